/// \file
/// Vocabulary shared by all stages.
#pragma once

#include <Eigen/Core>
#include <Eigen/Geometry>
#include <cstdint>
#include <string>
#include <tuple>
#include <vector>

namespace incremental_segmatch {

using StampNs = std::int64_t;                 ///< time in nanoseconds, on the clock of the input
using Pose = Eigen::Isometry3d;               ///< T_a_b maps coordinates in frame b to frame a: p_a = T_a_b * p_b
using Points = std::vector<Eigen::Vector3f>;  ///< points in metres, in a frame that the name of the variable says
using VoxelHandle = std::uint32_t;            ///< names a voxel of a DynamicVoxelGrid for that voxel's life
using SegmentId = std::uint32_t;              ///< unique per robot, never reused; 0 is no segment
using RobotIndex = std::uint32_t;             ///< index of a robot in the order in which a back end met them

inline constexpr SegmentId kNoSegment = 0;  ///< no segment

/// A segment's name everywhere: robot and segment ID.
struct SegmentKey {
  RobotIndex robot = 0;       ///< index of the robot
  SegmentId id = kNoSegment;  ///< of the segment, with that robot

  friend bool operator==(const SegmentKey& a, const SegmentKey& b) { return a.robot == b.robot && a.id == b.id; }
  friend bool operator!=(const SegmentKey& a, const SegmentKey& b) { return !(a == b); }
  friend bool operator<(const SegmentKey& a, const SegmentKey& b) {
    return std::tie(a.robot, a.id) < std::tie(b.robot, b.id);
  }
};

/// For unordered containers.
struct SegmentKeyHash {
  /// Hash of both parts.
  std::size_t operator()(const SegmentKey& key) const {
    return std::hash<std::uint64_t>()((std::uint64_t{key.robot} << 32) | key.id);
  }
};

/// A pose with its time.
struct StampedPose {
  StampNs stamp_ns = 0;                    ///< time of the pose or sweep
  Pose T_frame_sensor = Pose::Identity();  ///< pose of the sensor in a frame that the owner names
};

/// One LiDAR sweep in the sensor's frame (metres, float) and where the sensor was.
struct Scan {
  StampNs stamp_ns = 0;                   ///< time of the pose or sweep
  Points points_sensor;                   ///< may contain NaN: such points are dropped and counted
  Pose T_odom_sensor = Pose::Identity();  ///< the sensor's pose in odom at the stamp
};

/// 6x6 covariance in ROS's order: x, y, z, rotation about x, y, z.
using Covariance6 = Eigen::Matrix<double, 6, 6>;

}  // namespace incremental_segmatch
