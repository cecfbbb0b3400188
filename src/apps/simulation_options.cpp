#include "apps/simulation_options.hpp"

namespace incremental_segmatch::apps {

simulator::SimulationOptions SimulationArguments::Resolve() const {
  simulator::SimulationOptions resolved = options;
  resolved.drift.translation_percent = drift_percent;
  resolved.drift.rotation_deg_per_100m = drift_percent * 0.8 / 0.7;
  return resolved;
}

void AddDriveOptions(CLI::App& command, SimulationArguments* arguments) {
  simulator::SimulationOptions& options = arguments->options;
  CLI::Option* route = command
                           .add_option("--route", options.route,
                                       "loops: streets revisited in the same and in the opposite direction;\n"
                                       "opposite: a long street there and back;\n"
                                       "deceptive: blocks of equal houses that invite false closures;\n"
                                       "lap: one closed lap, see --laps;\n"
                                       "office: corridors, rooms and furniture of an office floor, at 1 m/s")
                           ->check(CLI::IsMember(simulator::PresetRouteNames()))
                           ->capture_default_str();
  command
      .add_option("--poses", options.poses_file,
                  "drive along this KITTI pose file (3x4 rows, camera frame); only its shape in the plane is used")
      ->check(CLI::ExistingFile)
      ->excludes(route);
  command.add_option("--laps", options.laps, "laps of the route lap")
      ->check(CLI::PositiveNumber)
      ->capture_default_str();
  command.add_option("--seed", options.seed, "of the town, the noise and the drift")->capture_default_str();
  command.add_option("--day", options.day, "another day in the same town: other parked cars, traffic, noise, drift")
      ->capture_default_str();
  command.add_option("--first-frame", options.first_frame, "skip this many frames of the route")
      ->check(CLI::NonNegativeNumber)
      ->capture_default_str();
  command.add_option("--max-scans", options.max_scans, "stop after this many scans (0: the whole route)")
      ->check(CLI::NonNegativeNumber)
      ->capture_default_str();
}

void AddSensorOptions(CLI::App& command, SimulationArguments* arguments) {
  simulator::SimulationOptions& options = arguments->options;
  command.add_option("--sensor", options.sensor, "LiDAR")
      ->check(CLI::IsMember(simulator::SensorNames()))
      ->capture_default_str();
  command.add_option("--sensor-height", options.sensor_height_m, "of the LiDAR over the ground (m)")
      ->check(CLI::PositiveNumber)
      ->capture_default_str();
  command.add_option("--stride", options.stride, "keep every n-th frame")
      ->check(CLI::PositiveNumber)
      ->capture_default_str();
  command.add_option("--scan-rate", options.frame_rate_hz, "frames a second, before --stride (Hz)")
      ->check(CLI::PositiveNumber)
      ->capture_default_str();
  command.add_option("--speed", options.speed_m_s, "of preset routes, on straights (m/s)")
      ->check(CLI::PositiveNumber)
      ->capture_default_str();
  command
      .add_option("--drift", arguments->drift_percent,
                  "of the odometry, per cent of the path over 100 m; yaw drifts along (0: none)")
      ->check(CLI::NonNegativeNumber)
      ->capture_default_str();
  command.add_option("--noise", options.range_noise_m, "standard deviation of the range (m)")
      ->check(CLI::NonNegativeNumber)
      ->capture_default_str();
  command.add_option("--grade", options.town.grade, "steepest slope of the ground (0.04: four per cent)")
      ->check(CLI::Range(0.0, 0.2))
      ->capture_default_str();
}

std::string RouteName(const simulator::SimulationOptions& options) {
  return options.poses_file.empty() ? "route " + options.route : options.poses_file;
}

}  // namespace incremental_segmatch::apps
