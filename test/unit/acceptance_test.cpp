#include "incremental_segmatch/acceptance.hpp"

#include <gtest/gtest.h>

#include <limits>
#include <random>
#include <stdexcept>
#include <string>

namespace incremental_segmatch {
namespace {

// Evidence that leaves nothing to be desired.
Evidence Good() {
  Evidence evidence;
  evidence.inliers = 20;
  evidence.expected = 60;
  evidence.supported = 40;
  evidence.overlap = 0.9;
  evidence.sigma_m = 0.01;
  evidence.sigma_rad = 0.001;
  evidence.distance_m = 1.0;
  return evidence;
}

TEST(Acceptance, EachPartOfTheEvidenceCanRefuse) {
  const AcceptanceParameters parameters;
  EXPECT_EQ(Judge(Good(), parameters), Verdict::kAccepted);
  const auto judge = [&](auto spoil) {
    Evidence evidence = Good();
    spoil(evidence);
    return Judge(evidence, parameters);
  };
  EXPECT_EQ(judge([](Evidence& e) { e.runner_up = 11; }), Verdict::kAccepted);
  EXPECT_EQ(judge([](Evidence& e) { e.runner_up = 12; }), Verdict::kAmbiguous);
  EXPECT_EQ(judge([](Evidence& e) { e.since_twin_m = 99.0; }), Verdict::kAmbiguous);
  EXPECT_EQ(judge([](Evidence& e) { e.since_twin_m = 101.0; }), Verdict::kAccepted);
  EXPECT_EQ(judge([](Evidence& e) { e.supported = 14; }), Verdict::kUncovered);
  EXPECT_EQ(judge([](Evidence& e) { e.expected = e.supported = 0; }), Verdict::kUncovered);
  EXPECT_EQ(judge([](Evidence& e) { e.contradiction = 0.07; }), Verdict::kContradicted);
  EXPECT_EQ(judge([](Evidence& e) { e.contradiction_once = 0.21; }), Verdict::kContradicted);
  EXPECT_EQ(judge([](Evidence& e) { e.sigma_m = 0.6; }), Verdict::kUncertain);
  EXPECT_EQ(judge([](Evidence& e) { e.sigma_rad = 0.03; }), Verdict::kUncertain);
  EXPECT_EQ(judge([](Evidence& e) { e.distance_m = 21.0; }), Verdict::kTooFar);
}

TEST(Acceptance, WhereSegmentsDeceiveTheWayAndTheScansDecide) {
  const AcceptanceParameters parameters;
  const auto judge = [&](auto change) {
    Evidence evidence = Good();
    evidence.runner_up = 19;
    evidence.distinction = 0.8;
    evidence.track_m = 51.0;
    evidence.track_fit = 0.995;
    change(evidence);
    return Judge(evidence, parameters);
  };
  EXPECT_EQ(judge([](Evidence&) {}), Verdict::kAccepted);
  EXPECT_EQ(judge([](Evidence& e) { e.distinction = 0.7; }), Verdict::kAmbiguous);
  EXPECT_EQ(judge([](Evidence& e) { e.track_m = 49.0; }), Verdict::kAmbiguous);
  EXPECT_EQ(judge([](Evidence& e) { e.track_fit = 0.985; }), Verdict::kAmbiguous);
  EXPECT_EQ(judge([](Evidence& e) { e.runner_up = 0, e.distinction = 0.0, e.since_twin_m = 50.0; }), Verdict::kAccepted)
      << "no rival now";
  EXPECT_EQ(judge([](Evidence& e) { e.contradiction = 0.07; }), Verdict::kContradicted);
  EXPECT_EQ(judge([](Evidence& e) { e.distinction = e.track_m = 0.0, e.on_proven_track = true; }), Verdict::kAccepted);
  EXPECT_EQ(judge([](Evidence& e) { e.contradiction = 0.07, e.on_proven_track = true; }), Verdict::kContradicted);
}

TEST(Acceptance, StrengthIsTheSmallestFactorByWhichALimitIsKept) {
  const AcceptanceParameters parameters;
  Evidence evidence = Good();
  evidence.contradiction = 0.03;  // half of what is allowed; coverage and the sigmas are farther from theirs
  EXPECT_DOUBLE_EQ(Strength(evidence, parameters), 2.0);
  evidence.runner_up = 8;
  EXPECT_DOUBLE_EQ(Strength(evidence, parameters), 20.0 / 14.0);
  evidence.since_twin_m = 25.0;
  EXPECT_DOUBLE_EQ(Strength(evidence, parameters), 0.25);
  evidence.track_m = 60.0;
  evidence.track_fit = 0.995;
  EXPECT_DOUBLE_EQ(Strength(evidence, parameters), 60.0 / 50.0) << "borne out by the way";
  evidence.on_proven_track = true;
  EXPECT_DOUBLE_EQ(Strength(evidence, parameters), 2.0);
  AcceptanceParameters lax;
  lax.min_coverage = lax.twin_memory_m = 0.0;
  EXPECT_EQ(Strength(Evidence(), lax), std::numeric_limits<double>::infinity());
}

TEST(Acceptance, StrengthOfOneDividesWhatIsAcceptedFromWhatIsRefused) {
  for (unsigned seed = 1; seed <= 5; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    std::mt19937 random(seed);
    std::uniform_real_distribution<double> uniform(0.0, 1.0);
    const auto chance = [&](double share) { return uniform(random) < share; };
    // Mostly within its limit, and often at it.
    const auto around = [&](double limit) {
      return chance(0.2) ? limit : chance(0.1) ? 0.0 : limit * (chance(0.9) ? uniform(random) : 2.0 * uniform(random));
    };
    std::size_t accepted = 0, refused = 0;
    for (int i = 0; i < 2000; ++i) {
      AcceptanceParameters parameters;
      if (chance(0.1)) parameters.min_coverage = 0.0;
      if (chance(0.1)) parameters.twin_memory_m = 0.0;
      Evidence evidence;
      evidence.inliers = 6 + random() % 30;
      evidence.runner_up = random() % (chance(0.1) ? 20 : 4);
      evidence.expected = random() % 40;
      evidence.supported = chance(0.9) ? evidence.expected : random() % (evidence.expected + 1);
      if (chance(0.1)) evidence.since_twin_m = 2.0 * parameters.twin_memory_m * uniform(random);
      evidence.track_m = 2.0 * parameters.min_track_m * uniform(random);
      evidence.track_fit = chance(0.2) ? parameters.min_track_fit : 0.9 + 0.1 * uniform(random);
      evidence.on_proven_track = chance(0.1);
      evidence.distinction = chance(0.2) ? parameters.min_distinction : uniform(random);
      evidence.contradiction = around(parameters.max_contradiction);
      evidence.contradiction_once = around(parameters.max_contradiction_once);
      evidence.sigma_m = around(parameters.max_sigma_m);
      evidence.sigma_rad = around(parameters.max_sigma_rad);
      evidence.distance_m = around(parameters.max_distance_m);
      const bool accepts = Judge(evidence, parameters) == Verdict::kAccepted;
      EXPECT_EQ(Strength(evidence, parameters) >= 1.0, accepts) << "evidence " << i;
      ++(accepts ? accepted : refused);
    }
    EXPECT_GT(accepted, 300u);
    EXPECT_GT(refused, 300u);
  }
}

TEST(Acceptance, CoverageCountsSegmentsWhereTheMapWasSeen) {
  Evidence evidence;
  // Supported, expected only, beyond the neighbourhood.
  MeasureCoverage({{0, 0, 0}, {5, 0, 0}, {50, 0, 0}}, {{0.5, 0, 0}}, AcceptanceParameters(), &evidence);
  EXPECT_EQ(evidence.expected, 2u);
  EXPECT_EQ(evidence.supported, 1u);
  EXPECT_EQ(evidence.Coverage(), 0.5);
}

TEST(Acceptance, RefusesParametersOutOfRange) {
  AcceptanceParameters parameters;
  parameters.min_ratio = -1.0;
  EXPECT_THROW(Validate(parameters), std::invalid_argument);
  parameters = AcceptanceParameters();
  parameters.max_contradiction = 1.5;
  EXPECT_THROW(Validate(parameters), std::invalid_argument);
  parameters = AcceptanceParameters();
  parameters.max_contradiction_once = -0.5;
  EXPECT_THROW(Validate(parameters), std::invalid_argument);
}

}  // namespace
}  // namespace incremental_segmatch
