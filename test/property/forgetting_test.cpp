// What leaves the target map because it was not seen again: equal to going through all that ever happened, at every step.
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <map>
#include <random>
#include <set>
#include <string>
#include <vector>

#include "incremental_segmatch/back_end.hpp"

namespace incremental_segmatch {
namespace {

constexpr StampNs kSecond = 1000000000;

/// How a robot drives.
enum class Driving {
  kLaps,   ///< lap after lap, where all stays as it is
  kWander  ///< turns round, waits and goes on as it likes, while landmarks come and go
};

/// A robot on a ring road, among landmarks, and pieces that are seen once and never again. Its odometry
/// does not drift. Beside it, the diary: all that happened to every segment.
class Town {
 public:
  static constexpr int kStepsALap = 75;

  Town(unsigned seed, const BackEndParameters& parameters, Driving driving)
      : random_(seed), back_end_(parameters), driving_(driving) {
    for (int i = 0; i < 120; ++i) {
      const double angle = 2.0 * M_PI * Unit(), radius_m = kRadius_m + 30.0 * (Unit() - 0.5);
      landmarks_.push_back({{radius_m * std::cos(angle), radius_m * std::sin(angle), 3.0 * Unit()}, Look(2.0), 0, true});
    }
  }

  const TargetMap& map() const { return back_end_.map(); }
  std::size_t forgotten() const { return forgotten_; }
  std::size_t closures() const { return closures_; }
  /// Pieces that came within the last so many steps, and those of all that are in the map.
  std::size_t PiecesOfTheLast(int steps) const {
    return CountPieces([&](const Piece& piece) { return piece.step > step_ - steps; });
  }
  std::size_t PiecesInMap() const {
    return CountPieces([&](const Piece& piece) { return map().Find(piece.key) != nullptr; });
  }

  /// Another robot takes over.
  void GoOnAs(const std::string& robot) {
    robot_ = robot;
    robot_index_ = static_cast<RobotIndex>(map().robots());
    sequence_ = 0;
    truth_.clear();
    for (Landmark& landmark : landmarks_) landmark.tracked_as = 0;
  }

  /// The robot comes back another day, with the map of this one.
  void GoOnAnotherDay() {
    back_end_ = BackEnd(back_end_.parameters(), TargetMap(map()));
    GoOnAs(robot_);
  }

  /// One lap, or as many steps as that takes.
  void DriveALap() {
    for (int step = 0; step < kStepsALap; ++step) {
      Move();
      const bool is_closure = back_end_.Process(LookAround()).closure.has_value();
      if (is_closure) back_end_.CorrectTrajectory(robot_, truth_);
    }
  }

  /// One scan of a single robot; what is counted and what is forgotten must be what the diary says.
  void CheckedStep() {
    Move();
    const std::set<SegmentKey> untracked = Untracked();
    const std::size_t sightings_before = Sightings();
    const BackEndStep step = back_end_.Process(LookAround());
    NoteNewViews(sightings_before);
    ExpectForgotten(untracked, sightings_before);
    for (const Closure& closure : step.settled) NoteMatches(closure, sightings_before);
    if (step.closure) NoteMatches(*step.closure, sightings_before);
    if (step.closure) {
      back_end_.CorrectTrajectory(robot_, truth_);
      NoteNewViews(Sightings());
    }
    ExpectCounts();
    if (step.closure) ++closures_;
  }
 private:
  struct Landmark {
    Eigen::Vector3d position;
    Descriptor look;
    SegmentId tracked_as;  // 0: out of sight
    bool stands;
  };
  struct Piece {
    SegmentKey key;
    int step;  // when it was seen
  };
  struct Entry {  // of the diary
    std::size_t seen_at = 0;
    std::set<std::uint32_t> views;  // poses that they hang on
    std::uint32_t from = 0;         // pose of the nearest look
  };
  static constexpr double kRadius_m = 60.0, kSight_m = 30.0;

  double Unit() { return std::uniform_real_distribution<double>(0.0, 1.0)(random_); }
  Descriptor Look(double scale) {
    Descriptor look(6);
    for (float& value : look) value = static_cast<float>(scale * std::normal_distribution<double>()(random_));
    return look;
  }

