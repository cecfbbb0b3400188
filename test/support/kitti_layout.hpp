/// \file
/// A tiny drive in KITTI's layout, made by a test.
#pragma once

#include <cmath>
#include <cstdio>
#include <exception>
#include <string>
#include <vector>

#include "incremental_segmatch/types.hpp"
#include "support/temporary_directory.hpp"

namespace incremental_segmatch::test {

/// What such a drive holds; row i of each belongs to scan i.
struct TinyDrive {
  std::vector<double> seconds;
  std::vector<Pose> T_world_sensor;  ///< the first is the identity, as in KITTI
  std::vector<Pose> T_odom_sensor;
  Pose T_camera_sensor = Pose::Identity();
};

/// A pose as a row of 12 numbers.
inline std::string MatrixRow(const Pose& T) {
  std::string row;
  char number[32];
  for (int k = 0; k < 12; ++k) {
    std::snprintf(number, sizeof number, "%s%.12g", k > 0 ? " " : "", T.matrix()(k / 4, k % 4));
    row += number;
  }
  return row;
}

/// A few scans on a curve, odometry beside the truth, camera axes as KITTI has them.
inline TinyDrive MakeTinyDrive(int scans) {
  TinyDrive drive;
  drive.T_camera_sensor.linear() << 0, -1, 0, 0, 0, -1, 1, 0, 0;
  drive.T_camera_sensor.translation() << 0.01, -0.08, -0.27;
  for (int i = 0; i < scans; ++i) {
    const auto pose = [&](double yaw_per_scan) {
      Pose T = Pose::Identity();
      T.linear() = Eigen::AngleAxisd(yaw_per_scan * i, Eigen::Vector3d::UnitZ()).toRotationMatrix();
      T.translation() << 0.8 * i, 0.05 * i * i, 0.01 * i;
      return T;
    };
    drive.seconds.push_back(0.1 * i);
    drive.T_world_sensor.push_back(pose(0.1));
    drive.T_odom_sensor.push_back(pose(0.11));
  }
  return drive;
}

/// Four points of scan i: the last one is not finite.
inline std::vector<float> TinyScan(int i) {
  return {1.f + i, 2.f, 3.f, 0.25f, -4.f, 5.5f, -1.f, 0.5f, 0.f, 0.f, 10.f, 1.f, std::nanf(""), 0.f, 0.f, 0.f};
}

/// Writes the drive as sequence `name` below the folder's path.
inline void WriteKittiLayout(const TinyDrive& drive, const TemporaryDirectory& directory, const std::string& name) {
  const std::string sequence = "sequences/" + name;
  std::string times, poses, odometry;
  for (std::size_t i = 0; i < drive.seconds.size(); ++i) {
    char text[48];
    std::snprintf(text, sizeof text, "%e\n", drive.seconds[i]);
    times += text;
    poses += MatrixRow(drive.T_camera_sensor * drive.T_world_sensor[i] * drive.T_camera_sensor.inverse()) + "\n";
    odometry += MatrixRow(drive.T_odom_sensor[i]) + "\n";
    const std::vector<float> scan = TinyScan(static_cast<int>(i));
    std::snprintf(text, sizeof text, "/velodyne/%06zu.bin", i);
    directory.Write(sequence + text,
                    std::string(reinterpret_cast<const char*>(scan.data()), scan.size() * sizeof(float)));
  }
  directory.Write(sequence + "/calib.txt",
                  "P0: 1 0 0 0 0 1 0 0 0 0 1 0\nTr: " + MatrixRow(drive.T_camera_sensor) + "\n");
  directory.Write(sequence + "/times.txt", times);
  directory.Write(sequence + "/odometry.txt", odometry);
  directory.Write("poses/" + name + ".txt", poses);
}

/// The message of the exception that `call` throws; empty if it throws none.
template <typename Call>
std::string MessageOf(const Call& call) {
  try {
    call();
  } catch (const std::exception& error) {
    return error.what();
  }
  return "";
}

}  // namespace incremental_segmatch::test
