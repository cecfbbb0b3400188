// The whole core on a small drive: loops are found, none is false, and what must not matter does not.

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <random>

#include "support/lap_drive.hpp"

namespace incremental_segmatch::test {
namespace {

/// The drive as it is, processed once for all tests that compare with it.
const PipelineRun& Undisturbed() {
  static const PipelineRun run = [] {
    BackEnd back_end{BackEndParameters{}};
    return Process(TwoLaps(), &back_end);
  }();
  return run;
}

TEST(Pipeline, FindsTheSecondLapAndNothingFalse) {
  const Score score = ScoreRun(TwoLaps(), Undisturbed());
  EXPECT_GT(score.revisits, 50u);
  EXPECT_EQ(score.false_closures, 0u);
  EXPECT_EQ(score.trivial_closures, 0u);
  EXPECT_EQ(score.unmatched_closures, 0u);
  EXPECT_GE(score.recall, 0.7);
  EXPECT_LE(score.translation_error_median_m, 0.05);
  EXPECT_LE(score.rotation_error_95_deg, 0.5);
}

TEST(Pipeline, RefinementOnScansImprovesThePose) {
  BackEndParameters parameters;
  parameters.refinement.enabled = false;
  BackEnd back_end(parameters);
  const Score unrefined = ScoreRun(TwoLaps(), Process(TwoLaps(), &back_end)), refined = ScoreRun(TwoLaps(), Undisturbed());
  EXPECT_LT(refined.translation_error_median_m, 0.5 * unrefined.translation_error_median_m);
  EXPECT_LT(refined.rotation_error_median_deg, 0.5 * unrefined.rotation_error_median_deg);
}

TEST(Pipeline, RecognitionsHaveNoPriorOnThePose) {
  // The robot is carried elsewhere between the laps: the rest of its odometry moves by any heading and translation.
  const Score expected_score = ScoreRun(TwoLaps(), Undisturbed());
  constexpr unsigned kSeed = 1;
  SCOPED_TRACE("seed " + std::to_string(kSeed));
  std::mt19937 random(kSeed);
  std::uniform_real_distribution<double> metres(-3000.0, 3000.0), yaw(-M_PI, M_PI);
  const Pose T_moved_odom = Eigen::Translation3d(metres(random), metres(random), 0.01 * metres(random)) *
                            Eigen::AngleAxisd(yaw(random), Eigen::Vector3d::UnitZ());
  const std::size_t half = TwoLaps().scans.size() / 2;
  BackEnd back_end{BackEndParameters{}};
  const Score score = ScoreRun(TwoLaps(), Process(TwoLaps(), &back_end, {}, half, T_moved_odom));
  EXPECT_EQ(score.false_closures, 0u);
  EXPECT_EQ(score.trivial_closures, 0u);
  // Not to the last one: the local map starts anew where the robot was put down, and voxels fall differently.
  EXPECT_GE(score.recall, expected_score.recall - 0.1);
  EXPECT_NEAR(score.translation_error_median_m, expected_score.translation_error_median_m, 0.1);
}

TEST(Pipeline, TwoRunsAgreeToTheBit) {
  BackEnd back_end{BackEndParameters{}};
  const PipelineRun &a = Undisturbed(), b = Process(TwoLaps(), &back_end);
  ASSERT_EQ(a.closures.size(), b.closures.size());
  for (std::size_t i = 0; i < a.closures.size(); ++i) {
    EXPECT_EQ(a.closures[i].stamp_target_ns, b.closures[i].stamp_target_ns);
    EXPECT_EQ(a.closures[i].T_target_query.matrix(), b.closures[i].T_target_query.matrix());
  }
}

TEST(Pipeline, TargetMapStopsGrowingAfterTheFirstLap) {
  const PipelineRun& run = Undisturbed();
  const std::size_t after_first = run.steps[run.steps.size() / 2].counts.target_segments;
  const std::size_t after_second = run.steps.back().counts.target_segments;
  EXPECT_LT(static_cast<double>(after_second), 1.6 * static_cast<double>(after_first));
}

TEST(Pipeline, LocalizesInYesterdaysMap) {
  BackEnd mapping{BackEndParameters{}};
  Process(SimulateLaps(0, 1), &mapping);
  BackEndParameters parameters;
  parameters.mode = Mode::kLocalization;
  BackEnd back_end(parameters, mapping.map());
  const Drive today = SimulateLaps(1, 1);
  const PipelineRun run = Process(today, &back_end);
  std::size_t right = 0;
  for (const ClosureRow& closure : run.closures) {
    // Both days follow one route: a stamp names the same place on both.
    const auto index = [&](StampNs stamp_ns) {
      return static_cast<std::size_t>(std::lower_bound(today.stamps_ns.begin(), today.stamps_ns.end(), stamp_ns) -
                                      today.stamps_ns.begin());
    };
    const Pose truth = today.T_world_sensor[index(closure.stamp_target_ns)].inverse() *
                       today.T_world_sensor[index(closure.stamp_query_ns)];
    const double error_m = (closure.T_target_query.translation() - truth.translation()).norm();
    right += error_m < 1.0;
    EXPECT_LT(error_m, 1.0) << "query at " << closure.stamp_query_ns << " ns, target at " << closure.stamp_target_ns << " ns, "
                            << closure.inliers << " inliers";
  }
  EXPECT_EQ(right, run.closures.size());
  EXPECT_GE(right, today.scans.size() / 2);
  EXPECT_EQ(back_end.map().segments().size(), mapping.map().segments().size());
}

TEST(Pipeline, AMissingDeltaIsNoticedAndAFullStateHeals) {
  const Drive& drive = TwoLaps();
  FrontEnd front_end({}, "robot");
  BackEnd back_end{BackEndParameters{}};
  for (std::size_t i = 0; i < 10; ++i) EXPECT_FALSE(back_end.Process(front_end.Process(drive.scans[i]).delta).missed_delta);
  front_end.Process(drive.scans[10]);  // lost on the way
  EXPECT_TRUE(back_end.Process(front_end.Process(drive.scans[11]).delta).missed_delta);
  const BackEndStep healed = back_end.Process(front_end.FullState());
  EXPECT_FALSE(healed.missed_delta);
  EXPECT_EQ(healed.counts.local_segments, front_end.FullState().changed.size());
  EXPECT_FALSE(back_end.Process(front_end.Process(drive.scans[12]).delta).missed_delta);
}

TEST(Pipeline, DescriptorsKnowWhatStandsAroundEachSegment) {
  // In a full state all segments are described at once: centroids and heights there give each one's context.
  const FrontEndParameters parameters;
  FrontEnd front_end(parameters, "robot");
  for (std::size_t i = 0; i < 20; ++i) front_end.Process(TwoLaps().scans[i]);
  front_end.ApplyJump(Eigen::Translation3d(3.0, -2.0, 0.1) * Eigen::AngleAxisd(0.2, Eigen::Vector3d::UnitZ()));
  const std::vector<std::string>& names = front_end.describer().names();
  const auto index_of = [&](const std::string& name) { return std::find(names.begin(), names.end(), name) - names.begin(); };
  const double width_m = parameters.descriptor.context_radius_m / static_cast<double>(kContextRings);
  const SegmentDelta state = front_end.FullState();
  ASSERT_GT(state.changed.size(), 20u);
  for (const SegmentState& segment : state.changed) {
    Eigen::VectorXd heights_m = Eigen::VectorXd::Zero(kContextRings);
    for (const SegmentState& other : state.changed) {
      if (other.id == segment.id) continue;
      const double distance_m = (other.centroid_odom - segment.centroid_odom).norm();
      const double height_m = std::exp(other.descriptor[index_of("log_height")]) - parameters.grid.resolution_m;
      for (Eigen::Index ring = 0; ring < kContextRings; ++ring)
        heights_m[ring] += height_m * std::max(0.0, 1.0 - std::abs(distance_m / width_m - static_cast<double>(ring)));
    }
    const Eigen::VectorXf context = segment.descriptor.segment(index_of("context_1"), kContextRings);
    EXPECT_LT((context.cast<double>() - heights_m.cwiseSqrt()).cwiseAbs().maxCoeff(), 2e-3) << "segment " << segment.id;
  }
}

TEST(Pipeline, AJumpOfTheOdometryFrameLeavesTrackingAlone) {
  // The SLAM stack corrects the frame of the scans: cloud and segments follow, IDs stay.
  const Drive& drive = TwoLaps();
  const Pose T_new_old = Eigen::Translation3d(3.0, -2.0, 0.1) * Eigen::AngleAxisd(0.2, Eigen::Vector3d::UnitZ());
  FrontEnd steady({}, "robot"), jumping({}, "robot");
  for (std::size_t i = 0; i < 20; ++i) {
    Scan scan = drive.scans[i];
    const SegmentDelta expected = steady.Process(scan).delta;
    if (i == 10) jumping.ApplyJump(T_new_old);
    if (i >= 10) scan.T_odom_sensor = T_new_old * scan.T_odom_sensor;
    const SegmentDelta moved = jumping.Process(scan).delta;
    if (i == 10) {
      EXPECT_GE(moved.changed.size(), expected.changed.size());
      continue;
    }
    ASSERT_EQ(moved.changed.size(), expected.changed.size());
    const Pose T = i < 10 ? Pose::Identity() : T_new_old;
    for (std::size_t k = 0; k < moved.changed.size(); ++k) {
      EXPECT_EQ(moved.changed[k].id, expected.changed[k].id);
      EXPECT_LT((moved.changed[k].centroid_odom - T * expected.changed[k].centroid_odom).norm(), 0.02);
    }
  }
}

TEST(Pipeline, RefusesTimeGoingBackAndPosesThatAreNotFinite) {
  FrontEnd front_end({}, "robot");
  Scan scan;
  scan.stamp_ns = 10;
  front_end.Process(scan);
  EXPECT_THROW(front_end.Process(scan), std::invalid_argument);
  scan.stamp_ns = 11;
  scan.T_odom_sensor.translation().x() = std::nan("");
  EXPECT_THROW(front_end.Process(scan), std::invalid_argument);
  scan.T_odom_sensor = Pose::Identity();
  scan.points_sensor = {{std::nanf(""), 0.f, 0.f}, {5.f, 0.f, 0.f}};
  const FrontEndStep step = front_end.Process(scan);
  EXPECT_EQ(step.counts.dropped_nonfinite, 1u);
  EXPECT_EQ(step.counts.voxels, 1u);
}

}  // namespace
}  // namespace incremental_segmatch::test
