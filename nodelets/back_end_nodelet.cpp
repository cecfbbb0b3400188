#include "back_end_nodelet.hpp"

#include <geometry_msgs/PoseWithCovarianceStamped.h>
#include <incremental_segmatch/RequestFullState.h>

#include <algorithm>
#include <boost/make_shared.hpp>
#include <exception>
#include <pluginlib/class_list_macros.hpp>
#include <set>
#include <utility>

#include "incremental_segmatch/twist.hpp"
#include "markers.hpp"

namespace incremental_segmatch {
namespace {

constexpr double kWarnPeriod_s = 5.0;
constexpr double kRequestPeriod_s = 1.0;
constexpr double kRecognizedPeriod_s = 10.0;  // between lines about recognitions in the log
constexpr double kMemoryPeriod_s = 2.0;
constexpr double kCorrection_m = 0.02;     // of a corrected pose, from which on the map follows
constexpr double kCorrection_rad = 0.001;  // likewise
constexpr double kLabelRadius_m = 40.0;    // around the robot
constexpr double kLetter_m = 0.7;
constexpr double kResidualExaggeration = 10.0;

const LineStyle kRefusedStyle{"refused", 0.7f, 0.7f, 0.75f, 0.07f, 0.05};
const LineStyle kAcceptedStyle{"accepted", 0.1f, 0.9f, 0.2f, 1.0f, 0.2};
const LineStyle kResidualStyle{"residuals", 1.0f, 0.2f, 0.2f, 1.0f, 0.15};
const LineStyle kClosureStyle{"closures", 1.0f, 0.85f, 0.1f, 1.0f, 0.25};

/// Index in the map of a robot of this run: the last of that name, since those of a loaded map come first.
std::optional<RobotIndex> FindRobot(const TargetMap& map, const std::string& name) {
  for (std::size_t i = map.robots(); i-- > 0;)
    if (map.RobotName(static_cast<RobotIndex>(i)) == name) return static_cast<RobotIndex>(i);
  return std::nullopt;
}

/// The candidates that are none of the accepted matches.
std::vector<SegmentMatch> RefusedMatches(const BackEndStep& step) {
  if (!step.closure) return step.candidates;
  std::set<std::pair<SegmentKey, SegmentKey>> accepted;
  for (const SegmentMatch& match : step.closure->matches) accepted.insert({match.local, match.target});
  std::vector<SegmentMatch> refused;
  for (const SegmentMatch& match : step.candidates)
    if (accepted.count({match.local, match.target}) == 0) refused.push_back(match);
  return refused;
}

/// The pose of a robot at a stamp of its trajectory; null: there is none.
const TrajectoryPose* PoseAt(const TargetMap& map, const std::string& robot, StampNs stamp_ns) {
  const std::optional<RobotIndex> index = FindRobot(map, robot);
  if (!index) return nullptr;
  const std::vector<TrajectoryPose>& trajectory = map.Trajectory(*index);
  const auto pose = std::lower_bound(trajectory.begin(), trajectory.end(), stamp_ns,
                                     [](const TrajectoryPose& p, StampNs stamp) { return p.stamp_ns < stamp; });
  return pose != trajectory.end() && pose->stamp_ns == stamp_ns ? &*pose : nullptr;
}

/// How far the robot had gone when it took the scan that recognised the place.
double PathAtQuery(const TargetMap& map, const Closure& closure) {
  const TrajectoryPose* const query = PoseAt(map, closure.robot_query, closure.stamp_query_ns);
  return query == nullptr ? 0.0 : query->path_m;
}

}  // namespace

BackEndNodelet::~BackEndNodelet() {
  // First, so that no callback runs any more when the worker goes.
  for (ros::Subscriber& subscriber : subscribers_) subscriber.shutdown();
  save_service_.shutdown();
  load_service_.shutdown();
  reset_service_.shutdown();
  trigger_service_.shutdown();
  service_spinner_.stop();
  diagnostics_timer_.stop();
  tuning_.reset();
  worker_.reset();
}

void BackEndNodelet::onInit() {
  try {
    Start();
  } catch (const std::exception& error) {
    NODELET_FATAL("the back end does not start: %s", error.what());
  }
}

void BackEndNodelet::Start() {
  ros::NodeHandle& nh = getNodeHandle();
  const NodeletParameters<BackEndNodeParameters> parameters = ReadBackEndParameters(getPrivateNodeHandle());
  parameters_ = parameters.node;
  core_parameters_ = parameters.core.back_end;

  closures_publisher_ = nh.advertise<LoopClosure>("loop_closures", 100);
  targets_publisher_ = nh.advertise<sensor_msgs::PointCloud2>("target_segments", 1);
  labels_publisher_ = nh.advertise<visualization_msgs::MarkerArray>("target_labels", 1);
  refused_publisher_ = nh.advertise<visualization_msgs::Marker>("refused_matches", 1);
  accepted_publisher_ = nh.advertise<visualization_msgs::Marker>("accepted_matches", 1);
  residuals_publisher_ = nh.advertise<visualization_msgs::Marker>("residuals", 1);
  selected_publisher_ = nh.advertise<visualization_msgs::MarkerArray>("selected_segment", 1, true);
  closure_lines_publisher_ = nh.advertise<visualization_msgs::Marker>("closure_lines", 1, true);
  steps_publisher_ = nh.advertise<StepReport>("back_end_steps", 10);
  if (IsLocalization()) {
    localization_publisher_ = nh.advertise<geometry_msgs::PoseWithCovarianceStamped>("localization", 10);
    if (parameters_.publish_tf) tf_broadcaster_ = std::make_unique<tf2_ros::TransformBroadcaster>();
  }

  worker_ = std::make_unique<Worker>(parameters_.queue_size, [this](const std::string& what) { Refuse(what); });
  worker_->PostAlways([this] {
    try {
      StartOver();
    } catch (const std::exception& error) {
      back_end_.reset();
      why_not_started_ = error.what();
      NODELET_FATAL("the back end does not start: %s", error.what());
    }
  });
  ros::NodeHandle service_nh = nh;
  service_nh.setCallbackQueue(&service_queue_);
  save_service_ = service_nh.advertiseService("save_map", &BackEndNodelet::OnSaveMap, this);
  load_service_ = service_nh.advertiseService("load_map", &BackEndNodelet::OnLoadMap, this);
  reset_service_ = service_nh.advertiseService("reset", &BackEndNodelet::OnReset, this);
  trigger_service_ = service_nh.advertiseService("trigger", &BackEndNodelet::OnTrigger, this);
  if (parameters_.robots.empty()) Subscribe("");
  for (const std::string& robot : parameters_.robots) Subscribe(robot);
  const boost::function<void(const geometry_msgs::PointStampedConstPtr&)> on_point =
      [this](const geometry_msgs::PointStampedConstPtr& m) { worker_->PostAlways([this, m] { Select(*m); }); };
  subscribers_.push_back(nh.subscribe<geometry_msgs::PointStamped>("clicked_point", 1, on_point));
  ros::NodeHandle tuning_nh = getPrivateNodeHandle();
  tuning_nh.setCallbackQueue(&service_queue_);
  tuning_ = std::make_unique<Tuning<BackEndConfig>>(
      tuning_nh, ToConfig(parameters),
      [this](const BackEndConfig& config) { worker_->Run([this, &config] { Change(config); }); });
  service_spinner_.start();

  diagnostics_ = std::make_unique<diagnostic_updater::Updater>(nh, getPrivateNodeHandle(), getName());
  diagnostics_->setHardwareID("none");
  diagnostics_->add("back end", this, &BackEndNodelet::Diagnose);
  diagnostics_timer_ =
      nh.createWallTimer(ros::WallDuration(1.0), [this](const ros::WallTimerEvent&) { diagnostics_->force_update(); });
}

void BackEndNodelet::Subscribe(const std::string& robot) {
  ros::NodeHandle& nh = getNodeHandle();
  const std::string prefix = robot.empty() ? "" : robot + "/";
  const std::string topic = nh.resolveName(prefix + "segments");
  segments_topics_.push_back(topic);
  const boost::function<void(const SegmentArrayConstPtr&)> on_segments = [this, topic](const SegmentArrayConstPtr& m) {
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      ++status_.received;
    }
    worker_->Post([this, topic, m] { ProcessSegments(*m, topic); });
  };
  const boost::function<void(const nav_msgs::PathConstPtr&)> on_path = [this, robot](const nav_msgs::PathConstPtr& m) {
    worker_->PostAlways([this, robot, m] { CorrectTrajectory(robot, *m); });
  };
  const boost::function<void(const nav_msgs::OdometryConstPtr&)> on_pose =
      [this, robot](const nav_msgs::OdometryConstPtr& m) {
        worker_->PostAlways([this, robot, m] { CorrectPose(robot, *m); });
      };
  subscribers_.push_back(nh.subscribe<SegmentArray>(prefix + "segments", 100, on_segments));
  subscribers_.push_back(nh.subscribe<nav_msgs::Path>(prefix + "trajectory", 1, on_path));
  subscribers_.push_back(nh.subscribe<nav_msgs::Odometry>(prefix + "corrected_odometry", 100, on_pose));
}

