// What a user may get wrong, and the message that comes.
#include <diagnostic_msgs/DiagnosticArray.h>
#include <dynamic_reconfigure/Reconfigure.h>
#include <geometry_msgs/PoseStamped.h>
#include <gtest/gtest.h>
#include <incremental_segmatch/LoadMap.h>
#include <incremental_segmatch/RequestFullState.h>
#include <incremental_segmatch/SaveMap.h>
#include <nav_msgs/Odometry.h>
#include <nav_msgs/Path.h>
#include <nodelet/NodeletList.h>
#include <nodelet/NodeletLoad.h>
#include <ros/ros.h>
#include <rosgraph_msgs/Log.h>
#include <tf2_ros/static_transform_broadcaster.h>
#include <tf2_ros/transform_broadcaster.h>
#include <unistd.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <fstream>
#include <limits>
#include <map>
#include <string>
#include <vector>

#include "conversions.hpp"
#include "synthetic_drive.hpp"
#include "waiting.hpp"

namespace incremental_segmatch {
namespace {

using test::SyntheticDrive;
using test::WaitFor;

/// Hears all that nodelets say: log, diagnostics, segments.
class BadInput : public testing::Test {
 protected:
  static void SetUpTestSuite() { drive_ = new SyntheticDrive(); }
  static void TearDownTestSuite() { delete drive_; }

  void SetUp() override {
    log_ = nh_.subscribe<rosgraph_msgs::Log>("/rosout", 500, [this](const rosgraph_msgs::LogConstPtr& m) {
      said_.push_back({m->level, m->msg});
    });
    diagnostics_ = nh_.subscribe<diagnostic_msgs::DiagnosticArray>(
        "/diagnostics", 100, [this](const diagnostic_msgs::DiagnosticArrayConstPtr& m) {
          for (const auto& status : m->status)
            for (const auto& value : status.values) diagnosed_[status.name][value.key] = value.value;
        });
    ASSERT_TRUE(WaitFor([this] { return log_.getNumPublishers() > 0 && diagnostics_.getNumPublishers() > 0; }));
  }

  /// Loads a nodelet of the given name, with its topics below a prefix. Returns false if it can't be loaded.
  static bool LoadNodelet(const std::string& name, const std::string& type, const std::string& prefix) {
    nodelet::NodeletLoad load;
    load.request.name = "/" + name;
    load.request.type = "incremental_segmatch/" + type;
    for (const std::string topic :
         {"points", "odometry", "pose", "segments", "local_cloud", "local_labels", "front_end_steps", "loop_closures",
          "reset", "trigger", "trajectory", "save_map", "load_map", "back_end_steps", "corrected_odometry"}) {
      load.request.remap_source_args.push_back("/" + topic);
      load.request.remap_target_args.push_back("/" + prefix + "/" + topic);
    }
    return ros::service::waitForService("/manager/load_nodelet", 10000) &&
           ros::service::call("/manager/load_nodelet", load) && load.response.success;
  }

  /// Loads a front end and connects with it.
  bool LoadAndConnect(const std::string& name) {
    if (!LoadNodelet(name, "FrontEndNodelet", name)) return false;
    clouds_ = nh_.advertise<sensor_msgs::PointCloud2>("/" + name + "/points", 10);
    segments_ = nh_.subscribe<SegmentArray>("/" + name + "/segments", 10,
                                            [this](const SegmentArrayConstPtr& m) { received_.push_back(*m); });
    return WaitFor([this] { return clouds_.getNumSubscribers() > 0 && segments_.getNumPublishers() > 0; });
  }

  void PublishTf(int scan, const std::string& frame) {
    tf_.sendTransform(ToTransform(drive_->T_odom_sensor(scan), "odom", frame, ToTime(drive_->stamp_ns(scan))));
  }

  bool IsSaid(const std::string& words, int level) const {
    return std::any_of(said_.begin(), said_.end(), [&](const auto& line) {
      return line.first == level && line.second.find(words) != std::string::npos;
    });
  }

  testing::AssertionResult Hears(const std::string& words, int level = rosgraph_msgs::Log::WARN) {
    return HearsWithin(words, 5.0, level);
  }

