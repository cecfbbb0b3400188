#include "evaluation/kidnap_comparison.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <nlohmann/json.hpp>
#include <stdexcept>

namespace incremental_segmatch {
namespace {

constexpr StampNs kSecond = 1000000000;

// 100 steps, one a second and one metre apart along x.
EvaluationResult Straight() {
  EvaluationResult result;
  result.score.emplace();
  for (int i = 0; i < 100; ++i) {
    Pose T = Pose::Identity();
    T.translation().x() = i;
    result.odometry.push_back({i * kSecond, T});
  }
  return result;
}

ClosureRow Row(int query, int target, double off_m) {
  ClosureRow row;
  row.stamp_query_ns = query * kSecond;
  row.stamp_target_ns = target * kSecond;
  row.T_target_query.translation().x() = 5.0 - target + off_m;  // always near what is at x = 5 m
  return row;
}

TEST(KidnapComparison, TellsThePartsOfTheDriveApart) {
  EvaluationResult undisturbed = Straight(), carried = Straight();
  Pose T_moved = Pose::Identity();
  T_moved.translation().y() = 300.0;
  for (std::size_t i = 50; i < 100; ++i)
    carried.odometry[i].T_frame_sensor = T_moved * carried.odometry[i].T_frame_sensor;
  undisturbed.closures = {Row(40, 4, 0.0), Row(55, 5, 0.0), Row(60, 5, 0.0), Row(80, 5, 0.0), Row(90, 7, 0.0)};
  carried.closures = {Row(40, 4, 0.0), Row(60, 5, 0.5), Row(80, 6, 0.25), Row(90, 7, 0.0), Row(95, 7, 0.0)};
  carried.score->false_closures = 3;
  const KidnapComparison comparison = CompareKidnapped("street", undisturbed, carried, 50, 20.0);
  EXPECT_EQ(comparison.false_undisturbed, 0u);
  EXPECT_EQ(comparison.false_carried, 3u);
  ASSERT_EQ(comparison.parts.size(), 3u);
  const KidnapPart &before = comparison.parts[0], &refill = comparison.parts[1], &after = comparison.parts[2];
  EXPECT_EQ(before.steps, 50u);
  EXPECT_EQ(before.undisturbed, 1u);
  EXPECT_EQ(before.both, 1u);
  EXPECT_EQ(before.difference_max_m, 0.0);
  EXPECT_EQ(refill.steps, 21u);
  EXPECT_EQ(refill.undisturbed, 2u);
  EXPECT_EQ(refill.carried, 1u);
  EXPECT_EQ(refill.both, 1u);
  EXPECT_NEAR(refill.difference_max_m, 0.5, 1e-12);
  EXPECT_EQ(after.undisturbed, 2u);
  EXPECT_EQ(after.carried, 3u);
  EXPECT_EQ(after.both, 2u);
  EXPECT_NEAR(after.difference_max_m, 0.25, 1e-12) << "targets differ, and odometry joins them";
  EXPECT_NEAR(after.difference_max_deg, 0.0, 1e-9);

  EXPECT_NE(KidnapMarkdown({comparison}).find("| street | after that | 29 | 2 | 3 | 2 |"), std::string::npos);
  const nlohmann::json json = nlohmann::json::parse(KidnapJson({comparison}));
  EXPECT_EQ(json[0]["parts"][1]["undisturbed"], 2);
}

TEST(KidnapComparison, RefusesRunsThatDoNotBelongTogether) {
  EvaluationResult undisturbed = Straight(), carried = Straight();
  carried.odometry.pop_back();
  EXPECT_THROW(CompareKidnapped("x", undisturbed, carried, 50, 20.0), std::invalid_argument);
  carried = Straight();
  ++carried.odometry[3].stamp_ns;
  EXPECT_THROW(CompareKidnapped("x", undisturbed, carried, 50, 20.0), std::invalid_argument);
  carried = Straight();
  carried.score.reset();
  EXPECT_THROW(CompareKidnapped("x", undisturbed, carried, 50, 20.0), std::invalid_argument);
}

}  // namespace
}  // namespace incremental_segmatch