void BackEndNodelet::StartOver() {
  if (parameters_.map_file.empty()) {
    back_end_ = std::make_unique<BackEnd>(core_parameters_);
  } else {
    back_end_ =
        std::make_unique<BackEnd>(core_parameters_, TargetMap::Load(parameters_.map_file, core_parameters_.target_map));
    NODELET_INFO("%zu target segments loaded from %s", back_end_->map().segments().size(),
                 parameters_.map_file.c_str());
  }
  robots_.clear();
  closures_.clear();
  selected_.reset();
  if (!parameters_.output_dir.empty())
    closure_log_ = std::make_unique<ClosureLog>(parameters_.output_dir + "/closures.csv");
}

bool BackEndNodelet::OnSaveMap(SaveMap::Request& request, SaveMap::Response& response) {
  try {
    response.segments = worker_->Run([this, path = request.path] {
      RequireStarted();
      RequireWholePath(path);
      back_end_->map().Save(path);
      return static_cast<std::uint32_t>(back_end_->map().segments().size());
    });
    response.success = true;
    response.message = "saved to " + request.path;
  } catch (const std::exception& error) {
    response.success = false;
    response.message = error.what();
  }
  return true;
}

bool BackEndNodelet::OnLoadMap(LoadMap::Request& request, LoadMap::Response& response) {
  try {
    response.segments = worker_->Run([this, path = request.path] {
      RequireWholePath(path);
      back_end_ = std::make_unique<BackEnd>(core_parameters_, TargetMap::Load(path, core_parameters_.target_map));
      robots_.clear();
      closures_.clear();
      selected_.reset();
      return static_cast<std::uint32_t>(back_end_->map().segments().size());
    });
    response.success = true;
    response.message = "loaded from " + request.path;
  } catch (const std::exception& error) {
    response.success = false;
    response.message = error.what();
  }
  return true;
}

