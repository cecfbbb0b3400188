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
      odometry_(kKeepPoses_s, parameters.odometry_max_gap_s) {}

void SensorLocator::AddOdometry(const nav_msgs::Odometry& odometry) {
  odometry_.Add({ToStampNs(odometry.header.stamp), ToPose(odometry.pose.pose, "odometry")});
  const std::lock_guard<std::mutex> lock(mutex_);
  odometry_frame_ = FrameName(odometry.header.frame_id);
  odometry_child_frame_ = FrameName(odometry.child_frame_id);
}

void SensorLocator::Clear() {
  tf_buffer_.clear();
  odometry_.Clear();
}

LocateResult SensorLocator::Locate(const ros::Time& stamp, const std::string& sensor_frame) const {
  const std::string odom_frame = FrameName(parameters_.odom_frame);
  const std::string base_frame = parameters_.base_frame.empty() ? sensor_frame : FrameName(parameters_.base_frame);
  const TransformResult odom_sensor = parameters_.pose_source == PoseSource::kTf
                                          ? LookUp(odom_frame, sensor_frame, stamp)
                                          : LookUpOdometry(sensor_frame, stamp);
  if (!odom_sensor.T_target_source) return {std::nullopt, odom_sensor.reason};
  const TransformResult base_sensor = LookUp(base_frame, sensor_frame, stamp);
  if (!base_sensor.T_target_source)
    return {std::nullopt,
            base_sensor.reason + " (base_frame may be empty where the robot has no other than " + sensor_frame + ")"};
  return {SensorLocation{*odom_sensor.T_target_source,
                         {odom_frame, base_frame, sensor_frame, *base_sensor.T_target_source}},
          ""};
}

SensorLocator::TransformResult SensorLocator::LookUp(const std::string& target, const std::string& source,
                                                     const ros::Time& stamp) const {
  if (target == source) return {Pose::Identity(), ""};
  try {
    return {ToPose(tf_buffer_.lookupTransform(target, source, stamp).transform, "tf"), ""};
  } catch (const tf2::TransformException& error) {
    return {std::nullopt, "no tf from " + target + " to " + source + " at " + Text(stamp) + ": " + error.what() + "; " +
                              KnownFrames()};
  }
}

SensorLocator::TransformResult SensorLocator::LookUpOdometry(const std::string& sensor_frame,
                                                             const ros::Time& stamp) const {
  std::string frame;
  std::string child_frame;
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    frame = odometry_frame_;
    child_frame = odometry_child_frame_.empty() ? FrameName(parameters_.base_frame) : odometry_child_frame_;
  }
  const std::optional<Pose> T_odom_child = odometry_.At(ToStampNs(stamp));
  if (!T_odom_child)
    return {std::nullopt, "no odometry pose at " + Text(stamp) + ": " + odometry_.WhyNot(ToStampNs(stamp))};
  if (frame != FrameName(parameters_.odom_frame))
    return {std::nullopt, "odometry is in frame " + frame + ", but odom_frame is " + parameters_.odom_frame};
  if (child_frame.empty()) child_frame = sensor_frame;
  const TransformResult child_sensor = LookUp(child_frame, sensor_frame, stamp);
  if (!child_sensor.T_target_source) return {std::nullopt, child_sensor.reason + " (odometry's child frame)"};
  return {*T_odom_child * *child_sensor.T_target_source, ""};
}

std::string SensorLocator::KnownFrames() const {
  std::vector<std::string> frames;
  tf_buffer_._getFrameStrings(frames);
  if (frames.empty()) return "tf is empty: does anybody publish it?";
  std::string list;
  for (const std::string& frame : frames) list += (list.empty() ? "" : ", ") + frame;
  return "the tree has: " + list;
}

}  // namespace incremental_segmatch
