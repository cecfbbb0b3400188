// Other stacks' topics, as they publish them: LOAM's and LIO-SAM's. The nodelets are started by segmatch.launch.
#include <geometry_msgs/PoseStamped.h>
#include <gtest/gtest.h>
#include <nav_msgs/Odometry.h>
#include <nav_msgs/Path.h>
#include <ros/ros.h>
#include <std_msgs/Float64MultiArray.h>
#include <std_srvs/Trigger.h>
#include <tf2_ros/static_transform_broadcaster.h>

#include <algorithm>
#include <cmath>
#include <string>
#include <vector>

#include "conversions.hpp"
#include "synthetic_drive.hpp"
#include "waiting.hpp"

namespace incremental_segmatch {
namespace {

using test::SyntheticDrive;
using test::WaitFor;

/// LOAM's axes: z forwards, x to the left, y up.
Pose ZUpToLoam() {
  Pose T = Pose::Identity();
  T.linear() << 0, 0, 1, 1, 0, 0, 0, 1, 0;
  return T;
}

class Stacks : public testing::Test {
 protected:
  /// Listens to the nodelets under a namespace and publishes clouds for them.
  void Connect(const std::string& ns, const std::string& cloud_topic) {
    clouds_ = nh_.advertise<sensor_msgs::PointCloud2>(cloud_topic, 10);
    steps_ = nh_.subscribe<StepReport>(
        ns + "/back_end_steps", 10,
        boost::function<void(const StepReportConstPtr&)>([this](const StepReportConstPtr&) { ++answered_; }));
    closures_ = nh_.subscribe<LoopClosure>(ns + "/loop_closures", 100,
                                           boost::function<void(const LoopClosureConstPtr&)>(
                                               [this](const LoopClosureConstPtr& m) { received_.push_back(*m); }));
    ASSERT_TRUE(WaitFor([this] {
      return clouds_.getNumSubscribers() > 0 && steps_.getNumPublishers() > 0 && closures_.getNumPublishers() > 0;
    }));
  }

  /// The scan in a frame of which T_frame_sensor is the sensor's pose, as a registered cloud.
  void PublishRegistered(int scan, const Pose& T_frame_sensor, const std::string& frame) {
    std::vector<ColouredPoint> points;
    for (const Eigen::Vector3f& p : drive_.Scan(scan))
      points.push_back({(T_frame_sensor * p.cast<double>()).cast<float>(), 0});
    std_msgs::Header header;
    header.stamp = ToTime(drive_.stamp_ns(scan));
    header.frame_id = frame;
    clouds_.publish(ToPointCloud2(points, header));
  }

  bool IsAnswered(std::size_t expected) {
    return WaitFor([this, expected] { return answered_ >= expected; }, 5.0);
  }

  int ScanAt(const ros::Time& stamp) const {
    return static_cast<int>((ToStampNs(stamp) - SyntheticDrive::kStartNs) / SyntheticDrive::kPeriodNs);
  }

  /// Error of a closure between sensors.
  double Error_m(const LoopClosure& closure) const {
    const Pose truth = drive_.T_world_sensor(ScanAt(closure.stamp_target)).inverse() *
                       drive_.T_world_sensor(ScanAt(closure.stamp_query));
    return (ToPose(closure.relative_pose.pose, "").translation() - truth.translation()).norm();
  }

