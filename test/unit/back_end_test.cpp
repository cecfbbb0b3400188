// When segments become targets of their own robot: view by view, as these get old enough. What is the same becomes one.

#include "incremental_segmatch/back_end.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <functional>
#include <limits>
#include <memory>
#include <random>

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

  /// Where the robot really was.
  void Correct(const std::vector<std::pair<double, double>>& times_s_and_x_m) {
    std::vector<StampedPose> poses;
    for (const auto& [time_s, x_m] : times_s_and_x_m) {
      StampedPose pose;
      pose.stamp_ns = static_cast<StampNs>(time_s * kSecond);
      pose.T_frame_sensor.translation().x() = x_m;
      poses.push_back(pose);
    }
    back_end_.CorrectTrajectory("robot", poses);
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

SegmentState StateAt(SegmentId id, double x_m, float look) {
  SegmentState state = State(id, true);
  state.centroid_odom.x() = x_m;
  state.descriptor.setConstant(look);
  return state;
}

/// Segments 1 and 2 stand at 5 m and 5.3 m and are seen together; an object at 5.1 m is seen as segment 3, 100 s later,
/// when odometry has drifted by 3 m. Returns how many views segment 1 has after the correction, 0 if it is gone.
std::size_t ViewsAfterTheSecondVisit(const BackEndParameters& parameters, float look, bool is_tracked,
                                     std::size_t* segments) {
  Drive drive(parameters);
  drive.AllowedAt(0, 0, {StateAt(1, 5.0, 1.f), StateAt(2, 5.3, 1.f)});
  drive.AllowedAt(10, 100, {}, {{1, RetirementCause::kLeft}, {2, RetirementCause::kLeft}});
  drive.AllowedAt(100, 3, {StateAt(3, 8.1, look)});
  if (!is_tracked) drive.AllowedAt(101, 4, {}, {{3, RetirementCause::kLeft}});
  drive.Correct({{0, 0}, {10, 100}, {100, 0}});
  *segments = drive.back_end().map().segments().size();
  const TargetSegment* const first = drive.back_end().map().Find({0, 1});
  return first == nullptr ? 0 : first->views.size();
}

TEST(BackEnd, WhatLiesOnEachOtherAfterACorrectionIsOneObject) {
  std::size_t segments = 0;
  EXPECT_EQ(ViewsAfterTheSecondVisit({}, 1.2f, false, &segments), 2u);
  EXPECT_EQ(segments, 2u) << "those that were seen together stay two";
  EXPECT_EQ(ViewsAfterTheSecondVisit({}, 3.f, false, &segments), 1u) << "it looks otherwise";
  EXPECT_EQ(segments, 3u);
  EXPECT_EQ(ViewsAfterTheSecondVisit({}, 1.2f, true, &segments), 1u) << "it is tracked: it may still change";
  EXPECT_EQ(segments, 3u);
  BackEndParameters parameters;
  parameters.merging.distance_m = 0.05;
  EXPECT_EQ(ViewsAfterTheSecondVisit(parameters, 1.2f, false, &segments), 1u) << "it is elsewhere";
  parameters.merging.distance_m = 0.0;
  EXPECT_EQ(ViewsAfterTheSecondVisit(parameters, 1.2f, false, &segments), 1u);
}

/// Landmarks along a ring road, seen as new segments on every lap, with odometry that drifts and a map that is
/// corrected at every closure, unless fewer corrections are ordered.
class Laps {
 public:
  explicit Laps(unsigned seed) : Laps(seed, Parameters()) {}
  Laps(unsigned seed, const BackEndParameters& parameters)
      : random_(seed), back_end_(std::make_unique<BackEnd>(parameters)) {
    for (int i = 0; i < 150; ++i) {
      const double angle = 2.0 * M_PI * Unit(), radius_m = kRadius_m + 30.0 * (Unit() - 0.5);
      landmarks_.push_back({{radius_m * std::cos(angle), radius_m * std::sin(angle), 3.0 * Unit()}, Look(2.0), 0});
    }
  }

  static constexpr int kStepsALap = 75;
  std::size_t landmarks() const { return landmarks_.size(); }
  const BackEnd& back_end() const { return *back_end_; }

  /// The map as it is now is loaded and fixed from here on.
  void GoOnInLocalization() {
    BackEndParameters parameters = Parameters();
    parameters.mode = Mode::kLocalization;
    back_end_ = std::make_unique<BackEnd>(parameters, back_end_->map());
    for (Landmark& landmark : landmarks_) landmark.tracked_as = 0;
    deltas_ = 0;
  }

  /// Corrects the map so many times more, and then no more.
  void LastCorrections(std::size_t corrections) { corrections_ = corrections; }

  /// From here on a tracked segment changes with this probability in a step, and each step is checked before the map is
  /// corrected.
  void ChangeSegments(double probability, std::function<void(const Laps&, const BackEndStep&)> check) {
    change_ = probability;
    check_ = std::move(check);
  }
  /// The tracked segments, as they are now.
  const std::map<SegmentId, Descriptor>& tracked() const { return tracked_; }

  static BackEndParameters Parameters() {
    BackEndParameters parameters;
    parameters.refinement.enabled = false;  // there are no scans
    parameters.matching.nearest = 3;  // so few that many a landmark is not recognised, but only found to lie there
    return parameters;
  }

  /// Returns the steps with a closure.
  std::size_t DriveOneLap() {
    std::size_t closures = 0;
    for (int k = 0; k < kStepsALap; ++k) closures += Step();
    return closures;
  }

 private:
  struct Landmark {
    Eigen::Vector3d position;
    Descriptor look;
    SegmentId tracked_as;  // 0: out of sight
  };
  static constexpr double kRadius_m = 60.0;

  double Unit() { return std::uniform_real_distribution<double>(0.0, 1.0)(random_); }
  Descriptor Look(double scale) {
    Descriptor look(6);
    for (float& value : look) value = static_cast<float>(scale * std::normal_distribution<double>()(random_));
    return look;
  }

  bool Step() {
    const double angle = 2.0 * M_PI * step_ / kStepsALap;
    Pose T_world_sensor = Pose::Identity();
    T_world_sensor.linear() = Eigen::AngleAxisd(angle + M_PI / 2.0, Eigen::Vector3d::UnitZ()).toRotationMatrix();
    T_world_sensor.translation() = kRadius_m * Eigen::Vector3d(std::cos(angle), std::sin(angle), 0.0);
    const Pose T_odom_world = Eigen::Translation3d(0.02 * step_, 0.0, 0.0) *
                              Eigen::AngleAxisd(2e-4 * step_, Eigen::Vector3d::UnitZ()) * Pose::Identity();
    SegmentDelta delta;
    delta.robot = "robot";
    delta.sequence = ++deltas_;
    delta.full_state = delta.sequence == 1;
    delta.stamp_ns = (step_ + 1) * kSecond;
    delta.T_odom_sensor = T_odom_world * T_world_sensor;
    for (Landmark& landmark : landmarks_) {
      const bool is_seen = (landmark.position - T_world_sensor.translation()).norm() < 30.0;
      if (is_seen && landmark.tracked_as == 0) {
        landmark.tracked_as = ++last_id_;
        SegmentState state = State(landmark.tracked_as, true);
        const Eigen::Vector3d noise_m = 0.05 * Eigen::Vector3d(Unit(), Unit(), Unit());
        state.centroid_odom = T_odom_world * (landmark.position + noise_m);
        state.descriptor = landmark.look + Look(0.5);
        tracked_[landmark.tracked_as] = state.descriptor;
        delta.changed.push_back(state);
      } else if (!is_seen && landmark.tracked_as != 0) {
        delta.retired.push_back({landmark.tracked_as, RetirementCause::kLeft});
        tracked_.erase(landmark.tracked_as);
        landmark.tracked_as = 0;
      } else if (is_seen && check_ && Unit() < change_) {
        SegmentState state = State(landmark.tracked_as, Unit() < 0.5);
        state.centroid_odom = T_odom_world * landmark.position;
        state.descriptor = landmark.look + Look(0.5);
        tracked_[landmark.tracked_as] = state.descriptor;
        delta.changed.push_back(state);
      }
    }
    ++step_;
    StampedPose truth;
    truth.stamp_ns = delta.stamp_ns;
    truth.T_frame_sensor = T_world_sensor;
    truth_.push_back(truth);
    const BackEndStep step = back_end_->Process(delta);
    if (check_) check_(*this, step);
    const bool is_closure = step.closure.has_value();
    if (is_closure && back_end_->parameters().mode == Mode::kLoopClosure && corrections_ > 0) {
      --corrections_;
      back_end_->CorrectTrajectory("robot", truth_);
    }
    return is_closure;
  }

  std::mt19937 random_;
  std::unique_ptr<BackEnd> back_end_;
  std::vector<Landmark> landmarks_;
  std::map<SegmentId, Descriptor> tracked_;
  double change_ = 0.0;
  std::function<void(const Laps&, const BackEndStep&)> check_;
  std::vector<StampedPose> truth_;
  std::size_t corrections_ = std::numeric_limits<std::size_t>::max();
  int step_ = 0;
  std::uint64_t deltas_ = 0;  // of this back end's life
  SegmentId last_id_ = 0;
};

TEST(BackEnd, TheMapStopsGrowingAfterTheFirstLap) {
  for (unsigned seed = 0; seed < 3; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    Laps laps(seed);
    laps.DriveOneLap();
    const TargetMap& map = laps.back_end().map();
    const std::size_t keyframes = map.Keyframes(0).size();
    laps.DriveOneLap();
    // Those in sight stand in the map twice until their tracking ends.
    const std::size_t segments = map.segments().size();
    EXPECT_LT(segments, laps.landmarks() + laps.landmarks() / 3);
    for (int lap = 3; lap <= 10; ++lap) {
      SCOPED_TRACE("lap " + std::to_string(lap));
      EXPECT_GT(laps.DriveOneLap(), 65u) << "of 75 steps";
      EXPECT_LE(map.segments().size(), segments + 3);
      EXPECT_LE(map.Keyframes(0).size(), keyframes + 10);
      EXPECT_LT(laps.back_end().targets().next_item(), 20 * laps.landmarks()) << "closed items are forgotten";
    }
  }
}

TEST(BackEnd, ARobotThatNobodyCorrectsGoesOnWhereItWasRecognised) {
  for (unsigned seed = 0; seed < 3; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    Laps laps(seed);
    laps.LastCorrections(0);
    laps.DriveOneLap();
    const TargetMap& map = laps.back_end().map();
    for (int lap = 2; lap <= 8; ++lap) {
      SCOPED_TRACE("lap " + std::to_string(lap));
      EXPECT_GT(laps.DriveOneLap(), 65u) << "of 75 steps";
      const auto place = [&](int step) { return map.Trajectory(0)[static_cast<std::size_t>(step)].T_map_sensor.translation(); };
      constexpr int kHalf = Laps::kStepsALap / 2;
      EXPECT_LT((place((lap - 1) * Laps::kStepsALap + kHalf) - place(kHalf)).norm(), 0.3) << "odometry has 0.75 m more on every lap";
      EXPECT_LE(map.segments().size(), 3 * laps.landmarks());
    }
  }
}

TEST(BackEnd, ARobotThatWasCorrectedGoesOnFromThere) {
  Laps laps(1);
  laps.LastCorrections(1);
  laps.DriveOneLap();
  laps.DriveOneLap();
  const Pose T_map_odom = laps.back_end().map().T_map_odom(0);
  EXPECT_FALSE(T_map_odom.isApprox(Pose::Identity(), 1e-6)) << "there was a closure, and a correction";
  EXPECT_GT(laps.DriveOneLap(), 30u);
  EXPECT_EQ(laps.back_end().map().T_map_odom(0).matrix(), T_map_odom.matrix()) << "and closures after it";
}

/// Compares the candidates of all tracked segments with the nearest of all open views, each looked at.
void ExpectNearestCandidates(const Laps& laps, const BackEndStep& step) {
  const TargetIndex& targets = laps.back_end().targets();
  std::map<SegmentId, std::map<SegmentKey, float>> found;
  for (const SegmentMatch& match : step.candidates) found[match.local.id][match.target] = match.descriptor_distance;
  for (const auto& [id, descriptor] : laps.tracked()) {
    std::map<SegmentKey, float> nearest;  // by segment
    for (std::uint64_t item = 0; item < targets.next_item(); ++item) {
      if (!targets.IsOpen(item, 0)) continue;
      const auto entry = nearest.emplace(targets.view(item).segment, std::numeric_limits<float>::infinity()).first;
      entry->second = std::min(entry->second, targets.Distance(descriptor, targets.descriptor(item)));
    }
    std::vector<std::pair<float, SegmentKey>> expected;
    for (const auto& [segment, distance] : nearest) expected.emplace_back(distance, segment);
    std::sort(expected.begin(), expected.end());
    expected.resize(std::min<std::size_t>(expected.size(), 3));
    ASSERT_EQ(found[id].size(), expected.size());
    for (const auto& [distance, segment] : expected) {
      ASSERT_EQ(found[id].count(segment), 1u);
      EXPECT_NEAR(found[id][segment], distance, 1e-4f);
    }
  }
}

TEST(BackEnd, CandidatesAreTheNearestOpenSegmentsWhateverChanged) {
  for (unsigned seed = 0; seed < 3; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    BackEndParameters parameters = Laps::Parameters();
    parameters.matching.requery_distance = 0.0;
    parameters.forgetting.missed_visits = 0;  // nothing is closed after it was matched
    Laps laps(seed, parameters);
    laps.ChangeSegments(0.3, ExpectNearestCandidates);
    for (int lap = 1; lap <= 4 && !::testing::Test::HasFailure(); ++lap) laps.DriveOneLap();
    EXPECT_GT(laps.back_end().targets().generation(), 1u);
  }
}

/// Compares a closure's key frame with the nearest of all that were kept or sighted within reach along the path of where
/// the matched segments, of one view each, were seen from.
void ExpectNearestKeyframe(const Laps& laps, const BackEndStep& step) {
  const BackEnd& back_end = laps.back_end();
  const TargetMap& map = back_end.map();
  const std::vector<TrajectoryPose>& trajectory = map.Trajectory(0);
  for (const std::optional<Closure>& closure : {step.closure, step.refused}) {
    if (!closure) continue;
    const Eigen::Vector3d place = closure->T_map_odom * trajectory.back().T_odom_sensor.translation();
    StampNs nearest_ns = 0;
    double nearest_m = std::numeric_limits<double>::infinity();
    const auto consider = [&](std::uint32_t seen_at, const KeyframeName& keyframe) {
      const TrajectoryPose& pose = trajectory[map.Keyframes(0)[keyframe.index].pose];
      const bool is_young = trajectory.back().stamp_ns - pose.stamp_ns <= 60 * kSecond ||
                            trajectory.back().path_m - pose.path_m <= back_end.parameters().matching.min_path_m;
      const double distance_m = (pose.T_map_sensor.translation() - place).norm();
      if (is_young || distance_m >= nearest_m) return;
      for (const SegmentMatch& match : closure->matches) {
        const double seen_from_m = map.PoseOf(map.Find(match.target)->views.at(0)).path_m;
        if (std::abs(trajectory[seen_at].path_m - seen_from_m) > back_end.parameters().keyframes.reach_m) continue;
        nearest_m = distance_m;
        nearest_ns = pose.stamp_ns;
        return;
      }
    };
    for (std::uint32_t i = 0; i < map.Keyframes(0).size(); ++i) consider(map.Keyframes(0)[i].pose, {0, i});
    for (const Sighting& sighting : map.Sightings(0)) consider(sighting.pose, sighting.keyframe);
    EXPECT_EQ(closure->stamp_target_ns, nearest_ns);
  }
}

TEST(BackEnd, AClosureLeadsToTheNearestKeyframeOfAllAlongThePassesThatSawItsSegments) {
  for (unsigned seed = 0; seed < 3; ++seed) {
    for (const double reach_m : {3.0, 12.0, 50.0}) {
      SCOPED_TRACE("seed " + std::to_string(seed) + ", reach " + std::to_string(reach_m));
      BackEndParameters parameters = Laps::Parameters();
      parameters.target_map.max_views = 1;
      parameters.keyframes.reach_m = reach_m;
      Laps laps(seed, parameters);
      laps.ChangeSegments(0.1, ExpectNearestKeyframe);
      laps.DriveOneLap();
      for (int lap = 2; lap <= 4; ++lap) EXPECT_GT(laps.DriveOneLap(), 30u) << "of 75 steps";
    }
  }
}

TEST(BackEnd, AMapOfManyLapsRecognisesAfterItIsLoaded) {
  for (unsigned seed = 0; seed < 3; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    Laps laps(seed);
    for (int lap = 1; lap <= 8; ++lap) laps.DriveOneLap();
    laps.GoOnInLocalization();
    EXPECT_GT(laps.DriveOneLap(), 65u) << "of 75 steps";
  }
}

}  // namespace
}  // namespace incremental_segmatch
