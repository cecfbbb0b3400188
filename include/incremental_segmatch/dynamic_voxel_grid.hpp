/// \file
/// Dynamic voxel grid (METHOD 1; thesis 3.1): incremental downsampling with stable handles and neighbours from the grid
/// itself.
#pragma once

#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <vector>

#include "incremental_segmatch/paged_array.hpp"
#include "incremental_segmatch/types.hpp"

namespace incremental_segmatch {

/// Of the grid.
struct DynamicVoxelGridParameters {
  double resolution_m = 0.1;                      ///< side of a voxel
  int min_points_per_voxel = 1;                   ///< a voxel is active, and goes downstream, from this many points on
  std::array<int, 3> bits{21, 21, 21};            ///< of the index, per axis (3.1); 21 bits of 0.1 m span 209 km
  std::array<double, 3> center_m{0.0, 0.0, 0.0};  ///< o of (3.3): centre of the covered volume, in the grid's frame
};

/// A voxel whose centroid moved; DynamicVoxelGrid::CentroidInBlock has it as it is now.
struct MovedVoxel {
  VoxelHandle voxel = 0;  ///< which voxel
  /// Its centroid before, relative to the corner of its block (DynamicVoxelGrid::BlockCorner) (m).
  Eigen::Vector3f before_block = Eigen::Vector3f::Zero();
};

/// A voxel that left. Its handle is free from the next call of the grid on.
struct RemovedVoxel {
  VoxelHandle voxel = 0;  ///< which voxel; the handle may be given to another one later
  /// Its last centroid, relative to the corner of its block (m).
  Eigen::Vector3f centroid_block = Eigen::Vector3f::Zero();
};

/// What one call changed, among active voxels only; the three lists are disjoint. Apply it to every consumer before the
/// grid is called again: handles of removed voxels are reused then.
struct VoxelUpdate {
  std::vector<VoxelHandle> activated;  ///< reached min_points_per_voxel in this call
  std::vector<MovedVoxel> moved;       ///< were active before, and got points
  std::vector<RemovedVoxel> removed;   ///< were active and are gone
  std::size_t dropped_nonfinite = 0;   ///< points with a NaN or infinite coordinate
  std::size_t dropped_outside = 0;     ///< points outside the covered volume
};

/// Cells of the neighbourhood of a radius, prepared once: for each of the 64 cells of a block, which neighbouring
/// blocks to visit and which of their cells can hold a point within the radius.
class NeighbourStencil {
 public:
  /// Throws std::invalid_argument unless 0 < radius_m <= 16 resolution_m.
  NeighbourStencil(double radius_m, double resolution_m);

  /// A block to look into, and which of its cells.
  struct BlockVisit {
    std::array<std::int8_t, 3> offset{};  ///< in blocks
    std::uint64_t cells = 0;              ///< candidates within that block
  };
  /// Of a cell of a block (0 to 63): the blocks that hold cells within the radius.
  struct Neighbourhood {
    std::uint32_t links = 0;              ///< which of adjacent, by the indices of their links
    std::array<BlockVisit, 27> adjacent;  ///< those next to the block, and itself, by link
    std::vector<BlockVisit> farther;      ///< those that must be looked up
  };
  /// Around a cell.
  const Neighbourhood& around(unsigned cell) const { return around_[cell]; }
  /// The radius.
  double radius_m() const { return radius_m_; }

 private:
  double radius_m_;
  std::array<Neighbourhood, 64> around_;
};

/// Voxels in blocks of 4 x 4 x 4 cells, the blocks in a hash map with links to their 26 neighbours. A voxel's handle is
/// block slot * 64 + cell: stable for the voxel's life. Centroids are stored in float relative to their block, so that
/// accuracy does not depend on the distance from the origin.
///
/// Everything is kept in the grid's own frame; T_odom_grid (T_g of the thesis) maps it to the world, so that a rigid
/// transform of the whole grid (3.1.4) is one matrix product, and a later point still finds its voxel.
///
/// Cost: Insert is O(points), RemoveOutside O(removed + blocks at the boundary), with an oldest insertion O(removed +
/// blocks), Transform O(1), neighbours O(voxels in the stencil). Not thread-safe.
class DynamicVoxelGrid {
 public:
  static constexpr int kBlockSide = 4;               ///< cells along a block's side
  static constexpr VoxelHandle kCellsPerBlock = 64;  ///< 4 x 4 x 4

  /// Throws std::invalid_argument naming the parameter that is out of range.
  explicit DynamicVoxelGrid(const DynamicVoxelGridParameters& parameters);
  ~DynamicVoxelGrid();
  /// Moves; what was moved from can only be assigned to or destroyed.
  DynamicVoxelGrid(DynamicVoxelGrid&&) noexcept;
  /// Moves likewise.
  DynamicVoxelGrid& operator=(DynamicVoxelGrid&&) noexcept;

  /// Inserts points (3.2-3.4): c <- (n c + sum p) / (n + m), n <- n + m. Points that are not finite or lie outside the
  /// covered volume are dropped and counted.
  VoxelUpdate Insert(const Points& points_sensor, const Pose& T_odom_sensor);

