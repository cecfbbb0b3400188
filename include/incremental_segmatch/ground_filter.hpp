/// \file
/// Scan in the sensor's frame to obstacle points (METHOD 6: the original's height cut; and an elevation model for
/// slopes).
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "incremental_segmatch/types.hpp"

namespace incremental_segmatch {

/// How ground is told from obstacles.
enum class GroundModel {
  kNone,             ///< no ground is removed; only what is out of range goes
  kHeightThreshold,  ///< what lies below a height in the sensor's frame goes (KITTI: -1.0 m)
  kElevation         ///< what lies less than a clearance above a ground surface that is estimated from the scan goes
};

/// Which points are obstacles.
struct GroundFilterParameters {
  GroundModel model = GroundModel::kHeightThreshold;  ///< how ground is told
  double min_height_m = -1.0;                         ///< kHeightThreshold: in the sensor's frame
  double sensor_height_m = 1.73;                      ///< kElevation: of the sensor over the ground below it
  double clearance_m = 0.3;                           ///< kElevation: points lower than this above the ground go
  double cell_size_m = 1.0;                           ///< kElevation: side of a cell of the elevation map
  double max_slope = 0.15;                            ///< kElevation: rise over run that still is ground
  double min_range_m = 1.5;                           ///< points nearer than this horizontally go: the robot itself
  double max_range_m = 50.0;                          ///< points farther away horizontally go
  double max_height_m = 1000.0;                       ///< points higher above the sensor go
};

/// Obstacle points of a scan, in the scan's order, and what became of the others: each point is counted once.
struct GroundFilterResult {
  Points obstacles_sensor;            ///< what is left, in the scan's order
  std::size_t dropped_nonfinite = 0;  ///< points with NaN or infinity
  std::size_t dropped_range = 0;      ///< points too near, too far or too high
  std::size_t dropped_ground = 0;     ///< points of the ground
};

/// Removes ground, far and invalid points from single scans. O(points), plus O(cells) for kElevation. Not thread-safe
/// (keeps work space).
///
/// kElevation keeps the lowest height of each cell of a gravity-aligned map around the sensor and follows the ground
/// outwards from below the sensor: a cell's lowest height is ground if the slope limit allows it, seen from the ground
/// last observed inwards; a cell without points, or one whose lowest point is too high (an obstacle) or too deep (an
/// echo), takes over that ground.
class GroundFilter {
 public:
  /// Throws std::invalid_argument naming the parameter that is out of range.
  explicit GroundFilter(const GroundFilterParameters& parameters);

  /// \param T_gravity_sensor  only its rotation is used, by kElevation: heights and ranges are measured along and
  /// across gravity
  ///                          (odom's z) then, and in the sensor's frame otherwise.
  /// Throws std::invalid_argument if kElevation gets a rotation that is not finite.
  GroundFilterResult Filter(const Points& points_sensor, const Pose& T_gravity_sensor);

 private:
  struct Cell {
    std::uint32_t index;
    std::array<std::uint32_t, 3>
        inner;  ///< its neighbours towards the sensor, the diagonal one first; itself if it touches it
  };

  GroundFilterResult FilterByHeight(const Points& points_sensor) const;
  GroundFilterResult FilterByElevation(const Points& points_sensor, const Eigen::Matrix3f& R_gravity_sensor);
  void PrepareElevation();
  void EstimateGround();

  GroundFilterParameters parameters_;
  int half_cells_ = 0;               ///< the elevation map spans -half_cells_ .. half_cells_ - 1 in both axes
  std::vector<Cell> outward_;        ///< cells by their distance from the sensor
  std::vector<float> lowest_;        ///< lowest height seen in each cell
  std::vector<float> ground_;        ///< estimated height of the ground in each cell
  std::vector<float> unseen_;        ///< distance in metres since ground was last observed on the way to each cell
  std::vector<float> heights_;       ///< of the scan's points
  std::vector<std::int32_t> cells_;  ///< of the scan's points; negative: dropped already
};

}  // namespace incremental_segmatch
