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

/// A segment as it is now.
struct SegmentState {
  SegmentId id = kNoSegment;
  std::uint32_t size = 0;                                        ///< voxels, those that left the local map included
  Eigen::Vector3d centroid_odom = Eigen::Vector3d::Zero();
  Descriptor descriptor;
  bool new_view = false;                                         ///< worth keeping as a view: it grew, or is seen from elsewhere
  std::shared_ptr<const Points> points_centroid;                 ///< with new_view: relative to centroid_odom, odom's axes; may be null
};

/// One step of one robot. Deltas of a robot have consecutive sequence numbers; a full state replaces all that was said before.
struct SegmentDelta {
  std::string robot;
  std::uint64_t sequence = 0;
  StampNs stamp_ns = 0;
  Pose T_odom_sensor = Pose::Identity();
  bool full_state = false;
  std::vector<SegmentState> changed;                             ///< ascending IDs
  std::vector<RenamedSegment> renamed;
  std::vector<RetiredSegment> retired;
};

}  // namespace incremental_segmatch
