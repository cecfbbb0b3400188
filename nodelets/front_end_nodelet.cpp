#include "front_end_nodelet.hpp"

#include <pluginlib/class_list_macros.hpp>

#include <algorithm>
#include <boost/make_shared.hpp>
#include <cmath>
#include <exception>
#include <utility>

#include "markers.hpp"
#include "point_cloud.hpp"

namespace incremental_segmatch {
namespace {

constexpr double kPollPeriod_s = 0.005;
constexpr double kWarnPeriod_s = 5.0;
constexpr double kMissingPeriod_s = 10.0;       // between reminders that nothing comes
constexpr double kStalePeriod_s = 60.0;         // between warnings that stamps and ROS time are far apart
constexpr double kStale_s = 10.0;               // how far that is
constexpr StampNs kJumpBackNs = 1'000'000'000;  // stamps that go back by less are late messages, by more a new run
constexpr StampNs kSameStampNs = 1'000'000;     // stacks pass stamps through doubles
constexpr std::uint32_t kCallbackQueue = 1000;  // roscpp drops without counting, so the worker's queue is to do it
constexpr std::size_t kHistorySize = 600;
constexpr double kLabelHeight_m = 0.5;           // over a segment's top
constexpr double kLetter_m = 0.7;                // height of labels
constexpr double kQuantisation = 0.02;           // of segment points, in voxels: 65 m fit into 16 bits at 2 mm
constexpr double kCoarseFloatDistance_m = 10e3;  // from here on, registered float clouds are coarser than a millimetre

bool HasFinitePoint(const Points& points) {
  return std::any_of(points.begin(), points.end(), [](const Eigen::Vector3f& p) { return p.allFinite(); });
}

/// Without a clock clouds are processed all the same, but whoever else follows ROS time waits for ever.
bool IsClockMissing() {
  return ros::Time::isSimTime() && ros::Time::now().isZero();
}

/// Clouds that nodelets of ours show, which nobody wants for input.
bool IsDisplay(const std::string& topic) {
  const std::string name = topic.substr(topic.rfind('/') + 1);
  return name == "local_cloud" || name == "target_segments";
}

/// In words, why no publisher of a topic is connected: what is on it, and where there are messages of its type.
std::string WhyNobodyPublishes(const std::string& topic, const std::string& type) {
  ros::master::V_TopicInfo topics;
  if (!ros::master::getTopics(topics)) return "nobody publishes " + topic + "; the master does not answer";
  std::string type_there, elsewhere;
  for (const ros::master::TopicInfo& other : topics) {
    if (other.name == topic)
      type_there = other.datatype;
    else if (other.datatype == type && !IsDisplay(other.name))
      elsewhere += (elsewhere.empty() ? "" : ", ") + other.name;
  }
  const std::string message = type.substr(type.find('/') + 1);
  return (type_there.empty() || type_there == type ? "nobody publishes " + topic
                                                   : topic + " has " + type_there + ", not " + message) +
         "; " +
         (elsewhere.empty() ? "no " + message + " is published at all" : message + " is published on: " + elsewhere);
}

}  // namespace

FrontEndNodelet::~FrontEndNodelet() {
  // First, so that no callback runs any more when the worker goes.
  cloud_subscriber_.shutdown();
  pose_subscriber_.shutdown();
  trajectory_subscriber_.shutdown();
  corrected_odometry_subscriber_.shutdown();
  full_state_service_.shutdown();
  reset_service_.shutdown();
  diagnostics_timer_.stop();
  tuning_.reset();
  worker_.reset();
}

void FrontEndNodelet::onInit() {
  try {
    Start();
  } catch (const std::exception& error) {
    NODELET_FATAL("the front end does not start: %s", error.what());
  }
}

void FrontEndNodelet::Start() {
  ros::NodeHandle& nh = getNodeHandle();
  const NodeletParameters<FrontEndNodeParameters> parameters = ReadFrontEndParameters(getPrivateNodeHandle());
  parameters_ = parameters.node;
  core_parameters_ = parameters.core.front_end;
  front_end_ = std::make_unique<FrontEnd>(core_parameters_, parameters_.robot);
  session_ = ros::WallTime::now().toNSec();
  locator_ = std::make_unique<SensorLocator>(parameters_);
  worker_ = std::make_unique<Worker>(parameters_.queue_size,
                                     [this](const std::string& what) { Skip("internal error", what); });

  segments_publisher_ = nh.advertise<SegmentArray>("segments", 10);
  local_cloud_publisher_ = nh.advertise<sensor_msgs::PointCloud2>("local_cloud", 1);
  labels_publisher_ = nh.advertise<visualization_msgs::MarkerArray>("local_labels", 1);
  steps_publisher_ = nh.advertise<StepReport>("front_end_steps", 10);
  full_state_service_ = nh.advertiseService(segments_publisher_.getTopic() + "/request_full_state",
                                            &FrontEndNodelet::OnRequestFullState, this);
  reset_service_ = nh.advertiseService(segments_publisher_.getTopic() + "/reset", &FrontEndNodelet::OnReset, this);
  if (parameters_.pose_source == PoseSource::kOdometry)
    pose_subscriber_ = nh.subscribe("odometry", 200, &FrontEndNodelet::OnOdometry, this);
  if (parameters_.pose_source == PoseSource::kPose)
    pose_subscriber_ = nh.subscribe("pose", 200, &FrontEndNodelet::OnPose, this);
  if (parameters_.frame_jumps) {
    trajectory_subscriber_ = nh.subscribe("trajectory", 1, &FrontEndNodelet::OnTrajectory, this);
    corrected_odometry_subscriber_ = nh.subscribe("corrected_odometry", 1, &FrontEndNodelet::OnCorrectedOdometry, this);
  }
  cloud_subscriber_ = nh.subscribe("points", kCallbackQueue, &FrontEndNodelet::OnCloud, this);

  diagnostics_ = std::make_unique<diagnostic_updater::Updater>(nh, getPrivateNodeHandle(), getName());
  diagnostics_->setHardwareID("none");
  diagnostics_->add("front end", this, &FrontEndNodelet::Diagnose);
  diagnostics_timer_ = nh.createWallTimer(ros::WallDuration(1.0), [this](const ros::WallTimerEvent&) {
    diagnostics_->force_update();
    SayWhatIsMissing();
  });
  tuning_ = std::make_unique<Tuning<FrontEndConfig>>(
      getPrivateNodeHandle(), ToConfig(parameters),
      [this](const FrontEndConfig& config) { worker_->Run([this, &config] { Change(config); }); });
  throttle_.IsDue("missing", kMissingPeriod_s);  // time to start for everybody, before something is missing
  NODELET_INFO("front end of %s: clouds from %s, poses from %s", parameters_.robot.c_str(),
               cloud_subscriber_.getTopic().c_str(),
               parameters_.pose_source == PoseSource::kTf ? "tf" : pose_subscriber_.getTopic().c_str());
}

void FrontEndNodelet::OnCloud(const sensor_msgs::PointCloud2ConstPtr& cloud) {
  const double age_s = (ros::Time::now() - cloud->header.stamp).toSec();
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    ++status_.received;
    status_.stamp_age_s = age_s;
  }
  if (std::abs(age_s) > kStale_s && !cloud->header.stamp.isZero() && !ros::Time::now().isZero() &&
      throttle_.IsDue("stale", kStalePeriod_s))
    NODELET_WARN(
        "stamps on %s are %.1f s %s ROS time: if a bag plays, set /use_sim_time and play it with --clock; if "
        "not, the sensor's clock is wrong. Clouds are used all the same, at their stamps",
        cloud_subscriber_.getTopic().c_str(), std::abs(age_s), age_s > 0.0 ? "behind" : "ahead of");
  const std::size_t dropped = worker_->dropped();
  worker_->Post([this, cloud, received = Clock::now()] { ProcessCloud(*cloud, received); });
  if (worker_->dropped() > dropped && throttle_.IsDue("dropped", kWarnPeriod_s))
    NODELET_WARN("%zu scans dropped so far: they come faster than they are processed", worker_->dropped());
}

