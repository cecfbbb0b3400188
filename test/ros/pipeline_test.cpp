// Two laps through nodelets in one manager: loop closures come out, the trajectory is corrected, files are written.
#include <geometry_msgs/PoseWithCovarianceStamped.h>
#include <gtest/gtest.h>
#include <incremental_segmatch/SaveMap.h>
#include <nodelet/NodeletLoad.h>
#include <ros/ros.h>
#include <std_srvs/Trigger.h>
#include <tf2_ros/buffer.h>
#include <tf2_ros/static_transform_broadcaster.h>
#include <tf2_ros/transform_broadcaster.h>
#include <tf2_ros/transform_listener.h>

#include <fstream>
#include <sstream>
#include <string>
#include <vector>

#include "conversions.hpp"
#include "synthetic_drive.hpp"
#include "waiting.hpp"

namespace incremental_segmatch {
namespace {

using test::SyntheticDrive;
using test::WaitFor;

Pose BaseToSensor() {
  Pose T = Pose::Identity();
  T.linear() = Eigen::AngleAxisd(0.3, Eigen::Vector3d::UnitZ()).toRotationMatrix();
  T.translation() << 0.5, -0.1, 1.5;
  return T;
}

std::vector<std::string> Lines(const std::string& path) {
  std::ifstream file(path);
  std::vector<std::string> lines;
  for (std::string line; std::getline(file, line);) lines.push_back(line);
  return lines;
}

double RotationAngle(const Pose& T) {
  return Eigen::AngleAxisd(T.linear()).angle();
}

/// Publishes the drive scan by scan, each after the step before has been answered by the back end.
class Driver {
 public:
  Driver() {
    clouds_ = nh_.advertise<sensor_msgs::PointCloud2>("points", 10);
    steps_ = nh_.subscribe<StepReport>("back_end_steps", 10, [this](const StepReportConstPtr&) { ++answered_; });
    local_ = nh_.subscribe<sensor_msgs::PointCloud2>(
        "local_cloud", 1, [this](const sensor_msgs::PointCloud2ConstPtr& m) { local_cloud_points_ = m->width; });
    closures_ = nh_.subscribe<LoopClosure>("loop_closures", 100,
                                           [this](const LoopClosureConstPtr& m) { received_.push_back(*m); });
    paths_ = nh_.subscribe<nav_msgs::Path>("trajectory", 1, [this](const nav_msgs::PathConstPtr& m) { path_ = *m; });
    static_broadcaster_.sendTransform(ToTransform(BaseToSensor(), "base_link", "velodyne", ros::Time::now()));
  }

  bool Start() {
    return WaitFor([this] {
      return clouds_.getNumSubscribers() > 0 && steps_.getNumPublishers() > 0 && closures_.getNumPublishers() > 0 &&
             paths_.getNumPublishers() > 0;
    });
  }

  bool Drive(int scan) {
    const Pose T_odom_base = drive_.T_odom_sensor(scan) * BaseToSensor().inverse();
    broadcaster_.sendTransform(ToTransform(T_odom_base, "odom", "base_link", ToTime(drive_.stamp_ns(scan))));
    clouds_.publish(drive_.Cloud(scan, "velodyne"));
    const std::size_t expected = answered_ + 1;
    return WaitFor([this, expected] { return answered_ >= expected; }, 5.0);
  }

  const SyntheticDrive& drive() const { return drive_; }
  const std::vector<LoopClosure>& received() const { return received_; }
  const nav_msgs::Path& path() const { return path_; }
  std::size_t local_cloud_points() const { return local_cloud_points_; }

 private:
  SyntheticDrive drive_;
  ros::NodeHandle nh_;
  ros::Publisher clouds_;
  ros::Subscriber steps_, local_, closures_, paths_;
  tf2_ros::TransformBroadcaster broadcaster_;
  tf2_ros::StaticTransformBroadcaster static_broadcaster_;
  std::size_t answered_ = 0;
  std::size_t local_cloud_points_ = 0;
  std::vector<LoopClosure> received_;
  nav_msgs::Path path_;
};

/// The robot drives on from test to test.
class Pipeline : public testing::Test {
 protected:
  static void SetUpTestSuite() { driver_ = new Driver(); }
  static void TearDownTestSuite() { delete driver_; }