  void Move() {
    if (driving_ == Driving::kWander && Unit() < 0.01) forward_ = !forward_;
    if (driving_ == Driving::kWander && Unit() < 0.01) stamp_ns_ += 100 * kSecond;  // waits
    at_ += forward_ ? 1 : -1;
    stamp_ns_ += kSecond;
    ++step_;
  }

  template <class Predicate>
  std::size_t CountPieces(const Predicate& predicate) const {
    return static_cast<std::size_t>(std::count_if(pieces_.begin(), pieces_.end(), predicate));
  }

  static SegmentState State(SegmentId id, const Eigen::Vector3d& centroid, const Descriptor& look) {
    SegmentState state;
    state.id = id;
    state.size = 100;
    state.new_view = true;
    state.centroid_odom = centroid;
    state.descriptor = look;
    return state;
  }

  SegmentDelta LookAround() {
    const double angle = 2.0 * M_PI * at_ / kStepsALap;
    SegmentDelta delta;
    delta.robot = robot_;
    delta.sequence = ++sequence_;
    delta.full_state = sequence_ == 1;
    delta.stamp_ns = stamp_ns_;
    delta.T_odom_sensor.linear() = Eigen::AngleAxisd(angle, Eigen::Vector3d::UnitZ()).toRotationMatrix();
    delta.T_odom_sensor.translation() = kRadius_m * Eigen::Vector3d(std::cos(angle), std::sin(angle), 0.0);
    for (Landmark& landmark : landmarks_) {
      const bool is_near = (landmark.position - delta.T_odom_sensor.translation()).norm() < kSight_m;
      if (driving_ == Driving::kWander && !is_near && Unit() < 0.003) landmark.stands = !landmark.stands;  // a car parks, or drives away
      const bool is_seen = is_near && landmark.stands;
      if (is_seen && landmark.tracked_as == 0) {
        landmark.tracked_as = ++last_id_;
        const Eigen::Vector3d noise_m = 0.05 * Eigen::Vector3d(Unit(), Unit(), Unit());
        delta.changed.push_back(State(landmark.tracked_as, landmark.position + noise_m, landmark.look + Look(0.5)));
      } else if (!is_seen && landmark.tracked_as != 0) {
        delta.retired.push_back({landmark.tracked_as, RetirementCause::kLeft});
        landmark.tracked_as = 0;
      }
    }
    if (!pieces_.empty() && pieces_.back().step == step_ - 1)
      delta.retired.push_back({pieces_.back().key.id, RetirementCause::kLeft});
    if (Unit() < 0.3) {
      const Eigen::Vector3d above_all(10.0 * (Unit() - 0.5), 10.0 * (Unit() - 0.5), 5.0 + 3.0 * Unit());
      pieces_.push_back({{robot_index_, ++last_id_}, step_});
      delta.changed.push_back(State(last_id_, delta.T_odom_sensor.translation() + above_all, Look(2.0)));
    }
    StampedPose pose;
    pose.stamp_ns = delta.stamp_ns;
    pose.T_frame_sensor = delta.T_odom_sensor;
    truth_.push_back(pose);
    return delta;
  }

  std::size_t Sightings() const { return map().robots() == 0 ? 0 : map().Sightings(0).size(); }
  std::set<SegmentKey> Untracked() const {
    std::set<SegmentKey> keys;
    for (const auto& [key, segment] : map().segments())
      if (!segment.tracked) keys.insert(key);
    return keys;
  }

  // ---- The diary: when each segment was last seen, as a number of sightings, and what it was then ------------------
  void NoteMatches(const Closure& closure, std::size_t sightings) {
    for (const SegmentMatch& match : closure.matches) diary_[match.target].seen_at = sightings;
  }
  void NoteNewViews(std::size_t sightings) {
    for (const auto& [key, segment] : map().segments()) {
      std::set<std::uint32_t> poses;
      for (const SegmentView& view : segment.views) poses.insert(view.pose);
      Entry& entry = diary_[key];
      if (entry.views != poses || segment.tracked) entry.seen_at = sightings;
      entry.views = poses;
      const auto nearest = std::min_element(segment.views.begin(), segment.views.end(), [](const auto& a, const auto& b) {
        return a.centroid_sensor.norm() < b.centroid_sensor.norm();
      });
      entry.from = nearest->pose;
    }
  }
  /// The key frame at which the robot was, or is, at a pose: the last one that it kept or sighted.
  std::uint32_t KeyframeAt(std::uint32_t pose) const {
    std::int64_t last = -1;
    std::uint32_t keyframe = 0;
    const auto consider = [&](std::uint32_t at, std::uint32_t index) {
      if (at > pose || at <= last) return;
      last = at;
      keyframe = index;
    };
    for (std::uint32_t i = 0; i < map().Keyframes(0).size(); ++i) consider(map().Keyframes(0)[i].pose, i);
    for (const Sighting& sighting : map().Sightings(0)) consider(sighting.pose, sighting.keyframe.index);
    return keyframe;
  }

