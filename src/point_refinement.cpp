#include "incremental_segmatch/point_refinement.hpp"

#include <Eigen/Eigenvalues>
#include <Eigen/Geometry>
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <limits>
#include <stdexcept>
#include <string>

#include "incremental_segmatch/twist.hpp"

namespace incremental_segmatch {
namespace {

using Matrix6 = Eigen::Matrix<double, 6, 6>;
using Vector6 = Eigen::Matrix<double, 6, 1>;

constexpr float kThin = 0.2f;  // variance across over variance along, below which a neighbourhood counts as thin
constexpr std::size_t kMinNeighbours = 8;  // that tell a surface's direction
constexpr double kPointWeight = 0.02;      // of a distance to a point: it has the cloud's spacing for an error
constexpr std::size_t kMinPairs = 30;
constexpr std::size_t kMaxCoarsePoints = 1000;
constexpr double kShrink = 0.85;          // of the robust weight's width, from iteration to iteration,
constexpr double kSettledShrink = 0.6;    // once the points move less than
constexpr double kSettled = 0.1;          // this share of it
constexpr double kFineSpacing = 0.5;        // of the target's points, over the distance to a partner at the end
constexpr double kStale = 0.2;  // motion over the spacing of the target's points, after which partners are sought anew
constexpr double kFineWidth = 1.0 / 3.0;  // of the robust weight in the last iteration, over the distance to a partner
constexpr double kSearchStep = 0.5;       // between places that are tried, over the distance to a partner in the beginning
constexpr double kSearchGain = 0.05;      // in overlap, from which another place is worth a refinement
constexpr std::size_t kSearchPoints = 300;
constexpr double kConvergedM = 5e-4;      // motion of the points in the last iteration
constexpr double kMaxExtentM = 1e5;       // floats are exact enough to a centimetre up to here
constexpr std::uint32_t kNone = 0xffffffffu;

/// d(xi at origin) / d(xi at center): what a perturbation about a center is about the origin.
Matrix6 Shift(const Eigen::Vector3d& center) {
  return Adjoint(Pose(Eigen::Translation3d(center)));
}

/// Points whose memory is fetched before it is read: target clouds do not fit into the second-level cache.
constexpr std::size_t kAhead = 16;

/// Points by cubic cells: contiguous per cell, the cells in an open hash table. Finds what is within a cell's side.
class CellHash {
 public:
  CellHash(const std::vector<Eigen::Vector3f>& points, float side) : side_(side), per_metre_(1.f / side) {
    std::vector<std::uint64_t> keys;
    keys.reserve(points.size() + kAhead);
    for (const Eigen::Vector3f& point : points) keys.push_back(KeyOf(point));
    keys.resize(points.size() + kAhead, 0);
    std::vector<std::uint32_t> slot_of(points.size());
    const auto count_points = [&](std::size_t least_slots) {
      std::size_t slots = 16;
      while (slots < least_slots) slots *= 2;
      table_.assign(slots, {});
      used_.clear();
      for (std::size_t i = 0; i < points.size(); ++i) {
        __builtin_prefetch(&table_[SlotOf(keys[i + kAhead])]);
        slot_of[i] = FindOrAdd(keys[i]);
        ++table_[slot_of[i]].count;
      }
    };
    count_points(2 * points.size());
    // Searches are as fast as the table is small.
    if (8 * used_.size() < table_.size()) count_points(2 * used_.size());
    std::uint32_t begin = 0;
    for (const std::uint32_t slot : used_) {
      table_[slot].begin = begin;
      begin += table_[slot].count;
      table_[slot].count = 0;
    }
    points_.resize(points.size());
    for (std::size_t i = 0; i < points.size(); ++i) {
      __builtin_prefetch(&table_[slot_of[std::min(i + kAhead, points.size() - 1)]]);
      Cell& cell = table_[slot_of[i]];
      points_[cell.begin + cell.count++] = points[i];
    }
  }