  inline static Driver* driver_ = nullptr;
};

TEST_F(Pipeline, ClosesTheLoopAndCorrectsTheTrajectory) {
  tf2_ros::Buffer tf_buffer;
  tf2_ros::TransformListener tf_listener(tf_buffer);
  Driver& driver = *driver_;
  ASSERT_TRUE(driver.Start());
  const SyntheticDrive& drive = driver.drive();
  for (int scan = 0; scan < drive.scans(); ++scan) ASSERT_TRUE(driver.Drive(scan)) << "no answer to scan " << scan;
  EXPECT_GT(driver.local_cloud_points(), 1000u);

  // Closures are right, between base frames, and no more frequent than one in five metres.
  const std::vector<LoopClosure>& closures = driver.received();
  ASSERT_GE(closures.size(), 3u);
  EXPECT_LE(closures.size(), 40u);
  const auto scan_at = [](const ros::Time& stamp) {
    return static_cast<int>((ToStampNs(stamp) - SyntheticDrive::kStartNs) / SyntheticDrive::kPeriodNs);
  };
  for (const LoopClosure& closure : closures) {
    EXPECT_EQ(closure.frame_kind, LoopClosure::FRAME_BASE);
    EXPECT_EQ(closure.frame_query, "base_link");
    EXPECT_EQ(closure.robot_query, "alice");
    EXPECT_EQ(closure.robot_target, "alice");
    EXPECT_GE(closure.inliers, 6u);
    EXPECT_EQ(closure.matches.size(), closure.inliers);
    const Pose T_world_query = drive.T_world_sensor(scan_at(closure.stamp_query)) * BaseToSensor().inverse();
    const Pose T_world_target = drive.T_world_sensor(scan_at(closure.stamp_target)) * BaseToSensor().inverse();
    const Pose error = (T_world_target.inverse() * T_world_query).inverse() * ToPose(closure.relative_pose.pose, "");
    EXPECT_LT(error.translation().norm(), 0.5);
    EXPECT_LT(RotationAngle(error), 0.03);
  }

  // The corrected path has the robot at the end near where it was a lap before; odometry has it metres away.
  const int last = drive.scans() - 1;
  ASSERT_TRUE(WaitFor([&] { return driver.path().poses.size() >= static_cast<std::size_t>(last - 20); }));
  EXPECT_EQ(driver.path().header.frame_id, "map");
  const auto gap = [&](const auto& position) {
    return (position(last - 1) - position(last - 1 - SyntheticDrive::kScansPerLap)).norm();
  };
  const double gap_odometry = gap([&](int scan) -> Eigen::Vector3d { return drive.T_odom_sensor(scan).translation(); });
  EXPECT_GT(gap_odometry, 2.0);

  // map -> odom has a publisher, and is no identity.
  ASSERT_TRUE(WaitFor([&] { return tf_buffer.canTransform("map", "odom", ros::Time(0)); }));
  const Pose T_map_odom = ToPose(tf_buffer.lookupTransform("map", "odom", ros::Time(0)).transform, "map to odom");
  EXPECT_GT((T_map_odom * drive.T_odom_sensor(last).translation() - drive.T_odom_sensor(last).translation()).norm(),
            0.5);

  // Files, on request.
  const std::string folder = ros::param::param<std::string>("/output_dir", "");
  std_srvs::Trigger written;
  ASSERT_TRUE(ros::service::call("write_trajectories", written));
  EXPECT_TRUE(written.response.success) << written.response.message;
  EXPECT_EQ(Lines(folder + "/trajectory_odometry.tum").size(), static_cast<std::size_t>(drive.scans()));
  const std::vector<std::string> optimized = Lines(folder + "/trajectory_optimized.tum");
  ASSERT_EQ(optimized.size(), static_cast<std::size_t>(drive.scans()));
  const double gap_optimized = gap([&](int scan) -> Eigen::Vector3d {
    std::istringstream line(optimized[static_cast<std::size_t>(scan)]);
    double stamp;
    Eigen::Vector3d t;
    line >> stamp >> t.x() >> t.y() >> t.z();
    return t;
  });
  EXPECT_LT(gap_optimized, 0.5);
  const std::vector<std::string> rows = Lines(folder + "/closures.csv");
  ASSERT_GT(rows.size(), closures.size());  // a heading, and every recognition
  EXPECT_EQ(rows[0], "stamp_query,stamp_target,robot_query,robot_target,x,y,z,qx,qy,qz,qw,inliers,candidates,rms_m");
}

TEST_F(Pipeline, MapIsSavedAndAWrongPathIsExplained) {
  const std::string folder = ros::param::param<std::string>("/output_dir", "");
  SaveMap save;
  save.request.path = folder + "/town.map";
  ASSERT_TRUE(ros::service::call("save_map", save));
  EXPECT_TRUE(save.response.success) << save.response.message;
  EXPECT_GT(save.response.segments, 20u);
  EXPECT_TRUE(std::ifstream(save.request.path).good());
  save.request.path = folder + "/no_such_folder/town.map";
  ASSERT_TRUE(ros::service::call("save_map", save));
  EXPECT_FALSE(save.response.success);
  EXPECT_NE(save.response.message.find("no_such_folder"), std::string::npos) << save.response.message;
}

TEST_F(Pipeline, SavedMapLocalizesTheRobot) {
  const std::string folder = ros::param::param<std::string>("/output_dir", "");
  ros::param::set("/localizer/map_file", folder + "/town.map");
  ros::param::set("/localizer/back_end/mode", "localization");
  ros::param::set("/localizer/publish_tf", false);  // the pose graph does
  nodelet::NodeletLoad load;
  load.request.name = "/localizer";
  load.request.type = "incremental_segmatch/BackEndNodelet";
  for (const std::string topic : {"save_map", "load_map", "back_end_steps", "loop_closures"}) {
    load.request.remap_source_args.push_back("/" + topic);
    load.request.remap_target_args.push_back("/localizer/" + topic);
  }
  ASSERT_TRUE(ros::service::call("/manager/load_nodelet", load));
  ros::NodeHandle nh;
  std::vector<geometry_msgs::PoseWithCovarianceStamped> poses;
  ros::Subscriber subscriber = nh.subscribe<geometry_msgs::PoseWithCovarianceStamped>(
      "localization", 10, [&poses](const geometry_msgs::PoseWithCovarianceStampedConstPtr& m) { poses.push_back(*m); });
  ASSERT_TRUE(WaitFor([&] { return subscriber.getNumPublishers() > 0; }));

  const SyntheticDrive& drive = driver_->drive();
  for (int scan = drive.scans(); scan < drive.scans() + 12; ++scan) ASSERT_TRUE(driver_->Drive(scan));
  ASSERT_TRUE(WaitFor([&] { return poses.size() >= 3; }));
  // The map's frame is that of the optimized first lap, so near the odometry's origin.
  const Pose T_map_world = drive.T_world_sensor(0).inverse();
  for (const geometry_msgs::PoseWithCovarianceStamped& pose : poses) {
    EXPECT_EQ(pose.header.frame_id, "map");
    const int scan =
        static_cast<int>((ToStampNs(pose.header.stamp) - SyntheticDrive::kStartNs) / SyntheticDrive::kPeriodNs);
    const Pose T_map_base = T_map_world * drive.T_world_sensor(scan) * BaseToSensor().inverse();
    EXPECT_LT((ToPose(pose.pose.pose, "").translation() - T_map_base.translation()).norm(), 2.0);
    const Covariance6 covariance = ToCovariance(pose.pose);
    EXPECT_GT(covariance.diagonal().minCoeff(), 0.0);
    EXPECT_LT(covariance.diagonal().maxCoeff(), 1.0);
  }
}

}  // namespace
}  // namespace incremental_segmatch
