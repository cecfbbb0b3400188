/// \file
/// Robot side: scan and pose to changed, described segments (METHOD 0 to 4).
#pragma once

#include <deque>
#include <limits>
#include <memory>
#include <string>
#include <unordered_map>
#include <vector>

#include "incremental_segmatch/descriptors.hpp"
#include "incremental_segmatch/dynamic_voxel_grid.hpp"
#include "incremental_segmatch/ground_filter.hpp"
#include "incremental_segmatch/incremental_normals.hpp"
#include "incremental_segmatch/incremental_segmenter.hpp"
#include "incremental_segmatch/scan_thinning.hpp"
#include "incremental_segmatch/segment_delta.hpp"
#include "incremental_segmatch/stage_times.hpp"
#include "incremental_segmatch/trail_finder.hpp"
#include "incremental_segmatch/types.hpp"

namespace incremental_segmatch {

/// When a tracked segment's state is worth a view, and what is shown of it.
struct ViewParameters {
  double growth_factor = 1.4;  ///< a new view once the segment has grown by this factor since its last view
  double baseline_m = 10.0;    ///< or once it changed and the sensor is this far from where its last view was taken
  std::size_t shown_points = 100;  ///< points of a view that are kept, for people to look at; 0: none
};

/// Of the robot side.
struct FrontEndParameters {
  GroundFilterParameters ground;    ///< which points are obstacles
  double local_radius_m = 50.0;     ///< of the local map around the sensor, horizontally
  /// Of path, for which something stays in it without being seen: so a place that the robot never goes far from can be
  /// recognised when it comes back.
  double local_path_m = std::numeric_limits<double>::infinity();
  DynamicVoxelGridParameters grid;  ///< of the local map
  Segmentation segmentation = Segmentation::kEuclidean;  ///< the growing policy
  SegmenterParameters segmenter;    ///< voxels to segments
  NormalsParameters normals;        ///< kSmoothness: of the voxels
  SmoothnessParameters smoothness;  ///< kSmoothness: which neighbours belong together
  DescriptorParameters descriptor;  ///< features of a segment
  ViewParameters view;              ///< when a view is kept
  ScanThinningParameters thinning;  ///< of the scan that goes along, for refinement
  TrailParameters trails;           ///< which segments are trails of moving objects
};

/// The robot side's part of the funnel.
struct FrontEndCounts {
  std::size_t points = 0;             ///< of the scan
  std::size_t obstacle_points = 0;    ///< that passed the ground filter
  std::size_t dropped_nonfinite = 0;  ///< points with NaN or infinity
  std::size_t dropped_outside = 0;    ///< outside the volume that the grid covers
  std::size_t voxels = 0;             ///< active in the local map
  std::size_t activated_voxels = 0;   ///< that got enough points in this step
  std::size_t moved_voxels = 0;       ///< whose centroid moved in this step
  std::size_t removed_voxels = 0;     ///< that left the local map in this step
  ClusterCounts clusters;             ///< what the voxels form
};

/// What came of one scan.
struct FrontEndStep {
  SegmentDelta delta;     ///< what changed
  FrontEndCounts counts;  ///< the funnel
  StageTimes times;       ///< of this step
  Points obstacles_sensor;  ///< of the scan, what passed the ground filter; in the sensor's frame (m)
};

/// A point of the local map with the segment it belongs to (kNoSegment if none): for people to look at.
struct LocalPoint {
  Eigen::Vector3f position_odom;  ///< in odom (m)
  SegmentId segment;              ///< that it belongs to, or kNoSegment
};

/// One robot's local map. Synchronous; not thread-safe.
class FrontEnd {
 public:
  /// Throws std::invalid_argument naming the parameter that is out of range.
  FrontEnd(const FrontEndParameters& parameters, std::string robot);
  FrontEnd(const FrontEnd&) = delete;  // the segmenter refers to the grid
  FrontEnd& operator=(const FrontEnd&) = delete;

  /// Takes one scan. Throws std::invalid_argument if its stamp is not after the last one's or its pose is not finite:
  /// nothing has changed then.
  FrontEndStep Process(const Scan& scan);

  /// The odometry frame jumped (a correction by the SLAM stack): local cloud and segments move along, and tracking goes
  /// on. O(1) for the cloud; the next delta reports every tracked segment as changed, and all deltas from then on the
  /// jump, so that the map side knows that nothing has moved.
  void ApplyJump(const Pose& T_new_old);

  /// Changes what may change between two scans; the other parameters hold for life. Throws std::invalid_argument
  /// naming the parameter that is out of range: nothing has changed then.
  void ChangeParameters(const GroundFilterParameters& ground, double local_radius_m, const ViewParameters& view);

  /// Every tracked segment, as a delta with full_state set, with the sequence number of the last delta.
  SegmentDelta FullState() const;

  /// The local map's points. O(local cloud).
  std::vector<LocalPoint> LocalCloud() const;

  /// Name of the robot.
  const std::string& robot() const { return robot_; }
  /// As given to the constructor, or changed since.
  const FrontEndParameters& parameters() const { return parameters_; }
  /// Which features the descriptors have.
  const Describer& describer() const { return describer_; }
  /// Memory held, about. O(1).
  std::size_t memory_bytes() const;

 private:
  struct Tracked {
    std::uint32_t view_size = 0;
    Eigen::Vector3d view_position_odom = Eigen::Vector3d::Zero();
  };

  SegmentDelta DescribeChanges(const SegmentUpdate& left, const SegmentUpdate& grown);
  Surroundings AllSegments() const;
  SegmentState DescribeSegment(SegmentId segment, const Surroundings& surroundings) const;
  bool IsNewView(const SegmentState& state);
  void ShowViews(const std::vector<VoxelHandle>& voxels, SegmentDelta* delta) const;
  SegmentDelta EmptyDelta() const;
  std::uint32_t OldestInsertion();

  FrontEndParameters parameters_;
  std::string robot_;
  GroundFilter ground_filter_;
  DynamicVoxelGrid grid_;
  std::unique_ptr<IncrementalNormals> normals_;  // only where the growing policy reads them
  std::unique_ptr<Segmenter> segmenter_;
  TrailFinder trail_finder_;
  Describer describer_;
  std::unordered_map<SegmentId, Tracked> tracked_;
  std::uint64_t sequence_ = 0;
  bool started_ = false;
  bool jumped_ = false;
  Pose T_odom_continuous_ = Pose::Identity();
  StampNs last_stamp_ns_ = 0;
  Pose last_T_odom_sensor_ = Pose::Identity();
  double path_m_ = 0.0;
  std::deque<double> insertion_path_m_;  // of the scans that count for local_path_m, the grid's last insertions
};

}  // namespace incremental_segmatch
