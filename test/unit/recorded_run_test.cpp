#include "evaluation/recorded_run.hpp"

#include <gtest/gtest.h>

#include <random>

#include "incremental_segmatch/pose_graph_io.hpp"
#include "support/temporary_directory.hpp"

namespace incremental_segmatch {
namespace {

constexpr StampNs kEpochNs = 1'317'000'000'123'456'789;

Pose MakePose(double x, double y, double yaw_rad) {
  Pose T = Pose::Identity();
  T.translation() << x, y, 0.1 * x;
  T.linear() = Eigen::AngleAxisd(yaw_rad, Eigen::Vector3d::UnitZ()).toRotationMatrix();
  return T;
}

// Twice around a circle; the odometry drifts.
struct Circles {
  std::vector<StampNs> stamps_ns;
  std::vector<Pose> truth;
  std::vector<StampedPose> odometry;

  Circles() {
    Pose T_odom_sensor = Pose::Identity();
    for (int i = 0; i < 80; ++i) {
      const double angle = 2.0 * M_PI * i / 40.0;
      const Pose T_world_sensor = MakePose(20.0 * std::sin(angle), 20.0 - 20.0 * std::cos(angle), angle);
      if (i > 0) T_odom_sensor = T_odom_sensor * truth.back().inverse() * T_world_sensor * MakePose(0.02, 0.0, 0.004);
      stamps_ns.push_back(kEpochNs + 100'000'000LL * i);
      truth.push_back(T_world_sensor);
      odometry.push_back({stamps_ns.back(), T_odom_sensor});
    }
  }
};

Covariance6 RandomCovariance(std::mt19937& random) {
  std::normal_distribution<double> normal;
  Covariance6 root;
  for (int i = 0; i < root.size(); ++i) root(i) = 0.02 * normal(random);
  return root * root.transpose() + 1e-4 * Covariance6::Identity();
}

class RecordedRunTest : public ::testing::Test {
 protected:
  // A run with closures between the rounds that are off by 10 cm.
  RecordedRunTest() {
    std::mt19937 random(7);
    PoseGraph graph({});
    for (const StampedPose& pose : drive_.odometry) graph.AddNode(0, pose.stamp_ns, pose.T_frame_sensor);
    for (std::size_t i = 45; i < 80; i += 10) {
      const Pose T_target_query = drive_.truth[i - 40].inverse() * drive_.truth[i] * MakePose(0.1, 0.0, 0.0);
      const Covariance6 covariance = RandomCovariance(random);
      EXPECT_TRUE(graph.AddClosure(0, drive_.stamps_ns[i - 40], 0, drive_.stamps_ns[i], T_target_query, covariance));
      rows_.push_back({drive_.stamps_ns[i], drive_.stamps_ns[i - 40], "a", "b", T_target_query, 9, 100, 0.25});
    }
    graph.Optimize();
    WriteClosuresCsv(rows_, folder_.path() + "/closures.csv");
    WriteTum(drive_.odometry, folder_.path() + "/trajectory_odometry.tum");
    WriteTum(graph.Trajectory(0), folder_.path() + "/trajectory_optimized.tum");
    WriteG2o(graph, folder_.path() + "/pose_graph.g2o");
    optimized_ = graph.Trajectory(0);
    for (const PoseGraphEdge& edge : graph.Edges()) {
      if (edge.is_closure) edges_.push_back(edge);
    }
  }

  std::string ErrorOfReading() const {
    try {
      ReadRecordedRun(folder_.path());
    } catch (const std::runtime_error& error) {
      return error.what();
    }
    return "";
  }

