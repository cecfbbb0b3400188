#include "apps/experiment.hpp"

#include <algorithm>
#include <atomic>
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <functional>
#include <memory>
#include <mutex>
#include <stdexcept>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "apps/progress_bar.hpp"
#include "apps/simulated_drive.hpp"
#include "apps/simulation_options.hpp"
#include "evaluation/evaluation.hpp"
#include "evaluation/kidnap_comparison.hpp"
#include "evaluation/kidnapped_drive.hpp"
#include "evaluation/kitti_io.hpp"
#include "evaluation/run_table.hpp"
#include "evaluation/thesis_page.hpp"

namespace incremental_segmatch::apps {
namespace {

namespace fs = std::filesystem;

struct MatrixArguments {
  SimulationArguments simulation;
  std::vector<std::string> drives;
  std::vector<std::uint64_t> seeds{1, 2, 3};
  std::string config;
  std::string out;
  unsigned jobs = 1;
  bool resume = false;
  bool no_optimization = false;
};

// A drive as the command line names it: ROUTE or POSES_FILE, then :FIRST:COUNT for a part of it.
struct DriveName {
  std::string name;  ///< of its folders
  std::string route;
  std::string poses_file;
  std::size_t first_frame = 0;
  std::size_t max_scans = 0;
};

std::size_t ParseCount(const std::string& word, const std::string& drive) {
  std::size_t used = 0;
  unsigned long count = 0;
  try {
    count = std::stoul(word, &used);
  } catch (const std::exception&) {
    used = 0;
  }
  if (word.empty() || used != word.size()) {
    throw std::invalid_argument("drive " + drive + ": expected ROUTE, FILE, or either with :FIRST_FRAME:SCANS");
  }
  return count;
}

DriveName ParseDrive(const std::string& text) {
  std::vector<std::string> words{""};
  for (const char c : text) {
    if (c == ':') {
      words.emplace_back();
    } else {
      words.back() += c;
    }
  }
  if (words.size() > 3) throw std::invalid_argument("drive " + text + ": expected at most two colons");
  DriveName drive;
  const std::vector<std::string> routes = simulator::PresetRouteNames();
  if (std::find(routes.begin(), routes.end(), words[0]) != routes.end()) {
    drive.route = drive.name = words[0];
  } else if (fs::exists(words[0])) {
    drive.poses_file = words[0];
    drive.name = fs::path(words[0]).stem().string();
  } else {
    throw std::invalid_argument("drive " + text + " is neither a preset route nor a pose file that exists");
  }
  if (words.size() > 1) drive.first_frame = ParseCount(words[1], text);
  if (words.size() > 2) drive.max_scans = ParseCount(words[2], text);
  for (std::size_t i = 1; i < words.size(); ++i) drive.name += "_" + words[i];
  return drive;
}

simulator::SimulationOptions OptionsOf(const SimulationArguments& arguments, const DriveName& drive,
                                       std::uint64_t seed) {
  simulator::SimulationOptions options = arguments.Resolve();
  options.route = drive.route;
  options.poses_file = drive.poses_file;
  options.first_frame = drive.first_frame;
  options.max_scans = drive.max_scans;
  options.seed = seed;
  return options;
}

struct Run {
  std::string folder;
  std::string name;
  simulator::SimulationOptions simulation;
};

void Evaluate(const Run& run, const EvaluationParameters& parameters, std::string* words) {
  SimulatedDrive drive(run.simulation);
  const EvaluationResult result = incremental_segmatch::Evaluate(drive, parameters);
  WriteResults(result, parameters, run.folder);
  const Score& score = *result.score;
  char text[200];
  std::snprintf(text, sizeof text, "%zu steps, %zu true, %zu false, recall %.3f of %zu, %.0f s", result.steps.size(),
                score.true_closures, score.false_closures, score.recall, score.revisits, result.seconds);
  *words = text;
}

// Runs them on some threads. A run that fails does not end the others; what failed is said, and thrown in the end.
void EvaluateAll(const std::vector<Run>& runs, const EvaluationParameters& parameters, unsigned jobs, bool resume) {
  std::atomic<std::size_t> next{0};
  std::mutex printing;
  std::size_t done = 0, failed = 0;
  const auto work = [&] {
    for (std::size_t i = next++; i < runs.size(); i = next++) {
      std::string words;
      bool ok = true;
      try {
        if (resume && fs::exists(runs[i].folder + "/summary.json")) {
          words = "is there already";
        } else {
          Evaluate(runs[i], parameters, &words);
        }
      } catch (const std::exception& error) {
        words = std::string("failed: ") + error.what();
        ok = false;
      }
      const std::lock_guard<std::mutex> lock(printing);
      failed += !ok;
      std::printf("[%zu/%zu] %s: %s\n", ++done, runs.size(), runs[i].name.c_str(), words.c_str());
      std::fflush(stdout);
    }
  };
  std::vector<std::thread> threads;
  for (unsigned i = 1; i < std::min<std::size_t>(jobs, runs.size()); ++i) threads.emplace_back(work);
  work();
  for (std::thread& thread : threads) thread.join();
  if (failed > 0)
    throw std::runtime_error(std::to_string(failed) + " of " + std::to_string(runs.size()) + " runs failed");
}

void WriteText(const std::string& path, const std::string& text) {
  std::ofstream file(path);
  file << text;
  file.close();
  if (!file) throw std::runtime_error("can't write " + path);
}

void RunMatrix(const MatrixArguments& arguments) {
  EvaluationParameters parameters;
  if (!arguments.config.empty()) parameters.core = LoadParameters(arguments.config);
  parameters.optimize = !arguments.no_optimization;
  std::vector<Run> runs;
  std::vector<RunGroup> groups;
  for (const std::string& text : arguments.drives) {
    const DriveName drive = ParseDrive(text);
    groups.push_back({drive.name, {}});
    for (const std::uint64_t seed : arguments.seeds) {
      Run run;
      run.name = drive.name + " seed " + std::to_string(seed);
      run.folder = arguments.out + "/" + drive.name + "_seed" + std::to_string(seed);
      run.simulation = OptionsOf(arguments.simulation, drive, seed);
      runs.push_back(run);
      groups.back().summaries.push_back(run.folder + "/summary.json");
    }
  }
  EvaluateAll(runs, parameters, arguments.jobs, arguments.resume);
  const std::string table = RunTableMarkdown(groups);
  WriteText(arguments.out + "/matrix.md", table);
  WriteText(arguments.out + "/matrix.json", RunTableJson(groups));
  std::printf("\n%s\nwritten to %s: matrix.md matrix.json, and a folder for each run with its report.html\n",
              table.c_str(), arguments.out.c_str());
}

void AddMatrixCommand(CLI::App& experiment) {
  const auto arguments = std::make_shared<MatrixArguments>();
  CLI::App* command = experiment.add_subcommand(
      "matrix",
      "Evaluate several simulated drives with several seeds each, simulating on the fly, and gather mean and range "
      "per\n"
      "drive in one table.\n\n"
      "  segmatch experiment matrix --drives opposite deceptive kitti/05.txt kitti/06.txt:0:600 --stride 2 --out "
      "result\n\n"
      "A drive is a preset route or a KITTI pose file, of which :FIRST_FRAME:SCANS takes a part.\n");
  command->add_option("--drives", arguments->drives, "what to drive")->required();
  command->add_option("--seeds", arguments->seeds, "of town, noise and drift")->capture_default_str();
  command->add_option("--out", arguments->out, "folder to write into; made if need be")->required();
  command->add_option("--config", arguments->config, "YAML with parameters that differ from the defaults");
  command->add_option("--jobs", arguments->jobs, "runs at a time; their times are worth less then")
      ->check(CLI::PositiveNumber)
      ->capture_default_str();
  command->add_flag("--resume", arguments->resume, "keep what runs of an earlier call have left in the folder");
  command->add_flag("--no-optimization", arguments->no_optimization, "recognitions only: no pose graph");
  AddSensorOptions(*command, &arguments->simulation);
  command->callback([arguments] { RunMatrix(*arguments); });
}

struct ThesisArguments {
  SimulationArguments simulation;
  std::vector<std::string> drives;
  std::uint64_t seed = 1;
  std::string kitti_root;
  std::vector<std::string> sequences;  ///< pairs: of the map, and to localize in it
  std::string config;
  std::string out;
};

// A drive for the map, and one to localize in it.
struct DrivePair {
  std::string name;
  std::function<std::unique_ptr<DriveSource>()> map_drive;
  std::function<std::unique_ptr<DriveSource>()> query_drive;
};

DrivePair SimulatedPair(const ThesisArguments& arguments, const std::string& text) {
  const DriveName drive = ParseDrive(text);
  const auto simulated = [=](std::uint64_t day) {
    simulator::SimulationOptions options = OptionsOf(arguments.simulation, drive, arguments.seed);
    options.day = day;
    return std::make_unique<SimulatedDrive>(options);
  };
  return {drive.name, [=] { return simulated(0); }, [=] { return simulated(1); }};
}

DrivePair KittiPair(const std::string& root, const std::string& map_sequence, const std::string& query_sequence) {
  const auto recorded = [=](const std::string& sequence) {
    KittiDriveOptions options{root, sequence, {}};
    if (HasKittiOdometry(root, sequence)) options.odometry_file = "odometry.txt";
    return std::make_unique<KittiDrive>(options);
  };
  return {query_sequence + "_in_" + map_sequence, [=] { return recorded(map_sequence); },
          [=] { return recorded(query_sequence); }};
}

ThesisRun RunExperiment(const std::string& name, DriveSource& drive, const EvaluationParameters& parameters,
                        const std::string& out) {
  ThesisRun run;
  run.drive = name;
  run.is_localization = parameters.core.back_end.mode == Mode::kLocalization;
  const std::string folder = name + (run.is_localization ? "_localization" : "_loop_closure");
  run.report = folder + "/report.html";
  {
    ProgressBar bar(folder, drive.size());
    run.result =
        incremental_segmatch::Evaluate(drive, parameters, [&](std::size_t done, std::size_t) { bar.Update(done); });
  }
  WriteResults(run.result, parameters, out + "/" + folder);
  return run;
}

void RunThesis(const ThesisArguments& arguments) {
  std::vector<DrivePair> pairs;
  for (const std::string& drive : arguments.drives) pairs.push_back(SimulatedPair(arguments, drive));
  for (std::size_t i = 0; i + 1 < arguments.sequences.size(); i += 2)
    pairs.push_back(KittiPair(arguments.kitti_root, arguments.sequences[i], arguments.sequences[i + 1]));
  if (pairs.empty())
    throw std::invalid_argument("experiment thesis needs --drives, or --kitti and pairs of --sequences");
  fs::create_directories(arguments.out);
  std::vector<ThesisRun> runs;
  for (const DrivePair& pair : pairs) {
    EvaluationParameters parameters;
    if (!arguments.config.empty()) parameters.core = LoadParameters(arguments.config);
    parameters.pipeline = Pipeline::kBoth;
    parameters.core.back_end.mode = Mode::kLoopClosure;
    parameters.save_map = arguments.out + "/" + pair.name + ".map";
    runs.push_back(RunExperiment(pair.name, *pair.map_drive(), parameters, arguments.out));
    parameters.core.back_end.mode = Mode::kLocalization;
    parameters.map_file = std::exchange(parameters.save_map, {});
    parameters.map_truth = runs.back().result.truth;
    runs.push_back(RunExperiment(pair.name, *pair.query_drive(), parameters, arguments.out));
  }
  WriteText(arguments.out + "/thesis.html", ThesisPage(runs));
  std::printf("written to %s: thesis.html, and a folder for each run with its report.html\n", arguments.out.c_str());
}

void AddThesisCommand(CLI::App& experiment) {
  const auto arguments = std::make_shared<ThesisArguments>();
  CLI::App* command = experiment.add_subcommand(
      "thesis",
      "The thesis's two KITTI experiments, loop closure and localization, both beside the batch pipeline, on one "
      "page:\n"
      "thesis.html has what was found, speed-ups per stage, and the curve of distances between localizations.\n"
      "Simulated drives: the map is of the first day, the drive to localize of the second, whose parked cars, "
      "traffic,\n"
      "noise and drift are others.\n\n"
      "  segmatch experiment thesis --drives kitti/05.txt kitti/06.txt --stride 2 --out thesis\n"
      "  segmatch experiment thesis --kitti data --sequences 00 01 --out thesis     localizes 01 in the map of 00\n");
  command->add_option("--drives", arguments->drives,
                      "preset routes or KITTI pose files, with :FIRST_FRAME:SCANS a part of them");
  CLI::Option* kitti =
      command->add_option("--kitti", arguments->kitti_root, "folder that holds sequences/ and poses/ (ROOT)");
  CLI::Option* sequences =
      command
          ->add_option("--sequences", arguments->sequences,
                       "pairs of sequences: of the map, and to localize in it; their poses must be in one frame")
          ->needs(kitti);
  kitti->needs(sequences);
  command->add_option("--seed", arguments->seed, "of town, noise and drift")->capture_default_str();
  command->add_option("--out", arguments->out, "folder to write into; made if need be")->required();
  command->add_option("--config", arguments->config, "YAML with parameters that differ from the defaults");
  AddSensorOptions(*command, &arguments->simulation);
  command->callback([arguments] {
    if (arguments->sequences.size() % 2 != 0) throw CLI::ValidationError("--sequences", "give pairs");
    RunThesis(*arguments);
  });
}

struct KidnapArguments {
  SimulationArguments simulation;
  std::vector<std::string> drives;
  std::vector<std::uint64_t> seeds{1};
  std::string config;
  std::string out;
};

void RunKidnap(const KidnapArguments& arguments) {
  EvaluationParameters parameters;
  if (!arguments.config.empty()) parameters.core = LoadParameters(arguments.config);
  parameters.optimize = false;
  const double refill_m = 2.0 * parameters.core.front_end.local_radius_m;
  std::vector<KidnapComparison> comparisons;
  for (const std::string& text : arguments.drives) {
    const DriveName name = ParseDrive(text);
    for (const std::uint64_t seed : arguments.seeds) {
      SimulatedDrive drive(OptionsOf(arguments.simulation, name, seed));
      const std::size_t half = drive.size() / 2;
      KidnappedDrive kidnapped(drive, half, RandomPlacement(static_cast<unsigned>(seed)));
      const auto run = [&](const std::string& what, DriveSource& source) {
        const std::string folder = name.name + "_seed" + std::to_string(seed) + "_" + what;
        ProgressBar bar(folder, source.size());
        EvaluationResult result = incremental_segmatch::Evaluate(
            source, parameters, [&](std::size_t done, std::size_t) { bar.Update(done); });
        WriteResults(result, parameters, arguments.out + "/" + folder);
        return result;
      };
      const EvaluationResult undisturbed = run("undisturbed", drive);
      comparisons.push_back(CompareKidnapped(name.name + ", seed " + std::to_string(seed), undisturbed,
                                             run("carried", kidnapped), half, refill_m));
    }
  }
  WriteText(arguments.out + "/kidnap.md", KidnapMarkdown(comparisons));
  WriteText(arguments.out + "/kidnap.json", KidnapJson(comparisons));
  std::printf("\n%s\nwritten to %s: kidnap.md kidnap.json, and a folder for each run with its report.html\n",
              KidnapMarkdown(comparisons).c_str(), arguments.out.c_str());
}

void AddKidnapCommand(CLI::App& experiment) {
  const auto arguments = std::make_shared<KidnapArguments>();
  CLI::App* command = experiment.add_subcommand(
      "kidnap",
      "A robot that is carried elsewhere half-way, odometry moved by a random rigid transform, beside the same drive\n"
      "undisturbed: recognition takes no pose prior, so both recognise the same, but where the local map of the "
      "carried\n"
      "robot has still to fill again. Nothing is optimized.\n\n"
      "  segmatch experiment kidnap --drives loops kitti/06.txt --seeds 1 2 --stride 2 --out kidnap\n");
  command
      ->add_option("--drives", arguments->drives, "preset routes or KITTI pose files, with :FIRST_FRAME:SCANS a part")
      ->required();
  command->add_option("--seeds", arguments->seeds, "of town, noise, drift and of where the robot is carried to")
      ->capture_default_str();
  command->add_option("--out", arguments->out, "folder to write into; made if need be")->required();
  command->add_option("--config", arguments->config, "YAML with parameters that differ from the defaults");
  AddSensorOptions(*command, &arguments->simulation);
  command->callback([arguments] { RunKidnap(*arguments); });
}

}  // namespace

void AddExperimentCommand(CLI::App& app) {
  CLI::App* command = app.add_subcommand("experiment", "Sets of runs, and the table or page that comes of them.");
  command->require_subcommand(1);
  AddMatrixCommand(*command);
  AddThesisCommand(*command);
  AddKidnapCommand(*command);
}

}  // namespace incremental_segmatch::apps
