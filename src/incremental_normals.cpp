#include "incremental_segmatch/incremental_normals.hpp"

#if defined(__SSE2__)
#include <emmintrin.h>
#endif

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>
#include <string>

namespace incremental_segmatch {
namespace {

constexpr VoxelHandle kCells = DynamicVoxelGrid::kCellsPerBlock;
constexpr unsigned kSide = DynamicVoxelGrid::kBlockSide;

/// Bit i is set where lane i is at most the limit.
std::uint64_t LanesAtMost(const Eigen::Array4f& lanes, float limit) {
#if defined(__SSE2__)
  return static_cast<std::uint64_t>(_mm_movemask_ps(_mm_cmple_ps(_mm_loadu_ps(lanes.data()), _mm_set1_ps(limit))));
#else
  std::uint64_t bits = 0;
  for (int i = 0; i < 4; ++i) bits |= static_cast<std::uint64_t>(lanes[i] <= limit) << i;
  return bits;
#endif
}

/// The finest power of two of units per cell for which all sums over a full neighbourhood are exact: products in float, sums in
/// 32 bits. A neighbour lies within the radius of a point that is at most half a cell from the reference, on each axis.
int UnitsPerCell(const NeighbourStencil& stencil, double radius_cells) {
  std::size_t most_neighbours = 0;
  for (unsigned cell = 0; cell < kCells; ++cell) {
    const NeighbourStencil::Neighbourhood& around = stencil.around(cell);
    std::size_t cells = 0;
    for (const NeighbourStencil::BlockVisit& visit : around.adjacent)
      cells += static_cast<std::size_t>(__builtin_popcountll(visit.cells));
    for (const NeighbourStencil::BlockVisit& visit : around.farther)
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
  const auto center_of = [&](unsigned index) { return (static_cast<float>(index) + 0.5f) * static_cast<float>(units_per_cell_); };
  for (unsigned cell = 0; cell < kCells; ++cell)
    cell_centers_[cell] = Position(center_of(cell % kSide), center_of(cell / kSide % kSide), center_of(cell / (kSide * kSide)), 0.f);
  unit_m_ = resolution_m / units_per_cell_;
  units_per_m_ = static_cast<float>(1.0 / unit_m_);
  const double radius_units = radius_cells * units_per_cell_ * (1.0 + 1e-9);  // radii that are whole voxels are whole units
  radius2_units_ = static_cast<float>(std::floor(radius_units * radius_units));
  const double tolerance_units = parameters.renewal_tolerance_voxels * units_per_cell_;
  tolerance2_units_ = static_cast<float>(tolerance_units * tolerance_units);
}

/// Adds (sign 1) or takes out (-1) what a position relative to the accumulators' reference contributes: products of integers, exact
/// in float.
template <int kSign>
void IncrementalNormals::Accumulate(const Position& p, Moments* moments) {
  moments->squares += kSign * (p.xyz1 * p.xyz1).cast<int>();
  moments->products += kSign * (p.xyz1 * p.yzx1).cast<int>();
  moments->sum += kSign * p.xyz1.cast<int>();
}

/// Takes out what position a contributes and adds what b does, given b - a and a + b: b b - a a = (b - a) (b + a), and
/// bx by - ax ay = ((bx - ax) (by + ay) + (by - ay) (bx + ax)) / 2. Exact as well.
void IncrementalNormals::AccumulateMove(const Position& difference, const Position& sum, Moments* moments) {
  moments->squares += (difference.xyz1 * sum.xyz1).cast<int>();
  moments->products += (0.5f * (difference.xyz1 * sum.yzx1 + difference.yzx1 * sum.xyz1)).cast<int>();
  moments->sum += difference.xyz1.cast<int>();
}

void IncrementalNormals::Remove(const std::vector<RemovedVoxel>& removed) {
  // All leave before any takes back what it gave: nobody cares for the accumulators of those that go along.
  leaving_.clear();
  for (const RemovedVoxel& gone : removed) {
    if (!IsAnchored(gone.voxel)) continue;
    Masks& home = masks_[gone.voxel / kCells];
    home.anchored &= ~CellBit(gone.voxel);
    home.overdue &= ~CellBit(gone.voxel);
    leaving_.push_back(gone.voxel);
  }
  for (const VoxelHandle voxel : leaving_) Replace<true, false>(voxel, Position());
}

void IncrementalNormals::Insert(const VoxelUpdate& update) {
  const std::size_t blocks = grid_->handle_capacity() / kCells;
  blocks_.Grow(blocks);
  if (masks_.size() < blocks) masks_.resize(blocks);
  for (const MovedVoxel& moved : update.moved) {
    Masks& home = masks_[moved.voxel / kCells];
    if ((home.overdue & CellBit(moved.voxel)) != 0) continue;
    const Position position = PositionOf(moved.voxel, grid_->CentroidInBlock(moved.voxel));
    const Position anchor = blocks_[moved.voxel / kCells].Anchor(moved.voxel % kCells);
    if ((position - anchor).xyz1.matrix().squaredNorm() <= tolerance2_units_) continue;
    home.overdue |= CellBit(moved.voxel);
    grid_->ForEachStencilBlock(stencil_, moved.voxel, [&](std::uint32_t slot, const NeighbourStencil::BlockVisit& at) {
      masks_[slot].stale |= masks_[slot].anchored & at.cells;
      return true;
    });
  }
  for (const VoxelHandle voxel : update.activated)
    Replace<false, true>(voxel, PositionOf(voxel, grid_->CentroidInBlock(voxel)));
}

/// Renews the contributions that are overdue among all that may reach the voxel's accumulators: if there are any, its estimate is
/// stale.
void IncrementalNormals::RenewAround(VoxelHandle voxel) const {
  if ((masks_[voxel / kCells].stale & CellBit(voxel)) == 0) return;
  renewing_.clear();
  grid_->ForEachStencilBlock(stencil_, voxel, [&](std::uint32_t slot, const NeighbourStencil::BlockVisit& at) {
    for (std::uint64_t cells = masks_[slot].overdue & at.cells; cells != 0; cells &= cells - 1)
      renewing_.push_back(slot * kCells + static_cast<VoxelHandle>(__builtin_ctzll(cells)));
    return true;
  });
  for (const VoxelHandle overdue : renewing_) Renew(overdue);
}

void IncrementalNormals::Renew(VoxelHandle voxel) const {
  masks_[voxel / kCells].overdue &= ~CellBit(voxel);
  Replace<true, true>(voxel, PositionOf(voxel, grid_->CentroidInBlock(voxel)));
}

IncrementalNormals::Position IncrementalNormals::PositionOf(VoxelHandle voxel, const Eigen::Vector3f& in_block) const {
  const Lanes& center = cell_centers_[voxel % kCells].xyz1;
  const float half = 0.5f * static_cast<float>(units_per_cell_);
  const auto round = [&](int axis) {  // must not carry it out of its cell
    return std::clamp(std::floor(in_block[axis] * units_per_m_ + 0.5f), center[axis] - half, center[axis] + half);
  };
  return {round(0), round(1), round(2)};
}

/// Which of the cells have their anchors within the radius of a position, both relative to the block's corner.
std::uint64_t IncrementalNormals::CellsWithinRadius(const Block& block, std::uint64_t cells, const Position& position) const {
  const Lanes x = Lanes::Constant(position.xyz1[0]), y = Lanes::Constant(position.xyz1[1]), z = Lanes::Constant(position.xyz1[2]);
  std::uint64_t within = 0;
  for (std::uint64_t rest = cells; rest != 0;) {
    const unsigned row = static_cast<unsigned>(__builtin_ctzll(rest)) & ~(kSide - 1);
    const Lanes dx = Eigen::Map<const Lanes>(&block.anchors[0][row]) - x;
    const Lanes dy = Eigen::Map<const Lanes>(&block.anchors[1][row]) - y;
    const Lanes dz = Eigen::Map<const Lanes>(&block.anchors[2][row]) - z;
    within |= LanesAtMost(dx * dx + dy * dy + dz * dz, radius2_units_) << row;
    rest &= ~(std::uint64_t{0xf} << row);
  }
  return within & cells;
}

/// The voxel takes back what it gave as of its anchor (kWithdraw), and gives anew as of the position, its anchor from now on (kGive).
/// Its own accumulators get the neighbours that it wins, and lose those that it leaves.
template <bool kWithdraw, bool kGive>
void IncrementalNormals::Replace(VoxelHandle voxel, const Position& position) const {
  const unsigned cell = voxel % kCells;
  const std::uint32_t home = voxel / kCells;
  Moments own = blocks_[home].moments[cell];
  const Position before = blocks_[home].Anchor(cell);
  const Position& center = cell_centers_[cell];
  if (!kWithdraw) own = {Eigen::Array4i::Zero(), Eigen::Array4i::Zero(), Eigen::Array4i::Zero()};
  masks_[home].anchored &= ~(std::uint64_t{1} << cell);  // not a neighbour of its own

  // Blocks lie anywhere in memory: each pass fetches what the next one reads, so that the fetches overlap.
  const float block_side = static_cast<float>(units_per_cell_) * kSide;
  reached_.clear();
  grid_->ForEachStencilBlock(stencil_, voxel, [&](std::uint32_t slot, const NeighbourStencil::BlockVisit& at) {
    const std::uint64_t cells = masks_[slot].anchored & at.cells;
    if (cells == 0) return true;
    for (const auto& axis : blocks_[slot].anchors)
      for (unsigned layer = 0; layer < kCells; layer += kSide * kSide)
        if ((cells >> layer & 0xffff) != 0) __builtin_prefetch(&axis[layer]);
    const Position corner(at.offset[0] * block_side, at.offset[1] * block_side, at.offset[2] * block_side, 0.f);
    reached_.push_back({corner, slot, cells, 0, 0});
    return true;
  });
  for (ReachedBlock& reached : reached_) {
    const Block& other = blocks_[reached.slot];
    if (kWithdraw) reached.before = CellsWithinRadius(other, reached.cells, before - reached.corner);
    if (kGive) reached.after = CellsWithinRadius(other, reached.cells, position - reached.corner);
    for (std::uint64_t cells = reached.before | reached.after; cells != 0; cells &= cells - 1)
      __builtin_prefetch(&other.moments[__builtin_ctzll(cells)], 1);
  }
  for (const ReachedBlock& reached : reached_) {
    Block& other = blocks_[reached.slot];
    const Position before_there = before - reached.corner, position_there = position - reached.corner;
    const std::uint64_t both = reached.before & reached.after, lost = reached.before & ~both, won = reached.after & ~both;
    const Position moved = position - before, sum_there = before_there + position_there;
    for (std::uint64_t cells = both; kWithdraw && kGive && cells != 0; cells &= cells - 1) {
      const unsigned neighbour = static_cast<unsigned>(__builtin_ctzll(cells));
      const Position& there = cell_centers_[neighbour];
      AccumulateMove(moved, sum_there - there - there, &other.moments[neighbour]);
    }
    for (std::uint64_t cells = lost; kWithdraw && cells != 0; cells &= cells - 1) {
      const unsigned neighbour = static_cast<unsigned>(__builtin_ctzll(cells));
      Accumulate<-1>(before_there - cell_centers_[neighbour], &other.moments[neighbour]);
    }
    for (std::uint64_t cells = won; kGive && cells != 0; cells &= cells - 1) {
      const unsigned neighbour = static_cast<unsigned>(__builtin_ctzll(cells));
      Accumulate<1>(position_there - cell_centers_[neighbour], &other.moments[neighbour]);
    }
    masks_[reached.slot].stale |= reached.before | reached.after;
    const Position from_there = reached.corner - center;
    const auto theirs = [&](std::uint64_t cells) { return other.Anchor(static_cast<unsigned>(__builtin_ctzll(cells))) + from_there; };
    for (std::uint64_t cells = won; kGive && cells != 0; cells &= cells - 1) Accumulate<1>(theirs(cells), &own);
    for (std::uint64_t cells = lost; kGive && cells != 0; cells &= cells - 1) Accumulate<-1>(theirs(cells), &own);
  }

  if (!kGive) return;
  if (kWithdraw) Accumulate<-1>(before - center, &own);
  Accumulate<1>(position - center, &own);
  blocks_[home].moments[cell] = own;
  for (int axis = 0; axis < 3; ++axis) blocks_[home].anchors[axis][cell] = position.xyz1[axis];
  masks_[home].anchored |= std::uint64_t{1} << cell;
  masks_[home].stale |= std::uint64_t{1} << cell;
}

bool IncrementalNormals::IsAnchored(VoxelHandle voxel) const {
  return voxel / kCells < masks_.size() && (masks_[voxel / kCells].anchored >> (voxel % kCells) & 1) != 0;
}

const IncrementalNormals::Moments& IncrementalNormals::MomentsOf(VoxelHandle voxel) const {
  if (!IsAnchored(voxel)) throw std::invalid_argument("voxel " + std::to_string(voxel) + " has no normal: it is not active");
  RenewAround(voxel);
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
  if ((masks_[voxel / kCells].overdue & CellBit(voxel)) != 0) Renew(voxel);
  return (blocks_[voxel / kCells].Anchor(voxel % kCells) - cell_centers_[voxel % kCells]).xyz1.head<3>().cast<int>();
}

}  // namespace incremental_segmatch