bool BackEndNodelet::OnReset(std_srvs::Trigger::Request& /*request*/, std_srvs::Trigger::Response& response) {
  try {
    response.message = worker_->Run([this] { return Reset(); });
    response.success = true;
  } catch (const std::exception& error) {
    response.success = false;
    response.message = error.what();
  }
  return true;
}

void BackEndNodelet::RequireStarted() const {
  if (!back_end_) throw std::invalid_argument("the back end has not started: " + why_not_started_);
}

/// Everybody forgets everything: the front ends first, so that nothing of before comes after.
std::string BackEndNodelet::Reset() {
  std::string unreached;
  for (const std::string& topic : segments_topics_) {
    std_srvs::Trigger front_end;
    if (!ros::service::exists(topic + "/reset", false) || !ros::service::call(topic + "/reset", front_end))
      unreached += (unreached.empty() ? "" : ", ") + topic;
  }
  if (unreached.empty()) {
    sessions_.EndAll();
    const std::string pose_graph = getNodeHandle().resolveName("reset_pose_graph");
    std_srvs::Trigger graph;
    if (ros::service::exists(pose_graph, false)) ros::service::call(pose_graph, graph);
  } else {
    sessions_.Clear();
  }
  StartOver();
  const std::string map = std::to_string(back_end_->map().segments().size()) + " segments in the map";
  if (unreached.empty()) return "map, front ends and pose graph start over; " + map;
  return "the map starts over; no front end answers for " + unreached +
         ", so local map and pose graph stay as they are; " + map;
}