  const std::vector<Eigen::Vector3f>& points() const { return points_; }
  float side() const { return side_; }
  std::size_t memory_bytes() const {
    return points_.capacity() * sizeof(Eigen::Vector3f) + table_.capacity() * sizeof(Cell) +
           used_.capacity() * sizeof(std::uint32_t);
  }

  /// Mean of each cell's points.
  std::vector<Eigen::Vector3f> CellMeans() const {
    std::vector<Eigen::Vector3f> means;
    means.reserve(used_.size());
    for (const std::uint32_t slot : used_) {
      Eigen::Vector3f sum = Eigen::Vector3f::Zero();
      for (std::uint32_t i = 0; i < table_[slot].count; ++i)
        sum += points_[table_[slot].begin + i] - points_[table_[slot].begin];
      means.push_back(points_[table_[slot].begin] + sum / static_cast<float>(table_[slot].count));
    }
    return means;
  }

  /// Index of the nearest point within a distance of at most side(), kNone if there is none.
  std::uint32_t Nearest(const Eigen::Vector3f& p, float distance) const {
    std::uint32_t nearest = kNone;
    float best = distance * distance;
    VisitKeys(p, &best, [&](std::uint64_t key) {
      const Cell* const cell = Find(key);
      if (cell == nullptr) return;
      for (std::uint32_t i = cell->begin; i < cell->begin + cell->count; ++i) {
        const float distance2 = (points_[i] - p).squaredNorm();
        if (distance2 > best) continue;
        best = distance2;
        nearest = i;
      }
    });
    return nearest;
  }

  /// Calls visit(point) for each point within a radius of at most side().
  template <class Visit>
  void ForEachWithin(const Eigen::Vector3f& p, float radius, Visit&& visit) const {
    const float radius2 = radius * radius;
    std::array<std::uint64_t, 27> keys;  // fetched at once, then read
    std::size_t count = 0;
    VisitKeys(p, &radius2, [&](std::uint64_t key) {
      __builtin_prefetch(&table_[SlotOf(key)]);
      keys[count++] = key;
    });
    std::array<const Cell*, 27> cells;
    std::size_t found = 0;
    for (std::size_t k = 0; k < count; ++k) {
      const Cell* const cell = Find(keys[k]);
      if (cell == nullptr) continue;
      __builtin_prefetch(&points_[cell->begin]);
      cells[found++] = cell;
    }
    for (std::size_t k = 0; k < found; ++k) {
      for (std::uint32_t i = cells[k]->begin; i < cells[k]->begin + cells[k]->count; ++i)
        if ((points_[i] - p).squaredNorm() <= radius2) visit(points_[i]);
    }
  }

 private:
  struct Cell {
    std::uint64_t key = 0;
    std::uint32_t begin = 0;
    std::uint32_t count = 0;  ///< 0: a free slot
  };
  static constexpr std::uint64_t kBias = std::uint64_t{1} << 20;

  static std::uint64_t Pack(std::int64_t x, std::int64_t y, std::int64_t z) {
    return (static_cast<std::uint64_t>(x) + kBias) << 42 | ((static_cast<std::uint64_t>(y) + kBias) & 0x1fffff) << 21 |
           ((static_cast<std::uint64_t>(z) + kBias) & 0x1fffff);
  }
  Eigen::Vector3f CellOf(const Eigen::Vector3f& p) const { return (p * per_metre_).array().floor(); }
  std::uint64_t KeyOf(const Eigen::Vector3f& p) const {
    const Eigen::Vector3f cell = CellOf(p);
    return Pack(static_cast<std::int64_t>(cell.x()), static_cast<std::int64_t>(cell.y()),
                static_cast<std::int64_t>(cell.z()));
  }
  std::uint32_t SlotOf(std::uint64_t key) const {
    return static_cast<std::uint32_t>((key * 0x9e3779b97f4a7c15u) >> 32) &
           static_cast<std::uint32_t>(table_.size() - 1);
  }
  std::uint32_t FindOrAdd(std::uint64_t key) {
    std::uint32_t slot = SlotOf(key);
    while (table_[slot].count != 0 && table_[slot].key != key) slot = (slot + 1) & (table_.size() - 1);
    if (table_[slot].count == 0) {
      table_[slot].key = key;
      used_.push_back(slot);
    }
    return slot;
  }
  const Cell* Find(std::uint64_t key) const {
    for (std::uint32_t slot = SlotOf(key); table_[slot].count != 0; slot = (slot + 1) & (table_.size() - 1))
      if (table_[slot].key == key) return &table_[slot];
    return nullptr;
  }

