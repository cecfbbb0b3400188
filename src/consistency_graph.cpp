#include "incremental_segmatch/consistency_graph.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <stdexcept>
#include <string>
#include <tuple>

#include "incremental_segmatch/stage_times.hpp"
#include "radix_sort.hpp"
#include "truss.hpp"

#if defined(__GNUC__) && defined(__x86_64__)
#define SEGMATCH_HAS_AVX_KERNELS
#include <immintrin.h>
#endif

namespace incremental_segmatch {
namespace {

constexpr double kInfinity = std::numeric_limits<double>::infinity();

/// What the predicate needs of a correspondence, in one cache line.
struct Match {
  Eigen::Vector3d local;
  Eigen::Vector3d target;
  std::uint64_t local_key;
  std::uint64_t target_key;
};

std::uint64_t Packed(const SegmentKey& key) {
  return (std::uint64_t{key.robot} << 32) | key.id;
}

Match MakeMatch(const Correspondence& c) {
  return {c.centroid_local, c.centroid_target, Packed(c.local), Packed(c.target)};
}

/// Larger coordinates, and such that are not numbers, are no positions; far below where squares overflow.
constexpr double kLargestCoordinate_m = 1e12;

bool IsUsable(const Match& match) {
  return (match.local.array().abs() <= kLargestCoordinate_m).all() &&
         (match.target.array().abs() <= kLargestCoordinate_m).all();
}

double SquaredDistance(const Eigen::Vector3d& a, const Eigen::Vector3d& b) {
  const double x = a.x() - b.x();
  const double y = a.y() - b.y();
  const double z = a.z() - b.z();
  return x * x + y * y + z * z;
}

double Distance(const Eigen::Vector3d& a, const Eigen::Vector3d& b) {
  return std::sqrt(SquaredDistance(a, b));
}

bool ShareSegment(const Match& a, const Match& b) {
  return a.local_key == b.local_key || a.target_key == b.target_key;
}

/// How far a pair is from violating each of the two inequalities; negative if it does.
struct Margins {
  double distance = 0.0;  ///< epsilon - |d_l - d_t|
  double height = 0.0;    ///< epsilon + slope * d_l - |dz_l - dz_t|
  bool consistent() const { return distance >= 0.0 && height >= 0.0; }
};

Margins MarginsOf(const Match& a, const Match& b, double epsilon_m, double max_vertical_slope) {
  const Eigen::Array2d squares(SquaredDistance(a.local, b.local), SquaredDistance(a.target, b.target));
  const Eigen::Array2d distances = squares.sqrt();  // both roots at once
  const double d_local = distances[0], d_target = distances[1];
  const double rise = std::abs((a.local.z() - b.local.z()) - (a.target.z() - b.target.z()));
  // Infinity times a zero distance would be no number.
  const double allowance = max_vertical_slope == kInfinity ? kInfinity : epsilon_m + max_vertical_slope * d_local;
  return {epsilon_m - std::abs(d_local - d_target), allowance - rise};
}

/// The one predicate behind every method.
bool Consistent(const Match& a, const Match& b, double epsilon_m, double max_vertical_slope) {
  return !ShareSegment(a, b) && MarginsOf(a, b, epsilon_m, max_vertical_slope).consistent();
}

// ---------------------------------------------------------------------------------------------------------------------
// Screening in single precision

/// Coordinates of matches in single precision, relative to the middle of each map and scaled below one, and the
/// tolerance that covers their rounding.
///
/// With all coordinates at most E from their middle and u = 2^-24, a coordinate is off by at most u E, a difference by
/// 4 u E, a distance by 7 u E for that and by another 7 u E for the rounding of its square. Both distances together:
/// 28 u E. The kernels compare squares, (d_l^2 - d_t^2)^2 <= 2 tol^2 (d_l^2 + d_t^2), which follows from
/// |d_l - d_t| <= tol because (d_l + d_t)^2 <= 2 (d_l^2 + d_t^2), without a root; their rounding is a factor of
/// 1 + 8 u on tol. 64 u E and 1 + 2^-16 leave a wide margin to both.
struct ScreenArrays {
  static constexpr std::uint32_t kBlock = 16;  ///< matches, one after the other
  /// A cache line for each of local x, y, z, target x, y, z.
  struct alignas(64) Block {
    float coordinates[6][kBlock];
  };
  static constexpr std::uint32_t kBlocksAtATime = 4;
  std::vector<Block> blocks;  ///< the last one padded, and more behind it: what is read together may begin with any
  float factor = 0.f;         ///< 2 tol^2
};

struct Bounds {
  Eigen::Vector3d low = Eigen::Vector3d::Constant(kInfinity);
  Eigen::Vector3d high = Eigen::Vector3d::Constant(-kInfinity);

