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
constexpr int kSide = DynamicVoxelGrid::kBlockSide;
constexpr std::size_t kMostReached = 7 * 7 * 7;  // blocks around a voxel, by a radius of 8 voxels

/// The finest power of two of units per cell for which all sums over a full neighbourhood fit 32 bits. A neighbour lies
/// within the radius of a point that is at most half a cell from the reference, on each axis.
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
  while (largest_product() * static_cast<double>(most_neighbours) >= 0x1p31) units /= 2;
  return units;
}

}  // namespace

SmallestEigen SmallestEigenOf(const Eigen::Matrix3d& m) {
  SmallestEigen result{Eigen::Vector3d::UnitZ(), 0.0, m.trace()};
  if (!(result.trace > 0.0)) return result;
  // Laguerre's iteration on p(x) = det(m - x) = c0 - c1 x + c2 x^2 - x^3 rises monotonically from 0 to the smallest
  // root, and cubically near it: all roots are real.
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
  const Eigen::Vector3d a = rows.row(0).cross(rows.row(1)), b = rows.row(0).cross(rows.row(2)),
                        c = rows.row(1).cross(rows.row(2));
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
    throw std::invalid_argument("normals.radius_m: must be at most 8 voxels of " + std::to_string(resolution_m) +
                                " m, is " + std::to_string(parameters.radius_m));
  if (!(parameters.renewal_tolerance_voxels >= 0.0))
    throw std::invalid_argument("normals.renewal_tolerance_voxels: must not be negative, is " +
                                std::to_string(parameters.renewal_tolerance_voxels));
  units_per_cell_ = UnitsPerCell(stencil_, radius_cells);
  unit_m_ = resolution_m / units_per_cell_;
  units_per_m_ = static_cast<float>(1.0 / unit_m_);
  const double radius_units =
      radius_cells * units_per_cell_ * (1.0 + 1e-9);  // radii that are whole voxels are whole units
  radius2_units_ = static_cast<int>(radius_units * radius_units);
  const double tolerance_units = parameters.renewal_tolerance_voxels * units_per_cell_;
  tolerance2_units_ = static_cast<float>(tolerance_units * tolerance_units);
}

void IncrementalNormals::Remove(const std::vector<RemovedVoxel>& removed) {
  for (const RemovedVoxel& gone : removed) {
    if (!IsAnchored(gone.voxel)) continue;
    masks_[gone.voxel / kCells].anchored &= ~CellBit(gone.voxel);
    MarkStaleAround(gone.voxel);
  }
}

void IncrementalNormals::Insert(const VoxelUpdate& update) {
  const std::size_t blocks = grid_->handle_capacity() / kCells;
  blocks_.Grow(blocks);
  if (masks_.size() < blocks) masks_.resize(blocks);
  constexpr std::size_t kAhead = 16;
  for (std::size_t i = 0; i < update.moved.size(); ++i) {
    if (i + kAhead < update.moved.size()) {
      const VoxelHandle next = update.moved[i + kAhead].voxel;
      __builtin_prefetch(&blocks_[next / kCells].anchors[next % kCells]);
      __builtin_prefetch(&grid_->CentroidInBlock(next));
    }
    const VoxelHandle voxel = update.moved[i].voxel;
    const Position position = PositionOf(voxel, grid_->CentroidInBlock(voxel));
    if (static_cast<float>((position - AnchorInBlock(voxel)).matrix().squaredNorm()) > tolerance2_units_)
      SetAnchor(voxel, position);
  }
  for (const VoxelHandle voxel : update.activated) {
    masks_[voxel / kCells].anchored |= CellBit(voxel);
    SetAnchor(voxel, PositionOf(voxel, grid_->CentroidInBlock(voxel)));
  }
}

void IncrementalNormals::SetAnchor(VoxelHandle voxel, const Position& position) {
  PackedPosition& anchor = blocks_[voxel / kCells].anchors[voxel % kCells];
  for (int axis = 0; axis < 3; ++axis)
    anchor[static_cast<std::size_t>(axis)] = static_cast<std::int16_t>(position[axis]);
  anchor[3] = 1;
  MarkStaleAround(voxel);
}

/// Wherever in its cell the voxel was, is, or will be.
void IncrementalNormals::MarkStaleAround(VoxelHandle voxel) {
  grid_->ForEachStencilBlock(stencil_, voxel, [this](std::uint32_t slot, const NeighbourStencil::BlockVisit& at) {
    masks_[slot].stale |= at.cells;
    return true;
  });
}

IncrementalNormals::Position IncrementalNormals::CellCenter(VoxelHandle voxel) const {
  const int cell = static_cast<int>(voxel % kCells);
  const auto center = [this](int index) { return index * units_per_cell_ + units_per_cell_ / 2; };
  return {center(cell % kSide), center(cell / kSide % kSide), center(cell / (kSide * kSide))};
}