bool BackEndNodelet::OnTrigger(std_srvs::Trigger::Request& /*request*/, std_srvs::Trigger::Response& response) {
  try {
    bool recognized = false;
    response.message = worker_->Run([this, &recognized] { return RecognizeAgain(&recognized); });
    response.success = recognized;
  } catch (const std::exception& error) {
    response.success = false;
    response.message = error.what();
  }
  return true;
}

/// Attempts a recognition for every robot that tracks segments, and publishes it, however recent the last one is. In
/// words, what came of it.
std::string BackEndNodelet::RecognizeAgain(bool* recognized) {
  RequireStarted();
  if (robots_.empty()) throw std::runtime_error("no segments have come from any robot yet");
  std::string words;
  for (auto& [session, robot] : robots_) {
    const BackEndStep step = back_end_->RecognizeAgain(session);
    robot.published_path_m.reset();
    Publish(step, session, robot);
    words += (words.empty() ? "" : "; ") + session + ": " + ToString(step.counts.end) + ", " +
             std::to_string(step.counts.local_segments) + " local segments, " + std::to_string(step.counts.candidates) +
             " candidate matches of " + std::to_string(step.counts.allowed_targets) +
             " allowed targets, largest consistent set " + std::to_string(step.counts.clique) + " of at least " +
             std::to_string(core_parameters_.recognizer.clique.min_size);
    *recognized = *recognized || step.closure.has_value();
  }
  return words;
}

/// Throws std::invalid_argument, naming the parameter, if it is refused: nothing has changed then.
void BackEndNodelet::Change(const BackEndConfig& config) {
  NodeletParameters<BackEndNodeParameters> parameters{parameters_, Parameters()};
  parameters.core.back_end = core_parameters_;
  try {
    RequireStarted();
    parameters = WithConfig(std::move(parameters), config);
    back_end_->ChangeParameters(parameters.core.back_end);
  } catch (const std::invalid_argument& error) {
    NODELET_WARN("a change of the parameters is refused: %s", error.what());
    throw;
  }
  core_parameters_ = parameters.core.back_end;
  parameters_ = parameters.node;
  NODELET_INFO("the parameters have changed");
}

void BackEndNodelet::ProcessSegments(const SegmentArray& message, const std::string& topic) {
  RequireStarted();
  const RobotSessions::Session session =
      sessions_.Find(message.robot, message.session, ToStampNs(message.header.stamp));
  if (session.change == RobotSessions::Change::kEnded) return;
  if (session.change == RobotSessions::Change::kRewound) {
    NODELET_WARN("time jumped back for %s: the back end forgets all robots and starts over", message.robot.c_str());
    sessions_.Clear();
    StartOver();
    return ProcessSegments(message, topic);
  }
  if (session.change == RobotSessions::Change::kRestarted)
    NODELET_WARN("the front end of %s has started over: it goes on as %s", message.robot.c_str(), session.name.c_str());

  Robot& robot = Meet(session.name, message);
  const SegmentDelta delta = ToSegmentDelta(message, session.name);
  const BackEndStep step = back_end_->Process(delta);
  if (step.missed_delta) {
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      ++status_.missed;
    }
    return RequestFullState(topic);
  }
  Publish(step, session.name, robot);
  Report(step);
}

BackEndNodelet::Robot& BackEndNodelet::Meet(const std::string& session, const SegmentArray& message) {
  Robot& robot = robots_[session];
  robot.name = message.robot;
  robot.frames = ToRobotFrames(message);
  robot.stamp_ns = ToStampNs(message.header.stamp);
  robot.T_odom_sensor = ToPose(message.sensor_pose, "sensor_pose");
  robot.T_odom_continuous = ToPose(message.continuous_frame, "continuous_frame");
  return robot;
}

