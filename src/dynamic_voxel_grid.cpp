#include "incremental_segmatch/dynamic_voxel_grid.hpp"

#include <algorithm>
#include <functional>
#include <limits>
#include <numeric>
#include <optional>
#include <queue>
#include <stdexcept>
#include <string>
#include <unordered_map>
#include <utility>

#include "several_targets.hpp"

namespace incremental_segmatch {
namespace {

constexpr int kSide = DynamicVoxelGrid::kBlockSide;
constexpr int kBlocksPerTileSide = 8;
constexpr int kLinkCenter = 13;  // index of the block itself among its 27 links

int LinkIndex(int dx, int dy, int dz) {
  return kLinkCenter + dx + 3 * dy + 9 * dz;
}

int FloorDivide(int value, int divisor) {
  return value >= 0 ? value / divisor : -((divisor - 1 - value) / divisor);
}

std::uint64_t PackTile(int x, int y) {
  return (static_cast<std::uint64_t>(static_cast<std::uint32_t>(x)) << 32) | static_cast<std::uint32_t>(y);
}

// Block coordinates fit 21 bits each: at most 23 bits of cells an axis, in blocks of 4.
constexpr int kBlockBits = 21;

std::uint64_t PackCoordinate(std::int32_t coordinate, int axis) {
  return static_cast<std::uint64_t>(static_cast<std::uint32_t>(coordinate) & ((1u << kBlockBits) - 1))
         << (kBlockBits * axis);
}

std::uint64_t PackBlock(const std::array<std::int32_t, 3>& c) {
  return PackCoordinate(c[0], 0) | PackCoordinate(c[1], 1) | PackCoordinate(c[2], 2);
}

std::array<std::int32_t, 3> UnpackBlock(std::uint64_t key) {
  const auto coordinate = [key](int axis) {  // its sign is its highest bit
    return static_cast<std::int32_t>(static_cast<std::uint32_t>(key >> (kBlockBits * axis)) << (32 - kBlockBits)) >>
           (32 - kBlockBits);
  };
  return {coordinate(0), coordinate(1), coordinate(2)};
}

struct SquareDistances {
  double nearest_m, farthest_m;
};

/// Of the nearest and the farthest point of a square with this lower corner.
SquareDistances DistancesToSquare(const Eigen::Vector2d& from, const Eigen::Vector2d& corner, double side_m) {
  const Eigen::Array2d to_lower = (from - corner).array(), to_upper = to_lower - side_m;
  return {(-to_lower).max(to_upper).max(0.0).matrix().norm(), to_lower.abs().max(to_upper.abs()).matrix().norm()};
}

}  // namespace

NeighbourStencil::NeighbourStencil(double radius_m, double resolution_m) : radius_m_(radius_m) {
  if (!(radius_m > 0.0) || !(radius_m <= 16.0 * resolution_m))
    throw std::invalid_argument("neighbourhood radius of " + std::to_string(radius_m) +
                                " m: must be positive and at most 16 voxels of " + std::to_string(resolution_m) + " m");
  // Points of two cells that lie d cells apart along an axis are at least d - 1 cells apart.
  const double radius_cells = radius_m / resolution_m * (1.0 + 1e-6);
  const int reach_blocks = (static_cast<int>(std::ceil(radius_cells)) + kSide) / kSide;
  const auto least_gap = [](int cells) { return std::max(0, std::abs(cells) - 1); };
  for (int cell = 0; cell < 64; ++cell) {
    const int x = cell % kSide, y = cell / kSide % kSide, z = cell / (kSide * kSide);
    for (int bz = -reach_blocks; bz <= reach_blocks; ++bz)
      for (int by = -reach_blocks; by <= reach_blocks; ++by)
        for (int bx = -reach_blocks; bx <= reach_blocks; ++bx) {
          BlockVisit visit;
          for (int other = 0; other < 64; ++other) {
            const int gx = least_gap(bx * kSide + other % kSide - x);
            const int gy = least_gap(by * kSide + other / kSide % kSide - y);
            const int gz = least_gap(bz * kSide + other / (kSide * kSide) - z);
            if (gx * gx + gy * gy + gz * gz <= radius_cells * radius_cells) visit.cells |= std::uint64_t{1} << other;
          }
          if (visit.cells == 0) continue;
          visit.offset = {static_cast<std::int8_t>(bx), static_cast<std::int8_t>(by), static_cast<std::int8_t>(bz)};
          if (std::max({std::abs(bx), std::abs(by), std::abs(bz)}) > 1) {
            around_[cell].farther.push_back(visit);
            continue;
          }
          const int link = LinkIndex(bx, by, bz);
          around_[cell].links |= 1u << link;
          around_[cell].adjacent[link] = visit;
        }
  }
}

/// Extendible hashing: entries lie in pages of 4 KB, found through a directory by the leading bits of their hash. A page
/// that is half full is split in two, so that no insertion moves more than a page, however large the map. Within a page
/// linear probing and backward-shift deletion: one cache line a lookup, no tombstones.
class DynamicVoxelGrid::BlockMap {
 public:
  BlockMap() : directory_(std::size_t{1} << kFirstDepth) {
    for (Page*& page : directory_) page = AddPage(kFirstDepth);
  }