  /// Calls visit(key) for p's cell and its neighbours, skipping those that are farther than the (shrinking) squared
  /// bound.
  template <class Visit>
  void VisitKeys(const Eigen::Vector3f& p, const float* bound2, Visit&& visit) const {
    const Eigen::Vector3f home = CellOf(p);
    const Eigen::Vector3f below = p - home * side_;
    const Eigen::Vector3f above = Eigen::Vector3f::Constant(side_) - below;
    const auto gap = [&](int axis, int step) {
      return step == 0 ? 0.f : std::max(0.f, step < 0 ? below[axis] : above[axis]);
    };
    static constexpr std::array<int, 3> kSteps{0, -1, 1};  // home first: its points tighten the bound
    for (const int dx : kSteps) {
      const float x2 = gap(0, dx) * gap(0, dx);
      if (x2 > *bound2) continue;
      for (const int dy : kSteps) {
        const float xy2 = x2 + gap(1, dy) * gap(1, dy);
        if (xy2 > *bound2) continue;
        for (const int dz : kSteps) {
          if (xy2 + gap(2, dz) * gap(2, dz) > *bound2) continue;
          visit(Pack(static_cast<std::int64_t>(home.x()) + dx, static_cast<std::int64_t>(home.y()) + dy,
                     static_cast<std::int64_t>(home.z()) + dz));
        }
      }
    }
  }

  float side_;
  float per_metre_;
  std::vector<Eigen::Vector3f> points_;
  std::vector<Cell> table_;
  std::vector<std::uint32_t> used_;
};

/// In which directions a target point holds a local point.
struct Surface {
  static constexpr int kUnknown = -1;
  int thin_directions = kUnknown;  ///< across a surface 1, across a pole 2, otherwise 0: held to the point itself
  std::array<Eigen::Vector3f, 2> across;
};

Surface EstimateSurface(const CellHash& cloud, const Eigen::Vector3f& p, float radius) {
  std::size_t count = 0;
  Eigen::Vector3f sum = Eigen::Vector3f::Zero();
  Eigen::Matrix3f outer = Eigen::Matrix3f::Zero();
  cloud.ForEachWithin(p, radius, [&](const Eigen::Vector3f& q) {
    const Eigen::Vector3f d = q - p;
    ++count;
    sum += d;
    outer.noalias() += d * d.transpose();
  });
  Surface surface;
  surface.thin_directions = 0;
  if (count < kMinNeighbours) return surface;
  const float n = static_cast<float>(count);
  Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> solver;
  solver.computeDirect((outer / n - sum * sum.transpose() / (n * n)).cast<double>());
  const Eigen::Vector3f variance = solver.eigenvalues().cast<float>();
  if (!(variance[0] < kThin * variance[2])) return surface;
  // A pole is thin in two directions alike; the rim of a wall, where the neighbourhood is cut off, only seems to be.
  const bool is_pole = variance[1] < kThin * variance[2] && variance[0] > kThin * variance[1];
  surface.thin_directions = is_pole ? 2 : 1;
  for (int axis = 0; axis < surface.thin_directions; ++axis)
    surface.across[axis] = solver.eigenvectors().col(axis).cast<float>();
  return surface;
}

/// The target at one spacing, with surfaces that are estimated when they are first asked for.
class SurfaceCloud {
 public:
  SurfaceCloud(const std::vector<Eigen::Vector3f>& points, float side) : cells_(points, side), surfaces_(points.size()) {}

