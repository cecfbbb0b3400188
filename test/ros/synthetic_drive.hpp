/// \file
/// A small world and two laps through it, as messages: what ROS tests drive nodelets with.
#pragma once

#include <sensor_msgs/PointCloud2.h>

#include <algorithm>
#include <cmath>
#include <random>
#include <vector>

#include "conversions.hpp"
#include "incremental_segmatch/types.hpp"
#include "point_cloud.hpp"

namespace incremental_segmatch::test {

/// Boxes and poles on both sides of a circular road. The sensor sees all points within its range, from the ground up.
class SyntheticDrive {
 public:
  static constexpr double kRadius_m = 30.0;
  static constexpr double kRange_m = 18.0;
  static constexpr double kSensorHeight_m = 1.7;
  static constexpr int kScansPerLap = 60;
  static constexpr StampNs kStartNs = 1317000000000000000;
  static constexpr StampNs kPeriodNs = 1000000000;

  SyntheticDrive() {
    std::mt19937 random(7);
    std::uniform_real_distribution<double> unit(0.0, 1.0);
    for (int i = 0; i < 70; ++i) {
      const double angle = 2.0 * M_PI * (i + 0.5 * unit(random)) / 70.0;
      const double radius = kRadius_m + (i % 2 == 0 ? 1.0 : -1.0) * (5.0 + 7.0 * unit(random));
      const bool is_pole = i % 3 == 0;
      const Eigen::Vector3d size =
          is_pole ? Eigen::Vector3d(0.3, 0.3, 3.0 + 3.0 * unit(random))
                  : Eigen::Vector3d(1.0 + 1.5 * unit(random), 0.8 + unit(random), 1.5 + 3.0 * unit(random));
      AddBox({radius * std::cos(angle), radius * std::sin(angle), 0.0}, size, M_PI * unit(random), random);
    }
  }

  int scans() const { return 2 * kScansPerLap; }
  StampNs stamp_ns(int scan) const { return kStartNs + scan * kPeriodNs; }

  /// True pose of the sensor.
  Pose T_world_sensor(int scan) const {
    const double angle = 2.0 * M_PI * scan / kScansPerLap;
    Pose T = Pose::Identity();
    T.linear() = Eigen::AngleAxisd(angle + M_PI / 2.0, Eigen::Vector3d::UnitZ()).toRotationMatrix();
    T.translation() << kRadius_m * std::cos(angle), kRadius_m * std::sin(angle), kSensorHeight_m;
    return T;
  }

  /// Odometry: begins at the identity, drifts by 1.5 % of the way and turns a little.
  Pose T_odom_sensor(int scan) const {
    Pose T_odom = Pose::Identity();
    for (int i = 1; i <= scan; ++i) {
      Pose step = T_world_sensor(i - 1).inverse() * T_world_sensor(i);
      step.translation() *= 1.015;
      step.linear() = step.linear() * Eigen::AngleAxisd(0.002, Eigen::Vector3d::UnitZ());
      T_odom = T_odom * step;
    }
    return T_odom;
  }

  /// The scan in the sensor's frame.
  Points Scan(int scan) const {
    const Pose T_sensor_world = T_world_sensor(scan).inverse();
    Points points;
    for (const Eigen::Vector3d& point : world_) {
      const Eigen::Vector3d p = T_sensor_world * point;
      if (p.head<2>().norm() < kRange_m) points.push_back(p.cast<float>());
    }
    return points;
  }

  /// The scan as a message.
  sensor_msgs::PointCloud2 Cloud(int scan, const std::string& frame) const {
    std::vector<ColouredPoint> points;
    for (const Eigen::Vector3f& p : Scan(scan)) points.push_back({p, 0});
    std_msgs::Header header;
    header.stamp = ToTime(stamp_ns(scan));
    header.frame_id = frame;
    return ToPointCloud2(points, header);
  }

 private:
  void AddBox(const Eigen::Vector3d& foot, const Eigen::Vector3d& size, double yaw, std::mt19937& random) {
    const Eigen::Matrix3d R = Eigen::AngleAxisd(yaw, Eigen::Vector3d::UnitZ()).toRotationMatrix();
    const double area = 2.0 * (size.x() + size.y()) * size.z() + size.x() * size.y();
    std::uniform_real_distribution<double> unit(-0.5, 0.5);
    const int count = static_cast<int>(area * 250.0);
    for (int i = 0; i < count; ++i) {
      Eigen::Vector3d p(unit(random), unit(random), unit(random));
      const double choice = (unit(random) + 0.5) * area;
      if (choice < size.x() * size.y())
        p.z() = 0.5;
      else if (choice < size.x() * size.y() + 2.0 * size.x() * size.z())
        p.y() = std::copysign(0.5, p.y());
      else
        p.x() = std::copysign(0.5, p.x());
      p.z() += 0.5;
      world_.push_back(foot + R * p.cwiseProduct(size));
    }
  }

  std::vector<Eigen::Vector3d> world_;
};

}  // namespace incremental_segmatch::test
