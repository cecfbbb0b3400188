/// \file
/// A drive to evaluate: scans with odometry, and the truth where there is one.
#pragma once

#include <cstddef>
#include <optional>
#include <string>
#include <vector>

#include "incremental_segmatch/types.hpp"

namespace incremental_segmatch {

/// Where scans come from: files in KITTI's layout, a bag, or a simulation. Poses are those of the LiDAR itself. Scans
/// are read one at a time, so that a drive need not fit into memory. Not thread-safe.
class DriveSource {
 public:
  virtual ~DriveSource() = default;

  /// What it is, for the summary: a path, say.
  virtual std::string name() const = 0;

  /// Number of scans.
  virtual std::size_t size() const = 0;

  /// Time of scan i < size(), on the clock of the input; increases with i.
  virtual StampNs stamp_ns(std::size_t i) const = 0;

  /// Odometry at scan i: drifts, but never jumps.
  virtual Pose T_odom_sensor(std::size_t i) const = 0;

  /// True pose at scan i, or nothing if the input has no ground truth. For scoring only.
  virtual std::optional<Pose> T_world_sensor(std::size_t i) const = 0;

  /// Points of scan i in the sensor's frame. Throws std::runtime_error naming the file if it can't be read.
  virtual Points ReadPoints(std::size_t i) = 0;

  /// Remarks that belong into the summary: what the odometry is, what was left out.
  virtual std::vector<std::string> notes() const { return {}; }

  /// True if the odometry is the ground truth and so does not drift.
  virtual bool odometry_is_truth() const { return false; }
};

}  // namespace incremental_segmatch
