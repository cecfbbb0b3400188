/// \file
/// A LiDAR odometry that drifts, made from the true poses.
#pragma once

#include <cstdint>
#include <vector>

#include "incremental_segmatch/types.hpp"

namespace incremental_segmatch::simulator {

/// Size of the drift: mean error of the relative pose over 100 m of driving (or half the path, if that is shorter).
struct DriftParameters {
  double translation_percent = 0.7;  ///< of the driven path; 0: the odometry is the truth
  double rotation_deg_per_100m = 0.8;
};

/// Mean relative error over stretches of driving, as KITTI's benchmark defines it.
struct DriftMeasure {
  double translation_percent = 0.0;
  double rotation_deg_per_100m = 0.0;
};

/// Mean relative pose error of `estimate` against `truth` over stretches of stretch_m (all start frames).
DriftMeasure MeasureDrift(const std::vector<Pose>& truth, const std::vector<Pose>& estimate, double stretch_m);

/// Odometry poses T_odom_sensor; the first is the identity's tilt-preserving twin of the truth: T_odom_sensor(0) keeps
/// the true roll, pitch and height, and has x = y = yaw = 0. Errors are correlated over about a hundred metres and are
/// scaled so that their mean is what the parameters ask for.
std::vector<Pose> MakeDriftingOdometry(const std::vector<Pose>& T_world_sensor, std::uint64_t seed,
                                       const DriftParameters& parameters);

}  // namespace incremental_segmatch::simulator