  const CellHash& cells() const { return cells_; }
  std::size_t memory_bytes() const { return cells_.memory_bytes() + surfaces_.capacity() * sizeof(Surface); }
  /// Fetches a point, or none, and its surface.
  void FetchPoint(std::uint32_t point) const {
    if (point == kNone) return;
    __builtin_prefetch(&cells_.points()[point]);
    __builtin_prefetch(&surfaces_[point]);
  }
  const Surface& SurfaceAt(std::uint32_t point, const CellHash& cloud, float radius) {
    Surface& surface = surfaces_[point];
    if (surface.thin_directions == Surface::kUnknown) surface = EstimateSurface(cloud, cells_.points()[point], radius);
    return surface;
  }

 private:
  CellHash cells_;
  std::vector<Surface> surfaces_;
};

/// Normal equations of one iteration, perturbation on the left about the clouds' common origin.
struct System {
  Matrix6 information = Matrix6::Zero();
  Vector6 gradient = Vector6::Zero();
  std::size_t pairs = 0;
  double squares = 0.0;  ///< robustly weighted sum of squared residuals
  double weights = 0.0;
  double thin_squares = 0.0;  ///< of the pairs across something thin, unweighted
  std::size_t thin_pairs = 0;
  Eigen::Vector3d sum = Eigen::Vector3d::Zero();
  double sum_squared_norms = 0.0;

  Eigen::Vector3d Center() const { return sum / static_cast<double>(pairs); }
  /// Root mean square distance of the points from their center: what a rotation is multiplied by to be a length.
  double Extent() const {
    return std::sqrt(std::max(1e-6, sum_squared_norms / static_cast<double>(pairs) - Center().squaredNorm()));
  }
};

/// Adds weight * J^T J of a residual along a direction at a point, and its gradient.
void AddResidual(const Eigen::Vector3d& direction, const Eigen::Vector3d& at, double residual, double weight,
                 System* system) {
  Vector6 J;
  J << direction, at.cross(direction);
  const Vector6 weighted = weight * J;
  system->information.noalias() += weighted * J.transpose();
  system->gradient += residual * weighted;
}

/// Of each local point the nearest target point within the distance, or kNone.
std::vector<std::uint32_t> FindPartners(const std::vector<Eigen::Vector3f>& local, const Pose& T_target_local,
                                        const CellHash& target, float distance) {
  const Eigen::Matrix3f R = T_target_local.linear().cast<float>();
  const Eigen::Vector3f t = T_target_local.translation().cast<float>();
  std::vector<std::uint32_t> partners;
  partners.reserve(local.size());
  for (const Eigen::Vector3f& point : local) partners.push_back(target.Nearest(R * point + t, distance));
  return partners;
}

/// Whether each local point's partner is within the distance.
std::vector<bool> HavePartners(const std::vector<Eigen::Vector3f>& local, const std::vector<std::uint32_t>& partners,
                               const Pose& T_target_local, const CellHash& target, double distance_m) {
  const Eigen::Matrix3f R = T_target_local.linear().cast<float>();
  const Eigen::Vector3f t = T_target_local.translation().cast<float>();
  std::vector<bool> have(local.size());
  for (std::size_t i = 0; i < local.size(); ++i)
    have[i] = partners[i] != kNone && (R * local[i] + t - target.points()[partners[i]]).norm() <= distance_m;
  return have;
}

System BuildSystem(const std::vector<Eigen::Vector3f>& local, const std::vector<std::uint32_t>& partners,
                   const Pose& T_target_local, SurfaceCloud* target, const CellHash& cloud, float radius, float distance,
                   double width_m) {
  const Eigen::Matrix3f R = T_target_local.linear().cast<float>();
  const Eigen::Vector3f t = T_target_local.translation().cast<float>();
  const double width2 = width_m * width_m;
  System system;
  for (std::size_t i = 0; i < local.size(); ++i) {
    target->FetchPoint(partners[std::min(i + kAhead, local.size() - 1)]);
    if (partners[i] == kNone) continue;
    const Eigen::Vector3f p = R * local[i] + t;
    const Eigen::Vector3d difference = (p - target->cells().points()[partners[i]]).cast<double>();
    if (difference.squaredNorm() > distance * distance) continue;
    const Surface& surface = target->SurfaceAt(partners[i], cloud, radius);
    const Eigen::Vector3d at = p.cast<double>();
    std::array<double, 2> residual{};
    double square = 0.0;
    for (int k = 0; k < surface.thin_directions; ++k) {
      residual[k] = difference.dot(surface.across[k].cast<double>());
      square += residual[k] * residual[k];
    }
    if (surface.thin_directions == 0) square = kPointWeight * difference.squaredNorm();
    const double root = width2 / (width2 + square);
    const double weight = root * root;  // Geman and McClure
    if (surface.thin_directions == 0) {
      for (int axis = 0; axis < 3; ++axis)
        AddResidual(Eigen::Vector3d::Unit(axis), at, difference[axis], kPointWeight * weight, &system);
    } else {
      for (int k = 0; k < surface.thin_directions; ++k)
        AddResidual(surface.across[k].cast<double>(), at, residual[k], weight, &system);
      system.thin_squares += square;
      ++system.thin_pairs;
    }
    system.squares += weight * square;
    system.weights += weight;
    system.sum += at;
    system.sum_squared_norms += at.squaredNorm();
    ++system.pairs;
  }
  return system;
}

/// The system about the points' center with rotations as lengths, in its eigenbasis: stiff directions and open ones.
struct Directions {
  Matrix6 basis;      ///< columns: perturbations about the clouds' common origin, each moving the points by some 1 m
  Vector6 stiffness;  ///< ascending
  int open = 0;       ///< the first so many directions are open

