// Corrections of the trajectory and jumps of the odometry frame: what is recognised afterwards is what would have been
// recognised without them, moved by the correction.
#include <gtest/gtest.h>

#include <random>
#include <vector>

#include "incremental_segmatch/back_end.hpp"
#include "incremental_segmatch/front_end.hpp"
#include "synthetic_drive.hpp"

namespace incremental_segmatch {
namespace {

using test::SyntheticDrive;

/// A correction by some metres and any yaw, as a SLAM stack with gravity makes them.
Pose RandomCorrection(std::mt19937& random) {
  std::uniform_real_distribution<double> unit(-1.0, 1.0);
  Pose T = Pose::Identity();
  T.linear() = Eigen::AngleAxisd(M_PI * unit(random), Eigen::Vector3d::UnitZ()).toRotationMatrix();
  T.translation() << 20.0 * unit(random), 20.0 * unit(random), unit(random);
  return T;
}

class Corrections : public testing::Test {
 protected:
  static constexpr int kScans = 2 * SyntheticDrive::kScansPerLap;

  struct Jump {
    int scan = 0;
    Pose T_new_old = Pose::Identity();
  };
  enum class Frame { kContinuous, kJumping };

  static std::vector<BackEndStep> Drive(const std::vector<Jump>& jumps, Frame frame) {
    static const SyntheticDrive drive;
    FrontEndParameters front_end_parameters;
    front_end_parameters.local_radius_m = 20.0;
    BackEndParameters back_end_parameters;
    back_end_parameters.matching.time_window_s = 20.0;
    FrontEnd front_end(front_end_parameters, "robot");
    BackEnd back_end(back_end_parameters);
    std::vector<BackEndStep> steps;
    std::vector<StampedPose> trajectory;  // in the map, as the SLAM stack has it
    Pose T_map_odom = Pose::Identity();   // of the odometry that never jumped
    auto jump = jumps.begin();
    for (int i = 0; i < kScans; ++i) {
      if (jump != jumps.end() && jump->scan == i) {
        for (StampedPose& pose : trajectory) pose.T_frame_sensor = jump->T_new_old * pose.T_frame_sensor;
        T_map_odom = jump->T_new_old * T_map_odom;
        back_end.CorrectTrajectory("robot", trajectory);
        if (frame == Frame::kJumping) front_end.ApplyJump(jump->T_new_old);
        ++jump;
      }
      Scan scan{drive.stamp_ns(i), drive.Scan(i), drive.T_odom_sensor(i)};
      trajectory.push_back({scan.stamp_ns, T_map_odom * scan.T_odom_sensor});
      if (frame == Frame::kJumping) scan.T_odom_sensor = T_map_odom * scan.T_odom_sensor;
      steps.push_back(back_end.Process(front_end.Process(scan).delta));
    }
    EXPECT_GT(back_end.memory_bytes(), back_end.map().memory_bytes() + 100000) << "past scans and prepared ones are left out";
    return steps;
  }

  /// The stack corrects here as well, but nothing changes: a robot that nobody corrects goes on where it was recognised.
  static const std::vector<BackEndStep>& Undisturbed() {
    static const std::vector<BackEndStep> steps = Drive({{10, Pose::Identity()}}, Frame::kContinuous);
    return steps;
  }

  static void Compare(Frame frame, unsigned seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    std::mt19937 random(seed);
    // In the first lap, and amid the closures of the second one.
    std::vector<Jump> jumps;
    for (const int begin : {10, 70, 95})
      jumps.push_back({begin + static_cast<int>(random() % 20), RandomCorrection(random)});
    const std::vector<BackEndStep>& expected = Undisturbed();
    const std::vector<BackEndStep> steps = Drive(jumps, frame);
    ASSERT_EQ(steps.size(), expected.size());
    std::size_t closures_before = 0, closures_after = 0;
    for (int i = 0; i < kScans; ++i) {
      SCOPED_TRACE("scan " + std::to_string(i));
      const auto k = static_cast<std::size_t>(i);
      EXPECT_STREQ(ToString(steps[k].counts.end), ToString(expected[k].counts.end));
      EXPECT_EQ(steps[k].counts.local_segments, expected[k].counts.local_segments);
      ASSERT_EQ(steps[k].closure.has_value(), expected[k].closure.has_value());
      if (!steps[k].closure) continue;
      ++(i < jumps[1].scan ? closures_before : closures_after);
      const Closure& a = *steps[k].closure;
      const Closure& b = *expected[k].closure;
      EXPECT_EQ(a.stamp_target_ns, b.stamp_target_ns);
      EXPECT_EQ(a.inliers, b.inliers);
      const Pose error = b.T_target_query.inverse() * a.T_target_query;
      EXPECT_LT(error.translation().norm(), 0.02);
      EXPECT_LT(Eigen::AngleAxisd(error.linear()).angle(), 0.002);
      // Where the recognition puts the robot: moved by the corrections so far.
      Pose T = Pose::Identity();
      for (const Jump& jump : jumps)
        if (jump.scan <= i) T = jump.T_new_old * T;
      const Pose T_odom = frame == Frame::kJumping ? T : Pose::Identity();
      const Pose place_error = (T * b.T_map_odom).inverse() * a.T_map_odom * T_odom;
      EXPECT_LT((place_error * SyntheticDrive().T_odom_sensor(i).translation() -
                 SyntheticDrive().T_odom_sensor(i).translation())
                    .norm(),
                0.02);
      for (std::size_t m = 0; m < a.matches.size(); ++m) {
        EXPECT_LT((a.matches[m].centroid_local_odom - T_odom * b.matches[m].centroid_local_odom).norm(), 0.01);
        EXPECT_LT((a.matches[m].centroid_target_map - T * b.matches[m].centroid_target_map).norm(), 0.01);
      }
    }
    EXPECT_GT(closures_before, 2u);
    EXPECT_GT(closures_after, 20u);
  }
};

TEST_F(Corrections, OfTheTrajectoryMoveTheMap) {
  Compare(Frame::kContinuous, 0);
}

TEST_F(Corrections, ByWhichTheOdometryFrameJumpsMoveAllTogether) {
  Compare(Frame::kJumping, 10);
}

}  // namespace
}  // namespace incremental_segmatch