void FrontEndNodelet::OnOdometry(const nav_msgs::OdometryConstPtr& odometry) {
  try {
    locator_->AddOdometry(*odometry);
  } catch (const std::invalid_argument& error) {
    if (throttle_.IsDue("odometry", kWarnPeriod_s)) NODELET_WARN("an odometry message is left out: %s", error.what());
  }
}

void FrontEndNodelet::OnPose(const geometry_msgs::PoseStampedConstPtr& pose) {
  try {
    locator_->AddPose(*pose);
  } catch (const std::invalid_argument& error) {
    if (throttle_.IsDue("pose", kWarnPeriod_s)) NODELET_WARN("a pose is left out: %s", error.what());
  }
}

void FrontEndNodelet::OnTrajectory(const nav_msgs::PathConstPtr& path) {
  const std::lock_guard<std::mutex> lock(mutex_);
  trajectory_ = path;
}

/// A trajectory of one pose.
void FrontEndNodelet::OnCorrectedOdometry(const nav_msgs::OdometryConstPtr& odometry) {
  const auto path = boost::make_shared<nav_msgs::Path>();
  path->header = odometry->header;
  path->poses.resize(1);
  path->poses[0].header = odometry->header;
  path->poses[0].pose = odometry->pose.pose;
  OnTrajectory(path);
}

