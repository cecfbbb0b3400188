/// \file
/// A small pose-graph back end: odometry and loop closures in, corrected trajectories out.
#pragma once

#include <diagnostic_updater/diagnostic_updater.h>
#include <nav_msgs/Path.h>
#include <nodelet/nodelet.h>
#include <ros/ros.h>
#include <std_srvs/Trigger.h>
#include <tf2_ros/transform_broadcaster.h>

#include <chrono>
#include <map>
#include <memory>
#include <mutex>
#include <string>
#include <vector>

#include "conversions.hpp"
#include "incremental_segmatch/pose_graph.hpp"
#include "node_parameters.hpp"
#include "robot_sessions.hpp"
#include "throttle.hpp"
#include "worker.hpp"

namespace incremental_segmatch {

/// The PoseGraph of all robots. Callbacks only queue; the worker's thread owns the graph, and optimizes it when
/// closures have come and nothing else waits. A wrong parameter is FATAL, and the nodelet then stays idle.
///
/// Subscribes `segments` or `<robot>/segments` (for the sensor's poses) and `loop_closures`. Publishes, under the same
/// prefix, `trajectory` (corrected, in the map frame; after every optimization and now and then) and `odometry_path`
/// (where odometry alone has the robot; in the map frame, too, as if both began at one place); tf map to odom. A robot
/// that no closure connects with the first one has no place in the map yet, so neither trajectory nor tf. Serves
/// `write_trajectories` and `reset_pose_graph`. At the end, and when asked to, writes trajectories of the sensor (TUM)
/// and the graph (g2o), where `output_dir` says so.
class PoseGraphNodelet : public nodelet::Nodelet {
 public:
  ~PoseGraphNodelet() override;

 private:
  using Clock = std::chrono::steady_clock;

  /// A session of a robot.
  struct Robot {
    std::string name;      ///< of the robot; the session's own name is the key
    RobotIndex index = 0;  ///< in the graph
    RobotFrames frames;
    Pose T_odom_continuous = Pose::Identity();  ///< the jumps of its odometry frame so far
    std::vector<StampedPose> odometry;          ///< of the sensor, in odometry's frame without its jumps
  };
  struct Publishers {
    ros::Publisher trajectory;
    ros::Publisher odometry_path;
  };

  /// What diagnostics tell; guarded by mutex_.
  struct Status {
    std::size_t poses = 0;
    std::size_t closures = 0;
    std::size_t refused = 0;
    std::string last_error;
    PoseGraphReport report;
    double optimization_ms = 0.0;
    std::size_t reported_refused = 0;  ///< at the last report
  };

  void onInit() override;
  void Start();
  void Subscribe(const std::string& robot);
  bool OnReset(std_srvs::Trigger::Request& request, std_srvs::Trigger::Response& response);
  bool OnWrite(std_srvs::Trigger::Request& request, std_srvs::Trigger::Response& response);
  void Diagnose(diagnostic_updater::DiagnosticStatusWrapper& status);

  // In the worker's thread.
  void AddPose(const SegmentArray& message, const std::string& prefix);
  void StartOver();
  bool AddClosure(const LoopClosure& message);
  void AddWaitingClosures();
  void OptimizeIfIdle();
  void Optimize();
  bool IsInMap(const Robot& robot) const;
  void PublishTransform(const Robot& robot, const ros::Time& stamp);
  void PublishPaths();
  nav_msgs::Path CorrectedPath(const Robot& newest) const;
  void WriteTrajectories();
  void Refuse(const std::string& what);

  PoseGraphNodeParameters parameters_;
  Throttle throttle_;

  std::vector<ros::Subscriber> subscribers_;
  std::map<std::string, Publishers> publishers_;  // by prefix
  ros::ServiceServer write_service_;
  ros::ServiceServer reset_service_;
  ros::WallTimer diagnostics_timer_;
  std::unique_ptr<diagnostic_updater::Updater> diagnostics_;
  std::unique_ptr<tf2_ros::TransformBroadcaster> tf_broadcaster_;

  std::mutex mutex_;
  Status status_;

  // Owned by the worker's thread.
  std::unique_ptr<PoseGraph> graph_;
  RobotSessions sessions_;
  std::map<std::string, Robot> robots_;                // by session
  std::map<std::string, std::string> newest_session_;  // by prefix
  std::vector<LoopClosureConstPtr> waiting_closures_;  // for the query's pose
  bool has_new_closures_ = false;

  std::unique_ptr<Worker> worker_;  // last: its thread ends before anything else goes
};

}  // namespace incremental_segmatch