  /// Removes whole voxels whose centroid is farther than the radius from the centre, measured in the grid's x-y plane,
  /// and whole blocks that got no point from the call of Insert on that is counted as oldest_insertion (0: none).
  VoxelUpdate RemoveOutside(const Eigen::Vector3d& center_odom, double radius_m, std::uint32_t oldest_insertion = 0);

  /// Rigid transform of everything: T_g <- T_new_old T_g.
  void Transform(const Pose& T_new_old) { T_odom_grid_ = T_new_old * T_odom_grid_; }

  /// Pose of the grid's own frame in odom.
  const Pose& T_odom_grid() const { return T_odom_grid_; }
  /// As given to the constructor.
  const DynamicVoxelGridParameters& parameters() const { return parameters_; }
  /// How often Insert was called; the last call is counted by this number. O(1).
  std::uint32_t insertions() const { return insertions_; }
  /// Voxels with enough points. O(1).
  std::size_t active_voxels() const { return active_voxels_; }
  /// Voxels with any point. O(1).
  std::size_t occupied_voxels() const { return occupied_voxels_; }
  /// One more than the largest handle that was ever given out: the size of a consumer's array over handles.
  std::size_t handle_capacity() const;
  /// Bytes held by the grid.
  std::size_t memory_bytes() const;

  /// True if the voxel has enough points. O(1).
  bool IsActive(VoxelHandle voxel) const;
  /// Points in a voxel. O(1).
  std::uint32_t PointCount(VoxelHandle voxel) const;
  /// Lower corner of the block that the voxel belongs to, in the grid's frame (exact multiples of 4 cells).
  Eigen::Vector3d BlockCorner(VoxelHandle voxel) const {
    const std::array<std::int32_t, 3>& c = blocks_[voxel / kCellsPerBlock].coordinates;
    const double side_m = kBlockSide * parameters_.resolution_m;
    return {c[0] * side_m + parameters_.center_m[0], c[1] * side_m + parameters_.center_m[1],
            c[2] * side_m + parameters_.center_m[2]};
  }
  /// Centroid relative to BlockCorner.
  const Eigen::Vector3f& CentroidInBlock(VoxelHandle voxel) const { return VoxelAt(voxel).centroid_block; }
  /// Centroid in the grid's frame.
  Eigen::Vector3d CentroidGrid(VoxelHandle voxel) const {
    return BlockCorner(voxel) + CentroidInBlock(voxel).cast<double>();
  }
  /// Centroid in odom (m). O(1).
  Eigen::Vector3d CentroidOdom(VoxelHandle voxel) const { return T_odom_grid_ * CentroidGrid(voxel); }

  /// Handles of all active voxels, block by block. O(local cloud): for inspection, not for a step.
  std::vector<VoxelHandle> ActiveVoxels() const;

  /// Calls visit(neighbour, difference) for each active voxel other than this one whose centroid lies within the
  /// stencil's radius; difference = centroid of the neighbour minus this voxel's. visit returns false to stop.
  template <class Visit>
  void ForEachNeighbour(const NeighbourStencil& stencil, VoxelHandle voxel, Visit&& visit) const;

  /// The same a block at a time, for consumers that can settle many voxels at once: calls visit(slot, cells, shift) for
  /// each block that may hold neighbours. Handles are slot * kCellsPerBlock + cell for the set bits of cells (active
  /// voxels, this one included); CentroidInBlock(handle) + shift is the difference to this voxel's centroid, still to
  /// be held against the radius.
  template <class Visit>
  void ForEachNeighbourBlock(const NeighbourStencil& stencil, VoxelHandle voxel, Visit&& visit) const;

  /// The blocks themselves, for consumers that keep voxels of their own by handle: calls visit(slot, block_visit) for
  /// each block that the stencil around the voxel reaches; visit returns false to stop. Of a voxel that the last call
  /// removed, it still finds all blocks that stayed.
  template <class Visit>
  void ForEachStencilBlock(const NeighbourStencil& stencil, VoxelHandle voxel, Visit&& visit) const;

 private:
  static constexpr std::uint32_t kNoBlock = 0xffffffffu;
  struct Voxel {
    Eigen::Vector3f centroid_block;
    std::uint32_t count;
  };
  struct alignas(64) Block {
    std::uint64_t occupied = 0;        ///< cells with at least one point
    std::uint64_t active = 0;          ///< cells with at least min_points_per_voxel
    std::uint64_t touched = 0;         ///< cells that got points in the last insertion
    std::uint32_t last_insertion = 0;  ///< that brought points
    std::array<std::int32_t, 3> coordinates{};
    std::uint32_t tile = 0;
    std::uint32_t position_in_tile = 0;
    std::uint32_t linked = 0;  ///< which of its links lead to a block
  };
  using Links = std::array<std::uint32_t, 32>;  ///< to the 26 blocks around and to itself; 27 are used
  class BlockMap;
  class TileMap;