void BackEndNodelet::RequestFullState(const std::string& topic) {
  if (!throttle_.IsDue("request " + topic, kRequestPeriod_s)) return;
  const std::string service = topic + "/request_full_state";
  incremental_segmatch::RequestFullState request;
  if (ros::service::call(service, request) && request.response.success)
    NODELET_INFO("a delta on %s is missing; asked for a full state", topic.c_str());
  else
    NODELET_WARN("a delta on %s is missing, and service %s does not answer: no recognition until it does",
                 topic.c_str(), service.c_str());
}

/// Sessions of the robot whose corrections come on a topic, in order of time; an empty name stands for the only robot.
std::vector<std::string> BackEndNodelet::SessionsOf(const std::string& robot_name) {
  std::vector<std::pair<StampNs, std::string>> sessions;  // by their first stamps
  for (const auto& [session, robot] : robots_) {
    if (!robot_name.empty() && robot.name != robot_name) continue;
    if (robot_name.empty() && robot.name != robots_.begin()->second.name) {
      if (throttle_.IsDue("trajectory", kWarnPeriod_s))
        NODELET_WARN(
            "several robots send segments on one topic: whose trajectory is corrected? Set the parameter robots");
      return {};
    }
    const std::optional<RobotIndex> index = FindRobot(back_end_->map(), session);
    if (index && !back_end_->map().Trajectory(*index).empty())
      sessions.emplace_back(back_end_->map().Trajectory(*index).front().stamp_ns, session);
  }
  std::sort(sessions.begin(), sessions.end());
  std::vector<std::string> names;
  for (const auto& [stamp_ns, session] : sessions) names.push_back(session);
  return names;
}

void BackEndNodelet::CorrectTrajectory(const std::string& robot_name, const nav_msgs::Path& path) {
  if (!back_end_ || IsLocalization()) return;
  if (!path.poses.empty() && path.poses.back().header.stamp.isZero() && throttle_.IsDue("unstamped", kWarnPeriod_s))
    NODELET_WARN("poses of the trajectory have no stamps: each needs that of its scan, or the map is not corrected");
  for (const std::string& session : SessionsOf(robot_name)) {
    const std::vector<TrajectoryPose>& known = back_end_->map().Trajectory(*FindRobot(back_end_->map(), session));
    std::vector<StampedPose> corrected = ToTrajectory(path, parameters_.trajectory_kind, robots_.at(session).frames);
    const auto is_other_sessions = [&known](const StampedPose& pose) {
      return pose.stamp_ns < known.front().stamp_ns || pose.stamp_ns > known.back().stamp_ns;
    };
    corrected.erase(std::remove_if(corrected.begin(), corrected.end(), is_other_sessions), corrected.end());
    if (!corrected.empty()) back_end_->CorrectTrajectory(session, corrected);
  }
}

/// A corrected pose says nothing of those before it: they stay as they were corrected when they came. The map follows
/// once it would be off by more than centimetres.
void BackEndNodelet::CorrectPose(const std::string& robot_name, const nav_msgs::Odometry& odometry) {
  if (!back_end_ || IsLocalization()) return;
  const std::vector<std::string> sessions = SessionsOf(robot_name);
  if (sessions.empty()) return;
  const std::string& session = sessions.back();
  Robot& robot = robots_.at(session);
  const StampedPose pose{ToStampNs(odometry.header.stamp), ToSensorPose(odometry.pose.pose, "corrected_odometry",
                                                                        parameters_.trajectory_kind, robot.frames)};
  if (!robot.corrected.empty() && pose.stamp_ns <= robot.corrected.back().stamp_ns) return;
  robot.corrected.push_back(pose);

  const RobotIndex index = *FindRobot(back_end_->map(), session);
  const std::optional<Pose> T_odom_sensor = back_end_->map().OdometryAt(index, pose.stamp_ns);
  if (!T_odom_sensor) return;  // the scan comes later: the next pose takes it along
  const Pose error = (back_end_->map().T_map_odom(index) * *T_odom_sensor).inverse() * pose.T_frame_sensor;
  if (error.translation().norm() < kCorrection_m && Eigen::AngleAxisd(error.linear()).angle() < kCorrection_rad) return;
  back_end_->CorrectTrajectory(session, robot.corrected);
}