  testing::AssertionResult HearsWithin(const std::string& words, double timeout_s,
                                       int level = rosgraph_msgs::Log::WARN) {
    if (WaitFor([&] { return IsSaid(words, level); }, timeout_s)) return testing::AssertionSuccess();
    testing::AssertionResult result = testing::AssertionFailure() << "nobody said \"" << words << "\", but:";
    for (const auto& line : said_) result << "\n  " << line.second;
    return result;
  }

  testing::AssertionResult Counts(const std::string& name, const std::string& key, int at_least = 1) {
    const std::string status = name + ": front end";
    const auto counted = [&] {
      const auto it = diagnosed_[status].find(key);
      return it != diagnosed_[status].end() && std::stoi(it->second) >= at_least;
    };
    if (WaitFor(counted, 5.0)) return testing::AssertionSuccess();
    return testing::AssertionFailure() << "diagnostics do not count \"" << key << "\"";
  }

  /// The front end still does its work.
  testing::AssertionResult Works(int scan, const std::string& frame) {
    const std::size_t before = received_.size();
    PublishTf(scan, frame);
    clouds_.publish(drive_->Cloud(scan, frame));
    if (WaitFor([&] { return received_.size() > before; }, 5.0)) return testing::AssertionSuccess();
    return testing::AssertionFailure() << "no segments came for scan " << scan;
  }

