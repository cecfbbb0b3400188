// Contract 5: partitioned == cached == all pairs, edge for edge, and so are the pairs that sets of some size may hold.
#include "incremental_segmatch/consistency_graph.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <map>
#include <random>
#include <set>
#include <string>
#include <tuple>

namespace incremental_segmatch {
namespace {

using EdgeSet = std::vector<ConsistencyGraph::Edge>;

constexpr double kInfinity = std::numeric_limits<double>::infinity();

/// The definition, as directly as it can be written.
EdgeSet ExpectedEdges(const Correspondences& c, const ConsistencyParameters& parameters) {
  EdgeSet edges;
  for (std::uint32_t i = 0; i < c.size(); ++i) {
    for (std::uint32_t j = i + 1; j < c.size(); ++j) {
      if (c[i].local == c[j].local || c[i].target == c[j].target) continue;
      const Eigen::Vector3d local = c[i].centroid_local - c[j].centroid_local;
      const Eigen::Vector3d target = c[i].centroid_target - c[j].centroid_target;
      if (!(std::abs(local.norm() - target.norm()) <= parameters.epsilon_m)) continue;
      const double rise = std::abs(local.z() - target.z());
      const bool steep = std::isfinite(parameters.max_vertical_slope) &&
                         rise > parameters.epsilon_m + parameters.max_vertical_slope * local.norm();
      if (!steep) edges.emplace_back(i, j);
    }
  }
  return edges;
}

EdgeSet EdgesOf(const ConsistencyGraph& graph) {
  EdgeSet edges;
  for (std::uint32_t v = 0; v < graph.vertices(); ++v) {
    const ConsistencyGraph::Range range = graph.Neighbours(v);
    EXPECT_TRUE(std::is_sorted(range.begin(), range.end()));
    for (const std::uint32_t u : range) {
      EXPECT_TRUE(graph.HasEdge(u, v));
      if (v < u) edges.emplace_back(v, u);
    }
  }
  EXPECT_EQ(edges.size(), graph.edges);
  return edges;
}

Correspondence Make(SegmentId local, SegmentId target, const Eigen::Vector3d& p_local,
                    const Eigen::Vector3d& p_target) {
  Correspondence c;
  c.local = {0, local};
  c.target = {1, target};
  c.centroid_local = p_local;
  c.centroid_target = p_target;
  return c;
}

ConsistencyParameters With(ConsistencyMethod method) {
  ConsistencyParameters parameters;
  parameters.method = method;
  return parameters;
}

const std::map<std::string, ConsistencyMethod>& Methods() {
  static const std::map<std::string, ConsistencyMethod> methods{{"all pairs", ConsistencyMethod::kAllPairs},
                                                                {"squares", ConsistencyMethod::kPartitioned2D},
                                                                {"cubes", ConsistencyMethod::kPartitioned3D},
                                                                {"cached", ConsistencyMethod::kCached},
                                                                {"auto", ConsistencyMethod::kAuto}};
  return methods;
}

/// One for each method and for all instructions.
std::map<std::string, ConsistencyGraphBuilder> Builders(ConsistencyParameters parameters) {
  std::map<std::string, ConsistencyGraphBuilder> builders;
  for (const auto& [name, method] : Methods()) {
    parameters.method = method;
    for (const auto& [suffix, instructions] : {std::make_pair("", Instructions::kAvx512),
                                               std::make_pair(", AVX2", Instructions::kAvx2),
                                               std::make_pair(", portable", Instructions::kPortable)}) {
      parameters.instructions = instructions;
      builders.emplace(name + suffix, parameters);
    }
  }
  return builders;
}

/// Segments that move, are renamed, vanish and appear while correspondences come and go.
class RandomSequence {
 public:
  explicit RandomSequence(unsigned seed) : random_(seed) {
    const double offsets_m[] = {0.0, -37.0, 1e5, -1e5, 3e6};
    local_offset_ = {Pick(offsets_m), Pick(offsets_m), 10.0 * Signed()};
    target_offset_ = {Pick(offsets_m), Pick(offsets_m), 10.0 * Signed()};
    snapped_ = Chance(0.25);
    local_radius_m_ = 5.0 + 45.0 * Unit();
    target_radius_m_ = local_radius_m_ * (1.0 + 9.0 * Unit());
    height_m_ = Chance(0.3) ? 60.0 : 4.0;
    parameters_.epsilon_m = snapped_ ? 0.5 : 0.1 + Unit();
    const double slopes[] = {0.1, 0.0, 0.5, kInfinity};
    parameters_.max_vertical_slope = Pick(slopes);
    parameters_.cache_theta_m = 0.3 + 5.0 * Unit();
    const std::size_t locals = 3 + random_() % 30;
    const std::size_t targets = 5 + random_() % 120;
    for (std::size_t i = 0; i < locals; ++i) locals_[next_id_++] = LocalPoint();
    for (std::size_t i = 0; i < targets; ++i) targets_[next_id_++] = TargetPoint();
    // Some targets are the local segments, seen before.
    const double yaw = 6.3 * Unit();
    for (const auto& [id, p] : std::map<SegmentId, Eigen::Vector3d>(locals_)) {
      const Eigen::Vector3d turned = Eigen::AngleAxisd(yaw, Eigen::Vector3d::UnitZ()) * (p - local_offset_);
      targets_[next_id_] = Snap(turned + target_offset_ + 0.1 * Eigen::Vector3d(Signed(), Signed(), Signed()));
      pairs_.insert({id, next_id_++});
    }
    const std::size_t pairs = 20 + random_() % 300;
    for (std::size_t i = 0; i < pairs; ++i) pairs_.insert({RandomKey(locals_), RandomKey(targets_)});
  }

