/// \file
/// Robot side as a nodelet: clouds and poses in, segments out.
#pragma once

#include <diagnostic_updater/diagnostic_updater.h>
#include <geometry_msgs/PoseStamped.h>
#include <incremental_segmatch/RequestFullState.h>
#include <nav_msgs/Odometry.h>
#include <nav_msgs/Path.h>
#include <nodelet/nodelet.h>
#include <ros/ros.h>
#include <sensor_msgs/PointCloud2.h>
#include <std_srvs/Trigger.h>

#include <chrono>
#include <deque>
#include <map>
#include <memory>
#include <mutex>
#include <optional>
#include <string>

#include "conversions.hpp"
#include "incremental_segmatch/front_end.hpp"
#include "node_parameters.hpp"
#include "sensor_locator.hpp"
#include "throttle.hpp"
#include "tuning.hpp"
#include "worker.hpp"

namespace incremental_segmatch {

/// One robot's FrontEnd. Callbacks only queue; the worker's thread owns the FrontEnd, reads clouds, waits for their
/// poses and publishes. Bad scans are skipped, counted and explained (log, diagnostics); a wrong parameter is FATAL,
/// and the nodelet then stays idle.
///
/// Subscribes `points`; `odometry` or `pose` if that is the source of poses; `trajectory` and `corrected_odometry` if odom jumps. Publishes
/// `segments`, `local_cloud` (coloured by segment) and `local_labels` (IDs), `front_end_steps`, diagnostics. Serves
/// `<segments>/request_full_state` and `<segments>/reset`, and dynamic_reconfigure below `~tuning`. Says what is
/// missing while nothing comes.
class FrontEndNodelet : public nodelet::Nodelet {
 public:
  ~FrontEndNodelet() override;

 private:
  using Clock = std::chrono::steady_clock;

  /// What diagnostics tell; guarded by mutex_.
  struct Status {
    std::size_t received = 0;
    std::size_t processed = 0;
    std::map<std::string, std::size_t> skipped;  ///< by kind
    std::string last_skip;                       ///< the reason, in words
    std::size_t restarts = 0;
    FrontEndCounts counts;
    StageTimes times;
    std::size_t memory_bytes = 0;
    double distance_m = 0.0;            ///< of the sensor from odom's origin
    double stamp_age_s = 0.0;           ///< ROS time minus the last cloud's stamp, when it came
    double latency_ms = 0.0;            ///< from the last cloud's arrival to its segments
    std::size_t reported_received = 0;  ///< at the last report, as the next three
    std::size_t reported_processed = 0;
    std::size_t reported_skipped = 0;
    std::size_t reported_dropped = 0;
    Clock::time_point reported = Clock::now();
  };

  void onInit() override;
  void Start();
  void OnCloud(const sensor_msgs::PointCloud2ConstPtr& cloud);
  void OnOdometry(const nav_msgs::OdometryConstPtr& odometry);
  void OnPose(const geometry_msgs::PoseStampedConstPtr& pose);
  void OnTrajectory(const nav_msgs::PathConstPtr& path);
  void OnCorrectedOdometry(const nav_msgs::OdometryConstPtr& odometry);
  bool OnRequestFullState(RequestFullState::Request& request, RequestFullState::Response& response);
  bool OnReset(std_srvs::Trigger::Request& request, std_srvs::Trigger::Response& response);
  void Diagnose(diagnostic_updater::DiagnosticStatusWrapper& status);
  bool IsTrajectoryMissing() const;
  std::string WhatIsMissing() const;
  void SayWhatIsMissing();

  // In the worker's thread.
  void ProcessCloud(const sensor_msgs::PointCloud2& cloud, Clock::time_point received);
  bool AcceptStamp(const sensor_msgs::PointCloud2& cloud);
  std::optional<SensorLocation> WaitForLocation(const sensor_msgs::PointCloud2& cloud, Clock::time_point received);
  Points ReadScanPoints(const sensor_msgs::PointCloud2& cloud, const SensorLocation& location) const;
  void FollowTrajectory(const ros::Time& stamp, Clock::time_point received);
  void FollowJump(const nav_msgs::Path& path);
  void Restart();
  void Skip(const std::string& kind, const std::string& reason);
  void Publish(FrontEndStep step, const SensorLocation& location, Clock::time_point received);
  void PublishLocalCloud(const std_msgs::Header& header);
  void Change(const FrontEndConfig& config);

  FrontEndNodeParameters parameters_;   // what may change, the worker's thread changes
  FrontEndParameters core_parameters_;  // likewise
  Throttle throttle_;

  ros::Subscriber cloud_subscriber_;
  ros::Subscriber pose_subscriber_;  // of odometry or poses
  ros::Subscriber trajectory_subscriber_;
  ros::Subscriber corrected_odometry_subscriber_;
  ros::Publisher segments_publisher_;
  ros::Publisher local_cloud_publisher_;
  ros::Publisher labels_publisher_;
  ros::Publisher steps_publisher_;
  ros::ServiceServer full_state_service_;
  ros::ServiceServer reset_service_;
  ros::WallTimer diagnostics_timer_;
  std::unique_ptr<diagnostic_updater::Updater> diagnostics_;
  std::unique_ptr<SensorLocator> locator_;
  std::unique_ptr<Tuning<FrontEndConfig>> tuning_;

  std::mutex mutex_;
  Status status_;
  nav_msgs::PathConstPtr trajectory_;  // the newest that was not followed yet; guarded by mutex_

  // Owned by the worker's thread.
  std::unique_ptr<FrontEnd> front_end_;
  std::uint64_t session_ = 0;
  bool full_state_wanted_ = false;
  std::optional<StampNs> last_stamp_ns_;  // of any cloud seen in this session
  std::deque<StampedPose> history_;       // poses used lately, to recognise a jump by
  RobotFrames frames_;

  std::unique_ptr<Worker> worker_;  // last: its thread ends before anything else goes
};

}  // namespace incremental_segmatch
