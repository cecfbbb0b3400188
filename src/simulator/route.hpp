/// \file
/// Where the simulated vehicle drives: plane poses over time.
#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <string>
#include <vector>

#include "incremental_segmatch/types.hpp"

namespace incremental_segmatch::simulator {

/// The vehicle at one frame, in the town's plane (x east, y north, yaw counter-clockwise from x).
struct RouteFrame {
  StampNs stamp_ns = 0;
  Eigen::Vector2d position_m = Eigen::Vector2d::Zero();
  double yaw_rad = 0.0;
};

using Route = std::vector<RouteFrame>;

/// How a preset route is driven.
struct RouteParameters {
  double frame_rate_hz = 10.0;
  double speed_m_s = 7.0;  ///< on straights; corners are taken more slowly, and an office at 1 m/s at most
  int laps = 2;            ///< of the preset "lap"
};

/// Names of the preset routes: loops, opposite, deceptive, lap, office.
std::vector<std::string> PresetRouteNames();

/// A preset route; throws std::invalid_argument for an unknown name or a non-positive rate or speed.
Route MakePresetRoute(const std::string& name, const RouteParameters& parameters);

/// The route along a KITTI pose file (rows of 3x4 camera poses, x right, y down, z forward), one frame a row at
/// frame_rate_hz. Heights and tilts of the file are not used. Throws std::runtime_error naming the file.
Route RouteFromKittiPoses(const std::string& file, double frame_rate_hz);

}  // namespace incremental_segmatch::simulator
