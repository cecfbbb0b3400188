// A constructed visit and revisit: which segments have a true target, its rank, and what loses it.
#include "evaluation/true_pairs.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <string>

namespace incremental_segmatch {
namespace {

constexpr StampNs kSecond = 1000000000;
constexpr int kObjects = 8;

Pose MakePose(double x, double y, double yaw) {
  Pose T = Pose::Identity();
  T.linear() = Eigen::AngleAxisd(yaw, Eigen::Vector3d::UnitZ()).toRotationMatrix();
  T.translation() << x, y, 1.7;
  return T;
}

// Objects in the world, in no regular order, and where they are seen on the second visit: the last one elsewhere.
Eigen::Vector3d Place(int object) {
  return {14.0 * std::cos(1.9 * object + 0.2 * object * object), 15.0 * std::sin(2.3 * object + 1.0), 0.3 * object};
}
Eigen::Vector3d PlaceAgain(int object) {
  return Place(object) + Eigen::Vector3d(object == 7 ? 1.5 : 0.02 * object, 0.0, 0.0);
}

Descriptor Looks(float value) {
  return Descriptor::Constant(1, value);
}
// Object 2 looks like the sixth of the others: its own is the sixth nearest then.
float ValueAgain(int object) {
  return object == 2 ? 46.f : 10.f * static_cast<float>(object) + 1.f;
}

SegmentState State(SegmentId id, std::uint32_t size, const Eigen::Vector3d& centroid_odom, float value) {
  SegmentState state;
  state.id = id;
  state.size = size;
  state.centroid_odom = centroid_odom;
  state.descriptor = Looks(value);
  state.new_view = true;
  return state;
}

struct Visits {
  TrueTrajectory truth;
  std::vector<SegmentDelta> deltas;
};

// Here at 0 s, all but segment 7 gone at 1 s, far away at 40 s, and here again at 80 s, where odometry has drifted.
Visits MakeVisits() {
  Visits visits;
  const Pose T_drift = MakePose(7.0, 3.0, 0.4);
  const std::vector<StampNs> stamps{0, kSecond, 40 * kSecond, 80 * kSecond};
  const std::vector<Pose> poses{MakePose(0, 0, 0), MakePose(5, 0, 0), MakePose(120, 0, 1), MakePose(1, 1, 2)};
  for (std::size_t i = 0; i < poses.size(); ++i) {
    visits.truth.stamps_ns.push_back(stamps[i]);
    visits.truth.T_world_sensor.push_back(poses[i]);
    SegmentDelta delta;
    delta.robot = "robot";
    delta.sequence = i + 1;
    delta.stamp_ns = stamps[i];
    delta.T_odom_sensor = i < 3 ? poses[i] : T_drift * poses[i];
    delta.full_state = i == 0;
    visits.deltas.push_back(delta);
  }
  for (int k = 0; k < kObjects; ++k) {
    const SegmentId id = static_cast<SegmentId>(k) + 1;
    visits.deltas[0].changed.push_back(State(id, 200, Place(k), 10.f * static_cast<float>(k)));
    if (k != 6) visits.deltas[1].retired.push_back({id, RetirementCause::kLeft});
    visits.deltas[3].changed.push_back(State(id + 10, 100 + 10 * id, T_drift * PlaceAgain(k), ValueAgain(k)));
  }
  // Would be seen again if it had not become part of another one.
  visits.deltas[2].changed.push_back(State(9, 50, Place(7), 3.f));
  visits.deltas[3].renamed.push_back({9, 11});
  return visits;
}

BackEndParameters Parameters() {
  BackEndParameters parameters;
  parameters.matching.nearest = 5;
  parameters.recognizer.clique.min_size = 4;
  parameters.refinement.enabled = false;  // there are no scans
  return parameters;
}

void ExpectPairs(const std::vector<TruePair>& pairs, RobotIndex local_robot, bool seventh_is_open) {
  ASSERT_EQ(pairs.size(), 7u) << "the last object was seen farther away than a metre";
  for (int k = 0; k < 7; ++k) {
    SCOPED_TRACE("object " + std::to_string(k));
    const TruePair& pair = pairs[static_cast<std::size_t>(k)];
    const SegmentId id = static_cast<SegmentId>(k) + 1;
    EXPECT_EQ(pair.local, (SegmentKey{local_robot, id + 10}));
    EXPECT_EQ(pair.target, (SegmentKey{0, id}));
    EXPECT_NEAR(pair.centroid_difference_m, 0.02 * k, 1e-9);
    EXPECT_DOUBLE_EQ(pair.size_ratio, (100.0 + 10 * id) / 200.0);
    const bool open = k != 6 || seventh_is_open;
    EXPECT_EQ(pair.allowed, open);
    EXPECT_EQ(pair.rank, !open ? 0u : k == 2 ? 6u - !seventh_is_open : 1u);
    EXPECT_EQ(pair.nearest, open && pair.rank <= 5);
    EXPECT_EQ(pair.within, pair.nearest);
  }
}

TEST(TruePairs, ARevisitHasThoseThatTheTruthJoins) {
  const Visits visits = MakeVisits();
  BackEnd back_end(Parameters());
  TruePairFinder finder(visits.truth, nullptr, ScoringParameters());
  std::vector<TruePair> pairs;
  for (std::size_t i = 0; i < visits.deltas.size(); ++i) {
    const BackEndStep step = back_end.Process(visits.deltas[i]);
    pairs = finder.Step(i, visits.deltas[i], step, back_end);
    EXPECT_EQ(pairs.empty(), i < 3) << "only the last step is a revisit";
  }
  // The rank is the place in the list that matching would get without a limit.
  for (const TruePair& pair : pairs) {
    const std::vector<TargetCandidate> all =
        back_end.targets().Nearest(Looks(ValueAgain(static_cast<int>(pair.local.id) - 11)), 0, 0, 1e9f);
    EXPECT_EQ(all.size(), 7u);
    EXPECT_TRUE(!pair.allowed || all[pair.rank - 1].segment == pair.target);
  }
  // Segment 7 is tracked still, and is not open to its own robot. Without it the target of object 2 is the fifth.
  ExpectPairs(pairs, 0, false);
  for (const int k : {0, 1, 3, 4, 5}) EXPECT_TRUE(pairs[static_cast<std::size_t>(k)].consistent) << k;
  EXPECT_FALSE(pairs[6].consistent);
}

TEST(TruePairs, ALoadedMapIsAllOpen) {
  const Visits visits = MakeVisits();
  BackEnd mapper(Parameters());
  for (const SegmentDelta& delta : visits.deltas) {
    if (delta.stamp_ns < 80 * kSecond) mapper.Process(delta);
  }
  BackEndParameters parameters = Parameters();
  parameters.mode = Mode::kLocalization;
  BackEnd back_end(parameters, mapper.map());
  SegmentDelta delta = visits.deltas[3];
  delta.stamp_ns = 5 * kSecond;
  delta.full_state = true;
  delta.renamed.clear();
  const TrueTrajectory truth{{5 * kSecond}, {visits.truth.T_world_sensor[3]}};
  TruePairFinder finder(truth, &visits.truth, ScoringParameters());
  const BackEndStep step = back_end.Process(delta);
  // The second segment at the place of the last object was in the map under its own ID.
  ExpectPairs(finder.Step(0, delta, step, back_end), 1, true);
}

TEST(TruePairs, AShortLimitOfDistanceCuts) {
  const Visits visits = MakeVisits();
  BackEndParameters parameters = Parameters();
  parameters.matching.max_distance = 0.5;
  BackEnd back_end(parameters);
  TruePairFinder finder(visits.truth, nullptr, ScoringParameters());
  std::vector<TruePair> pairs;
  for (std::size_t i = 0; i < visits.deltas.size(); ++i)
    pairs = finder.Step(i, visits.deltas[i], back_end.Process(visits.deltas[i]), back_end);
  ASSERT_EQ(pairs.size(), 7u);
  for (const TruePair& pair : pairs) EXPECT_FALSE(pair.within) << "descriptors differ by 1 and more";
  EXPECT_TRUE(pairs[0].nearest);
}

TEST(TruePairs, AreSummedUp) {
  std::vector<TruePair> pairs(20);
  for (std::size_t i = 0; i < pairs.size(); ++i) {
    pairs[i].step = i / 4;
    pairs[i].centroid_difference_m = 0.01 * static_cast<double>(i);
    pairs[i].size_ratio = 0.05 * static_cast<double>(i);
    pairs[i].allowed = i < 16;
    pairs[i].rank = i < 16 ? i + 1 : 0;
    pairs[i].nearest = i < 10;
    pairs[i].within = i < 8;
    pairs[i].consistent = i < 4;
  }
  const TruePairStatistics statistics = MeasureTruePairs(pairs);
  EXPECT_EQ(statistics.pairs, 20u);
  EXPECT_EQ(statistics.steps, 5u);
  EXPECT_EQ(statistics.rank_median, 9.0);
  EXPECT_EQ(statistics.rank_90, 15.0);
  EXPECT_EQ(statistics.kept_allowed, 0.8);
  EXPECT_EQ(statistics.kept_nearest, 0.5);
  EXPECT_EQ(statistics.kept_within, 0.4);
  EXPECT_EQ(statistics.kept_consistent, 0.2);
  ASSERT_EQ(statistics.share_within_rank.size(), 5u);
  EXPECT_EQ(statistics.share_within_rank[1], (std::pair<std::size_t, double>{5, 5.0 / 16}));
  EXPECT_EQ(statistics.share_within_rank[4].second, 1.0);
  EXPECT_DOUBLE_EQ(statistics.centroid_difference_90_m, 0.18);
  EXPECT_DOUBLE_EQ(statistics.size_ratio_10, 0.1);
  EXPECT_TRUE(std::isnan(MeasureTruePairs({}).kept_allowed));
}

}  // namespace
}  // namespace incremental_segmatch
