#include "pose_graph_nodelet.hpp"

#include <algorithm>
#include <boost/make_shared.hpp>
#include <exception>
#include <pluginlib/class_list_macros.hpp>
#include <utility>

#include "incremental_segmatch/pose_graph_io.hpp"

namespace incremental_segmatch {
namespace {

constexpr double kWarnPeriod_s = 5.0;
constexpr double kPathPeriod_s = 1.0;

/// `name.ext` for the first robot, `name_robot.ext` for others.
std::string FileName(const std::string& folder, const std::string& name, const std::string& session, RobotIndex index) {
  return folder + "/" + name + (index == 0 ? "" : "_" + session) + ".tum";
}

}  // namespace

PoseGraphNodelet::~PoseGraphNodelet() {
  // First, so that no callback runs any more when the worker goes.
  for (ros::Subscriber& subscriber : subscribers_) subscriber.shutdown();
  write_service_.shutdown();
  reset_service_.shutdown();
  diagnostics_timer_.stop();
  const bool started = worker_ != nullptr;
  worker_.reset();
  if (!started || parameters_.output_dir.empty()) return;
  try {
    if (has_new_closures_) graph_->Optimize();
    WriteTrajectories();
  } catch (const std::exception& error) {
    NODELET_ERROR("the trajectories are not written: %s", error.what());
  }
}

void PoseGraphNodelet::onInit() {
  try {
    Start();
  } catch (const std::exception& error) {
    NODELET_FATAL("the pose graph does not start: %s", error.what());
  }
}

void PoseGraphNodelet::Start() {
  ros::NodeHandle& nh = getNodeHandle();
  parameters_ = ReadPoseGraphParameters(getPrivateNodeHandle());
  graph_ = std::make_unique<PoseGraph>(parameters_.pose_graph);
  if (parameters_.publish_tf) tf_broadcaster_ = std::make_unique<tf2_ros::TransformBroadcaster>();
  worker_ = std::make_unique<Worker>(parameters_.queue_size, [this](const std::string& what) { Refuse(what); });
  write_service_ = nh.advertiseService("write_trajectories", &PoseGraphNodelet::OnWrite, this);
  reset_service_ = nh.advertiseService("reset_pose_graph", &PoseGraphNodelet::OnReset, this);
  if (parameters_.robots.empty()) Subscribe("");
  for (const std::string& robot : parameters_.robots) Subscribe(robot);
  const boost::function<void(const LoopClosureConstPtr&)> on_closure = [this](const LoopClosureConstPtr& closure) {
    worker_->PostAlways([this, closure] {
      waiting_closures_.push_back(closure);
      AddWaitingClosures();
      OptimizeIfIdle();
    });
  };
  subscribers_.push_back(nh.subscribe<LoopClosure>("loop_closures", 100, on_closure));

  diagnostics_ = std::make_unique<diagnostic_updater::Updater>(nh, getPrivateNodeHandle(), getName());
  diagnostics_->setHardwareID("none");
  diagnostics_->add("pose graph", this, &PoseGraphNodelet::Diagnose);
  diagnostics_timer_ =
      nh.createWallTimer(ros::WallDuration(1.0), [this](const ros::WallTimerEvent&) { diagnostics_->force_update(); });
}

void PoseGraphNodelet::Subscribe(const std::string& robot) {
  ros::NodeHandle& nh = getNodeHandle();
  const std::string prefix = robot.empty() ? "" : robot + "/";
  publishers_[prefix] = {nh.advertise<nav_msgs::Path>(prefix + "trajectory", 1, true),
                         nh.advertise<nav_msgs::Path>(prefix + "odometry_path", 1, true)};
  const boost::function<void(const SegmentArrayConstPtr&)> on_segments = [this, prefix](const SegmentArrayConstPtr& m) {
    worker_->Post([this, prefix, m] {
      AddPose(*m, prefix);
      AddWaitingClosures();
      OptimizeIfIdle();
    });
  };
  subscribers_.push_back(nh.subscribe<SegmentArray>(prefix + "segments", 100, on_segments));
}

bool PoseGraphNodelet::OnWrite(std_srvs::Trigger::Request& /*request*/, std_srvs::Trigger::Response& response) {
  try {
    worker_->Run([this] {
      if (parameters_.output_dir.empty()) throw std::runtime_error("the parameter output_dir is not set: there is no folder to write to");
      if (has_new_closures_) Optimize();
      WriteTrajectories();
    });
    response.success = true;
    response.message = "written to " + parameters_.output_dir;
  } catch (const std::exception& error) {
    response.success = false;
    response.message = error.what();
  }
  return true;
}

bool PoseGraphNodelet::OnReset(std_srvs::Trigger::Request& /*request*/, std_srvs::Trigger::Response& response) {
  worker_->PostAlways([this] {
    sessions_.EndAll();
    StartOver();
  });
  response.success = true;
  response.message = "the pose graph is forgotten";
  return true;
}

void PoseGraphNodelet::StartOver() {
  graph_ = std::make_unique<PoseGraph>(parameters_.pose_graph);
  sessions_.Clear();
  robots_.clear();
  newest_session_.clear();
  waiting_closures_.clear();
  has_new_closures_ = false;
}

void PoseGraphNodelet::AddPose(const SegmentArray& message, const std::string& prefix) {
  const StampNs stamp_ns = ToStampNs(message.header.stamp);
  RobotSessions::Session session = sessions_.Find(message.robot, message.session, stamp_ns);
  if (session.change == RobotSessions::Change::kRewound) {
    NODELET_WARN("time jumped back for %s: the pose graph starts over", message.robot.c_str());
    StartOver();
    session = sessions_.Find(message.robot, message.session, stamp_ns);
  }
  if (session.change == RobotSessions::Change::kEnded) return;
  const auto index = static_cast<RobotIndex>(robots_.size());
  const auto [it, is_new] = robots_.try_emplace(session.name);
  Robot& robot = it->second;
  if (is_new) robot.index = index;
  robot.name = message.robot;
  robot.frames = ToRobotFrames(message);
  newest_session_[prefix] = session.name;

  robot.T_odom_continuous = ToPose(message.continuous_frame, "continuous_frame");
  const Pose T_continuous_sensor = ContinuousSensorPose(message);
  graph_->AddNode(robot.index, stamp_ns, T_continuous_sensor);
  robot.odometry.push_back({stamp_ns, T_continuous_sensor});
  PublishTransform(robot, message.header.stamp);
  if (throttle_.IsDue("paths", kPathPeriod_s)) PublishPaths();
  const std::lock_guard<std::mutex> lock(mutex_);
  ++status_.poses;
}

/// True if the closure was taken; false if it must wait for the query's pose.
bool PoseGraphNodelet::AddClosure(const LoopClosure& message) {
  const auto query = robots_.find(message.robot_query);
  if (query == robots_.end() || query->second.odometry.back().stamp_ns < ToStampNs(message.stamp_query)) return false;
  const auto target = robots_.find(message.robot_target);
  if (target == robots_.end()) {
    Refuse("a loop closure to " + message.robot_target + ", of which no poses have come");
    return true;
  }
  const SensorClosure closure = ToSensorClosure(message, query->second.frames, target->second.frames);
  if (!graph_->AddClosure(target->second.index, ToStampNs(message.stamp_target), query->second.index,
                          ToStampNs(message.stamp_query), closure.T_target_query, closure.covariance)) {
    Refuse("a loop closure between stamps at which no poses have come");
    return true;
  }
  has_new_closures_ = true;
  const std::lock_guard<std::mutex> lock(mutex_);
  ++status_.closures;
  return true;
}

void PoseGraphNodelet::AddWaitingClosures() {
  std::vector<LoopClosureConstPtr> waiting;
  waiting.swap(waiting_closures_);
  for (const LoopClosureConstPtr& closure : waiting)
    if (!AddClosure(*closure)) waiting_closures_.push_back(closure);
}

void PoseGraphNodelet::OptimizeIfIdle() {
  if (has_new_closures_ && worker_->queued() == 0) Optimize();
}

void PoseGraphNodelet::Optimize() {
  const Clock::time_point start = Clock::now();
  const PoseGraphReport report = graph_->Optimize();
  has_new_closures_ = false;
  PublishPaths();
  const std::lock_guard<std::mutex> lock(mutex_);
  status_.report = report;
  status_.optimization_ms = std::chrono::duration<double, std::milli>(Clock::now() - start).count();
}

bool PoseGraphNodelet::IsInMap(const Robot& robot) const {
  return graph_->AreConnected(0, robot.index);
}

void PoseGraphNodelet::PublishTransform(const Robot& robot, const ros::Time& stamp) {
  if (!tf_broadcaster_ || !IsInMap(robot)) return;
  const Pose T_map_odom = graph_->T_map_odom(robot.index) * robot.T_odom_continuous.inverse();
  tf_broadcaster_->sendTransform(ToTransform(T_map_odom, parameters_.map_frame, robot.frames.odom_frame,
                                             stamp + ros::Duration(parameters_.tf_tolerance_s)));
}

void PoseGraphNodelet::PublishPaths() {
  for (auto& [prefix, publishers] : publishers_) {
    const auto session = newest_session_.find(prefix);
    if (session == newest_session_.end()) continue;
    const Robot& robot = robots_.at(session->second);
    if (publishers.trajectory.getNumSubscribers() > 0 && IsInMap(robot))
      publishers.trajectory.publish(boost::make_shared<const nav_msgs::Path>(CorrectedPath(robot)));
    if (publishers.odometry_path.getNumSubscribers() > 0)
      publishers.odometry_path.publish(boost::make_shared<const nav_msgs::Path>(
          ToPath(robot.odometry, parameters_.trajectory_kind, robot.frames, parameters_.map_frame,
                 ToTime(robot.odometry.back().stamp_ns))));
  }
}

/// Of all sessions of the robot that are in the map; their stamps follow each other.
nav_msgs::Path PoseGraphNodelet::CorrectedPath(const Robot& newest) const {
  std::vector<StampedPose> trajectory;
  for (const auto& [session, robot] : robots_) {
    if (robot.name != newest.name || !IsInMap(robot)) continue;
    const std::vector<StampedPose> part = graph_->Trajectory(robot.index);
    trajectory.insert(trajectory.end(), part.begin(), part.end());
  }
  std::sort(trajectory.begin(), trajectory.end(),
            [](const StampedPose& a, const StampedPose& b) { return a.stamp_ns < b.stamp_ns; });
  return ToPath(trajectory, parameters_.trajectory_kind, newest.frames, parameters_.map_frame,
                ToTime(newest.odometry.back().stamp_ns));
}

void PoseGraphNodelet::WriteTrajectories() {
  for (const auto& [session, robot] : robots_) {
    WriteTum(robot.odometry, FileName(parameters_.output_dir, "trajectory_odometry", session, robot.index));
    WriteTum(graph_->Trajectory(robot.index),
             FileName(parameters_.output_dir, "trajectory_optimized", session, robot.index));
  }
  WriteG2o(*graph_, parameters_.output_dir + "/pose_graph.g2o");
}

void PoseGraphNodelet::Refuse(const std::string& what) {
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    ++status_.refused;
    status_.last_error = what;
  }
  if (throttle_.IsDue("refused", kWarnPeriod_s)) NODELET_ERROR("a message was refused: %s", what.c_str());
}

void PoseGraphNodelet::Diagnose(diagnostic_updater::DiagnosticStatusWrapper& status) {
  using diagnostic_msgs::DiagnosticStatus;
  const std::lock_guard<std::mutex> lock(mutex_);
  if (status_.refused != status_.reported_refused)
    status.summary(DiagnosticStatus::ERROR, "a message was refused: " + status_.last_error);
  else
    status.summaryf(DiagnosticStatus::OK, "%zu poses, %zu loop closures", status_.poses, status_.closures);
  status.add("poses", status_.poses);
  status.add("loop closures", status_.closures);
  status.add("loop closures outvoted", status_.report.outvoted_closures);
  status.add("messages refused", status_.refused);
  status.add("segment arrays waiting", worker_->queued());
  status.add("segment arrays dropped by the full queue", worker_->dropped());
  status.addf("last optimization [ms]", "%.1f", status_.optimization_ms);
  status_.reported_refused = status_.refused;
}

}  // namespace incremental_segmatch

PLUGINLIB_EXPORT_CLASS(incremental_segmatch::PoseGraphNodelet, nodelet::Nodelet)
