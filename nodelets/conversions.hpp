/// \file
/// ROS messages from and to the core's types. All functions are pure. Those that read messages throw
/// std::invalid_argument naming what is wrong with a message that no front end or back end of ours would send.
#pragma once

#include <geometry_msgs/Point.h>
#include <geometry_msgs/Pose.h>
#include <geometry_msgs/PoseWithCovariance.h>
#include <geometry_msgs/TransformStamped.h>
#include <incremental_segmatch/LoopClosure.h>
#include <incremental_segmatch/SegmentArray.h>
#include <incremental_segmatch/StepReport.h>
#include <nav_msgs/Path.h>
#include <ros/time.h>

#include <string>
#include <vector>

#include "incremental_segmatch/back_end.hpp"
#include "incremental_segmatch/front_end.hpp"
#include "incremental_segmatch/segment_delta.hpp"
#include "incremental_segmatch/stage_times.hpp"
#include "incremental_segmatch/types.hpp"

namespace incremental_segmatch {

/// A robot's frames by their tf names, and where its LiDAR sits.
struct RobotFrames {
  std::string odom_frame;
  std::string base_frame;
  std::string sensor_frame;
  Pose T_base_sensor = Pose::Identity();
};

/// The two frames that a loop closure or a trajectory may be about.
enum class FrameKind { kBase, kSensor };

/// A stamp in nanoseconds.
StampNs ToStampNs(const ros::Time& stamp);
/// A stamp as ROS time, which begins at 0: throws std::invalid_argument before that.
ros::Time ToTime(StampNs stamp_ns);

geometry_msgs::Point ToPoint(const Eigen::Vector3d& point);
Eigen::Vector3d ToVector(const geometry_msgs::Point& point);

geometry_msgs::Pose ToPoseMsg(const Pose& T);
geometry_msgs::TransformStamped ToTransform(const Pose& T_parent_child, const std::string& parent,
                                            const std::string& child, const ros::Time& stamp);
/// Normalises the quaternion. Throws std::invalid_argument if it is far from unit length (an unset one, say) or
/// anything is not finite; `what` names the pose in the message.
Pose ToPose(const geometry_msgs::Pose& pose, const std::string& what);
Pose ToPose(const geometry_msgs::Transform& transform, const std::string& what);

geometry_msgs::PoseWithCovariance ToPoseWithCovariance(const Pose& T, const Covariance6& covariance);
Covariance6 ToCovariance(const geometry_msgs::PoseWithCovariance& pose);

/// Covariance of a pose's position and orientation about the parent's axes, as geometry_msgs has it for a pose in a
/// map, from that of a perturbation on the right, T_parent_child exp(xi).
Covariance6 RightPerturbationToParentAxes(const Covariance6& covariance, const Pose& T_parent_child);

/// A delta as a message. Points are quantised to `point_unit_m`, or coarser where a segment is too large for 16 bits;
/// without `with_points` none are sent. O(segments + points of new views).
SegmentArray ToSegmentArray(const SegmentDelta& delta, const RobotFrames& frames, std::uint64_t session,
                            double point_unit_m, bool with_points);

/// A message as a delta, under the given name of the robot. O(message).
SegmentDelta ToSegmentDelta(const SegmentArray& message, const std::string& robot);

/// Pose of the sensor in the frame that odometry would be without its jumps: what a graph of odometry edges needs.
Pose ContinuousSensorPose(const SegmentArray& message);

/// Frames of the robot that sent a message.
RobotFrames ToRobotFrames(const SegmentArray& message);

/// A closure as a message, between base frames or between the sensors. `map` names the robots of its matches.
LoopClosure ToLoopClosure(const Closure& closure, FrameKind frame_kind, const RobotFrames& query,
                          const RobotFrames& target, const TargetMap& map);

/// What a pose graph over sensor poses takes of a closure.
struct SensorClosure {
  Pose T_target_query = Pose::Identity();
  Covariance6 covariance = Covariance6::Identity();  ///< perturbation on the right
};

/// A closure's relative pose between the two sensors. `query` and `target` give T_base_sensor.
SensorClosure ToSensorClosure(const LoopClosure& message, const RobotFrames& query, const RobotFrames& target);

/// A trajectory of sensor poses as a path of base or sensor poses in `frame`.
nav_msgs::Path ToPath(const std::vector<StampedPose>& trajectory, FrameKind frame_kind, const RobotFrames& robot,
                      const std::string& frame, const ros::Time& stamp);
/// A base or sensor pose as a sensor pose; `name` of the input for the error. Throws std::invalid_argument as ToPose does.
Pose ToSensorPose(const geometry_msgs::Pose& pose, const std::string& name, FrameKind frame_kind,
                  const RobotFrames& robot);
/// A path back to sensor poses.
std::vector<StampedPose> ToTrajectory(const nav_msgs::Path& path, FrameKind frame_kind, const RobotFrames& robot);

/// Names and values of a step's funnel.
using NamedCounts = std::vector<std::pair<std::string, std::size_t>>;
NamedCounts ToNamedCounts(const FrontEndCounts& counts);
NamedCounts ToNamedCounts(const BackEndCounts& counts);

/// What a step did; `header` is that of its delta.
StepReport ToStepReport(const std_msgs::Header& header, const std::string& robot, const StageTimes& times,
                        const NamedCounts& counts, const std::string& end);

}  // namespace incremental_segmatch
