#include "evaluation/bag.hpp"

#include <geometry_msgs/PoseStamped.h>
#include <gtest/gtest.h>
#include <nav_msgs/Odometry.h>
#include <rosbag/bag.h>
#include <rosbag/view.h>
#include <std_msgs/Time.h>
#include <tf2_msgs/TFMessage.h>

#include <cstring>
#include <filesystem>
#include <map>

#include "evaluation/bag_common.hpp"
#include "support/kitti_layout.hpp"

namespace incremental_segmatch {
namespace {

using test::MessageOf;

#define EXPECT_HAS(text, word) \
  EXPECT_NE((text).find(word), std::string::npos) << "`" << (word) << "` is not in: " << (text)

Pose Relative(const DriveSource& drive, std::size_t a, std::size_t b) {
  return drive.T_odom_sensor(a).inverse() * drive.T_odom_sensor(b);
}

class Bag : public testing::Test {
 protected:
  Bag() { test::WriteKittiLayout(tiny_, directory_, "07"); }

  KittiDrive Drive(const std::string& odometry = "odometry.txt") const {
    return KittiDrive({directory_.path(), "07", odometry});
  }

  std::string WriteStyle(BagStyle style) const {
    BagWriterOptions options;
    options.path = directory_.path() + "/drive.bag";
    options.style = style;
    WriteBag(Drive(), options);
    return options.path;
  }

  test::TinyDrive tiny_ = test::MakeTinyDrive(5);
  test::TemporaryDirectory directory_;
};

TEST_F(Bag, HasTheTopicsAndFramesOfKitti2Bag) {
  rosbag::Bag bag(WriteStyle(BagStyle::kKitti2Bag), rosbag::bagmode::Read);
  std::map<std::string, std::string> types;
  rosbag::View view(bag);
  for (const rosbag::ConnectionInfo* connection : view.getConnections())
    types[connection->topic] = connection->datatype;
  const std::map<std::string, std::string> expected{{"/kitti/velo/pointcloud", "sensor_msgs/PointCloud2"},
                                                    {"/tf", "tf2_msgs/TFMessage"},
                                                    {"/tf_static", "tf2_msgs/TFMessage"},
                                                    {"/odometry", "nav_msgs/Odometry"},
                                                    {"/ground_truth", "nav_msgs/Odometry"},
                                                    {"/segmatch/epoch", "std_msgs/Time"}};
  EXPECT_EQ(types, expected);
  std::map<std::string, std::string> parents;
  for (const rosbag::MessageInstance& message : view) {
    EXPECT_GE(message.getTime().sec, 1317000000u);
    if (const auto cloud = message.instantiate<sensor_msgs::PointCloud2>()) {
      EXPECT_EQ(cloud->header.frame_id, "velo_link");
      EXPECT_EQ(cloud->header.stamp, message.getTime());
    }
    if (const auto tf = message.instantiate<tf2_msgs::TFMessage>()) {
      for (const auto& transform : tf->transforms) parents[transform.child_frame_id] = transform.header.frame_id;
    }
    if (const auto odometry = message.instantiate<nav_msgs::Odometry>()) {
      EXPECT_EQ(odometry->header.frame_id, "world");
      EXPECT_EQ(odometry->child_frame_id, "base_link");
    }
  }
  const std::map<std::string, std::string> tree{
      {"base_link", "world"}, {"imu_link", "base_link"}, {"velo_link", "imu_link"}};
  EXPECT_EQ(parents, tree);
}

TEST_F(Bag, HasTheTopicsAndFramesOfVelodynePoints) {
  rosbag::Bag bag(WriteStyle(BagStyle::kVelodynePoints), rosbag::bagmode::Read);
  rosbag::View clouds(bag, rosbag::TopicQuery(std::string("/velodyne_points")));
  EXPECT_EQ(clouds.size(), 5u);
  EXPECT_EQ(clouds.begin()->instantiate<sensor_msgs::PointCloud2>()->header.frame_id, "velodyne");
  rosbag::View transforms(bag, rosbag::TopicQuery(std::string("/tf")));
  const auto tf = transforms.begin()->instantiate<tf2_msgs::TFMessage>();
  EXPECT_EQ(tf->transforms[0].header.frame_id, "world");
  EXPECT_EQ(tf->transforms[0].child_frame_id, "velodyne");
}

TEST_F(Bag, RoundTripGivesTheSameDrive) {
  for (const BagStyle style : {BagStyle::kKitti2Bag, BagStyle::kVelodynePoints}) {
    for (const std::string odometry_topic : {"", "/odometry"}) {
      SCOPED_TRACE("style " + std::to_string(static_cast<int>(style)) + ", odometry from `" + odometry_topic + "`");
      BagDriveOptions options;
      options.path = WriteStyle(style);
      options.odometry_topic = odometry_topic;
      const std::unique_ptr<DriveSource> drive = OpenBag(options);
      KittiDrive expected = Drive();
      ASSERT_EQ(drive->size(), expected.size());
      for (std::size_t i = 0; i < drive->size(); ++i) {
        EXPECT_EQ(drive->stamp_ns(i), expected.stamp_ns(i)) << "the epoch is taken off";
        EXPECT_TRUE(Relative(*drive, 0, i).isApprox(Relative(expected, 0, i), 1e-9));
        ASSERT_TRUE(drive->T_world_sensor(i).has_value());
        EXPECT_TRUE((drive->T_world_sensor(0)->inverse() * *drive->T_world_sensor(i))
                        .isApprox(tiny_.T_world_sensor[0].inverse() * tiny_.T_world_sensor[i], 1e-9));
        const Points points = drive->ReadPoints(i), expected_points = expected.ReadPoints(i);
        ASSERT_EQ(points.size(), expected_points.size());
        for (std::size_t k = 0; k + 1 < points.size(); ++k) EXPECT_EQ(points[k], expected_points[k]);
        EXPECT_TRUE(std::isnan(points.back().x()));
      }
    }
  }
}

TEST_F(Bag, FailedWriteLeavesNothing) {
  directory_.Write("sequences/07/velodyne/000003.bin", "broken");
  EXPECT_HAS(MessageOf([&] { WriteStyle(BagStyle::kKitti2Bag); }), "000003.bin");
  EXPECT_FALSE(std::filesystem::exists(directory_.path() + "/drive.bag"));
  EXPECT_FALSE(std::filesystem::exists(directory_.path() + "/drive.bag.part"));
  BagWriterOptions options;
  options.path = "/nonexistent_folder/drive.bag";
  EXPECT_HAS(MessageOf([&] { WriteBag(Drive(), options); }), "/nonexistent_folder/drive.bag");
}

// A bag that a test fills by itself.
class ForeignBag : public Bag {
 protected:
  ForeignBag() : path_(directory_.path() + "/foreign.bag") { bag_.open(path_, rosbag::bagmode::Write); }

