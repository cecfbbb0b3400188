/// \file
/// Waiting for what another process does.
#pragma once

#include <ros/ros.h>

#include <functional>

namespace incremental_segmatch::test {

/// Handles callbacks until the condition holds; false if it does not within the time (wall clock).
inline bool WaitFor(const std::function<bool()>& condition, double timeout_s = 10.0) {
  const ros::WallTime end = ros::WallTime::now() + ros::WallDuration(timeout_s);
  while (ros::ok() && ros::WallTime::now() < end) {
    ros::spinOnce();
    if (condition()) return true;
    ros::WallDuration(0.005).sleep();
  }
  return false;
}

}  // namespace incremental_segmatch::test