  inline static SyntheticDrive* drive_ = nullptr;
  ros::NodeHandle nh_;
  ros::Publisher clouds_;
  ros::Subscriber segments_, log_, diagnostics_;
  tf2_ros::TransformBroadcaster tf_;
  tf2_ros::StaticTransformBroadcaster static_tf_;
  std::vector<SegmentArray> received_;
  std::vector<std::pair<int, std::string>> said_;
  std::map<std::string, std::map<std::string, std::string>> diagnosed_;
};

TEST_F(BadInput, EmptyAndInvalidCloudsAreSkipped) {
  ASSERT_TRUE(LoadAndConnect("bad_clouds"));
  ASSERT_TRUE(Works(0, "lidar_a"));

  sensor_msgs::PointCloud2 empty = drive_->Cloud(1, "lidar_a");
  empty.width = 0;
  empty.row_step = 0;
  empty.data.clear();
  PublishTf(1, "lidar_a");
  clouds_.publish(empty);
  EXPECT_TRUE(Hears("the cloud is empty"));
  EXPECT_TRUE(Counts("bad_clouds", "scans skipped: empty"));

  sensor_msgs::PointCloud2 nameless = drive_->Cloud(1, "lidar_a");
  nameless.fields[1].name = "azimuth";
  clouds_.publish(nameless);
  EXPECT_TRUE(Hears("the cloud has no field y; its fields are: x (FLOAT32), azimuth (FLOAT32)"));

  const float nan = std::numeric_limits<float>::quiet_NaN();
  std_msgs::Header header = nameless.header;
  header.stamp = ToTime(drive_->stamp_ns(2));
  PublishTf(2, "lidar_a");
  clouds_.publish(ToPointCloud2(std::vector<ColouredPoint>(10, {{nan, nan, nan}, 0}), header));
  EXPECT_TRUE(Hears("none of the cloud's 10 points is finite"));

  header.stamp = ros::Time();
  sensor_msgs::PointCloud2 timeless = drive_->Cloud(3, "lidar_a");
  timeless.header = header;
  clouds_.publish(timeless);
  EXPECT_TRUE(Hears("stamp is 0"));

  // Some NaN among good points are dropped and counted.
  std::vector<ColouredPoint> points(25, {{nan, 1.f, 1.f}, 0});
  for (const Eigen::Vector3f& p : drive_->Scan(4)) points.push_back({p, 0});
  header.stamp = ToTime(drive_->stamp_ns(4));
  PublishTf(4, "lidar_a");
  clouds_.publish(ToPointCloud2(points, header));
  EXPECT_TRUE(Counts("bad_clouds", "dropped_nonfinite", 25));
  EXPECT_TRUE(Works(5, "lidar_a"));
}

TEST_F(BadInput, MissingTfIsExplainedAndNeverGuessed) {
  ASSERT_TRUE(LoadAndConnect("no_tf"));
  tf2_ros::StaticTransformBroadcaster others;
  others.sendTransform(ToTransform(Pose::Identity(), "somewhere", "else", ros::Time::now()));
  clouds_.publish(drive_->Cloud(0, "lidar_b"));
  EXPECT_TRUE(Hears("no tf from odom to lidar_b"));
  EXPECT_TRUE(Hears("the tree has:"));
  EXPECT_TRUE(Hears("else"));
  EXPECT_TRUE(Counts("no_tf", "scans skipped: no pose"));
  EXPECT_TRUE(received_.empty());

  // A transform that comes a little after its cloud is waited for.
  clouds_.publish(drive_->Cloud(1, "lidar_b"));
  WaitFor([] { return false; }, 0.1);
  PublishTf(1, "lidar_b");
  EXPECT_TRUE(WaitFor([this] { return received_.size() == 1; }, 5.0));
}

TEST_F(BadInput, TimeThatJumpsBackStartsOver) {
  ASSERT_TRUE(LoadAndConnect("looped"));
  ASSERT_TRUE(LoadNodelet("looped_map", "BackEndNodelet", "looped"));
  ASSERT_TRUE(LoadNodelet("looped_graph", "PoseGraphNodelet", "looped"));
  for (int scan = 20; scan < 24; ++scan) ASSERT_TRUE(Works(scan, "lidar_c"));
  ASSERT_EQ(received_.size(), 4u);
  EXPECT_EQ(received_.back().sequence, 4u);
  const std::uint64_t session = received_.back().session;

  clouds_.publish(drive_->Cloud(23, "lidar_c"));  // the same again
  EXPECT_TRUE(Hears("the cloud is not newer than the last one"));

  clouds_.publish(drive_->Cloud(0, "lidar_c"));
  EXPECT_TRUE(Hears("time jumped back by 23.0 s"));
  for (int scan = 1; scan < 4; ++scan) ASSERT_TRUE(Works(scan, "lidar_c"));
  EXPECT_NE(received_.back().session, session);
  EXPECT_LE(received_.back().sequence, 4u);
  EXPECT_TRUE(Counts("looped", "starts over"));
  EXPECT_TRUE(Hears("the back end forgets all robots and starts over"));
  EXPECT_TRUE(Hears("the pose graph starts over"));
}

TEST_F(BadInput, FullStateComesOnRequest) {
  ASSERT_TRUE(LoadAndConnect("full_state"));
  for (int scan = 0; scan < 3; ++scan) ASSERT_TRUE(Works(scan, "lidar_d"));
  EXPECT_FALSE(received_.back().full_state);
  RequestFullState request;
  ASSERT_TRUE(ros::service::call("/full_state/segments/request_full_state", request));
  EXPECT_TRUE(request.response.success);
  ASSERT_TRUE(Works(3, "lidar_d"));
  EXPECT_TRUE(received_.back().full_state);
  EXPECT_EQ(received_.back().sequence, 4u);
  ASSERT_TRUE(Works(4, "lidar_d"));
  EXPECT_FALSE(received_.back().full_state);
}

TEST_F(BadInput, BackEndThatComesLateAsksForAFullState) {
  ASSERT_TRUE(LoadAndConnect("late"));
  for (int scan = 0; scan < 3; ++scan) ASSERT_TRUE(Works(scan, "lidar_g"));
  ASSERT_TRUE(LoadNodelet("late_map", "BackEndNodelet", "late"));
  std::vector<StepReport> steps;
  ros::Subscriber subscriber = nh_.subscribe<StepReport>(
      "/late/back_end_steps", 10, [&steps](const StepReportConstPtr& m) { steps.push_back(*m); });
  ASSERT_TRUE(WaitFor([&] { return subscriber.getNumPublishers() > 0; }));
  ASSERT_TRUE(Works(3, "lidar_g"));
  EXPECT_TRUE(Hears("asked for a full state", rosgraph_msgs::Log::INFO));
  ASSERT_TRUE(Works(4, "lidar_g"));
  EXPECT_TRUE(received_.back().full_state);
  ASSERT_TRUE(WaitFor([&] { return !steps.empty(); }, 5.0));
  ASSERT_EQ(steps[0].counts[0], "local_segments");
  EXPECT_EQ(steps[0].values[0], received_.back().changed.size());
}

TEST_F(BadInput, OdometryIsInterpolatedBetweenMessages) {
  ros::param::set("/odometry_pose/pose_source", "odometry");
  ASSERT_TRUE(LoadAndConnect("odometry_pose"));
  ros::Publisher publisher = nh_.advertise<nav_msgs::Odometry>("/odometry_pose/odometry", 10);
  ASSERT_TRUE(WaitFor([&] { return publisher.getNumSubscribers() > 0; }));
  const auto publish = [&](StampNs stamp_ns, double x) {
    nav_msgs::Odometry odometry;
    odometry.header.stamp = ToTime(stamp_ns);
    odometry.header.frame_id = "odom";
    odometry.child_frame_id = "lidar_e";
    Pose T = Pose::Identity();
    T.translation().x() = x;
    odometry.pose.pose = ToPoseMsg(T);
    publisher.publish(odometry);
  };
  const StampNs stamp_ns = drive_->stamp_ns(1);
  publish(stamp_ns - 100000000, 1.0);
  clouds_.publish(drive_->Cloud(1, "lidar_e"));
  WaitFor([] { return false; }, 0.05);
  EXPECT_TRUE(received_.empty());
  publish(stamp_ns + 100000000, 2.0);
  ASSERT_TRUE(WaitFor([this] { return received_.size() == 1; }, 5.0));
  EXPECT_NEAR(received_[0].sensor_pose.position.x, 1.5, 1e-6);

  clouds_.publish(drive_->Cloud(2, "lidar_e"));  // no odometry comes any more
  EXPECT_TRUE(Hears("odometry ends"));
}

TEST_F(BadInput, PosesOfATopicAreThoseOfTheBase) {
  ros::param::set("/pose_topic/pose_source", "pose");
  ros::param::set("/pose_topic/base_frame", "base");
  ASSERT_TRUE(LoadAndConnect("pose_topic"));
  ros::Publisher publisher = nh_.advertise<geometry_msgs::PoseStamped>("/pose_topic/pose", 10);
  ASSERT_TRUE(WaitFor([&] { return publisher.getNumSubscribers() > 0; }));

  geometry_msgs::PoseStamped pose;
  pose.header.stamp = ToTime(drive_->stamp_ns(1));
  pose.header.frame_id = "odom";
  publisher.publish(pose);  // no orientation
  EXPECT_TRUE(Hears("a pose is left out: pose: its quaternion has length 0"));

  Pose T_odom_base = Pose::Identity();
  T_odom_base.linear() = Eigen::AngleAxisd(0.5 * M_PI, Eigen::Vector3d::UnitZ()).toRotationMatrix();
  T_odom_base.translation() << 5.0, 6.0, 0.0;
  pose.pose = ToPoseMsg(T_odom_base);
  publisher.publish(pose);
  clouds_.publish(drive_->Cloud(1, "lidar_h"));
  EXPECT_TRUE(Hears("there is no frame base (parameter base_frame); "));

  Pose T_base_lidar = Pose::Identity();
  T_base_lidar.translation() << 1.0, 0.0, 2.0;
  static_tf_.sendTransform(ToTransform(T_base_lidar, "base", "lidar_h", ros::Time::now()));
  pose.header.stamp = ToTime(drive_->stamp_ns(2));
  publisher.publish(pose);
  clouds_.publish(drive_->Cloud(2, "lidar_h"));
  ASSERT_TRUE(WaitFor([this] { return received_.size() == 1; }, 5.0));
  EXPECT_LT((ToVector(received_[0].sensor_pose.position) - Eigen::Vector3d(5.0, 7.0, 2.0)).norm(), 1e-9);
  EXPECT_EQ(received_[0].base_frame, "base");
}

TEST_F(BadInput, WhatIsMissingIsSaidWithoutBeingAsked) {
  ros::param::set("/waiting/pose_source", "odometry");
  ros::Publisher elsewhere = nh_.advertise<sensor_msgs::PointCloud2>("/lidar_front/points_raw", 1);
  ASSERT_TRUE(LoadNodelet("waiting", "FrontEndNodelet", "waiting"));
  EXPECT_TRUE(HearsWithin("nobody publishes /waiting/points; PointCloud2 is published on:", 15.0));
  EXPECT_TRUE(Hears("/lidar_front/points_raw"));
  EXPECT_FALSE(IsSaid("/waiting/local_cloud", rosgraph_msgs::Log::WARN)) << "its own output was offered as input";
  clouds_ = nh_.advertise<sensor_msgs::PointCloud2>("/waiting/points", 10);
  EXPECT_TRUE(HearsWithin("nobody publishes /waiting/odometry", 15.0));
}

TEST_F(BadInput, JumpsNeedATrajectoryInTheFrameThatJumps) {
  ros::param::set("/jumping/frame_jumps", true);
  ASSERT_TRUE(LoadAndConnect("jumping"));
  ASSERT_TRUE(Works(0, "lidar_j"));
  EXPECT_TRUE(
      HearsWithin("no jump of odom will be followed (frame_jumps): nobody publishes /jumping/corrected_odometry, "
                  "and nobody publishes /jumping/trajectory",
                  15.0));
  ros::Publisher paths = nh_.advertise<nav_msgs::Path>("/jumping/trajectory", 1);
  ASSERT_TRUE(WaitFor([&] { return paths.getNumSubscribers() > 0; }));
  // As our pose graph's, which corrects the map and lets odom alone: a jump it is not.
  nav_msgs::Path path;
  path.header.frame_id = "map";
  path.poses.emplace_back();
  path.poses.back().header.stamp = ToTime(drive_->stamp_ns(0));
  path.poses.back().pose = ToPoseMsg(Pose(Eigen::Translation3d(5.0, 0.0, 0.0)) * drive_->T_odom_sensor(0));
  paths.publish(path);
  WaitFor([] { return false; }, 0.2);
  ASSERT_TRUE(Works(1, "lidar_j"));
  EXPECT_TRUE(
      Hears("the trajectory is in frame map, but the frame that jumps is odom (odom_frame): it is not followed"));
  const auto position = [this]() -> Eigen::Vector3d { return ContinuousSensorPose(received_.back()).translation(); };
  EXPECT_LT((position() - drive_->T_odom_sensor(1).translation()).norm(), 1e-6);

  // A corrected odometry in the frame that jumps, at a scan's stamp: the next scan comes in the frame after the jump.
  const Pose T_new_old(Eigen::Translation3d(5.0, -3.0, 0.0));
  ros::Publisher corrections = nh_.advertise<nav_msgs::Odometry>("/jumping/corrected_odometry", 1);
  ASSERT_TRUE(WaitFor([&] { return corrections.getNumSubscribers() > 0; }));
  nav_msgs::Odometry corrected;
  corrected.header.frame_id = "odom";
  corrected.header.stamp = ToTime(drive_->stamp_ns(1));
  corrected.pose.pose = ToPoseMsg(T_new_old * drive_->T_odom_sensor(1));
  corrections.publish(corrected);
  WaitFor([] { return false; }, 0.2);
  tf_.sendTransform(ToTransform(T_new_old * drive_->T_odom_sensor(2), "odom", "lidar_j", ToTime(drive_->stamp_ns(2))));
  const std::size_t before = received_.size();
  clouds_.publish(drive_->Cloud(2, "lidar_j"));
  ASSERT_TRUE(WaitFor([&] { return received_.size() > before; }, 5.0));
  EXPECT_LT((position() - drive_->T_odom_sensor(2).translation()).norm(), 1e-6);
  EXPECT_LT(
      (ToVector(received_.back().sensor_pose.position) - (T_new_old * drive_->T_odom_sensor(2)).translation()).norm(),
      1e-6);
}

TEST_F(BadInput, ATopicOfAnotherTypeIsSaidToBeOne) {
  ros::Publisher other = nh_.advertise<nav_msgs::Odometry>("/mistaken/points", 1);
  ASSERT_TRUE(LoadNodelet("mistaken", "FrontEndNodelet", "mistaken"));
  EXPECT_TRUE(HearsWithin("/mistaken/points has nav_msgs/Odometry, not PointCloud2; ", 15.0));
}

TEST_F(BadInput, ATrajectoryWithoutStampsIsRemarked) {
  ASSERT_TRUE(LoadNodelet("unstamped", "BackEndNodelet", "unstamped"));
  ros::Publisher paths = nh_.advertise<nav_msgs::Path>("/unstamped/trajectory", 1);
  ASSERT_TRUE(WaitFor([&] { return paths.getNumSubscribers() > 0; }));
  nav_msgs::Path path;
  path.header.stamp = ToTime(drive_->stamp_ns(0));
  path.header.frame_id = "map";
  path.poses.emplace_back();
  path.poses.back().pose.orientation.w = 1.0;
  paths.publish(path);
  EXPECT_TRUE(Hears("poses of the trajectory have no stamps: each needs that of its scan"));
}

TEST_F(BadInput, ABackEndWithABrokenMapSaysSoWhateverItIsAskedFor) {
  const std::string path = "/tmp/incremental_segmatch_broken_" + std::to_string(getpid()) + ".map";
  std::ofstream(path) << "no map";
  ros::param::set("/broken/map_file", path);
  ASSERT_TRUE(LoadNodelet("broken", "BackEndNodelet", "broken"));
  EXPECT_TRUE(Hears("the back end does not start: " + path + " is not a segment map", rosgraph_msgs::Log::FATAL));
  SaveMap save;
  save.request.path = "/tmp/town.map";
  ASSERT_TRUE(ros::service::waitForService("/broken/save_map", 5000));
  ASSERT_TRUE(ros::service::call("/broken/save_map", save));
  EXPECT_FALSE(save.response.success);
  EXPECT_EQ(save.response.message, "the back end has not started: " + path + " is not a segment map");
  LoadMap load;
  load.request.path = "town.map";
  ASSERT_TRUE(ros::service::call("/broken/load_map", load));
  EXPECT_NE(load.response.message.find("town.map is no whole path, and this node runs in /"), std::string::npos)
      << load.response.message;
  std::remove(path.c_str());
}

TEST_F(BadInput, ParametersChangeWhileRunningAndARefusalIsExplained) {
  ASSERT_TRUE(LoadAndConnect("tuned"));
  ASSERT_TRUE(LoadNodelet("tuned_map", "BackEndNodelet", "tuned"));
  const auto set = [](const std::string& server, const std::string& name, double value) {
    dynamic_reconfigure::Reconfigure change;
    change.request.config.doubles.emplace_back();
    change.request.config.doubles.back().name = name;
    change.request.config.doubles.back().value = value;
    EXPECT_TRUE(ros::service::waitForService(server + "/tuning/set_parameters", 5000));
    EXPECT_TRUE(ros::service::call(server + "/tuning/set_parameters", change));
    return change.response.config;
  };
  const auto value = [](const dynamic_reconfigure::Config& config, const std::string& name) {
    for (const auto& parameter : config.doubles)
      if (parameter.name == name) return parameter.value;
    return std::nan("");
  };
  const auto refused = [](const dynamic_reconfigure::Config& config) {
    for (const auto& parameter : config.strs)
      if (parameter.name == "refused") return parameter.value;
    return std::string("not there");
  };
  dynamic_reconfigure::Config config = set("/tuned_map", "epsilon_m", 0.5);
  EXPECT_EQ(value(config, "epsilon_m"), 0.5);
  EXPECT_EQ(refused(config), "");
  EXPECT_TRUE(Hears("the parameters have changed", rosgraph_msgs::Log::INFO));

  config = set("/tuned_map", "epsilon_m", 0.0);
  EXPECT_EQ(value(config, "epsilon_m"), 0.5);
  EXPECT_NE(refused(config).find("back_end.recognizer.consistency.epsilon_m: must be > 0, is 0"), std::string::npos)
      << refused(config);
  EXPECT_TRUE(Hears("a change of the parameters is refused: "));
  config = set("/tuned_map", "closure_min_distance_m", -0.5);
  EXPECT_NE(refused(config).find("closure_min_distance_m: must not be negative"), std::string::npos) << refused(config);

  // A wider near limit of the range leaves fewer points: the change has reached the core.
  ASSERT_TRUE(Works(0, "lidar_i"));
  config = set("/tuned", "min_range_m", 1000.0);
  EXPECT_NE(refused(config).find("range_m"), std::string::npos) << refused(config);
  config = set("/tuned", "local_radius_m", 1.0);
  EXPECT_EQ(refused(config), "");
  const std::size_t before = received_.size();
  ASSERT_TRUE(Works(1, "lidar_i"));
  ASSERT_GT(received_.size(), before);
  EXPECT_FALSE(received_.back().retired.empty());
}

TEST_F(BadInput, RegisteredCloudsAreTakenBackIntoTheSensorsFrame) {
  ros::param::set("/registered/registered", true);
  ros::param::set("/registered/sensor_frame", "lidar_f");
  ros::param::set("/registered/base_frame", "");
  ASSERT_TRUE(LoadAndConnect("registered"));
  PublishTf(0, "lidar_f");
  clouds_.publish(drive_->Cloud(0, "map"));
  EXPECT_TRUE(
      Hears("registered clouds come in frame map, but odom_frame is odom, and there is no tf from odom to map"));

  ASSERT_TRUE(LoadAndConnect("unregistered"));
  const auto centroids = [this](const std::string& name, int scan, bool is_registered) {
    ros::Publisher publisher = nh_.advertise<sensor_msgs::PointCloud2>("/" + name + "/points", 10);
    std::vector<SegmentArray> got;
    ros::Subscriber subscriber = nh_.subscribe<SegmentArray>(
        "/" + name + "/segments", 10, [&got](const SegmentArrayConstPtr& m) { got.push_back(*m); });
    EXPECT_TRUE(WaitFor([&] { return publisher.getNumSubscribers() > 0 && subscriber.getNumPublishers() > 0; }));
    PublishTf(scan, "lidar_f");
    sensor_msgs::PointCloud2 cloud = drive_->Cloud(scan, "lidar_f");
    if (is_registered) {
      std::vector<ColouredPoint> points;
      for (const Eigen::Vector3f& p : drive_->Scan(scan))
        points.push_back({(drive_->T_odom_sensor(scan) * p.cast<double>()).cast<float>(), 0});
      cloud = ToPointCloud2(points, cloud.header);
      cloud.header.frame_id = "odom";
    }
    publisher.publish(cloud);
    EXPECT_TRUE(WaitFor([&] { return !got.empty(); }, 5.0));
    std::vector<Eigen::Vector3d> result;
    if (!got.empty())
      for (const Segment& segment : got[0].changed) result.push_back(ToVector(segment.centroid));
    return result;
  };
  const std::vector<Eigen::Vector3d> registered = centroids("registered", 10, true);
  const std::vector<Eigen::Vector3d> unregistered = centroids("unregistered", 10, false);
  ASSERT_GT(registered.size(), 5u);
  ASSERT_EQ(registered.size(), unregistered.size());
  for (const Eigen::Vector3d& centroid : registered)
    EXPECT_TRUE(std::any_of(unregistered.begin(), unregistered.end(),
                            [&](const Eigen::Vector3d& other) { return (other - centroid).norm() < 0.01; }));
}

struct WrongParameter {
  std::string nodelet;
  std::string type;
  std::string words;
};

TEST_F(BadInput, WrongParametersAreFatalByNameAndTheManagerLives) {
  ros::param::set("/wrong_1/colour", "red");
  ros::param::set("/wrong_2/front_end/grid/resolution", 0.1);
  ros::param::set("/wrong_3/queue_size", "many");
  ros::param::set("/wrong_4/config_file", "/no/such/file.yaml");
  ros::param::set("/wrong_5/front_end/local_radius_m", -3.0);
  ros::param::set("/wrong_6/display_hight_m", 1.0);
  ros::param::set("/wrong_7/pose_graph/sigma", 1.0);
  ros::param::set("/wrong_8/output_dir", "results");
  const std::vector<WrongParameter> wrong{
      {"wrong_1", "FrontEndNodelet", "unknown parameter /wrong_1/colour"},
      {"wrong_2", "FrontEndNodelet", "grid.resolution"},
      {"wrong_3", "FrontEndNodelet", "/wrong_3/queue_size: expected an integer"},
      {"wrong_4", "FrontEndNodelet", "/no/such/file.yaml"},
      {"wrong_5", "FrontEndNodelet", "local_radius_m"},
      {"wrong_6", "BackEndNodelet", "unknown parameter /wrong_6/display_hight_m"},
      {"wrong_7", "PoseGraphNodelet", "unknown parameter /wrong_7/pose_graph/sigma"},
      {"wrong_8", "PoseGraphNodelet", "parameter /wrong_8/output_dir: results is no whole path"}};
  for (const WrongParameter& w : wrong) {
    ASSERT_TRUE(LoadNodelet(w.nodelet, w.type, w.nodelet)) << w.nodelet;
    EXPECT_TRUE(Hears(w.words, rosgraph_msgs::Log::FATAL));
  }
  nodelet::NodeletList list;
  ASSERT_TRUE(ros::service::call("/manager/list", list));
  EXPECT_GE(list.response.nodelets.size(), wrong.size());
}

}  // namespace
}  // namespace incremental_segmatch