bool FrontEndNodelet::OnRequestFullState(RequestFullState::Request& /*request*/, RequestFullState::Response& response) {
  worker_->PostAlways([this] { full_state_wanted_ = true; });
  response.success = true;
  response.message = "the next delta is a full state";
  return true;
}

bool FrontEndNodelet::OnReset(std_srvs::Trigger::Request& /*request*/, std_srvs::Trigger::Response& response) {
  worker_->PostAlways([this] { Restart(); });
  response.success = true;
  response.message = "the local map of " + parameters_.robot + " is forgotten";
  return true;
}

void FrontEndNodelet::ProcessCloud(const sensor_msgs::PointCloud2& cloud, Clock::time_point received) {
  if (std::size_t{cloud.width} * cloud.height == 0) return Skip("empty", "the cloud is empty");
  if (!AcceptStamp(cloud)) return;
  const std::optional<SensorLocation> location = WaitForLocation(cloud, received);
  if (!location) return;
  Scan scan;
  scan.stamp_ns = ToStampNs(cloud.header.stamp);
  scan.T_odom_sensor = location->T_odom_sensor;
  try {
    if (parameters_.frame_jumps) FollowTrajectory(cloud.header.stamp, received);
    scan.points_sensor = ReadScanPoints(cloud, *location);
    if (!HasFinitePoint(scan.points_sensor))
      return Skip("no finite point",
                  "none of the cloud's " + std::to_string(scan.points_sensor.size()) + " points is finite");
    FrontEndStep step = front_end_->Process(scan);
    history_.push_back({scan.stamp_ns, scan.T_odom_sensor});
    if (history_.size() > kHistorySize) history_.pop_front();
    frames_ = location->frames;
    Publish(std::move(step), *location, received);
  } catch (const std::invalid_argument& error) {
    Skip("unusable", error.what());
  }
}

bool FrontEndNodelet::AcceptStamp(const sensor_msgs::PointCloud2& cloud) {
  if (cloud.header.stamp.isZero()) {
    Skip("no stamp", "the cloud's stamp is 0; it has to be the time of the scan");
    return false;
  }
  const StampNs stamp_ns = ToStampNs(cloud.header.stamp);
  if (last_stamp_ns_ && stamp_ns <= *last_stamp_ns_) {
    if (*last_stamp_ns_ - stamp_ns < kJumpBackNs) {
      Skip("out of order", "the cloud is not newer than the last one");
      return false;
    }
    NODELET_WARN("time jumped back by %.1f s (a bag that starts again?): the front end of %s starts over",
                 1e-9 * static_cast<double>(*last_stamp_ns_ - stamp_ns), parameters_.robot.c_str());
    locator_->Clear();
    Restart();
  }
  last_stamp_ns_ = stamp_ns;
  return true;
}

void FrontEndNodelet::Restart() {
  front_end_ = std::make_unique<FrontEnd>(core_parameters_, parameters_.robot);
  session_ = std::max(ros::WallTime::now().toNSec(), session_ + 1);
  history_.clear();
  const std::lock_guard<std::mutex> lock(mutex_);
  ++status_.restarts;
}

