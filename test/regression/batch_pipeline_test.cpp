// The batch baseline as a pipeline: the same inputs and outputs as the incremental one, and the same answers where theory says so.
#include <gtest/gtest.h>

#include <algorithm>
#include <map>
#include <random>
#include <vector>

#include "incremental_segmatch/batch_pipeline.hpp"
#include "incremental_segmatch/parameters.hpp"
#include "simulator/simulation.hpp"

namespace incremental_segmatch {
namespace {

std::vector<Scan> Scans(std::size_t count) {
  simulator::SimulationOptions options;
  options.sensor = "HDL-64E";
  options.route = "lap";
  options.max_scans = count;
  simulator::Simulation simulation(options);
  std::vector<Scan> scans;
  for (std::size_t i = 0; i < simulation.size(); ++i)
    scans.push_back({simulation.stamp_ns(i), simulation.Scan(i), simulation.T_odom_sensor(i)});
  return scans;
}

// A first scan is inserted in one go: both must find the same clusters (contract 3), whatever order they come in.
TEST(BatchPipeline, FirstScanGivesTheSegmentsOfTheIncrementalPipeline) {
  const Parameters defaults;
  FrontEnd incremental(defaults.front_end, "robot");
  BatchFrontEnd batch(defaults.front_end, defaults.back_end.recognizer, "robot");
  const Scan scan = Scans(1).front();
  const FrontEndStep a = incremental.Process(scan), b = batch.Process(scan);
  EXPECT_EQ(a.obstacles_sensor.size(), b.obstacles_sensor.size());
  ASSERT_GT(a.delta.changed.size(), 5u);
  ASSERT_EQ(a.delta.changed.size(), b.delta.changed.size());
  for (const SegmentState& segment : a.delta.changed) {
    const auto twin = std::min_element(b.delta.changed.begin(), b.delta.changed.end(), [&](const auto& x, const auto& y) {
      return (x.centroid_odom - segment.centroid_odom).norm() < (y.centroid_odom - segment.centroid_odom).norm();
    });
    EXPECT_LT((twin->centroid_odom - segment.centroid_odom).norm(), 0.01);
    EXPECT_NEAR(twin->size, segment.size, 2 + 0.01 * segment.size) << "voxels of float and double grids";
    for (const SegmentState* shown : {&segment, &*twin}) {
      const std::size_t limit = defaults.front_end.view.shown_points;
      EXPECT_LE(shown->points_centroid->size(), limit);
      EXPECT_GE(10 * shown->points_centroid->size(), std::min<std::size_t>(limit, shown->size));
      for (const Eigen::Vector3f& p : *shown->points_centroid) EXPECT_LT(p.norm(), 50.f);
    }
  }
}

TEST(BatchPipeline, EveryStepRetiresTheSegmentsOfTheLast) {
  const Parameters defaults;
  BatchFrontEnd batch(defaults.front_end, defaults.back_end.recognizer, "robot");
  std::vector<SegmentId> last;
  SegmentId highest = 0;
  for (const Scan& scan : Scans(4)) {
    const FrontEndStep step = batch.Process(scan);
    std::vector<SegmentId> retired, changed;
    for (const RetiredSegment& segment : step.delta.retired) retired.push_back(segment.id);
    for (const SegmentState& segment : step.delta.changed) {
      EXPECT_GT(segment.id, highest) << "an ID came back";
      highest = segment.id;
      changed.push_back(segment.id);
    }
    EXPECT_EQ(retired, last);
    last = changed;
  }
}

// Correspondences under one transform: the greedy grouping finds them as the clique does.
TEST(BatchPipeline, RecognizesWhatIsConsistent) {
  const Parameters defaults;
  const BatchRecognizer batch(defaults.front_end, defaults.back_end.recognizer);
  Recognizer incremental(defaults.back_end.recognizer);
  std::mt19937 random(7);
  std::uniform_real_distribution<double> uniform(-40.0, 40.0);
  Pose T = Pose::Identity();
  T.linear() = Eigen::AngleAxisd(1.3, Eigen::Vector3d::UnitZ()).toRotationMatrix();
  T.translation() << 100.0, -50.0, 2.0;
  Correspondences correspondences;
  for (SegmentId i = 1; i <= 12; ++i) {
    const Eigen::Vector3d p(uniform(random), uniform(random), 0.05 * uniform(random));
    correspondences.push_back({{0, i}, {1, i}, p, T * p, 0.1f});
  }
  const RecognizerResult a = incremental.Recognize(correspondences), b = batch.Recognize(correspondences);
  ASSERT_TRUE(a.recognition && b.recognition);
  EXPECT_EQ(b.recognition->inliers.size(), 12u);
  EXPECT_LT((b.recognition->T_target_local.matrix() - T.matrix()).norm(), 1e-3);
  EXPECT_LT((b.recognition->covariance - a.recognition->covariance).norm(), 1e-3 * a.recognition->covariance.norm());

  correspondences.resize(5);
  EXPECT_FALSE(batch.Recognize(correspondences).recognition);
  EXPECT_FALSE(batch.Recognize({}).recognition);
}

}  // namespace
}  // namespace incremental_segmatch
