#include "incremental_segmatch/target_map.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <random>
#include <stdexcept>

namespace incremental_segmatch {
namespace {

Pose MakePose(double x, double y, double z, double yaw) {
  Pose T = Pose::Identity();
  T.linear() = Eigen::AngleAxisd(yaw, Eigen::Vector3d::UnitZ()).toRotationMatrix();
  T.translation() << x, y, z;
  return T;
}

SegmentView MakeView(RobotIndex robot, std::uint32_t pose, std::uint32_t size) {
  SegmentView view;
  view.robot = robot;
  view.pose = pose;
  view.size = size;
  view.centroid_sensor << 1, 2, 3;
  view.descriptor = Descriptor::Constant(3, static_cast<float>(size));
  return view;
}

std::vector<std::uint32_t> Sizes(const TargetMap& map, const SegmentKey& key) {
  std::vector<std::uint32_t> sizes;
  for (const SegmentView& view : map.Find(key)->views) sizes.push_back(view.size);
  return sizes;
}

// One robot with ten poses, one a second, one metre apart.
TargetMap MapOfOneRobot(std::size_t max_views = 4) {
  TargetMap map({max_views});
  const RobotIndex robot = map.RobotByName("a");
  for (int i = 0; i < 10; ++i) map.AddPose(robot, i * 1000, MakePose(i, 0, 0, 0.1 * i));
  return map;
}

TEST(TargetMap, RefusesToKeepNoView) {
  EXPECT_THROW(TargetMap({0}), std::invalid_argument);
}

TEST(TargetMap, NamesRobotsInTheOrderInWhichTheyCome) {
  TargetMap map({});
  EXPECT_EQ(map.RobotByName("b"), 0u);
  EXPECT_EQ(map.RobotByName("a"), 1u);
  EXPECT_EQ(map.RobotByName("b"), 0u);
  EXPECT_EQ(map.robots(), 2u);
  EXPECT_EQ(map.RobotName(1), "a");
  EXPECT_THROW(map.RobotName(2), std::out_of_range);
}

TEST(TargetMap, KeyframesAlongAPathAreThoseOfAllThatLieThere) {
  std::size_t kept = 0, sighted = 0;
  for (unsigned seed = 0; seed < 1000; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    std::mt19937 random(seed);
    TargetMap map({});
    for (const char* name : {"a", "b"}) map.RobotByName(name);
    double x_m = 0.0;
    for (int i = 0; i < 60; ++i) {
      const RobotIndex robot = random() % 2;
      x_m += static_cast<double>(random() % 3);  // it may stand still
      map.AddPose(robot, i, MakePose(x_m, 0, 0, 0));
      if (random() % 2 == 0) map.AddKeyframe(robot, nullptr);
      const RobotIndex other = random() % 2;
      if (random() % 2 == 0 && !map.Keyframes(other).empty())
        map.AddSighting(robot, {other, static_cast<std::uint32_t>(random() % map.Keyframes(other).size())});
    }
    for (RobotIndex robot = 0; robot < 2; ++robot) {
      // Whole metres, as the path: what lies at an end is along it.
      const double from_m = static_cast<double>(random() % 80) - 10.0, to_m = from_m + static_cast<double>(random() % 30);
      const auto is_along = [&](std::uint32_t pose) {
        const double path_m = map.Trajectory(robot)[pose].path_m;
        return from_m <= path_m && path_m <= to_m;
      };
      std::vector<KeyframeName> expected;
      for (std::uint32_t i = 0; i < map.Keyframes(robot).size(); ++i)
        if (is_along(map.Keyframes(robot)[i].pose)) expected.push_back({robot, i});
      kept += expected.size();
      for (const Sighting& sighting : map.Sightings(robot))
        if (is_along(sighting.pose)) expected.push_back(sighting.keyframe), ++sighted;
      EXPECT_EQ(map.KeyframesAlong(robot, from_m, to_m), expected);
    }
  }
  EXPECT_GT(kept, 1000u);
  EXPECT_GT(sighted, 1000u);
}

TEST(TargetMap, KeepsAtMostOneKeyframeAndSightingAPose) {
  TargetMap map({});
  const RobotIndex robot = map.RobotByName("a");
  const auto scan = std::make_shared<const Points>(Points{{1.f, 2.f, 3.f}});
  EXPECT_THROW(map.AddKeyframe(robot, scan), std::invalid_argument);  // there is no pose yet
  map.AddPose(robot, 0, Pose::Identity());
  map.AddPose(robot, 1, Pose::Identity());
  map.AddKeyframe(robot, scan);
  EXPECT_THROW(map.AddKeyframe(robot, scan), std::invalid_argument);  // the newest pose has one
  map.AddPose(robot, 2, Pose::Identity());
  map.AddKeyframe(robot, nullptr);
  ASSERT_EQ(map.Keyframes(robot).size(), 2u);
  EXPECT_EQ(map.Keyframes(robot)[0].pose, 1u);
  EXPECT_EQ(map.Keyframes(robot)[0].scan_sensor, scan);
  EXPECT_EQ(map.Keyframes(robot)[1].pose, 2u);
  EXPECT_THROW(map.AddSighting(robot, {0, 2}), std::out_of_range);
  map.AddSighting(robot, {0, 0});
  EXPECT_THROW(map.AddSighting(robot, {0, 1}), std::invalid_argument);  // the newest pose has one
  ASSERT_EQ(map.Sightings(robot).size(), 1u);
  EXPECT_EQ(map.Sightings(robot)[0].pose, 2u);
  EXPECT_EQ(map.Sightings(robot)[0].keyframe.index, 0u);

  const auto keyframe_at = [&](std::uint32_t pose) {
    SegmentView view;
    view.robot = robot;
    view.pose = pose;
    const std::optional<KeyframeName> keyframe = map.KeyframeOf(view);
    return keyframe ? static_cast<int>(keyframe->index) : -1;
  };
  EXPECT_EQ(keyframe_at(0), -1) << "there was none yet";
  EXPECT_EQ(keyframe_at(1), 0);
  EXPECT_EQ(keyframe_at(2), 1) << "that which was kept there goes before that which was sighted";
  map.AddPose(robot, 4000, Pose::Identity());
  map.AddSighting(robot, {robot, 0});
  map.AddPose(robot, 5000, Pose::Identity());
  EXPECT_EQ(keyframe_at(4), 0) << "sighted last";
}

TEST(TargetMap, RefusesStampsThatDoNotIncreaseAndPosesThatAreNotFinite) {
  TargetMap map({});
  const RobotIndex robot = map.RobotByName("a");
  EXPECT_EQ(map.AddPose(robot, 5, Pose::Identity()), 0u);
  EXPECT_THROW(map.AddPose(robot, 5, Pose::Identity()), std::invalid_argument);
  EXPECT_THROW(map.AddPose(robot, 4, Pose::Identity()), std::invalid_argument);
  EXPECT_THROW(map.AddPose(robot, 6, MakePose(std::nan(""), 0, 0, 0)), std::invalid_argument);
  EXPECT_EQ(map.AddPose(robot, 6, Pose::Identity()), 1u);
  EXPECT_EQ(map.AddPose(map.RobotByName("b"), 1, Pose::Identity()), 0u);  // its own clock
}

TEST(TargetMap, CorrectedPosesAreTakenExactlyAndOthersFollow) {
  TargetMap map = MapOfOneRobot();
  const Pose at3 = MakePose(10, 20, 1, 0.7), at6 = MakePose(-5, 3, 2, -0.4);
  map.CorrectTrajectory(0, {{6000, at6}, {3000, at3}});  // any order
  const auto& trajectory = map.Trajectory(0);
  EXPECT_EQ(trajectory[3].T_map_sensor.matrix(), at3.matrix());
  EXPECT_EQ(trajectory[6].T_map_sensor.matrix(), at6.matrix());
  for (int i = 0; i < 10; ++i) {
    const int leader = i < 6 ? 3 : 6;
    const Pose expected =
        trajectory[leader].T_map_sensor * trajectory[leader].T_odom_sensor.inverse() * trajectory[i].T_odom_sensor;
    EXPECT_TRUE(trajectory[i].T_map_sensor.isApprox(expected, 1e-12)) << i;
    EXPECT_EQ(trajectory[i].T_odom_sensor.matrix(), MakePose(i, 0, 0, 0.1 * i).matrix()) << "odometry stays";
  }
  const Pose T_map_odom = at6 * trajectory[6].T_odom_sensor.inverse();
  EXPECT_TRUE(map.T_map_odom(0).isApprox(T_map_odom, 1e-12));
  map.AddPose(0, 10000, MakePose(11, 0, 0, 0));
  EXPECT_TRUE(map.Trajectory(0).back().T_map_sensor.isApprox(T_map_odom * MakePose(11, 0, 0, 0), 1e-12));
}

TEST(TargetMap, AnAnchorHoldsForThePosesAfterIt) {
  TargetMap map = MapOfOneRobot();
  const Pose T_map_odom = MakePose(3, -4, 1, 0.2);
  map.Anchor(0, T_map_odom);
  for (int i = 0; i < 10; ++i) EXPECT_EQ(map.Trajectory(0)[i].T_map_sensor.matrix(), MakePose(i, 0, 0, 0.1 * i).matrix());
  map.AddPose(0, 10000, MakePose(11, 0, 0, 0));
  EXPECT_TRUE(map.Trajectory(0).back().T_map_sensor.isApprox(T_map_odom * MakePose(11, 0, 0, 0), 1e-12));
  Pose broken = Pose::Identity();
  broken.translation().x() = std::numeric_limits<double>::quiet_NaN();
  EXPECT_THROW(map.Anchor(0, broken), std::invalid_argument);
  EXPECT_EQ(map.T_map_odom(0).matrix(), T_map_odom.matrix());
}

TEST(TargetMap, ACorrectionBetweenTwoStampsCountsFromInterpolatedOdometry) {
  TargetMap map = MapOfOneRobot();
  const Pose correction = MakePose(3, 4, 5, 0.3);
  map.CorrectTrajectory(0, {{4500, correction * MakePose(4.5, 0, 0, 0.45)}});
  EXPECT_TRUE(map.T_map_odom(0).isApprox(correction, 1e-9));
}

TEST(TargetMap, CorrectionsOutsideTheTrajectoryAreIgnored) {
  TargetMap map = MapOfOneRobot();
  map.CorrectTrajectory(0, {});
  map.CorrectTrajectory(0, {{-1, MakePose(9, 9, 9, 1)}, {9001, MakePose(9, 9, 9, 1)}});
  EXPECT_TRUE(map.T_map_odom(0).isApprox(Pose::Identity()));
  TargetMap empty({});
  empty.CorrectTrajectory(empty.RobotByName("a"), {{0, MakePose(1, 1, 1, 1)}});
  EXPECT_TRUE(empty.T_map_odom(0).isApprox(Pose::Identity()));
}

TEST(TargetMap, ACorrectionThatIsNotFiniteChangesNothing) {
  TargetMap map = MapOfOneRobot();
  EXPECT_THROW(map.CorrectTrajectory(0, {{3000, MakePose(9, 9, 9, 1)},
                                         {4000, MakePose(std::numeric_limits<double>::infinity(), 0, 0, 0)}}),
               std::invalid_argument);
  EXPECT_TRUE(map.Trajectory(0)[3].T_map_sensor.isApprox(MakePose(3, 0, 0, 0.3), 1e-12));
}

TEST(TargetMap, CentroidsMoveWithThePoseTheyWereSeenFrom) {
  TargetMap map = MapOfOneRobot();
  const SegmentKey key{0, 7};
  map.UpdateSegment(key, MakeView(0, 2, 100), false, 2000);
  map.CorrectTrajectory(0, {{2000, MakePose(100, 0, 0, M_PI / 2)}, {3000, MakePose(0, 0, 0, 0)}});
  const Eigen::Vector3d centroid = map.CentroidMap(map.Find(key)->views.front());
  EXPECT_TRUE(centroid.isApprox(Eigen::Vector3d(98, 1, 3), 1e-12)) << centroid.transpose();
}

TEST(TargetMap, AnUpdateReplacesTheLastViewUnlessItIsKept) {
  TargetMap map = MapOfOneRobot();
  const SegmentKey key{0, 7};
  EXPECT_EQ(map.Find(key), nullptr);
  map.UpdateSegment(key, MakeView(0, 0, 100), true, 0);
  map.UpdateSegment(key, MakeView(0, 1, 110), false, 1000);
  EXPECT_EQ(Sizes(map, key), (std::vector<std::uint32_t>{110}));
  map.UpdateSegment(key, MakeView(0, 2, 120), true, 2000);
  EXPECT_EQ(Sizes(map, key), (std::vector<std::uint32_t>{110, 120}));
  EXPECT_EQ(map.Find(key)->last_seen_ns, 2000);
  EXPECT_TRUE(map.Find(key)->tracked);
}

TEST(TargetMap, AnUpdateReplacesTheViewOfItsOwnRobotOnly) {
  TargetMap map = MapOfOneRobot();
  const RobotIndex other = map.RobotByName("b");
  map.AddPose(other, 1000000, Pose::Identity());  // its clock is ahead
  map.UpdateSegment({0, 7}, MakeView(0, 0, 100), false, 0);
  map.UpdateSegment({other, 3}, MakeView(other, 0, 500), false, 1000000);
  map.MoveViews({other, 3}, {0, 7});
  map.UpdateSegment({0, 7}, MakeView(0, 1, 101), false, 1000);
  EXPECT_EQ(Sizes(map, {0, 7}), (std::vector<std::uint32_t>{101, 500}));
}

TEST(TargetMap, KeepsTheNewestViewAndTheLargestOthers) {
  TargetMap map = MapOfOneRobot(3);
  const SegmentKey key{0, 7};
  const std::vector<std::uint32_t> sizes{100, 500, 200, 400, 150, 90};
  for (std::uint32_t i = 0; i < sizes.size(); ++i) map.UpdateSegment(key, MakeView(0, i, sizes[i]), true, i * 1000);
  EXPECT_EQ(Sizes(map, key), (std::vector<std::uint32_t>{500, 400, 90}));
  TargetMap single = MapOfOneRobot(1);
  for (std::uint32_t i = 0; i < sizes.size(); ++i) single.UpdateSegment(key, MakeView(0, i, sizes[i]), true, i * 1000);
  EXPECT_EQ(Sizes(single, key), (std::vector<std::uint32_t>{90}));
}

TEST(TargetMap, MovedViewsAreOrderedByTheirStamps) {
  TargetMap map = MapOfOneRobot();
  const SegmentKey from{0, 9}, to{0, 4};
  map.UpdateSegment(to, MakeView(0, 0, 10), true, 0);
  map.UpdateSegment(to, MakeView(0, 5, 15), true, 5000);
  map.UpdateSegment(from, MakeView(0, 2, 12), true, 2000);
  map.UpdateSegment(from, MakeView(0, 8, 18), true, 8000);
  map.Find(to)->tracked = false;
  map.MoveViews(from, to);
  EXPECT_EQ(map.Find(from), nullptr);
  EXPECT_EQ(Sizes(map, to), (std::vector<std::uint32_t>{10, 12, 15, 18}));
  EXPECT_EQ(map.Find(to)->last_seen_ns, 8000);
  EXPECT_TRUE(map.Find(to)->tracked);
}

TEST(TargetMap, MovingToANewKeyMakesItAndMovingNothingDoesNothing) {
  TargetMap map = MapOfOneRobot();
  map.UpdateSegment({0, 9}, MakeView(0, 2, 12), true, -5);
  map.MoveViews({0, 9}, {0, 9});
  EXPECT_EQ(Sizes(map, {0, 9}), (std::vector<std::uint32_t>{12}));
  map.MoveViews({0, 9}, {0, 1});
  EXPECT_EQ(Sizes(map, {0, 1}), (std::vector<std::uint32_t>{12}));
  EXPECT_EQ(map.Find({0, 1})->last_seen_ns, -5);
  map.MoveViews({0, 9}, {0, 2});
  EXPECT_EQ(map.segments().size(), 1u);
  map.Erase({0, 1});
  EXPECT_TRUE(map.segments().empty());
}

TEST(TargetMap, RefusesViewsThatHangOnNothing) {
  TargetMap map = MapOfOneRobot();
  EXPECT_THROW(map.UpdateSegment({0, 1}, MakeView(0, 10, 1), true, 0), std::invalid_argument);
  EXPECT_THROW(map.UpdateSegment({0, 1}, MakeView(1, 0, 1), true, 0), std::invalid_argument);
  EXPECT_TRUE(map.segments().empty());
}

TEST(TargetMap, MemoryGrowsWithPoints) {
  TargetMap map = MapOfOneRobot();
  const std::size_t before = map.memory_bytes();
  SegmentView view = MakeView(0, 0, 1000);
  view.points_centroid = std::make_shared<const Points>(1000, Eigen::Vector3f::Zero());
  map.UpdateSegment({0, 1}, view, true, 0);
  EXPECT_GE(map.memory_bytes(), before + 12000);
}

}  // namespace
}  // namespace incremental_segmatch