void BackEndNodelet::Publish(const BackEndStep& step, const std::string& session, Robot& robot) {
  for (const Closure& closure : step.settled) {
    Record(closure);
    if (!IsLocalization() && IsDue(closure, robot)) PublishClosure(closure, robot);
  }
  if (step.closure) {
    const Closure& closure = *step.closure;
    robot.T_map_continuous = closure.T_map_odom * robot.T_odom_continuous;
    Record(closure);
    if (throttle_.IsDue("recognized", kRecognizedPeriod_s))
      NODELET_INFO("%s at %.1f s is where %s was at %.1f s: %zu of %zu matches agree (recognition %zu)",
                   closure.robot_query.c_str(), 1e-9 * static_cast<double>(closure.stamp_query_ns),
                   closure.robot_target.c_str(), 1e-9 * static_cast<double>(closure.stamp_target_ns),
                   static_cast<std::size_t>(closure.inliers), static_cast<std::size_t>(closure.candidates),
                   closures_.size());
    if (IsLocalization()) {
      PublishLocalization(closure, robot);
    } else if (IsDue(closure, robot)) {
      PublishClosure(closure, robot);
    }
  }
  PublishTransform(robot);
  PublishMatches(step, session, robot);
  PublishMap(session, robot);
  if (steps_publisher_.getNumSubscribers() > 0) {
    std_msgs::Header header;
    header.stamp = ToTime(robot.stamp_ns);
    header.frame_id = robot.frames.odom_frame;
    steps_publisher_.publish(
        ToStepReport(header, session, step.times, ToNamedCounts(step.counts), ToString(step.counts.end)));
  }
}

/// What was accepted, for the display and the file.
void BackEndNodelet::Record(const Closure& closure) {
  closures_.push_back({closure.robot_query, closure.stamp_query_ns, closure.robot_target, closure.stamp_target_ns});
  if (closure_log_) closure_log_->Add(closure);
}

bool BackEndNodelet::IsDue(const Closure& closure, const Robot& robot) const {
  if (!robot.published_path_m) return true;
  const double interval_s = 1e-9 * static_cast<double>(closure.stamp_query_ns - robot.published_ns);
  return PathAtQuery(back_end_->map(), closure) - *robot.published_path_m >= parameters_.closure_min_distance_m &&
         interval_s >= parameters_.closure_min_interval_s;
}

void BackEndNodelet::PublishClosure(const Closure& closure, Robot& robot) {
  const auto target = robots_.find(closure.robot_target);
  FrameKind kind = parameters_.closure_kind;
  RobotFrames target_frames;
  if (target != robots_.end()) {
    target_frames = target->second.frames;
  } else if (kind == FrameKind::kBase) {
    kind = FrameKind::kSensor;
    if (throttle_.IsDue("frames " + closure.robot_target, kWarnPeriod_s))
      NODELET_WARN("the base frame of %s in the loaded map is not known: closures to it are between the sensors",
                   closure.robot_target.c_str());
  }
  robot.published_path_m = PathAtQuery(back_end_->map(), closure);
  robot.published_ns = closure.stamp_query_ns;
  closures_publisher_.publish(boost::make_shared<const LoopClosure>(
      ToLoopClosure(closure, kind, robot.frames, target_frames, back_end_->map())));
  const std::lock_guard<std::mutex> lock(mutex_);
  ++status_.published;
}

void BackEndNodelet::PublishLocalization(const Closure& closure, const Robot& robot) {
  const Pose T_sensor_base = robot.frames.T_base_sensor.inverse();
  const Pose T_map_base = closure.T_map_odom * robot.T_odom_sensor * T_sensor_base;
  const Covariance6 covariance = MoveToTheRight(closure.covariance, T_sensor_base);
  geometry_msgs::PoseWithCovarianceStamped message;
  message.header = MapHeader(robot.stamp_ns);
  message.pose = ToPoseWithCovariance(T_map_base, RightPerturbationToParentAxes(covariance, T_map_base));
  localization_publisher_.publish(message);
}

