#include "incremental_segmatch/dynamic_voxel_grid.hpp"

#include <algorithm>
#include <limits>
#include <stdexcept>
#include <string>
#include <unordered_map>

// Compiled for processors with AVX2 as well, and chosen at run time; the results are the same.
#if defined(__GNUC__) && !defined(__clang__) && defined(__x86_64__) && defined(__gnu_linux__)
#define SEGMATCH_SEVERAL_TARGETS __attribute__((target_clones("avx2", "default")))
#else
#define SEGMATCH_SEVERAL_TARGETS
#endif

namespace incremental_segmatch {
namespace {

constexpr int kSide = DynamicVoxelGrid::kBlockSide;
constexpr int kBlocksPerTileSide = 8;
constexpr int kLinkCenter = 13;  // index of the block itself among its 27 links

int LinkIndex(int dx, int dy, int dz) { return kLinkCenter + dx + 3 * dy + 9 * dz; }

int FloorDivide(int value, int divisor) { return value >= 0 ? value / divisor : -((divisor - 1 - value) / divisor); }

std::uint64_t PackTile(int x, int y) {
  return (static_cast<std::uint64_t>(static_cast<std::uint32_t>(x)) << 32) | static_cast<std::uint32_t>(y);
}

// Block coordinates fit 21 bits each: at most 23 bits of cells an axis, in blocks of 4.
std::uint64_t PackBlock(const std::array<std::int32_t, 3>& c) {
  constexpr std::uint64_t kMask = (1u << 21) - 1;
  return ((static_cast<std::uint64_t>(c[2]) & kMask) << 42) | ((static_cast<std::uint64_t>(c[1]) & kMask) << 21) |
         (static_cast<std::uint64_t>(c[0]) & kMask);
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

/// Open addressing with linear probing and backward-shift deletion: one cache line a lookup, no tombstones.
class DynamicVoxelGrid::BlockMap {
 public:
  BlockMap() : entries_(1024) {}

  /// Starts to fetch what Find will read.
  void Prefetch(std::uint64_t key) const { __builtin_prefetch(&entries_[Home(key)]); }
  std::uint32_t Find(std::uint64_t key) const {
    for (std::size_t i = Home(key);; i = (i + 1) & (entries_.size() - 1)) {
      if (entries_[i].slot == kNoBlock) return kNoBlock;
      if (entries_[i].key == key) return entries_[i].slot;
    }
  }
  void Insert(std::uint64_t key, std::uint32_t slot) {
    if (2 * ++size_ > entries_.size()) {
      std::vector<Entry> old(2 * entries_.size());
      old.swap(entries_);
      for (const Entry& entry : old)
        if (entry.slot != kNoBlock) Place(entry);
    }
    Place({key, slot});
  }
  void Erase(std::uint64_t key) {
    const std::size_t mask = entries_.size() - 1;
    std::size_t hole = Home(key);
    while (entries_[hole].key != key || entries_[hole].slot == kNoBlock) hole = (hole + 1) & mask;
    for (std::size_t i = (hole + 1) & mask; entries_[i].slot != kNoBlock; i = (i + 1) & mask) {
      // An entry moves into the hole unless its home lies cyclically in (hole, i].
      if (((i - Home(entries_[i].key)) & mask) >= ((i - hole) & mask)) {
        entries_[hole] = entries_[i];
        hole = i;
      }
    }
    entries_[hole].slot = kNoBlock;
    --size_;
  }
  std::size_t memory_bytes() const { return entries_.size() * sizeof(Entry); }

 private:
  struct Entry {
    std::uint64_t key = 0;
    std::uint32_t slot = kNoBlock;
  };
  std::size_t Home(std::uint64_t key) const {
    key ^= key >> 32;
    key *= 0x9e3779b97f4a7c15ull;
    return (key >> 32) & (entries_.size() - 1);
  }
  void Place(const Entry& entry) {
    std::size_t i = Home(entry.key);
    while (entries_[i].slot != kNoBlock) i = (i + 1) & (entries_.size() - 1);
    entries_[i] = entry;
  }

  std::vector<Entry> entries_;
  std::size_t size_ = 0;
};

/// Blocks by columns of 8 x 8 blocks: removal looks at whole columns first.
class DynamicVoxelGrid::TileMap {
 public:
  struct Tile {
    int x = 0, y = 0;
    std::vector<std::uint32_t> blocks;
  };

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
    }
    return it->second;
  }
  Tile& tile(std::uint32_t index) { return tiles_[index]; }
  void Free(std::uint32_t index) {
    index_.erase(PackTile(tiles_[index].x, tiles_[index].y));
    tiles_[index].blocks = {};
    free_.push_back(index);
  }
  const std::vector<Tile>& tiles() const { return tiles_; }
  std::size_t memory_bytes() const {
    std::size_t bytes = tiles_.size() * (sizeof(Tile) + 32);
    for (const Tile& tile : tiles_) bytes += tile.blocks.capacity() * sizeof(std::uint32_t);
    return bytes;
  }

