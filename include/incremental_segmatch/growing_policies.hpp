/// \file
/// Growing policies of the incremental segmenter (METHOD 3; thesis 3.3.5).
#pragma once

#include <cmath>
#include <utility>
#include <vector>

#include "incremental_segmatch/incremental_normals.hpp"
#include "incremental_segmatch/types.hpp"

namespace incremental_segmatch {

/// How voxels are grouped into segments.
enum class Segmentation {
  kEuclidean,  ///< whatever hangs together
  kSmoothness  ///< smooth surfaces; needs normals, which are kept for it alone
};

/// Euclidean clustering: every neighbour within the growing radius belongs to the region.
struct EuclideanPolicy {
  /// Every point may seed and be grown to.
  static constexpr bool kAcceptsAll = true;

  /// Seeds stay in their order.
  void PrepareSeeds(std::vector<VoxelHandle>*) const {}
  /// Whatever is within the radius belongs together.
  bool CanGrowToPoint(VoxelHandle, VoxelHandle) const { return true; }
  /// Any voxel may seed.
  bool CanPointBeSeed(VoxelHandle) const { return true; }
  /// No voxel is flatter than another.
  float Roughness(VoxelHandle) const { return 0.f; }
};

/// What makes a point too rough to grow regions from.
enum class RoughnessMeasure {
  kCurvature,     ///< sigma of (2.2): how thick the neighbourhood is for its width
  kPlaneResidual  ///< root mean square distance of the neighbourhood from its plane, after Rabbani: better on curved
                  ///< surfaces
};

/// When neighbours belong to one surface.
struct SmoothnessParameters {
  double max_angle_rad = 0.14;  ///< between the normals of neighbours in a region, up to pi/2
  RoughnessMeasure measure = RoughnessMeasure::kCurvature;  ///< what is compared with the next two
  double max_curvature = 0.05;                              ///< with kCurvature: a rougher point does not seed
  double max_residual_m = 0.03;                             ///< with kPlaneResidual: a rougher point does not seed
};

/// Smoothness constraints (Rabbani et al.; thesis 3.3.5): regions grow from their flattest points along normals that
/// turn slowly. Points without a normal, or too rough, do not seed, and regions are not linked through them. The
/// normals must have taken in what the segmenter is given, and outlive the policy. Normals are read as they are when a
/// point is clustered; later changes of theirs don't take it out again.
class SmoothnessPolicy {
 public:
  static constexpr bool kAcceptsAll = false;  ///< not every neighbour joins

  /// Throws std::invalid_argument naming the parameter that is out of range.
  SmoothnessPolicy(const SmoothnessParameters& parameters, const IncrementalNormals& normals);

  /// Drops points that may not seed and puts the flattest first; of equals, the lower handle. O(n log n).
  void PrepareSeeds(std::vector<VoxelHandle>* voxels);
  /// Whether the normals of both differ by no more than the angle, whatever their signs: |dot| against a precomputed
  /// cosine.
  bool CanGrowToPoint(VoxelHandle from, VoxelHandle to) const {
    return std::abs(normals_->Estimate(from).normal_grid.dot(normals_->Estimate(to).normal_grid)) >= min_cosine_;
  }
  /// Whether the voxel has a normal and is flat enough.
  bool CanPointBeSeed(VoxelHandle voxel) const { return Roughness(voxel) <= max_roughness_; }
  /// Curvature or plane residual; NaN, which passes no test, without a normal.
  float Roughness(VoxelHandle voxel) const {
    return measure_ == RoughnessMeasure::kCurvature ? normals_->Estimate(voxel).curvature
                                                    : normals_->PlaneResidual(voxel);
  }

 private:
  const IncrementalNormals* normals_;
  RoughnessMeasure measure_;
  float min_cosine_;
  float max_roughness_;
  std::vector<std::pair<float, VoxelHandle>> order_;  // work space
};

}  // namespace incremental_segmatch