  /// Starts to fetch what Find will read.
  void Prefetch(std::uint64_t key) const {
    const std::uint64_t hash = Hash(key);
    __builtin_prefetch(&PageOf(hash)->entries[Home(hash)]);
  }
  std::uint32_t Find(std::uint64_t key) const {
    const std::uint64_t hash = Hash(key);
    const Entries& entries = PageOf(hash)->entries;
    for (std::size_t i = Home(hash);; i = (i + 1) % kPageSize) {
      if (entries[i].slot == kNoBlock) return kNoBlock;
      if (entries[i].key == key) return entries[i].slot;
    }
  }
  void Insert(std::uint64_t key, std::uint32_t slot) {
    while (2 * PageOf(Hash(key))->size >= kPageSize) Split(Hash(key));
    Place({key, slot});
  }
  void Erase(std::uint64_t key) {
    Page* const page = PageOf(Hash(key));
    Entries& entries = page->entries;
    std::size_t hole = Home(Hash(key));
    while (entries[hole].key != key || entries[hole].slot == kNoBlock) hole = (hole + 1) % kPageSize;
    for (std::size_t i = (hole + 1) % kPageSize; entries[i].slot != kNoBlock; i = (i + 1) % kPageSize) {
      // An entry moves into the hole unless its home lies cyclically in (hole, i].
      if ((i - Home(Hash(entries[i].key))) % kPageSize >= (i - hole) % kPageSize) {
        entries[hole] = entries[i];
        hole = i;
      }
    }
    entries[hole].slot = kNoBlock;
    --page->size;
  }
  std::size_t memory_bytes() const { return pages_.memory_bytes() + directory_.capacity() * sizeof(Page*); }

 private:
  static constexpr int kFirstDepth = 2;
  static constexpr std::size_t kPageSize = 256;
  struct Entry {
    std::uint64_t key = 0;
    std::uint32_t slot = kNoBlock;
  };
  using Entries = std::array<Entry, kPageSize>;
  struct alignas(64) Page {
    Entries entries;
    std::size_t size = 0;  ///< entries that are taken
    int depth = 0;         ///< leading bits that the hashes have in common
  };

