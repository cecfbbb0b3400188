#include "incremental_segmatch/acceptance.hpp"

#include <gtest/gtest.h>

#include <stdexcept>

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
