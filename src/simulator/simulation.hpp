/// \file
/// A simulated drive: truth, drifting odometry and scans, on the fly.
#pragma once

#include <memory>
#include <string>
#include <vector>

#include "incremental_segmatch/types.hpp"
#include "simulator/drift.hpp"
#include "simulator/route.hpp"
#include "simulator/sensor_model.hpp"
#include "simulator/town.hpp"

namespace incremental_segmatch::simulator {

struct SimulationOptions {
  std::string route = "loops";     ///< a preset (PresetRouteNames); not used with a pose file
  std::string poses_file;          ///< KITTI pose file to drive along; empty: the preset
  std::string sensor = "HDL-64E";  ///< see SensorNames
  std::uint64_t seed = 1;          ///< of the town, the noise and the drift
  std::uint64_t day = 0;           ///< another day in the same town: other parked cars, traffic, noise and drift
  std::size_t stride = 1;          ///< every how many frames a scan is taken
  std::size_t first_frame = 0;     ///< frames of the route before the first scan
  std::size_t max_scans = 0;       ///< 0: the whole route
  double frame_rate_hz = 10.0;     ///< turns of the sensor, also frames of a pose file
  double speed_m_s = 7.0;          ///< of preset routes, on straights
  int laps = 2;                    ///< of the preset "lap"
  double sensor_height_m = 1.73;   ///< over the ground
  DriftParameters drift;
  double range_noise_m = 0.02;
  double dropout = 0.02;  ///< share of beams lost even in the best case
  TownParameters town;    ///< seed, day and world are set from the options above
};

/// Points with their intensities (0..1), ring by ring from the top, counter-clockwise from the x axis in each ring.
struct SimulatedScan {
  Points points_sensor;
  std::vector<float> intensities;
};

/// Everything but the scans is computed by the constructor. Scans are deterministic in options and index, and may be
/// asked for in any order; in order of the route is fastest. Not thread-safe.
class Simulation {
 public:
  /// Throws std::invalid_argument for bad options, std::runtime_error for an unreadable pose file.
  explicit Simulation(const SimulationOptions& options);
  ~Simulation();
  Simulation(Simulation&&) noexcept;
  Simulation& operator=(Simulation&&) noexcept;

  std::size_t size() const;  ///< number of scans
  StampNs stamp_ns(std::size_t i) const;
  const Pose& T_world_sensor(std::size_t i) const;  ///< truth, in the town's gravity-aligned frame
  /// Where the route begins, without the sway of a day: the origin of the poses that are written, so that the drives of
  /// all days are in one frame.
  const Pose& T_world_start() const;
  const Pose& T_odom_sensor(std::size_t i) const;  ///< odometry that drifts, in a gravity-aligned frame of its own

  Points Scan(std::size_t i);  ///< in the sensor's frame
  SimulatedScan ScanWithIntensities(std::size_t i);

  const Town& town() const;

 private:
  class Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace incremental_segmatch::simulator