  Directions(const System& system, double min_stiffness) {
    Matrix6 scaled = Shift(system.Center());
    scaled.rightCols<3>() /= system.Extent();
    const Eigen::SelfAdjointEigenSolver<Matrix6> solver(scaled.transpose() * system.information * scaled);
    basis = scaled * solver.eigenvectors();
    stiffness = solver.eigenvalues();
    while (open < 6 && !(stiffness[open] > min_stiffness * stiffness[5])) ++open;
  }

  /// Gauss-Newton step over the stiff directions; its length in metres at the points.
  std::pair<Vector6, double> Step(const Vector6& gradient) const {
    Vector6 along = -(basis.transpose() * gradient);
    for (int i = 0; i < 6; ++i) along[i] = i < open ? 0.0 : along[i] / stiffness[i];
    return {basis * along, along.norm()};
  }
};

Pose Perturb(const Vector6& xi, const Pose& T) {
  Pose delta = Pose::Identity();
  const double angle = xi.tail<3>().norm();
  if (angle > 0.0) delta.linear() = Eigen::AngleAxisd(angle, xi.tail<3>() / angle).toRotationMatrix();
  delta.translation() = xi.head<3>();
  return delta * T;
}

/// Points relative to a center, without those that are not finite or absurdly far away.
std::vector<Eigen::Vector3f> Center(const std::vector<Eigen::Vector3d>& points, const Eigen::Vector3d& center) {
  std::vector<Eigen::Vector3f> centered;
  centered.reserve(points.size());
  for (const Eigen::Vector3d& p : points) {
    const Eigen::Vector3d relative = p - center;
    if (relative.cwiseAbs().maxCoeff() < kMaxExtentM && relative.allFinite())
      centered.push_back(relative.cast<float>());
  }
  return centered;
}

Eigen::Vector3d Mean(const std::vector<Eigen::Vector3d>& points) {
  Eigen::Vector3d sum = Eigen::Vector3d::Zero();
  std::size_t count = 0;
  for (const Eigen::Vector3d& p : points) {
    if (!p.allFinite()) continue;
    sum += p;
    ++count;
  }
  return count == 0 ? sum : Eigen::Vector3d(sum / static_cast<double>(count));
}

/// At most `count` points, spread evenly over the list.
std::vector<Eigen::Vector3f> Thin(const std::vector<Eigen::Vector3f>& points, std::size_t count) {
  if (points.size() <= count) return points;
  std::vector<Eigen::Vector3f> thinned;
  thinned.reserve(count);
  for (std::size_t i = 0; i < count; ++i) thinned.push_back(points[i * points.size() / count]);
  return thinned;
}

/// Share of the pairs that tell something of their own: neighbours share the errors of the surface that they are held
/// to.
double IndependentShare(const std::vector<Eigen::Vector3f>& local, float side) {
  return static_cast<double>(CellHash(local, side).CellMeans().size()) / static_cast<double>(local.size());
}

void Refuse(const char* name, double value, const char* remedy) {
  throw std::invalid_argument(std::string("refinement.") + name + " is " + std::to_string(value) + "; it must be " +
                              remedy);
}

}  // namespace

void Validate(const RefinementParameters& parameters) {
  const auto is_length = [](double value) { return value > 0.0 && std::isfinite(value); };
  if (!is_length(parameters.min_distance_m)) Refuse("min_distance_m", parameters.min_distance_m, "positive and finite");
  if (!(parameters.max_distance_m >= parameters.min_distance_m) || !is_length(parameters.max_distance_m))
    Refuse("max_distance_m", parameters.max_distance_m, "finite and at least min_distance_m");
  if (!(parameters.search_m >= 0.0) || !std::isfinite(parameters.search_m))
    Refuse("search_m", parameters.search_m, "finite and not negative");
  if (!(parameters.search_overlap >= 0.0 && parameters.search_overlap <= 1.0))
    Refuse("search_overlap", parameters.search_overlap, "between 0 and 1");
  if (parameters.max_iterations < 1) Refuse("max_iterations", parameters.max_iterations, "at least 1");
  if (!(parameters.min_overlap >= 0.0 && parameters.min_overlap <= 1.0))
    Refuse("min_overlap", parameters.min_overlap, "between 0 and 1");
  if (!is_length(parameters.normal_radius_m))
    Refuse("normal_radius_m", parameters.normal_radius_m, "positive and finite");
  if (parameters.max_points < kMinPairs)
    Refuse("max_points", static_cast<double>(parameters.max_points), "at least 30");
  if (!(parameters.min_stiffness > 0.0 && parameters.min_stiffness < 1.0))
    Refuse("min_stiffness", parameters.min_stiffness, "between 0 and 1");
  if (parameters.max_open_directions < 0 || parameters.max_open_directions > 5)
    Refuse("max_open_directions", parameters.max_open_directions, "between 0 and 5");
  if (!(parameters.floor_m >= 0.0) || !std::isfinite(parameters.floor_m))
    Refuse("floor_m", parameters.floor_m, "zero or positive, and finite");
  if (!(parameters.floor_rad >= 0.0) || !std::isfinite(parameters.floor_rad))
    Refuse("floor_rad", parameters.floor_rad, "zero or positive, and finite");
}

/// Target points of a refinement's points.
struct Partners {
  std::vector<std::uint32_t> points;
  const SurfaceCloud* target = nullptr;  ///< where they are
  double moved_m = 0.0;                  ///< by which the points have moved since they were found
};

/// Where an attempt came to rest.
struct Fit {
  Pose T_target_local = Pose::Identity();  ///< both relative to their centers
  System system;
  Partners partners;
  double overlap = 0.0;
};

/// Relative to its own center, as the local cloud is to its own: floats and normal equations are good at small numbers.
struct RefinementTarget::Impl {
  Impl(const std::vector<Eigen::Vector3d>& points, const RefinementParameters& parameters)
      : parameters(parameters),
        center(Mean(points)),
        fine(CellHash(Center(points, center), static_cast<float>(kFineSpacing * parameters.min_distance_m)).CellMeans(),
             static_cast<float>(std::max(parameters.normal_radius_m, parameters.min_distance_m))),
        coarse(CellHash(fine.cells().points(), static_cast<float>(parameters.min_distance_m)).CellMeans(),
               static_cast<float>(parameters.max_distance_m)) {}

