/// \file
/// Incremental normals (METHOD 2; thesis 3.2): normals that follow the voxel grid.
#pragma once

#include <Eigen/Core>
#include <array>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "incremental_segmatch/dynamic_voxel_grid.hpp"
#include "incremental_segmatch/paged_array.hpp"
#include "incremental_segmatch/types.hpp"

namespace incremental_segmatch {

/// Of the neighbourhoods.
struct NormalsParameters {
  double radius_m = 0.3;  ///< of a normal's neighbourhood; up to 8 voxels
  double renewal_tolerance_voxels =
      0.1;  ///< a voxel's contribution is renewed once its centroid moved farther than this
};

/// The accumulators of a voxel: sums over the anchors p of its neighbourhood, itself included, in units of
/// IncrementalNormals::unit_m() relative to the centre of the voxel's own cell. Integers: they never round.
struct NormalAccumulators {
  std::int64_t count = 0;                                                               ///< n
  Eigen::Matrix<std::int64_t, 3, 1> sum{0, 0, 0};                                       ///< b = sum of p
  Eigen::Matrix<std::int64_t, 3, 3> outer = Eigen::Matrix<std::int64_t, 3, 3>::Zero();  ///< A = sum of p pT
};

/// A normal in the grid's frame, of either sign, and the curvature (2.2). NaN while the neighbourhood has fewer than 3
/// voxels.
struct NormalEstimate {
  Eigen::Vector3f normal_grid;  ///< unit length, in the grid's frame
  float curvature;              ///< smallest eigenvalue over their sum
};

/// Unit eigenvector of the smallest eigenvalue of a symmetric positive semidefinite matrix, that eigenvalue, and the
/// trace. Where the two smallest eigenvalues are equal, any of the vectors that qualify.
struct SmallestEigen {
  Eigen::Vector3d vector;  ///< unit length
  double value;            ///< the smallest eigenvalue
  double trace;            ///< sum of the eigenvalues
};
/// The smallest eigenvalue of a symmetric positive semidefinite matrix. O(1).
SmallestEigen SmallestEigenOf(const Eigen::Matrix3d& matrix);

/// Normals of the active voxels of a grid, from the accumulators A, b, n of (3.6) over their neighbourhoods.
///
/// Each voxel has an anchor: its centroid when it was activated, or when it had last moved beyond the tolerance. Two
/// voxels are neighbours iff their anchors lie within the radius. Anchors are rounded to unit_m() (a 512th of a voxel
/// for radii of up to 3.5 voxels) relative to their own cell, so that all sums are integers: accumulators equal the
/// batch sums over the anchors bit for bit after any sequence of calls, in any order, anywhere in the world.
///
/// The thesis scatters every new point into the accumulators of all its neighbours (3.9, 3.10). Here what is new, gone
/// or moved only marks the normals around it as stale, and a stale normal's accumulators are gathered once somebody
/// reads it: most of what changes is read by nobody, and much changes several times before it is read. All is in the
/// grid's frame: after DynamicVoxelGrid::Transform the accumulators of (3.12), A <- R A RT + R b tT + t bT RT + n t tT
/// and b <- n t + R b, and N <- R N are what one gets by expressing them in the new frame, and nothing need be done;
/// NormalOdom rotates when it is read.
///
/// Cost: Insert and Remove O(changed) with the few blocks around each; reading O(1), and O(neighbours) for a stale
/// normal. Not thread-safe, not even for reading. The grid must outlive this object.
class IncrementalNormals {
 public:
  /// Throws std::invalid_argument naming the parameter that is out of range.
  IncrementalNormals(const NormalsParameters& parameters, const DynamicVoxelGrid& grid);

  /// Takes removed voxels out. To be called before the grid is called again.
  void Remove(const std::vector<RemovedVoxel>& removed);

  /// Takes activated voxels in and moves the anchors of those that moved beyond the tolerance.
  void Insert(const VoxelUpdate& update);