  void Add(const Eigen::Vector3d& p) {
    low = low.cwiseMin(p);
    high = high.cwiseMax(p);
  }
  Eigen::Vector3d middle() const { return 0.5 * low + 0.5 * high; }
  double half_extent() const { return (0.5 * high - 0.5 * low).maxCoeff(); }
  double largest_coordinate() const { return std::max(low.cwiseAbs().maxCoeff(), high.cwiseAbs().maxCoeff()); }
};

void FillScreenArrays(const std::vector<Match>& matches, const Bounds& local, const Bounds& target, double tolerance_m,
                      ScreenArrays& arrays) {
  constexpr double kFloatRounding = 1.0 / (1 << 24);
  constexpr double kDoubleRounding = 1e-15;
  constexpr std::uint32_t kBlock = ScreenArrays::kBlock;
  arrays.blocks.resize((matches.size() + kBlock - 1) / kBlock + ScreenArrays::kBlocksAtATime - 1);
  if (matches.empty()) return;

  const double extent = std::max(local.half_extent(), target.half_extent());
  const double rounding_m = 64.0 * kFloatRounding * extent +
                            64.0 * kDoubleRounding * std::max(local.largest_coordinate(), target.largest_coordinate());
  int exponent = 0;
  std::frexp(extent + tolerance_m, &exponent);
  const double scale = std::ldexp(1.0, -exponent);  // a power of two: scaling does not round
  const double tolerance = (tolerance_m + rounding_m) * scale * (1.0 + 1.0 / (1 << 16));
  arrays.factor = static_cast<float>(2.0 * tolerance * tolerance);

  const Eigen::Vector3d local_middle = local.middle();
  const Eigen::Vector3d target_middle = target.middle();
  for (std::size_t i = 0; i < matches.size(); ++i) {
    auto& coordinates = arrays.blocks[i / kBlock].coordinates;
    for (int axis = 0; axis < 3; ++axis) {
      coordinates[axis][i % kBlock] = static_cast<float>((matches[i].local[axis] - local_middle[axis]) * scale);
      coordinates[3 + axis][i % kBlock] = static_cast<float>((matches[i].target[axis] - target_middle[axis]) * scale);
    }
  }
}

/// Indices begin to end - 1.
struct Range {
  std::uint32_t begin, end;
};

/// Appends a range to ascending ones; where the last one ends at its begin, they become one.
void Append(Range range, std::vector<Range>& ranges) {
  if (range.begin >= range.end) return;
  if (!ranges.empty() && ranges.back().end == range.begin) {
    ranges.back().end = range.end;
  } else {
    ranges.push_back(range);
  }
}

using Pair = ConsistencyGraph::Edge;

/// Writes the pairs of i with those in the ranges that may be within the tolerance of it to `hits`, which has room for
/// two more, and returns their number.
std::size_t ScreenPortable(const ScreenArrays& arrays, std::uint32_t i, const std::vector<Range>& ranges, Pair* hits) {
  constexpr std::uint32_t kBlock = ScreenArrays::kBlock;
  std::array<float, 6> own;
  for (int k = 0; k < 6; ++k) own[k] = arrays.blocks[i / kBlock].coordinates[k][i % kBlock];
  const auto square = [](float x) { return x * x; };
  std::size_t count = 0;
  for (const Range range : ranges) {
    for (std::uint32_t j = range.begin / kBlock * kBlock; j < range.end; j += kBlock) {
      const auto& all = arrays.blocks[j / kBlock].coordinates;
      std::array<float, kBlock> excess;
      for (std::uint32_t k = 0; k < kBlock; ++k) {
        const float local = square(own[0] - all[0][k]) + square(own[1] - all[1][k]) + square(own[2] - all[2][k]);
        const float target = square(own[3] - all[3][k]) + square(own[4] - all[4][k]) + square(own[5] - all[5][k]);
        excess[k] = square(local - target) - arrays.factor * (local + target);
      }
      const std::uint32_t end = std::min(kBlock, range.end - j);
      for (std::uint32_t k = j < range.begin ? range.begin - j : 0; k < end; ++k) {
        hits[count] = {i, j + k};
        count += excess[k] <= 0.f ? 1 : 0;
      }
    }
  }
  return count;
}

#ifdef SEGMATCH_HAS_AVX_KERNELS
#define SEGMATCH_AVX2 __attribute__((target("avx2,fma,bmi,popcnt")))
#define SEGMATCH_AVX512 __attribute__((target("avx512f,bmi,popcnt")))

/// Appends (i, j + k) for each bit k of the mask and returns the new count. Most masks have at most two bits, but which
/// ones have any is anybody's guess: without a branch for that, nothing is guessed wrongly.
__attribute__((target("bmi,popcnt"))) inline std::size_t AppendBits(std::uint64_t mask, std::uint32_t i,
                                                                    std::uint32_t j, Pair* hits, std::size_t count) {
  const auto bits = static_cast<std::size_t>(_mm_popcnt_u64(mask));
  hits[count] = {i, j + static_cast<std::uint32_t>(_tzcnt_u64(mask))};
  mask = _blsr_u64(mask);
  hits[count + 1] = {i, j + static_cast<std::uint32_t>(_tzcnt_u64(mask))};
  for (std::size_t k = 2; k < bits; ++k) {
    mask = _blsr_u64(mask);
    hits[count + k] = {i, j + static_cast<std::uint32_t>(_tzcnt_u64(mask))};
  }
  return count + bits;
}

/// The match that others are compared with, eight times over.
struct Own256 {
  SEGMATCH_AVX2 Own256(const ScreenArrays& arrays, std::uint32_t i) : factor(_mm256_set1_ps(arrays.factor)) {
    const auto& own = arrays.blocks[i / ScreenArrays::kBlock].coordinates;
    for (int k = 0; k < 6; ++k) coordinates[k] = _mm256_set1_ps(own[k][i % ScreenArrays::kBlock]);
  }
  __m256 coordinates[6];
  __m256 factor;
};

/// One bit for each of the eight matches in a half of the block.
SEGMATCH_AVX2 inline std::uint64_t ScreenHalf(const Own256& own, const ScreenArrays::Block& block, int half) {
  const auto difference = [&](int k) SEGMATCH_AVX2 {
    return _mm256_sub_ps(own.coordinates[k], _mm256_load_ps(block.coordinates[k] + 8 * half));
  };
  const __m256 lx = difference(0), ly = difference(1), lz = difference(2);
  const __m256 tx = difference(3), ty = difference(4), tz = difference(5);
  const __m256 local = _mm256_fmadd_ps(lx, lx, _mm256_fmadd_ps(ly, ly, _mm256_mul_ps(lz, lz)));
  const __m256 target = _mm256_fmadd_ps(tx, tx, _mm256_fmadd_ps(ty, ty, _mm256_mul_ps(tz, tz)));
  const __m256 off = _mm256_sub_ps(local, target);
  const __m256 near =
      _mm256_cmp_ps(_mm256_mul_ps(off, off), _mm256_mul_ps(own.factor, _mm256_add_ps(local, target)), _CMP_LE_OQ);
  return static_cast<std::uint32_t>(_mm256_movemask_ps(near));
}

SEGMATCH_AVX2 inline std::uint64_t ScreenBlock(const Own256& own, const ScreenArrays::Block& block) {
  return ScreenHalf(own, block, 0) | ScreenHalf(own, block, 1) << 8;
}

/// The same, sixteen times over.
struct Own512 {
  SEGMATCH_AVX512 Own512(const ScreenArrays& arrays, std::uint32_t i) : factor(_mm512_set1_ps(arrays.factor)) {
    const auto& own = arrays.blocks[i / ScreenArrays::kBlock].coordinates;
    for (int k = 0; k < 6; ++k) coordinates[k] = _mm512_set1_ps(own[k][i % ScreenArrays::kBlock]);
  }
  __m512 coordinates[6];
  __m512 factor;
};

/// One bit for each of the matches of the block.
SEGMATCH_AVX512 inline std::uint64_t ScreenBlock(const Own512& own, const ScreenArrays::Block& block) {
  const auto difference = [&](int k) SEGMATCH_AVX512 {
    return _mm512_sub_ps(own.coordinates[k], _mm512_load_ps(block.coordinates[k]));
  };
  const __m512 lx = difference(0), ly = difference(1), lz = difference(2);
  const __m512 tx = difference(3), ty = difference(4), tz = difference(5);
  const __m512 local = _mm512_fmadd_ps(lx, lx, _mm512_fmadd_ps(ly, ly, _mm512_mul_ps(lz, lz)));
  const __m512 target = _mm512_fmadd_ps(tx, tx, _mm512_fmadd_ps(ty, ty, _mm512_mul_ps(tz, tz)));
  const __m512 off = _mm512_sub_ps(local, target);
  return _mm512_cmp_ps_mask(_mm512_mul_ps(off, off), _mm512_mul_ps(own.factor, _mm512_add_ps(local, target)),
                            _CMP_LE_OQ);
}

/// The same as ScreenPortable, four blocks at a time. Becomes a part of its callers, which say for what processor it is
/// compiled.
template <class Own>
__attribute__((always_inline)) inline std::size_t ScreenRanges(const Own& own, const ScreenArrays& arrays,
                                                               std::uint32_t i, const std::vector<Range>& ranges,
                                                               Pair* hits) {
  constexpr std::uint32_t kBlock = ScreenArrays::kBlock, kAtATime = ScreenArrays::kBlocksAtATime * kBlock;
  std::size_t count = 0;
  for (const Range range : ranges) {
    std::uint32_t j = range.begin / kBlock * kBlock;
    std::uint64_t valid = ~std::uint64_t{0} << (range.begin - j);
    for (; j < range.end; j += kAtATime) {
      const ScreenArrays::Block* const block = &arrays.blocks[j / kBlock];
      const std::uint64_t mask = ScreenBlock(own, block[0]) | ScreenBlock(own, block[1]) << kBlock |
                                 ScreenBlock(own, block[2]) << 2 * kBlock | ScreenBlock(own, block[3]) << 3 * kBlock;
      if (range.end - j < kAtATime) valid &= (std::uint64_t{1} << (range.end - j)) - 1;
      count = AppendBits(mask & valid, i, j, hits, count);
      valid = ~std::uint64_t{0};
    }
  }
  return count;
}

SEGMATCH_AVX2 std::size_t ScreenAvx2(const ScreenArrays& arrays, std::uint32_t i, const std::vector<Range>& ranges,
                                     Pair* hits) {
  return ScreenRanges(Own256(arrays, i), arrays, i, ranges, hits);
}

SEGMATCH_AVX512 std::size_t ScreenAvx512(const ScreenArrays& arrays, std::uint32_t i, const std::vector<Range>& ranges,
                                         Pair* hits) {
  return ScreenRanges(Own512(arrays, i), arrays, i, ranges, hits);
}
#endif

using ScreenFunction = std::size_t (*)(const ScreenArrays&, std::uint32_t, const std::vector<Range>&, Pair*);

ScreenFunction ChooseScreen(Instructions instructions) {
#ifdef SEGMATCH_HAS_AVX_KERNELS
  if (instructions >= Instructions::kAvx512 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("bmi") &&
      __builtin_cpu_supports("popcnt")) {
    return ScreenAvx512;
  }
  if (instructions >= Instructions::kAvx2 && __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") &&
      __builtin_cpu_supports("bmi") && __builtin_cpu_supports("popcnt")) {
    return ScreenAvx2;
  }
#endif
  (void)instructions;
  return ScreenPortable;
}

// ---------------------------------------------------------------------------------------------------------------------
// Partitions

enum class Layout { kOneCell, kSquares, kCubes };

/// Matches sorted into cells over the target centroids: rows along x, divided into columns, so that all columns of a
/// row within reach are one contiguous range. Finds, for a match, those others for which |d_l - d_t| may be within the
/// tolerance. Memory is kept from one list of matches to the next.
class Partition {
 public:
  explicit Partition(Instructions instructions) : screen_(ChooseScreen(instructions)) {}

