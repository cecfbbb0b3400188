#include "apps/simulate.hpp"

#include <cstdio>
#include <memory>
#include <string>

#include "apps/progress_bar.hpp"
#include "apps/simulation_options.hpp"
#include "simulator/kitti_writer.hpp"

namespace incremental_segmatch::apps {
namespace {

struct SimulateArguments {
  SimulationArguments simulation;
  std::string out;
  std::string sequence = "00";
};

void Simulate(const SimulateArguments& arguments) {
  simulator::Simulation simulation(arguments.simulation.Resolve());
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
  AddDriveOptions(*command, &arguments->simulation);
  AddSensorOptions(*command, &arguments->simulation);
  command->callback([arguments] { Simulate(*arguments); });
}

}  // namespace incremental_segmatch::apps