  /// Of two poses of the trajectory, by their indices: the later one is still on the visit of the earlier one.
  bool IsOneVisit(std::uint32_t earlier, std::uint32_t later) const {
    const MatchingParameters& matching = back_end_.parameters().matching;
    const TrajectoryPose &a = map().Trajectory(0)[earlier], &b = map().Trajectory(0)[later];
    return static_cast<double>(b.stamp_ns - a.stamp_ns) <= matching.time_window_s * 1e9 ||
           b.path_m - a.path_m <= matching.min_path_m;
  }

  /// Of the first so many sightings those that began visits of where a segment was seen from: each is another visit than the
  /// one before it.
  std::vector<std::size_t> Visits(const Entry& entry, std::size_t count) const {
    const std::vector<Sighting>& sightings = map().Sightings(0);
    const auto path_m = [&](std::uint32_t keyframe) { return map().Trajectory(0)[map().Keyframes(0)[keyframe].pose].path_m; };
    const double from_m = path_m(KeyframeAt(entry.from));
    std::vector<std::size_t> visits;
    for (std::size_t i = 0; i < count; ++i) {
      const bool is_there =
          std::abs(path_m(sightings[i].keyframe.index) - from_m) <= back_end_.parameters().keyframes.submap_radius_m;
      if (is_there && (visits.empty() || !IsOneVisit(sightings[visits.back()].pose, sightings[i].pose))) visits.push_back(i);
    }
    return visits;
  }

  /// Of the visits that the first so many sightings make, those since a segment was last seen.
  std::uint32_t MissedVisits(const Entry& entry, std::size_t count) const {
    std::uint32_t missed = 0;
    for (const std::size_t visit : Visits(entry, count))
      missed += visit >= entry.seen_at && !IsOneVisit(*entry.views.rbegin(), map().Sightings(0)[visit].pose);
    return missed;
  }

  /// Those that are untracked are judged when a visit has just ended, by what they were before the step.
  void ExpectForgotten(const std::set<SegmentKey>& untracked, std::size_t sightings) {
    const ForgettingParameters& limits = back_end_.parameters().forgetting;
    const auto now = static_cast<std::uint32_t>(map().Trajectory(0).size() - 1);
    for (const SegmentKey& key : untracked) {
      const Entry& entry = diary_.at(key);
      bool is_expected = false;
      for (const std::size_t visit : Visits(entry, sightings)) {
        const std::uint32_t began = map().Sightings(0)[visit].pose;
        if (IsOneVisit(began, now) || !IsOneVisit(began, now - 1)) continue;
        const auto missed = static_cast<int>(MissedVisits(entry, sightings));
        const bool is_glimpse = *entry.views.begin() >= began && static_cast<int>(entry.views.size()) < limits.min_views;
        is_expected = is_expected || is_glimpse || (limits.missed_visits > 0 && missed >= limits.missed_visits);
      }
      EXPECT_EQ(map().Find(key) == nullptr, is_expected) << "segment " << key.id;
      forgotten_ += is_expected;
    }
    for (const Landmark& landmark : landmarks_) {
      if (landmark.tracked_as == 0) continue;
      EXPECT_NE(map().Find({robot_index_, landmark.tracked_as}), nullptr) << "segment " << landmark.tracked_as << " is tracked";
    }
  }
  void ExpectCounts() const {
    for (const auto& [key, segment] : map().segments()) EXPECT_EQ(segment.missed_visits, MissedVisits(diary_.at(key), Sightings())) << "segment " << key.id;
  }

