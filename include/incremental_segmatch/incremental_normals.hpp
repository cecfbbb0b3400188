/// \file
/// Incremental normals (METHOD 2; thesis 3.2): covariance accumulators that follow the voxel grid.
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

/// Keeps the accumulators A, b, n of (3.6) for every active voxel of a grid, by scattering and gathering (3.9, 3.10).
///
/// Each voxel has an anchor: its centroid when it last gave its contribution. Two voxels are neighbours iff their
/// anchors lie within the radius. A voxel that is removed, or whose centroid has moved beyond the tolerance, takes back
/// exactly what it gave, from exactly those that got it. Anchors are rounded to unit_m() (a 512th of a voxel for radii
/// of up to 3.5 voxels) relative to their own cell, so that all sums are integers: accumulators equal the batch sums
/// over the anchors bit for bit after any sequence of calls, in any order, anywhere in the world.
///
/// Contributions are renewed when somebody reads accumulators that they may reach, and not before: most of what moves is
/// read by nobody. Whoever reads finds all anchors around within the tolerance of their centroids. Normals are computed
/// when they are read, and kept until an accumulator changes. All is in the grid's frame: after
/// DynamicVoxelGrid::Transform the accumulators of (3.12), A <- R A RT + R b tT + t bT RT + n t tT and b <- n t + R b,
/// and N <- R N are what one gets by expressing them in the new frame, and nothing need be done; NormalOdom rotates
/// when it is read.
///
/// Cost: Insert O(activated * neighbours + moved), reading O(renewed * neighbours) more, Remove O(removed * neighbours). Not thread-safe, not
/// even for reading. The grid must outlive this object.
class IncrementalNormals {
 public:
  /// Throws std::invalid_argument naming the parameter that is out of range.
  IncrementalNormals(const NormalsParameters& parameters, const DynamicVoxelGrid& grid);

  /// Withdraws what removed voxels gave. To be called before the grid is called again.
  void Remove(const std::vector<RemovedVoxel>& removed);

  /// Takes activated voxels in and renews the contributions of those that moved beyond the tolerance.
  void Insert(const VoxelUpdate& update);

  /// Normal and curvature of an active voxel: O(1), amortised. (3.7), (2.2).
  const NormalEstimate& Estimate(VoxelHandle voxel) const;

  /// The same normal in the odometry frame, turned towards the viewpoint. NaN while it is undefined.
  Eigen::Vector3d NormalOdom(VoxelHandle voxel, const Eigen::Vector3d& viewpoint_odom) const;

  /// Root mean square distance in metres of the neighbourhood from its plane (Rabbani's residual). NaN with fewer than
  /// 3 voxels.
  double PlaneResidual(VoxelHandle voxel) const;

  /// Accumulators of an active voxel. O(1).
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
  // Positions are in units, integers throughout. Anchors are relative to their block's corner, accumulators to their cell's centre.
  using Lanes = Eigen::Array4f;
  /// A position as (x, y, z, 1) and as (y, z, x, 1): their products with themselves and each other are what the accumulators sum.
  struct Position {
    Lanes xyz1, yzx1;

    Position(float x, float y, float z, float one = 1.f) : xyz1(x, y, z, one), yzx1(y, z, x, one) {}
    Position() : Position(0.f, 0.f, 0.f, 0.f) {}
    Position(const Lanes& a, const Lanes& b) : xyz1(a), yzx1(b) {}
    Position operator-(const Position& other) const { return {xyz1 - other.xyz1, yzx1 - other.yzx1}; }
    Position operator+(const Position& other) const { return {xyz1 + other.xyz1, yzx1 + other.yzx1}; }
  };
  struct Moments {
    Eigen::Array4i squares;   // sums of x x, y y, z z, 1
    Eigen::Array4i products;  // sums of x y, y z, z x, 1
    Eigen::Array4i sum;       // sums of x, y, z, 1
  };
  struct Block {
    std::array<std::array<float, DynamicVoxelGrid::kCellsPerBlock>, 3> anchors;  // x, y, z: rows of four cells at a time
    std::array<Moments, DynamicVoxelGrid::kCellsPerBlock> moments;
    std::array<NormalEstimate, DynamicVoxelGrid::kCellsPerBlock> estimates;

    Position Anchor(unsigned cell) const { return {anchors[0][cell], anchors[1][cell], anchors[2][cell]}; }
  };
  struct Masks {
    std::uint64_t anchored = 0;       // cells whose voxels have given their contribution
    std::uint64_t overdue = 0;        // of them, cells whose contribution is to be renewed before it is read
    std::uint64_t stale = 0;  // cells whose estimate is older than their accumulators
  };
  // A block around the voxel of Replace.
  struct ReachedBlock {
    Position corner;       // relative to the corner of the voxel's block
    std::uint32_t slot;
    std::uint64_t cells;   // that may hold neighbours
    std::uint64_t before;  // that hold neighbours of its anchor
    std::uint64_t after;   // that hold neighbours of its new position
  };

  bool IsAnchored(VoxelHandle voxel) const;
  const Moments& MomentsOf(VoxelHandle voxel) const;
  Position PositionOf(VoxelHandle voxel, const Eigen::Vector3f& in_block) const;
  std::uint64_t CellsWithinRadius(const Block& block, std::uint64_t cells, const Position& position) const;
  template <int kSign>
  static void Accumulate(const Position& p, Moments* moments);
  static void AccumulateMove(const Position& difference, const Position& sum, Moments* moments);
  template <bool kWithdraw, bool kGive>
  void Replace(VoxelHandle voxel, const Position& position) const;
  void RenewAround(VoxelHandle voxel) const;
  void Renew(VoxelHandle voxel) const;
  static std::uint64_t CellBit(VoxelHandle voxel) {
    return std::uint64_t{1} << (voxel % DynamicVoxelGrid::kCellsPerBlock);
  }
  Eigen::Matrix3d CovarianceOf(const Moments& moments) const;
  NormalEstimate Compute(const Moments& moments) const;

  NormalsParameters parameters_;
  const DynamicVoxelGrid* grid_;
  NeighbourStencil stencil_;
  double unit_m_ = 0.0;
  int units_per_cell_ = 0;
  float units_per_m_ = 0.f;
  std::array<Position, DynamicVoxelGrid::kCellsPerBlock> cell_centers_;  // relative to the block's corner; last lane 0
  float radius2_units_ = 0.f;
  float tolerance2_units_ = 0.f;
  // Mutable, since contributions are renewed when they are read.
  mutable PagedArray<Block> blocks_;
  mutable std::vector<Masks> masks_;           // apart from the blocks: most around a voxel have nothing in reach
  mutable std::vector<ReachedBlock> reached_;  // work space of Replace
  mutable std::vector<VoxelHandle> renewing_;  // work space of RenewAround
  std::vector<VoxelHandle> leaving_;           // work space of Remove
};

}  // namespace incremental_segmatch