  void AddCloud(double stamp_s, const std::string& frame = "lidar", const std::string& topic = "/points") {
    const KittiScan scan{{{1.f, 2.f, 3.f}}, {0.f}};
    const ros::Time stamp(stamp_s);
    bag_.write(topic, ros::Time(100.0 + written_++), CloudMessage(scan, stamp, frame));
  }
  void AddTf(double stamp_s, double x, const std::string& parent = "odom", const std::string& child = "lidar") {
    Pose T = Pose::Identity();
    T.translation().x() = x;
    tf2_msgs::TFMessage message;
    message.transforms.push_back(ToMessage(T, ros::Time(stamp_s), parent, child));
    bag_.write("/tf", ros::Time(stamp_s), message);
  }
  std::unique_ptr<DriveSource> Open(BagDriveOptions options = {}) {
    bag_.close();
    options.path = path_;
    return OpenBag(options);
  }

  std::string path_;
  rosbag::Bag bag_;
  int written_ = 0;
};

TEST_F(ForeignBag, OdometryIsInterpolatedAndScansWithoutPoseAreLeftOut) {
  AddTf(10.0, 0.0);
  AddTf(12.0, 4.0);
  for (const double stamp : {9.0, 10.5, 11.0, 11.0, 10.9, 13.0}) AddCloud(stamp);
  const std::unique_ptr<DriveSource> drive = Open();
  ASSERT_EQ(drive->size(), 2u);
  EXPECT_NEAR(drive->T_odom_sensor(0).translation().x(), 1.0, 1e-9);
  EXPECT_NEAR(drive->T_odom_sensor(1).translation().x(), 2.0, 1e-9);
  EXPECT_EQ(drive->stamp_ns(0), 10500000000) << "no epoch in the bag: its own clock";
  EXPECT_FALSE(drive->T_world_sensor(0).has_value());
  std::string notes;
  for (const std::string& note : drive->notes()) notes += note + "; ";
  EXPECT_HAS(notes, "2 scans left out, for want of a pose");
  EXPECT_HAS(notes, "2 scans left out, their stamps do not increase");
  EXPECT_HAS(notes, "no ground truth");
}

TEST_F(ForeignBag, OdometryOfTheBodyIsBroughtToTheSensor) {
  AddTf(1.0, 0.5, "base", "/lidar");
  AddCloud(10.0);
  nav_msgs::Odometry odometry;
  odometry.header.stamp = ros::Time(10.0);
  odometry.child_frame_id = "base";
  odometry.pose.pose.position.x = 7.0;
  odometry.pose.pose.orientation.w = 1.0;
  AddTf(10.0, 0.5, "base", "/lidar");
  bag_.write("/odom", ros::Time(10.0), odometry);
  geometry_msgs::PoseStamped truth;
  truth.header.stamp = ros::Time(10.0);
  truth.pose.position.y = 3.0;
  truth.pose.orientation.w = 1.0;
  bag_.write("/truth", ros::Time(10.0), truth);
  BagDriveOptions options;
  options.odometry_topic = "/odom";
  options.ground_truth_topic = "/truth";
  const std::unique_ptr<DriveSource> drive = Open(options);
  ASSERT_EQ(drive->size(), 1u);
  EXPECT_NEAR(drive->T_odom_sensor(0).translation().x(), 7.5, 1e-9);
  EXPECT_NEAR(drive->T_world_sensor(0)->translation().y(), 3.0, 1e-9);
  EXPECT_NEAR(drive->T_world_sensor(0)->translation().x(), 0.0, 1e-9) << "a pose without a body is the sensor's own";
}

TEST_F(ForeignBag, SeveralCloudTopicsNeedAChoice) {
  AddCloud(10.0, "lidar", "/a");
  AddCloud(11.0, "lidar", "/b");
  const std::string error = MessageOf([&] { Open(); });
  EXPECT_HAS(error, "--topic");
  EXPECT_HAS(error, "/a, /b");
}

TEST_F(ForeignBag, NoCloudTopic) {
  AddTf(1.0, 0.0);
  const std::string error = MessageOf([&] { Open(); });
  EXPECT_HAS(error, "sensor_msgs/PointCloud2");
  EXPECT_HAS(error, "/tf");
}

TEST_F(ForeignBag, WrongTopicNamesTheOthers) {
  AddCloud(10.0);
  BagDriveOptions options;
  options.cloud_topic = "/wrong";
  EXPECT_HAS(MessageOf([&] { Open(options); }), "/points");
}

TEST_F(ForeignBag, MissingTfIsNeverTheIdentity) {
  AddCloud(10.0);
  AddTf(10.0, 0.0, "elsewhere", "something");
  const std::string error = MessageOf([&] { Open(); });
  EXPECT_HAS(error, "no scan on /points has a pose");
  EXPECT_HAS(error, "elsewhere, something");
}

TEST_F(Bag, MissingOrBrokenFile) {
  BagDriveOptions options;
  options.path = directory_.path() + "/none.bag";
  EXPECT_HAS(MessageOf([&] { OpenBag(options); }), "none.bag: there is no such file");
  options.path = directory_.Write("broken.bag", "not a bag");
  EXPECT_HAS(MessageOf([&] { OpenBag(options); }), "broken.bag");
}

sensor_msgs::PointField Field(const std::string& name, std::uint32_t offset, std::uint8_t datatype) {
  sensor_msgs::PointField field;
  field.name = name;
  field.offset = offset;
  field.datatype = datatype;
  field.count = 1;
  return field;
}

TEST(PointCloudMessage, AnyFieldLayoutIsRead) {
  // Two rows of two points, padded; z first and double, other fields between, a gap at the end of each row.
  sensor_msgs::PointCloud2 cloud;
  cloud.fields = {Field("z", 2, sensor_msgs::PointField::FLOAT64), Field("ring", 0, sensor_msgs::PointField::UINT16),
                  Field("y", 16, sensor_msgs::PointField::FLOAT32), Field("x", 12, sensor_msgs::PointField::FLOAT32)};
  cloud.height = 2;
  cloud.width = 2;
  cloud.point_step = 21;
  cloud.row_step = 2 * 21 + 5;
  cloud.data.resize(2 * cloud.row_step, 0xff);
  for (int i = 0; i < 4; ++i) {
    std::uint8_t* point = cloud.data.data() + (i / 2) * cloud.row_step + (i % 2) * 21;
    const float x = 1.f + static_cast<float>(i), y = 10.f * x;
    const double z = 100.0 * x;
    std::memcpy(point + 12, &x, 4);
    std::memcpy(point + 16, &y, 4);
    std::memcpy(point + 2, &z, 8);
  }
  const Points points = PointsFromMessage(cloud);
  ASSERT_EQ(points.size(), 4u);
  for (int i = 0; i < 4; ++i) EXPECT_EQ(points[i], Eigen::Vector3f(1.f + i, 10.f * (1.f + i), 100.f * (1.f + i)));

  sensor_msgs::PointCloud2 cut = cloud;
  cut.data.resize(60);
  EXPECT_HAS(MessageOf([&] { PointsFromMessage(cut); }), "less data");
  sensor_msgs::PointCloud2 without_x = cloud;
  without_x.fields.pop_back();
  EXPECT_HAS(MessageOf([&] { PointsFromMessage(without_x); }), "no field x, only: z ring y");
  sensor_msgs::PointCloud2 integers = cloud;
  integers.fields[2].datatype = sensor_msgs::PointField::INT32;
  EXPECT_HAS(MessageOf([&] { PointsFromMessage(integers); }), "field y is neither");
  sensor_msgs::PointCloud2 outside = cloud;
  outside.fields[2].offset = 18;
  EXPECT_HAS(MessageOf([&] { PointsFromMessage(outside); }), "outside the point");
  EXPECT_TRUE(PointsFromMessage(CloudMessage({}, ros::Time(1.0), "lidar")).empty());
}

}  // namespace
}  // namespace incremental_segmatch