  /// Replaces what the partition holds.
  void Assign(const std::vector<Match>& matches, double tolerance_m, Layout layout);

  std::size_t size() const { return matches_.size(); }
  const Match& match(std::uint32_t slot) const { return matches_[slot]; }
  /// Index of the match in the list that was assigned.
  std::uint32_t index(std::uint32_t slot) const { return order_[slot]; }

  /// Appends the pairs of slots that pass the screen, each once, and returns how many were screened.
  std::uint64_t FindPairs(std::vector<Pair>& pairs) {
    return FindPairsOf([](std::uint32_t) { return true; }, true, pairs);
  }

  /// The same for the pairs (slot, any slot, itself included) of those slots for which selected(slot), or with later
  /// slots alone.
  template <typename Selected>
  std::uint64_t FindPairsOf(Selected selected, bool only_later, std::vector<Pair>& pairs);

 private:
  using Index = std::int64_t;  ///< of a cell along an axis
  struct Row {
    Index y, z;                ///< of its cells
    std::uint32_t begin, end;  ///< its slots
    Index first_column, last_column;
    std::size_t table;  ///< where the columns' first slots stand in column_begin_
  };
  /// A row within reach and by how many rows it is away.
  struct NearRow {
    const Row* row;
    int dy, dz;
  };

