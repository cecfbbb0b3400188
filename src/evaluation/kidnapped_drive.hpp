/// \file
/// A robot that is carried elsewhere in the middle of a drive.
#pragma once

#include <cmath>
#include <optional>
#include <random>
#include <string>
#include <vector>

#include "evaluation/drive_source.hpp"

namespace incremental_segmatch {

/// Anywhere within a kilometre, turned by any angle about the vertical.
inline Pose RandomPlacement(unsigned seed) {
  std::mt19937 random(seed);
  std::uniform_real_distribution<double> uniform(-1.0, 1.0);
  Pose T = Pose::Identity();
  T.translation() << 1000.0 * uniform(random), 1000.0 * uniform(random), 10.0 * uniform(random);
  T.linear() = Eigen::AngleAxisd(M_PI * uniform(random), Eigen::Vector3d::UnitZ()).toRotationMatrix();
  return T;
}

/// A drive whose odometry from some scan on is moved by a rigid transform: T_moved_odom * T_odom_sensor. What
/// recognition does must not depend on it. The other drive must outlive this one.
class KidnappedDrive : public DriveSource {
 public:
  KidnappedDrive(DriveSource& drive, std::size_t first_moved, const Pose& T_moved_odom)
      : drive_(drive), first_moved_(first_moved), T_moved_odom_(T_moved_odom) {}

  std::string name() const override { return drive_.name(); }
  std::size_t size() const override { return drive_.size(); }
  StampNs stamp_ns(std::size_t i) const override { return drive_.stamp_ns(i); }
  Pose T_odom_sensor(std::size_t i) const override {
    return i < first_moved_ ? drive_.T_odom_sensor(i) : T_moved_odom_ * drive_.T_odom_sensor(i);
  }
  std::optional<Pose> T_world_sensor(std::size_t i) const override { return drive_.T_world_sensor(i); }
  Points ReadPoints(std::size_t i) override { return drive_.ReadPoints(i); }
  bool odometry_is_truth() const override { return drive_.odometry_is_truth(); }
  std::vector<std::string> notes() const override {
    std::vector<std::string> notes = drive_.notes();
    notes.push_back("kidnapped: the odometry is moved by a rigid transform from scan " + std::to_string(first_moved_) +
                    " on");
    return notes;
  }

 private:
  DriveSource& drive_;
  std::size_t first_moved_;
  Pose T_moved_odom_;
};

}  // namespace incremental_segmatch