  Voxel& VoxelAt(VoxelHandle voxel) { return voxels_[voxel / kCellsPerBlock][voxel % kCellsPerBlock]; }
  const Voxel& VoxelAt(VoxelHandle voxel) const { return voxels_[voxel / kCellsPerBlock][voxel % kCellsPerBlock]; }
  void SetLink(std::uint32_t slot, int link, std::uint32_t to);
  /// Points in the sensor's frame to cells, relative to the middle of the grid: R p + t.
  struct CellTransform {
    std::array<std::array<double, 3>, 3> R;
    std::array<double, 3> t;
    std::array<double, 3> half_cells;  ///< of the grid, per axis
    float resolution;
  };
  struct Chunk;
  struct Runs;
  CellTransform CellTransformOf(const Pose& T_odom_sensor) const;
  static void Locate(const CellTransform& transform, Chunk* chunk);
  static void CountDropped(const Chunk& chunk, VoxelUpdate* update);
  static void MergeRuns(const Chunk& chunk, Runs* runs);
  void FindBlocks(Runs* runs);
  void AddRuns(const Runs& runs, VoxelUpdate* update);
  void ActivateTouched(VoxelUpdate* update);
  std::uint32_t FindBlock(const std::array<std::int32_t, 3>& coordinates) const;
  std::uint32_t AddBlock(const std::array<std::int32_t, 3>& coordinates);
  void RemoveBlock(std::uint32_t slot);
  void RemoveCells(std::uint32_t slot, std::uint64_t cells, VoxelUpdate* update);
  std::vector<std::uint32_t> TilesAtBoundary(const Eigen::Vector2d& center, double radius_m);

  DynamicVoxelGridParameters parameters_;
  float block_size_m_ = 0.f;
  Pose T_odom_grid_ = Pose::Identity();
  // By slot. A point needs one cache line of the first and one of the third.
  PagedArray<Block> blocks_;
  PagedArray<Links> links_;
  PagedArray<std::array<Voxel, kCellsPerBlock>> voxels_;
  std::uint32_t block_slots_ = 0;  ///< slots ever used
  std::vector<std::uint32_t> free_blocks_;
  std::unique_ptr<BlockMap> block_map_;
  std::unique_ptr<TileMap> tiles_;
  // Of RemoveOutside: the last circle, and how far its boundary has come inwards at most, over all calls.
  Eigen::Vector2d last_center_ = Eigen::Vector2d::Zero();
  double last_radius_m_ = 0.0;
  double advance_m_ = 0.0;
  std::size_t active_voxels_ = 0;
  std::size_t occupied_voxels_ = 0;
  std::size_t last_moved_ = 0;  ///< in the last Insert
  std::uint32_t insertions_ = 0;
  std::vector<VoxelHandle> touched_inactive_;  ///< work space of Insert
};

template <class Visit>
void DynamicVoxelGrid::ForEachStencilBlock(const NeighbourStencil& stencil, VoxelHandle voxel, Visit&& visit) const {
  const Block& home = blocks_[voxel / kCellsPerBlock];
  const Links& links = links_[voxel / kCellsPerBlock];
  const NeighbourStencil::Neighbourhood& around = stencil.around(voxel % kCellsPerBlock);
  for (std::uint32_t linked = around.links & home.linked; linked != 0; linked &= linked - 1) {
    const int link = __builtin_ctz(linked);
    if (!visit(links[link], around.adjacent[link])) return;
  }
  for (const NeighbourStencil::BlockVisit& at : around.farther) {
    const std::uint32_t slot = FindBlock(
        {home.coordinates[0] + at.offset[0], home.coordinates[1] + at.offset[1], home.coordinates[2] + at.offset[2]});
    if (slot != kNoBlock && !visit(slot, at)) return;
  }
}

template <class Visit>
void DynamicVoxelGrid::ForEachNeighbourBlock(const NeighbourStencil& stencil, VoxelHandle voxel, Visit&& visit) const {
  const Eigen::Vector3f center = CentroidInBlock(voxel);
  ForEachStencilBlock(stencil, voxel, [&](std::uint32_t slot, const NeighbourStencil::BlockVisit& at) {
    const std::uint64_t cells = blocks_[slot].active & at.cells;
    if (cells == 0) return true;
    const Eigen::Vector3f shift(at.offset[0] * block_size_m_ - center.x(), at.offset[1] * block_size_m_ - center.y(),
                                at.offset[2] * block_size_m_ - center.z());
    return visit(slot, cells, shift);
  });
}

template <class Visit>
void DynamicVoxelGrid::ForEachNeighbour(const NeighbourStencil& stencil, VoxelHandle voxel, Visit&& visit) const {
  const float radius2 = static_cast<float>(stencil.radius_m() * stencil.radius_m());
  ForEachNeighbourBlock(stencil, voxel, [&](std::uint32_t slot, std::uint64_t cells, const Eigen::Vector3f& shift) {
    for (; cells != 0; cells &= cells - 1) {
      const VoxelHandle neighbour = slot * kCellsPerBlock + static_cast<VoxelHandle>(__builtin_ctzll(cells));
      const Eigen::Vector3f difference = CentroidInBlock(neighbour) + shift;
      if (difference.squaredNorm() <= radius2 && neighbour != voxel && !visit(neighbour, difference)) return false;
    }
    return true;
  });
}

}  // namespace incremental_segmatch