  static constexpr int kReach = 2;    ///< rows to a square of side b + tolerance
  static constexpr int kColumns = 8;  ///< columns to the height of a row

  Index RowAt(double offset_m) const { return static_cast<Index>(std::max(offset_m, 0.0) * rows_per_m_); }
  Index ColumnAt(double offset_m) const {
    return static_cast<Index>(std::max(offset_m, 0.0) * (kColumns * rows_per_m_)) >> column_shift_;
  }
  static std::uint64_t Packed(Index high, Index low) {
    return (static_cast<std::uint64_t>(high) << 32) | static_cast<std::uint64_t>(low);
  }
  void SortIntoRows(const std::vector<Match>& matches);
  void FillColumns(const std::vector<Index>& column_of);
  std::vector<NearRow> RowsNear(const Row& row, bool only_later) const;
  /// Where the targets of some slots are, and how far the farthest consistent target is from any of them.
  struct Reach {
    Bounds targets;
    double distance_m = 0.0;
  };

  Reach ReachOf(std::uint32_t begin, std::uint32_t end) const;
  double Gap(Index cell, int step, const Bounds& targets, int axis) const;
  Range RangeIn(const NearRow& near, const Row& own, const Reach& reach) const;
  std::uint64_t Screen(std::uint32_t slot, const std::vector<Range>& ranges, std::vector<Pair>& pairs);

