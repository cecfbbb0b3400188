#include "evaluation/bag_common.hpp"

#include <cmath>
#include <cstring>
#include <stdexcept>

namespace incremental_segmatch {
namespace {

Pose MakePose(double x, double y, double z, double qw, double qx, double qy, double qz) {
  const Eigen::Quaterniond q(qw, qx, qy, qz);
  const Eigen::Vector3d t(x, y, z);
  if (!t.allFinite() || !(std::abs(q.norm() - 1.0) < 0.1)) {
    throw std::runtime_error("a pose in the bag is not finite, or its quaternion is not of unit length");
  }
  Pose T = Pose::Identity();
  T.linear() = q.normalized().toRotationMatrix();
  T.translation() = t;
  return T;
}

// Where a coordinate lies in a point, and how wide it is.
struct Coordinate {
  std::size_t offset = 0;
  bool is_double = false;

  float Read(const std::uint8_t* point) const {
    if (is_double) {
      double value = 0.0;
      std::memcpy(&value, point + offset, sizeof value);
      return static_cast<float>(value);
    }
    float value = 0.f;
    std::memcpy(&value, point + offset, sizeof value);
    return value;
  }
};

Coordinate FindCoordinate(const sensor_msgs::PointCloud2& cloud, const std::string& name) {
  std::string names;
  for (const sensor_msgs::PointField& field : cloud.fields) {
    names += " " + field.name;
    if (field.name != name) continue;
    const bool is_double = field.datatype == sensor_msgs::PointField::FLOAT64;
    if (!is_double && field.datatype != sensor_msgs::PointField::FLOAT32) {
      throw std::runtime_error("the point cloud's field " + name + " is neither float32 nor float64");
    }
    if (field.offset + (is_double ? sizeof(double) : sizeof(float)) > cloud.point_step) {
      throw std::runtime_error("the point cloud's field " + name + " lies outside the point");
    }
    return {field.offset, is_double};
  }
  throw std::runtime_error("the point cloud has no field " + name + ", only:" + (names.empty() ? " none" : names));
}

}  // namespace

geometry_msgs::Pose ToMessage(const Pose& T) {
  const Eigen::Quaterniond q = Eigen::Quaterniond(T.linear()).normalized();
  geometry_msgs::Pose message;
  message.position.x = T.translation().x();
  message.position.y = T.translation().y();
  message.position.z = T.translation().z();
  message.orientation.x = q.x();
  message.orientation.y = q.y();
  message.orientation.z = q.z();
  message.orientation.w = q.w();
  return message;
}

geometry_msgs::TransformStamped ToMessage(const Pose& T_parent_child, const ros::Time& stamp, const std::string& parent,
                                          const std::string& child) {
  const geometry_msgs::Pose pose = ToMessage(T_parent_child);
  geometry_msgs::TransformStamped message;
  message.header.stamp = stamp;
  message.header.frame_id = parent;
  message.child_frame_id = child;
  message.transform.translation.x = pose.position.x;
  message.transform.translation.y = pose.position.y;
  message.transform.translation.z = pose.position.z;
  message.transform.rotation = pose.orientation;
  return message;
}

Pose FromMessage(const geometry_msgs::Pose& message) {
  return MakePose(message.position.x, message.position.y, message.position.z, message.orientation.w,
                  message.orientation.x, message.orientation.y, message.orientation.z);
}

Pose FromMessage(const geometry_msgs::Transform& message) {
  return MakePose(message.translation.x, message.translation.y, message.translation.z, message.rotation.w,
                  message.rotation.x, message.rotation.y, message.rotation.z);
}

Points PointsFromMessage(const sensor_msgs::PointCloud2& cloud) {
  if (cloud.is_bigendian) throw std::runtime_error("the point cloud is big-endian, which is not supported");
  const Coordinate x = FindCoordinate(cloud, "x");
  const Coordinate y = FindCoordinate(cloud, "y");
  const Coordinate z = FindCoordinate(cloud, "z");
  const std::size_t row_bytes = std::size_t{cloud.width} * cloud.point_step;
  if (cloud.row_step < row_bytes || cloud.data.size() < std::size_t{cloud.row_step} * cloud.height) {
    throw std::runtime_error("the point cloud holds less data than its width and height say");
  }
  Points points;
  points.reserve(std::size_t{cloud.width} * cloud.height);
  for (std::size_t row = 0; row < cloud.height; ++row) {
    const std::uint8_t* point = cloud.data.data() + row * cloud.row_step;
    for (std::size_t column = 0; column < cloud.width; ++column, point += cloud.point_step) {
      points.emplace_back(x.Read(point), y.Read(point), z.Read(point));
    }
  }
  return points;
}

sensor_msgs::PointCloud2 CloudMessage(const KittiScan& scan, const ros::Time& stamp, const std::string& frame) {
  constexpr std::uint32_t kPointStep = 4 * sizeof(float);
  sensor_msgs::PointCloud2 cloud;
  cloud.header.stamp = stamp;
  cloud.header.frame_id = frame;
  cloud.height = 1;
  cloud.width = static_cast<std::uint32_t>(scan.points_sensor.size());
  cloud.point_step = kPointStep;
  cloud.row_step = kPointStep * cloud.width;
  cloud.is_dense = true;
  std::uint32_t offset = 0;
  for (const char* name : {"x", "y", "z", "intensity"}) {
    sensor_msgs::PointField field;
    field.name = name;
    field.offset = offset;
    field.datatype = sensor_msgs::PointField::FLOAT32;
    field.count = 1;
    cloud.fields.push_back(field);
    offset += sizeof(float);
  }
  cloud.data.resize(cloud.row_step);
  for (std::size_t i = 0; i < scan.points_sensor.size(); ++i) {
    std::uint8_t* point = cloud.data.data() + i * kPointStep;
    std::memcpy(point, scan.points_sensor[i].data(), 3 * sizeof(float));
    std::memcpy(point + 3 * sizeof(float), &scan.intensities[i], sizeof(float));
  }
  return cloud;
}

}  // namespace incremental_segmatch
