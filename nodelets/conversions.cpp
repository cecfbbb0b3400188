#include "conversions.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>

#include "incremental_segmatch/twist.hpp"

namespace incremental_segmatch {
namespace {

constexpr double kInt16Max = std::numeric_limits<std::int16_t>::max();
constexpr double kScanUnitM = 0.002;  // refinement is good to millimetres

template <class Vector, class Quaternion>
Pose MakePose(const Vector& translation, const Quaternion& rotation, const std::string& what) {
  const Eigen::Quaterniond q(rotation.w, rotation.x, rotation.y, rotation.z);
  const Eigen::Vector3d t(translation.x, translation.y, translation.z);
  if (!t.allFinite() || !q.coeffs().allFinite()) throw std::invalid_argument(what + ": the pose is not finite");
  if (std::abs(q.norm() - 1.0) > 0.01)
    throw std::invalid_argument(what + ": its quaternion has length " + std::to_string(q.norm()) +
                                " instead of 1; was it never set?");
  Pose T = Pose::Identity();
  T.linear() = q.normalized().toRotationMatrix();
  T.translation() = t;
  return T;
}

template <class Vector>
Vector ToXyz(const Eigen::Vector3d& v) {
  Vector message;
  message.x = v.x();
  message.y = v.y();
  message.z = v.z();
  return message;
}

geometry_msgs::Quaternion ToQuaternion(const Eigen::Matrix3d& R) {
  const Eigen::Quaterniond q = Eigen::Quaterniond(R).normalized();
  geometry_msgs::Quaternion message;
  message.x = q.x();
  message.y = q.y();
  message.z = q.z();
  message.w = q.w();
  return message;
}

/// To the nearest; in range, and inline, which std::lround is not.
std::int16_t RoundToInt16(float value) {
  return static_cast<std::int16_t>(value + std::copysign(0.5f, value));
}

/// Multiples of a unit, which is `unit_m` or, where that is too small for the points' extent, larger; returned.
float QuantisePoints(const Points& points, double unit_m, std::vector<std::int16_t>* quantised) {
  float largest = 0.f;
  for (const Eigen::Vector3f& p : points) largest = std::max(largest, p.cwiseAbs().maxCoeff());
  const float used_m = static_cast<float>(std::max(unit_m, largest / (kInt16Max - 1.0)));
  const float scale = 1.f / used_m;
  quantised->resize(3 * points.size());
  auto out = quantised->begin();
  for (const Eigen::Vector3f& p : points)
    for (int axis = 0; axis < 3; ++axis) *out++ = RoundToInt16(p[axis] * scale);
  return used_m;
}

/// Null where there are none. `what` and `unit_name` are for the error.
std::shared_ptr<const Points> RestorePoints(const std::vector<std::int16_t>& quantised, float unit_m,
                                            const std::string& what, const char* unit_name) {
  if (quantised.empty()) return nullptr;
  if (quantised.size() % 3 != 0 || !(unit_m > 0.f))
    throw std::invalid_argument(what + ": points are no triples, or " + unit_name + " is not positive");
  auto points = std::make_shared<Points>(quantised.size() / 3);
  auto in = quantised.begin();
  for (Eigen::Vector3f& p : *points)
    for (int axis = 0; axis < 3; ++axis) p[axis] = unit_m * static_cast<float>(*in++);
  return points;
}

std::uint8_t ToCause(RetirementCause cause) {
  switch (cause) {
    case RetirementCause::kTooLarge:
      return SegmentRetirement::TOO_LARGE;
    case RetirementCause::kCut:
      return SegmentRetirement::CUT;
    case RetirementCause::kTrail:
      return SegmentRetirement::TRAIL;
    case RetirementCause::kLeft:
      break;
  }
  return SegmentRetirement::LEFT;
}

RetirementCause FromCause(const SegmentRetirement& retired) {
  switch (retired.cause) {
    case SegmentRetirement::TOO_LARGE:
      return RetirementCause::kTooLarge;
    case SegmentRetirement::CUT:
      return RetirementCause::kCut;
    case SegmentRetirement::TRAIL:
      return RetirementCause::kTrail;
    case SegmentRetirement::LEFT:
      return RetirementCause::kLeft;
    default:
      throw std::invalid_argument("retired segment " + std::to_string(retired.id) + " has the unknown cause " +
                                  std::to_string(retired.cause));
  }
}

Segment ToSegment(const SegmentState& state, double point_unit_m, bool with_points) {
  Segment message;
  message.id = state.id;
  message.size = state.size;
  message.centroid = ToPoint(state.centroid_odom);
  message.descriptor.assign(state.descriptor.data(), state.descriptor.data() + state.descriptor.size());
  message.new_view = state.new_view;
  if (with_points && state.points_centroid)
    message.point_unit_m = QuantisePoints(*state.points_centroid, point_unit_m, &message.points);
  return message;
}

SegmentState FromSegment(const Segment& message) {
  SegmentState state;
  state.id = message.id;
  state.size = message.size;
  state.centroid_odom = ToVector(message.centroid);
  state.descriptor =
      Eigen::Map<const Descriptor>(message.descriptor.data(), static_cast<Eigen::Index>(message.descriptor.size()));
  state.new_view = message.new_view;
  state.points_centroid =
      RestorePoints(message.points, message.point_unit_m, "segment " + std::to_string(message.id), "point_unit_m");
  if (state.id == kNoSegment) throw std::invalid_argument("a segment has the ID 0, which means none");
  if (!state.centroid_odom.allFinite() || !state.descriptor.allFinite())
    throw std::invalid_argument("segment " + std::to_string(state.id) + ": centroid or descriptor is not finite");
  return state;
}

}  // namespace

StampNs ToStampNs(const ros::Time& stamp) {
  return static_cast<StampNs>(stamp.toNSec());
}

ros::Time ToTime(StampNs stamp_ns) {
  if (stamp_ns < 0) throw std::invalid_argument("ROS has no time before 0: " + std::to_string(stamp_ns) + " ns");
  return ros::Time().fromNSec(static_cast<std::uint64_t>(stamp_ns));
}

geometry_msgs::Point ToPoint(const Eigen::Vector3d& point) {
  return ToXyz<geometry_msgs::Point>(point);
}

Eigen::Vector3d ToVector(const geometry_msgs::Point& point) {
  return {point.x, point.y, point.z};
}

geometry_msgs::Pose ToPoseMsg(const Pose& T) {
  geometry_msgs::Pose message;
  message.position = ToPoint(T.translation());
  message.orientation = ToQuaternion(T.linear());
  return message;
}

geometry_msgs::TransformStamped ToTransform(const Pose& T_parent_child, const std::string& parent,
                                            const std::string& child, const ros::Time& stamp) {
  geometry_msgs::TransformStamped message;
  message.header.stamp = stamp;
  message.header.frame_id = parent;
  message.child_frame_id = child;
  message.transform.translation = ToXyz<geometry_msgs::Vector3>(T_parent_child.translation());
  message.transform.rotation = ToQuaternion(T_parent_child.linear());
  return message;
}

Pose ToPose(const geometry_msgs::Pose& pose, const std::string& what) {
  return MakePose(pose.position, pose.orientation, what);
}

Pose ToPose(const geometry_msgs::Transform& transform, const std::string& what) {
  return MakePose(transform.translation, transform.rotation, what);
}

geometry_msgs::PoseWithCovariance ToPoseWithCovariance(const Pose& T, const Covariance6& covariance) {
  geometry_msgs::PoseWithCovariance message;
  message.pose = ToPoseMsg(T);
  for (int row = 0; row < 6; ++row)
    for (int column = 0; column < 6; ++column)
      message.covariance[static_cast<std::size_t>(6 * row + column)] = covariance(row, column);
  return message;
}

Covariance6 ToCovariance(const geometry_msgs::PoseWithCovariance& pose) {
  return Eigen::Map<const Eigen::Matrix<double, 6, 6, Eigen::RowMajor>>(pose.covariance.data());
}

Covariance6 RightPerturbationToParentAxes(const Covariance6& covariance, const Pose& T_parent_child) {
  Covariance6 rotation = Covariance6::Zero();
  rotation.topLeftCorner<3, 3>() = T_parent_child.linear();
  rotation.bottomRightCorner<3, 3>() = T_parent_child.linear();
  return rotation * covariance * rotation.transpose();
}

SegmentArray ToSegmentArray(const SegmentDelta& delta, const RobotFrames& frames, std::uint64_t session,
                            double point_unit_m, bool with_points) {
  SegmentArray message;
  message.header.stamp = ToTime(delta.stamp_ns);
  message.header.frame_id = frames.odom_frame;
  message.robot = delta.robot;
  message.session = session;
  message.sequence = delta.sequence;
  message.full_state = delta.full_state;
  message.sensor_frame = frames.sensor_frame;
  message.sensor_pose = ToPoseMsg(delta.T_odom_sensor);
  message.continuous_frame = ToPoseMsg(delta.T_odom_continuous);
  message.base_frame = frames.base_frame;
  message.sensor_in_base = ToPoseMsg(frames.T_base_sensor);
  message.changed.reserve(delta.changed.size());
  if (with_points && delta.scan_sensor)
    message.scan_unit_m = QuantisePoints(*delta.scan_sensor, kScanUnitM, &message.scan);
  for (const SegmentState& state : delta.changed)
    message.changed.push_back(ToSegment(state, point_unit_m, with_points));
  for (const RenamedSegment& renamed : delta.renamed) {
    message.renamed.emplace_back();
    message.renamed.back().from_id = renamed.from;
    message.renamed.back().to_id = renamed.to;
  }
  for (const RetiredSegment& retired : delta.retired) {
    message.retired.emplace_back();
    message.retired.back().id = retired.id;
    message.retired.back().cause = ToCause(retired.cause);
  }
  return message;
}

SegmentDelta ToSegmentDelta(const SegmentArray& message, const std::string& robot) {
  SegmentDelta delta;
  delta.robot = robot;
  delta.sequence = message.sequence;
  delta.stamp_ns = ToStampNs(message.header.stamp);
  delta.T_odom_sensor = ToPose(message.sensor_pose, "sensor_pose");
  delta.T_odom_continuous = ToPose(message.continuous_frame, "continuous_frame");
  delta.full_state = message.full_state;
  delta.scan_sensor = RestorePoints(message.scan, message.scan_unit_m, "the scan", "scan_unit_m");
  delta.changed.reserve(message.changed.size());
  for (const Segment& segment : message.changed) {
    if (!delta.changed.empty() && segment.id <= delta.changed.back().id)
      throw std::invalid_argument("changed segments are not in ascending order at ID " + std::to_string(segment.id));
    delta.changed.push_back(FromSegment(segment));
  }
  for (const SegmentRenaming& renamed : message.renamed) delta.renamed.push_back({renamed.from_id, renamed.to_id});
  for (const SegmentRetirement& retired : message.retired) delta.retired.push_back({retired.id, FromCause(retired)});
  return delta;
}

Pose ContinuousSensorPose(const SegmentArray& message) {
  return ToPose(message.continuous_frame, "continuous_frame").inverse() * ToPose(message.sensor_pose, "sensor_pose");
}

RobotFrames ToRobotFrames(const SegmentArray& message) {
  return {message.header.frame_id, message.base_frame, message.sensor_frame,
          ToPose(message.sensor_in_base, "sensor_in_base")};
}

LoopClosure ToLoopClosure(const Closure& closure, FrameKind frame_kind, const RobotFrames& query,
                          const RobotFrames& target, const TargetMap& map) {
  LoopClosure message;
  message.header.stamp = ToTime(closure.stamp_query_ns);
  message.header.frame_id = query.odom_frame;
  message.robot_query = closure.robot_query;
  message.robot_target = closure.robot_target;
  message.stamp_query = ToTime(closure.stamp_query_ns);
  message.stamp_target = ToTime(closure.stamp_target_ns);
  if (frame_kind == FrameKind::kBase) {
    const Pose T_sensor_base = query.T_base_sensor.inverse();
    message.frame_kind = LoopClosure::FRAME_BASE;
    message.frame_query = query.base_frame;
    message.frame_target = target.base_frame;
    message.relative_pose = ToPoseWithCovariance(target.T_base_sensor * closure.T_target_query * T_sensor_base,
                                                 MoveToTheRight(closure.covariance, T_sensor_base));
  } else {
    message.frame_kind = LoopClosure::FRAME_SENSOR;
    message.frame_query = query.sensor_frame;
    message.frame_target = target.sensor_frame;
    message.relative_pose = ToPoseWithCovariance(closure.T_target_query, closure.covariance);
  }
  message.inliers = static_cast<std::uint32_t>(closure.inliers);
  message.candidates = static_cast<std::uint32_t>(closure.candidates);
  message.rms_m = closure.rms_m;
  for (const SegmentMatch& match : closure.matches) {
    MatchedSegments matched;
    matched.segment_query = match.local.id;
    matched.centroid_query = ToPoint(match.centroid_local_odom);
    matched.robot_target = map.RobotName(match.target.robot);
    matched.segment_target = match.target.id;
    matched.centroid_target = ToPoint(match.centroid_target_map);
    message.matches.push_back(std::move(matched));
  }
  return message;
}

SensorClosure ToSensorClosure(const LoopClosure& message, const RobotFrames& query, const RobotFrames& target) {
  const Pose T = ToPose(message.relative_pose.pose, "relative_pose");
  const Covariance6 covariance = ToCovariance(message.relative_pose);
  if (message.frame_kind == LoopClosure::FRAME_SENSOR) return {T, covariance};
  if (message.frame_kind != LoopClosure::FRAME_BASE)
    throw std::invalid_argument("loop closure with the unknown frame_kind " + std::to_string(message.frame_kind));
  return {target.T_base_sensor.inverse() * T * query.T_base_sensor,
          MoveToTheRight(covariance, query.T_base_sensor)};
}

nav_msgs::Path ToPath(const std::vector<StampedPose>& trajectory, FrameKind frame_kind, const RobotFrames& robot,
                      const std::string& frame, const ros::Time& stamp) {
  const Pose T_sensor_base = frame_kind == FrameKind::kBase ? robot.T_base_sensor.inverse() : Pose::Identity();
  nav_msgs::Path path;
  path.header.frame_id = frame;
  path.header.stamp = stamp;
  path.poses.reserve(trajectory.size());
  for (const StampedPose& pose : trajectory) {
    path.poses.emplace_back();
    path.poses.back().header.frame_id = frame;
    path.poses.back().header.stamp = ToTime(pose.stamp_ns);
    path.poses.back().pose = ToPoseMsg(pose.T_frame_sensor * T_sensor_base);
  }
  return path;
}

Pose ToSensorPose(const geometry_msgs::Pose& pose, const std::string& name, FrameKind frame_kind,
                  const RobotFrames& robot) {
  const Pose T_parent_frame = ToPose(pose, name);
  return frame_kind == FrameKind::kBase ? T_parent_frame * robot.T_base_sensor : T_parent_frame;
}

std::vector<StampedPose> ToTrajectory(const nav_msgs::Path& path, FrameKind frame_kind, const RobotFrames& robot) {
  std::vector<StampedPose> trajectory;
  trajectory.reserve(path.poses.size());
  for (const geometry_msgs::PoseStamped& pose : path.poses)
    trajectory.push_back({ToStampNs(pose.header.stamp), ToSensorPose(pose.pose, "trajectory", frame_kind, robot)});
  return trajectory;
}

StepReport ToStepReport(const std_msgs::Header& header, const std::string& robot, const StageTimes& times,
                        const NamedCounts& counts, const std::string& end) {
  StepReport report;
  report.header = header;
  report.robot = robot;
  for (const auto& [stage, milliseconds] : times) {
    report.stages.push_back(stage);
    report.milliseconds.push_back(milliseconds);
  }
  for (const auto& [name, value] : counts) {
    report.counts.push_back(name);
    report.values.push_back(value);
  }
  report.end = end;
  return report;
}

NamedCounts ToNamedCounts(const FrontEndCounts& counts) {
  return {{"points", counts.points},
          {"obstacle_points", counts.obstacle_points},
          {"dropped_nonfinite", counts.dropped_nonfinite},
          {"dropped_outside", counts.dropped_outside},
          {"voxels", counts.voxels},
          {"activated_voxels", counts.activated_voxels},
          {"moved_voxels", counts.moved_voxels},
          {"removed_voxels", counts.removed_voxels},
          {"clusters", counts.clusters.clusters},
          {"segments", counts.clusters.segments},
          {"too_small", counts.clusters.too_small},
          {"too_large", counts.clusters.too_large},
          {"cut", counts.clusters.cut},
          {"trails", counts.clusters.trails}};
}

NamedCounts ToNamedCounts(const BackEndCounts& counts) {
  return {{"local_segments", counts.local_segments},
          {"target_segments", counts.target_segments},
          {"allowed_targets", counts.allowed_targets},
          {"requeried", counts.requeried},
          {"candidates", counts.candidates},
          {"tested_pairs", counts.tested_pairs},
          {"edges", counts.edges},
          {"clique", counts.clique}};
}

}  // namespace incremental_segmatch
