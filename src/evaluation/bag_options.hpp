/// \file
/// What to read from and write to ROS bags; no ROS in it, so that command lines are the same everywhere.
#pragma once

#include <cstddef>
#include <cstdint>
#include <string>

namespace incremental_segmatch {

/// What to read from a bag. Empty names are found out from the bag where only one answer is possible.
struct BagDriveOptions {
  std::string path;
  std::string cloud_topic;     ///< empty: the only sensor_msgs/PointCloud2 topic
  std::string odometry_topic;  ///< nav_msgs/Odometry; empty: odometry comes from tf
  std::string odometry_frame;  ///< for tf; empty: odom if tf has it, else world
  std::string ground_truth_topic =
      "/ground_truth";  ///< nav_msgs/Odometry or geometry_msgs/PoseStamped; absent: no truth
};

/// Which topics and frames a bag is to have.
enum class BagStyle {
  kKitti2Bag,       ///< /kitti/velo/pointcloud in velo_link; tf world -> base_link -> imu_link -> velo_link
  kVelodynePoints,  ///< /velodyne_points in velodyne; tf world -> velodyne
};

/// How to write a bag.
struct BagWriterOptions {
  std::string path;
  BagStyle style = BagStyle::kKitti2Bag;
  std::int64_t epoch_s = 1317000000;  ///< added to all stamps, since a bag refuses time 0; recorded on /segmatch/epoch
  std::size_t max_scans = 0;          ///< 0: all
};

}  // namespace incremental_segmatch