  std::mt19937 random_;
  BackEnd back_end_;
  Driving driving_;
  bool forward_ = true;
  int at_ = 0;
  StampNs stamp_ns_ = 0;
  int step_ = 0;
  std::string robot_ = "one";
  RobotIndex robot_index_ = 0;  // in the map
  std::uint64_t sequence_ = 0;
  SegmentId last_id_ = 0;
  std::vector<Landmark> landmarks_;
  std::vector<Piece> pieces_;
  std::vector<StampedPose> truth_;
  std::map<SegmentKey, Entry> diary_;
  std::size_t forgotten_ = 0, closures_ = 0;
};

BackEndParameters Forgetting(int missed_visits, int min_views = 0) {
  BackEndParameters parameters;
  parameters.refinement.enabled = false;  // there are no scans
  parameters.matching.nearest = 3;        // so few that many a landmark is not recognised, but only found to lie there
  parameters.forgetting.missed_visits = missed_visits;
  parameters.forgetting.min_views = min_views;
  return parameters;
}

TEST(Forgetting, EqualsTheDiaryAtEveryStep) {
  std::size_t forgotten = 0;
  for (unsigned seed = 0; seed < 24; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    const int missed_visits = static_cast<int>(seed % 4);
    const int min_views = static_cast<int>(seed / 4 % 4);
    Town town(seed, Forgetting(missed_visits, min_views), seed % 3 == 0 ? Driving::kLaps : Driving::kWander);
    for (int step = 0; step < 400; ++step) {
      town.CheckedStep();
      if (::testing::Test::HasFailure()) return;
    }
    EXPECT_GT(town.closures(), 200u) << "of 400 steps";
    if (missed_visits == 0 && min_views < 2) {
      EXPECT_EQ(town.forgotten(), 0u);
    }
    forgotten += town.forgotten();
  }
  EXPECT_GT(forgotten, 1000u) << "the sequences should exercise forgetting";
}

TEST(Forgetting, WhatWasSeenOnceStaysForSoManyVisitsAndNoLonger) {
  for (unsigned seed = 0; seed < 6; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    const int missed_visits = 1 + static_cast<int>(seed % 3);
    Town town(seed, Forgetting(missed_visits), Driving::kLaps);
    for (int lap = 1; lap <= 12; ++lap) {
      SCOPED_TRACE("lap " + std::to_string(lap));
      town.DriveALap();
      // Each is missed on the visits after its own, and leaves when the last of them is over: before that lap is full.
      const int least = missed_visits * Town::kStepsALap, most = (missed_visits + 1) * Town::kStepsALap;
      EXPECT_GE(town.PiecesInMap() + 1, town.PiecesOfTheLast(least)) << "but for some that are taken for others";
      EXPECT_LE(town.PiecesInMap(), town.PiecesOfTheLast(most) + 1) << "but for some that others are taken for";
    }
  }
}

TEST(Forgetting, WhatAVisitAddsWithoutASecondLookLeavesAfterIt) {
  for (unsigned seed = 0; seed < 6; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    Town town(seed, Forgetting(100, 2), Driving::kLaps);
    town.DriveALap();
    const std::size_t pieces = town.PiecesInMap();
    EXPECT_GT(pieces, 10u) << "a place that is new keeps all";
    for (int lap = 2; lap <= 6; ++lap) {
      SCOPED_TRACE("lap " + std::to_string(lap));
      town.DriveALap();
      EXPECT_GE(town.PiecesInMap() + 1, pieces) << "but for some that are taken for others";
      EXPECT_LE(town.PiecesInMap(), pieces + town.PiecesOfTheLast(Town::kStepsALap) + 1);
    }
  }
}

TEST(Forgetting, VisitsOfAnotherRobotAndOfAnotherDayCount) {
  for (unsigned seed = 0; seed < 6; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    Town town(seed, Forgetting(2), Driving::kLaps);
    const auto go_on = [&] { seed % 2 == 0 ? town.GoOnAs("two") : town.GoOnAnotherDay(); };
    town.DriveALap();
    if (seed % 3 == 0) town.DriveALap();
    const std::size_t pieces = town.PiecesInMap();
    EXPECT_GT(pieces, 10u);
    go_on();
    town.DriveALap();
    EXPECT_GE(town.PiecesInMap(), pieces) << "it is the first or the second visit since";
    if (seed % 2 == 1) go_on();
    for (int lap = 2; lap <= 4; ++lap) town.DriveALap();
    EXPECT_LE(town.PiecesInMap(), town.PiecesOfTheLast(3 * Town::kStepsALap) + 1);
  }
}

}  // namespace
}  // namespace incremental_segmatch