std::optional<SensorLocation> FrontEndNodelet::WaitForLocation(const sensor_msgs::PointCloud2& cloud,
                                                               Clock::time_point received) {
  const std::string cloud_frame = FrameName(cloud.header.frame_id);
  if (parameters_.registered && cloud_frame.empty()) {
    Skip("no frame", "the registered cloud has no frame_id");
    return std::nullopt;
  }
  const std::string sensor_frame = parameters_.sensor_frame.empty() ? cloud_frame : FrameName(parameters_.sensor_frame);
  if (sensor_frame.empty()) {
    Skip("no frame", "the cloud has no frame_id, and sensor_frame is not set");
    return std::nullopt;
  }
  const auto deadline = received + std::chrono::duration<double>(parameters_.pose_timeout_s);
  while (true) {
    LocateResult result = locator_->Locate(cloud.header.stamp, sensor_frame, parameters_.registered ? cloud_frame : "");
    if (result.location) return result.location;
    if (worker_->stopping()) return std::nullopt;
    if (Clock::now() >= deadline) {
      Skip("no pose", result.reason);
      return std::nullopt;
    }
    worker_->SleepFor(kPollPeriod_s);
  }
}

Points FrontEndNodelet::ReadScanPoints(const sensor_msgs::PointCloud2& cloud, const SensorLocation& location) const {
  return parameters_.registered ? ReadPoints(cloud, location.T_odom_sensor.inverse() * location.T_odom_registered)
                                : ReadPoints(cloud);
}

/// Follows the newest trajectory; waits a little for one that is no older than the cloud.
void FrontEndNodelet::FollowTrajectory(const ros::Time& stamp, Clock::time_point received) {
  const auto deadline = received + std::chrono::duration<double>(parameters_.trajectory_wait_s);
  const auto has_come = [this, &stamp] {
    const std::lock_guard<std::mutex> lock(mutex_);
    return trajectory_ && trajectory_->header.stamp >= stamp;
  };
  while (!has_come() && Clock::now() < deadline && !worker_->stopping()) worker_->SleepFor(kPollPeriod_s);
  nav_msgs::PathConstPtr path;
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    path.swap(trajectory_);
  }
  if (path) FollowJump(*path);
}

/// The newest pose of the trajectory that was used for a cloud tells whether the frame has jumped since.
void FrontEndNodelet::FollowJump(const nav_msgs::Path& path) {
  if (FrameName(path.header.frame_id) != FrameName(parameters_.odom_frame)) {
    if (throttle_.IsDue("trajectory", kWarnPeriod_s))
      NODELET_WARN("the trajectory is in frame %s, but the frame that jumps is %s (odom_frame): it is not followed",
                   path.header.frame_id.c_str(), parameters_.odom_frame.c_str());
    return;
  }
  for (auto corrected = path.poses.rbegin(); corrected != path.poses.rend(); ++corrected) {
    const StampNs stamp_ns = ToStampNs(corrected->header.stamp);
    const auto used = std::find_if(history_.rbegin(), history_.rend(), [stamp_ns](const StampedPose& pose) {
      return std::abs(pose.stamp_ns - stamp_ns) < kSameStampNs;
    });
    if (used == history_.rend()) continue;
    const Pose T_new_old = ToSensorPose(corrected->pose, "trajectory", parameters_.trajectory_kind, frames_) *
                           used->T_frame_sensor.inverse();
    if (T_new_old.isApprox(Pose::Identity(), 1e-6)) return;
    front_end_->ApplyJump(T_new_old);
    for (StampedPose& pose : history_) pose.T_frame_sensor = T_new_old * pose.T_frame_sensor;
    return;
  }
}

void FrontEndNodelet::Skip(const std::string& kind, const std::string& reason) {
  std::size_t count = 0;
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    count = ++status_.skipped[kind];
    status_.last_skip = reason;
  }
  if (throttle_.IsDue(kind, kWarnPeriod_s)) NODELET_WARN("%zu scans skipped so far: %s", count, reason.c_str());
}

