/// \file
/// A scan with few, evenly spread points: what key frames hold and recognitions are refined on (METHOD 5, beyond).
#pragma once

#include <cstddef>

#include "incremental_segmatch/types.hpp"

namespace incremental_segmatch {

/// Which points of a scan stay.
struct ScanThinningParameters {
  double cell_size_m = 0.3;        ///< one point of each cubic cell of this side
  double min_range_m = 2.5;        ///< points nearer than this horizontally go: the robot itself
  double max_range_m = 40.0;       ///< farther ones go
  std::size_t max_points = 30000;  ///< points of the scan that are looked at, evenly over its order
};

/// Points of a scan, ground included: it holds height, roll and pitch. At most one a cell, the first in the scan's
/// order. Both in the sensor's frame (m); points that are not finite are left out. O(max_points).
Points ThinScan(const Points& points_sensor, const ScanThinningParameters& parameters);

/// Throws std::invalid_argument naming the parameter that is out of range.
void Validate(const ScanThinningParameters& parameters);

}  // namespace incremental_segmatch
