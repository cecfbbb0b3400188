#include "incremental_segmatch/dynamic_voxel_grid.hpp"

#include <algorithm>
#include <stdexcept>
#include <string>
#include <unordered_map>

namespace incremental_segmatch {
namespace {

constexpr int kSide = DynamicVoxelGrid::kBlockSide;
constexpr int kBlocksPerTileSide = 8;
constexpr int kLinkCenter = 13;  // index of the block itself among its 27 links

std::int16_t LinkIndex(int dx, int dy, int dz) { return static_cast<std::int16_t>(kLinkCenter + dx + 3 * dy + 9 * dz); }

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
          if (std::max({std::abs(bx), std::abs(by), std::abs(bz)}) <= 1) visit.link = LinkIndex(bx, by, bz);
          visits_[cell].push_back(visit);
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

VoxelUpdate DynamicVoxelGrid::Insert(const Points& points_sensor, const Pose& T_odom_sensor) {
  // Blocks lie anywhere in memory. A chunk of points at a time, everything that a pass over the chunk needs was asked for by the
  // pass before it, so that the fetches overlap instead of following each other.
  constexpr std::size_t kChunk = 128;
  VoxelUpdate update;
  std::array<Located, kChunk> located;
  const Pose T_grid_sensor = T_odom_grid_.inverse() * T_odom_sensor;
  touched_.clear();
  for (std::size_t begin = 0; begin < points_sensor.size(); begin += kChunk) {
    const std::size_t end = std::min(begin + kChunk, points_sensor.size());
    const std::size_t count = Locate(points_sensor.data() + begin, end - begin, T_grid_sensor, located.data(), &update);
    std::uint64_t last_key = ~std::uint64_t{0};
    std::uint32_t slot = kNoBlock;
    for (std::size_t i = 0; i < count; ++i) {
      const std::uint64_t key = PackBlock(located[i].coordinates);
      if (key != last_key) {
        slot = block_map_->Find(key);
        if (slot == kNoBlock) slot = AddBlock(located[i].coordinates);
        last_key = key;
      }
      located[i].slot = slot;
      __builtin_prefetch(&block(slot));
      __builtin_prefetch(&block(slot).voxels[located[i].cell], 1);
    }
    for (std::size_t i = 0; i < count; ++i) AddPoint(located[i]);
  }
  CollectTouched(&update);
  return update;
}

/// (3.3): finds block and cell of each point, drops those that have none, and returns how many are left.
std::size_t DynamicVoxelGrid::Locate(const Eigen::Vector3f* points_sensor, std::size_t count, const Pose& T_grid_sensor,
                                     Located* located, VoxelUpdate* update) const {
  const Eigen::Vector3d center(parameters_.center_m[0], parameters_.center_m[1], parameters_.center_m[2]);
  const double cells_per_m = 1.0 / parameters_.resolution_m;
  const Eigen::Matrix3d R_cells = cells_per_m * T_grid_sensor.linear();
  const Eigen::Vector3d t_cells = cells_per_m * (T_grid_sensor.translation() - center);
  const std::array<double, 3> half_cells{std::ldexp(1.0, parameters_.bits[0] - 1), std::ldexp(1.0, parameters_.bits[1] - 1),
                                         std::ldexp(1.0, parameters_.bits[2] - 1)};
  const float resolution = static_cast<float>(parameters_.resolution_m);
  Located* out = located;
  for (const Eigen::Vector3f* point = points_sensor; point != points_sensor + count; ++point) {
    const Eigen::Vector3f& p = *point;
    std::array<double, 3> cells;
    for (int axis = 0; axis < 3; ++axis)
      cells[axis] = R_cells(axis, 0) * p[0] + R_cells(axis, 1) * p[1] + R_cells(axis, 2) * p[2] + t_cells[axis];
    // Also false for NaN.
    const bool inside = cells[0] >= -half_cells[0] && cells[0] < half_cells[0] && cells[1] >= -half_cells[1] &&
                        cells[1] < half_cells[1] && cells[2] >= -half_cells[2] && cells[2] < half_cells[2];
    if (!inside) {
      ++(p.allFinite() ? update->dropped_outside : update->dropped_nonfinite);
      continue;
    }
    out->cell = 0;
    for (int axis = 0; axis < 3; ++axis) {
      std::int32_t index = static_cast<std::int32_t>(cells[axis]);
      index -= cells[axis] < index;  // floor
      out->coordinates[axis] = index >> 2;
      out->cell |= static_cast<unsigned>(index & 3) << (2 * axis);
      out->in_block[axis] = static_cast<float>(cells[axis] - 4 * out->coordinates[axis]) * resolution;
    }
    block_map_->Prefetch(PackBlock(out->coordinates));
    ++out;
  }
  return static_cast<std::size_t>(out - located);
}

void DynamicVoxelGrid::AddPoint(const Located& point) {
  Block& home = block(point.slot);
  Voxel& voxel = home.voxels[point.cell];
  const std::uint64_t bit = std::uint64_t{1} << point.cell;
  if (!(home.occupied & bit)) {
    home.occupied |= bit;
    voxel = {Eigen::Vector3f::Zero(), 0};
    ++occupied_voxels_;
  }
  if (!(home.touched & bit)) {
    home.touched |= bit;
    touched_.push_back({point.slot * kCellsPerBlock + point.cell, (home.active & bit) != 0, voxel.centroid_block});
  }
  // (3.4) for m = 1; repeated, it gives the mean of all points.
  ++voxel.count;
  voxel.centroid_block += (point.in_block - voxel.centroid_block) * (1.f / static_cast<float>(voxel.count));
}

/// Reports what became of the voxels that got points.
void DynamicVoxelGrid::CollectTouched(VoxelUpdate* update) {
  constexpr std::size_t kAhead = 16;
  const std::uint32_t min_points = static_cast<std::uint32_t>(parameters_.min_points_per_voxel);
  update->moved.reserve(touched_.size());
  for (std::size_t i = 0; i < touched_.size(); ++i) {
    if (i + kAhead < touched_.size()) {
      const VoxelHandle ahead = touched_[i + kAhead].voxel;
      __builtin_prefetch(&block(ahead / kCellsPerBlock), 1);
      __builtin_prefetch(&block(ahead / kCellsPerBlock).voxels[ahead % kCellsPerBlock]);
    }
    const Touched& touched = touched_[i];
    Block& home = block(touched.voxel / kCellsPerBlock);
    const unsigned cell = touched.voxel % kCellsPerBlock;
    const Voxel& voxel = home.voxels[cell];
    home.touched &= ~(std::uint64_t{1} << cell);
    if (touched.was_active) {
      update->moved.push_back({touched.voxel, touched.before_block, voxel.centroid_block});
    } else if (voxel.count >= min_points) {
      home.active |= std::uint64_t{1} << cell;
      update->activated.push_back(touched.voxel);
    }
  }
  active_voxels_ += update->activated.size();
}

VoxelUpdate DynamicVoxelGrid::RemoveOutside(const Eigen::Vector3d& center_odom, double radius_m) {
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
    if (distances2(tile.x * tile_m + parameters_.center_m[0], tile.y * tile_m + parameters_.center_m[1], tile_m).second <=
        radius2)
      continue;
    for (std::size_t i = tile.blocks.size(); i-- > 0;) {  // backwards: removal swaps the last one in
      const std::uint32_t slot = tile.blocks[i];
      const Block& candidate = block(slot);
      const Eigen::Vector3d corner = BlockCorner(slot * kCellsPerBlock);
      const auto [nearest2, farthest2] = distances2(corner.x(), corner.y(), block_m);
      if (farthest2 <= radius2) continue;
      std::uint64_t leaving = 0;
      for (std::uint64_t cells = candidate.occupied; cells != 0; cells &= cells - 1) {
        const int cell = __builtin_ctzll(cells);
        const Eigen::Vector3f& c = candidate.voxels[cell].centroid_block;
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
  Block& home = block(slot);
  for (std::uint64_t active = cells & home.active; active != 0; active &= active - 1) {
    const VoxelHandle cell = static_cast<VoxelHandle>(__builtin_ctzll(active));
    update->removed.push_back({slot * kCellsPerBlock + cell, home.voxels[cell].centroid_block});
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
    if (block_slots_ % kBlocksPerPage == 0) pages_.push_back(std::make_unique<Block[]>(kBlocksPerPage));
    slot = block_slots_++;
  }
  Block& added = block(slot);
  added.coordinates = coordinates;
  for (int dz = -1; dz <= 1; ++dz)
    for (int dy = -1; dy <= 1; ++dy)
      for (int dx = -1; dx <= 1; ++dx)
        block_map_->Prefetch(PackBlock({coordinates[0] + dx, coordinates[1] + dy, coordinates[2] + dz}));
  for (int dz = -1; dz <= 1; ++dz)
    for (int dy = -1; dy <= 1; ++dy)
      for (int dx = -1; dx <= 1; ++dx) {
        const std::int16_t link = LinkIndex(dx, dy, dz);
        if (link == kLinkCenter) continue;
        added.links[link] = FindBlock({coordinates[0] + dx, coordinates[1] + dy, coordinates[2] + dz});
        if (added.links[link] != kNoBlock) block(added.links[link]).links[2 * kLinkCenter - link] = slot;
      }
  added.links[kLinkCenter] = slot;
  block_map_->Insert(PackBlock(coordinates), slot);
  added.tile = tiles_->FindOrAdd(FloorDivide(coordinates[0], kBlocksPerTileSide), FloorDivide(coordinates[1], kBlocksPerTileSide));
  std::vector<std::uint32_t>& members = tiles_->tile(added.tile).blocks;
  added.position_in_tile = static_cast<std::uint32_t>(members.size());
  members.push_back(slot);
  return slot;
}

void DynamicVoxelGrid::RemoveBlock(std::uint32_t slot) {
  Block& removed = block(slot);
  for (int link = 0; link < 27; ++link)
    if (link != kLinkCenter && removed.links[link] != kNoBlock)
      block(removed.links[link]).links[2 * kLinkCenter - link] = kNoBlock;
  block_map_->Erase(PackBlock(removed.coordinates));
  std::vector<std::uint32_t>& members = tiles_->tile(removed.tile).blocks;
  members[removed.position_in_tile] = members.back();
  block(members.back()).position_in_tile = removed.position_in_tile;
  members.pop_back();
  if (members.empty()) tiles_->Free(removed.tile);
  free_blocks_.push_back(slot);
}

std::size_t DynamicVoxelGrid::handle_capacity() const { return std::size_t{block_slots_} * kCellsPerBlock; }

std::size_t DynamicVoxelGrid::memory_bytes() const {
  return pages_.size() * kBlocksPerPage * sizeof(Block) + free_blocks_.capacity() * sizeof(std::uint32_t) +
         block_map_->memory_bytes() + tiles_->memory_bytes() + touched_.capacity() * sizeof(Touched);
}

bool DynamicVoxelGrid::IsActive(VoxelHandle voxel) const {
  return voxel < handle_capacity() && (block(voxel / kCellsPerBlock).active >> (voxel % kCellsPerBlock) & 1) != 0;
}

std::uint32_t DynamicVoxelGrid::PointCount(VoxelHandle voxel) const {
  return block(voxel / kCellsPerBlock).voxels[voxel % kCellsPerBlock].count;
}

std::vector<VoxelHandle> DynamicVoxelGrid::ActiveVoxels() const {
  std::vector<VoxelHandle> voxels;
  voxels.reserve(active_voxels_);
  for (const TileMap::Tile& tile : tiles_->tiles())
    for (const std::uint32_t slot : tile.blocks)
      for (std::uint64_t cells = block(slot).active; cells != 0; cells &= cells - 1)
        voxels.push_back(slot * kCellsPerBlock + static_cast<VoxelHandle>(__builtin_ctzll(cells)));
  return voxels;
}

}  // namespace incremental_segmatch
