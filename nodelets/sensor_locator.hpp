/// \file
/// Where the LiDAR is at a stamp: from tf, or from the poses of a topic and tf.
#pragma once

#include <geometry_msgs/PoseStamped.h>
#include <nav_msgs/Odometry.h>
#include <ros/time.h>
#include <tf2_ros/buffer.h>
#include <tf2_ros/transform_listener.h>

#include <mutex>
#include <optional>
#include <string>

#include "conversions.hpp"
#include "node_parameters.hpp"
#include "pose_buffer.hpp"

namespace incremental_segmatch {

/// The sensor's pose and frames at a stamp.
struct SensorLocation {
  Pose T_odom_sensor = Pose::Identity();
  Pose T_odom_registered = Pose::Identity();  ///< of the frame in which registered clouds come
  RobotFrames frames;
};

/// A location, or in words why there is none.
struct LocateResult {
  std::optional<SensorLocation> location;
  std::string reason;
};

/// A frame's name as tf2 has it, without the leading slash of older drivers.
std::string FrameName(const std::string& frame);

/// Listens to tf in a thread of its own. All functions may be called from any thread; none blocks.
class SensorLocator {
 public:
  explicit SensorLocator(const FrontEndNodeParameters& parameters);

  /// Takes an odometry message. Throws std::invalid_argument if its pose is no pose.
  void AddOdometry(const nav_msgs::Odometry& odometry);
  /// The same for a pose of base_frame, or of the sensor where there is no base_frame.
  void AddPose(const geometry_msgs::PoseStamped& pose);

  /// Forgets what is known, but static transforms: time has jumped back.
  void Clear();

  /// Where the sensor of this frame is at a stamp, and the frame `registered_frame` (empty: none). Never assumes an
  /// identity for what is not known.
  LocateResult Locate(const ros::Time& stamp, const std::string& sensor_frame,
                      const std::string& registered_frame) const;

 private:
  struct TransformResult {
    std::optional<Pose> T_target_source;
    std::string reason;
  };
  TransformResult LookUp(const std::string& target, const std::string& source, const ros::Time& stamp) const;
  TransformResult LookUpPose(const std::string& sensor_frame, const ros::Time& stamp) const;
  void Add(const StampedPose& pose, const std::string& frame, const std::string& child_frame);
  std::string WhoNames(const std::string& frame) const;
  std::string KnownFrames() const;

  const FrontEndNodeParameters parameters_;
  tf2_ros::Buffer tf_buffer_;
  tf2_ros::TransformListener tf_listener_;
  PoseBuffer poses_;
  mutable std::mutex mutex_;
  std::string pose_frame_;        // of the last message with a pose
  std::string pose_child_frame_;  // likewise
};

}  // namespace incremental_segmatch