  ScreenFunction screen_;
  Layout layout_ = Layout::kOneCell;
  double slack_m_ = 0.0;  ///< covers the rounding of the grid's arithmetic
  double side_m_ = 1.0;   ///< height of a row
  double rows_per_m_ = 1.0;
  int column_shift_ = 0;  ///< columns are 2^shift cells wide, so that tables stay small however far targets lie apart
  Eigen::Vector3d origin_ = Eigen::Vector3d::Zero();
  std::vector<std::uint32_t> order_;         ///< slot to index
  std::vector<Match> matches_;               ///< by slot
  std::vector<double> reach_m_;              ///< by slot: no consistent target is farther away
  std::vector<Row> rows_;                    ///< by z, then y
  std::vector<std::uint32_t> column_begin_;  ///< first slot of each column of each row
  ScreenArrays arrays_;
  std::vector<Pair> hits_;
};

void Partition::Assign(const std::vector<Match>& matches, double tolerance_m, Layout layout) {
  layout_ = layout;
  column_shift_ = 0;
  order_.clear();
  matches_.clear();
  reach_m_.clear();
  rows_.clear();
  column_begin_.clear();
  Bounds local, target;
  for (const Match& match : matches) {
    local.Add(match.local);
    target.Add(match.target);
  }
  if (!matches.empty()) {
    slack_m_ = 1e-12 * (local.largest_coordinate() + target.largest_coordinate() + tolerance_m);
    origin_ = target.low;
    // The farthest local centroid from the middle bounds the distance of any two: b = 2 farthest.
    const Eigen::Vector3d middle = local.middle();
    double farthest_m = 0.0;
    for (const Match& match : matches) farthest_m = std::max(farthest_m, Distance(match.local, middle));
    side_m_ = (2.0 * farthest_m + tolerance_m + 8.0 * slack_m_) * (1.0 + 1e-9) / kReach;
    side_m_ = std::max(side_m_, target.half_extent() / (1 << 24));
    rows_per_m_ = 1.0 / side_m_;
    SortIntoRows(matches);
    reach_m_.reserve(matches_.size());
    for (const Match& match : matches_) {
      reach_m_.push_back(Distance(match.local, middle) + farthest_m + tolerance_m + 4.0 * slack_m_);
    }
  }
  FillScreenArrays(matches_, local, target, tolerance_m, arrays_);
  hits_.resize(matches_.size() + 2);
}

void Partition::SortIntoRows(const std::vector<Match>& matches) {
  order_.resize(matches.size());
  for (std::uint32_t i = 0; i < order_.size(); ++i) order_[i] = i;
  std::vector<std::uint64_t> level_of(matches.size(), 0), cell_of(matches.size(), 0);
  if (layout_ != Layout::kOneCell) {
    for (std::size_t i = 0; i < matches.size(); ++i) {
      const Eigen::Vector3d offset = matches[i].target - origin_;
      cell_of[i] = Packed(RowAt(offset.y()), ColumnAt(offset.x()));
      level_of[i] = layout_ == Layout::kCubes ? static_cast<std::uint64_t>(RowAt(offset.z())) : 0;
    }
    order_ = SortedByKeys(std::move(order_), level_of, cell_of);
  }
  matches_.reserve(matches.size());
  for (const std::uint32_t i : order_) matches_.push_back(matches[i]);

  std::vector<Index> column_of;  // by slot
  column_of.reserve(order_.size());
  for (std::uint32_t slot = 0; slot < order_.size(); ++slot) {
    const auto z = static_cast<Index>(level_of[order_[slot]]);
    const auto y = static_cast<Index>(cell_of[order_[slot]] >> 32);
    column_of.push_back(static_cast<Index>(cell_of[order_[slot]] & 0xffffffffu));
    if (rows_.empty() || rows_.back().y != y || rows_.back().z != z) {
      rows_.push_back({y, z, slot, slot, column_of.back(), 0, 0});
    }
    rows_.back().end = slot + 1;
    rows_.back().last_column = column_of.back();
  }
  FillColumns(column_of);
}

void Partition::FillColumns(const std::vector<Index>& column_of) {
  const std::size_t limit = 8 * order_.size() + 4096;
  for (;; ++column_shift_) {
    std::size_t total = 0;
    for (const Row& row : rows_) {
      total += static_cast<std::size_t>((row.last_column >> column_shift_) - (row.first_column >> column_shift_)) + 2;
    }
    if (total <= limit) break;
  }
  for (Row& row : rows_) {
    row.first_column >>= column_shift_;
    row.last_column >>= column_shift_;
    row.table = column_begin_.size();
    for (std::uint32_t slot = row.begin; slot < row.end; ++slot) {
      const Index column = column_of[slot] >> column_shift_;
      const std::size_t needed = row.table + static_cast<std::size_t>(column - row.first_column) + 1;
      if (column_begin_.size() < needed) column_begin_.resize(needed, slot);
    }
    column_begin_.push_back(row.end);
  }
}

std::vector<Partition::NearRow> Partition::RowsNear(const Row& row, bool only_later) const {
  std::vector<NearRow> near;
  const int reach_z = layout_ == Layout::kCubes ? kReach : 0;
  const int reach_y = layout_ == Layout::kOneCell ? 0 : kReach;
  for (int dz = only_later ? 0 : -reach_z; dz <= reach_z; ++dz) {
    for (int dy = only_later && dz == 0 ? 0 : -reach_y; dy <= reach_y; ++dy) {
      if (row.z + dz < 0 || row.y + dy < 0) continue;
      const std::uint64_t key = Packed(row.z + dz, row.y + dy);
      const auto found = std::lower_bound(rows_.begin(), rows_.end(), key,
                                          [](const Row& a, std::uint64_t b) { return Packed(a.z, a.y) < b; });
      if (found != rows_.end() && Packed(found->z, found->y) == key) near.push_back({&*found, dy, dz});
    }
  }
  return near;
}

Partition::Reach Partition::ReachOf(std::uint32_t begin, std::uint32_t end) const {
  Reach reach;
  for (std::uint32_t slot = begin; slot < end; ++slot) {
    reach.targets.Add(matches_[slot].target);
    reach.distance_m = std::max(reach.distance_m, reach_m_[slot]);
  }
  return reach;
}

/// Lower bound of the distance along one axis from some targets in a cell to the cells `step` away.
double Partition::Gap(Index cell, int step, const Bounds& targets, int axis) const {
  if (step == 0) return 0.0;
  const auto index = static_cast<double>(cell + step);
  const double gap = step > 0 ? index * side_m_ - (targets.high[axis] - origin_[axis])
                              : targets.low[axis] - origin_[axis] - (index + 1.0) * side_m_;
  return std::max(gap - slack_m_, 0.0);
}

Range Partition::RangeIn(const NearRow& near, const Row& own, const Reach& reach) const {
  const Row& row = *near.row;
  if (layout_ == Layout::kOneCell) return {row.begin, row.end};
  const double gap_y = Gap(own.y, near.dy, reach.targets, 1);
  const double gap_z = Gap(own.z, near.dz, reach.targets, 2);
  const double width_sq = reach.distance_m * reach.distance_m - gap_y * gap_y - gap_z * gap_z;
  if (width_sq < 0.0) return {0, 0};
  const double width = std::sqrt(width_sq) + slack_m_;
  const Index low = std::max(ColumnAt(reach.targets.low.x() - origin_.x() - width), row.first_column);
  const Index high = std::min(ColumnAt(reach.targets.high.x() - origin_.x() + width), row.last_column);
  if (low > high) return {0, 0};
  const std::uint32_t* const table = column_begin_.data() + row.table - row.first_column;
  return {table[low], table[high + 1]};
}

std::uint64_t Partition::Screen(std::uint32_t slot, const std::vector<Range>& ranges, std::vector<Pair>& pairs) {
  const std::size_t count = screen_(arrays_, slot, ranges, hits_.data());
  pairs.insert(pairs.end(), hits_.data(), hits_.data() + count);
  std::uint64_t screened = 0;
  for (const Range range : ranges) screened += range.end - range.begin;
  return screened;
}

/// The slots of a column look through the same ranges.
template <typename Selected>
std::uint64_t Partition::FindPairsOf(Selected selected, bool only_later, std::vector<Pair>& pairs) {
  std::uint64_t screened = 0;
  std::vector<Range> ranges;
  for (const Row& row : rows_) {
    const std::vector<NearRow> rows_near = RowsNear(row, only_later);
    const std::uint32_t* const table = column_begin_.data() + row.table;
    for (Index column = 0; column <= row.last_column - row.first_column; ++column) {
      const std::uint32_t begin = table[column], end = table[column + 1];
      if (begin == end) continue;
      const Reach reach = ReachOf(begin, end);
      ranges.clear();
      for (const NearRow& near : rows_near) Append(RangeIn(near, row, reach), ranges);
      for (std::uint32_t slot = begin; slot < end; ++slot) {
        if (!selected(slot)) continue;
        if (only_later) ranges.front().begin = slot + 1;  // of the own row, which comes first
        screened += Screen(slot, ranges, pairs);
      }
    }
  }
  return screened;
}

// ---------------------------------------------------------------------------------------------------------------------
// Cache

/// Remembers, per correspondence, which others may be consistent with it until one of the two has drifted too far.
class Cache {
 public:
  explicit Cache(const ConsistencyParameters& parameters)
      : parameters_(parameters), partition_(parameters.instructions) {}

  /// Appends the pairs; returns how many were tested.
  std::uint64_t FindPairs(const Correspondences& correspondences, std::vector<ConsistencyGraph::Edge>& edges);

