#include "evaluation/scoring.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <map>
#include <random>
#include <set>
#include <sstream>

#include "evaluation/kitti_io.hpp"
#include "evaluation/trajectory_error.hpp"
#include "support/temporary_directory.hpp"

namespace incremental_segmatch {
namespace {

constexpr StampNs kPeriodNs = 100000000;

Pose PlanarPose(double x, double y, double yaw, double z = 0.0) {
  Pose T = Pose::Identity();
  T.translation() << x, y, z;
  T.linear() = Eigen::AngleAxisd(yaw, Eigen::Vector3d::UnitZ()).toRotationMatrix();
  return T;
}

using Drive = TrueTrajectory;

// Up and down one street, with turns of radius 3 m, so that it is revisited in both directions, and wandering sideways.
Drive RandomDrive(std::mt19937& random) {
  std::uniform_real_distribution<double> uniform(-1.0, 1.0);
  Drive drive;
  double x = 0.0, y = 0.0, heading = 0.0, wander = 0.0;
  for (int i = 0; i < 2400; ++i) {
    wander = 0.95 * wander + 0.05 * uniform(random);
    if (std::abs(x) > 120.0 && x * std::cos(heading) > 0.0) {
      heading += M_PI;
      y += 3.0 * uniform(random);
    }
    x += 0.6 * std::cos(heading);
    y += 0.2 * wander;
    drive.stamps_ns.push_back(i * kPeriodNs + (i * 7919 % 1000) * 1000);  // no two are 60 s apart to the nanosecond
    drive.T_world_sensor.push_back(PlanarPose(x, y, heading + 0.1 * wander, 0.3 * uniform(random)));
  }
  return drive;
}

// Targets are the drive's own older poses, or those of the map's drive.
std::vector<ClosureRow> RandomClosures(const Drive& drive, std::mt19937& random, const Drive* map_drive = nullptr) {
  const Drive& targets = map_drive ? *map_drive : drive;
  std::uniform_int_distribution<std::size_t> step(0, drive.stamps_ns.size() - 1);
  std::uniform_real_distribution<double> uniform(-1.0, 1.0);
  std::vector<ClosureRow> closures;
  for (int k = 0; k < 800; ++k) {
    std::size_t a = step(random), b = step(random);
    if (!map_drive && a < b) std::swap(a, b);
    ClosureRow row;
    row.stamp_query_ns = drive.stamps_ns[a] + static_cast<StampNs>(3e7 * uniform(random));
    row.stamp_target_ns = targets.stamps_ns[b] + static_cast<StampNs>(6e7 * uniform(random));
    row.robot_query = row.robot_target = "robot";
    row.T_target_query = targets.T_world_sensor[b].inverse() * drive.T_world_sensor[a] *
                         PlanarPose(uniform(random), 0.8 * uniform(random), 0.07 * uniform(random));
    if (k % 40 == 0) row.stamp_query_ns += 1000000000000;
    row.inliers = 7;
    row.candidates = 200;
    row.rms_m = 0.125;
    closures.push_back(row);
  }
  return closures;
}

// The definitions read literally: every pair of steps, no index.
std::map<std::string, double> SlowScore(const Drive& drive, const std::vector<ClosureRow>& closures,
                                        const Drive* map_drive = nullptr) {
  const Drive& targets = map_drive ? *map_drive : drive;
  const std::size_t n = drive.stamps_ns.size();
  std::vector<double> path(n, 0.0);
  for (std::size_t i = 1; i < n; ++i) {
    path[i] = path[i - 1] + (drive.T_world_sensor[i].translation() - drive.T_world_sensor[i - 1].translation()).norm();
  }
  const auto is_old = [&](std::size_t query, std::size_t target) {
    return map_drive != nullptr || (drive.stamps_ns[query] - drive.stamps_ns[target] > 60 * StampNs{1000000000} &&
                                    path[query] - path[target] > 50.0);
  };
  std::map<std::string, double> score;
  std::vector<int> revisit(n, 0);  // 1 in the same direction, -1 in the opposite one
  for (std::size_t i = 0; i < n; ++i) {
    double nearest = 5.0;
    for (std::size_t k = 0; k < (map_drive ? targets.stamps_ns.size() : i); ++k) {
      if (!is_old(i, k)) continue;
      const double distance = (drive.T_world_sensor[i].translation() - targets.T_world_sensor[k].translation()).norm();
      if (distance > nearest || (distance == nearest && revisit[i] != 0)) continue;
      nearest = distance;
      const Eigen::Vector3d ahead_i = drive.T_world_sensor[i].linear() * Eigen::Vector3d::UnitX();
      const Eigen::Vector3d ahead_k = targets.T_world_sensor[k].linear() * Eigen::Vector3d::UnitX();
      revisit[i] = ahead_i.dot(ahead_k) < 0 ? -1 : 1;
    }
    score["revisits"] += revisit[i] != 0;
    score["opposite"] += revisit[i] < 0;
  }
  const auto find = [](const Drive& where, StampNs stamp) {
    std::vector<StampNs> periods;
    int nearest = 0;
    for (std::size_t i = 0; i < where.stamps_ns.size(); ++i) {
      if (i > 0) periods.push_back(where.stamps_ns[i] - where.stamps_ns[i - 1]);
      if (std::abs(where.stamps_ns[i] - stamp) < std::abs(where.stamps_ns[nearest] - stamp))
        nearest = static_cast<int>(i);
    }
    std::sort(periods.begin(), periods.end());
    return 2 * std::abs(where.stamps_ns[nearest] - stamp) <= periods[periods.size() / 2] ? nearest : -1;
  };
  std::set<std::size_t> good;
  std::vector<double> errors_m, errors_deg;
  for (const ClosureRow& row : closures) {
    const int query = find(drive, row.stamp_query_ns), target = find(targets, row.stamp_target_ns);
    if (query < 0 || target < 0) {
      ++score["unmatched"];
    } else if (!is_old(query, target)) {
      ++score["trivial"];
    } else {
      const Pose T = targets.T_world_sensor[target].inverse() * drive.T_world_sensor[query];
      const double metres = (T.translation() - row.T_target_query.translation()).norm();
      const double degrees =
          Eigen::Quaterniond(T.linear()).angularDistance(Eigen::Quaterniond(row.T_target_query.linear())) * 180 / M_PI;
      if (metres < 1.0 && degrees < 3.0) {
        ++score["true"];
        good.insert(query);
        errors_m.push_back(metres);
        errors_deg.push_back(degrees);
      } else {
        ++score["false"];
      }
    }
  }
  double same = 0, opposite = 0;
  for (std::size_t i : good) {
    same += revisit[i] > 0;
    opposite += revisit[i] < 0;
  }
  score["recall"] = (same + opposite) / score["revisits"];
  score["recall_same"] = same / (score["revisits"] - score["opposite"]);
  score["recall_opposite"] = opposite / score["opposite"];
  std::vector<double> gaps;
  double last = 0;
  for (std::size_t i = 0; i < n; ++i) {
    if (revisit[i] == 0) continue;
    if (i == 0 || revisit[i - 1] == 0) last = path[i];
    if (good.count(i) > 0) {
      gaps.push_back(path[i] - last);
      last = path[i];
    }
    if (i + 1 == n || revisit[i + 1] == 0) gaps.push_back(path[i] - last);
  }
  const auto percentile = [](std::vector<double> v, double p) {
    std::sort(v.begin(), v.end());
    return v[std::min(v.size() - 1, static_cast<std::size_t>(p * v.size()))];
  };
  for (const auto& [name, p] : std::map<std::string, double>{{"50", 0.5}, {"90", 0.9}, {"99", 0.99}, {"max", 1.0}}) {
    score["gap_" + name] = percentile(gaps, p);
  }
  score["t_50"] = percentile(errors_m, 0.5);
  score["t_95"] = percentile(errors_m, 0.95);
  score["r_50"] = percentile(errors_deg, 0.5);
  score["r_95"] = percentile(errors_deg, 0.95);
  return score;
}

void ExpectEqual(const Score& score, std::map<std::string, double> slow) {
  EXPECT_EQ(score.revisits, slow["revisits"]);
  EXPECT_EQ(score.revisits_opposite, slow["opposite"]);
  EXPECT_EQ(score.unmatched_closures, slow["unmatched"]);
  EXPECT_EQ(score.trivial_closures, slow["trivial"]);
  EXPECT_EQ(score.true_closures, slow["true"]);
  EXPECT_EQ(score.false_closures, slow["false"]);
  EXPECT_EQ(score.closures, slow["true"] + slow["false"]);
  EXPECT_DOUBLE_EQ(score.recall, slow["recall"]);
  EXPECT_DOUBLE_EQ(score.recall_same_direction, slow["recall_same"]);
  EXPECT_DOUBLE_EQ(score.recall_opposite_direction, slow["recall_opposite"]);
  EXPECT_NEAR(score.gap_50_m, slow["gap_50"], 1e-9);
  EXPECT_NEAR(score.gap_90_m, slow["gap_90"], 1e-9);
  EXPECT_NEAR(score.gap_99_m, slow["gap_99"], 1e-9);
  EXPECT_NEAR(score.gap_max_m, slow["gap_max"], 1e-9);
  EXPECT_NEAR(score.translation_error_median_m, slow["t_50"], 1e-9);
  EXPECT_NEAR(score.translation_error_95_m, slow["t_95"], 1e-9);
  EXPECT_NEAR(score.rotation_error_median_deg, slow["r_50"], 1e-6);
  EXPECT_NEAR(score.rotation_error_95_deg, slow["r_95"], 1e-6);
}

TEST(Scoring, AgreesWithTheDefinitionsReadLiterally) {
  for (unsigned seed = 1; seed <= 4; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    std::mt19937 random(seed);
    const Drive drive = RandomDrive(random);
    const std::vector<ClosureRow> closures = RandomClosures(drive, random);
    std::map<std::string, double> slow = SlowScore(drive, closures);
    const Score score = ScoreClosures(drive, closures, {});
    EXPECT_EQ(score.steps, drive.stamps_ns.size());
    ExpectEqual(score, slow);
    EXPECT_GT(slow["revisits"], 500) << "the test must see every case";
    EXPECT_GT(slow["opposite"], 100);
    EXPECT_GT(slow["unmatched"], 10);
    EXPECT_GT(slow["trivial"], 50);
    EXPECT_GT(slow["true"], 50);
    EXPECT_GT(slow["false"], 50);
  }
}

TEST(Scoring, OfLocalizationsAgreesWithTheDefinitionsReadLiterally) {
  for (unsigned seed = 5; seed <= 8; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    std::mt19937 random(seed);
    const Drive drive = RandomDrive(random);
    Drive map_drive = RandomDrive(random);
    // Another clock, and only part of the street.
    for (StampNs& stamp_ns : map_drive.stamps_ns) stamp_ns += 5000000000;
    for (Pose& pose : map_drive.T_world_sensor) pose.translation().x() *= 0.6;
    const std::vector<ClosureRow> closures = RandomClosures(drive, random, &map_drive);
    std::map<std::string, double> slow = SlowScore(drive, closures, &map_drive);
    ExpectEqual(ScoreLocalizations(drive, map_drive, closures, {}), slow);
    EXPECT_GT(slow["revisits"], 500) << "the test must see every case";
    EXPECT_LT(slow["revisits"], 2300);
    EXPECT_GT(slow["opposite"], 100);
    EXPECT_GT(slow["unmatched"], 10);
    EXPECT_EQ(slow["trivial"], 0);
    EXPECT_GT(slow["true"], 50);
    EXPECT_GT(slow["false"], 50);
  }
}

// What a drive's truth looks like in KITTI's layout.
void WriteTruth(const Drive& drive, const std::string& sequence, const test::TemporaryDirectory& directory) {
  const Pose T_camera_sensor = [] {
    Pose T = PlanarPose(0.1, -0.2, 0.0, 0.3);
    T.linear() << 0, -1, 0, 0, 0, -1, 1, 0, 0;
    return T;
  }();
  const auto write_row = [](std::ostream& out, const Pose& T) {
    out.precision(12);
    for (int k = 0; k < 12; ++k) out << (k > 0 ? " " : "") << T.matrix()(k / 4, k % 4);
    out << '\n';
  };
  directory.MakeFolder("sequences/" + sequence);
  directory.MakeFolder("poses");
  std::ofstream calibration(directory.path() + "/sequences/" + sequence + "/calib.txt");
  calibration << "Tr: ";
  write_row(calibration, T_camera_sensor);
  std::ofstream times(directory.path() + "/sequences/" + sequence + "/times.txt");
  std::ofstream poses(directory.path() + "/poses/" + sequence + ".txt");
  for (std::size_t i = 0; i < drive.stamps_ns.size(); ++i) {
    char seconds[32];
    std::snprintf(seconds, sizeof seconds, "%.9f\n", static_cast<double>(drive.stamps_ns[i]) / 1e9);
    times << seconds;
    write_row(poses, T_camera_sensor * drive.T_world_sensor[i] * T_camera_sensor.inverse());
  }
}

TEST(Scoring, AgreesWithAnotherChecker) {
  const char* checker = std::getenv("SEGMATCH_CHECKER");
  if (checker == nullptr) GTEST_SKIP() << "SEGMATCH_CHECKER does not name a checker program";
  for (const bool in_a_map : {false, true}) {
    SCOPED_TRACE(in_a_map ? "localization" : "loop closure");
    const test::TemporaryDirectory directory;
    std::mt19937 random(11);
    const Drive drive = RandomDrive(random), map_drive = RandomDrive(random);
    const std::vector<ClosureRow> closures = RandomClosures(drive, random, in_a_map ? &map_drive : nullptr);
    WriteTruth(drive, "00", directory);
    WriteTruth(map_drive, "01", directory);
    WriteClosuresCsv(closures, directory.path() + "/closures.csv");

    std::string command = std::string("python3 ") + checker + " " + directory.path() + " 00 " + directory.path() +
                          "/closures.csv 2>/dev/null";
    if (in_a_map) command += " --target-root " + directory.path() + " --target-sequence 01";
    FILE* pipe = popen(command.c_str(), "r");
    ASSERT_NE(pipe, nullptr);
    std::string output;
    char buffer[512];
    while (std::fgets(buffer, sizeof buffer, pipe) != nullptr) output += buffer;
    pclose(pipe);
    std::map<std::string, double> theirs;
    std::istringstream words(output);
    for (std::string word; words >> word;) {
      const std::size_t equals = word.find('=');
      ASSERT_NE(equals, std::string::npos) << output;
      theirs[word.substr(0, equals)] = std::stod(word.substr(equals + 1));
    }
    const Score score =
        in_a_map ? ScoreLocalizations(drive, map_drive, closures, {}) : ScoreClosures(drive, closures, {});
    EXPECT_EQ(score.steps, theirs["steps"]);
    EXPECT_EQ(score.revisits, theirs["revisits"]);
    EXPECT_EQ(score.revisits_opposite, theirs["opposite"]);
    EXPECT_EQ(score.true_closures, theirs["tp"]);
    EXPECT_EQ(score.false_closures, theirs["fp"]);
    EXPECT_EQ(score.trivial_closures, theirs["trivial"]);
    EXPECT_EQ(score.unmatched_closures, theirs["bad"]);
    EXPECT_NEAR(score.precision, theirs["precision"], 1e-4);
    EXPECT_NEAR(score.recall, theirs["recall"], 1e-4);
    EXPECT_NEAR(score.recall_opposite_direction, theirs["recall_opposite"], 1e-4);
    EXPECT_NEAR(score.gap_50_m, theirs["gap_50"], 0.051);
    EXPECT_NEAR(score.gap_90_m, theirs["gap_90"], 0.051);
    EXPECT_NEAR(score.gap_99_m, theirs["gap_99"], 0.051);
    EXPECT_NEAR(score.gap_max_m, theirs["gap_max"], 0.051);
    EXPECT_NEAR(score.translation_error_median_m, theirs["t_med"], 1e-3);
    EXPECT_NEAR(score.translation_error_95_m, theirs["t_95"], 1e-3);
    EXPECT_NEAR(score.rotation_error_median_deg, theirs["r_med"], 1e-3);
    EXPECT_NEAR(score.rotation_error_95_deg, theirs["r_95"], 1e-3);
  }
}

TEST(Scoring, NothingGivesNaNNotPerfection) {
  const Score score = ScoreClosures({{0, kPeriodNs}, {Pose::Identity(), Pose::Identity()}}, {}, {});
  EXPECT_TRUE(std::isnan(score.precision));
  EXPECT_TRUE(std::isnan(score.recall));
  EXPECT_TRUE(std::isnan(score.gap_max_m));
  EXPECT_EQ(score.places, 0u);
  EXPECT_THROW(ScoreClosures({{0}, {}}, {}, {}), std::invalid_argument);
}

TEST(Scoring, PlacesAreStretchesWithATrueClosure) {
  // Out and back on a line, then out again: one stretch against the way out, one along it.
  Drive drive;
  for (int i = 0; i < 3000; ++i) {
    const int phase = i % 2000;
    const bool back = phase >= 1000;
    const double along = back ? 2000 - phase : phase;
    drive.stamps_ns.push_back(i * kPeriodNs);
    drive.T_world_sensor.push_back(PlanarPose(0.2 * along, 0, back ? M_PI : 0));
  }
  const auto closure = [&](std::size_t target, std::size_t query) {
    ClosureRow row;
    row.stamp_query_ns = drive.stamps_ns[query];
    row.stamp_target_ns = drive.stamps_ns[target];
    row.T_target_query = drive.T_world_sensor[target].inverse() * drive.T_world_sensor[query];
    return row;
  };
  Score score = ScoreClosures(drive, {closure(300, 1700)}, {});
  EXPECT_EQ(score.places, 1u);
  EXPECT_EQ(score.places_opposite, 1u);
  EXPECT_EQ(score.true_closures, 1u);
}

// Errors drawn from a covariance that is stated truly, and from the same one stated too small.
TEST(Scoring, TellsHonestCovariancesFromOptimisticOnes) {
  Drive drive;
  for (int i = 0; i < 2000; ++i) {
    drive.stamps_ns.push_back(i * kPeriodNs);
    drive.T_world_sensor.push_back(PlanarPose(0.2 * (i % 1000), 0, 0));
  }
  std::mt19937 random(1);
  std::normal_distribution<double> normal;
  Covariance6 factor = Covariance6::Zero();
  for (int row = 0; row < 6; ++row)
    for (int column = 0; column <= row; ++column) factor(row, column) = (row < 3 ? 0.02 : 0.001) * normal(random);
  const Covariance6 covariance = factor * factor.transpose();
  std::vector<ClosureRow> closures;
  for (int i = 0; i < 4000; ++i) {
    Eigen::Matrix<double, 6, 1> xi;
    for (int k = 0; k < 6; ++k) xi[k] = normal(random);
    xi = factor * xi;
    Pose error = Pose::Identity();
    error.translation() = xi.head<3>();
    error.linear() = Eigen::AngleAxisd(xi.tail<3>().norm(), xi.tail<3>().normalized()).toRotationMatrix();
    ClosureRow row;
    row.stamp_query_ns = drive.stamps_ns[1000 + i % 1000];
    row.stamp_target_ns = drive.stamps_ns[i % 1000];
    row.T_target_query = error;
    row.covariance = covariance;
    closures.push_back(row);
  }
  Score score = ScoreClosures(drive, closures, {});
  ASSERT_EQ(score.true_closures, closures.size());
  EXPECT_NEAR(score.normalized_error2_median, 5.35, 0.3);
  EXPECT_NEAR(score.normalized_error2_within_95, 0.95, 0.02);
  for (ClosureRow& row : closures) row.covariance = 0.25 * covariance;
  EXPECT_LT(ScoreClosures(drive, closures, {}).normalized_error2_within_95, 0.5);
  for (ClosureRow& row : closures) row.covariance.reset();
  EXPECT_TRUE(std::isnan(ScoreClosures(drive, closures, {}).normalized_error2_median));
}

TEST(TrajectoryError, IsTheResidualAfterAlignment) {
  std::mt19937 random(5);
  std::uniform_real_distribution<double> uniform(-50.0, 50.0);
  std::vector<Pose> truth, moved;
  const Pose T = PlanarPose(1000, -300, 2.0, 40.0);
  for (int i = 0; i < 100; ++i) {
    truth.push_back(PlanarPose(uniform(random), uniform(random), 0, uniform(random)));
    moved.push_back(T * truth.back());
  }
  EXPECT_NEAR(AbsoluteTrajectoryError(moved, truth), 0.0, 1e-9);
  // Opposite errors cancel in the alignment: a symmetric pair of points, stretched by 1 m at each end.
  const std::vector<Pose> pair{PlanarPose(-10, 0, 0), PlanarPose(10, 0, 0)};
  const std::vector<Pose> stretched{PlanarPose(-11, 0, 0), PlanarPose(11, 0, 0)};
  EXPECT_NEAR(AbsoluteTrajectoryError(stretched, pair), 1.0, 1e-9);
  EXPECT_THROW(AbsoluteTrajectoryError(pair, truth), std::invalid_argument);
  EXPECT_TRUE(std::isnan(AbsoluteTrajectoryError({}, {})));
}

TEST(TrajectoryError, TrueClosuresBoundTheError) {
  std::mt19937 random(9);
  std::normal_distribution<double> noise(0.0, 1.0);
  std::vector<StampNs> stamps;
  std::vector<Pose> truth, odometry;
  for (int i = 0; i < 400; ++i) {
    const double angle = 2 * M_PI * i / 200;
    stamps.push_back(i * kPeriodNs);
    truth.push_back(PlanarPose(60 * std::sin(angle), 60 - 60 * std::cos(angle), angle));
    odometry.push_back(i == 0 ? truth[0]
                              : odometry.back() * (truth[i - 1].inverse() * truth[i]) *
                                    PlanarPose(0.02 * noise(random), 0.02 * noise(random), 3e-4));
  }
  std::vector<GraphClosure> closures;
  for (std::size_t i = 200; i < 400; i += 20) closures.push_back({i - 200, i, Covariance6::Zero()});
  const double before = AbsoluteTrajectoryError(odometry, truth);
  const double after =
      AbsoluteTrajectoryError(PosesOf(OptimizeWithTrueClosures(stamps, odometry, truth, closures, {})), truth);
  EXPECT_GT(before, 1.0);
  EXPECT_LT(after, 0.6 * before);
}

}  // namespace
}  // namespace incremental_segmatch
