/// \file
/// The original, batch SegMatch on PCL: what every speed figure is taken against (METHOD 0, batch mode).
///
/// In a library target of its own, incremental_segmatch_batch; PCL stays inside its .cpp.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <vector>

#include "incremental_segmatch/correspondence.hpp"
#include "incremental_segmatch/descriptors.hpp"
#include "incremental_segmatch/growing_policies.hpp"
#include "incremental_segmatch/stage_times.hpp"
#include "incremental_segmatch/types.hpp"

namespace incremental_segmatch {

/// Of all stages.
struct BatchBaselineParameters {
  /// How voxels are grouped: pcl::EuclideanClusterExtraction, or pcl::NormalEstimation and pcl::RegionGrowing.
  Segmentation segmentation = Segmentation::kEuclidean;
  double local_radius_m = 50.0;          ///< of the local map around the sensor, horizontally
  double resolution_m = 0.1;             ///< side of a voxel
  int min_points_per_voxel = 1;          ///< of the points and former centroids that fall into it
  double growing_radius_m = 0.2;         ///< of Euclidean clustering
  std::size_t min_cluster_size = 100;    ///< voxels; smaller clusters are no segments
  std::size_t max_cluster_size = 15000;  ///< voxels; larger clusters are no segments
  double normal_radius_m = 0.3;          ///< neighbourhood of a normal
  int region_neighbours = 30;            ///< pcl::RegionGrowing grows to this many nearest neighbours
  SmoothnessParameters smoothness;       ///< which neighbours belong to a region
  double epsilon_m = 0.4;                ///< by how much distances in a consistent set may differ
  std::size_t min_consistent = 6;        ///< size of the smallest consistent set that is a recognition
  DescriptorParameters descriptor;       ///< features of a segment
};

/// A point's normal and curvature (2.2); NaN where the neighbourhood has fewer than three points.
struct BatchNormal {
  Eigen::Vector3f normal_odom;  ///< unit length, in odom
  float curvature;              ///< smallest eigenvalue over their sum
};

using BatchClusters = std::vector<std::vector<std::int32_t>>;  ///< indices into the local cloud

/// What recognition found: the largest group of pcl::GeometricConsistencyGrouping.
struct BatchRecognition {
  Pose T_target_local = Pose::Identity();  ///< p_map = T * p_odom
  Correspondences inliers;                 ///< the group
};

/// A described segment of a batch step; it has no identity from step to step.
struct BatchSegment {
  std::vector<std::int32_t> cluster;                        ///< its points, as indices into the local cloud
  Eigen::Vector3d centroid_odom = Eigen::Vector3d::Zero();  ///< mean of its voxels' centroids (m)
  Descriptor descriptor;                                    ///< unscaled
};

/// What came of one scan.
struct BatchStep {
  std::size_t voxels = 0;              ///< in the local map
  std::vector<BatchSegment> segments;  ///< of the local map
  StageTimes times;                    ///< voxel_grid, tree, (normals,) segmentation, description
};

/// One robot's local map, processed as a whole in every step: voxel grid over filtered cloud and new points, k-d tree,
/// normals, clusters. The tree is built once a step and shared by all stages. Cost of a step: O(n log n) in the local
/// cloud. Clouds are float in the odometry frame, as PCL's are: accuracy goes with the distance from its origin. Not
/// thread-safe.
class BatchBaseline {
 public:
  /// Throws std::invalid_argument naming the parameter that is out of range.
  explicit BatchBaseline(const BatchBaselineParameters& parameters);
  ~BatchBaseline();
  /// Moves; what was moved from can only be assigned to or destroyed.
  BatchBaseline(BatchBaseline&&) noexcept;
  /// Moves likewise.
  BatchBaseline& operator=(BatchBaseline&&) noexcept;

  /// As given to the constructor.
  const BatchBaselineParameters& parameters() const;

  /// A whole step on obstacle points (finite, without ground): all stages below up to segmentation, and a description
  /// of every segment.
  BatchStep Process(const Points& obstacles_sensor, const Pose& T_odom_sensor);

  /// Crop of the local cloud to the radius, then pcl::VoxelGrid over it and the new points.
  void UpdateLocalCloud(const Points& obstacles_sensor, const Pose& T_odom_sensor);
  /// The k-d tree that the stages below share.
  void BuildTree();
  /// pcl::NormalEstimation. Builds the tree if there is none for this cloud yet, as do the following.
  void EstimateNormals();
  /// pcl::EuclideanClusterExtraction: clusters of min_cluster_size to max_cluster_size points.
  BatchClusters ClusterEuclidean();
  /// pcl::RegionGrowing, after EstimateNormals (throws std::logic_error otherwise).
  BatchClusters GrowSmoothRegions();
  /// pcl::GeometricConsistencyGrouping; nothing if no group has min_consistent correspondences.
  std::optional<BatchRecognition> Recognize(const Correspondences& correspondences) const;

  /// Forgets the local cloud and starts from these centroids, so that a stage can be run on another's cloud.
  void SetLocalCloud(const Points& centroids_odom, const Eigen::Vector3d& sensor_odom);

  std::size_t size() const;                  ///< points of the local cloud
  Points LocalCloud() const;                 ///< in the odometry frame
  std::vector<BatchNormal> Normals() const;  ///< of LocalCloud(); empty before EstimateNormals

 private:
  class Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace incremental_segmatch
