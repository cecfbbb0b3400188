#include "apps/evaluate.hpp"

#include <cstdio>
#include <filesystem>
#include <map>
#include <memory>
#include <string>

#include "apps/no_bags.hpp"
#include "apps/progress_bar.hpp"
#include "apps/simulated_drive.hpp"
#include "evaluation/bag_options.hpp"
#include "evaluation/evaluation.hpp"
#include "evaluation/kidnapped_drive.hpp"
#include "evaluation/kitti_io.hpp"
#include "evaluation/recorded_run.hpp"
#ifdef SEGMATCH_WITH_ROSBAG
#include "evaluation/bag.hpp"
#endif

namespace incremental_segmatch::apps {
namespace {

struct EvaluateArguments {
  KittiDriveOptions kitti;
  BagDriveOptions bag;
  bool simulate = false;
  SimulationArguments simulation;
  std::string config;
  std::string out;
  std::string mode;
  KittiDriveOptions map_drive;
  unsigned kidnap_seed = 0;
  bool no_optimization = false;
  EvaluationParameters parameters;
};

#ifdef SEGMATCH_WITH_ROSBAG
std::unique_ptr<DriveSource> OpenBagDrive(const BagDriveOptions& options) {
  return OpenBag(options);
}
#else
std::unique_ptr<DriveSource> OpenBagDrive(const BagDriveOptions&) {
  ThrowNoBags("--bag");
}
#endif

std::unique_ptr<DriveSource> OpenDrive(const EvaluateArguments& arguments) {
  if (arguments.simulate) return std::make_unique<SimulatedDrive>(arguments.simulation.Resolve());
  if (!arguments.bag.path.empty()) return OpenBagDrive(arguments.bag);
  return std::make_unique<KittiDrive>(arguments.kitti);
}

// The truth of the map's drive: as given, or as saved with the map.
std::optional<TrueTrajectory> ReadMapTruth(const EvaluateArguments& arguments) {
  if (!arguments.map_drive.root.empty()) return ReadKittiTruth(arguments.map_drive.root, arguments.map_drive.sequence);
  const std::string path = MapTruthPath(arguments.parameters.map_file);
  if (!std::filesystem::exists(path)) return std::nullopt;
  TrueTrajectory truth;
  for (const StampedPose& pose : ReadTum(path)) {
    truth.stamps_ns.push_back(pose.stamp_ns);
    truth.T_world_sensor.push_back(pose.T_frame_sensor);
  }
  return truth;
}

void RunEvaluation(EvaluateArguments arguments) {
  EvaluationParameters& parameters = arguments.parameters;
  if (!arguments.config.empty()) parameters.core = LoadParameters(arguments.config);
  if (!arguments.mode.empty())
    parameters.core.back_end.mode = arguments.mode == "localization" ? Mode::kLocalization : Mode::kLoopClosure;
  if (!parameters.map_file.empty()) parameters.map_truth = ReadMapTruth(arguments);
  parameters.optimize = !arguments.no_optimization && arguments.kidnap_seed == 0;
  const std::unique_ptr<DriveSource> drive = OpenDrive(arguments);
  KidnappedDrive kidnapped(*drive, drive->size() / 2, RandomPlacement(arguments.kidnap_seed));
  DriveSource& input = arguments.kidnap_seed > 0 ? static_cast<DriveSource&>(kidnapped) : *drive;
  EvaluationResult result;
  {
    ProgressBar bar("evaluating", std::min(input.size(), parameters.max_steps));
    result = Evaluate(input, parameters, [&bar](std::size_t done, std::size_t) { bar.Update(done); });
  }
  WriteResults(result, parameters, arguments.out);
  std::printf("%s\nwritten to %s: report.html summary.json closures.csv steps.csv missed.csv trajectory_*.tum\n",
              FormatSummary(result).c_str(), arguments.out.c_str());
}

void AddInputOptions(CLI::App& command, EvaluateArguments& arguments) {
  CLI::App* input = command.add_option_group("Input", "one of");
  CLI::Option* kitti =
      input->add_option("--kitti", arguments.kitti.root, "folder that holds sequences/ and poses/ (ROOT)");
  CLI::Option* bag = input->add_option("--bag", arguments.bag.path, "ROS bag; no ROS master is needed");
  CLI::Option* simulate =
      input->add_flag("--simulate", arguments.simulate, "simulate each scan when it is needed, no files");
  input->require_option(1);

  CLI::App* with_kitti = command.add_option_group("With --kitti");
  with_kitti->add_option("--sequence", arguments.kitti.sequence, "name of the sequence (SS)")->needs(kitti);
  kitti->needs(with_kitti->get_option("--sequence"));
  with_kitti
      ->add_option("--odometry", arguments.kitti.odometry_file,
                   "3x4 rows, poses of the LiDAR; also looked for in the sequence's folder.\n"
                   "Without it the ground-truth poses serve as an odometry that does not drift")
      ->needs(kitti);

  CLI::App* with_bag = command.add_option_group("With --bag");
  with_bag->add_option("--topic", arguments.bag.cloud_topic, "sensor_msgs/PointCloud2; default: the only one")
      ->needs(bag);
  with_bag->add_option("--odometry-topic", arguments.bag.odometry_topic, "nav_msgs/Odometry; default: tf")->needs(bag);
  with_bag
      ->add_option("--odometry-frame", arguments.bag.odometry_frame,
                   "for tf; default: odom, if there is one, else world")
      ->needs(bag);
  with_bag
      ->add_option("--ground-truth-topic", arguments.bag.ground_truth_topic,
                   "nav_msgs/Odometry or geometry_msgs/PoseStamped, for scoring only")
      ->capture_default_str()
      ->needs(bag);

  CLI::App* with_simulate = command.add_option_group("With --simulate");
  AddDriveOptions(*with_simulate, &arguments.simulation);
  AddSensorOptions(*with_simulate, &arguments.simulation);
  for (CLI::Option* option : with_simulate->get_options()) option->needs(simulate);
}

}  // namespace

void AddEvaluateCommand(CLI::App& app) {
  const auto arguments = std::make_shared<EvaluateArguments>();
  CLI::App* command = app.add_subcommand(
      "evaluate",
      "Run a drive through the whole pipeline as fast as it goes: segments, recognitions, pose graph. Ground truth, "
      "where\n"
      "there is one, is used for scoring only. Writes report.html (the run as a page), summary.json, closures.csv, "
      "steps.csv\n"
      "(times and counts of every stage), missed.csv (revisits that were not recognised, and why), "
      "trajectory_odometry.tum,\n"
      "trajectory_optimized.tum, pose_graph.g2o and parameters.yaml, and prints a summary.\n\n"
      "  segmatch evaluate --kitti data --sequence 00 --odometry odometry.txt --out result\n"
      "  segmatch evaluate --bag town.bag --out result\n"
      "  segmatch evaluate --simulate --route loops --stride 2 --save-map town.map --out result\n"
      "  segmatch evaluate --simulate --route loops --day 1 --map town.map --mode localization --out day1\n\n"
      "A closure counts if its target is more than 60 s and 50 m of path older, and is true if its relative pose is "
      "within\n"
      "1 m and 3 degrees of the truth. A revisit is a step within 5 m of a pose that much older.\n");
  AddInputOptions(*command, *arguments);
  EvaluationParameters& parameters = arguments->parameters;
  command->add_option("--out", arguments->out, "folder to write into; made if need be")->required();
  command->add_option("--config", arguments->config, "YAML with parameters that differ from the defaults");
  CLI::Option* mode =
      command
          ->add_option(
              "--mode", arguments->mode,
              "loop_closure: the map is what this drive has seen; localization: in a map of an earlier drive,\n"
              "whose clock the stamps of targets are on. Default: as --config says")
          ->check(CLI::IsMember({"loop_closure", "localization"}));
  CLI::Option* map = command->add_option("--map", parameters.map_file, "map to localize in, saved by an earlier run")
                         ->check(CLI::ExistingFile)
                         ->needs(mode);
  CLI::Option* map_kitti =
      command
          ->add_option("--map-kitti", arguments->map_drive.root,
                       "KITTI layout of the map's drive, for its truth, in the same world frame as this drive's.\n"
                       "Default: the truth that was saved beside the map")
          ->needs(map);
  CLI::Option* map_sequence =
      command->add_option("--map-sequence", arguments->map_drive.sequence, "name of the map's sequence")
          ->needs(map_kitti);
  map_kitti->needs(map_sequence);
  command->add_option("--save-map", parameters.save_map,
                      "save the map in the end, and the truth of this drive, if it is known, beside it");
  const std::map<std::string, Pipeline> pipelines{
      {"incremental", Pipeline::kIncremental}, {"batch", Pipeline::kBatch}, {"both", Pipeline::kBoth}};
  command
      ->add_option("--pipeline", parameters.pipeline,
                   "incremental, batch (the original SegMatch on PCL), or both: steps.csv has the times of the batch\n"
                   "stages, run on each step's own input, beside ours")
      ->transform(CLI::CheckedTransformer(pipelines, CLI::ignore_case))
      ->default_str("incremental");
  command->add_option("--max-steps", parameters.max_steps, "stop after this many scans")->check(CLI::PositiveNumber);
  command
      ->add_option("--closure-spacing", parameters.closure_spacing_m,
                   "metres of path between closures that enter the pose graph; all are written")
      ->check(CLI::NonNegativeNumber)
      ->capture_default_str();
  command
      ->add_option("--optimization-spacing", parameters.optimization_spacing_m, "metres of path between optimizations")
      ->check(CLI::NonNegativeNumber)
      ->capture_default_str();
  command->add_flag("--no-optimization", arguments->no_optimization,
                    "recognitions only: no pose graph, nothing is corrected");
  command
      ->add_option("--kidnap", arguments->kidnap_seed,
                   "move the second half of the odometry by a random rigid transform of this seed: recognition\n"
                   "takes no pose prior, so the closures stay those of --no-optimization, which this implies")
      ->check(CLI::PositiveNumber);
  command->callback([arguments] { RunEvaluation(*arguments); });
}

}  // namespace incremental_segmatch::apps
