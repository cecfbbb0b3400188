// Places whose segments are copies of each other: scans and the way tell them apart, or nothing is accepted.

#include <gtest/gtest.h>

#include <string>
#include <vector>

#include "incremental_segmatch/back_end.hpp"
#include "support/twin_street.hpp"

namespace incremental_segmatch {
namespace {

using test::kBlock_m;
using test::Street;
using test::StreetRobot;

BackEndParameters Settings() {
  BackEndParameters parameters;
  parameters.free_space.max_range_m = 1e-6;  // posts hide nothing: seeing through things is no matter here
  return parameters;
}

/// A robot and its back end.
class Robot {
 public:
  explicit Robot(const Street& street) : robot_(street), back_end_(Settings()) {}

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

  /// Corrected to where odometry has it: the passes lie apart in the map, and only the street deceives.
  std::vector<Step> Drive(double from_m, double to_m) {
    std::vector<Step> steps;
    for (const StreetRobot::Sight& sight : robot_.Pass(from_m, to_m)) {
      Step step{sight.x, back_end_.Process(sight.delta), false, {}};
      const auto& evidence = step.result.counts.evidence;
      step.has_rival = evidence && HasRival(*evidence, back_end_.parameters().acceptance);
      std::vector<Closure> closures = step.result.settled;
      if (step.result.closure) closures.push_back(*step.result.closure);
      for (const Closure& closure : closures) {
        const Pose& T_world_query = robot_.T_world_sensor(closure.stamp_query_ns);
        const Pose truth = robot_.T_world_sensor(closure.stamp_target_ns).inverse() * T_world_query;
        step.accepted.push_back(
            {T_world_query.translation().x(), (truth.inverse() * closure.T_target_query).translation().norm() < 0.5});
      }
      steps.push_back(std::move(step));
      back_end_.CorrectTrajectory(sight.delta.robot, {{sight.delta.stamp_ns, sight.delta.T_odom_sensor}});
    }
    return steps;
  }

 private:
  StreetRobot robot_;
  BackEnd back_end_;
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
    // Copies in all, but for one block: so many that the largest sets speak for two others.
    const Street street(8, false, seed, 3);
    bool any_certain = false;
    for (const Robot::Step& step : DriveAgain(street, 8, 2 * kBlock_m, 7.5 * kBlock_m)) {
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
      carried_on += step.has_rival && !step.accepted.empty() && step.x > 5 * kBlock_m;
    }
  }
  EXPECT_GE(settled, 5) << "what was ambiguous before it";
  EXPECT_GE(carried_on, 200) << "and after it";
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
