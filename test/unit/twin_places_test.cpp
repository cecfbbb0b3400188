// Places whose segments are copies of each other: scans and the way tell them apart, or nothing is accepted.

#include <gtest/gtest.h>

#include <cmath>
#include <map>
#include <memory>
#include <random>
#include <string>
#include <vector>

#include "incremental_segmatch/back_end.hpp"

namespace incremental_segmatch {
namespace {

constexpr double kBlock_m = 40.0, kReach_m = 15.0, kStep_m = 2.0;
constexpr int kPosts = 14;  // in a block

struct Thing {
  double size;
  std::vector<Eigen::Vector3d> points;
  Eigen::Vector3d centroid;
};

Thing Post(double x, double y, double size) {
  Thing post{size, {}, {x, y, 1.0}};
  for (double z = 0.0; z < 2.0; z += 0.1) post.points.push_back({x, y, z});
  return post;
}

/// Equal rows of posts, which are segments, and clutter, which is none, that may differ from block to block. One block may
/// have posts of its own.
class Street {
 public:
  Street(int blocks, bool clutter_differs, unsigned seed, int own_block = -1) {
    std::mt19937 random(seed);
    std::uniform_real_distribution<double> along(0.0, kBlock_m), aside(4.0, 12.0), unit(0.0, 1.0);
    const auto across = [&] { return (unit(random) < 0.5 ? -1.0 : 1.0) * aside(random); };
    std::vector<Eigen::Vector3d> posts;  // x, y, size
    for (int i = 0; i < kPosts; ++i) posts.push_back({along(random), across(), 100.0 * (i + 1)});
    std::vector<Eigen::Vector2d> clutter;
    for (int block = 0; block < blocks; ++block) {
      for (const Eigen::Vector3d& p : posts) {
        const bool is_own = block == own_block;
        segments_.push_back(Post(kBlock_m * block + (is_own ? along(random) : p.x()), p.y(), p.z() + (is_own ? 2000.0 : 0.0)));
      }
      if (block == 0 || clutter_differs) {
        clutter.clear();
        for (int i = 0; i < kPosts / 2; ++i) clutter.push_back({along(random), across()});
      }
      for (const Eigen::Vector2d& p : clutter) clutter_.push_back(Post(kBlock_m * block + p.x(), p.y(), 0.0));
    }
  }

  const std::vector<Thing>& segments() const { return segments_; }
  /// Points that are seen from a place on the x axis, relative to it.
  std::shared_ptr<const Points> ScanAt(double x) const {
    auto scan = std::make_shared<Points>();
    for (const std::vector<Thing>* things : {&segments_, &clutter_})
      for (const Thing& thing : *things)
        if (std::abs(thing.centroid.x() - x) <= kReach_m)
          for (const Eigen::Vector3d& p : thing.points) scan->push_back((p - Eigen::Vector3d(x, 0, 0)).cast<float>());
    return scan;
  }

 private:
  std::vector<Thing> segments_, clutter_;
};

BackEndParameters Settings() {
  BackEndParameters parameters;
  parameters.free_space.max_range_m = 1e-6;  // posts hide nothing: seeing through things is no matter here
  return parameters;
}

/// A robot that sees all segments within reach. Odometry starts anew with each pass, where and how turned nobody knows.
class Robot {
 public:
  explicit Robot(const Street& street) : street_(street), back_end_(Settings()) {}

  struct Accepted {
    double x = 0.0;  ///< where
    bool is_true = false;
  };
  struct Step {
    double x = 0.0;
    BackEndStep result;
    bool has_rival = false;          ///< another place matches nearly as many segments
    std::vector<Accepted> accepted;  ///< with this step: settled ones, and its own
  };

  std::vector<Step> Drive(double from_m, double to_m) {
    time_s_ += 100.0;
    const Pose T_odom_world = Eigen::Translation3d(30.0 * pass_, -500.0 * pass_, 0.0) *
                              Eigen::AngleAxisd(0.8 * pass_, Eigen::Vector3d::UnitZ());
    ++pass_;
    std::vector<Step> steps;
    for (double x = from_m; x <= to_m; x += kStep_m) {
      time_s_ += 0.5;
      SegmentDelta delta;
      delta.robot = "robot";
      delta.sequence = ++sequence_;
      delta.full_state = true;
      delta.stamp_ns = static_cast<StampNs>(time_s_ * 1e9);
      const Pose T_world_sensor(Eigen::Translation3d(x, 0.0, 0.0));
      delta.T_odom_sensor = T_odom_world * T_world_sensor;
      delta.scan_sensor = street_.ScanAt(x);
      for (std::size_t i = 0; i < street_.segments().size(); ++i) {
        const Thing& thing = street_.segments()[i];
        if (std::abs(thing.centroid.x() - x) > kReach_m) continue;
        SegmentState state;
        state.id = street_.segments().size() * pass_ + i + 1;
        state.size = static_cast<std::uint32_t>(thing.size);
        state.centroid_odom = T_odom_world * thing.centroid;
        state.descriptor = Descriptor::Constant(4, static_cast<float>(thing.size / 1000.0));
        state.new_view = true;
        delta.changed.push_back(state);
      }
      Step step{x, back_end_.Process(delta), false, {}};
      const auto& evidence = step.result.counts.evidence;
      step.has_rival = evidence && HasRival(*evidence, back_end_.parameters().acceptance);
      truth_[delta.stamp_ns] = T_world_sensor;
      std::vector<Closure> closures = step.result.settled;
      if (step.result.closure) closures.push_back(*step.result.closure);
      for (const Closure& closure : closures) {
        const Pose& T_world_query = truth_.at(closure.stamp_query_ns);
        const Pose truth = truth_.at(closure.stamp_target_ns).inverse() * T_world_query;
        step.accepted.push_back(
            {T_world_query.translation().x(), (truth.inverse() * closure.T_target_query).translation().norm() < 0.5});
      }
      steps.push_back(std::move(step));
    }
    return steps;
  }

