#include "drive.hpp"

#include "incremental_segmatch/ground_filter.hpp"
#include "simulator/simulation.hpp"

namespace incremental_segmatch::bench {
namespace {

constexpr std::size_t kScans = 900;
constexpr double kRangeM = 50.0;

const std::vector<DriveScan>& Drive() {
  static const std::vector<DriveScan> drive = [] {
    simulator::SimulationOptions options;
    options.route = "loops";
    options.sensor = "HDL-64E";
    options.max_scans = kScans;
    simulator::Simulation simulation(options);
    GroundFilterParameters ground;  // the preset for KITTI: points lower than 1 m below the sensor go
    ground.max_range_m = kRangeM;
    GroundFilter filter(ground);
    std::vector<DriveScan> scans;
    for (std::size_t i = 0; i < simulation.size(); ++i) {
      const Pose& T_odom_sensor = simulation.T_odom_sensor(i);
      scans.push_back({filter.Filter(simulation.Scan(i), T_odom_sensor).obstacles_sensor, T_odom_sensor});
    }
    return scans;
  }();
  return drive;
}

}  // namespace

const std::vector<DriveSetup>& Setups() {
  static const std::vector<DriveSetup> setups{
      {"1e4", 12.0, 12.0, 50, 100, 5},
      {"2e5", 50.0, 50.0, 150, 100, 10},
      {"1e6", 50.0, 1000.0, kScans - 100, 100, 20}};
  return setups;
}

DriveSetup GrowingSetup() {
  DriveSetup setup = Setups().back();
  setup.name += "_growing";
  setup.grows = true;
  return setup;
}

std::vector<DriveScan> Scans(const DriveSetup& setup) {
  const std::vector<DriveScan>& drive = Drive();
  std::vector<DriveScan> scans(drive.end() - static_cast<std::ptrdiff_t>(setup.warm_up_scans + setup.measured_scans), drive.end());
  if (setup.scan_radius_m < kRangeM) {
    const float radius = static_cast<float>(setup.scan_radius_m);
    for (DriveScan& scan : scans) {
      Points& points = scan.obstacles_sensor;
      const auto far = [&](const Eigen::Vector3f& p) { return p.head<2>().norm() > radius; };
      points.erase(std::remove_if(points.begin(), points.end(), far), points.end());
    }
  }
  return scans;
}

}  // namespace incremental_segmatch::bench