  SyntheticDrive drive_;
  ros::NodeHandle nh_;
  ros::Publisher clouds_;
  ros::Subscriber steps_, closures_;
  tf2_ros::StaticTransformBroadcaster static_tf_;
  std::size_t answered_ = 0;
  std::vector<LoopClosure> received_;
};

TEST_F(Stacks, LoamsRegisteredCloudsAndOdometryGiveLoopClosures) {
  const Pose T_map_init = ZUpToLoam();
  const Pose T_aft_velodyne = ZUpToLoam().inverse();
  static_tf_.sendTransform({ToTransform(T_map_init, "loam_map", "camera_init", ros::Time::now()),
                            ToTransform(T_aft_velodyne, "aft_mapped", "loam_velodyne", ros::Time::now())});
  Connect("/loam", "/velodyne_cloud_registered");
  ros::Publisher odometry = nh_.advertise<nav_msgs::Odometry>("/aft_mapped_to_init", 10);
  ASSERT_TRUE(WaitFor([&] { return odometry.getNumSubscribers() > 0; }));
  for (int scan = 0; scan < drive_.scans(); ++scan) {
    const Pose T_init_velodyne = T_map_init.inverse() * drive_.T_odom_sensor(scan);
    nav_msgs::Odometry message;
    message.header.stamp = ToTime(drive_.stamp_ns(scan));
    message.header.frame_id = "/camera_init";
    message.child_frame_id = "/aft_mapped";
    message.pose.pose = ToPoseMsg(T_init_velodyne * T_aft_velodyne.inverse());
    PublishRegistered(scan, T_init_velodyne, "/camera_init");
    odometry.publish(message);
    ASSERT_TRUE(IsAnswered(static_cast<std::size_t>(scan + 1))) << "no answer to scan " << scan;
  }
  ASSERT_GE(received_.size(), 10u);
  for (const LoopClosure& closure : received_) {
    EXPECT_EQ(closure.frame_query, "loam_velodyne");
    EXPECT_LT(Error_m(closure), 0.5);
  }
}

TEST_F(Stacks, LioSamGetsItsStampsAndItsJumpsAreFollowed) {
  Connect("/lio", "/lio_sam/cloud_registered");
  ros::Publisher poses = nh_.advertise<geometry_msgs::PoseStamped>("/lio_sam/pose", 10);
  ros::Publisher paths = nh_.advertise<nav_msgs::Path>("/lio_sam/mapping/path", 10);
  std::vector<std::vector<double>> pairs;
  ros::Subscriber detections = nh_.subscribe<std_msgs::Float64MultiArray>(
      "/lio/lio_loop/loop_closure_detection", 100,
      boost::function<void(const std_msgs::Float64MultiArrayConstPtr&)>(
          [&pairs](const std_msgs::Float64MultiArrayConstPtr& m) { pairs.push_back(m->data); }));
  ASSERT_TRUE(WaitFor([&] {
    return poses.getNumSubscribers() > 0 && paths.getNumSubscribers() > 0 && detections.getNumPublishers() > 0;
  }));

  // Amid the second lap the graph is optimized: the whole path moves, and the frame with it.
  constexpr int kCorrectedAt = 90;
  Pose T_correction = Pose::Identity();
  T_correction.linear() = Eigen::AngleAxisd(0.4, Eigen::Vector3d::UnitZ()).toRotationMatrix();
  T_correction.translation() << -6.0, 4.0, 0.3;
  Pose T_odom_continuous = Pose::Identity();
  nav_msgs::Path path;
  path.header.frame_id = "lio_odom";
  for (int scan = 0; scan < drive_.scans(); ++scan) {
    if (scan == kCorrectedAt) {
      T_odom_continuous = T_correction;
      for (geometry_msgs::PoseStamped& pose : path.poses) pose.pose = ToPoseMsg(T_correction * ToPose(pose.pose, ""));
    }
    const Pose T_odom_sensor = T_odom_continuous * drive_.T_odom_sensor(scan);
    geometry_msgs::PoseStamped pose;
    pose.header.stamp = ToTime(drive_.stamp_ns(scan));
    pose.header.frame_id = "lio_odom";
    pose.pose = ToPoseMsg(T_odom_sensor);
    path.poses.push_back(pose);
    PublishRegistered(scan, T_odom_sensor, "lio_odom");
    poses.publish(pose);
    // The path comes last and a little later, as it does there: so the first cloud after the jump is in the new frame
    // before anything has told of it.
    if (scan == kCorrectedAt) ros::WallDuration(0.3).sleep();
    path.header.stamp = pose.header.stamp;
    paths.publish(path);
    ASSERT_TRUE(IsAnswered(static_cast<std::size_t>(scan + 1))) << "no answer to scan " << scan;
  }
  std::size_t before = 0, after = 0;
  for (const LoopClosure& closure : received_) {
    EXPECT_LT(Error_m(closure), 0.5) << "at scan " << ScanAt(closure.stamp_query);
    ++(ScanAt(closure.stamp_query) < kCorrectedAt ? before : after);
  }
  EXPECT_GE(before, 10u);
  EXPECT_GE(after, 10u);
  ASSERT_FALSE(received_.empty());
  EXPECT_EQ(ScanAt(received_[before].stamp_query), kCorrectedAt) << "the jump interrupted the recognitions";

  // LIO-SAM finds its key frames by these very numbers.
  ASSERT_TRUE(WaitFor([&] { return pairs.size() == received_.size(); }, 5.0));
  for (std::size_t i = 0; i < pairs.size(); ++i)
    EXPECT_EQ(pairs[i], (std::vector<double>{received_[i].stamp_query.toSec(), received_[i].stamp_target.toSec()}));

  // Recognise now: the robot stands, no scan comes.
  std_srvs::Trigger trigger;
  const std::size_t published = received_.size();
  ASSERT_TRUE(ros::service::call("/lio/trigger", trigger));
  EXPECT_TRUE(trigger.response.success) << trigger.response.message;
  EXPECT_NE(trigger.response.message.find("robot: recognized"), std::string::npos) << trigger.response.message;
  EXPECT_TRUE(WaitFor([&] { return received_.size() == published + 1; }, 5.0));

  // All is forgotten: nothing to recognise, in words.
  std_srvs::Trigger reset;
  ASSERT_TRUE(ros::service::call("/lio/reset", reset));
  EXPECT_TRUE(reset.response.success);
  EXPECT_NE(reset.response.message.find("start over; 0 segments"), std::string::npos) << reset.response.message;
  ASSERT_TRUE(ros::service::call("/lio/trigger", trigger));
  EXPECT_FALSE(trigger.response.success);
  EXPECT_NE(trigger.response.message.find("no segments have come"), std::string::npos) << trigger.response.message;
}

TEST_F(Stacks, CorrectedOdometryMovesTheMap) {
  Connect("/slam", "/slam/points");
  ros::Publisher odometry = nh_.advertise<nav_msgs::Odometry>("/slam/odom", 10);
  ros::Publisher corrected = nh_.advertise<nav_msgs::Odometry>("/slam/corrected", 10);
  ASSERT_TRUE(WaitFor([&] { return odometry.getNumSubscribers() > 0 && corrected.getNumSubscribers() > 0; }));
  const auto publish = [this](const ros::Publisher& publisher, int scan, const std::string& frame, const Pose& T) {
    nav_msgs::Odometry message;
    message.header.stamp = ToTime(drive_.stamp_ns(scan));
    message.header.frame_id = frame;
    message.child_frame_id = "slam_velodyne";
    message.pose.pose = ToPoseMsg(T);
    publisher.publish(message);
  };
  // A SLAM that is always right, in a map that is turned against odom.
  const Pose T_map_world = Eigen::Translation3d(100.0, -50.0, 0.0) *
                           Eigen::AngleAxisd(1.0, Eigen::Vector3d::UnitZ()) * drive_.T_world_sensor(0).inverse();
  for (int scan = 0; scan < drive_.scans(); ++scan) {
    clouds_.publish(drive_.Cloud(scan, "slam_velodyne"));
    publish(odometry, scan, "odom", drive_.T_odom_sensor(scan));
    ASSERT_TRUE(IsAnswered(static_cast<std::size_t>(scan + 1))) << "no answer to scan " << scan;
    publish(corrected, scan, "map", T_map_world * drive_.T_world_sensor(scan));
  }
  // The segments of the first lap lie where they truly are, which odometry has lost by metres when it sees them again.
  ASSERT_GE(received_.size(), 10u);
  std::vector<double> errors_m, drifts_m;
  for (const LoopClosure& closure : received_) {
    EXPECT_LT(Error_m(closure), 0.5);
    const int query = ScanAt(closure.stamp_query), target = ScanAt(closure.stamp_target);
    const Pose T_map_odom = T_map_world * drive_.T_world_sensor(query) * drive_.T_odom_sensor(query).inverse();
    for (const MatchedSegments& match : closure.matches) {
      const Eigen::Vector3d seen_map = T_map_odom * ToVector(match.centroid_query);
      errors_m.push_back((ToVector(match.centroid_target) - seen_map).norm());
    }
    const Pose T_query_target = drive_.T_world_sensor(query).inverse() * drive_.T_world_sensor(target);
    drifts_m.push_back((drive_.T_odom_sensor(query) * T_query_target.translation() -
                        drive_.T_odom_sensor(target).translation())
                           .norm());
  }
  const auto median = [](std::vector<double> values) {
    std::sort(values.begin(), values.end());
    return values[values.size() / 2];
  };
  EXPECT_GT(median(drifts_m), 2.0);
  EXPECT_LT(median(errors_m), 0.3);
}

}  // namespace
}  // namespace incremental_segmatch
