#include "sensor_locator.hpp"

#include <tf2/exceptions.h>

#include <sstream>
#include <vector>

namespace incremental_segmatch {
namespace {

constexpr double kKeepPoses_s = 30.0;

std::string Text(const ros::Time& stamp) {
  std::ostringstream text;
  text << stamp;
  return text.str();
}

}  // namespace

std::string FrameName(const std::string& frame) {
  return !frame.empty() && frame.front() == '/' ? frame.substr(1) : frame;
}

SensorLocator::SensorLocator(const FrontEndNodeParameters& parameters)
    : parameters_(parameters),
      tf_buffer_(ros::Duration(kKeepPoses_s)),
      tf_listener_(tf_buffer_),
      poses_(kKeepPoses_s, parameters.odometry_max_gap_s) {}

void SensorLocator::AddOdometry(const nav_msgs::Odometry& odometry) {
  Add({ToStampNs(odometry.header.stamp), ToPose(odometry.pose.pose, "odometry")}, odometry.header.frame_id,
      odometry.child_frame_id);
}

void SensorLocator::AddPose(const geometry_msgs::PoseStamped& pose) {
  Add({ToStampNs(pose.header.stamp), ToPose(pose.pose, "pose")}, pose.header.frame_id, "");
}

void SensorLocator::Add(const StampedPose& pose, const std::string& frame, const std::string& child_frame) {
  poses_.Add(pose);
  const std::lock_guard<std::mutex> lock(mutex_);
  pose_frame_ = FrameName(frame);
  pose_child_frame_ = FrameName(child_frame);
}

void SensorLocator::Clear() {
  tf_buffer_.clear();
  poses_.Clear();
}

LocateResult SensorLocator::Locate(const ros::Time& stamp, const std::string& sensor_frame,
                                   const std::string& registered_frame) const {
  const std::string odom_frame = FrameName(parameters_.odom_frame);
  const std::string base_frame = parameters_.base_frame.empty() ? sensor_frame : FrameName(parameters_.base_frame);
  const TransformResult odom_sensor = parameters_.pose_source == PoseSource::kTf
                                          ? LookUp(odom_frame, sensor_frame, stamp)
                                          : LookUpPose(sensor_frame, stamp);
  if (!odom_sensor.T_target_source) return {std::nullopt, odom_sensor.reason};
  const TransformResult base_sensor = LookUp(base_frame, sensor_frame, stamp);
  if (!base_sensor.T_target_source)
    return {std::nullopt,
            base_sensor.reason + " (where the robot has no other frame, set base_frame to " + sensor_frame + ", too)"};
  const TransformResult odom_registered =
      LookUp(odom_frame, registered_frame.empty() ? odom_frame : registered_frame, stamp);
  if (!odom_registered.T_target_source)
    return {std::nullopt, "registered clouds come in frame " + registered_frame + ", but odom_frame is " + odom_frame +
                              ", and there is " + odom_registered.reason};
  return {SensorLocation{*odom_sensor.T_target_source,
                         *odom_registered.T_target_source,
                         {odom_frame, base_frame, sensor_frame, *base_sensor.T_target_source}},
          ""};
}

SensorLocator::TransformResult SensorLocator::LookUp(const std::string& target, const std::string& source,
                                                     const ros::Time& stamp) const {
  if (target == source) return {Pose::Identity(), ""};
  const std::string failed = "no tf from " + target + " to " + source + " at " + Text(stamp) + ": ";
  for (const std::string& frame : {target, source})
    if (!tf_buffer_._frameExists(frame))
      return {std::nullopt, failed + "there is no frame " + frame + WhoNames(frame) + "; " + KnownFrames()};
  try {
    return {ToPose(tf_buffer_.lookupTransform(target, source, stamp).transform, "tf"), ""};
  } catch (const tf2::TransformException& error) {
    return {std::nullopt, failed + error.what() + "; " + KnownFrames()};
  }
}

/// The pose of a topic, from its frame into odom_frame, and from what it is a pose of to the sensor.
SensorLocator::TransformResult SensorLocator::LookUpPose(const std::string& sensor_frame,
                                                         const ros::Time& stamp) const {
  const std::string topic = parameters_.pose_source == PoseSource::kOdometry ? "odometry" : "pose";
  const std::string odom_frame = FrameName(parameters_.odom_frame);
  std::string frame;
  std::string child_frame;
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    frame = pose_frame_;
    child_frame = pose_child_frame_.empty() ? FrameName(parameters_.base_frame) : pose_child_frame_;
  }
  if (child_frame.empty()) child_frame = sensor_frame;
  const std::optional<Pose> T_frame_child = poses_.At(ToStampNs(stamp));
  if (!T_frame_child)
    return {std::nullopt, "no pose at " + Text(stamp) + ": " + poses_.WhyNot(topic, ToStampNs(stamp))};
  const TransformResult odom_frame_T = LookUp(odom_frame, frame, stamp);
  if (!odom_frame_T.T_target_source)
    return {std::nullopt, topic + " is in frame " + frame + ", but odom_frame is " + odom_frame + ", and there is " +
                              odom_frame_T.reason};
  const TransformResult child_sensor = LookUp(child_frame, sensor_frame, stamp);
  if (!child_sensor.T_target_source)
    return {std::nullopt, child_sensor.reason + " (" + topic + " gives the pose of " + child_frame + ")"};
  return {*odom_frame_T.T_target_source * *T_frame_child * *child_sensor.T_target_source, ""};
}

/// Which parameter, if any, a frame's name comes from, as words: there it can be mended.
std::string SensorLocator::WhoNames(const std::string& frame) const {
  if (frame == FrameName(parameters_.odom_frame)) return " (parameter odom_frame)";
  if (frame == FrameName(parameters_.base_frame)) return " (parameter base_frame)";
  if (frame == FrameName(parameters_.sensor_frame)) return " (parameter sensor_frame)";
  return "";
}

std::string SensorLocator::KnownFrames() const {
  std::vector<std::string> frames;
  tf_buffer_._getFrameStrings(frames);
  if (frames.empty())
    return std::string("tf is empty: does anybody publish it?") +
           (parameters_.pose_source == PoseSource::kTf ? " Without tf set pose_source to odometry or pose" : "");
  std::string list;
  for (const std::string& frame : frames) list += (list.empty() ? "" : ", ") + frame;
  return "the tree has: " + list;
}

}  // namespace incremental_segmatch