 private:
  std::unordered_map<std::uint64_t, std::uint32_t> index_;
  std::vector<Tile> tiles_;
  std::vector<std::uint32_t> free_;
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

  std::size_t count = 0;
  std::array<std::array<float, kSize>, 3> points_sensor;
  std::array<std::array<float, kSize>, 3> in_block;          ///< relative to the corner of their block
  std::array<std::array<std::int32_t, kSize>, 3> coordinates;  ///< of their block
  std::array<std::uint32_t, kSize> cell;
  std::array<std::uint32_t, kSize> inside;  ///< 0 for points that have no voxel
};

/// Points of one voxel that follow each other in the scan.
struct DynamicVoxelGrid::Run {
  std::uint32_t slot, cell, count;
  Eigen::Vector3f sum_block;
};

VoxelUpdate DynamicVoxelGrid::Insert(const Points& points_sensor, const Pose& T_odom_sensor) {
  // Blocks lie anywhere in memory. A chunk of points at a time, everything that a pass over the chunk needs was asked for by the
  // pass before it, so that the fetches overlap instead of following each other.
  VoxelUpdate update;
  ++insertions_;
  Chunk chunk;
  std::array<Run, Chunk::kSize> runs;
  const CellTransform transform = CellTransformOf(T_odom_sensor);
  touched_inactive_.clear();
  update.moved.reserve(last_moved_ + last_moved_ / 8);
  for (std::size_t begin = 0; begin < points_sensor.size(); begin += Chunk::kSize) {
    chunk.count = std::min(Chunk::kSize, points_sensor.size() - begin);
    for (std::size_t i = 0; i < chunk.count; ++i)
      for (int axis = 0; axis < 3; ++axis) chunk.points_sensor[axis][i] = points_sensor[begin + i][axis];
    Locate(transform, &chunk);
    for (std::size_t i = 0; i < chunk.count; ++i)
      block_map_->Prefetch(PackBlock({chunk.coordinates[0][i], chunk.coordinates[1][i], chunk.coordinates[2][i]}));
    const std::size_t count = FindVoxels(chunk, runs.data(), &update);
    for (std::size_t i = 0; i < count; ++i) AddRun(runs[i], &update);
  }
  SettleTouched(&update);
  last_moved_ = update.moved.size();
  return update;
}

DynamicVoxelGrid::CellTransform DynamicVoxelGrid::CellTransformOf(const Pose& T_odom_sensor) const {
  const Pose T_grid_sensor = T_odom_grid_.inverse() * T_odom_sensor;
  const Eigen::Vector3d center(parameters_.center_m[0], parameters_.center_m[1], parameters_.center_m[2]);
  const double cells_per_m = 1.0 / parameters_.resolution_m;
  CellTransform transform;
  for (int row = 0; row < 3; ++row) {
    for (int column = 0; column < 3; ++column) transform.R[row][column] = cells_per_m * T_grid_sensor.linear()(row, column);
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
  std::uint32_t* const inside = chunk->inside.data();
  for (std::size_t i = 0; i < count; ++i) cell[i] = 0;
  for (std::size_t i = 0; i < count; ++i) inside[i] = 1;
  for (int axis = 0; axis < 3; ++axis) {
    const double rx = transform.R[axis][0], ry = transform.R[axis][1], rz = transform.R[axis][2], t = transform.t[axis];
    const double low = -transform.half_cells[axis], high = transform.half_cells[axis];
    float* const in_block = chunk->in_block[axis].data();
    std::int32_t* const coordinate = chunk->coordinates[axis].data();
    for (std::size_t i = 0; i < count; ++i) {
      const double exact = rx * static_cast<double>(x[i]) + ry * static_cast<double>(y[i]) + rz * static_cast<double>(z[i]) + t;
      double cells = exact >= low ? exact : low;  // also where it is no number
      cells = cells < high ? cells : low;
      std::int32_t index = static_cast<std::int32_t>(cells);
      index -= cells < static_cast<double>(index) ? 1 : 0;  // floor
      coordinate[i] = index >> 2;
      cell[i] |= static_cast<std::uint32_t>(index & 3) << (2 * axis);
      inside[i] &= cells == exact ? 1u : 0u;
      in_block[i] = static_cast<float>(cells - static_cast<double>(index & ~3)) * transform.resolution;
    }
  }
}

/// Finds or adds the block of each point that has one, drops the others, and returns how many runs there are.
std::size_t DynamicVoxelGrid::FindVoxels(const Chunk& chunk, Run* runs, VoxelUpdate* update) {
  std::array<std::int32_t, 3> last{std::numeric_limits<std::int32_t>::min(), 0, 0};
  std::uint32_t slot = kNoBlock;
  Run* run = runs - 1;
  for (std::size_t i = 0; i < chunk.count; ++i) {
    if (!chunk.inside[i]) {
      const bool finite = std::isfinite(chunk.points_sensor[0][i]) && std::isfinite(chunk.points_sensor[1][i]) &&
                          std::isfinite(chunk.points_sensor[2][i]);
      ++(finite ? update->dropped_outside : update->dropped_nonfinite);
      continue;
    }
    const Eigen::Vector3f in_block(chunk.in_block[0][i], chunk.in_block[1][i], chunk.in_block[2][i]);
    const std::array<std::int32_t, 3> coordinates{chunk.coordinates[0][i], chunk.coordinates[1][i], chunk.coordinates[2][i]};
    if (coordinates != last) {
      slot = block_map_->Find(PackBlock(coordinates));
      if (slot == kNoBlock) slot = AddBlock(coordinates);
      last = coordinates;
    } else if (run->cell == chunk.cell[i]) {
      ++run->count;
      run->sum_block += in_block;
      continue;
    }
    *++run = {slot, chunk.cell[i], 1, in_block};
    __builtin_prefetch(&blocks_[slot], 1);
    __builtin_prefetch(&voxels_[slot][chunk.cell[i]], 1);
  }
  return static_cast<std::size_t>(run + 1 - runs);
}

/// While a voxel is touched its centroid is the sum of its points.
void DynamicVoxelGrid::AddRun(const Run& run, VoxelUpdate* update) {
  Block& home = blocks_[run.slot];
  Voxel& voxel = voxels_[run.slot][run.cell];
  const std::uint64_t bit = std::uint64_t{1} << run.cell;
  const VoxelHandle handle = run.slot * kCellsPerBlock + run.cell;
  if (!(home.touched & bit)) {
    home.touched |= bit;
    if (home.active & bit) {
      update->moved.push_back({handle, voxel.centroid_block, Eigen::Vector3f::Zero()});
    } else {
      touched_inactive_.push_back(handle);
      if (!(home.occupied & bit)) {
        home.occupied |= bit;
        voxel = {Eigen::Vector3f::Zero(), 0};
        ++occupied_voxels_;
      }
    }
    voxel.centroid_block *= static_cast<float>(voxel.count);
  }
  voxel.centroid_block += run.sum_block;
  voxel.count += run.count;
}

/// (3.4): sums become centroids. Reports what became of the voxels that got points.
void DynamicVoxelGrid::SettleTouched(VoxelUpdate* update) {
  constexpr std::size_t kAhead = 16;
  const auto prefetch = [this](VoxelHandle voxel) {
    __builtin_prefetch(&blocks_[voxel / kCellsPerBlock], 1);
    __builtin_prefetch(&VoxelAt(voxel), 1);
  };
  const auto settle = [this](VoxelHandle handle) -> const Voxel& {
    Block& home = blocks_[handle / kCellsPerBlock];
    Voxel& voxel = VoxelAt(handle);
    home.touched &= ~(std::uint64_t{1} << (handle % kCellsPerBlock));
    home.last_insertion = insertions_;
    voxel.centroid_block *= 1.f / static_cast<float>(voxel.count);
    return voxel;
  };
  std::vector<MovedVoxel>& moved = update->moved;
  for (std::size_t i = 0; i < moved.size(); ++i) {
    if (i + kAhead < moved.size()) prefetch(moved[i + kAhead].voxel);
    moved[i].after_block = settle(moved[i].voxel).centroid_block;
  }
  const std::uint32_t min_points = static_cast<std::uint32_t>(parameters_.min_points_per_voxel);
  update->activated.reserve(touched_inactive_.size());
  for (std::size_t i = 0; i < touched_inactive_.size(); ++i) {
    const VoxelHandle handle = touched_inactive_[i];
    if (i + kAhead < touched_inactive_.size()) prefetch(touched_inactive_[i + kAhead]);
    if (settle(handle).count < min_points) continue;
    blocks_[handle / kCellsPerBlock].active |= std::uint64_t{1} << (handle % kCellsPerBlock);
    update->activated.push_back(handle);
  }
  active_voxels_ += update->activated.size();
}

VoxelUpdate DynamicVoxelGrid::RemoveOutside(const Eigen::Vector3d& center_odom, double radius_m,
                                            std::uint32_t oldest_insertion) {
  VoxelUpdate update;
  const Eigen::Vector3d center = T_odom_grid_.inverse() * center_odom;
  const double radius2 = radius_m * radius_m;
  const double block_m = kBlockSide * parameters_.resolution_m;
  // Squared distances in x-y of the nearest and the farthest point of a square with this lower corner.
  const auto distances2 = [&](double corner_x, double corner_y, double side) {
    const double dx = center.x() - corner_x, dy = center.y() - corner_y;
    const double near_x = dx < 0 ? -dx : std::max(0.0, dx - side), near_y = dy < 0 ? -dy : std::max(0.0, dy - side);
    const double far_x = std::max(std::abs(dx), std::abs(dx - side)), far_y = std::max(std::abs(dy), std::abs(dy - side));
    return std::make_pair(near_x * near_x + near_y * near_y, far_x * far_x + far_y * far_y);
  };
  const double tile_m = kBlocksPerTileSide * block_m;
  for (std::uint32_t t = 0; t < tiles_->tiles().size(); ++t) {
    const TileMap::Tile& tile = tiles_->tile(t);
    if (tile.blocks.empty()) continue;
    if (oldest_insertion == 0 &&
        distances2(tile.x * tile_m + parameters_.center_m[0], tile.y * tile_m + parameters_.center_m[1], tile_m).second <=
            radius2)
      continue;
    for (std::size_t i = tile.blocks.size(); i-- > 0;) {  // backwards: removal swaps the last one in
      const std::uint32_t slot = tile.blocks[i];
      const Block& candidate = blocks_[slot];
      const Eigen::Vector3d corner = BlockCorner(slot * kCellsPerBlock);
      const auto [nearest2, farthest2] = distances2(corner.x(), corner.y(), block_m);
      const bool is_old = candidate.last_insertion < oldest_insertion;
      if (farthest2 <= radius2 && !is_old) continue;
      std::uint64_t leaving = is_old ? candidate.occupied : 0;
      for (std::uint64_t cells = candidate.occupied & ~leaving; cells != 0; cells &= cells - 1) {
        const int cell = __builtin_ctzll(cells);
        const Eigen::Vector3f& c = voxels_[slot][cell].centroid_block;
        const double dx = corner.x() + c.x() - center.x(), dy = corner.y() + c.y() - center.y();
        if (nearest2 > radius2 || dx * dx + dy * dy > radius2) leaving |= std::uint64_t{1} << cell;
      }
      RemoveCells(slot, leaving, &update);
    }
  }
  active_voxels_ -= update.removed.size();
  return update;
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
  added.tile = tiles_->FindOrAdd(FloorDivide(coordinates[0], kBlocksPerTileSide), FloorDivide(coordinates[1], kBlocksPerTileSide));
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
  if (members.empty()) tiles_->Free(removed.tile);
  free_blocks_.push_back(slot);
}

std::size_t DynamicVoxelGrid::handle_capacity() const { return std::size_t{block_slots_} * kCellsPerBlock; }

std::size_t DynamicVoxelGrid::memory_bytes() const {
  return blocks_.memory_bytes() + links_.memory_bytes() + voxels_.memory_bytes() +
         free_blocks_.capacity() * sizeof(std::uint32_t) + block_map_->memory_bytes() + tiles_->memory_bytes() + touched_inactive_.capacity() * sizeof(VoxelHandle);
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
