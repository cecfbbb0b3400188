/// \file
/// What bag reader and writer share: names and conversions between messages and the core's types.
#pragma once

#include <geometry_msgs/Pose.h>
#include <geometry_msgs/TransformStamped.h>
#include <sensor_msgs/PointCloud2.h>

#include <string>

#include "evaluation/kitti_io.hpp"
#include "incremental_segmatch/types.hpp"

namespace incremental_segmatch {

inline constexpr char kEpochTopic[] = "/segmatch/epoch";

/// A stamp as ROS's time. Throws std::out_of_range before 1970 and after 2106.
inline ros::Time ToRosTime(StampNs stamp_ns) {
  if (stamp_ns < 0 || stamp_ns / 1000000000 > 0xffffffffLL) {
    throw std::out_of_range("the stamp " + std::to_string(stamp_ns) + " ns does not fit into ROS's time");
  }
  return {static_cast<std::uint32_t>(stamp_ns / 1000000000), static_cast<std::uint32_t>(stamp_ns % 1000000000)};
}

inline StampNs ToStampNs(const ros::Time& time) {
  return std::int64_t{time.sec} * 1000000000 + time.nsec;
}

/// Pose as translation and unit quaternion.
geometry_msgs::Pose ToMessage(const Pose& T);

/// A transform message for T_parent_child.
geometry_msgs::TransformStamped ToMessage(const Pose& T_parent_child, const ros::Time& stamp, const std::string& parent,
                                          const std::string& child);

/// Throws std::runtime_error if the quaternion is far from unit length or anything is not finite.
Pose FromMessage(const geometry_msgs::Pose& message);
Pose FromMessage(const geometry_msgs::Transform& message);

/// Points of a cloud whose fields x, y and z are float32 or float64, at any offset and padding. Throws
/// std::runtime_error naming what the cloud has instead.
Points PointsFromMessage(const sensor_msgs::PointCloud2& cloud);

/// A cloud with fields x, y, z, intensity (float32).
sensor_msgs::PointCloud2 CloudMessage(const KittiScan& scan, const ros::Time& stamp, const std::string& frame);

}  // namespace incremental_segmatch