  /// Normal and curvature of an active voxel, (3.7), (2.2). O(1), O(neighbours) if it is stale.
  const NormalEstimate& Estimate(VoxelHandle voxel) const;

  /// The same normal in the odometry frame, turned towards the viewpoint. NaN while it is undefined.
  Eigen::Vector3d NormalOdom(VoxelHandle voxel, const Eigen::Vector3d& viewpoint_odom) const;

  /// Root mean square distance in metres of the neighbourhood from its plane (Rabbani's residual). NaN with fewer than
  /// 3 voxels. O(1), O(neighbours) if it is stale.
  float PlaneResidual(VoxelHandle voxel) const;

  /// Accumulators of an active voxel. O(neighbours).
  NormalAccumulators Accumulators(VoxelHandle voxel) const;
  /// Position of an active voxel's anchor relative to the centre of its cell, in units of unit_m(): integers.
  Eigen::Vector3i Anchor(VoxelHandle voxel) const;

  /// Unit of the accumulators (m).
  double unit_m() const { return unit_m_; }
  /// As given to the constructor.
  const NormalsParameters& parameters() const { return parameters_; }
  /// Memory held, about. O(1).
  std::size_t memory_bytes() const { return blocks_.memory_bytes() + masks_.capacity() * sizeof(Masks); }

 private:
  // Positions are in units, integers throughout. Anchors are relative to their block's corner, accumulators to their
  // cell's centre.
  using Position = Eigen::Array3i;
  using PackedPosition = std::array<std::int16_t, 4>;  // x, y, z, 1
  struct alignas(64) Block {
    std::array<PackedPosition, DynamicVoxelGrid::kCellsPerBlock> anchors;  // eight of them share a cache line
    std::array<NormalEstimate, DynamicVoxelGrid::kCellsPerBlock> estimates;
    std::array<float, DynamicVoxelGrid::kCellsPerBlock> residuals_m;
  };
  struct Masks {
    std::uint64_t anchored = 0;  // cells whose voxels are active
    std::uint64_t stale = 0;     // at least those of them whose estimate is older than their accumulators
  };
  // Sums over a neighbourhood.
  struct Moments {
    Eigen::Array4i sum = Eigen::Array4i::Zero();       // of x, y, z, 1
    Eigen::Array4i squares = Eigen::Array4i::Zero();   // of x x, y y, z z, 1
    Eigen::Array4i products = Eigen::Array4i::Zero();  // of x y, y z, z x, 1
  };

  bool IsAnchored(VoxelHandle voxel) const;
  Position CellCenter(VoxelHandle voxel) const;
  Position PositionOf(VoxelHandle voxel, const Eigen::Vector3f& in_block) const;
  Position AnchorInBlock(VoxelHandle voxel) const;
  void SetAnchor(VoxelHandle voxel, const Position& position);
  void MarkStaleAround(VoxelHandle voxel);
  void RefuseUnanchored(VoxelHandle voxel) const;
  void Refresh(VoxelHandle voxel) const;
  void AddWithinRadius(const Block& block, std::uint64_t cells, const Position& around, const Position& origin,
                       Moments* moments) const;
  Moments Gather(VoxelHandle voxel) const;
  static std::uint64_t CellBit(VoxelHandle voxel) {
    return std::uint64_t{1} << (voxel % DynamicVoxelGrid::kCellsPerBlock);
  }

  NormalsParameters parameters_;
  const DynamicVoxelGrid* grid_;
  NeighbourStencil stencil_;
  double unit_m_ = 0.0;
  int units_per_cell_ = 0;
  float units_per_m_ = 0.f;
  int radius2_units_ = 0;
  float tolerance2_units_ = 0.f;
  // Mutable, since normals are computed when they are read.
  mutable PagedArray<Block> blocks_;
  mutable std::vector<Masks> masks_;  // apart from the blocks: most around a voxel have nothing in reach
};

}  // namespace incremental_segmatch