void FrontEndNodelet::Publish(FrontEndStep step, const SensorLocation& location, Clock::time_point received) {
  std_msgs::Header header;
  header.stamp = ToTime(step.delta.stamp_ns);
  header.frame_id = location.frames.odom_frame;
  if (segments_publisher_.getNumSubscribers() > 0) {
    const SegmentDelta delta = full_state_wanted_ ? front_end_->FullState() : std::move(step.delta);
    full_state_wanted_ = false;
    segments_publisher_.publish(boost::make_shared<const SegmentArray>(
        ToSegmentArray(delta, location.frames, session_, kQuantisation * core_parameters_.grid.resolution_m,
                       parameters_.send_points)));
  }
  if (local_cloud_publisher_.getNumSubscribers() + labels_publisher_.getNumSubscribers() > 0) PublishLocalCloud(header);
  if (steps_publisher_.getNumSubscribers() > 0)
    steps_publisher_.publish(ToStepReport(header, parameters_.robot, step.times, ToNamedCounts(step.counts), ""));

  const std::lock_guard<std::mutex> lock(mutex_);
  ++status_.processed;
  status_.counts = step.counts;
  status_.times = step.times;
  status_.memory_bytes = front_end_->memory_bytes();
  status_.distance_m = location.T_odom_sensor.translation().norm();
  status_.latency_ms = std::chrono::duration<double, std::milli>(Clock::now() - received).count();
}

void FrontEndNodelet::PublishLocalCloud(const std_msgs::Header& header) {
  std::vector<ColouredPoint> points;
  std::map<SegmentId, Label> labels;
  for (const LocalPoint& point : front_end_->LocalCloud()) {
    const std::uint32_t colour = SegmentColour({0, point.segment});
    points.push_back({point.position_odom, colour});
    if (point.segment == kNoSegment) continue;
    Label& label = labels
                       .try_emplace(point.segment,
                                    Label{point.position_odom.cast<double>(), std::to_string(point.segment), colour})
                       .first->second;
    if (point.position_odom.z() > label.position.z()) label.position = point.position_odom.cast<double>();
  }
  if (local_cloud_publisher_.getNumSubscribers() > 0)
    local_cloud_publisher_.publish(boost::make_shared<const sensor_msgs::PointCloud2>(ToPointCloud2(points, header)));
  if (labels_publisher_.getNumSubscribers() == 0) return;
  std::vector<Label> list;
  for (auto& [segment, label] : labels) {
    label.position.z() += kLabelHeight_m;
    list.push_back(std::move(label));
  }
  labels_publisher_.publish(LabelMarkers(list, "local", kLetter_m, header));
}

/// Throws std::invalid_argument, naming the parameter, if the core refuses: nothing has changed then.
void FrontEndNodelet::Change(const FrontEndConfig& config) {
  NodeletParameters<FrontEndNodeParameters> parameters{parameters_, Parameters()};
  parameters.core.front_end = core_parameters_;
  try {
    parameters = WithConfig(std::move(parameters), config);
    const FrontEndParameters& core = parameters.core.front_end;
    front_end_->ChangeParameters(core.ground, core.local_radius_m, core.view);
  } catch (const std::invalid_argument& error) {
    NODELET_WARN("a change of the parameters is refused: %s", error.what());
    throw;
  }
  core_parameters_ = parameters.core.front_end;
  parameters_.pose_timeout_s = parameters.node.pose_timeout_s;
  NODELET_INFO("the parameters have changed");
}

bool FrontEndNodelet::IsTrajectoryMissing() const {
  return parameters_.frame_jumps &&
         trajectory_subscriber_.getNumPublishers() + corrected_odometry_subscriber_.getNumPublishers() == 0;
}

