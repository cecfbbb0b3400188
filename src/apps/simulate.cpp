#include "apps/simulate.hpp"

#include <cstdio>
#include <memory>
#include <string>

#include "apps/progress_bar.hpp"
#include "simulator/kitti_writer.hpp"
#include "simulator/simulation.hpp"

namespace incremental_segmatch::apps {
namespace {

struct SimulateArguments {
  simulator::SimulationOptions options;
  double drift_percent = 0.7;
  std::string out;
  std::string sequence = "00";
};

void Simulate(SimulateArguments arguments) {
  simulator::SimulationOptions& options = arguments.options;
  options.drift.translation_percent = arguments.drift_percent;
  options.drift.rotation_deg_per_100m = arguments.drift_percent * 0.8 / 0.7;
  simulator::Simulation simulation(options);
  {
    ProgressBar progress("Simulating", simulation.size());
    simulator::WriteKitti(simulation, arguments.out, arguments.sequence,
                          [&progress](std::size_t done) { progress.Update(done); });
  }
  std::printf("%zu scans in %s/sequences/%s, truth in %s/poses/%s.txt\n", simulation.size(), arguments.out.c_str(),
              arguments.sequence.c_str(), arguments.out.c_str(), arguments.sequence.c_str());
}

}  // namespace

void AddSimulateCommand(CLI::App& app) {
  const auto arguments = std::make_shared<SimulateArguments>();
  simulator::SimulationOptions& options = arguments->options;
  CLI::App* command = app.add_subcommand(
      "simulate",
      "Drive a simulated LiDAR through a town made up on the fly and write the drive in KITTI's odometry layout:\n"
      "ROOT/sequences/SS/{velodyne/NNNNNN.bin,calib.txt,times.txt,odometry.txt} and ROOT/poses/SS.txt.\n"
      "The poses are the truth; odometry.txt drifts as a LiDAR odometry does. The same options give the same bytes.\n\n"
      "  segmatch simulate --out data                        about 1.6 km with loops, HDL-64E\n"
      "  segmatch simulate --out data --poses kitti/05.txt   along the shape of a real drive\n"
      "  segmatch simulate --out data --day 1 --sequence 01  the same streets on another day\n");
  command->add_option("--out", arguments->out, "folder to write into (ROOT)")->required();
  command->add_option("--sequence", arguments->sequence, "name of the sequence (SS)")->capture_default_str();
  auto* route = command
                    ->add_option("--route", options.route,
                                 "loops: streets revisited in the same and in the opposite direction;\n"
                                 "opposite: a long street there and back;\n"
                                 "deceptive: blocks of equal houses that invite false closures;\n"
                                 "lap: one closed lap, see --laps")
                    ->check(CLI::IsMember(simulator::PresetRouteNames()))
                    ->capture_default_str();
  command
      ->add_option("--poses", options.poses_file,
                   "drive along this KITTI pose file (3x4 rows, camera frame); only its shape in the plane is used")
      ->check(CLI::ExistingFile)
      ->excludes(route);
  command->add_option("--laps", options.laps, "laps of the route lap")
      ->check(CLI::PositiveNumber)
      ->capture_default_str();
  command->add_option("--sensor", options.sensor, "LiDAR")
      ->check(CLI::IsMember(simulator::SensorNames()))
      ->capture_default_str();
  command->add_option("--seed", options.seed, "of the town, the noise and the drift")->capture_default_str();
  command->add_option("--day", options.day, "another day in the same town: other parked cars, traffic, noise, drift")
      ->capture_default_str();
  command->add_option("--stride", options.stride, "keep every n-th frame")
      ->check(CLI::PositiveNumber)
      ->capture_default_str();
  command->add_option("--first-frame", options.first_frame, "skip this many frames of the route")
      ->check(CLI::NonNegativeNumber)
      ->capture_default_str();
  command->add_option("--max-scans", options.max_scans, "stop after this many scans (0: the whole route)")
      ->check(CLI::NonNegativeNumber)
      ->capture_default_str();
  command->add_option("--scan-rate", options.frame_rate_hz, "frames a second, before --stride (Hz)")
      ->check(CLI::PositiveNumber)
      ->capture_default_str();
  command->add_option("--speed", options.speed_m_s, "of preset routes, on straights (m/s)")
      ->check(CLI::PositiveNumber)
      ->capture_default_str();
  command
      ->add_option("--drift", arguments->drift_percent,
                   "of the odometry, per cent of the path over 100 m; yaw drifts along (0: none)")
      ->check(CLI::NonNegativeNumber)
      ->capture_default_str();
  command->add_option("--noise", options.range_noise_m, "standard deviation of the range (m)")
      ->check(CLI::NonNegativeNumber)
      ->capture_default_str();
  command->add_option("--grade", options.town.grade, "steepest slope of the ground (0.04: four per cent)")
      ->check(CLI::Range(0.0, 0.2))
      ->capture_default_str();
  command->callback([arguments] { Simulate(*arguments); });
}

}  // namespace incremental_segmatch::apps