 private:
  /// An older tracked correspondence that may become consistent with the owner of the list.
  struct Candidate {
    std::uint32_t track;
    std::uint32_t generation : 31;  ///< of the track when the candidate was found; another one now: it has left
    std::uint32_t consistent : 1;
    double valid_until_m;  ///< the answer holds while the two tracks' travels sum to less
  };
  struct Track {
    Match anchor;  ///< where it was cached
    Match current;
    std::vector<Candidate> candidates;
  };
  /// What the candidate lists look up, apart from the tracks to keep the look-ups near each other.
  struct State {
    double travel_m = 0.0;  ///< how far local and target centroid have moved, summed over all steps
    std::uint32_t generation : 31;
    std::uint32_t is_new : 1;  ///< cached in this step
    std::uint32_t vertex = 0;  ///< its index in this step's input
    State() : generation(0), is_new(0) {}
  };

  void Follow(const Correspondences& correspondences);
  void Continue(std::uint32_t track, const Match& match, std::uint32_t vertex);
  void Insert(const Match& match, std::uint32_t vertex);
  void Remove(std::uint32_t track);
  void Test(const Match& own, double own_travel_m, Candidate& candidate);
  void TestKnownCandidates(std::vector<ConsistencyGraph::Edge>& edges);
  void FindNewCandidates(std::vector<ConsistencyGraph::Edge>& edges);

  ConsistencyParameters parameters_;
  std::vector<Track> tracks_;
  std::vector<State> states_;          ///< by track
  std::vector<std::uint32_t> free_;    ///< tracks without a correspondence
  std::vector<std::uint32_t> sorted_;  ///< tracks in use, by key
  Partition partition_;                ///< of the anchors
  std::uint64_t tested_pairs_ = 0;
};

bool KeyLess(const Match& a, const Match& b) {
  return std::tie(a.local_key, a.target_key) < std::tie(b.local_key, b.target_key);
}

std::uint64_t Cache::FindPairs(const Correspondences& correspondences, std::vector<ConsistencyGraph::Edge>& edges) {
  tested_pairs_ = 0;
  Follow(correspondences);
  TestKnownCandidates(edges);
  FindNewCandidates(edges);
  return tested_pairs_;
}

/// Joins the sorted keys of the last step with those of this one: what is in both goes on, the others leave or enter.
void Cache::Follow(const Correspondences& correspondences) {
  std::vector<Match> matches;
  std::vector<std::uint64_t> local_keys, target_keys;
  std::vector<std::uint32_t> order;
  matches.reserve(correspondences.size());
  local_keys.reserve(correspondences.size());
  target_keys.reserve(correspondences.size());
  order.reserve(correspondences.size());
  for (const Correspondence& c : correspondences) {
    matches.push_back(MakeMatch(c));
    local_keys.push_back(matches.back().local_key);
    target_keys.push_back(matches.back().target_key);
    if (IsUsable(matches.back())) order.push_back(static_cast<std::uint32_t>(matches.size() - 1));
  }
  order = SortedByKeys(std::move(order), local_keys, target_keys);

  std::vector<std::uint32_t> last = std::move(sorted_);
  sorted_.clear();
  auto old = last.begin();
  for (const std::uint32_t vertex : order) {
    for (; old != last.end() && KeyLess(tracks_[*old].current, matches[vertex]); ++old) Remove(*old);
    if (old != last.end() && !KeyLess(matches[vertex], tracks_[*old].current)) {
      Continue(*old++, matches[vertex], vertex);
    } else {
      Insert(matches[vertex], vertex);
    }
  }
  for (; old != last.end(); ++old) Remove(*old);
}

void Cache::Continue(std::uint32_t index, const Match& match, std::uint32_t vertex) {
  Track& track = tracks_[index];
  const double drift_m = Distance(match.local, track.anchor.local) + Distance(match.target, track.anchor.target);
  if (drift_m >= 0.5 * parameters_.cache_theta_m) {
    Remove(index);
    Insert(match, vertex);
    return;
  }
  State& state = states_[index];
  state.travel_m += Distance(match.local, track.current.local) + Distance(match.target, track.current.target);
  state.is_new = 0;
  state.vertex = vertex;
  track.current = match;
  sorted_.push_back(index);
}

void Cache::Insert(const Match& match, std::uint32_t vertex) {
  if (free_.empty()) {
    free_.push_back(static_cast<std::uint32_t>(tracks_.size()));
    tracks_.emplace_back();
    states_.emplace_back();
  }
  const std::uint32_t index = free_.back();
  free_.pop_back();
  tracks_[index].anchor = tracks_[index].current = match;
  states_[index].travel_m = 0.0;
  states_[index].is_new = 1;
  states_[index].vertex = vertex;
  sorted_.push_back(index);
}

void Cache::Remove(std::uint32_t track) {
  tracks_[track].candidates.clear();
  states_[track].generation = states_[track].generation + 1;
  free_.push_back(track);
}

/// Decides on a pair and on how long the answer holds: moving a centroid by a step changes the first margin by at most
/// that step, the second by at most (1 + slope) times it.
void Cache::Test(const Match& own, double own_travel_m, Candidate& candidate) {
  const Match& other = tracks_[candidate.track].current;
  const double slope = parameters_.max_vertical_slope;
  const Margins margins = MarginsOf(own, other, parameters_.epsilon_m, slope);
  ++tested_pairs_;
  candidate.consistent = margins.consistent();
  const double height = slope == kInfinity ? kInfinity : margins.height / (1.0 + slope);
  const double room_m =
      candidate.consistent ? std::min(margins.distance, height) : std::max(-margins.distance, -height);
  const double rounding_m = 1e-9 + 1e-13 * (own.local.cwiseAbs().sum() + own.target.cwiseAbs().sum() +
                                            other.local.cwiseAbs().sum() + other.target.cwiseAbs().sum());
  candidate.valid_until_m = own_travel_m + states_[candidate.track].travel_m + room_m - rounding_m;
}

void Cache::TestKnownCandidates(std::vector<ConsistencyGraph::Edge>& edges) {
  for (const std::uint32_t index : sorted_) {
    Track& track = tracks_[index];
    const State state = states_[index];
    std::size_t kept = 0;
    for (Candidate candidate : track.candidates) {
      const State& other = states_[candidate.track];
      if (other.generation != candidate.generation) continue;
      if (state.travel_m + other.travel_m >= candidate.valid_until_m) Test(track.current, state.travel_m, candidate);
      if (candidate.consistent) edges.emplace_back(state.vertex, other.vertex);
      track.candidates[kept++] = candidate;
    }
    track.candidates.resize(kept);
  }
}

void Cache::FindNewCandidates(std::vector<ConsistencyGraph::Edge>& edges) {
  std::vector<Match> anchors;
  bool any_new = false;
  anchors.reserve(sorted_.size());
  for (const std::uint32_t index : sorted_) {
    anchors.push_back(tracks_[index].anchor);
    any_new = any_new || states_[index].is_new;
  }
  if (!any_new) return;
  constexpr double kRounding_m = 1e-6;
  const double tolerance_m = parameters_.cache_theta_m + parameters_.epsilon_m + kRounding_m;
  partition_.Assign(anchors, tolerance_m, Layout::kSquares);
  const auto is_new = [&](std::uint32_t slot) { return states_[sorted_[partition_.index(slot)]].is_new == 1; };
  std::vector<Pair> pairs;
  tested_pairs_ += partition_.FindPairsOf(is_new, false, pairs);
  for (const auto& [slot, other_slot] : pairs) {
    if (other_slot == slot || (other_slot > slot && is_new(other_slot))) continue;  // new pairs once
    const Match& own = partition_.match(slot);
    const Match& other = partition_.match(other_slot);
    if (ShareSegment(own, other)) continue;
    const std::uint32_t index = sorted_[partition_.index(slot)];
    const std::uint32_t other_index = sorted_[partition_.index(other_slot)];
    Candidate candidate{other_index, states_[other_index].generation, 0, 0.0};
    Test(own, 0.0, candidate);
    if (candidate.consistent) edges.emplace_back(states_[index].vertex, states_[other_index].vertex);
    tracks_[index].candidates.push_back(candidate);
  }
}

// ---------------------------------------------------------------------------------------------------------------------
// Choice of the method

/// Picks the method with the smallest cost per correspondence, and tries each of them once in a while.
class MethodChooser {
 public:
  /// The method for the next call.
  ConsistencyMethod Next(std::size_t correspondences) {
    // The cache is only worth measuring on the second of two calls; the first one fills it.
    static constexpr std::array<ConsistencyMethod, 5> kTrials{
        ConsistencyMethod::kPartitioned2D, ConsistencyMethod::kPartitioned3D, ConsistencyMethod::kAllPairs,
        ConsistencyMethod::kCached, ConsistencyMethod::kCached};
    constexpr std::size_t kCallsBetweenTrials = 64;
    const std::size_t turn = calls_++ % kCallsBetweenTrials;
    const ConsistencyMethod best = Best(correspondences);
    const ConsistencyMethod next = turn < kTrials.size() ? kTrials[turn] : best;
    return IsCandidate(next, correspondences) ? next : best;
  }