  const ConsistencyParameters& parameters() const { return parameters_; }

  void Step() {
    const double amplitudes_m[] = {0.0, 0.05, 0.4 * parameters_.cache_theta_m, 3.0 * parameters_.cache_theta_m};
    const double amplitude_m = Pick(amplitudes_m);
    for (auto& [id, p] : locals_) {
      if (Chance(0.5)) p = Snap(p + amplitude_m * Eigen::Vector3d(Signed(), Signed(), 0.3 * Signed()));
    }
    if (Chance(0.3)) {  // the trajectory was corrected
      for (auto& [id, p] : targets_) p = Snap(p + amplitude_m * Eigen::Vector3d(Signed(), Signed(), 0.1 * Signed()));
    }
    if (Chance(0.5) && locals_.size() > 3) Rename(RandomKey(locals_), RandomKey(locals_));
    if (Chance(0.3) && locals_.size() > 3) Forget(locals_, RandomKey(locals_));
    if (Chance(0.3) && targets_.size() > 3) Forget(targets_, RandomKey(targets_));
    if (Chance(0.5)) locals_[next_id_++] = LocalPoint();
    if (Chance(0.5)) targets_[next_id_++] = TargetPoint();
    for (auto pair = pairs_.begin(); pair != pairs_.end();) pair = Chance(0.1) ? pairs_.erase(pair) : std::next(pair);
    for (int i = 0; i < 15; ++i) pairs_.insert({RandomKey(locals_), RandomKey(targets_)});
  }

  /// In random order; now and then with a pair given twice, or with a coordinate that is no number.
  Correspondences Current() {
    Correspondences result;
    for (const auto& [local, target] : pairs_) {
      result.push_back(Make(local, target, locals_.at(local), targets_.at(target)));
    }
    if (Chance(0.1)) result.push_back(result[random_() % result.size()]);
    if (Chance(0.1)) result[random_() % result.size()].centroid_local.y() = std::nan("");
    if (Chance(0.05)) result[random_() % result.size()].centroid_target.x() = kInfinity;
    std::shuffle(result.begin(), result.end(), random_);
    return result;
  }

