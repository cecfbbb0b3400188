#include "conversions.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <random>
#include <stdexcept>

namespace incremental_segmatch {
namespace {

Pose RandomPose(std::mt19937& random, double range_m) {
  std::uniform_real_distribution<double> unit(-1.0, 1.0);
  Pose T = Pose::Identity();
  T.linear() =
      Eigen::Quaterniond(unit(random), unit(random), unit(random), unit(random)).normalized().toRotationMatrix();
  T.translation() = range_m * Eigen::Vector3d(unit(random), unit(random), unit(random));
  return T;
}

Covariance6 RandomCovariance(std::mt19937& random) {
  std::normal_distribution<double> normal;
  const Covariance6 root = Covariance6::NullaryExpr([&] { return 0.1 * normal(random); });
  return root * root.transpose();
}

RobotFrames RandomFrames(std::mt19937& random, const std::string& prefix) {
  return {prefix + "odom", prefix + "base_link", prefix + "velodyne", RandomPose(random, 2.0)};
}

SegmentDelta RandomDelta(std::mt19937& random) {
  std::uniform_real_distribution<double> unit(-1.0, 1.0);
  SegmentDelta delta;
  delta.robot = "alice";
  delta.sequence = random();
  delta.stamp_ns = 1317000000123456789 + random() % 1000000;
  delta.T_odom_sensor = RandomPose(random, 1e5);
  delta.full_state = random() % 2 == 0;
  for (SegmentId id = 1; id < 8; ++id) {
    SegmentState state;
    state.id = 3 * id;
    state.size = random() % 10000;
    state.centroid_odom = 1e5 * Eigen::Vector3d(unit(random), unit(random), unit(random));
    state.descriptor = Descriptor::NullaryExpr(11, [&] { return static_cast<float>(unit(random)); });
    state.new_view = id % 2 == 0;
    if (state.new_view) {
      auto points = std::make_shared<Points>(1 + random() % 50);
      for (Eigen::Vector3f& p : *points)
        p = (20.0 * Eigen::Vector3d(unit(random), unit(random), unit(random))).cast<float>();
      state.points_centroid = points;
    }
    delta.changed.push_back(state);
  }
  auto scan = std::make_shared<Points>(1 + random() % 50);
  for (Eigen::Vector3f& p : *scan)
    p = (40.0 * Eigen::Vector3d(unit(random), unit(random), unit(random))).cast<float>();
  delta.scan_sensor = scan;
  delta.renamed = {{12, 5}, {30, 2}};
  delta.retired = {{40, RetirementCause::kTooLarge}, {41, RetirementCause::kCut}, {42, RetirementCause::kLeft}, {43, RetirementCause::kTrail}};
  return delta;
}

void ExpectSamePoses(const Pose& a, const Pose& b) {
  EXPECT_LT((a.matrix() - b.matrix()).cwiseAbs().maxCoeff(), 1e-9);
}

TEST(Conversions, DeltaComesBackFromItsMessage) {
  for (unsigned seed = 0; seed < 20; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    std::mt19937 random(seed);
    const SegmentDelta delta = RandomDelta(random);
    const RobotFrames frames = RandomFrames(random, "");
    const SegmentArray message = ToSegmentArray(delta, frames, 77, 0.01, true);
    EXPECT_EQ(message.session, 77u);
    EXPECT_EQ(message.robot, "alice");
    const SegmentDelta back = ToSegmentDelta(message, "alice#2");
    EXPECT_EQ(back.robot, "alice#2");
    EXPECT_EQ(back.sequence, delta.sequence);
    EXPECT_EQ(back.stamp_ns, delta.stamp_ns);
    EXPECT_EQ(back.full_state, delta.full_state);
    ExpectSamePoses(back.T_odom_sensor, delta.T_odom_sensor);
    ASSERT_NE(back.scan_sensor, nullptr);
    ASSERT_EQ(back.scan_sensor->size(), delta.scan_sensor->size());
    for (std::size_t k = 0; k < delta.scan_sensor->size(); ++k)
      EXPECT_LT(((*back.scan_sensor)[k] - (*delta.scan_sensor)[k]).cwiseAbs().maxCoeff(), 0.00101f);
    ASSERT_EQ(back.changed.size(), delta.changed.size());
    for (std::size_t i = 0; i < delta.changed.size(); ++i) {
      const SegmentState& a = delta.changed[i];
      const SegmentState& b = back.changed[i];
      EXPECT_EQ(a.id, b.id);
      EXPECT_EQ(a.size, b.size);
      EXPECT_EQ(a.new_view, b.new_view);
      EXPECT_EQ(a.centroid_odom, b.centroid_odom);
      EXPECT_EQ(a.descriptor, b.descriptor);
      ASSERT_EQ(a.points_centroid == nullptr, b.points_centroid == nullptr);
      if (!a.points_centroid) continue;
      ASSERT_EQ(a.points_centroid->size(), b.points_centroid->size());
      for (std::size_t k = 0; k < a.points_centroid->size(); ++k)
        EXPECT_LT(((*a.points_centroid)[k] - (*b.points_centroid)[k]).cwiseAbs().maxCoeff(), 0.00501f);
    }
    ASSERT_EQ(back.renamed.size(), delta.renamed.size());
    for (std::size_t i = 0; i < delta.renamed.size(); ++i) {
      EXPECT_EQ(back.renamed[i].from, delta.renamed[i].from);
      EXPECT_EQ(back.renamed[i].to, delta.renamed[i].to);
    }
    ASSERT_EQ(back.retired.size(), delta.retired.size());
    for (std::size_t i = 0; i < delta.retired.size(); ++i) {
      EXPECT_EQ(back.retired[i].id, delta.retired[i].id);
      EXPECT_EQ(back.retired[i].cause, delta.retired[i].cause);
    }
    const RobotFrames frames_back = ToRobotFrames(message);
    EXPECT_EQ(frames_back.odom_frame, "odom");
    EXPECT_EQ(frames_back.base_frame, "base_link");
    EXPECT_EQ(frames_back.sensor_frame, "velodyne");
    ExpectSamePoses(frames_back.T_base_sensor, frames.T_base_sensor);
  }
}

TEST(Conversions, LargeSegmentsAreQuantisedMoreCoarsely) {
  SegmentDelta delta;
  delta.changed.emplace_back();
  delta.changed[0].id = 1;
  delta.changed[0].points_centroid = std::make_shared<Points>(Points{{1000.f, -1000.f, 0.5f}, {-3.f, 2.f, 999.f}});
  const SegmentDelta back = ToSegmentDelta(ToSegmentArray(delta, {}, 1, 0.01, true), "r");
  for (std::size_t k = 0; k < 2; ++k)
    EXPECT_LT(((*back.changed[0].points_centroid)[k] - (*delta.changed[0].points_centroid)[k]).norm(), 0.03f);
  EXPECT_EQ(ToSegmentDelta(ToSegmentArray(delta, {}, 1, 0.01, false), "r").changed[0].points_centroid, nullptr);
}

TEST(Conversions, DamagedMessagesAreRefusedByName) {
  std::mt19937 random(5);
  const SegmentArray good = ToSegmentArray(RandomDelta(random), {}, 1, 0.01, true);
  const auto expect_refused = [&good](const auto& damage, const std::string& word) {
    SegmentArray message = good;
    damage(message);
    try {
      ToSegmentDelta(message, "r");
      FAIL() << "accepted; expected " << word;
    } catch (const std::invalid_argument& error) {
      EXPECT_NE(std::string(error.what()).find(word), std::string::npos) << error.what();
    }
  };
  expect_refused([](SegmentArray& m) { m.changed[1].id = m.changed[0].id; }, "order");
  expect_refused([](SegmentArray& m) { m.changed[0].id = 0; }, "ID 0");
  expect_refused([](SegmentArray& m) { m.changed[1].points.pop_back(); }, "triples");
  expect_refused([](SegmentArray& m) { m.changed[1].point_unit_m = 0.f; }, "point_unit_m");
  expect_refused([](SegmentArray& m) { m.changed[2].centroid.x = std::nan(""); }, "finite");
  expect_refused([](SegmentArray& m) { m.changed[2].descriptor[3] = std::nanf(""); }, "finite");
  expect_refused([](SegmentArray& m) { m.retired[0].cause = 9; }, "cause");
  expect_refused([](SegmentArray& m) { m.sensor_pose = geometry_msgs::Pose(); }, "sensor_pose");
}

TEST(Conversions, ClosureBetweenBasesIsTheSameClosure) {
  for (unsigned seed = 0; seed < 20; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    std::mt19937 random(seed);
    const RobotFrames query = RandomFrames(random, "q/");
    const RobotFrames target = RandomFrames(random, "t/");
    TargetMap map{TargetMapParameters()};
    map.RobotByName("alice");
    map.RobotByName("bob");
    const Pose T_world_target_sensor = RandomPose(random, 100.0);
    const Pose T_world_query_sensor = RandomPose(random, 100.0);
    Closure closure;
    closure.stamp_query_ns = 1317000100000000001;
    closure.stamp_target_ns = 1317000000000000002;
    closure.robot_query = "alice";
    closure.robot_target = "bob";
    closure.T_target_query = T_world_target_sensor.inverse() * T_world_query_sensor;
    closure.covariance = RandomCovariance(random);
    closure.inliers = 8;
    closure.candidates = 300;
    closure.rms_m = 0.125;
    closure.matches = {{{0, 11}, {1, 22}, {1, 2, 3}, {4, 5, 6}}};

    const LoopClosure message = ToLoopClosure(closure, FrameKind::kBase, query, target, map);
    EXPECT_EQ(message.frame_query, "q/base_link");
    EXPECT_EQ(message.frame_target, "t/base_link");
    const Pose T_world_target_base = T_world_target_sensor * target.T_base_sensor.inverse();
    const Pose T_world_query_base = T_world_query_sensor * query.T_base_sensor.inverse();
    ExpectSamePoses(ToPose(message.relative_pose.pose, ""), T_world_target_base.inverse() * T_world_query_base);
    ASSERT_EQ(message.matches.size(), 1u);
    EXPECT_EQ(message.matches[0].segment_query, 11u);
    EXPECT_EQ(message.matches[0].segment_target, 22u);
    EXPECT_EQ(message.matches[0].robot_target, "bob");
    EXPECT_EQ(ToVector(message.matches[0].centroid_target), Eigen::Vector3d(4, 5, 6));
    EXPECT_EQ(ToStampNs(message.stamp_query), closure.stamp_query_ns);
    EXPECT_EQ(ToStampNs(message.stamp_target), closure.stamp_target_ns);

    for (const FrameKind kind : {FrameKind::kBase, FrameKind::kSensor}) {
      const SensorClosure back = ToSensorClosure(ToLoopClosure(closure, kind, query, target, map), query, target);
      ExpectSamePoses(back.T_target_query, closure.T_target_query);
      EXPECT_LT((back.covariance - closure.covariance).cwiseAbs().maxCoeff(), 1e-9);
    }
  }
}

/// exp of a small twist (translation, rotation), to first order exact enough for differences.
Pose SmallMotion(const Eigen::Matrix<double, 6, 1>& xi) {
  Pose T = Pose::Identity();
  const double angle = xi.tail<3>().norm();
  if (angle > 0.0) T.linear() = Eigen::AngleAxisd(angle, xi.tail<3>() / angle).toRotationMatrix();
  T.translation() = xi.head<3>();
  return T;
}

Eigen::Matrix<double, 6, 1> Twist(const Pose& T) {
  Eigen::Matrix<double, 6, 1> xi;
  const Eigen::AngleAxisd rotation(T.linear());
  xi << T.translation(), rotation.angle() * rotation.axis();
  return xi;
}

TEST(Conversions, CovarianceTurnsIntoTheParentsAxes) {
  for (unsigned seed = 0; seed < 10; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    std::mt19937 random(seed);
    const Pose T = RandomPose(random, 10.0);
    const Covariance6 covariance = RandomCovariance(random);
    // The Jacobian by differences, column by column.
    Covariance6 parent;
    for (int column = 0; column < 6; ++column) {
      const double step = 1e-6;
      const Pose perturbed = T * SmallMotion(step * Eigen::Matrix<double, 6, 1>::Unit(column));
      parent.col(column).head<3>() = (perturbed.translation() - T.translation()) / step;
      Pose turned = Pose::Identity();
      turned.linear() = perturbed.linear() * T.linear().transpose();
      parent.col(column).tail<3>() = Twist(turned).tail<3>() / step;
    }
    EXPECT_LT(
        (RightPerturbationToParentAxes(covariance, T) - parent * covariance * parent.transpose()).cwiseAbs().maxCoeff(),
        1e-4);
  }
}

TEST(Conversions, TrajectoryComesBackFromItsPath) {
  std::mt19937 random(3);
  const RobotFrames frames = RandomFrames(random, "");
  std::vector<StampedPose> trajectory;
  for (int i = 0; i < 10; ++i) trajectory.push_back({1000000000LL * (i + 1) + 7, RandomPose(random, 100.0)});
  for (const FrameKind kind : {FrameKind::kBase, FrameKind::kSensor}) {
    const nav_msgs::Path path = ToPath(trajectory, kind, frames, "map", ros::Time(12.0));
    EXPECT_EQ(path.header.frame_id, "map");
    const std::vector<StampedPose> back = ToTrajectory(path, kind, frames);
    ASSERT_EQ(back.size(), trajectory.size());
    for (std::size_t i = 0; i < back.size(); ++i) {
      EXPECT_EQ(back[i].stamp_ns, trajectory[i].stamp_ns);
      ExpectSamePoses(back[i].T_frame_sensor, trajectory[i].T_frame_sensor);
    }
  }
}

TEST(Conversions, NoTimeBeforeZero) {
  EXPECT_THROW(ToTime(-1), std::invalid_argument);
}

}  // namespace
}  // namespace incremental_segmatch
