/// \file
/// Map side as a nodelet: segments of any number of robots in, loop closures or localizations out.
#pragma once

#include <diagnostic_updater/diagnostic_updater.h>
#include <geometry_msgs/PointStamped.h>
#include <incremental_segmatch/LoadMap.h>
#include <incremental_segmatch/SaveMap.h>
#include <nav_msgs/Odometry.h>
#include <nav_msgs/Path.h>
#include <nodelet/nodelet.h>
#include <ros/callback_queue.h>
#include <ros/ros.h>
#include <std_srvs/Trigger.h>
#include <tf2_ros/transform_broadcaster.h>

#include <chrono>
#include <map>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <vector>

#include "closure_log.hpp"
#include "conversions.hpp"
#include "incremental_segmatch/back_end.hpp"
#include "node_parameters.hpp"
#include "robot_sessions.hpp"
#include "throttle.hpp"
#include "tuning.hpp"
#include "worker.hpp"

namespace incremental_segmatch {

/// The BackEnd of all robots. Callbacks only queue; the worker's thread owns the BackEnd and publishes. A delta that is
/// missing makes it ask the robot's front end for a full state. A wrong parameter is FATAL, and the nodelet then stays
/// idle.
///
/// Subscribes `segments`, `trajectory` and `corrected_odometry`, or the same below `<robot>/`; `clicked_point`.
/// Publishes `loop_closures`; `localization` and tf (in localization); for rviz `target_segments`, `target_labels`,
/// `refused_matches`, `accepted_matches`, `residuals`, `closure_lines`, `selected_segment`; `back_end_steps`;
/// diagnostics. Serves `save_map`, `load_map`, `reset`, `trigger`, and dynamic_reconfigure below `~tuning`.
class BackEndNodelet : public nodelet::Nodelet {
 public:
  ~BackEndNodelet() override;

 private:
  using Clock = std::chrono::steady_clock;

  /// A session of a robot. Owned by the worker's thread.
  struct Robot {
    std::string name;  ///< of the robot; the session's own name is the key
    RobotFrames frames;
    StampNs stamp_ns = 0;  ///< of the last delta, as the next two
    Pose T_odom_sensor = Pose::Identity();
    Pose T_odom_continuous = Pose::Identity();  ///< jumps of odometry
    std::optional<Pose> T_map_continuous;       ///< of the last recognition
    std::vector<StampedPose> corrected;         ///< that came one by one: T_map_sensor, ascending stamps
    std::optional<double> published_path_m;     ///< at the query of the last published closure
    StampNs published_ns = 0;
  };

  /// The two poses of an accepted recognition.
  struct ClosureEnds {
    std::string robot_query;
    StampNs stamp_query_ns;
    std::string robot_target;
    StampNs stamp_target_ns;
  };

  /// What diagnostics tell; guarded by mutex_.
  struct Status {
    std::size_t received = 0;
    std::size_t processed = 0;
    std::size_t missed = 0;
    std::size_t refused = 0;
    std::size_t recognitions = 0;
    std::size_t published = 0;
    std::string last_error;
    std::map<std::string, std::size_t> ends;
    BackEndCounts counts;
    StageTimes times;
    std::size_t memory_bytes = 0;
    std::size_t reported_received = 0;  ///< at the last report, as the next two
    std::size_t reported_processed = 0;
    std::size_t reported_refused = 0;
    Clock::time_point reported = Clock::now();
  };

  void onInit() override;
  void Start();
  void Subscribe(const std::string& robot);
  bool OnSaveMap(SaveMap::Request& request, SaveMap::Response& response);
  bool OnLoadMap(LoadMap::Request& request, LoadMap::Response& response);
  bool OnReset(std_srvs::Trigger::Request& request, std_srvs::Trigger::Response& response);
  bool OnTrigger(std_srvs::Trigger::Request& request, std_srvs::Trigger::Response& response);
  void Diagnose(diagnostic_updater::DiagnosticStatusWrapper& status);

  // In the worker's thread.
  void StartOver();
  void RequireStarted() const;
  std::string Reset();
  std::string RecognizeAgain(bool* recognized);
  void Change(const BackEndConfig& config);
  void ProcessSegments(const SegmentArray& message, const std::string& topic);
  Robot& Meet(const std::string& session, const SegmentArray& message);
  void RequestFullState(const std::string& topic);
  std::vector<std::string> SessionsOf(const std::string& robot);
  void CorrectTrajectory(const std::string& robot, const nav_msgs::Path& path);
  void CorrectPose(const std::string& robot, const nav_msgs::Odometry& odometry);
  void Publish(const BackEndStep& step, const std::string& session, Robot& robot);
  void Record(const Closure& closure);
  bool IsDue(const Closure& closure, const Robot& robot) const;
  void PublishClosure(const Closure& closure, Robot& robot);
  void PublishLocalization(const Closure& closure, const Robot& robot);
  void PublishTransform(const Robot& robot);
  void PublishMatches(const BackEndStep& step, const std::string& session, const Robot& robot);
  void PublishMap(const std::string& session, const Robot& robot);
  void PublishClosureLines(const std_msgs::Header& header);
  void Select(const geometry_msgs::PointStamped& point);
  void PublishSelected();
  std_msgs::Header MapHeader(StampNs stamp_ns) const;
  Pose MapOdom(const std::string& session, const Robot& robot) const;
  void Report(const BackEndStep& step);
  void Refuse(const std::string& what);
  bool IsLocalization() const { return core_parameters_.mode == Mode::kLocalization; }

  BackEndNodeParameters parameters_;   // what may change, the worker's thread changes
  BackEndParameters core_parameters_;  // likewise
  Throttle throttle_;

  // Services wait for the worker, which may be waiting for the front end's. In a thread of their own, so that they take
  // none of the manager's from the front end: on one core it has one.
  ros::CallbackQueue service_queue_;
  ros::AsyncSpinner service_spinner_{1, &service_queue_};

  std::vector<ros::Subscriber> subscribers_;
  std::vector<std::string> segments_topics_;
  ros::Publisher closures_publisher_;
  ros::Publisher localization_publisher_;
  ros::Publisher targets_publisher_;
  ros::Publisher labels_publisher_;
  ros::Publisher refused_publisher_;
  ros::Publisher accepted_publisher_;
  ros::Publisher residuals_publisher_;
  ros::Publisher selected_publisher_;
  ros::Publisher closure_lines_publisher_;
  ros::Publisher steps_publisher_;
  ros::ServiceServer save_service_;
  ros::ServiceServer load_service_;
  ros::ServiceServer reset_service_;
  ros::ServiceServer trigger_service_;
  ros::WallTimer diagnostics_timer_;
  std::unique_ptr<diagnostic_updater::Updater> diagnostics_;
  std::unique_ptr<tf2_ros::TransformBroadcaster> tf_broadcaster_;
  std::unique_ptr<Tuning<BackEndConfig>> tuning_;

  std::mutex mutex_;
  Status status_;

  // Owned by the worker's thread.
  std::unique_ptr<BackEnd> back_end_;
  std::string why_not_started_;
  std::unique_ptr<ClosureLog> closure_log_;
  RobotSessions sessions_;
  std::map<std::string, Robot> robots_;  // by session
  std::vector<ClosureEnds> closures_;
  std::optional<SegmentKey> selected_;

  std::unique_ptr<Worker> worker_;  // last: its thread ends before anything else goes
};

}  // namespace incremental_segmatch