 private:
  double Unit() { return std::uniform_real_distribution<double>(0.0, 1.0)(random_); }
  double Signed() { return 2.0 * Unit() - 1.0; }
  bool Chance(double p) { return Unit() < p; }
  template <std::size_t n>
  double Pick(const double (&values)[n]) {
    return values[random_() % n];
  }
  SegmentId RandomKey(const std::map<SegmentId, Eigen::Vector3d>& segments) {
    return std::next(segments.begin(), static_cast<long>(random_() % segments.size()))->first;
  }
  Eigen::Vector3d Snap(const Eigen::Vector3d& p) const { return snapped_ ? Eigen::Vector3d(p.array().round()) : p; }
  Eigen::Vector3d LocalPoint() {
    return Snap(local_offset_ +
                Eigen::Vector3d(local_radius_m_ * Signed(), local_radius_m_ * Signed(), height_m_ * Signed()));
  }
  Eigen::Vector3d TargetPoint() {
    return Snap(target_offset_ +
                Eigen::Vector3d(target_radius_m_ * Signed(), target_radius_m_ * Signed(), height_m_ * Signed()));
  }
  void Forget(std::map<SegmentId, Eigen::Vector3d>& segments, SegmentId id) {
    segments.erase(id);
    for (auto pair = pairs_.begin(); pair != pairs_.end();) {
      pair = pair->first == id || pair->second == id ? pairs_.erase(pair) : std::next(pair);
    }
  }
  void Rename(SegmentId newer, SegmentId older) {
    if (newer == older) return;
    std::set<std::pair<SegmentId, SegmentId>> renamed;
    for (const auto& [local, target] : pairs_) renamed.insert({local == newer ? older : local, target});
    pairs_ = renamed;
    locals_.at(older) = Snap(0.5 * (locals_.at(older) + locals_.at(newer)));
    locals_.erase(newer);
  }

