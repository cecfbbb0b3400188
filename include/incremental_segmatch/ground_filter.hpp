/// \file
/// Scan in the sensor's frame to obstacle points (METHOD 6: the original's height cut; and an elevation model for slopes).
#pragma once

#include <cstdint>
#include <vector>

#include "incremental_segmatch/types.hpp"

namespace incremental_segmatch {

enum class GroundModel {
  kNone,             ///< every point is kept
  kHeightThreshold,  ///< what lies below a height in the sensor's frame goes (KITTI: -1.0 m)
  kElevation         ///< what lies less than a clearance above a ground surface that is estimated from the scan goes
};

struct GroundFilterParameters {
  GroundModel model = GroundModel::kHeightThreshold;
  double min_height_m = -1.0;          ///< kHeightThreshold: in the sensor's frame
  double sensor_height_m = 1.73;       ///< kElevation: of the sensor over the ground below it
  double clearance_m = 0.3;            ///< kElevation: points lower than this above the ground go
  double cell_size_m = 1.0;            ///< kElevation: side of a cell of the elevation map
  double max_slope = 0.15;             ///< kElevation: rise over run that still is ground
  double min_range_m = 1.5;            ///< nearer points go: the robot itself
  double max_range_m = 50.0;           ///< points farther away horizontally go
  double max_height_m = 1000.0;        ///< points higher above the sensor go
};

/// Obstacle points of a scan. `kept` indexes the scan's points, ascending.
struct GroundFilterResult {
  Points obstacles_sensor;
  std::size_t dropped_nonfinite = 0;
  std::size_t dropped_range = 0;
  std::size_t dropped_ground = 0;
};

/// Removes ground, far and invalid points from single scans. O(points). Not thread-safe (keeps work space).
class GroundFilter {
 public:
  /// Throws std::invalid_argument naming the parameter that is out of range.
  explicit GroundFilter(const GroundFilterParameters& parameters);

  /// \param T_gravity_sensor  only its rotation is used, by kElevation: heights are measured along gravity (odom's z).
  GroundFilterResult Filter(const Points& points_sensor, const Pose& T_gravity_sensor);

 private:
  GroundFilterResult FilterByHeight(const Points& points_sensor) const;
  GroundFilterResult FilterByElevation(const Points& points_sensor, const Pose& T_gravity_sensor);
  void EstimateGround();

  GroundFilterParameters parameters_;
  int half_cells_ = 0;                  ///< the elevation map spans -half_cells_ .. half_cells_ - 1 in both axes
  std::vector<float> lowest_;           ///< lowest height seen in each cell of the elevation map
  std::vector<float> ground_;           ///< estimated height of the ground in each cell
  std::vector<std::uint32_t> outward_;  ///< cells by their distance from the sensor
  std::vector<std::uint32_t> inner_;    ///< for each cell, its neighbour towards the sensor
};

}  // namespace incremental_segmatch
