#include "incremental_segmatch/incremental_normals.hpp"

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>
#include <string>

namespace incremental_segmatch {
namespace {

constexpr VoxelHandle kCells = DynamicVoxelGrid::kCellsPerBlock;
constexpr int kSide = DynamicVoxelGrid::kBlockSide;

/// What positions relative to the accumulators' reference contribute: products of integers, exact in float.
struct Contribution {
  Eigen::Array4f squares = Eigen::Array4f::Zero(), products = Eigen::Array4f::Zero(), sum = Eigen::Array4f::Zero();

  void Add(const Eigen::Array4f& p) {
    squares += p * p;
    products += p * Rotated(p);
    sum += p;
  }
  void Subtract(const Eigen::Array4f& p) {
    squares -= p * p;
    products -= p * Rotated(p);
    sum -= p;
  }
  static Eigen::Array4f Rotated(const Eigen::Array4f& p) { return {p[1], p[2], p[0], p[3]}; }
};

/// The finest power of two of units per cell for which all sums over a full neighbourhood are exact: products in float, sums in
/// 32 bits. A neighbour lies within the radius of a point that is at most half a cell from the reference, on each axis.
int UnitsPerCell(const NeighbourStencil& stencil, double radius_cells) {
  std::size_t most_neighbours = 0;
  for (unsigned cell = 0; cell < kCells; ++cell) {
    std::size_t cells = 0;
    for (const NeighbourStencil::BlockVisit& visit : stencil.visits(cell))
      cells += static_cast<std::size_t>(__builtin_popcountll(visit.cells));
    most_neighbours = std::max(most_neighbours, cells);
  }
  int units = 512;
  const auto largest_product = [&] { return std::pow((radius_cells + 0.5) * units, 2); };
  while (largest_product() > 0x1p24 || largest_product() * static_cast<double>(most_neighbours) >= 0x1p31) units /= 2;
  return units;
}

}  // namespace

SmallestEigen SmallestEigenOf(const Eigen::Matrix3d& m) {
  SmallestEigen result{Eigen::Vector3d::UnitZ(), 0.0, m.trace()};
  if (!(result.trace > 0.0)) return result;
  // Laguerre's iteration on p(x) = det(m - x) = c0 - c1 x + c2 x^2 - x^3 rises monotonically from 0 to the smallest root, and
  // cubically near it: all roots are real.
  const double c0 = m.determinant(), c2 = result.trace;
  const double c1 = m(0, 0) * m(1, 1) - m(0, 1) * m(0, 1) + m(0, 0) * m(2, 2) - m(0, 2) * m(0, 2) + m(1, 1) * m(2, 2) -
                    m(1, 2) * m(1, 2);
  const double rounding = 1e-15 * c2 * c2 * c2;  // of p(x)
  double x = 0.0;
  for (int i = 0; i < 40; ++i) {
    const double value = c0 + x * (-c1 + x * (c2 - x));
    const double slope = -c1 + x * (2.0 * c2 - 3.0 * x);
    const double bend = 2.0 * c2 - 6.0 * x;
    if (!(value > rounding) || !(slope < 0.0)) break;
    const double root = std::sqrt(std::max(0.0, 4.0 * slope * slope - 6.0 * value * bend));
    const double step = 3.0 * value / (root - slope);
    x += step;
    if (step <= 1e-6 * x) break;  // the next would be some 1e-18
  }
  result.value = x;
  // The vector is perpendicular to all rows of m - x: the longest product of two of them is the most accurate.
  Eigen::Matrix3d rows = m;
  rows.diagonal().array() -= x;
  const Eigen::Vector3d a = rows.row(0).cross(rows.row(1)), b = rows.row(0).cross(rows.row(2)), c = rows.row(1).cross(rows.row(2));
  const double aa = a.squaredNorm(), bb = b.squaredNorm(), cc = c.squaredNorm();
  const double longest2 = std::max({aa, bb, cc});
  if (longest2 > 1e-24 * std::pow(result.trace, 4)) {
    result.vector = (longest2 == aa ? a : longest2 == bb ? b : c) / std::sqrt(longest2);
    return result;
  }
  // Two equal eigenvalues: any direction perpendicular to the third's will do, and any at all if all are equal.
  Eigen::Index longest = 0;
  if (rows.rowwise().squaredNorm().maxCoeff(&longest) > 1e-24 * result.trace * result.trace)
    result.vector = Eigen::Vector3d(rows.row(longest)).unitOrthogonal();
  return result;
}

IncrementalNormals::IncrementalNormals(const NormalsParameters& parameters, const DynamicVoxelGrid& grid)
    : parameters_(parameters), grid_(&grid), stencil_(parameters.radius_m, grid.parameters().resolution_m) {
  const double resolution_m = grid.parameters().resolution_m;
  const double radius_cells = parameters.radius_m / resolution_m;
  if (!(radius_cells <= 8.0))
    throw std::invalid_argument("normals.radius_m: must be at most 8 voxels of " + std::to_string(resolution_m) + " m, is " +
                                std::to_string(parameters.radius_m));
  if (!(parameters.renewal_tolerance_voxels >= 0.0))
    throw std::invalid_argument("normals.renewal_tolerance_voxels: must not be negative, is " +
                                std::to_string(parameters.renewal_tolerance_voxels));
  units_per_cell_ = UnitsPerCell(stencil_, radius_cells);
  for (int cell = 0; cell < static_cast<int>(kCells); ++cell) {
    const Eigen::Array4i indices(cell % kSide, cell / kSide % kSide, cell / (kSide * kSide), 0);
    cell_centers_[cell] = (indices * units_per_cell_ + Eigen::Array4i(1, 1, 1, 0) * (units_per_cell_ / 2)).cast<float>();
  }
  unit_m_ = resolution_m / units_per_cell_;
  units_per_m_ = static_cast<float>(1.0 / unit_m_);
  const double radius_units = radius_cells * units_per_cell_ * (1.0 + 1e-9);  // radii that are whole voxels are whole units
  radius2_units_ = static_cast<float>(std::floor(radius_units * radius_units));
  const double tolerance_units = parameters.renewal_tolerance_voxels * units_per_cell_;
  tolerance2_units_ = static_cast<float>(tolerance_units * tolerance_units);
}

void IncrementalNormals::Remove(const std::vector<RemovedVoxel>& removed) {
  // All leave before any takes back what it gave: nobody cares for the accumulators of those that go along.
  leaving_.clear();
  for (const RemovedVoxel& gone : removed) {
    if (!IsAnchored(gone.voxel)) continue;
    masks_[gone.voxel / kCells].anchored &= ~(std::uint64_t{1} << (gone.voxel % kCells));
    leaving_.push_back(gone.voxel);
  }
  for (const VoxelHandle voxel : leaving_) Replace<true, false>(voxel, Position::Zero());
}

void IncrementalNormals::Insert(const VoxelUpdate& update) {
  const std::size_t blocks = grid_->handle_capacity() / kCells;
  blocks_.Grow(blocks);
  if (masks_.size() < blocks) masks_.resize(blocks);
  renewing_.clear();
  for (const MovedVoxel& moved : update.moved) {
    const Position position = PositionOf(moved.voxel, moved.after_block);
    const Position& anchor = blocks_[moved.voxel / kCells].anchors[moved.voxel % kCells];
    if ((position - anchor).matrix().squaredNorm() > tolerance2_units_) renewing_.push_back(moved.voxel);
  }
  std::sort(renewing_.begin(), renewing_.end());
  for (const VoxelHandle voxel : renewing_) Replace<true, true>(voxel, PositionOf(voxel, grid_->CentroidInBlock(voxel)));
  for (const VoxelHandle voxel : update.activated)
    Replace<false, true>(voxel, PositionOf(voxel, grid_->CentroidInBlock(voxel)));
}

IncrementalNormals::Position IncrementalNormals::PositionOf(VoxelHandle voxel, const Eigen::Vector3f& in_block) const {
  const Position& center = cell_centers_[voxel % kCells];
  const float half = 0.5f * static_cast<float>(units_per_cell_);
  Position position;
  for (int axis = 0; axis < 3; ++axis)  // rounding must not carry it out of its cell
    position[axis] = std::clamp(std::floor(in_block[axis] * units_per_m_ + 0.5f), center[axis] - half, center[axis] + half);
  position[3] = 1.f;
  return position;
}

/// The voxel takes back what it gave as of its anchor (kWithdraw), and gives anew as of the position, its anchor from now on (kGive).
/// Its own accumulators get the neighbours that it wins, and lose those that it leaves.
template <bool kWithdraw, bool kGive>
void IncrementalNormals::Replace(VoxelHandle voxel, const Position& position) {
  const unsigned cell = voxel % kCells;
  const std::uint32_t home = voxel / kCells;
  Moments own = blocks_[home].moments[cell];
  const Position before = blocks_[home].anchors[cell];
  if (!kWithdraw) own = {Eigen::Array4i::Zero(), Eigen::Array4i::Zero(), Eigen::Array4i::Zero()};
  const Position& center = cell_centers_[cell];
  const auto give = [](const Contribution& contribution, Moments* to) {
    to->squares += contribution.squares.cast<int>();
    to->products += contribution.products.cast<int>();
    to->sum += contribution.sum.cast<int>();
  };
  masks_[home].anchored &= ~(std::uint64_t{1} << cell);  // not a neighbour of its own

  // Blocks lie anywhere in memory: each pass fetches what the next one reads, so that the fetches overlap.
  reached_.clear();
  grid_->ForEachStencilBlock(stencil_, voxel, [&](std::uint32_t slot, const NeighbourStencil::BlockVisit& at) {
    const std::uint64_t cells = masks_[slot].anchored & at.cells;
    if (cells == 0) return true;
    for (std::uint64_t rest = cells; rest != 0; rest &= rest - 1) __builtin_prefetch(&blocks_[slot].anchors[__builtin_ctzll(rest)]);
    const Eigen::Array4i offset(at.offset[0], at.offset[1], at.offset[2], 0);
    reached_.push_back({(offset * (kSide * units_per_cell_)).cast<float>(), cells, slot});
    return true;
  });
  neighbours_.clear();
  for (const ReachedBlock& reached : reached_) {
    Block& other = blocks_[reached.slot];
    const Position before_there = before - reached.corner, position_there = position - reached.corner;
    std::uint64_t changed = 0;
    for (std::uint64_t cells = reached.cells; cells != 0; cells &= cells - 1) {
      const unsigned neighbour = static_cast<unsigned>(__builtin_ctzll(cells));
      const Position& anchor = other.anchors[neighbour];
      const bool was_near = kWithdraw && (anchor - before_there).matrix().squaredNorm() <= radius2_units_;
      const bool is_near = kGive && (anchor - position_there).matrix().squaredNorm() <= radius2_units_;
      if (!was_near && !is_near) continue;
      changed |= cells & -cells;
      __builtin_prefetch(&other.moments[neighbour].squares, 1);
      __builtin_prefetch(&other.moments[neighbour].sum, 1);
      neighbours_.push_back({reached.corner + cell_centers_[neighbour], &other.moments[neighbour], was_near, is_near});
      if (!kGive || was_near == is_near) continue;
      Contribution theirs;
      is_near ? theirs.Add(anchor + reached.corner - center) : theirs.Subtract(anchor + reached.corner - center);
      give(theirs, &own);
    }
    masks_[reached.slot].stale |= changed;
  }
  for (const Neighbour& neighbour : neighbours_) {
    Contribution change;
    if (neighbour.is_near) change.Add(position - neighbour.center);
    if (neighbour.was_near) change.Subtract(before - neighbour.center);
    give(change, neighbour.moments);
  }

  if (!kGive) return;
  Contribution change;
  change.Add(position - center);
  if (kWithdraw) change.Subtract(before - center);
  give(change, &own);
  blocks_[home].moments[cell] = own;
  blocks_[home].anchors[cell] = position;
  masks_[home].anchored |= std::uint64_t{1} << cell;
  masks_[home].stale |= std::uint64_t{1} << cell;
}

bool IncrementalNormals::IsAnchored(VoxelHandle voxel) const {
  return voxel / kCells < masks_.size() && (masks_[voxel / kCells].anchored >> (voxel % kCells) & 1) != 0;
}

const IncrementalNormals::Moments& IncrementalNormals::MomentsOf(VoxelHandle voxel) const {
  if (!IsAnchored(voxel)) throw std::invalid_argument("voxel " + std::to_string(voxel) + " has no normal: it is not active");
  return blocks_[voxel / kCells].moments[voxel % kCells];
}

const NormalEstimate& IncrementalNormals::Estimate(VoxelHandle voxel) const {
  const Moments& moments = MomentsOf(voxel);
  const std::uint64_t bit = std::uint64_t{1} << (voxel % kCells);
  NormalEstimate& estimate = blocks_[voxel / kCells].estimates[voxel % kCells];
  if (masks_[voxel / kCells].stale & bit) {
    estimate = Compute(moments);
    masks_[voxel / kCells].stale &= ~bit;
  }
  return estimate;
}

/// (3.7) in square units. Integers up to here: only the difference is rounded.
Eigen::Matrix3d IncrementalNormals::CovarianceOf(const Moments& moments) const {
  const double n = moments.squares[3];
  const Eigen::Vector3d b(moments.sum[0], moments.sum[1], moments.sum[2]);
  Eigen::Matrix3d a;
  a << moments.squares[0], moments.products[0], moments.products[2],  //
      moments.products[0], moments.squares[1], moments.products[1],   //
      moments.products[2], moments.products[1], moments.squares[2];
  return (n * a - b * b.transpose()) / (n * n);
}

NormalEstimate IncrementalNormals::Compute(const Moments& moments) const {
  if (moments.squares[3] < 3) {
    const float nan = std::numeric_limits<float>::quiet_NaN();
    return {Eigen::Vector3f::Constant(nan), nan};
  }
  const SmallestEigen eigen = SmallestEigenOf(CovarianceOf(moments));
  return {eigen.vector.cast<float>(), eigen.trace > 0.0 ? static_cast<float>(eigen.value / eigen.trace) : 0.f};
}

Eigen::Vector3d IncrementalNormals::NormalOdom(VoxelHandle voxel, const Eigen::Vector3d& viewpoint_odom) const {
  const Eigen::Vector3d normal = grid_->T_odom_grid().linear() * Estimate(voxel).normal_grid.cast<double>();
  return normal.dot(viewpoint_odom - grid_->CentroidOdom(voxel)) < 0.0 ? Eigen::Vector3d(-normal) : normal;
}

double IncrementalNormals::PlaneResidual(VoxelHandle voxel) const {
  const double curvature = Estimate(voxel).curvature;
  return unit_m_ * std::sqrt(curvature * CovarianceOf(MomentsOf(voxel)).trace());
}

NormalAccumulators IncrementalNormals::Accumulators(VoxelHandle voxel) const {
  const Moments& moments = MomentsOf(voxel);
  NormalAccumulators accumulators;
  accumulators.count = moments.squares[3];
  for (int axis = 0; axis < 3; ++axis) {
    const int next = (axis + 1) % 3;
    accumulators.sum[axis] = moments.sum[axis];
    accumulators.outer(axis, axis) = moments.squares[axis];
    accumulators.outer(axis, next) = accumulators.outer(next, axis) = moments.products[axis];
  }
  return accumulators;
}

Eigen::Vector3i IncrementalNormals::Anchor(VoxelHandle voxel) const {
  MomentsOf(voxel);  // throws if there is none
  return (blocks_[voxel / kCells].anchors[voxel % kCells] - cell_centers_[voxel % kCells]).head<3>().cast<int>();
}

}  // namespace incremental_segmatch
