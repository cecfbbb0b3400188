// The program as a user calls it: exit statuses, messages and the files that it writes.
#include <gtest/gtest.h>
#include <sys/wait.h>

#include <algorithm>
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <nlohmann/json.hpp>
#include <sstream>
#include <string>
#include <vector>

#include "support/kitti_layout.hpp"
#include "support/temporary_directory.hpp"

namespace incremental_segmatch {
namespace {

#define EXPECT_HAS(text, word) \
  EXPECT_NE((text).find(word), std::string::npos) << "`" << (word) << "` is not in: " << (text)

struct Outcome {
  int status = -1;
  std::string output;  // of both streams
};

Outcome Segmatch(const std::string& arguments) {
  Outcome run;
  FILE* pipe = popen((std::string(SEGMATCH_PROGRAM) + " " + arguments + " 2>&1").c_str(), "r");
  if (pipe == nullptr) return run;
  char buffer[4096];
  while (const std::size_t bytes = std::fread(buffer, 1, sizeof buffer, pipe)) run.output.append(buffer, bytes);
  const int status = pclose(pipe);
  run.status = WIFEXITED(status) ? WEXITSTATUS(status) : -1;
  return run;
}

std::vector<std::string> Lines(const std::string& path) {
  std::ifstream file(path);
  std::vector<std::string> lines;
  for (std::string line; std::getline(file, line);) lines.push_back(line);
  return lines;
}

TEST(Program, HelpTeachesWithExamples) {
  const Outcome run = Segmatch("--help");
  EXPECT_EQ(run.status, 0);
  for (const std::string command : {"simulate", "kitti2bag", "evaluate"}) {
    EXPECT_HAS(run.output, command);
    const Outcome help = Segmatch(command + " --help");
    EXPECT_EQ(help.status, 0);
    EXPECT_HAS(help.output, "  segmatch " + command + " --");
  }
  EXPECT_EQ(Segmatch("--version").status, 0);
}

TEST(Program, WrongCallsAreRefused) {
  EXPECT_NE(Segmatch("").status, 0);
  EXPECT_NE(Segmatch("dance").status, 0);
  const Outcome nothing = Segmatch("evaluate --out x");
  EXPECT_NE(nothing.status, 0);
  EXPECT_HAS(nothing.output, "--kitti");
  const Outcome no_sequence = Segmatch("evaluate --kitti x --out x");
  EXPECT_NE(no_sequence.status, 0);
  EXPECT_HAS(no_sequence.output, "--sequence");
  const Outcome both = Segmatch("evaluate --kitti x --sequence 00 --bag y --out x");
  EXPECT_NE(both.status, 0);
}

class Drive : public testing::Test {
 protected:
  Drive() { test::WriteKittiLayout(test::MakeTinyDrive(6), directory_, "07"); }
  std::string Kitti() const { return "--kitti " + directory_.path() + " --sequence 07"; }
  std::string Out(const std::string& name) const { return directory_.path() + "/" + name; }