  /// Partners stay as long as they are of the same points and these have hardly moved since.
  System BuildSystem(const std::vector<Eigen::Vector3f>& local, const Pose& T, double width_m, Partners* partners) {
    SurfaceCloud* const target = width_m <= parameters.min_distance_m ? &fine : &coarse;
    const float distance = static_cast<float>(std::max(width_m, parameters.min_distance_m));
    const double spacing_m = (target == &fine ? kFineSpacing : 1.0) * parameters.min_distance_m;
    if (target != partners->target || partners->points.size() != local.size() || partners->moved_m > kStale * spacing_m)
      *partners = {FindPartners(local, T, target->cells(), distance), target, 0.0};
    return incremental_segmatch::BuildSystem(local, partners->points, T, target, fine.cells(),
                                             static_cast<float>(parameters.normal_radius_m), distance, width_m);
  }

  /// Iterative closest points from one place on: wide as long as far points are far from their true partners; the distance to a
  /// partner follows down to its minimum. Nothing if too few have partners.
  std::optional<Fit> Descend(const std::vector<Eigen::Vector3f>& local, const std::vector<Eigen::Vector3f>& coarse_local, Pose T) {
    const double last_width_m = kFineWidth * parameters.min_distance_m;
    double width_m = parameters.max_distance_m;
    Fit fit;
    bool converged = false;
    for (int iteration = 0; iteration < parameters.max_iterations && !converged; ++iteration) {
      const bool is_last = width_m == last_width_m;
      fit.system = BuildSystem(is_last ? local : coarse_local, T, width_m, &fit.partners);
      if (fit.system.pairs < kMinPairs) return std::nullopt;
      const auto [step, length_m] = Directions(fit.system, parameters.min_stiffness).Step(fit.system.gradient);
      T = Perturb(step, T);
      fit.partners.moved_m += length_m;
      converged = is_last && length_m < kConvergedM;
      width_m = std::max(last_width_m, (length_m < kSettled * width_m ? kSettledShrink : kShrink) * width_m);
    }
    if (!converged) fit.system = BuildSystem(local, T, last_width_m, &fit.partners);
    if (fit.system.pairs < kMinPairs) return std::nullopt;
    fit.T_target_local = T;
    fit.overlap = static_cast<double>(fit.system.pairs) / static_cast<double>(local.size());
    return fit;
  }

