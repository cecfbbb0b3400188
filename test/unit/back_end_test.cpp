// When segments become targets of their own robot: view by view, as these get old enough.

#include "incremental_segmatch/back_end.hpp"

#include <gtest/gtest.h>

namespace incremental_segmatch {
namespace {

constexpr StampNs kSecond = 1000000000;

SegmentState State(SegmentId id, bool new_view) {
  SegmentState state;
  state.id = id;
  state.size = 100 + static_cast<std::uint32_t>(id);
  state.descriptor = Descriptor::Constant(4, static_cast<float>(id));
  state.new_view = new_view;
  return state;
}

/// A robot that drives along x; segments are told by hand.
class Drive {
 public:
  explicit Drive(const BackEndParameters& parameters = {}) : back_end_(parameters) {}

  /// The targets that are open after the robot got from where it was to x_m at a time.
  std::size_t AllowedAt(double time_s, double x_m, std::vector<SegmentState> changed = {},
                        std::vector<RetiredSegment> retired = {}, const std::string& robot = "robot") {
    SegmentDelta delta;
    delta.robot = robot;
    delta.sequence = ++sequences_[robot];
    delta.full_state = delta.sequence == 1;
    delta.stamp_ns = static_cast<StampNs>(time_s * kSecond);
    delta.T_odom_sensor.translation().x() = x_m;
    delta.changed = std::move(changed);
    delta.retired = std::move(retired);
    return back_end_.Process(delta).counts.allowed_targets;
  }

  const BackEnd& back_end() const { return back_end_; }

 private:
  BackEnd back_end_;
  std::map<std::string, std::uint64_t> sequences_;
};

TEST(BackEnd, AnOldViewIsATargetThoughItsSegmentWasSeenLately) {
  Drive drive;
  EXPECT_EQ(drive.AllowedAt(0, 0, {State(1, true), State(2, true)}), 0u);
  EXPECT_EQ(drive.AllowedAt(50, 60, {State(1, true)}), 0u);
  EXPECT_EQ(drive.AllowedAt(61, 80), 0u) << "both are tracked still";
  EXPECT_EQ(drive.AllowedAt(62, 85, {}, {{1, RetirementCause::kLeft}}), 1u) << "seen 62 s ago, and 12 s ago";
  EXPECT_EQ(drive.AllowedAt(63, 86, {}, {{2, RetirementCause::kLeft}}), 2u);
}

TEST(BackEnd, ViewsWaitForTimeAndForPath) {
  Drive drive;
  drive.AllowedAt(0, 0, {State(1, true)});
  EXPECT_EQ(drive.AllowedAt(10, 45, {}, {{1, RetirementCause::kLeft}}), 0u);
  EXPECT_EQ(drive.AllowedAt(60, 49), 0u) << "not old enough in either";
  EXPECT_EQ(drive.AllowedAt(70, 50), 0u) << "in time, but not in path";
  EXPECT_EQ(drive.AllowedAt(71, 51), 1u);

  Drive fast;
  fast.AllowedAt(0, 0, {State(1, true)});
  EXPECT_EQ(fast.AllowedAt(10, 200, {}, {{1, RetirementCause::kLeft}}), 0u);
  EXPECT_EQ(fast.AllowedAt(60, 300), 0u) << "in path, but not in time";
  EXPECT_EQ(fast.AllowedAt(60.1, 301), 1u);
}

TEST(BackEnd, ASegmentThatIsTooLargeIsNoTargetEver) {
  Drive drive;
  drive.AllowedAt(0, 0, {State(1, true)});
  drive.AllowedAt(1, 10, {}, {{1, RetirementCause::kTooLarge}});
  EXPECT_EQ(drive.AllowedAt(100, 500), 0u);
  EXPECT_TRUE(drive.back_end().map().segments().empty());
}

TEST(BackEnd, WhatAnotherRobotSeesIsATargetAtOnce) {
  Drive drive;
  drive.AllowedAt(0, 0, {State(1, true)}, {}, "one");
  EXPECT_EQ(drive.AllowedAt(1, 0, {}, {}, "two"), 1u);
  EXPECT_EQ(drive.AllowedAt(2, 1, {State(2, true)}, {}, "one"), 2u) << "tracked ones as well";
}

}  // namespace
}  // namespace incremental_segmatch