void BackEndNodelet::PublishTransform(const Robot& robot) {
  if (!tf_broadcaster_ || !robot.T_map_continuous) return;
  const ros::Time stamp = ToTime(robot.stamp_ns) + ros::Duration(parameters_.tf_tolerance_s);
  const Pose T_map_odom = *robot.T_map_continuous * robot.T_odom_continuous.inverse();
  tf_broadcaster_->sendTransform(ToTransform(T_map_odom, parameters_.map_frame, robot.frames.odom_frame, stamp));
}

void BackEndNodelet::PublishMatches(const BackEndStep& step, const std::string& session, const Robot& robot) {
  const std_msgs::Header header = MapHeader(robot.stamp_ns);
  const double height_m = parameters_.display_height_m;
  const Pose T_map_odom = MapOdom(session, robot);
  const std::vector<SegmentMatch> accepted = step.closure ? step.closure->matches : std::vector<SegmentMatch>();
  if (refused_publisher_.getNumSubscribers() > 0)
    refused_publisher_.publish(
        LineMarker(MatchLines(RefusedMatches(step), T_map_odom, height_m), kRefusedStyle, header));
  if (accepted_publisher_.getNumSubscribers() > 0)
    accepted_publisher_.publish(LineMarker(MatchLines(accepted, T_map_odom, height_m), kAcceptedStyle, header));
  if (step.closure && residuals_publisher_.getNumSubscribers() > 0)
    residuals_publisher_.publish(LineMarker(
        ResidualLines(accepted, step.closure->T_map_odom, height_m, kResidualExaggeration), kResidualStyle, header));
}

void BackEndNodelet::PublishMap(const std::string& session, const Robot& robot) {
  const std_msgs::Header header = MapHeader(robot.stamp_ns);
  const double height_m = parameters_.display_height_m;
  const double period_s = parameters_.display_period_s;
  if (targets_publisher_.getNumSubscribers() > 0 && throttle_.IsDue("targets", period_s))
    targets_publisher_.publish(TargetCloud(back_end_->map(), height_m, header));
  if (labels_publisher_.getNumSubscribers() > 0 && throttle_.IsDue("labels", period_s)) {
    const Eigen::Vector3d place = MapOdom(session, robot) * robot.T_odom_sensor.translation();
    labels_publisher_.publish(
        LabelMarkers(TargetLabels(back_end_->map(), place, kLabelRadius_m, height_m), "targets", kLetter_m, header));
  }
  if (closure_lines_publisher_.getNumSubscribers() > 0 && throttle_.IsDue("closures", period_s))
    PublishClosureLines(header);
  if (selected_ && throttle_.IsDue("selected", period_s)) PublishSelected();
}

void BackEndNodelet::PublishClosureLines(const std_msgs::Header& header) {
  std::vector<Line> lines;
  for (const ClosureEnds& ends : closures_) {
    const TrajectoryPose* const query = PoseAt(back_end_->map(), ends.robot_query, ends.stamp_query_ns);
    const TrajectoryPose* const target = PoseAt(back_end_->map(), ends.robot_target, ends.stamp_target_ns);
    if (query != nullptr && target != nullptr)
      lines.emplace_back(query->T_map_sensor.translation(), target->T_map_sensor.translation());
  }
  closure_lines_publisher_.publish(LineMarker(lines, kClosureStyle, header));
}

/// Shows the history of the segment that is nearest to a point in the map.
void BackEndNodelet::Select(const geometry_msgs::PointStamped& point) {
  if (!back_end_) return;
  if (point.header.frame_id != parameters_.map_frame) {
    NODELET_WARN("the clicked point is in frame %s: make %s rviz's fixed frame to select segments",
                 point.header.frame_id.c_str(), parameters_.map_frame.c_str());
    return;
  }
  selected_ = NearestTarget(back_end_->map(), ToVector(point.point), parameters_.display_height_m);
  if (selected_) PublishSelected();
}

