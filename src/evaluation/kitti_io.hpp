/// \file
/// KITTI odometry layout: ROOT/sequences/SS/{velodyne/NNNNNN.bin, calib.txt, times.txt, odometry.txt} and
/// ROOT/poses/SS.txt. All functions throw std::runtime_error naming the file, and what to do about it.
#pragma once

#include <memory>
#include <string>
#include <vector>

#include "drive_source.hpp"
#include "evaluation/scoring.hpp"
#include "incremental_segmatch/types.hpp"

namespace incremental_segmatch {

/// Points of a .bin file (float32 x, y, z, intensity, little endian, sensor frame) and their intensities.
struct KittiScan {
  Points points_sensor;
  std::vector<float> intensities;
};

/// Reads a .bin file.
KittiScan ReadKittiBin(const std::string& path);

/// Reads times.txt: seconds, one a row, increasing.
std::vector<StampNs> ReadKittiTimes(const std::string& path);

/// Reads rows of 3x4 matrices (row-major) as poses, rotations normalised. Refuses rows that are no rigid transform.
std::vector<Pose> ReadKittiPoses(const std::string& path);

/// Reads T_camera_sensor, the row `Tr` of calib.txt.
Pose ReadKittiCalibration(const std::string& path);

/// Poses of the LiDAR from those of camera 0: T_0_i = Tr^-1 P_i Tr, where frame 0 is the LiDAR whose camera is at the
/// poses' origin.
std::vector<Pose> SensorPosesFromCameraPoses(const std::vector<Pose>& camera_poses, const Pose& T_camera_sensor);

/// The truth of a sequence: stamps of times.txt, poses of the LiDAR. The scans are not needed. One pose for each stamp.
TrueTrajectory ReadKittiTruth(const std::string& root, const std::string& sequence);

/// Which files to read.
struct KittiDriveOptions {
  std::string root;      ///< folder that holds sequences/ and poses/
  std::string sequence;  ///< name of the sequence, 00 say
  std::string
      odometry_file;  ///< 3x4 rows in the LiDAR's frame; also looked for in the sequence's folder; empty: the poses
};

/// A drive in KITTI's layout. Without odometry file its poses serve as odometry, free of drift.
class KittiDrive : public DriveSource {
 public:
  /// Reads everything but the scans.
  explicit KittiDrive(const KittiDriveOptions& options);

  std::string name() const override { return folder_; }
  std::size_t size() const override { return stamps_ns_.size(); }
  StampNs stamp_ns(std::size_t i) const override { return stamps_ns_.at(i); }
  Pose T_odom_sensor(std::size_t i) const override { return T_odom_sensor_.at(i); }
  std::optional<Pose> T_world_sensor(std::size_t i) const override;
  Points ReadPoints(std::size_t i) override { return ReadScan(i).points_sensor; }
  std::vector<std::string> notes() const override { return notes_; }
  bool odometry_is_truth() const override { return odometry_is_truth_; }

  /// Points and intensities of scan i.
  KittiScan ReadScan(std::size_t i) const;

 private:
  std::string folder_;
  std::vector<StampNs> stamps_ns_;
  std::vector<Pose> T_odom_sensor_;
  std::vector<Pose> T_world_sensor_;  // empty without ground truth
  std::vector<std::string> notes_;
  bool odometry_is_truth_ = false;
};

/// True if the sequence's folder holds an odometry.txt.
bool HasKittiOdometry(const std::string& root, const std::string& sequence);

}  // namespace incremental_segmatch