/// In words, why nothing can come; empty if that is not known.
std::string FrontEndNodelet::WhatIsMissing() const {
  using ros::message_traits::datatype;
  if (IsClockMissing())
    return "/use_sim_time is set, but nobody publishes /clock: play the bag with --clock, or unset it";
  if (cloud_subscriber_.getNumPublishers() == 0)
    return WhyNobodyPublishes(cloud_subscriber_.getTopic(), datatype<sensor_msgs::PointCloud2>());
  if (parameters_.pose_source != PoseSource::kTf && pose_subscriber_.getNumPublishers() == 0)
    return "no poses of the sensor: " +
           WhyNobodyPublishes(pose_subscriber_.getTopic(), parameters_.pose_source == PoseSource::kOdometry
                                                               ? datatype<nav_msgs::Odometry>()
                                                               : datatype<geometry_msgs::PoseStamped>());
  if (IsTrajectoryMissing())
    return "no jump of " + parameters_.odom_frame + " will be followed (frame_jumps): nobody publishes " +
           corrected_odometry_subscriber_.getTopic() + ", and " +
           WhyNobodyPublishes(trajectory_subscriber_.getTopic(), datatype<nav_msgs::Path>());
  return "";
}

/// A reminder in the log, as long as nothing has come at all, or no clock, or jumps would be missed.
void FrontEndNodelet::SayWhatIsMissing() {
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    if (status_.processed > 0 && !IsClockMissing() && !IsTrajectoryMissing()) return;
  }
  if (!throttle_.IsDue("missing", kMissingPeriod_s)) return;
  const std::string missing = WhatIsMissing();
  if (!missing.empty()) NODELET_WARN("%s", missing.c_str());
}

void FrontEndNodelet::Diagnose(diagnostic_updater::DiagnosticStatusWrapper& status) {
  using diagnostic_msgs::DiagnosticStatus;
  const std::string missing = WhatIsMissing();
  const std::lock_guard<std::mutex> lock(mutex_);
  const Clock::time_point now = Clock::now();
  const double elapsed_s = std::chrono::duration<double>(now - status_.reported).count();
  std::size_t skipped = 0;
  for (const auto& [kind, count] : status_.skipped) skipped += count;
  const double rate_hz = static_cast<double>(status_.processed - status_.reported_processed) / elapsed_s;

  const std::size_t dropped = worker_->dropped();
  if (!missing.empty() && (status_.received == status_.reported_received || IsClockMissing() || IsTrajectoryMissing()))
    status.summary(DiagnosticStatus::WARN, missing);
  else if (skipped != status_.reported_skipped)
    status.summary(DiagnosticStatus::WARN, "scans are skipped: " + status_.last_skip);
  else if (dropped != status_.reported_dropped)
    status.summaryf(DiagnosticStatus::WARN, "%.1f scans/s, and %zu dropped since the last report: they come faster",
                    rate_hz, dropped - status_.reported_dropped);
  else if (parameters_.registered && status_.distance_m > kCoarseFloatDistance_m)
    status.summary(DiagnosticStatus::WARN,
                   "so far from the origin, registered float clouds are coarse: publish doubles");
  else if (status_.received == status_.reported_received)
    status.summary(DiagnosticStatus::OK, "waiting for clouds on " + cloud_subscriber_.getTopic());
  else
    status.summaryf(DiagnosticStatus::OK, "%.1f scans/s", rate_hz);

  status.add("scans received", status_.received);
  status.add("scans processed", status_.processed);
  status.addf("scans per second", "%.1f", rate_hz);
  status.add("scans waiting", worker_->queued());
  status.add("scans dropped by the full queue", dropped);
  for (const auto& [kind, count] : status_.skipped) status.add("scans skipped: " + kind, count);
  status.add("starts over", status_.restarts);
  status.addf("stamps behind ROS time [s]", "%.3f", status_.stamp_age_s);
  status.addf("arrival to segments [ms]", "%.1f", status_.latency_ms);
  for (const auto& [name, value] : ToNamedCounts(status_.counts)) status.add(name, value);
  for (const auto& [stage, milliseconds] : status_.times) status.addf(stage + " [ms]", "%.2f", milliseconds);
  status.addf("memory [MB]", "%.1f", 1e-6 * static_cast<double>(status_.memory_bytes));

  status_.reported = now;
  status_.reported_received = status_.received;
  status_.reported_processed = status_.processed;
  status_.reported_skipped = skipped;
  status_.reported_dropped = dropped;
}

}  // namespace incremental_segmatch

PLUGINLIB_EXPORT_CLASS(incremental_segmatch::FrontEndNodelet, nodelet::Nodelet)
