/// \file
/// What the robot side tells the map side: changed, described segments.
#pragma once

#include <memory>
#include <string>
#include <vector>

#include "incremental_segmatch/descriptors.hpp"
#include "incremental_segmatch/incremental_segmenter.hpp"
#include "incremental_segmatch/types.hpp"

namespace incremental_segmatch {

/// Every how many of a segment's points one is shown, so that at most `shown_points` (> 0) are.
inline std::size_t ShownStride(std::size_t points, std::size_t shown_points) {
  return (points + shown_points - 1) / shown_points;
}

/// A segment as it is now.
struct SegmentState {
  SegmentId id = kNoSegment;                                ///< unique per robot, never reused
  std::uint32_t size = 0;                                   ///< voxels, those that left the local map included
  Eigen::Vector3d centroid_odom = Eigen::Vector3d::Zero();  ///< mean of its voxels' centroids (m)
  Descriptor descriptor;                                    ///< unscaled
  bool new_view = false;  ///< worth keeping as a view: it grew, or is seen from elsewhere
  /// With new_view: some of the points that were seen of it, for people to look at (recognitions are refined on scans).
  /// Relative to centroid_odom, odom's axes; may be null.
  std::shared_ptr<const Points> points_centroid;
};

/// One step of one robot. Deltas of a robot have consecutive sequence numbers; a full state replaces all that was said
/// before.
struct SegmentDelta {
  std::string robot;                      ///< name of the robot
  std::uint64_t sequence = 0;             ///< consecutive
  StampNs stamp_ns = 0;                   ///< of the scan
  Pose T_odom_sensor = Pose::Identity();  ///< where the sensor was
  /// All jumps of odom so far: the pose of the frame that odom would be without them. The identity where it never
  /// jumps. A sum and not the last one, so that none is lost with a delta.
  Pose T_odom_continuous = Pose::Identity();
  std::shared_ptr<const Points> scan_sensor;  ///< the scan, thinned (see ThinScan), sensor frame; may be null
  bool full_state = false;                ///< `changed` holds every tracked segment, and replaces all said before
  std::vector<SegmentState> changed;      ///< ascending IDs
  std::vector<RenamedSegment> renamed;    ///< merged segments
  std::vector<RetiredSegment> retired;    ///< segments that ended
};

}  // namespace incremental_segmatch