  test::TemporaryDirectory directory_;
};

TEST_F(Drive, MissingDataIsNamed) {
  const Outcome run = Segmatch("evaluate --kitti /nonexistent --sequence 00 --out " + Out("result"));
  EXPECT_EQ(run.status, 1);
  EXPECT_HAS(run.output, "segmatch: /nonexistent/sequences/00/velodyne is no folder");
}

TEST_F(Drive, UnknownParameterIsNamed) {
  const std::string config = directory_.Write("config.yaml", "front_end:\n  no_such_key: 1\n");
  const Outcome run = Segmatch("evaluate " + Kitti() + " --config " + config + " --out " + Out("result"));
  EXPECT_EQ(run.status, 1);
  EXPECT_HAS(run.output, "front_end.no_such_key");
}

TEST_F(Drive, EvaluateWritesItsFiles) {
  const Outcome run =
      Segmatch("evaluate " + Kitti() + " --odometry odometry.txt --max-steps 5 --out " + Out("a/result"));
  ASSERT_EQ(run.status, 0) << run.output;
  EXPECT_HAS(run.output, "5 steps");
  EXPECT_HAS(run.output, "trajectory error");
  EXPECT_HAS(run.output, "bound");
  const std::vector<std::string> closures = Lines(Out("a/result/closures.csv"));
  ASSERT_EQ(closures.size(), 1u) << "nothing is revisited";
  EXPECT_EQ(closures[0],
            "stamp_query,stamp_target,robot_query,robot_target,x,y,z,qx,qy,qz,qw,inliers,candidates,rms_m");
  const std::vector<std::string> steps = Lines(Out("a/result/steps.csv"));
  ASSERT_EQ(steps.size(), 6u);
  for (const std::string column : {"total_ms", "points", "voxels", "segments", "candidates", "edges", "clique"}) {
    EXPECT_HAS("," + steps[0] + ",", "," + column + ",");
  }
  EXPECT_HAS(steps[2], "1,0.100000000,");
  for (const std::string& row : steps) {
    EXPECT_EQ(std::count(row.begin(), row.end(), ','), std::count(steps[0].begin(), steps[0].end(), ','));
  }
  EXPECT_EQ(Lines(Out("a/result/trajectory_odometry.tum")).size(), 5u);
  EXPECT_EQ(Lines(Out("a/result/trajectory_optimized.tum")).size(), 5u);
  std::ifstream file(Out("a/result/summary.json"));
  const nlohmann::json summary = nlohmann::json::parse(file);
  EXPECT_EQ(summary["steps"], 5);
  EXPECT_EQ(summary["odometry_is_truth"], false);
  EXPECT_EQ(summary["counts"]["points"]["median"], 4);
  EXPECT_TRUE(summary["score"]["recall"].is_null()) << "there is no revisit to find";
  EXPECT_GT(summary["trajectory_error_m"]["odometry"], 0.0);
  EXPECT_TRUE(summary["stages_ms"].contains("total"));
  // The parameters that were used reproduce the run.
  EXPECT_EQ(
      Segmatch("evaluate " + Kitti() + " --config " + Out("a/result/parameters.yaml") + " --out " + Out("b")).status,
      0);
}

TEST_F(Drive, TheOdometryUsedIsSaid) {
  const Outcome run = Segmatch("evaluate " + Kitti() + " --out " + Out("result"));
  ASSERT_EQ(run.status, 0) << run.output;
  EXPECT_HAS(run.output, "does not drift");
  std::ifstream file(Out("result/summary.json"));
  EXPECT_EQ(nlohmann::json::parse(file)["odometry_is_truth"], true);
}

TEST_F(Drive, Bags) {
  const Outcome written = Segmatch("kitti2bag " + Kitti() + " --out " + Out("drive.bag"));
#ifdef SEGMATCH_WITH_ROSBAG
  ASSERT_EQ(written.status, 0) << written.output;
  EXPECT_HAS(written.output, "odometry.txt");
  const Outcome from_bag = Segmatch("evaluate --bag " + Out("drive.bag") + " --out " + Out("bag"));
  ASSERT_EQ(from_bag.status, 0) << from_bag.output;
  const Outcome from_files = Segmatch("evaluate " + Kitti() + " --odometry odometry.txt --out " + Out("files"));
  ASSERT_EQ(from_files.status, 0) << from_files.output;
  std::ifstream bag(Out("bag/summary.json")), files(Out("files/summary.json"));
  const nlohmann::json a = nlohmann::json::parse(bag), b = nlohmann::json::parse(files);
  EXPECT_EQ(a["steps"], b["steps"]);
  EXPECT_NEAR(a["trajectory_error_m"]["odometry"], b["trajectory_error_m"]["odometry"], 1e-6);
  EXPECT_HAS(Lines(Out("bag/steps.csv"))[2], "1,0.100000000,");
  std::filesystem::remove(directory_.path() + "/sequences/07/odometry.txt");
  EXPECT_HAS(Segmatch("kitti2bag " + Kitti() + " --out " + Out("other.bag")).output, "poses serve as odometry");
#else
  EXPECT_EQ(written.status, 1);
  EXPECT_HAS(written.output, "not built in");
  const Outcome run = Segmatch("evaluate --bag x.bag --out " + Out("result"));
  EXPECT_EQ(run.status, 1);
  EXPECT_HAS(run.output, "--bag is not built in");
#endif
}

TEST_F(Drive, SimulatedOnTheFly) {
  const Outcome run = Segmatch("evaluate --simulate --sensor VLP-16 --route lap --max-steps 8 --out " + Out("result"));
  ASSERT_EQ(run.status, 0) << run.output;
  EXPECT_HAS(run.output, "8 steps of simulated drive along route lap");
}

TEST_F(Drive, SimulationTakesTheOptionsOfSimulate) {
  const std::string options =
      " --route lap --laps 1 --first-frame 7 --max-scans 4 --stride 3 --drift 0 --noise 0.01 --grade 0 ";
  const Outcome run = Segmatch("evaluate --simulate --sensor VLP-16" + options + "--out " + Out("result"));
  ASSERT_EQ(run.status, 0) << run.output;
  EXPECT_HAS(run.output, "4 steps of simulated drive");
  const Outcome written = Segmatch("simulate --sensor VLP-16" + options + "--out " + Out("drive"));
  ASSERT_EQ(written.status, 0) << written.output;
  const Outcome again =
      Segmatch("evaluate --kitti " + Out("drive") + " --sequence 00 --odometry odometry.txt --out " + Out("again"));
  ASSERT_EQ(again.status, 0) << again.output;
  std::ifstream first(Out("result/summary.json")), second(Out("again/summary.json"));
  const nlohmann::json a = nlohmann::json::parse(first), b = nlohmann::json::parse(second);
  EXPECT_EQ(a["counts"]["points"], b["counts"]["points"]);
  EXPECT_EQ(a["counts"]["segments"], b["counts"]["segments"]);
  EXPECT_NEAR(a["trajectory_error_m"]["odometry"].get<double>(), 0.0, 1e-6) << "no drift was asked for";
  EXPECT_NE(Segmatch("evaluate --kitti x --sequence 00 --laps 2 --out x").status, 0);
}

TEST_F(Drive, LocalizationNeedsAMapAndAMapLocalization) {
  const Outcome no_map = Segmatch("evaluate " + Kitti() + " --mode localization --out " + Out("result"));
  EXPECT_EQ(no_map.status, 1);
  EXPECT_HAS(no_map.output, "map");
  ASSERT_EQ(Segmatch("evaluate " + Kitti() + " --save-map " + Out("map") + " --out " + Out("first")).status, 0);
  EXPECT_EQ(Lines(Out("map.truth.tum")).size(), 6u);
  EXPECT_EQ(
      Segmatch("evaluate " + Kitti() + " --map " + Out("map") + " --mode loop_closure --out " + Out("second")).status,
      1);
  const Outcome run =
      Segmatch("evaluate " + Kitti() + " --map " + Out("map") + " --mode localization --out " + Out("second"));
  ASSERT_EQ(run.status, 0) << run.output;
  std::ifstream file(Out("second/summary.json"));
  const nlohmann::json summary = nlohmann::json::parse(file);
  EXPECT_EQ(summary["score"]["revisits"], 6) << "every scan is where the map was made";
  EXPECT_TRUE(summary["trajectory_error_m"].is_null());
  EXPECT_EQ(Lines(Out("second/missed.csv")).size(), 7u) << "and too empty to be recognised";
  std::filesystem::remove(Out("map.truth.tum"));
  const Outcome unjudged =
      Segmatch("evaluate " + Kitti() + " --map " + Out("map") + " --mode localization --out " + Out("third"));
  EXPECT_HAS(unjudged.output, "nothing is scored");
  const Outcome with_kitti =
      Segmatch("evaluate " + Kitti() + " --map " + Out("map") + " --mode localization --map-kitti " +
               directory_.path() + " --map-sequence 07 --out " + Out("fourth"));
  EXPECT_HAS(with_kitti.output, "of 6 revisits");
}

TEST_F(Drive, MatrixGathersRuns) {
  const std::string call =
      "experiment matrix --drives lap:0:3 lap:20:2 --seeds 4 9 --sensor VLP-16 --jobs 2 --out " + Out("matrix");
  const Outcome run = Segmatch(call);
  ASSERT_EQ(run.status, 0) << run.output;
  std::ifstream file(Out("matrix/matrix.json"));
  const nlohmann::json table = nlohmann::json::parse(file);
  EXPECT_EQ(table["lap_0_3"]["runs"], 2);
  EXPECT_EQ(table["lap_20_2"]["steps"]["mean"], 2.0);
  EXPECT_EQ(table["all"]["runs"], 4);
  EXPECT_TRUE(std::filesystem::exists(Out("matrix/lap_20_2_seed9/report.html")));
  EXPECT_HAS(Segmatch(call + " --resume").output, "is there already");
  const Outcome unknown = Segmatch("experiment matrix --drives nowhere --out " + Out("x"));
  EXPECT_EQ(unknown.status, 1);
  EXPECT_HAS(unknown.output, "nowhere");
}

TEST(Presets, FindSegmentsWithTheirSensors) {
  const test::TemporaryDirectory directory;
  const std::string street = "--route lap --first-frame 100 --stride 2 ", office = "--route office --stride 5 ";
  for (const auto& [preset, drive] :
       {std::make_pair("hdl64e", street + "--sensor HDL-64E"), std::make_pair("hdl32e", street + "--sensor HDL-32E"),
        std::make_pair("vlp16", street + "--sensor VLP-16"), std::make_pair("os1_128", street + "--sensor OS1-128"),
        std::make_pair("livox_avia", street + "--sensor Livox-Avia --sensor-height 1.2"),
        std::make_pair("indoor", office + "--sensor VLP-16 --sensor-height 0.6")}) {
    SCOPED_TRACE(preset);
    const Outcome run = Segmatch(std::string("evaluate --simulate --max-steps 12 ") + drive + " --config " +
                                 SEGMATCH_SOURCE_DIR "/config/" + preset + ".yaml --out " + directory.path());
    ASSERT_EQ(run.status, 0) << run.output;
    std::ifstream file(directory.path() + "/summary.json");
    EXPECT_GT(nlohmann::json::parse(file)["counts"]["segments"]["max"], 25.0);
  }
}

TEST(Experiment, KidnappedBesideUndisturbed) {
  const test::TemporaryDirectory directory;
  const Outcome run =
      Segmatch("experiment kidnap --drives lap:0:4 --seeds 2 --sensor VLP-16 --out " + directory.path());
  ASSERT_EQ(run.status, 0) << run.output;
  EXPECT_HAS(run.output, "| lap_0_4, seed 2 | before | 2 |");
  EXPECT_TRUE(std::filesystem::exists(directory.path() + "/lap_0_4_seed2_carried/report.html"));
  EXPECT_TRUE(std::filesystem::exists(directory.path() + "/kidnap.json"));
}

TEST_F(Drive, BatchBesideIncremental) {
  const std::string drive = "evaluate --simulate --sensor VLP-16 --route lap --first-frame 20 --max-steps 4 ";
  const Outcome run = Segmatch(drive + "--pipeline both --out " + Out("both"));
  ASSERT_EQ(run.status, 0) << run.output;
  EXPECT_HAS(run.output, "segmentation, tree included");
  const std::vector<std::string> steps = Lines(Out("both/steps.csv"));
  ASSERT_EQ(steps.size(), 5u);
  for (const std::string column : {"total_ms", "batch_total_ms", "batch_voxel_grid_ms", "batch_tree_ms",
                                   "batch_segmentation_ms", "batch_recognition_ms", "batch_segments"})
    EXPECT_HAS("," + steps[0] + ",", "," + column + ",");
  for (const std::string& row : steps)
    EXPECT_EQ(std::count(row.begin(), row.end(), ','), std::count(steps[0].begin(), steps[0].end(), ','));
  std::ifstream file(Out("both/summary.json"));
  const nlohmann::json comparison = nlohmann::json::parse(file)["batch_comparison"];
  EXPECT_EQ(comparison.back()["stage"], "whole step");
  EXPECT_EQ(comparison.back()["steps"], 4);
  EXPECT_GT(comparison.back()["batch_median_ms"], 0.0);

  const std::string config = directory_.Write("smooth.yaml", "front_end:\n  segmentation: smoothness\n");
  EXPECT_HAS(Segmatch(drive + "--pipeline both --config " + config + " --out " + Out("smooth")).output,
             "normals, tree shared");
  const Outcome batch = Segmatch(drive + "--pipeline batch --out " + Out("batch"));
  ASSERT_EQ(batch.status, 0) << batch.output;
  EXPECT_HAS(batch.output, "segment_clouds");
  EXPECT_NE(Segmatch(drive + "--pipeline none --out " + Out("none")).status, 0);
}

TEST_F(Drive, ThesisExperimentsWriteOnePage) {
  const Outcome run = Segmatch("experiment thesis --drives lap:0:3 --sensor VLP-16 --kitti " + directory_.path() +
                               " --sequences 07 07 --out " + Out("t"));
  ASSERT_EQ(run.status, 0) << run.output;
  for (const std::string name : {"lap_0_3_loop_closure", "lap_0_3_localization", "07_in_07_localization"})
    EXPECT_TRUE(std::filesystem::exists(Out("t/" + name + "/report.html"))) << name;
  EXPECT_TRUE(std::filesystem::exists(Out("t/thesis.html")));
  EXPECT_HAS(Lines(Out("t/lap_0_3_localization/steps.csv"))[0], "batch_voxel_grid_ms");
  EXPECT_NE(Segmatch("experiment thesis --kitti " + directory_.path() + " --sequences 07 --out " + Out("t")).status, 0);
  EXPECT_NE(Segmatch("experiment thesis --out " + Out("t")).status, 0);
}

}  // namespace
}  // namespace incremental_segmatch