  /// Share of the local points, both relative to their centers, that have a partner.
  double Overlap(const std::vector<Eigen::Vector3f>& local, const Pose& T) const {
    const std::vector<std::uint32_t> partners =
        FindPartners(local, T, fine.cells(), static_cast<float>(parameters.min_distance_m));
    const auto alone = std::count(partners.begin(), partners.end(), kNone);
    return 1.0 - static_cast<double>(alone) / static_cast<double>(partners.size());
  }

  /// Of a grid of places around one, along x and y, that where most points have a partner; nothing if it is hardly better than
  /// the one in the middle.
  std::optional<Pose> Search(const std::vector<Eigen::Vector3f>& local, const Pose& T_middle) const {
    double best = Overlap(local, T_middle) + kSearchGain;
    std::optional<Pose> best_T;
    const double step_m = kSearchStep * parameters.max_distance_m;
    const int steps = static_cast<int>(parameters.search_m / step_m);
    for (int x = -steps; x <= steps; ++x) {
      for (int y = -steps; y <= steps; ++y) {
        const Pose T = Eigen::Translation3d(step_m * x, step_m * y, 0.0) * T_middle;
        const double there = Overlap(local, T);
        if (there <= best) continue;
        best = there;
        best_T = T;
      }
    }
    return best_T;
  }