  static std::uint64_t Hash(std::uint64_t key) { return (key ^ key >> 32) * 0x9e3779b97f4a7c15ull; }
  static std::size_t Home(std::uint64_t hash) { return (hash >> 32) % kPageSize; }
  Page* PageOf(std::uint64_t hash) const { return directory_[hash >> (64 - depth_)]; }
  Page* AddPage(int depth) {
    pages_.Grow(pages_.size() + 1);
    Page* const page = &pages_[pages_.size() - 1];
    page->depth = depth;
    return page;
  }
  void Place(const Entry& entry) {
    Page* const page = PageOf(Hash(entry.key));
    std::size_t i = Home(Hash(entry.key));
    while (page->entries[i].slot != kNoBlock) i = (i + 1) % kPageSize;
    page->entries[i] = entry;
    ++page->size;
  }
  /// Tells the entries of a hash's page apart by one more bit.
  void Split(std::uint64_t hash) {
    Page* const page = PageOf(hash);
    if (page->depth == depth_) {
      std::vector<Page*> finer(2 * directory_.size());
      for (std::size_t i = 0; i < finer.size(); ++i) finer[i] = directory_[i / 2];
      directory_ = std::move(finer);
      ++depth_;
    }
    const int depth = ++page->depth;
    const std::size_t half = std::size_t{1} << (depth_ - depth);  // of the directory's entries for the page
    const std::size_t ones = (hash >> (64 - depth) | 1) * half;   // those with the bit set
    std::fill_n(directory_.begin() + static_cast<std::ptrdiff_t>(ones), half, AddPage(depth));
    const Entries entries = std::exchange(page->entries, Entries());
    page->size = 0;
    for (const Entry& entry : entries)
      if (entry.slot != kNoBlock) Place(entry);
  }

  PagedArray<Page> pages_;
  int depth_ = kFirstDepth;  ///< leading bits that the directory tells apart
  std::vector<Page*> directory_;
};

/// Blocks by columns of 8 x 8 blocks: removal looks at whole columns first, and only when the boundary may have come to
/// them.
class DynamicVoxelGrid::TileMap {
 public:
  struct Tile {
    int x = 0, y = 0;
    std::vector<std::uint32_t> blocks;
  };

  /// A new tile is due at once.
  std::uint32_t FindOrAdd(int x, int y) {
    const auto [it, added] = index_.try_emplace(PackTile(x, y), static_cast<std::uint32_t>(tiles_.size()));
    if (added) {
      if (free_.empty()) {
        tiles_.emplace_back();
      } else {
        it->second = free_.back();
        free_.pop_back();
      }
      tiles_[it->second].x = x;
      tiles_[it->second].y = y;
      PutOff(it->second, -std::numeric_limits<double>::infinity());
    }
    return it->second;
  }
  Tile& tile(std::uint32_t index) { return tiles_[index]; }
  const std::vector<Tile>& tiles() const { return tiles_; }

  /// The tile is not looked at before the boundary has advanced to there.
  void PutOff(std::uint32_t index, double due_m) { waiting_.emplace(due_m, index); }
  /// The next tile that is due and has blocks; none if nothing is. Whoever takes it puts it off again.
  std::optional<std::uint32_t> TakeDue(double advance_m) {
    while (!waiting_.empty() && waiting_.top().first <= advance_m) {
      const std::uint32_t index = waiting_.top().second;
      waiting_.pop();
      if (!tiles_[index].blocks.empty()) return index;
      index_.erase(PackTile(tiles_[index].x, tiles_[index].y));
      tiles_[index].blocks = {};
      free_.push_back(index);
    }
    return std::nullopt;
  }

  std::size_t memory_bytes() const {
    std::size_t bytes =
        tiles_.size() * (sizeof(Tile) + 32) + waiting_.size() * sizeof(std::pair<double, std::uint32_t>);
    for (const Tile& tile : tiles_) bytes += tile.blocks.capacity() * sizeof(std::uint32_t);
    return bytes;
  }