  void Report(ConsistencyMethod method, double cost) {
    constexpr double kNewWeight = 0.5;
    const bool filled_the_cache = method == ConsistencyMethod::kCached && last_ != ConsistencyMethod::kCached;
    last_ = method;
    if (filled_the_cache) return;
    double& known = cost_[static_cast<std::size_t>(method)];
    known = known == kInfinity ? cost : kNewWeight * cost + (1.0 - kNewWeight) * known;
  }

 private:
  static bool IsCandidate(ConsistencyMethod method, std::size_t correspondences) {
    constexpr std::size_t kMostForAllPairs = 1000;
    return method != ConsistencyMethod::kAllPairs || correspondences <= kMostForAllPairs;
  }

  ConsistencyMethod Best(std::size_t correspondences) const {
    auto best = ConsistencyMethod::kPartitioned2D;
    for (const auto method :
         {ConsistencyMethod::kAllPairs, ConsistencyMethod::kPartitioned3D, ConsistencyMethod::kCached}) {
      if (IsCandidate(method, correspondences) && Cost(method) < Cost(best)) best = method;
    }
    return best;
  }
  double Cost(ConsistencyMethod method) const { return cost_[static_cast<std::size_t>(method)]; }

  std::array<double, 4> cost_{kInfinity, kInfinity, kInfinity, kInfinity};  ///< per correspondence, by method
  ConsistencyMethod last_ = ConsistencyMethod::kAuto;
  std::size_t calls_ = 0;
};

// ---------------------------------------------------------------------------------------------------------------------

void Validate(const ConsistencyParameters& parameters) {
  const auto require = [](bool good, const char* message) {
    if (!good) throw std::invalid_argument(std::string("ConsistencyParameters: ") + message);
  };
  require(parameters.epsilon_m > 0.0 && std::isfinite(parameters.epsilon_m), "epsilon_m must be positive and finite");
  require(parameters.cache_theta_m > 0.0 && std::isfinite(parameters.cache_theta_m),
          "cache_theta_m must be positive and finite");
  require(parameters.max_vertical_slope >= 0.0, "max_vertical_slope must not be negative (infinity: no limit)");
}

}  // namespace

bool ConsistencyGraph::HasEdge(std::uint32_t a, std::uint32_t b) const {
  const Range range = Neighbours(a);
  return std::binary_search(range.begin(), range.end(), b);
}

ConsistencyGraph ConsistencyGraph::FromEdges(std::size_t vertices, const std::vector<Edge>& edges) {
  ConsistencyGraph graph;
  graph.edges = edges.size();
  graph.offsets.assign(vertices + 1, 0);
  for (const auto& [a, b] : edges) {
    ++graph.offsets[a + 1];
    ++graph.offsets[b + 1];
  }
  for (std::size_t v = 0; v < vertices; ++v) graph.offsets[v + 1] += graph.offsets[v];

  std::vector<std::uint32_t> unsorted(2 * edges.size());
  std::vector<std::size_t> next(graph.offsets.begin(), graph.offsets.end() - 1);
  for (const auto& [a, b] : edges) {
    unsorted[next[a]++] = b;
    unsorted[next[b]++] = a;
  }
  // Turning the rows into columns, vertex after vertex, leaves every row sorted.
  graph.neighbours.resize(unsorted.size());
  next.assign(graph.offsets.begin(), graph.offsets.end() - 1);
  for (std::uint32_t v = 0; v < vertices; ++v) {
    for (std::size_t k = graph.offsets[v]; k < graph.offsets[v + 1]; ++k) graph.neighbours[next[unsorted[k]]++] = v;
  }
  return graph;
}

bool AreConsistent(const Correspondence& a, const Correspondence& b, double epsilon_m, double max_vertical_slope) {
  const Match match_a = MakeMatch(a);
  const Match match_b = MakeMatch(b);
  return IsUsable(match_a) && IsUsable(match_b) && Consistent(match_a, match_b, epsilon_m, max_vertical_slope);
}

class ConsistencyGraphBuilder::Impl {
 public:
  explicit Impl(const ConsistencyParameters& parameters)
      : parameters_(parameters), partition_(parameters.instructions), cache_(parameters) {}