IncrementalNormals::Position IncrementalNormals::PositionOf(VoxelHandle voxel, const Eigen::Vector3f& in_block) const {
  const Position units = (in_block.array() * units_per_m_ + 0.5f).cast<int>();
  const Position center = CellCenter(voxel);
  const int half = units_per_cell_ / 2;
  return units.max(center - half).min(center + half);  // rounding must not carry it out of its cell
}

IncrementalNormals::Position IncrementalNormals::AnchorInBlock(VoxelHandle voxel) const {
  const PackedPosition& anchor = blocks_[voxel / kCells].anchors[voxel % kCells];
  return {anchor[0], anchor[1], anchor[2]};
}

/// Adds the anchors of the cells that lie within the radius around a position, relative to the origin. Both are
/// relative to the block's corner.
void IncrementalNormals::AddWithinRadius(const Block& block, std::uint64_t cells, const Position& around,
                                         const Position& origin, Moments* moments) const {
#if defined(__SSE2__)
  // Four cells at a time, without a branch: x, y, z, 1 of two of them in one register, and zeros where one does not
  // count.
  const auto twice = [](const Position& p, int last) {
    const auto low = [](int value) { return static_cast<std::int16_t>(value); };
    return _mm_set_epi16(low(last), low(p.z()), low(p.y()), low(p.x()), low(last), low(p.z()), low(p.y()), low(p.x()));
  };
  const __m128i around_twice = twice(around, 1), origin_twice = twice(origin, 0), ones = _mm_set1_epi16(1);
  const __m128i limit = _mm_set1_epi32(radius2_units_), bits = _mm_set_epi32(8, 4, 2, 1);
  const auto at = [](Eigen::Array4i& sums) { return reinterpret_cast<__m128i*>(sums.data()); };
  __m128i sum = _mm_loadu_si128(at(moments->sum)), squares = _mm_loadu_si128(at(moments->squares)),
          products = _mm_loadu_si128(at(moments->products));
  while (cells != 0) {
    const unsigned row = static_cast<unsigned>(__builtin_ctzll(cells)) & ~3u;
    const __m128i* const anchors = reinterpret_cast<const __m128i*>(&block.anchors[row]);
    const __m128i low = _mm_load_si128(anchors), high = _mm_load_si128(anchors + 1);
    const auto halves = [&](__m128i pair) {  // of their squared distances: x x + y y, z z
      const __m128i difference = _mm_sub_epi16(pair, around_twice);
      return _mm_castsi128_ps(_mm_madd_epi16(difference, difference));
    };
    const __m128 low_halves = halves(low), high_halves = halves(high);
    const __m128i distance2 =
        _mm_add_epi32(_mm_castps_si128(_mm_shuffle_ps(low_halves, high_halves, _MM_SHUFFLE(2, 0, 2, 0))),
                      _mm_castps_si128(_mm_shuffle_ps(low_halves, high_halves, _MM_SHUFFLE(3, 1, 3, 1))));
    const __m128i asked = _mm_and_si128(_mm_set1_epi32(static_cast<int>(cells >> row & 0xf)), bits);
    const __m128i counts = _mm_andnot_si128(_mm_cmpgt_epi32(distance2, limit), _mm_cmpeq_epi32(asked, bits));
    const auto add = [&](__m128i pair, __m128i which) {
      const __m128i p = _mm_and_si128(_mm_sub_epi16(pair, origin_twice), which);
      const __m128i xyz1 = _mm_unpacklo_epi16(p, _mm_srli_si128(p, 8));  // x x' y y' z z' 1 1
      const __m128i yzx1 = _mm_shuffle_epi32(xyz1, _MM_SHUFFLE(3, 0, 2, 1));
      sum = _mm_add_epi32(sum, _mm_madd_epi16(xyz1, ones));
      squares = _mm_add_epi32(squares, _mm_madd_epi16(xyz1, xyz1));
      products = _mm_add_epi32(products, _mm_madd_epi16(xyz1, yzx1));
    };
    add(low, _mm_unpacklo_epi32(counts, counts));
    add(high, _mm_unpackhi_epi32(counts, counts));
    cells &= ~(std::uint64_t{0xf} << row);
  }
  _mm_storeu_si128(at(moments->sum), sum);
  _mm_storeu_si128(at(moments->squares), squares);
  _mm_storeu_si128(at(moments->products), products);
#else
  for (; cells != 0; cells &= cells - 1) {
    const PackedPosition& anchor = block.anchors[static_cast<std::size_t>(__builtin_ctzll(cells))];
    const Position there(anchor[0], anchor[1], anchor[2]), p = there - origin;
    if ((there - around).matrix().squaredNorm() > radius2_units_) continue;
    moments->sum += Eigen::Array4i(p.x(), p.y(), p.z(), 1);
    moments->squares += Eigen::Array4i(p.x() * p.x(), p.y() * p.y(), p.z() * p.z(), 1);
    moments->products += Eigen::Array4i(p.x() * p.y(), p.y() * p.z(), p.z() * p.x(), 1);
  }
#endif
}