 private:
  std::unordered_map<std::uint64_t, std::uint32_t> index_;
  std::vector<Tile> tiles_;
  std::vector<std::uint32_t> free_;
  std::priority_queue<std::pair<double, std::uint32_t>, std::vector<std::pair<double, std::uint32_t>>, std::greater<>>
      waiting_;  // every tile that is not free, by when it is due
};

DynamicVoxelGrid::DynamicVoxelGrid(const DynamicVoxelGridParameters& parameters)
    : parameters_(parameters),
      block_size_m_(static_cast<float>(kBlockSide * parameters.resolution_m)),
      block_map_(std::make_unique<BlockMap>()),
      tiles_(std::make_unique<TileMap>()) {
  if (!(parameters.resolution_m > 0.0) || !std::isfinite(parameters.resolution_m))
    throw std::invalid_argument("grid.resolution_m: must be positive, is " + std::to_string(parameters.resolution_m));
  if (parameters.min_points_per_voxel < 1)
    throw std::invalid_argument("grid.min_points_per_voxel: must be at least 1, is " +
                                std::to_string(parameters.min_points_per_voxel));
  for (int bits : parameters.bits)
    if (bits < 3 || bits > 23)
      throw std::invalid_argument("grid.bits: each axis takes 3 to 23 bits, one has " + std::to_string(bits));
  for (double center : parameters.center_m)
    if (!std::isfinite(center)) throw std::invalid_argument("grid.center_m: must be finite");
}

DynamicVoxelGrid::~DynamicVoxelGrid() = default;
DynamicVoxelGrid::DynamicVoxelGrid(DynamicVoxelGrid&&) noexcept = default;
DynamicVoxelGrid& DynamicVoxelGrid::operator=(DynamicVoxelGrid&&) noexcept = default;

/// A chunk of points on their way into their voxels, by coordinate, so that compilers take several points at a time.
struct DynamicVoxelGrid::Chunk {
  static constexpr std::size_t kSize = 128;
  static constexpr std::uint64_t kNowhere = ~std::uint64_t{0};  ///< block of points that have no voxel

