#include <geometry_msgs/TransformStamped.h>
#include <nav_msgs/Odometry.h>
#include <rosbag/bag.h>
#include <std_msgs/Time.h>
#include <tf2_msgs/TFMessage.h>

#include <algorithm>
#include <cstdio>
#include <filesystem>
#include <stdexcept>

#include "evaluation/bag.hpp"
#include "evaluation/bag_common.hpp"

namespace incremental_segmatch {
namespace {

// Topics, frames and the fixed transforms between body and sensor.
struct Layout {
  std::string cloud_topic;
  std::string body_frame;  // whose pose the odometry gives
  std::string sensor_frame;
  Pose T_body_sensor = Pose::Identity();
  std::vector<geometry_msgs::TransformStamped> static_transforms;
};

Pose Offset(double x, double y, double z) {
  Pose T = Pose::Identity();
  T.translation() << x, y, z;
  return T;
}

Layout MakeLayout(BagStyle style) {
  Layout layout;
  if (style == BagStyle::kVelodynePoints) {
    layout.cloud_topic = "/velodyne_points";
    layout.body_frame = layout.sensor_frame = "velodyne";
    return layout;
  }
  // The published geometry of the KITTI car: base_link on the ground below the middle of the rear axle, the IMU behind
  // it, the LiDAR 0.81 m before the IMU and 1.73 m above ground.
  const Pose T_base_imu = Offset(-0.05, 0.32, 0.93);
  const Pose T_imu_velo = Offset(0.81, -0.32, 0.80);
  layout.cloud_topic = "/kitti/velo/pointcloud";
  layout.body_frame = "base_link";
  layout.sensor_frame = "velo_link";
  layout.T_body_sensor = T_base_imu * T_imu_velo;
  layout.static_transforms = {ToMessage(T_base_imu, ros::Time(), "base_link", "imu_link"),
                              ToMessage(T_imu_velo, ros::Time(), "imu_link", "velo_link")};
  return layout;
}

// Makes a late subscriber get the message, too, when the bag is played.
template <typename Message>
boost::shared_ptr<ros::M_string> LatchedHeader(const std::string& topic) {
  auto header = boost::make_shared<ros::M_string>();
  (*header)["callerid"] = "/segmatch";
  (*header)["latching"] = "1";
  (*header)["topic"] = topic;
  (*header)["type"] = ros::message_traits::datatype<Message>();
  (*header)["md5sum"] = ros::message_traits::md5sum<Message>();
  (*header)["message_definition"] = ros::message_traits::definition<Message>();
  return header;
}

nav_msgs::Odometry OdometryMessage(const Pose& T_world_body, const ros::Time& stamp, const std::string& body_frame) {
  nav_msgs::Odometry message;
  message.header.stamp = stamp;
  message.header.frame_id = "world";
  message.child_frame_id = body_frame;
  message.pose.pose = ToMessage(T_world_body);
  return message;
}

void WriteOnce(rosbag::Bag& bag, const Layout& layout, std::int64_t epoch_s, const ros::Time& first) {
  std_msgs::Time epoch;
  epoch.data = ToRosTime(epoch_s * 1000000000);
  bag.write(kEpochTopic, first, epoch, LatchedHeader<std_msgs::Time>(kEpochTopic));
  if (layout.static_transforms.empty()) return;
  tf2_msgs::TFMessage message;
  message.transforms = layout.static_transforms;
  for (geometry_msgs::TransformStamped& transform : message.transforms) transform.header.stamp = first;
  bag.write("/tf_static", first, message, LatchedHeader<tf2_msgs::TFMessage>("/tf_static"));
}

void WriteScan(rosbag::Bag& bag, const Layout& layout, const KittiDrive& drive, std::size_t i, const ros::Time& stamp) {
  // World is where the body stood at the odometry's origin.
  const auto body_pose = [&](const Pose& T_origin_sensor) -> Pose {
    return layout.T_body_sensor * T_origin_sensor * layout.T_body_sensor.inverse();
  };
  const Pose T_world_body = body_pose(drive.T_odom_sensor(i));
  tf2_msgs::TFMessage tf;
  tf.transforms.push_back(ToMessage(T_world_body, stamp, "world", layout.body_frame));
  bag.write("/tf", stamp, tf);
  bag.write("/odometry", stamp, OdometryMessage(T_world_body, stamp, layout.body_frame));
  if (const std::optional<Pose> truth = drive.T_world_sensor(i)) {
    bag.write("/ground_truth", stamp, OdometryMessage(body_pose(*truth), stamp, layout.body_frame));
  }
  bag.write(layout.cloud_topic, stamp, CloudMessage(drive.ReadScan(i), stamp, layout.sensor_frame));
}

}  // namespace

void WriteBag(const KittiDrive& drive, const BagWriterOptions& options,
              const std::function<void(std::size_t, std::size_t)>& progress) {
  const Layout layout = MakeLayout(options.style);
  const std::size_t scans = options.max_scans > 0 ? std::min(options.max_scans, drive.size()) : drive.size();
  const auto stamp = [&](std::size_t i) { return ToRosTime(options.epoch_s * 1000000000 + drive.stamp_ns(i)); };
  if (stamp(0).isZero()) throw std::runtime_error("a bag refuses time 0: give an epoch greater than 0");
  const std::string unfinished = options.path + ".part";
  try {
    rosbag::Bag bag(unfinished, rosbag::bagmode::Write);
    WriteOnce(bag, layout, options.epoch_s, stamp(0));
    for (std::size_t i = 0; i < scans; ++i) {
      WriteScan(bag, layout, drive, i, stamp(i));
      if (progress) progress(i + 1, scans);
    }
    bag.close();
    std::filesystem::rename(unfinished, options.path);
  } catch (const rosbag::BagException& error) {
    std::remove(unfinished.c_str());
    throw std::runtime_error("can't write the bag " + options.path + ": " + error.what());
  } catch (...) {
    std::remove(unfinished.c_str());
    throw;
  }
}

}  // namespace incremental_segmatch
