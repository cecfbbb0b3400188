/// \file
/// What matching hands to recognition.
#pragma once

#include <Eigen/Core>
#include <vector>

#include "incremental_segmatch/types.hpp"

namespace incremental_segmatch {

/// A local segment that may be the same object as a target segment.
struct Correspondence {
  SegmentKey local;                                           ///< in the local map
  SegmentKey target;                                          ///< in the target map
  Eigen::Vector3d centroid_local = Eigen::Vector3d::Zero();   ///< in the local map's frame (odom), metres
  Eigen::Vector3d centroid_target = Eigen::Vector3d::Zero();  ///< in the target map's frame (map), metres
  float descriptor_distance = 0.f;                            ///< scaled descriptor distance; smaller is more alike
};

/// Correspondences in any order.
using Correspondences = std::vector<Correspondence>;

}  // namespace incremental_segmatch