  std::size_t count = 0;
  std::array<std::array<float, kSize>, 3> points_sensor;
  std::array<std::array<float, kSize>, 3> in_block;  ///< relative to the corner of their block
  std::array<std::uint64_t, kSize> block;            ///< as PackBlock has it
  std::array<std::uint32_t, kSize> cell;
};

/// A chunk's points of one voxel that follow each other, as one.
struct DynamicVoxelGrid::Runs {
  struct Run {
    Eigen::Vector3f sum_block = Eigen::Vector3f::Zero();
    std::uint32_t count = 0;
    std::uint32_t cell = 0;
    std::uint32_t visit = 0;  ///< of its block, in the next two
  };
  std::size_t count = 0, visits = 0;
  std::array<Run, Chunk::kSize> runs;
  std::array<std::uint64_t, Chunk::kSize> block;
  std::array<std::uint32_t, Chunk::kSize> slot;
};

VoxelUpdate DynamicVoxelGrid::Insert(const Points& points_sensor, const Pose& T_odom_sensor) {
  // Blocks lie anywhere in memory. A chunk of points at a time, everything that a pass over the chunk needs was asked
  // for by the pass before it, so that the fetches overlap instead of following each other.
  VoxelUpdate update;
  ++insertions_;
  Chunk chunk;
  Runs runs;
  const CellTransform transform = CellTransformOf(T_odom_sensor);
  touched_inactive_.clear();
  update.moved.reserve(last_moved_ + last_moved_ / 8);
  for (std::size_t begin = 0; begin < points_sensor.size(); begin += Chunk::kSize) {
    chunk.count = std::min(Chunk::kSize, points_sensor.size() - begin);
    for (std::size_t i = 0; i < chunk.count; ++i)
      for (int axis = 0; axis < 3; ++axis) chunk.points_sensor[axis][i] = points_sensor[begin + i][axis];
    Locate(transform, &chunk);
    CountDropped(chunk, &update);
    MergeRuns(chunk, &runs);
    FindBlocks(&runs);
    AddRuns(runs, &update);
  }
  ActivateTouched(&update);
  last_moved_ = update.moved.size();
  return update;
}

DynamicVoxelGrid::CellTransform DynamicVoxelGrid::CellTransformOf(const Pose& T_odom_sensor) const {
  const Pose T_grid_sensor = T_odom_grid_.inverse() * T_odom_sensor;
  const Eigen::Vector3d center(parameters_.center_m[0], parameters_.center_m[1], parameters_.center_m[2]);
  const double cells_per_m = 1.0 / parameters_.resolution_m;
  CellTransform transform;
  for (int row = 0; row < 3; ++row) {
    for (int column = 0; column < 3; ++column)
      transform.R[row][column] = cells_per_m * T_grid_sensor.linear()(row, column);
    transform.t[row] = cells_per_m * (T_grid_sensor.translation()[row] - center[row]);
    transform.half_cells[row] = std::ldexp(1.0, parameters_.bits[row] - 1);
  }
  transform.resolution = static_cast<float>(parameters_.resolution_m);
  return transform;
}

/// (3.3): block and cell of each point.
SEGMATCH_SEVERAL_TARGETS
void DynamicVoxelGrid::Locate(const CellTransform& transform, Chunk* chunk) {
  const std::size_t count = chunk->count;
  const float* const x = chunk->points_sensor[0].data();
  const float* const y = chunk->points_sensor[1].data();
  const float* const z = chunk->points_sensor[2].data();
  std::uint32_t* const cell = chunk->cell.data();
  std::array<std::uint32_t, Chunk::kSize> inside;
  std::uint64_t* const block = chunk->block.data();
  for (std::size_t i = 0; i < count; ++i) block[i] = 0;
  for (std::size_t i = 0; i < count; ++i) cell[i] = 0;
  for (std::size_t i = 0; i < count; ++i) inside[i] = 1;
  for (int axis = 0; axis < 3; ++axis) {
    const double rx = transform.R[axis][0], ry = transform.R[axis][1], rz = transform.R[axis][2], t = transform.t[axis];
    const double low = -transform.half_cells[axis], high = transform.half_cells[axis];
    float* const in_block = chunk->in_block[axis].data();
    for (std::size_t i = 0; i < count; ++i) {
      const double exact =
          rx * static_cast<double>(x[i]) + ry * static_cast<double>(y[i]) + rz * static_cast<double>(z[i]) + t;
      double cells = exact >= low ? exact : low;  // also where it is no number
      cells = cells < high ? cells : low;
      std::int32_t index = static_cast<std::int32_t>(cells);
      index -= cells < static_cast<double>(index) ? 1 : 0;  // floor
      block[i] |= PackCoordinate(index >> 2, axis);
      cell[i] |= static_cast<std::uint32_t>(index & 3) << (2 * axis);
      inside[i] &= cells == exact ? 1u : 0u;
      in_block[i] = static_cast<float>(cells - static_cast<double>(index & ~3)) * transform.resolution;
    }
  }
  for (std::size_t i = 0; i < count; ++i) block[i] |= std::uint64_t{inside[i]} - 1;  // kNowhere, or nothing
}

void DynamicVoxelGrid::CountDropped(const Chunk& chunk, VoxelUpdate* update) {
  for (std::size_t i = 0; i < chunk.count; ++i) {
    if (chunk.block[i] != Chunk::kNowhere) continue;
    const bool finite = std::isfinite(chunk.points_sensor[0][i]) && std::isfinite(chunk.points_sensor[1][i]) &&
                        std::isfinite(chunk.points_sensor[2][i]);
    ++(finite ? update->dropped_outside : update->dropped_nonfinite);
  }
}

/// Where runs end nobody can predict, so that no branch depends on it.
void DynamicVoxelGrid::MergeRuns(const Chunk& chunk, Runs* runs) {
  std::size_t count = 0, visits = 0;
  std::uint64_t last_block = chunk.block[0];
  std::uint32_t last_cell = chunk.cell[0];
  Eigen::Vector3f sum = Eigen::Vector3f::Zero();
  std::uint32_t begin = 0;
  for (std::size_t i = 0; i < chunk.count; ++i) {
    const std::uint64_t block_change = chunk.block[i] ^ last_block;
    const std::uint32_t leaves_block = block_change != 0;
    const std::uint32_t leaves_voxel = (block_change | (chunk.cell[i] ^ last_cell)) != 0;
    count += leaves_voxel;
    visits += leaves_block;
    begin += leaves_voxel * (static_cast<std::uint32_t>(i) - begin);
    sum = static_cast<float>(1 - leaves_voxel) * sum +
          Eigen::Vector3f(chunk.in_block[0][i], chunk.in_block[1][i], chunk.in_block[2][i]);
    last_block = chunk.block[i];
    last_cell = chunk.cell[i];
    runs->block[visits] = last_block;
    runs->runs[count] = {sum, static_cast<std::uint32_t>(i) + 1 - begin, last_cell, static_cast<std::uint32_t>(visits)};
  }
  runs->count = count + 1;
  runs->visits = visits + 1;
}

/// Finds or adds the blocks.
void DynamicVoxelGrid::FindBlocks(Runs* runs) {
  for (std::size_t i = 0; i < runs->visits; ++i) block_map_->Prefetch(runs->block[i]);
  for (std::size_t i = 0; i < runs->visits; ++i) {
    const std::uint64_t block = runs->block[i];
    runs->slot[i] = kNoBlock;
    if (block == Chunk::kNowhere) continue;
    std::uint32_t slot = block_map_->Find(block);
    if (slot == kNoBlock) slot = AddBlock(UnpackBlock(block));
    runs->slot[i] = slot;
    __builtin_prefetch(&blocks_[slot], 1);
  }
}

/// (3.4).
void DynamicVoxelGrid::AddRuns(const Runs& runs, VoxelUpdate* update) {
  const auto end = runs.runs.begin() + static_cast<std::ptrdiff_t>(runs.count);
  for (auto run = runs.runs.begin(); run != end; ++run)
    if (runs.slot[run->visit] != kNoBlock) __builtin_prefetch(&voxels_[runs.slot[run->visit]][run->cell], 1);
  for (auto run = runs.runs.begin(); run != end; ++run) {
    const std::uint32_t slot = runs.slot[run->visit];
    if (slot == kNoBlock) continue;
    Block& home = blocks_[slot];
    Voxel& voxel = voxels_[slot][run->cell];
    const std::uint64_t bit = std::uint64_t{1} << run->cell;
    if (home.last_insertion != insertions_) {
      home.last_insertion = insertions_;
      home.touched = 0;
    }
    if (!(home.touched & bit)) {
      home.touched |= bit;
      const VoxelHandle handle = slot * kCellsPerBlock + run->cell;
      if (home.active & bit) {
        update->moved.push_back({handle, voxel.centroid_block});
      } else {
        touched_inactive_.push_back(handle);
        if (!(home.occupied & bit)) {
          home.occupied |= bit;
          voxel = {Eigen::Vector3f::Zero(), 0};
          ++occupied_voxels_;
        }
      }
    }
    const float n = static_cast<float>(voxel.count);
    voxel.count += run->count;
    voxel.centroid_block = (n * voxel.centroid_block + run->sum_block) * (1.f / static_cast<float>(voxel.count));
  }
}

void DynamicVoxelGrid::ActivateTouched(VoxelUpdate* update) {
  const std::uint32_t min_points = static_cast<std::uint32_t>(parameters_.min_points_per_voxel);
  update->activated.reserve(touched_inactive_.size());
  for (const VoxelHandle voxel : touched_inactive_) {
    if (VoxelAt(voxel).count < min_points) continue;
    blocks_[voxel / kCellsPerBlock].active |= std::uint64_t{1} << (voxel % kCellsPerBlock);
    update->activated.push_back(voxel);
  }
  active_voxels_ += update->activated.size();
}

VoxelUpdate DynamicVoxelGrid::RemoveOutside(const Eigen::Vector3d& center_odom, double radius_m,
                                            std::uint32_t oldest_insertion) {
  VoxelUpdate update;
  const Eigen::Vector2d center = (T_odom_grid_.inverse() * center_odom).head<2>();
  const double radius2 = radius_m * radius_m;
  const double block_m = kBlockSide * parameters_.resolution_m;
  std::vector<std::uint32_t> looked_at = TilesAtBoundary(center, radius_m);
  if (oldest_insertion != 0) {
    looked_at.resize(tiles_->tiles().size());
    std::iota(looked_at.begin(), looked_at.end(), 0u);
  }
  constexpr std::size_t kAhead = 8;
  for (const std::uint32_t t : looked_at) {
    const TileMap::Tile& tile = tiles_->tile(t);
    for (std::size_t i = tile.blocks.size(); i-- > 0;) {  // backwards: removal swaps the last one in
      if (i >= kAhead) __builtin_prefetch(&blocks_[tile.blocks[i - kAhead]]);
      const std::uint32_t slot = tile.blocks[i];
      const Block& candidate = blocks_[slot];
      const Eigen::Vector2d corner = BlockCorner(slot * kCellsPerBlock).head<2>();
      const auto [nearest_m, farthest_m] = DistancesToSquare(center, corner, block_m);
      const bool is_old = candidate.last_insertion < oldest_insertion;
      if (farthest_m <= radius_m && !is_old) continue;
      std::uint64_t leaving = is_old || nearest_m > radius_m ? candidate.occupied : 0;
      for (std::uint64_t cells = candidate.occupied & ~leaving; cells != 0; cells &= cells - 1) {
        const int cell = __builtin_ctzll(cells);
        const Eigen::Vector2d centroid = corner + voxels_[slot][cell].centroid_block.head<2>().cast<double>();
        if ((centroid - center).squaredNorm() > radius2) leaving |= std::uint64_t{1} << cell;
      }
      RemoveCells(slot, leaving, &update);
    }
  }
  active_voxels_ -= update.removed.size();
  return update;
}

/// The tiles that a circle in the grid's x-y plane, removal's boundary, leaves out, or cuts. A tile that lies inside
/// with some room is not looked at again before the circle has moved, or shrunk, by so much altogether.
std::vector<std::uint32_t> DynamicVoxelGrid::TilesAtBoundary(const Eigen::Vector2d& center, double radius_m) {
  constexpr double kRoundingM = 1e-6;
  advance_m_ += (center - last_center_).norm() + std::max(0.0, last_radius_m_ - radius_m);
  last_center_ = center;
  last_radius_m_ = radius_m;
  const double tile_m = kBlocksPerTileSide * kBlockSide * parameters_.resolution_m;
  const Eigen::Vector2d grid_center(parameters_.center_m[0], parameters_.center_m[1]);
  std::vector<std::uint32_t> due, at_boundary;
  while (const std::optional<std::uint32_t> index = tiles_->TakeDue(advance_m_)) due.push_back(*index);
  for (const std::uint32_t index : due) {
    const TileMap::Tile& tile = tiles_->tile(index);
    const Eigen::Vector2d corner = tile_m * Eigen::Vector2d(tile.x, tile.y) + grid_center;
    const double room_m = radius_m - DistancesToSquare(center, corner, tile_m).farthest_m - kRoundingM;
    if (room_m <= 0.0) at_boundary.push_back(index);
    tiles_->PutOff(index, advance_m_ + std::max(0.0, room_m));
  }
  return at_boundary;
}

void DynamicVoxelGrid::RemoveCells(std::uint32_t slot, std::uint64_t cells, VoxelUpdate* update) {
  Block& home = blocks_[slot];
  for (std::uint64_t active = cells & home.active; active != 0; active &= active - 1) {
    const VoxelHandle cell = static_cast<VoxelHandle>(__builtin_ctzll(active));
    update->removed.push_back({slot * kCellsPerBlock + cell, voxels_[slot][cell].centroid_block});
  }
  occupied_voxels_ -= static_cast<std::size_t>(__builtin_popcountll(cells));
  home.occupied &= ~cells;
  home.active &= ~cells;
  if (home.occupied == 0) RemoveBlock(slot);
}

std::uint32_t DynamicVoxelGrid::FindBlock(const std::array<std::int32_t, 3>& coordinates) const {
  return block_map_->Find(PackBlock(coordinates));
}

std::uint32_t DynamicVoxelGrid::AddBlock(const std::array<std::int32_t, 3>& coordinates) {
  std::uint32_t slot;
  if (!free_blocks_.empty()) {
    slot = free_blocks_.back();
    free_blocks_.pop_back();
  } else {
    slot = block_slots_++;
    blocks_.Grow(block_slots_);
    links_.Grow(block_slots_);
    voxels_.Grow(block_slots_);
  }
  Block& added = blocks_[slot];
  added.coordinates = coordinates;
  added.linked = 0;
  for (int dz = -1; dz <= 1; ++dz)
    for (int dy = -1; dy <= 1; ++dy)
      for (int dx = -1; dx <= 1; ++dx)
        block_map_->Prefetch(PackBlock({coordinates[0] + dx, coordinates[1] + dy, coordinates[2] + dz}));
  for (int dz = -1; dz <= 1; ++dz)
    for (int dy = -1; dy <= 1; ++dy)
      for (int dx = -1; dx <= 1; ++dx) {
        const int link = LinkIndex(dx, dy, dz);
        if (link == kLinkCenter) continue;
        const std::uint32_t neighbour = FindBlock({coordinates[0] + dx, coordinates[1] + dy, coordinates[2] + dz});
        if (neighbour == kNoBlock) continue;
        SetLink(slot, link, neighbour);
        SetLink(neighbour, 2 * kLinkCenter - link, slot);
      }
  SetLink(slot, kLinkCenter, slot);
  block_map_->Insert(PackBlock(coordinates), slot);
  added.tile = tiles_->FindOrAdd(FloorDivide(coordinates[0], kBlocksPerTileSide),
                                 FloorDivide(coordinates[1], kBlocksPerTileSide));
  std::vector<std::uint32_t>& members = tiles_->tile(added.tile).blocks;
  added.position_in_tile = static_cast<std::uint32_t>(members.size());
  members.push_back(slot);
  return slot;
}

void DynamicVoxelGrid::SetLink(std::uint32_t slot, int link, std::uint32_t to) {
  links_[slot][link] = to;
  blocks_[slot].linked |= 1u << link;
}

void DynamicVoxelGrid::RemoveBlock(std::uint32_t slot) {
  const Block& removed = blocks_[slot];
  for (std::uint32_t linked = removed.linked; linked != 0; linked &= linked - 1) {
    const int link = __builtin_ctz(linked);
    if (link != kLinkCenter) blocks_[links_[slot][link]].linked &= ~(1u << (2 * kLinkCenter - link));
  }
  block_map_->Erase(PackBlock(removed.coordinates));
  std::vector<std::uint32_t>& members = tiles_->tile(removed.tile).blocks;
  members[removed.position_in_tile] = members.back();
  blocks_[members.back()].position_in_tile = removed.position_in_tile;
  members.pop_back();
  free_blocks_.push_back(slot);
}

std::size_t DynamicVoxelGrid::handle_capacity() const {
  return std::size_t{block_slots_} * kCellsPerBlock;
}

std::size_t DynamicVoxelGrid::memory_bytes() const {
  return blocks_.memory_bytes() + links_.memory_bytes() + voxels_.memory_bytes() +
         free_blocks_.capacity() * sizeof(std::uint32_t) + block_map_->memory_bytes() + tiles_->memory_bytes() +
         touched_inactive_.capacity() * sizeof(VoxelHandle);
}

bool DynamicVoxelGrid::IsActive(VoxelHandle voxel) const {
  return voxel < handle_capacity() && (blocks_[voxel / kCellsPerBlock].active >> (voxel % kCellsPerBlock) & 1) != 0;
}

std::uint32_t DynamicVoxelGrid::PointCount(VoxelHandle voxel) const {
  return VoxelAt(voxel).count;
}

std::vector<VoxelHandle> DynamicVoxelGrid::ActiveVoxels() const {
  std::vector<VoxelHandle> voxels;
  voxels.reserve(active_voxels_);
  for (const TileMap::Tile& tile : tiles_->tiles())
    for (const std::uint32_t slot : tile.blocks)
      for (std::uint64_t cells = blocks_[slot].active; cells != 0; cells &= cells - 1)
        voxels.push_back(slot * kCellsPerBlock + static_cast<VoxelHandle>(__builtin_ctzll(cells)));
  return voxels;
}

}  // namespace incremental_segmatch