  Circles drive_;
  std::vector<ClosureRow> rows_;
  std::vector<StampedPose> optimized_;
  std::vector<PoseGraphEdge> edges_;
  test::TemporaryDirectory folder_;
};

TEST_F(RecordedRunTest, ReadsWhatWasWritten) {
  const RecordedRun run = ReadRecordedRun(folder_.path());
  ASSERT_EQ(run.closures.size(), rows_.size());
  for (std::size_t i = 0; i < rows_.size(); ++i) {
    EXPECT_EQ(run.closures[i].stamp_query_ns, rows_[i].stamp_query_ns);
    EXPECT_EQ(run.closures[i].stamp_target_ns, rows_[i].stamp_target_ns);
    EXPECT_EQ(run.closures[i].robot_query, "a");
    EXPECT_EQ(run.closures[i].robot_target, "b");
    EXPECT_TRUE(run.closures[i].T_target_query.isApprox(rows_[i].T_target_query, 1e-7));
    EXPECT_EQ(run.closures[i].inliers, 9u);
    EXPECT_EQ(run.closures[i].candidates, 100u);
    EXPECT_DOUBLE_EQ(run.closures[i].rms_m, 0.25);
  }
  ASSERT_EQ(run.odometry.size(), drive_.odometry.size());
  ASSERT_EQ(run.optimized.size(), optimized_.size());
  for (std::size_t i = 0; i < run.odometry.size(); ++i) {
    EXPECT_EQ(run.odometry[i].stamp_ns, drive_.stamps_ns[i]);
    EXPECT_TRUE(run.odometry[i].T_frame_sensor.isApprox(drive_.odometry[i].T_frame_sensor, 1e-9));
    EXPECT_TRUE(run.optimized[i].T_frame_sensor.isApprox(optimized_[i].T_frame_sensor, 1e-9));
  }
  ASSERT_EQ(run.graph_closures.size(), edges_.size());
  for (std::size_t i = 0; i < edges_.size(); ++i) {
    EXPECT_EQ(run.graph_closures[i].target_step, edges_[i].from);
    EXPECT_EQ(run.graph_closures[i].query_step, edges_[i].to);
    EXPECT_TRUE(run.graph_closures[i].covariance.isApprox(edges_[i].covariance, 1e-6));
  }
}

TEST_F(RecordedRunTest, MeasuresErrors) {
  const RunErrors errors = MeasureRun(ReadRecordedRun(folder_.path()), drive_.stamps_ns, drive_.truth);
  EXPECT_EQ(errors.poses, 80u);
  EXPECT_NEAR(errors.odometry_m, AbsoluteTrajectoryError(PosesOf(drive_.odometry), drive_.truth), 1e-6);
  EXPECT_NEAR(errors.optimized_m, AbsoluteTrajectoryError(PosesOf(optimized_), drive_.truth), 1e-6);
  EXPECT_LT(errors.optimized_m, errors.odometry_m);
  EXPECT_LT(errors.bound_same_places_m, errors.optimized_m);
}

TEST_F(RecordedRunTest, TakesARunThatMissedScans) {
  RecordedRun run = ReadRecordedRun(folder_.path());
  run.graph_closures.clear();
  run.odometry.erase(run.odometry.begin() + 10, run.odometry.begin() + 15);
  run.optimized.erase(run.optimized.begin() + 10, run.optimized.begin() + 15);
  EXPECT_EQ(MeasureRun(run, drive_.stamps_ns, drive_.truth).poses, 75u);
}

TEST_F(RecordedRunTest, RefusesAnotherEpoch) {
  for (StampNs& stamp_ns : drive_.stamps_ns) stamp_ns -= 1'000'000'000'000;
  EXPECT_THROW(MeasureRun(ReadRecordedRun(folder_.path()), drive_.stamps_ns, drive_.truth), std::runtime_error);
}

TEST_F(RecordedRunTest, RefusesFilesOfTwoRuns) {
  RecordedRun run = ReadRecordedRun(folder_.path());
  run.odometry.resize(60);
  run.optimized.resize(60);
  EXPECT_THROW(MeasureRun(run, drive_.stamps_ns, drive_.truth), std::runtime_error);
  run.optimized.resize(59);
  EXPECT_THROW(MeasureRun(run, drive_.stamps_ns, drive_.truth), std::runtime_error);
}

TEST_F(RecordedRunTest, NamesFileAndLineOfDamage) {
  folder_.Write("trajectory_optimized.tum", "1.0 0 0 0 0 0 0 1\n2.0 0 0 zero 0 0 0 1\n");
  EXPECT_NE(ErrorOfReading().find("trajectory_optimized.tum, line 2"), std::string::npos) << ErrorOfReading();
  folder_.Write("trajectory_optimized.tum", "1.0 0 0 0 0 0 0 2\n");  // no rotation
  EXPECT_NE(ErrorOfReading().find("trajectory_optimized.tum, line 1"), std::string::npos) << ErrorOfReading();
  folder_.Write("closures.csv", "stamp,x\n");
  EXPECT_NE(ErrorOfReading().find("closures.csv, line 1"), std::string::npos) << ErrorOfReading();
  std::filesystem::remove(folder_.path() + "/closures.csv");
  EXPECT_NE(ErrorOfReading().find("can't read"), std::string::npos) << ErrorOfReading();
}

}  // namespace
}  // namespace incremental_segmatch
