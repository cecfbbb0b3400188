#include "incremental_segmatch/parameters.hpp"

#include <gtest/gtest.h>
#include <yaml-cpp/yaml.h>

#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <limits>
#include <random>
#include <set>
#include <sstream>
#include <stdexcept>
#include <utility>

#ifndef SEGMATCH_SOURCE_DIR
#error "the build must say where config and docs are"
#endif

namespace incremental_segmatch {
namespace {

std::string ReadText(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  EXPECT_TRUE(file) << path;
  std::stringstream text;
  text << file.rdbuf();
  return text.str();
}

// What the parser says to a text that it must refuse.
std::string Complaint(const std::string& yaml) {
  try {
    ParseParameters(yaml, "test");
  } catch (const std::invalid_argument& error) {
    return error.what();
  }
  ADD_FAILURE() << "accepted: " << yaml;
  return "";
}

void ExpectComplaint(const std::string& yaml, const std::vector<std::string>& parts) {
  const std::string complaint = Complaint(yaml);
  for (const std::string& part : parts)
    EXPECT_NE(complaint.find(part), std::string::npos) << complaint << "\nlacks: " << part;
}

TEST(Parameters, NothingGivesTheDefaults) {
  const std::string defaults = ToYaml({});
  for (const char* yaml : {"", "{}", "# nothing\n", "front_end:\n", "back_end:\n  matching:\n"})
    EXPECT_EQ(ToYaml(ParseParameters(yaml, "test")), defaults) << yaml;
}

TEST(Parameters, ReadsEveryKindOfValue) {
  const Parameters p = ParseParameters(R"(
front_end:
  local_radius_m: 62.5
  ground: {model: elevation, max_height_m: .inf, min_height_m: -2}
  grid: {min_points_per_voxel: 3, bits: [20, 19, 18], center_m: [1.5, -2, 1e3]}
  segmenter: {max_cluster_size: 20000, boundary: invalidate}
  descriptor:
    sizes: false
back_end:
  mode: "localization"
  recognizer:
    clique: {deadline_us: 2500, max_tie_work: 10000000000}
    consistency: {method: cached}
)",
                                       "test");
  EXPECT_EQ(p.front_end.local_radius_m, 62.5);
  EXPECT_EQ(p.front_end.ground.model, GroundModel::kElevation);
  EXPECT_EQ(p.front_end.ground.max_height_m, std::numeric_limits<double>::infinity());
  EXPECT_EQ(p.front_end.ground.min_height_m, -2.0);
  EXPECT_EQ(p.front_end.grid.min_points_per_voxel, 3);
  EXPECT_EQ(p.front_end.grid.bits, (std::array<int, 3>{20, 19, 18}));
  EXPECT_EQ(p.front_end.grid.center_m, (std::array<double, 3>{1.5, -2.0, 1000.0}));
  EXPECT_EQ(p.front_end.segmenter.max_cluster_size, 20000u);
  EXPECT_EQ(p.front_end.segmenter.boundary, BoundaryPolicy::kInvalidate);
  EXPECT_FALSE(p.front_end.descriptor.sizes);
  EXPECT_TRUE(p.front_end.descriptor.eigenvalues);
  EXPECT_EQ(p.back_end.mode, Mode::kLocalization);
  EXPECT_EQ(p.back_end.recognizer.clique.deadline.count(), 2500);
  EXPECT_EQ(p.back_end.recognizer.clique.max_tie_work, 10000000000u);
  EXPECT_EQ(p.back_end.recognizer.consistency.method, ConsistencyMethod::kCached);
}

TEST(Parameters, UnknownKeysAreRefusedWithASuggestion) {
  ExpectComplaint("front_end: {grid: {resolution: 0.2}}",
                  {"test:1: front_end.grid.resolution: ", "did you mean front_end.grid.resolution_m?"});
  ExpectComplaint("front_end:\n  resolution_m: 0.2",
                  {"test:2: front_end.resolution_m: ", "front_end.grid.resolution_m?"});
  ExpectComplaint("frontend: {}", {"frontend: ", "did you mean front_end?"});
  ExpectComplaint("back_end: {recogniser: {max_rms_m: 1}}",
                  {"back_end.recogniser: ", "did you mean back_end.recognizer?"});
  ExpectComplaint("back_end: {recognizer: {min_size: 7}}", {"back_end.recognizer.clique.min_size?"});
  ExpectComplaint("{[1, 2]: 3}", {"is no parameter"});
}

TEST(Parameters, RepeatedKeysAreRefused) {
  ExpectComplaint("front_end: {local_radius_m: 40}\nfront_end: {}", {"test:2: front_end: is given twice"});
  ExpectComplaint("front_end: {local_radius_m: 40, local_radius_m: 50}", {"front_end.local_radius_m: is given twice"});
}

TEST(Parameters, WrongTypesAreRefused) {
  ExpectComplaint("front_end: 3", {"front_end: must hold keys and values"});
  ExpectComplaint("[1, 2]", {"must hold keys and values"});
  ExpectComplaint("front_end: {local_radius_m: far}", {"front_end.local_radius_m: must be a number"});
  ExpectComplaint("front_end: {local_radius_m: '40'}", {"front_end.local_radius_m: must be a number"});
  ExpectComplaint("front_end: {local_radius_m: }", {"front_end.local_radius_m: must be a number"});
  ExpectComplaint("front_end: {local_radius_m: [40]}", {"front_end.local_radius_m: must be a number"});
  ExpectComplaint("front_end: {grid: {min_points_per_voxel: 1.5}}", {"min_points_per_voxel: must be a whole number"});
  ExpectComplaint("front_end: {grid: {min_points_per_voxel: 99999999999}}", {"is beyond the range of its type"});
  ExpectComplaint("front_end: {segmenter: {max_cluster_size: -1}}",
                  {"max_cluster_size: is beyond the range of its type"});
  ExpectComplaint("front_end: {descriptor: {sizes: 1}}", {"front_end.descriptor.sizes: must be true or false"});
  ExpectComplaint("front_end: {grid: {bits: [21, 21]}}", {"front_end.grid.bits: must be a list of 3 numbers"});
  ExpectComplaint("front_end: {ground: {model: plane}}", {"must be one of none, height_threshold, elevation"});
  ExpectComplaint("back_end: {mode: 0}", {"back_end.mode: must be one of loop_closure, localization"});
}

TEST(Parameters, ValuesOutOfRangeAreRefused) {
  ExpectComplaint("front_end: {grid: {resolution_m: 0}}", {"test:1: front_end.grid.resolution_m: must be > 0, is 0"});
  ExpectComplaint("front_end: {grid: {resolution_m: .nan}}", {"front_end.grid.resolution_m: must be > 0, is .nan"});
  ExpectComplaint("front_end: {grid: {resolution_m: .inf}}", {"front_end.grid.resolution_m: must be > 0, is .inf"});
  ExpectComplaint("front_end: {grid: {bits: [21, 21, 24]}}", {"front_end.grid.bits: must be >= 3, <= 23"});
  ExpectComplaint("back_end: {recognizer: {clique: {min_size: 2}}}",
                  {"back_end.recognizer.clique.min_size: must be >= 3"});
  ExpectComplaint("back_end: {refinement: {min_overlap: 1.01}}",
                  {"back_end.refinement.min_overlap: must be >= 0, <= 1"});
  ExpectComplaint("back_end: {refinement: {min_stiffness: 1}}", {"min_stiffness: must be > 0, < 1, is 1"});
}

TEST(Parameters, RelationsBetweenParametersAreChecked) {
  ExpectComplaint("front_end: {segmenter: {min_cluster_size: 20000}}", {"front_end.segmenter.max_cluster_size: "});
  ExpectComplaint("front_end: {segmenter: {growing_radius_m: 2}}", {"front_end.segmenter.growing_radius_m: "});
  ExpectComplaint("front_end: {ground: {min_range_m: 50}}", {"front_end.ground.max_range_m: "});
  ExpectComplaint("front_end: {ground: {model: elevation, max_slope: 0.5}}", {"front_end.ground.clearance_m: "});
  ExpectComplaint("front_end: {ground: {model: elevation, cell_size_m: 0.01}}", {"front_end.ground.cell_size_m: "});
  ExpectComplaint("front_end: {descriptor: {eigenvalues: false, sizes: false, orientation: false, context: false}}",
                  {"front_end.descriptor: "});
  ExpectComplaint("back_end: {matching: {nearest: 0}}", {"back_end.matching: "});
  ExpectComplaint("back_end: {recognizer: {max_tilt_rad: 0.2}}",
                  {"back_end.recognizer.consistency.max_vertical_slope: "});
  ExpectComplaint("back_end: {refinement: {min_distance_m: 2}}", {"back_end.refinement.max_distance_m: "});
  ExpectComplaint("back_end: {acceptance: {neighbourhood_m: 0.5}}", {"back_end.acceptance.neighbourhood_m: "});
}

TEST(Parameters, WhatIsNoYamlIsARuntimeError) {
  for (const char* yaml : {"front_end: [", "a: b: c", "--- {}\n--- {}", "\t- x: {"}) {
    try {
      ParseParameters(yaml, "some/file.yaml");
      ADD_FAILURE() << "accepted: " << yaml;
    } catch (const std::runtime_error& error) {
      EXPECT_NE(std::string(error.what()).find("some/file.yaml"), std::string::npos) << error.what();
    }
  }
}

TEST(Parameters, FilesThatCanNotBeReadAreNamed) {
  for (const std::string& path :
       {std::string("/nowhere/at/all.yaml"), std::filesystem::temp_directory_path().string()}) {
    try {
      LoadParameters(path);
      ADD_FAILURE() << "read " << path;
    } catch (const std::runtime_error& error) {
      EXPECT_NE(std::string(error.what()).find(path), std::string::npos) << error.what();
    }
  }
}

TEST(Parameters, AnEmptyFileGivesTheDefaults) {
  const std::string path = (std::filesystem::temp_directory_path() / "segmatch_empty_parameters.yaml").string();
  std::ofstream(path).close();
  EXPECT_EQ(ToYaml(LoadParameters(path)), ToYaml({}));
  std::remove(path.c_str());
}

// ---- Properties over the whole table --------------------------------------------------------------------------------

// A value near the default, now and then far off: what the type of the default's text allows.
std::string RandomValue(const std::string& text, std::mt19937& random) {
  std::uniform_real_distribution<double> uniform(0.0, 1.0);
  static const std::set<std::string> words{
      "none",  "height_threshold", "elevation", "invalidate",     "keep",           "true",
      "false", "loop_closure",     "all_pairs", "partitioned_2d", "partitioned_3d", "cached"};
  if (words.count(text) != 0 || text.front() == '[') return text;
  const double value = std::strtod(text.c_str(), nullptr);
  const bool is_whole = text.find_first_of(".e") == std::string::npos && std::abs(value) >= 1.0;
  const double factor = std::exp(3.0 * uniform(random) - 1.5) * (uniform(random) < 0.03 ? -1.0 : 1.0);
  char changed[40];
  if (is_whole) {
    std::snprintf(changed, sizeof changed, "%lld", static_cast<long long>(value * factor));
  } else {
    std::snprintf(changed, sizeof changed, "%.17g", value * factor);
  }
  return changed;
}

std::string RandomYaml(std::mt19937& random) {
  std::uniform_real_distribution<double> uniform(0.0, 1.0);
  std::stringstream lines(ToYaml({}));
  std::string yaml, line;
  while (std::getline(lines, line)) {
    const std::size_t colon = line.find(": ");
    if (colon != std::string::npos) {
      if (uniform(random) < 0.8) continue;
      line = line.substr(0, colon + 2) + RandomValue(line.substr(colon + 2), random);
    }
    yaml += line + "\n";
  }
  return yaml;
}

TEST(Parameters, YamlRoundTripsBitForBit) {
  int accepted = 0;
  for (unsigned seed = 0; seed < 400; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    std::mt19937 random(seed);
    Parameters p;
    try {
      p = ParseParameters(RandomYaml(random), "test");
    } catch (const std::invalid_argument&) {
      continue;
    }
    ++accepted;
    const Parameters q = ParseParameters(ToYaml(p), "test");
    EXPECT_EQ(ToYaml(p), ToYaml(q));
    EXPECT_EQ(p.front_end.grid.resolution_m, q.front_end.grid.resolution_m);
    EXPECT_EQ(p.back_end.recognizer.max_rms_m, q.back_end.recognizer.max_rms_m);
  }
  EXPECT_GT(accepted, 20);
}

// The parser refuses all that the classes refuse, so that a file that was read never fails later.
TEST(Parameters, TheClassesAcceptWhatPasses) {
  int accepted = 0;
  for (unsigned seed = 0; seed < 400; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    std::mt19937 random(seed);
    Parameters p;
    const std::string yaml = RandomYaml(random);
    try {
      p = ParseParameters(yaml, "test");
    } catch (const std::invalid_argument&) {
      continue;
    }
    ++accepted;
    EXPECT_NO_THROW(FrontEnd(p.front_end, "robot")) << yaml;
    EXPECT_NO_THROW(BackEnd(p.back_end, TargetMap(p.back_end.target_map))) << yaml;
  }
  EXPECT_GT(accepted, 20);
}

// How many members an aggregate has: the longest list of anything that initialises it.
struct Anything {
  template <class T>
  operator T() const;
};
template <class T, std::size_t... I>
auto CanInitialize(std::index_sequence<I...>) -> decltype(T{((void)I, Anything{})...}, std::true_type{});
template <class T>
std::false_type CanInitialize(...);
template <class T, std::size_t N = 0>
constexpr std::size_t CountMembers() {
  if constexpr (decltype(CanInitialize<T>(std::make_index_sequence<N + 1>{}))::value) {
    return CountMembers<T, N + 1>();
  } else {
    return N;
  }
}

TEST(Parameters, EveryMemberOfEveryStructIsInTheTable) {
  const auto entries = [](const std::string& section) {
    std::set<std::string> names;
    for (const std::string& key : ParameterKeys())
      if (key.rfind(section + '.', 0) == 0)
        names.insert(key.substr(section.size() + 1, key.find('.', section.size() + 1) - section.size() - 1));
    return names.size();
  };
  EXPECT_EQ(entries("front_end"), CountMembers<FrontEndParameters>());
  EXPECT_EQ(entries("front_end.ground"), CountMembers<GroundFilterParameters>());
  EXPECT_EQ(entries("front_end.grid"), CountMembers<DynamicVoxelGridParameters>());
  EXPECT_EQ(entries("front_end.segmenter"), CountMembers<SegmenterParameters>());
  EXPECT_EQ(entries("front_end.descriptor"), CountMembers<DescriptorParameters>());
  EXPECT_EQ(entries("front_end.view"), CountMembers<ViewParameters>());
  EXPECT_EQ(entries("back_end"), CountMembers<BackEndParameters>());
  EXPECT_EQ(entries("back_end.matching"), CountMembers<MatchingParameters>());
  EXPECT_EQ(entries("back_end.recognizer"), CountMembers<RecognizerParameters>());
  EXPECT_EQ(entries("back_end.recognizer.consistency"), CountMembers<ConsistencyParameters>());
  EXPECT_EQ(entries("back_end.recognizer.clique"), CountMembers<MaxCliqueParameters>());
  EXPECT_EQ(entries("back_end.history"), CountMembers<HistoryParameters>());
  EXPECT_EQ(entries("back_end.free_space"), CountMembers<FreeSpaceParameters>());
  EXPECT_EQ(entries("back_end.merging"), CountMembers<MergingParameters>());
  EXPECT_EQ(entries("back_end.forgetting"), CountMembers<ForgettingParameters>());
  EXPECT_EQ(entries("back_end.keyframes"), CountMembers<KeyframeParameters>());
  EXPECT_EQ(entries("front_end.thinning"), CountMembers<ScanThinningParameters>());
  EXPECT_EQ(entries("front_end.trails"), CountMembers<TrailParameters>());
  EXPECT_EQ(entries("back_end.refinement"), CountMembers<RefinementParameters>());
  EXPECT_EQ(entries("back_end.acceptance"), CountMembers<AcceptanceParameters>());
  EXPECT_EQ(entries("back_end.target_map"), CountMembers<TargetMapParameters>());
}

TEST(Parameters, KeysAreUnique) {
  const std::vector<std::string> keys = ParameterKeys();
  EXPECT_EQ(std::set<std::string>(keys.begin(), keys.end()).size(), keys.size());
}

// ---- What the repository ships --------------------------------------------------------------------------------------

TEST(Parameters, EveryShippedFileIsAccepted) {
  int files = 0;
  for (const auto& entry : std::filesystem::directory_iterator(std::string(SEGMATCH_SOURCE_DIR) + "/config")) {
    if (entry.path().extension() != ".yaml") continue;
    SCOPED_TRACE(entry.path().string());
    EXPECT_NO_THROW(LoadParameters(entry.path().string()));
    ++files;
  }
  EXPECT_GE(files, 2);
}

TEST(Parameters, KittiIsTheReleasedConfiguration) {
  const Parameters p = LoadParameters(std::string(SEGMATCH_SOURCE_DIR) + "/config/kitti.yaml");
  EXPECT_EQ(p.front_end.local_radius_m, 50.0);
  EXPECT_EQ(p.front_end.ground.model, GroundModel::kHeightThreshold);
  EXPECT_EQ(p.front_end.ground.min_height_m, -1.0);
  EXPECT_EQ(p.front_end.grid.resolution_m, 0.1);
  EXPECT_EQ(p.front_end.grid.min_points_per_voxel, 1);
  EXPECT_EQ(p.front_end.segmenter.growing_radius_m, 0.2);
  EXPECT_EQ(p.front_end.segmenter.min_cluster_size, 100u);
  EXPECT_EQ(p.front_end.segmenter.max_cluster_size, 15000u);
  EXPECT_EQ(p.back_end.matching.time_window_s, 60.0);
  EXPECT_EQ(p.back_end.recognizer.consistency.epsilon_m, 0.4);
  EXPECT_EQ(p.back_end.recognizer.clique.min_size, 6u);
}

TEST(Parameters, ThePageIsUpToDate) {
  const std::string path = std::string(SEGMATCH_SOURCE_DIR) + "/docs/parameters.md";
  if (std::getenv("SEGMATCH_WRITE_DOCS") != nullptr) std::ofstream(path, std::ios::binary) << ParametersAsMarkdown();
  EXPECT_TRUE(ReadText(path) == ParametersAsMarkdown())
      << path << " is out of date; renew it: SEGMATCH_WRITE_DOCS=1 parameters_test";
}

}  // namespace
}  // namespace incremental_segmatch
