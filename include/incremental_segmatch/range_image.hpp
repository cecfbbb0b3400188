/// \file
/// What a scan sees in every direction, to tell places apart by what it sees through (METHOD 5, beyond).
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "incremental_segmatch/types.hpp"

namespace incremental_segmatch {

/// What of another visit's points a scan confirms and what it denies.
struct FreeSpaceCounts {
  std::size_t confirmed = 0;     ///< points with a return where they are
  std::size_t seen_through = 0;  ///< points with nothing but farther returns around them: they are not there

  /// Share of what could be judged that is denied; 0 where nothing could.
  double Contradiction() const {
    const std::size_t judged = confirmed + seen_through;
    return judged == 0 ? 0.0 : static_cast<double>(seen_through) / static_cast<double>(judged);
  }
  /// Adds the counts of another comparison.
  FreeSpaceCounts& operator+=(const FreeSpaceCounts& other) {
    confirmed += other.confirmed;
    seen_through += other.seen_through;
    return *this;
  }
};

/// Which points are compared, and how exactly.
struct FreeSpaceParameters {
  double min_height_m = 0.5;  ///< lower points are left out, in their sensor's frame: cars come and go
  double max_range_m = 35.0;  ///< nor are those farther from the image's sensor
  double tolerance_m = 0.5;   ///< a return so near to a point confirms it; one farther by twice as much sees through
};

/// What an image says of a point.
enum class Sight {
  kUnknown,     ///< hidden, beside the returns, or with returns both nearer and farther around it
  kConfirmed,   ///< there is a return where it is
  kSeenThrough  ///< there is nothing but farther returns around it: it is not there
};

/// Nearest and farthest return in each cell of a panorama of 2 degrees by 1.5 degrees. Immutable.
class RangeImage {
 public:
  /// Points in the sensor's frame (m). O(points).
  explicit RangeImage(const Points& scan_sensor);

  /// Looks where a point is, in the image's sensor frame (m): a return within the tolerance confirms it, returns farther
  /// by twice as much, all around, see through it. O(1).
  Sight Look(const Eigen::Vector3f& point_sensor, float tolerance_m) const;

  /// Holds another scan's points against the image. `slack_m` is added to the tolerance: what odometry may have drifted
  /// in between. Points beside the image's returns, or hidden behind them, count for nothing. O(points).
  FreeSpaceCounts Compare(const Points& points, const Pose& T_image_points, double slack_m,
                          const FreeSpaceParameters& parameters) const;

  /// Memory held. O(1).
  std::size_t memory_bytes() const { return sizeof(*this) + cells_.capacity() * sizeof(Cell); }

 private:
  struct Cell {
    float nearest = 0.f;
    float farthest = 0.f;  // 0: no return
  };
  // Of points in the sensor's frame: the cell that each lies in, 0 for none, and its range.
  struct Located {
    std::vector<std::int32_t> cells;
    std::vector<float> ranges;
  };
  static Located LocateAll(const Points& points_sensor);
  Sight LookAround(std::int32_t cell, float range, float tolerance_m) const;

  std::vector<Cell> cells_;  // row by row from below, with those at the seam twice and an empty row at either end
};

/// Throws std::invalid_argument naming the parameter that is out of range.
void Validate(const FreeSpaceParameters& parameters);

}  // namespace incremental_segmatch
