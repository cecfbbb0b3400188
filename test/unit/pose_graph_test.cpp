#include "incremental_segmatch/pose_graph.hpp"

#include <gtest/gtest.h>

#include <chrono>
#include <cmath>
#include <cstdio>
#include <fstream>
#include <limits>
#include <random>
#include <sstream>
#include <stdexcept>

#include "incremental_segmatch/pose_graph_io.hpp"

namespace incremental_segmatch {
namespace {

constexpr StampNs kPeriodNs = 100000000;

Pose MakePose(double x, double y, double z, double yaw, double pitch = 0.0) {
  Pose T = Pose::Identity();
  T.translation() << x, y, z;
  T.linear() = (Eigen::AngleAxisd(yaw, Eigen::Vector3d::UnitZ()) * Eigen::AngleAxisd(pitch, Eigen::Vector3d::UnitY()))
                   .toRotationMatrix();
  return T;
}

// Two laps on a circle of 80 m radius with some up and down, starting at the identity.
std::vector<Pose> Laps(int nodes_per_lap, int laps = 2) {
  std::vector<Pose> truth;
  const auto at = [&](int i) {
    const double angle = 2.0 * M_PI * i / nodes_per_lap;
    return MakePose(80.0 * std::sin(angle), 80.0 * (1.0 - std::cos(angle)), 2.0 * std::sin(3.0 * angle), angle);
  };
  const Pose T_first_world = at(0).inverse();
  for (int i = 0; i < laps * nodes_per_lap; ++i) truth.push_back(T_first_world * at(i));
  return truth;
}

// Odometry that measures every step with noise and a bias of heading.
std::vector<Pose> Drift(const std::vector<Pose>& truth, std::mt19937& random, double yaw_bias_rad = 2e-4) {
  std::normal_distribution<double> noise(0.0, 1.0);
  std::vector<Pose> odometry{truth.front()};
  for (std::size_t i = 1; i < truth.size(); ++i) {
    const Pose error = MakePose(0.01 * noise(random), 0.01 * noise(random), 0.01 * noise(random),
                                yaw_bias_rad + 5e-4 * noise(random), 2e-4 * noise(random));
    odometry.push_back(odometry.back() * (truth[i - 1].inverse() * truth[i]) * error);
  }
  return odometry;
}

void AddTrack(PoseGraph& graph, RobotIndex robot, const std::vector<Pose>& odometry) {
  for (std::size_t i = 0; i < odometry.size(); ++i)
    graph.AddNode(robot, static_cast<StampNs>(i) * kPeriodNs, odometry[i]);
}

bool AddTrueClosure(PoseGraph& graph, const std::vector<Pose>& truth, std::size_t target, std::size_t query,
                    const Covariance6& covariance = 1e-4 * Covariance6::Identity()) {
  return graph.AddClosure(0, static_cast<StampNs>(target) * kPeriodNs, 0, static_cast<StampNs>(query) * kPeriodNs,
                          truth[target].inverse() * truth[query], covariance);
}

double WorstError(const std::vector<StampedPose>& trajectory, const std::vector<Pose>& truth) {
  double worst = 0.0;
  for (std::size_t i = 0; i < truth.size(); ++i) {
    worst = std::max(worst, (trajectory[i].T_frame_sensor.translation() - truth[i].translation()).norm());
  }
  return worst;
}

TEST(PoseGraph, WithoutClosuresTheOdometryStays) {
  std::mt19937 random(1);
  const std::vector<Pose> odometry = Drift(Laps(50), random);
  PoseGraph graph({});
  AddTrack(graph, 0, odometry);
  const PoseGraphReport report = graph.Optimize();
  EXPECT_EQ(report.nodes, 100u);
  EXPECT_LT(WorstError(graph.Trajectory(0), odometry), 1e-12);
  EXPECT_TRUE(graph.T_map_odom(0).isApprox(Pose::Identity()));
}

TEST(PoseGraph, ConsistentMeasurementsAreReproducedExactly) {
  const std::vector<Pose> truth = Laps(60);
  PoseGraph graph({});
  AddTrack(graph, 0, truth);
  for (std::size_t i = 60; i < 120; i += 7) ASSERT_TRUE(AddTrueClosure(graph, truth, i - 60, i));
  graph.Optimize();
  EXPECT_LT(WorstError(graph.Trajectory(0), truth), 1e-8);
}

TEST(PoseGraph, ClosuresRemoveDrift) {
  for (unsigned seed = 1; seed <= 5; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    std::mt19937 random(seed);
    const std::vector<Pose> truth = Laps(150);
    const std::vector<Pose> odometry = Drift(truth, random);
    PoseGraph graph({});
    AddTrack(graph, 0, odometry);
    const double before = WorstError(graph.Trajectory(0), truth);
    for (std::size_t i = 150; i < 300; i += 10) ASSERT_TRUE(AddTrueClosure(graph, truth, i - 150, i));
    const PoseGraphReport report = graph.Optimize();
    const double after = WorstError(graph.Trajectory(0), truth);
    EXPECT_EQ(report.closures, 15u);
    EXPECT_EQ(report.outvoted_closures, 0u);
    EXPECT_TRUE(report.converged);
    EXPECT_GT(before, 4.0);
    EXPECT_LT(after, 0.4 * before);
  }
}

TEST(PoseGraph, OneClosureAgainstMuchDriftIsBelieved) {
  std::mt19937 random(7);
  const std::vector<Pose> truth = Laps(300, 2);
  const std::vector<Pose> odometry = Drift(truth, random, 1e-3);
  PoseGraph graph({});
  AddTrack(graph, 0, odometry);
  ASSERT_GT((odometry[299].translation() - truth[299].translation()).norm(), 20.0);
  ASSERT_TRUE(AddTrueClosure(graph, truth, 0, 299));
  graph.Optimize();
  const std::vector<StampedPose> corrected = graph.Trajectory(0);
  EXPECT_LT((corrected[299].T_frame_sensor.translation() - truth[299].translation()).norm(), 0.5);
}

TEST(PoseGraph, AFalseClosureIsOutvoted) {
  for (const bool false_one_first : {true, false}) {
    SCOPED_TRACE(false_one_first ? "false closure first" : "false closure last");
    std::mt19937 random(3);
    const std::vector<Pose> truth = Laps(150);
    PoseGraph graph({});
    AddTrack(graph, 0, Drift(truth, random));
    PoseGraph clean({});
    random.seed(3);
    AddTrack(clean, 0, Drift(truth, random));
    const auto add_false = [&] {
      ASSERT_TRUE(
          graph.AddClosure(0, 10 * kPeriodNs, 0, 225 * kPeriodNs, Pose::Identity(), 1e-4 * Covariance6::Identity()));
      graph.Optimize();
    };
    if (false_one_first) add_false();
    for (std::size_t i = 150; i < 300; i += 10) {
      ASSERT_TRUE(AddTrueClosure(graph, truth, i - 150, i));
      ASSERT_TRUE(AddTrueClosure(clean, truth, i - 150, i));
    }
    graph.Optimize();
    clean.Optimize();
    if (!false_one_first) add_false();
    const PoseGraphReport report = graph.Optimize();
    EXPECT_EQ(report.outvoted_closures, 1u);
    EXPECT_LT(WorstError(graph.Trajectory(0), truth), WorstError(clean.Trajectory(0), truth) + 0.2);
  }
}

TEST(PoseGraph, NewNodesFollowTheCorrection) {
  std::mt19937 random(4);
  const std::vector<Pose> truth = Laps(100);
  const std::vector<Pose> odometry = Drift(truth, random);
  PoseGraph graph({});
  AddTrack(graph, 0, std::vector<Pose>(odometry.begin(), odometry.begin() + 150));
  ASSERT_TRUE(AddTrueClosure(graph, truth, 49, 149));
  graph.Optimize();
  const Pose T_map_odom = graph.T_map_odom(0);
  EXPECT_FALSE(T_map_odom.isApprox(Pose::Identity(), 1e-6));
  graph.AddNode(0, 150 * kPeriodNs, odometry[150]);
  EXPECT_TRUE(graph.T_map_odom(0).isApprox(T_map_odom, 1e-9));
  EXPECT_TRUE(graph.Trajectory(0).back().T_frame_sensor.isApprox(T_map_odom * odometry[150], 1e-9));
}

TEST(PoseGraph, FirstClosureAlignsTwoRobots) {
  const std::vector<Pose> truth = Laps(60);
  const Pose T_world_odom1 = MakePose(300.0, -40.0, 2.0, 2.5);
  for (const bool earlier_robot_is_target : {true, false}) {
    PoseGraph graph({});
    AddTrack(graph, 5, truth);  // indices need not be in order: the robot that came first keeps its map
    std::vector<Pose> in_odom1;
    for (const Pose& T : truth) in_odom1.push_back(T_world_odom1.inverse() * T);
    AddTrack(graph, 2, in_odom1);
    EXPECT_FALSE(graph.AreConnected(2, 5));
    EXPECT_LT(WorstError(graph.Trajectory(2), in_odom1), 1e-12);
    const Pose T_10_70 = truth[10].inverse() * truth[70];
    const Covariance6 covariance = 1e-4 * Covariance6::Identity();
    ASSERT_TRUE(earlier_robot_is_target ? graph.AddClosure(5, 10 * kPeriodNs, 2, 70 * kPeriodNs, T_10_70, covariance)
                                        : graph.AddClosure(2, 10 * kPeriodNs, 5, 70 * kPeriodNs, T_10_70, covariance));
    EXPECT_TRUE(graph.AreConnected(2, 5));
    EXPECT_LT(WorstError(graph.Trajectory(2), truth), 1e-6) << "aligned before any optimization";
    graph.Optimize();
    EXPECT_LT(WorstError(graph.Trajectory(2), truth), 1e-6);
    EXPECT_LT(WorstError(graph.Trajectory(5), truth), 1e-6);
    EXPECT_TRUE(graph.T_map_odom(2).isApprox(T_world_odom1, 1e-6));
  }
}

TEST(PoseGraph, AFalseFirstClosureBetweenRobotsIsUndone) {
  const std::vector<Pose> truth = Laps(60);
  PoseGraph graph({});
  AddTrack(graph, 0, truth);
  AddTrack(graph, 1, truth);
  const Covariance6 covariance = 1e-4 * Covariance6::Identity();
  ASSERT_TRUE(graph.AddClosure(0, 0, 1, 20 * kPeriodNs, MakePose(90.0, 5.0, 0.0, 1.0), covariance));
  graph.Optimize();
  EXPECT_GT(WorstError(graph.Trajectory(1), truth), 10.0);
  for (int i = 5; i < 60; i += 10) {
    ASSERT_TRUE(
        graph.AddClosure(0, i * kPeriodNs, 1, (i + 3) * kPeriodNs, truth[i].inverse() * truth[i + 3], covariance));
  }
  graph.Optimize();
  EXPECT_LT(WorstError(graph.Trajectory(1), truth), 0.2);
}

TEST(PoseGraph, ThreeRobotsMeetInAnyOrder) {
  const std::vector<Pose> truth = Laps(40);
  PoseGraph graph({});
  std::vector<Pose> odometry[3];
  for (RobotIndex robot = 0; robot < 3; ++robot) {
    const Pose T_odom_world = MakePose(50.0 * robot, 10.0, 0.0, 0.7 * robot);
    for (const Pose& T : truth) odometry[robot].push_back(T_odom_world * T);
    AddTrack(graph, robot, odometry[robot]);
  }
  const Covariance6 covariance = 1e-4 * Covariance6::Identity();
  const auto meet = [&](RobotIndex target, RobotIndex query) {
    ASSERT_TRUE(
        graph.AddClosure(target, 12 * kPeriodNs, query, 52 * kPeriodNs, truth[12].inverse() * truth[52], covariance));
  };
  meet(2, 1);
  graph.Optimize();
  EXPECT_TRUE(graph.AreConnected(1, 2));
  EXPECT_FALSE(graph.AreConnected(0, 2));
  EXPECT_LT(WorstError(graph.Trajectory(2), odometry[1]), 1e-6);
  meet(2, 0);
  graph.Optimize();
  for (RobotIndex robot = 0; robot < 3; ++robot) EXPECT_LT(WorstError(graph.Trajectory(robot), odometry[0]), 1e-6);
}

TEST(PoseGraph, ClosuresTakeTheNearestNodeWithinHalfASpacing) {
  const std::vector<Pose> truth = Laps(60);
  PoseGraph graph({});
  AddTrack(graph, 0, truth);
  const Covariance6 covariance = Covariance6::Identity();
  const auto add = [&](StampNs target, StampNs query) {
    return graph.AddClosure(0, target, 0, query, Pose::Identity(), covariance);
  };
  EXPECT_TRUE(add(0, 70 * kPeriodNs + 40000000));
  EXPECT_EQ(graph.Edges().back().to, 70u);
  EXPECT_TRUE(add(0, 70 * kPeriodNs + 60000000));
  EXPECT_EQ(graph.Edges().back().to, 71u);
  EXPECT_TRUE(add(-40000000, 119 * kPeriodNs + 40000000));
  EXPECT_FALSE(add(-60000000, 119 * kPeriodNs)) << "before the first node";
  EXPECT_FALSE(add(0, 119 * kPeriodNs + 60000000)) << "after the last node";
  EXPECT_FALSE(add(70 * kPeriodNs, 70 * kPeriodNs)) << "a node with itself";
  EXPECT_FALSE(graph.AddClosure(0, 0, 9, 0, Pose::Identity(), covariance)) << "unknown robot";
  EXPECT_EQ(graph.closures(), 3u);
}

TEST(PoseGraph, CovarianceWeighsDirectionsInTheQueryFrame) {
  // Two nodes, turned by 90 degrees; two closures disagree, one sure along the query's x axis, one along its y axis.
  PoseGraphParameters parameters;
  parameters.odometry_sigma_m = 100.0;
  parameters.odometry_sigma_rad = 0.001;
  parameters.robust_width = 1e6;
  PoseGraph graph(parameters);
  graph.AddNode(0, 0, Pose::Identity());
  graph.AddNode(0, kPeriodNs, MakePose(0, 0, 0, M_PI / 2));
  Covariance6 sure_x = 1e-4 * Covariance6::Identity();
  sure_x(1, 1) = 1e4;
  Covariance6 sure_y = 1e-4 * Covariance6::Identity();
  sure_y(0, 0) = 1e4;
  ASSERT_TRUE(graph.AddClosure(0, 0, 0, kPeriodNs, MakePose(1, 1, 0, M_PI / 2), sure_x));
  ASSERT_TRUE(graph.AddClosure(0, 0, 0, kPeriodNs, MakePose(2, 2, 0, M_PI / 2), sure_y));
  graph.Optimize();
  const Eigen::Vector3d position = graph.Trajectory(0).back().T_frame_sensor.translation();
  EXPECT_NEAR(position.y(), 1.0, 1e-3) << "the query's x axis is the world's y axis";
  EXPECT_NEAR(position.x(), 2.0, 1e-3);
}

TEST(PoseGraph, BadInputIsRefused) {
  PoseGraphParameters bad;
  bad.odometry_sigma_m = 0.0;
  EXPECT_THROW(PoseGraph{bad}, std::invalid_argument);
  PoseGraph graph({});
  EXPECT_THROW(graph.T_map_odom(0), std::invalid_argument);
  EXPECT_TRUE(graph.Trajectory(0).empty());
  EXPECT_FALSE(graph.AddClosure(0, 0, 0, 1, Pose::Identity(), Covariance6::Identity()));
  graph.AddNode(0, 10, Pose::Identity());
  EXPECT_THROW(graph.AddNode(0, 10, Pose::Identity()), std::invalid_argument);
  EXPECT_THROW(graph.AddNode(0, 9, Pose::Identity()), std::invalid_argument);
  Pose broken = Pose::Identity();
  broken.translation().x() = std::numeric_limits<double>::quiet_NaN();
  EXPECT_THROW(graph.AddNode(0, 11, broken), std::invalid_argument);
  graph.AddNode(0, 20, Pose::Identity());
  EXPECT_THROW(graph.AddClosure(0, 10, 0, 20, broken, Covariance6::Identity()), std::invalid_argument);
  EXPECT_THROW(graph.AddClosure(0, 10, 0, 20, Pose::Identity(), -Covariance6::Identity()), std::invalid_argument);
  EXPECT_TRUE(graph.AddClosure(0, 10, 0, 20, Pose::Identity(), Covariance6::Zero())) << "floors make it definite";
  EXPECT_NO_THROW(graph.Optimize());
}

TEST(PoseGraph, LongDriveIsFast) {
  std::mt19937 random(6);
  const std::vector<Pose> truth = Laps(700);
  PoseGraph graph({});
  AddTrack(graph, 0, Drift(truth, random));
  for (std::size_t i = 700; i < 1400; i += 3) ASSERT_TRUE(AddTrueClosure(graph, truth, i - 700, i));
  const auto start = std::chrono::steady_clock::now();
  graph.Optimize();
  const double seconds = std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
  RecordProperty("seconds", std::to_string(seconds));
  std::printf("1400 nodes, %zu closures: %.3f s\n", graph.closures(), seconds);
  EXPECT_LT(seconds, 5.0) << "well under a second in a quiet release build";
}

TEST(PoseGraphIo, WritesWhatOtherProgramsRead) {
  PoseGraph graph({});
  graph.AddNode(0, 1500000000, Pose::Identity());
  graph.AddNode(0, 1600000001, MakePose(1, 2, 3, M_PI));
  graph.AddNode(1, 0, Pose::Identity());
  ASSERT_TRUE(graph.AddClosure(0, 1500000000, 0, 1600000001, MakePose(1, 2, 3, M_PI), Covariance6::Identity()));
  const std::string path = testing::TempDir() + "pose_graph_test.txt";
  WriteTum(graph.Trajectory(0), path);
  std::ifstream tum(path);
  std::string line;
  std::getline(tum, line);
  EXPECT_EQ(line, "1.500000000 0 0 0 0 0 0 1");
  std::getline(tum, line);
  EXPECT_EQ(line.substr(0, 17), "1.600000001 1 2 3");
  WriteG2o(graph, path);
  std::ifstream g2o(path);
  int vertices = 0, fixed = 0, edges = 0;
  std::string last;
  while (std::getline(g2o, line)) {
    vertices += line.rfind("VERTEX_SE3:QUAT ", 0) == 0;
    fixed += line.rfind("FIX ", 0) == 0;
    edges += line.rfind("EDGE_SE3:QUAT ", 0) == 0;
    last = line;
  }
  EXPECT_EQ(vertices, 3);
  EXPECT_EQ(fixed, 2) << "one for each map";
  EXPECT_EQ(edges, 2);
  std::istringstream fields(last);
  std::string tag;
  fields >> tag;
  std::vector<double> numbers;
  for (double number; fields >> number;) numbers.push_back(number);
  ASSERT_EQ(numbers.size(), 2u + 7u + 21u);
  EXPECT_NEAR(numbers[9], 1.0 / (1.0 + 0.0025), 1e-9);
  EXPECT_NEAR(numbers.back(), 4.0 / (1.0 + 0.000025), 1e-9) << "rotations as the quaternion's imaginary part";
  EXPECT_THROW(WriteTum({}, "/nonexistent_folder/x.tum"), std::runtime_error);
  EXPECT_EQ(FormatSeconds(-1), "-0.000000001");
}

}  // namespace
}  // namespace incremental_segmatch