/// (3.6) over the anchors around an anchor, itself included, relative to the centre of its cell.
IncrementalNormals::Moments IncrementalNormals::Gather(VoxelHandle voxel) const {
  // Blocks lie anywhere in memory: all are asked for before the first is read.
  struct Reached {
    std::uint32_t slot;
    std::uint64_t cells;
    Position corner;  // relative to the corner of the voxel's block
  };
  std::array<Reached, kMostReached> reached;
  std::size_t count = 0;
  const int block_side = units_per_cell_ * static_cast<int>(kSide);
  grid_->ForEachStencilBlock(stencil_, voxel, [&](std::uint32_t slot, const NeighbourStencil::BlockVisit& at) {
    const std::uint64_t cells = masks_[slot].anchored & at.cells;
    if (cells == 0) return true;
    constexpr unsigned kPerLine = 64 / sizeof(PackedPosition);
    for (unsigned line = 0; line < kCells; line += kPerLine)
      if ((cells >> line & 0xff) != 0) __builtin_prefetch(&blocks_[slot].anchors[line]);
    reached[count++] = {slot, cells, Position(at.offset[0], at.offset[1], at.offset[2]) * block_side};
    return true;
  });
  const Position anchor = AnchorInBlock(voxel), center = CellCenter(voxel);
  Moments moments;
  for (std::size_t i = 0; i < count; ++i) {
    const auto& [slot, cells, corner] = reached[i];
    AddWithinRadius(blocks_[slot], cells, anchor - corner, center - corner, &moments);
  }
  return moments;
}

bool IncrementalNormals::IsAnchored(VoxelHandle voxel) const {
  return voxel / kCells < masks_.size() && (masks_[voxel / kCells].anchored & CellBit(voxel)) != 0;
}

void IncrementalNormals::RefuseUnanchored(VoxelHandle voxel) const {
  if (!IsAnchored(voxel))
    throw std::invalid_argument("voxel " + std::to_string(voxel) + " has no normal: it is not active");
}

/// Computes the voxel's normal if it is stale: (3.7) in square units, integers up to the difference.
void IncrementalNormals::Refresh(VoxelHandle voxel) const {
  RefuseUnanchored(voxel);
  Masks& masks = masks_[voxel / kCells];
  if ((masks.stale & CellBit(voxel)) == 0) return;
  masks.stale &= ~CellBit(voxel);
  NormalEstimate& estimate = blocks_[voxel / kCells].estimates[voxel % kCells];
  float& residual_m = blocks_[voxel / kCells].residuals_m[voxel % kCells];
  const Moments moments = Gather(voxel);
  if (moments.sum[3] < 3) {
    const float nan = std::numeric_limits<float>::quiet_NaN();
    estimate = {Eigen::Vector3f::Constant(nan), nan};
    residual_m = nan;
    return;
  }
  const double n = moments.sum[3];
  const Eigen::Vector3d b = moments.sum.head<3>().cast<double>();
  const Eigen::Array4d squares = moments.squares.cast<double>(), products = moments.products.cast<double>();
  Eigen::Matrix3d a;
  a << squares[0], products[0], products[2],  //
      products[0], squares[1], products[1],   //
      products[2], products[1], squares[2];
  const SmallestEigen eigen = SmallestEigenOf((n * a - b * b.transpose()) / (n * n));
  estimate = {eigen.vector.cast<float>(), eigen.trace > 0.0 ? static_cast<float>(eigen.value / eigen.trace) : 0.f};
  residual_m = static_cast<float>(unit_m_ * std::sqrt(eigen.value));
}

const NormalEstimate& IncrementalNormals::Estimate(VoxelHandle voxel) const {
  Refresh(voxel);
  return blocks_[voxel / kCells].estimates[voxel % kCells];
}

Eigen::Vector3d IncrementalNormals::NormalOdom(VoxelHandle voxel, const Eigen::Vector3d& viewpoint_odom) const {
  const Eigen::Vector3d normal = grid_->T_odom_grid().linear() * Estimate(voxel).normal_grid.cast<double>();
  return normal.dot(viewpoint_odom - grid_->CentroidOdom(voxel)) < 0.0 ? Eigen::Vector3d(-normal) : normal;
}

float IncrementalNormals::PlaneResidual(VoxelHandle voxel) const {
  Refresh(voxel);
  return blocks_[voxel / kCells].residuals_m[voxel % kCells];
}

NormalAccumulators IncrementalNormals::Accumulators(VoxelHandle voxel) const {
  RefuseUnanchored(voxel);
  const Moments moments = Gather(voxel);
  NormalAccumulators accumulators;
  accumulators.count = moments.sum[3];
  for (int axis = 0; axis < 3; ++axis) {
    const int next = (axis + 1) % 3;
    accumulators.sum[axis] = moments.sum[axis];
    accumulators.outer(axis, axis) = moments.squares[axis];
    accumulators.outer(axis, next) = accumulators.outer(next, axis) = moments.products[axis];
  }
  return accumulators;
}

Eigen::Vector3i IncrementalNormals::Anchor(VoxelHandle voxel) const {
  RefuseUnanchored(voxel);
  return AnchorInBlock(voxel) - CellCenter(voxel);
}

}  // namespace incremental_segmatch