  ConsistentPairs FindPairs(const Correspondences& correspondences, std::size_t set_size) {
    if (parameters_.method != ConsistencyMethod::kAuto) return FindWith(parameters_.method, correspondences, set_size);
    const ConsistencyMethod fastest = chooser_.Next(correspondences.size());
    const double start_ms = ThreadCpuMs();
    ConsistentPairs found = FindWith(fastest, correspondences, set_size);
    chooser_.Report(fastest, (ThreadCpuMs() - start_ms) / static_cast<double>(correspondences.size() + 1));
    return found;
  }

 private:
  ConsistentPairs FindWith(ConsistencyMethod method, const Correspondences& correspondences, std::size_t set_size) {
    ConsistentPairs found;
    if (method == ConsistencyMethod::kCached) {
      found.tested_pairs = cache_.FindPairs(correspondences, found.pairs);
      truss_finder_.DropByBound(correspondences.size(), set_size, &found.pairs);
      truss_finder_.DropByCount(correspondences.size(), set_size, &found.pairs);
    } else {
      FindPartitioned(correspondences, set_size, LayoutOf(method), found);
    }
    return found;
  }

  static Layout LayoutOf(ConsistencyMethod method) {
    if (method == ConsistencyMethod::kPartitioned2D) return Layout::kSquares;
    return method == ConsistencyMethod::kPartitioned3D ? Layout::kCubes : Layout::kOneCell;
  }

  void FindPartitioned(const Correspondences& correspondences, std::size_t set_size, Layout layout,
                       ConsistentPairs& found);

  ConsistencyParameters parameters_;
  std::vector<Match> matches_;                 ///< of the last call, as what follows: memory that the next one reuses
  std::vector<std::uint32_t> indices_;         ///< of the matches among the correspondences
  std::vector<ConsistencyGraph::Edge> slots_;  ///< of the partition, that may be a pair
  Partition partition_;
  Cache cache_;
  TrussFinder truss_finder_;
  MethodChooser chooser_;
};

/// By slot, what is near each other in the target map is near each other in memory. The predicate decides late, on the
/// few pairs that enough others support even if all that pass the screen were consistent.
void ConsistencyGraphBuilder::Impl::FindPartitioned(const Correspondences& correspondences, std::size_t set_size,
                                                    Layout layout, ConsistentPairs& found) {
  matches_.clear();
  indices_.clear();
  for (std::uint32_t i = 0; i < correspondences.size(); ++i) {
    const Match match = MakeMatch(correspondences[i]);
    if (!IsUsable(match)) continue;
    matches_.push_back(match);
    indices_.push_back(i);
  }
  partition_.Assign(matches_, parameters_.epsilon_m, layout);
  slots_.clear();
  found.tested_pairs = partition_.FindPairs(slots_);
  truss_finder_.DropByBound(partition_.size(), set_size, &slots_);
  const auto inconsistent = [&](const ConsistencyGraph::Edge& pair) {
    return !Consistent(partition_.match(pair.first), partition_.match(pair.second), parameters_.epsilon_m,
                       parameters_.max_vertical_slope);
  };
  slots_.erase(std::remove_if(slots_.begin(), slots_.end(), inconsistent), slots_.end());
  truss_finder_.DropByCount(partition_.size(), set_size, &slots_);
  found.pairs.reserve(slots_.size());
  for (const auto& [a, b] : slots_) {
    found.pairs.emplace_back(indices_[partition_.index(a)], indices_[partition_.index(b)]);
  }
}

ConsistencyGraphBuilder::ConsistencyGraphBuilder(const ConsistencyParameters& parameters) {
  Validate(parameters);
  impl_ = std::make_unique<Impl>(parameters);
}
ConsistencyGraphBuilder::~ConsistencyGraphBuilder() = default;
ConsistencyGraphBuilder::ConsistencyGraphBuilder(ConsistencyGraphBuilder&&) noexcept = default;
ConsistencyGraphBuilder& ConsistencyGraphBuilder::operator=(ConsistencyGraphBuilder&&) noexcept = default;

ConsistentPairs ConsistencyGraphBuilder::FindPairs(const Correspondences& correspondences, std::size_t set_size) {
  return impl_->FindPairs(correspondences, set_size);
}

ConsistencyGraph ConsistencyGraphBuilder::Build(const Correspondences& correspondences) {
  return ConsistencyGraph::FromEdges(correspondences.size(), FindPairs(correspondences, 2).pairs);
}

}  // namespace incremental_segmatch