 private:
  const Street& street_;
  BackEnd back_end_;
  std::map<StampNs, Pose> truth_;
  std::uint64_t sequence_ = 0, pass_ = 0;
  double time_s_ = 0.0;
};

/// A pass along the first blocks, and what comes of another one from here to there.
std::vector<Robot::Step> DriveAgain(const Street& street, int blocks, double from_m, double to_m) {
  Robot robot(street);
  robot.Drive(0.0, blocks * kBlock_m);
  return robot.Drive(from_m, to_m);
}

void ExpectTrue(const Robot::Step& step) {
  for (const Robot::Accepted& accepted : step.accepted) EXPECT_TRUE(accepted.is_true) << "accepted: at " << accepted.x << " m";
}

TEST(TwinPlaces, AreToldApartByScansAfterSomeWay) {
  for (unsigned seed = 1; seed <= 5; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    const Street street(2, true, seed);
    int rivals = 0, accepted = 0;
    bool any_certain = false;
    for (const Robot::Step& step : DriveAgain(street, 2, 0.0, 2 * kBlock_m)) {
      SCOPED_TRACE("at " + std::to_string(step.x) + " m: " + ToString(step.result.counts.end));
      rivals += step.has_rival;
      ExpectTrue(step);
      if (!step.result.closure) continue;
      accepted += step.has_rival;
      any_certain |= !step.has_rival;
      if (!any_certain) {
        EXPECT_GE(step.x, AcceptanceParameters().min_track_m - 1e-6) << "before there was a track";
      }
    }
    EXPECT_GT(rivals, 10) << "nothing deceives here";
    EXPECT_GE(accepted, 3) << "the way and the scans tell enough";
  }
}

TEST(TwinPlaces, ThatAreCopiesInAllAreNotAccepted) {
  for (unsigned seed = 1; seed <= 5; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    const Street street(4, false, seed);
    int refused = 0;
    // No scan sees where the row of copies begins or ends.
    for (const Robot::Step& step : DriveAgain(street, 4, 1.5 * kBlock_m, 2.5 * kBlock_m)) {
      EXPECT_TRUE(step.accepted.empty()) << "at " << step.x << " m";
      refused += step.result.counts.end == StepEnd::kAmbiguous;
    }
    EXPECT_GE(refused, 10) << "nothing deceives here";
  }
}

TEST(TwinPlaces, AreToldApartByTheWayFromACertainOne) {
  int settled = 0, carried_on = 0;
  for (unsigned seed = 1; seed <= 5; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    // Copies in all, but for the block in the middle.
    const Street street(5, false, seed, 2);
    bool any_certain = false;
    for (const Robot::Step& step : DriveAgain(street, 5, kBlock_m, 4.5 * kBlock_m)) {
      SCOPED_TRACE("at " + std::to_string(step.x) + " m: " + ToString(step.result.counts.end));
      ExpectTrue(step);
      any_certain |= step.result.closure && !step.has_rival;
      if (!any_certain) {
        EXPECT_TRUE(step.accepted.empty()) << "before anything was certain";
      }
      if (step.accepted.size() > 1) {
        for (const Robot::Accepted& accepted : step.accepted) EXPECT_LE(accepted.x, step.x);
        settled += static_cast<int>(step.accepted.size()) - 1;
      }
      carried_on += step.has_rival && !step.accepted.empty() && step.x > 3.5 * kBlock_m;
    }
  }
  EXPECT_GE(settled, 5) << "what was ambiguous before it";
  EXPECT_GE(carried_on, 20) << "and after it";
}

TEST(TwinPlaces, AreNotTakenForOneThatWasNeverVisited) {
  for (unsigned seed = 1; seed <= 5; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    const Street street(5, true, seed);
    int recognitions = 0;
    for (const Robot::Step& step : DriveAgain(street, 2, 3 * kBlock_m, 5 * kBlock_m)) {
      recognitions += step.result.counts.clique >= 6;
      EXPECT_TRUE(step.accepted.empty()) << "at " << step.x << " m";
    }
    EXPECT_GT(recognitions, 20);
  }
}

TEST(TwinPlaces, EndATrackWhereTheMapEnds) {
  int accepted = 0;
  for (unsigned seed = 1; seed <= 5; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    // Certain in the first block of the map, and then on beyond it, where all is a copy of the map.
    const Street street(6, false, seed, 0);
    for (const Robot::Step& step : DriveAgain(street, 3, 0.0, 6 * kBlock_m)) {
      SCOPED_TRACE("at " + std::to_string(step.x) + " m: " + ToString(step.result.counts.end));
      ExpectTrue(step);
      accepted += static_cast<int>(step.accepted.size());
    }
  }
  EXPECT_GT(accepted, 100);
}

}  // namespace
}  // namespace incremental_segmatch
