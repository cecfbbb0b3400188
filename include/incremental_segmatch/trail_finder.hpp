/// \file
/// Which segments are trails of moving objects: their space was seen through later (METHOD 4, beyond).
#pragma once

#include <cstddef>
#include <unordered_map>
#include <vector>

#include "incremental_segmatch/dynamic_voxel_grid.hpp"
#include "incremental_segmatch/incremental_segmenter.hpp"
#include "incremental_segmatch/range_image.hpp"
#include "incremental_segmatch/types.hpp"

namespace incremental_segmatch {

/// When a segment is a trail.
struct TrailParameters {
  bool enabled = true;          ///< look for trails at all
  double interval_s = 1.0;      ///< between looks; a voxel is looked at once, so long after it came, or up to twice
  double min_range_m = 5.0;     ///< nearer voxels wait: a thinned scan has gaps there
  double tolerance_m = 0.5;     ///< a return so near confirms a voxel; one farther by twice as much sees through it
  std::size_t min_voxels = 8;   ///< a segment is judged by at least so many of its voxels
  double min_share = 0.5;       ///< of the judged voxels seen through, from which on a segment is a trail
};

/// Looks at voxels again some time after they came. Of something that stood there, something still stands there, or it
/// is hidden; where a car was that drove on, the ground or the wall behind it is seen. One voxel of eight is looked at,
/// once, so that the cost follows what is new. A car that stood for long and then drove off stays: its voxels were looked
/// at while it was there. Not thread-safe.
class TrailFinder {
 public:
  /// Throws std::invalid_argument naming the parameter that is out of range.
  explicit TrailFinder(const TrailParameters& parameters);

  /// If the interval has passed since the last look: the segments that a scan shows to be trails, ascending. `scan_sensor`
  /// in the sensor's frame (m), thinned or not. Grid and segmenter must be in step with each other. O(voxels of an
  /// interval + scan) once an interval.
  std::vector<SegmentId> Look(StampNs stamp_ns, const Points& scan_sensor, const Pose& T_odom_sensor,
                              const DynamicVoxelGrid& grid, const Segmenter& segmenter);

  /// New voxels, to be looked at later. O(activated).
  void Add(const std::vector<VoxelHandle>& activated, const DynamicVoxelGrid& grid);

  /// Merged and ended segments: what is known of them goes along, or is forgotten.
  void Follow(const SegmentUpdate& update);

  /// Memory held, about. O(1).
  std::size_t memory_bytes() const;

 private:
  struct Sample {
    VoxelHandle voxel = 0;
    Eigen::Vector3d centroid_grid = Eigen::Vector3d::Zero();  // tells a handle that was given to another voxel
  };

  TrailParameters parameters_;
  StampNs last_look_ns_ = 0;
  std::size_t skipped_ = 0;      // voxels since the last sample
  std::vector<Sample> recent_;   // since the last look
  std::vector<Sample> waiting_;  // from between the last two
  std::unordered_map<SegmentId, FreeSpaceCounts> judged_;
};

/// Throws std::invalid_argument naming the parameter that is out of range.
void Validate(const TrailParameters& parameters);

}  // namespace incremental_segmatch