  RefinementParameters parameters;
  Eigen::Vector3d center;
  SurfaceCloud fine;
  SurfaceCloud coarse;
};

RefinementTarget::RefinementTarget(const std::vector<Eigen::Vector3d>& points_target,
                                   const RefinementParameters& parameters) {
  Validate(parameters);
  impl_ = std::make_unique<Impl>(points_target, parameters);
}
RefinementTarget::~RefinementTarget() = default;
RefinementTarget::RefinementTarget(RefinementTarget&&) noexcept = default;
RefinementTarget& RefinementTarget::operator=(RefinementTarget&&) noexcept = default;

std::size_t RefinementTarget::memory_bytes() const {
  return sizeof(Impl) + impl_->fine.memory_bytes() + impl_->coarse.memory_bytes();
}

std::optional<RefinedTransform> RefinementTarget::Refine(const std::vector<Eigen::Vector3d>& points_local,
                                                         const Pose& T_target_local) {
  const RefinementParameters& parameters = impl_->parameters;
  const Eigen::Vector3d center_target = impl_->center, center_local = Mean(points_local);
  const std::vector<Eigen::Vector3f> local = Thin(Center(points_local, center_local), parameters.max_points);
  if (local.size() < kMinPairs || impl_->fine.cells().points().size() < kMinPairs) return std::nullopt;
  const std::vector<Eigen::Vector3f> coarse_local = Thin(local, kMaxCoarsePoints);
  const Pose T_begin = Eigen::Translation3d(-center_target) * T_target_local * Eigen::Translation3d(center_local);
  std::optional<Fit> fit = impl_->Descend(local, coarse_local, T_begin);
  if (!fit || fit->overlap < parameters.search_overlap) {
    if (const auto T_better = impl_->Search(Thin(local, kSearchPoints), fit ? fit->T_target_local : T_begin)) {
      std::optional<Fit> other = impl_->Descend(local, coarse_local, *T_better);
      if (other && (!fit || other->overlap > fit->overlap)) fit = std::move(other);
    }
  }
  if (!fit || fit->overlap < parameters.min_overlap) return std::nullopt;
  const System& system = fit->system;
  const Pose& T = fit->T_target_local;

  RefinedTransform refined;
  refined.has_partner =
      HavePartners(local, fit->partners.points, T, fit->partners.target->cells(), parameters.min_distance_m);
  refined.overlap = fit->overlap;
  const Directions directions(system, parameters.min_stiffness);
  refined.open_directions = directions.open;
  if (directions.open > parameters.max_open_directions) return std::nullopt;
  refined.rms_m = std::sqrt(system.thin_squares / static_cast<double>(std::max<std::size_t>(1, system.thin_pairs)));

  const double variance =
      system.squares / system.weights / IndependentShare(local, static_cast<float>(parameters.min_distance_m));
  Vector6 variances, floors;
  for (int i = 0; i < 6; ++i)
    variances[i] =
        i < directions.open ? std::pow(parameters.max_distance_m / 2.0, 2) : variance / directions.stiffness[i];
  floors << Eigen::Vector3d::Constant(std::pow(parameters.floor_m, 2)),
      Eigen::Vector3d::Constant(std::pow(parameters.floor_rad, 2));
  const Matrix6 to_target_origin = Shift(center_target), from_directions = to_target_origin * directions.basis;
  refined.covariance = from_directions * variances.asDiagonal() * from_directions.transpose() +
                       to_target_origin * floors.asDiagonal() * to_target_origin.transpose();
  refined.T_target_local = Eigen::Translation3d(center_target) * T * Eigen::Translation3d(-center_local);
  // Products of many rotations drift from being one.
  refined.T_target_local.linear() = Eigen::Quaterniond(refined.T_target_local.linear()).normalized().toRotationMatrix();
  return refined;
}

double RefinementTarget::Overlap(const std::vector<Eigen::Vector3d>& points_local, const Pose& T_target_local) const {
  const std::vector<Eigen::Vector3f> local =
      Thin(Center(points_local, Eigen::Vector3d::Zero()), impl_->parameters.max_points);
  if (local.empty()) return 0.0;
  return impl_->Overlap(local, Eigen::Translation3d(-impl_->center) * T_target_local);
}

}  // namespace incremental_segmatch