void BackEndNodelet::PublishSelected() {
  if (selected_publisher_.getNumSubscribers() == 0) return;
  std_msgs::Header header;  // stamp 0: rviz takes the newest transform
  header.frame_id = parameters_.map_frame;
  selected_publisher_.publish(HistoryMarkers(back_end_->map(), *selected_, parameters_.display_height_m, header));
}

std_msgs::Header BackEndNodelet::MapHeader(StampNs stamp_ns) const {
  std_msgs::Header header;
  header.stamp = ToTime(stamp_ns);
  header.frame_id = parameters_.map_frame;
  return header;
}

Pose BackEndNodelet::MapOdom(const std::string& session, const Robot& robot) const {
  const Pose T_continuous_odom = robot.T_odom_continuous.inverse();
  if (IsLocalization()) return robot.T_map_continuous.value_or(Pose::Identity()) * T_continuous_odom;
  const std::optional<RobotIndex> index = FindRobot(back_end_->map(), session);
  return (index ? back_end_->map().T_map_odom(*index) : Pose::Identity()) * T_continuous_odom;
}

void BackEndNodelet::Report(const BackEndStep& step) {
  const bool measure = throttle_.IsDue("memory", kMemoryPeriod_s);  // goes through the whole map
  const std::size_t memory_bytes = measure ? back_end_->memory_bytes() : 0;
  const std::lock_guard<std::mutex> lock(mutex_);
  ++status_.processed;
  status_.recognitions += step.settled.size() + (step.closure ? 1 : 0);
  ++status_.ends[ToString(step.counts.end)];
  status_.counts = step.counts;
  status_.times = step.times;
  if (measure) status_.memory_bytes = memory_bytes;
}

void BackEndNodelet::Refuse(const std::string& what) {
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    ++status_.refused;
    status_.last_error = what;
  }
  if (throttle_.IsDue("refused", kWarnPeriod_s)) NODELET_ERROR("a message was refused: %s", what.c_str());
}

void BackEndNodelet::Diagnose(diagnostic_updater::DiagnosticStatusWrapper& status) {
  using diagnostic_msgs::DiagnosticStatus;
  const std::lock_guard<std::mutex> lock(mutex_);
  const Clock::time_point now = Clock::now();
  const double elapsed_s = std::chrono::duration<double>(now - status_.reported).count();
  const double rate_hz = static_cast<double>(status_.processed - status_.reported_processed) / elapsed_s;

  if (status_.refused != status_.reported_refused)
    status.summary(DiagnosticStatus::ERROR, "a message was refused: " + status_.last_error);
  else if (status_.received == status_.reported_received)
    status.summary(DiagnosticStatus::OK, "waiting for segments on " + subscribers_.front().getTopic());
  else if (status_.processed == status_.reported_processed)
    status.summary(DiagnosticStatus::WARN, "segments come, but none could be applied: waiting for a full state");
  else
    status.summaryf(DiagnosticStatus::OK, "%.1f steps/s, %zu recognitions so far", rate_hz, status_.recognitions);

  status.add("segment arrays received", status_.received);
  status.add("segment arrays applied", status_.processed);
  status.addf("steps per second", "%.1f", rate_hz);
  status.add("segment arrays waiting", worker_->queued());
  status.add("segment arrays dropped by the full queue", worker_->dropped());
  status.add("segment arrays after a gap", status_.missed);
  status.add("messages refused", status_.refused);
  status.add("recognitions", status_.recognitions);
  status.add("loop closures published", status_.published);
  for (const auto& [end, count] : status_.ends) status.add("steps that ended: " + end, count);
  for (const auto& [name, value] : ToNamedCounts(status_.counts)) status.add(name, value);
  for (const auto& [stage, milliseconds] : status_.times) status.addf(stage + " [ms]", "%.2f", milliseconds);
  status.addf("memory [MB]", "%.1f", 1e-6 * static_cast<double>(status_.memory_bytes));

  status_.reported = now;
  status_.reported_received = status_.received;
  status_.reported_processed = status_.processed;
  status_.reported_refused = status_.refused;
}

}  // namespace incremental_segmatch

PLUGINLIB_EXPORT_CLASS(incremental_segmatch::BackEndNodelet, nodelet::Nodelet)