  std::mt19937 random_;
  ConsistencyParameters parameters_;
  Eigen::Vector3d local_offset_, target_offset_;
  bool snapped_;
  double local_radius_m_, target_radius_m_, height_m_;
  SegmentId next_id_ = 1;
  std::map<SegmentId, Eigen::Vector3d> locals_, targets_;
  std::set<std::pair<SegmentId, SegmentId>> pairs_;
};

TEST(ConsistencyGraph, EveryMethodGivesTheEdgesOfTheDefinition) {
  std::size_t edges_seen = 0;
  for (unsigned seed = 0; seed < 1000; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    RandomSequence sequence(seed);
    std::map<std::string, ConsistencyGraphBuilder> builders = Builders(sequence.parameters());
    for (int step = 0; step < 8; ++step) {
      SCOPED_TRACE("step " + std::to_string(step));
      const Correspondences correspondences = sequence.Current();
      const EdgeSet expected = ExpectedEdges(correspondences, sequence.parameters());
      edges_seen += expected.size();
      for (auto& [name, builder] : builders) {
        const ConsistencyGraph graph = builder.Build(correspondences);
        ASSERT_EQ(graph.vertices(), correspondences.size()) << name;
        ASSERT_EQ(EdgesOf(graph), expected) << name;
      }
      sequence.Step();
    }
  }
  EXPECT_GT(edges_seen, 100000u) << "the sequences are too thin to say anything";
}

/// The definition of a truss, as directly as it can be written: edges go until each is in k - 2 triangles.
EdgeSet ExpectedTruss(EdgeSet edges, std::size_t k) {
  for (;;) {
    std::map<std::uint32_t, std::set<std::uint32_t>> neighbours;
    for (const auto& [a, b] : edges) {
      neighbours[a].insert(b);
      neighbours[b].insert(a);
    }
    const auto in_too_few = [&](const ConsistencyGraph::Edge& edge) {
      std::size_t triangles = 0;
      for (const std::uint32_t v : neighbours[edge.first]) triangles += neighbours[edge.second].count(v);
      return triangles + 2 < k;
    };
    const auto last = std::remove_if(edges.begin(), edges.end(), in_too_few);
    if (last == edges.end()) return edges;
    edges.erase(last, edges.end());
  }
}

EdgeSet Sorted(EdgeSet edges) {
  for (auto& [a, b] : edges) std::tie(a, b) = std::make_pair(std::min(a, b), std::max(a, b));
  std::sort(edges.begin(), edges.end());
  return edges;
}

TEST(ConsistencyGraph, EveryMethodFindsThePairsThatSetsMayHold) {
  std::size_t kept = 0, dropped = 0;
  for (unsigned seed = 2000; seed < 2150; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    RandomSequence sequence(seed);
    std::map<std::string, ConsistencyGraphBuilder> builders = Builders(sequence.parameters());
    for (int step = 0; step < 4; ++step) {
      const Correspondences correspondences = sequence.Current();
      const EdgeSet edges = ExpectedEdges(correspondences, sequence.parameters());
      for (std::size_t set_size = 2; set_size <= 8; set_size += step + 1) {
        SCOPED_TRACE("step " + std::to_string(step) + ", set size " + std::to_string(set_size));
        const EdgeSet expected = ExpectedTruss(edges, set_size);
        for (auto& [name, builder] : builders)
          ASSERT_EQ(Sorted(builder.FindPairs(correspondences, set_size).pairs), expected) << name;
        if (set_size == 2) continue;
        kept += expected.size();
        dropped += edges.size() - expected.size();
      }
      sequence.Step();
    }
  }
  EXPECT_GT(kept, 10000u) << "the sequences are too thin to say anything";
  EXPECT_GT(dropped, 10000u) << "the sequences are too dense to say anything";
}

/// More correspondences than a sketch has bits, most of them false: some places seen again among many others.
TEST(ConsistencyGraph, FindsThePairsThatSetsMayHoldAmongThousands) {
  for (unsigned seed = 0; seed < 10; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    std::mt19937 random(seed);
    std::uniform_real_distribution<double> unit(-1.0, 1.0);
    const auto point = [&](double radius_m) {
      return Eigen::Vector3d(radius_m * unit(random), radius_m * unit(random), unit(random));
    };
    Correspondences correspondences;
    const Eigen::Vector3d places[] = {point(150.0), point(150.0), point(150.0)};
    for (SegmentId local = 1; local <= 80; ++local) {
      const Eigen::Vector3d p = point(40.0);
      for (SegmentId k = 0; k < 20; ++k) correspondences.push_back(Make(local, 100 * local + k, p, point(150.0)));
      for (SegmentId k = 0; k < 3; ++k) {
        if (local % (7 + 3 * k) == 0)
          correspondences.push_back(Make(local, 100 * local + 20 + k, p, p + places[k] + 0.1 * point(1.0)));
      }
    }
    std::shuffle(correspondences.begin(), correspondences.end(), random);
    const EdgeSet edges = ExpectedEdges(correspondences, With(ConsistencyMethod::kPartitioned2D));
    for (std::size_t set_size = 3; set_size <= 9; ++set_size) {
      const EdgeSet expected = ExpectedTruss(edges, set_size);
      for (const auto& [name, method] : Methods())
        ASSERT_EQ(Sorted(ConsistencyGraphBuilder(With(method)).FindPairs(correspondences, set_size).pairs), expected)
            << name << ", set size " << set_size;
      EXPECT_LT(expected.size(), edges.size());
      EXPECT_GT(expected.size(), 10u);
    }
  }
}

TEST(ConsistencyGraph, PredicateIsTheDefinition) {
  for (unsigned seed = 1000; seed < 2000; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    RandomSequence sequence(seed);
    const ConsistencyParameters& p = sequence.parameters();
    const Correspondences c = sequence.Current();
    EdgeSet edges;
    for (std::uint32_t i = 0; i < c.size(); ++i) {
      for (std::uint32_t j = i + 1; j < c.size(); ++j) {
        const bool consistent = AreConsistent(c[i], c[j], p.epsilon_m, p.max_vertical_slope);
        EXPECT_EQ(consistent, AreConsistent(c[j], c[i], p.epsilon_m, p.max_vertical_slope));
        if (consistent) edges.emplace_back(i, j);
      }
    }
    EXPECT_EQ(edges, ExpectedEdges(c, p));
  }
}

// METHOD 5: the cylinder's diameter, 10, is too small a side: the targets lie 14.142 apart at one height.
TEST(ConsistencyGraph, SidesCoverTheDistanceInThreeDimensions) {
  const Correspondences correspondences{
      Make(1, 11, {0.0, 0.0, 0.0}, {10.3, 0.0, 0.0}),
      Make(2, 12, {10.0, 0.0, 10.0}, {24.442, 0.0, 0.0}),
      Make(3, 13, {5.0, 0.0, 0.0}, {0.0, 0.0, 0.0}),
  };
  for (const auto& [name, method] : Methods()) {
    ConsistencyParameters parameters = With(method);
    parameters.max_vertical_slope = kInfinity;
    const ConsistencyGraph graph = ConsistencyGraphBuilder(parameters).Build(correspondences);
    EXPECT_EQ(EdgesOf(graph), (EdgeSet{{0, 1}})) << name;
  }
}

// METHOD 5: the older one is 1.45 m to one side when the newcomer is cached, and 1.45 m to the other side later.
TEST(ConsistencyGraph, CacheTestsCandidatesBetweenAnchors) {
  ConsistencyGraphBuilder builder(With(ConsistencyMethod::kCached));
  const auto older = [](double x) { return Make(1, 11, {x, 0.0, 0.0}, {0.0, 0.0, 0.0}); };
  const auto newcomer = [](double x) { return Make(2, 12, {x, 0.0, 0.0}, {7.7, 0.0, 0.0}); };
  EXPECT_EQ(builder.Build({older(0.0)}).edges, 0u);
  EXPECT_EQ(builder.Build({older(-1.45)}).edges, 0u);
  EXPECT_EQ(builder.Build({older(-1.45), newcomer(10.0)}).edges, 0u);
  EXPECT_EQ(builder.Build({older(1.45), newcomer(9.5)}).edges, 1u);
}

// Drifts of local and target centroid that are each below theta / 2 but not together.
TEST(ConsistencyGraph, CacheCountsTheDriftOfBothCentroids) {
  ConsistencyGraphBuilder builder(With(ConsistencyMethod::kCached));
  const auto pair = [](double step) {
    return Correspondences{Make(1, 11, {-step, 0.0, 0.0}, {step, 0.0, 0.0}),
                           Make(2, 12, {10.0 + step, 0.0, 0.0}, {15.0 - step, 0.0, 0.0})};
  };
  EXPECT_EQ(builder.Build(pair(0.0)).edges, 0u);
  EXPECT_EQ(builder.Build(pair(1.25)).edges, 1u);
}

TEST(ConsistencyGraph, CacheForgetsWhatVanished) {
  ConsistencyGraphBuilder builder(With(ConsistencyMethod::kCached));
  const Correspondence a = Make(1, 11, {0.0, 0.0, 0.0}, {0.0, 0.0, 0.0});
  const Correspondence b = Make(2, 12, {5.0, 0.0, 0.0}, {5.0, 0.0, 0.0});
  const Correspondence b_elsewhere = Make(2, 12, {5.0, 0.0, 0.0}, {50.0, 0.0, 0.0});
  EXPECT_EQ(builder.Build({a, b}).edges, 1u);
  EXPECT_EQ(builder.Build({a}).edges, 0u);
  EXPECT_EQ(builder.Build({a, b_elsewhere}).edges, 0u);
  EXPECT_EQ(builder.Build({b, a}).edges, 1u);
  EXPECT_EQ(builder.Build({}).edges, 0u);
  EXPECT_EQ(builder.Build({a, b}).edges, 1u);
}

TEST(ConsistencyGraph, CacheTestsLittleWhereLittleMoves) {
  RandomSequence sequence(7);
  ConsistencyParameters parameters = sequence.parameters();
  parameters.method = ConsistencyMethod::kCached;
  ConsistencyGraphBuilder builder(parameters);
  const Correspondences correspondences = sequence.Current();
  const std::uint64_t first = builder.FindPairs(correspondences, 2).tested_pairs;
  EXPECT_LT(builder.FindPairs(correspondences, 2).tested_pairs, first / 100 + 1);
}

TEST(ConsistencyGraph, PairsThatShareASegmentAreNeverConsistent) {
  const Correspondence a = Make(1, 11, {0.0, 0.0, 0.0}, {0.0, 0.0, 0.0});
  EXPECT_FALSE(AreConsistent(a, Make(1, 12, {0.0, 0.0, 0.0}, {0.1, 0.0, 0.0}), 0.4));
  EXPECT_FALSE(AreConsistent(a, Make(2, 11, {0.1, 0.0, 0.0}, {0.0, 0.0, 0.0}), 0.4));
  EXPECT_TRUE(AreConsistent(a, Make(2, 12, {0.1, 0.0, 0.0}, {0.0, 0.0, 0.0}), 0.4));
  Correspondence other_robot = Make(1, 11, {0.1, 0.0, 0.0}, {0.0, 0.0, 0.0});
  other_robot.local.robot = 5;
  other_robot.target.robot = 6;
  EXPECT_TRUE(AreConsistent(a, other_robot, 0.4));
}

TEST(ConsistencyGraph, SlopeLimitsTheChangeOfHeightDifferences) {
  const Correspondence a = Make(1, 11, {0.0, 0.0, 0.0}, {0.0, 0.0, 0.0});
  const Correspondence mirrored = Make(2, 12, {20.0, 0.0, 3.0}, {20.0, 0.0, -3.0});
  EXPECT_TRUE(AreConsistent(a, mirrored, 0.4));
  EXPECT_FALSE(AreConsistent(a, mirrored, 0.4, 0.1));
  EXPECT_TRUE(AreConsistent(a, mirrored, 0.4, 0.5));
}

/// Two towns far apart, and coordinates that single precision cannot hold.
TEST(ConsistencyGraph, TargetsMayLieFarApart) {
  for (const double gap_m : {1e3, 1e5, 1e7, 1e9, 1e11, 1e200}) {
    SCOPED_TRACE(gap_m);
    std::mt19937 random(5);
    std::uniform_real_distribution<double> within(-30.0, 30.0);
    Correspondences correspondences;
    for (SegmentId i = 0; i < 120; ++i) {
      const Eigen::Vector3d p(std::round(within(random)), std::round(within(random)), 0.0);
      const Eigen::Vector3d town = i % 2 == 0 ? Eigen::Vector3d::Zero() : Eigen::Vector3d(gap_m, -gap_m, 0.0);
      correspondences.push_back(Make(1 + i % 40, 100 + i, p, p + town));
    }
    // Centroids of a segment may even disagree; each correspondence counts for itself.
    const bool out_of_range = gap_m > 1e12;
    for (const auto& [name, method] : Methods()) {
      ConsistencyGraphBuilder builder(With(method));
      const EdgeSet edges = EdgesOf(builder.Build(correspondences));
      EdgeSet expected = ExpectedEdges(correspondences, With(method));
      if (out_of_range) {
        const auto far = [](const ConsistencyGraph::Edge& e) { return e.first % 2 == 1 || e.second % 2 == 1; };
        expected.erase(std::remove_if(expected.begin(), expected.end(), far), expected.end());
      }
      EXPECT_EQ(edges, expected) << name;
      EXPECT_GT(edges.size(), 500u);
    }
  }
}

TEST(ConsistencyGraph, PartitionsTestFewPairsInALargeMap) {
  std::mt19937 random(6);
  std::uniform_real_distribution<double> local(-30.0, 30.0), target(-1000.0, 1000.0);
  Correspondences correspondences;
  std::vector<Eigen::Vector3d> locals;
  for (int i = 0; i < 50; ++i) locals.emplace_back(local(random), local(random), 0.0);
  for (SegmentId i = 0; i < 2000; ++i) {
    correspondences.push_back(Make(1 + i % 50, 100 + i, locals[i % 50], {target(random), target(random), 0.0}));
  }
  const std::uint64_t all = 2000u * 1999u / 2u;
  const auto tested_by = [&](ConsistencyMethod method) {
    return ConsistencyGraphBuilder(With(method)).FindPairs(correspondences, 2).tested_pairs;
  };
  EXPECT_EQ(tested_by(ConsistencyMethod::kAllPairs), all);
  const auto tested = tested_by(ConsistencyMethod::kPartitioned2D);
  EXPECT_LT(tested, all / 50);
  EXPECT_GT(tested, 0u);
}

TEST(ConsistencyGraph, RefusesBadParameters) {
  const auto refused = [](auto change) {
    ConsistencyParameters parameters;
    change(parameters);
    EXPECT_THROW(ConsistencyGraphBuilder{parameters}, std::invalid_argument);
  };
  refused([](ConsistencyParameters& p) { p.epsilon_m = 0.0; });
  refused([](ConsistencyParameters& p) { p.epsilon_m = std::nan(""); });
  refused([](ConsistencyParameters& p) { p.cache_theta_m = -1.0; });
  refused([](ConsistencyParameters& p) { p.max_vertical_slope = -0.1; });
  refused([](ConsistencyParameters& p) { p.max_vertical_slope = std::nan(""); });
}

}  // namespace
}  // namespace incremental_segmatch
