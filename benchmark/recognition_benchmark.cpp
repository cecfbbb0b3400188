// Recognition: consistency graph, clique and transform beside PCL's geometric consistency grouping, on the same
// correspondences, with the same tolerance and the same smallest set, one thread each.
#include <benchmark/benchmark.h>
#include <pcl/point_cloud.h>
#include <pcl/point_types.h>
#include <pcl/recognition/cg/geometric_consistency.h>

#include <algorithm>
#include <chrono>
#include <memory>
#include <random>
#include <tuple>
#include <vector>

#include "incremental_segmatch/recognizer.hpp"

namespace incremental_segmatch {
namespace {

constexpr double kEpsilon_m = 0.4;
constexpr std::size_t kMinCliqueSize = 6;
constexpr double kDensity_per_m2 = 0.01;  ///< correspondences over the target map, about that of the thesis' KITTI runs
constexpr std::size_t kLocalSegments = 50;
constexpr double kLocalRadius_m = 50.0;

/// 50 local segments within 50 m, correspondences at constant density over a target map, 15 of them true.
class Scenario {
 public:
  /// A square map. A small one has more border, where a correspondence has fewer others to be tested with.
  explicit Scenario(std::size_t correspondences) : Scenario(correspondences, correspondences) {}

  /// A map of square districts with so many correspondences each, too far apart to be tested with each other: a
  /// correspondence has as many others to be tested with, however large the map.
  Scenario(std::size_t correspondences, std::size_t per_district, std::size_t seed = 0)
      : random_(static_cast<unsigned>(correspondences + seed)) {
    constexpr std::size_t kTrueMatches = 15;
    constexpr double kMatchesPerTarget = 3.0;
    constexpr double kGap_m = 2.5 * kLocalRadius_m;
    const double side_m = std::sqrt(static_cast<double>(per_district) / kDensity_per_m2);
    const std::size_t districts = correspondences / per_district;
    const auto districts_in_a_row = static_cast<std::size_t>(std::ceil(std::sqrt(static_cast<double>(districts))));
    std::vector<Eigen::Vector3d> locals;
    while (locals.size() < kLocalSegments) {
      const Eigen::Vector3d p(kLocalRadius_m * Signed(), kLocalRadius_m * Signed(), 2.0 * Signed());
      if (p.head<2>().norm() < kLocalRadius_m) locals.push_back(p);
    }
    const Eigen::AngleAxisd turn(1.0, Eigen::Vector3d::UnitZ());
    for (SegmentId i = 0; i < kTrueMatches; ++i) {
      const Eigen::Vector3d noise = 0.05 * Eigen::Vector3d(Signed(), Signed(), Signed());
      Add(i + 1, i + 1, locals[i], turn * locals[i] + noise);
    }
    const auto targets = static_cast<std::size_t>(static_cast<double>(correspondences) / kMatchesPerTarget) + 1;
    std::vector<Eigen::Vector3d> target_centroids;
    for (std::size_t i = 0; i < targets; ++i) {
      const std::size_t district = i % districts;
      const Eigen::Vector3d middle((side_m + kGap_m) * static_cast<double>(district % districts_in_a_row),
                                   (side_m + kGap_m) * static_cast<double>(district / districts_in_a_row), 0.0);
      target_centroids.push_back(middle +
                                 Eigen::Vector3d(0.5 * side_m * Signed(), 0.5 * side_m * Signed(), 2.0 * Signed()));
    }
    while (correspondences_.size() < correspondences) {
      const std::size_t local = random_() % kLocalSegments;
      const std::size_t target = random_() % targets;
      Add(static_cast<SegmentId>(local + 1), static_cast<SegmentId>(kTrueMatches + target + 1), locals[local],
          target_centroids[target]);
    }
    std::shuffle(correspondences_.begin(), correspondences_.end(), random_);
  }

  const Correspondences& correspondences() const { return correspondences_; }

  /// The next step of a drive: half of the local centroids move by some centimetres as their segments grow, and some
  /// local segments are replaced by others, with all their correspondences.
  void Step() {
    std::vector<Eigen::Vector3d> moves;
    for (std::size_t i = 0; i <= kLocalSegments; ++i) {
      moves.push_back(i % 2 == step_ % 2 ? Eigen::Vector3d(0.05 * Signed(), 0.05 * Signed(), 0.02 * Signed())
                                         : Eigen::Vector3d(Eigen::Vector3d::Zero()));
    }
    const SegmentId replaced = static_cast<SegmentId>(1 + step_ % kLocalSegments);
    const Eigen::Vector3d elsewhere(20.0 * Signed(), 20.0 * Signed(), 0.0);
    for (Correspondence& c : correspondences_) {
      const SegmentId slot = (c.local.id - 1) % kLocalSegments + 1;
      c.centroid_local += moves[slot];
      if (slot != replaced) continue;
      c.local.id += kLocalSegments;
      c.centroid_local = elsewhere;
    }
    ++step_;
  }

 private:
  double Signed() { return std::uniform_real_distribution<double>(-1.0, 1.0)(random_); }

  void Add(SegmentId local, SegmentId target, const Eigen::Vector3d& p_local, const Eigen::Vector3d& p_target) {
    Correspondence c;
    c.local = {0, local};
    c.target = {1, target};
    c.centroid_local = p_local;
    c.centroid_target = p_target;
    c.descriptor_distance = static_cast<float>(std::abs(Signed()));
    correspondences_.push_back(c);
  }

  std::mt19937 random_;
  Correspondences correspondences_;
  std::size_t step_ = 0;
};

RecognizerParameters Parameters(ConsistencyMethod method) {
  RecognizerParameters parameters;
  parameters.consistency.epsilon_m = kEpsilon_m;
  parameters.consistency.method = method;
  parameters.clique.min_size = kMinCliqueSize;
  return parameters;
}

/// Everything from the correspondences to the recognition, of each scenario in turn.
void Recognize(benchmark::State& state, ConsistencyMethod method, const std::vector<Scenario>& scenarios) {
  Recognizer recognizer(Parameters(method));
  RecognizerResult result;
  double graph_ms = 0.0, clique_ms = 0.0, tested_pairs = 0.0;
  std::size_t turn = 0;
  for (auto _ : state) {
    result = recognizer.Recognize(scenarios[turn++ % scenarios.size()].correspondences());
    graph_ms += result.graph_ms;
    clique_ms += result.clique_ms;
    tested_pairs += static_cast<double>(result.tested_pairs);
  }
  const double n = static_cast<double>(state.range(0));
  tested_pairs /= static_cast<double>(state.iterations());
  state.counters["inliers"] = static_cast<double>(result.clique_size);
  state.counters["edges"] = static_cast<double>(result.edges);
  state.counters["tested_%"] = 100.0 * tested_pairs / (n * (n - 1.0) / 2.0);
  state.counters["graph_ms"] = graph_ms / static_cast<double>(state.iterations());
  state.counters["clique_ms"] = clique_ms / static_cast<double>(state.iterations());
  state.counters["tested_per_correspondence"] = tested_pairs / n;
}

void RecognizeOurs(benchmark::State& state, ConsistencyMethod method) {
  Recognize(state, method, {Scenario(static_cast<std::size_t>(state.range(0)))});
}

/// How the time grows with the number of correspondences alone: in maps without a border, and of the same hundred
/// thousand correspondences in all, for a small input that is given again and again stays in the cache, and the
/// processor learns its branches.
void RecognizeInDistricts(benchmark::State& state, ConsistencyMethod method) {
  constexpr std::size_t kPerDistrict = 1000;
  constexpr std::size_t kInAll = 100000;
  const auto n = static_cast<std::size_t>(state.range(0));
  std::vector<Scenario> scenarios;
  while (scenarios.size() * n < kInAll) scenarios.emplace_back(n, kPerDistrict, scenarios.size());
  Recognize(state, method, scenarios);
}

/// A drive: the input changes a little from call to call; only the pairs that may be in a set of the smallest size.
void RecognizeSequence(benchmark::State& state, ConsistencyMethod method) {
  Scenario scenario(static_cast<std::size_t>(state.range(0)));
  ConsistencyParameters parameters = Parameters(method).consistency;
  ConsistencyGraphBuilder builder(parameters);
  builder.FindPairs(scenario.correspondences(), kMinCliqueSize);
  std::uint64_t tested = 0;
  for (auto _ : state) {
    state.PauseTiming();
    scenario.Step();
    state.ResumeTiming();
    tested += builder.FindPairs(scenario.correspondences(), kMinCliqueSize).tested_pairs;
  }
  state.counters["tested"] = benchmark::Counter(static_cast<double>(tested), benchmark::Counter::kAvgIterations);
}

void GroupWithPcl(benchmark::State& state) {
  const Scenario scenario(static_cast<std::size_t>(state.range(0)));
  auto local = std::make_shared<pcl::PointCloud<pcl::PointXYZ>>();
  auto target = std::make_shared<pcl::PointCloud<pcl::PointXYZ>>();
  auto pairs = std::make_shared<pcl::Correspondences>();
  for (const Correspondence& c : scenario.correspondences()) {
    const int index = static_cast<int>(local->size());
    const Eigen::Vector3f l = c.centroid_local.cast<float>();
    const Eigen::Vector3f t = c.centroid_target.cast<float>();
    local->emplace_back(l.x(), l.y(), l.z());
    target->emplace_back(t.x(), t.y(), t.z());
    pairs->emplace_back(index, index, c.descriptor_distance);
  }
  std::size_t inliers = 0;
  for (auto _ : state) {
    pcl::GeometricConsistencyGrouping<pcl::PointXYZ, pcl::PointXYZ> grouping;
    grouping.setGCSize(kEpsilon_m);
    grouping.setGCThreshold(static_cast<int>(kMinCliqueSize) - 1);  // PCL keeps sets that are larger than this
    grouping.setInputCloud(local);
    grouping.setSceneCloud(target);
    grouping.setModelSceneCorrespondences(pairs);
    std::vector<Eigen::Matrix4f, Eigen::aligned_allocator<Eigen::Matrix4f>> transforms;
    std::vector<pcl::Correspondences> groups;
    grouping.recognize(transforms, groups);
    inliers = 0;
    for (const pcl::Correspondences& group : groups) inliers = std::max(inliers, group.size());
  }
  state.counters["inliers"] = static_cast<double>(inliers);
}

/// Edges at random, and all those among a share of the vertices.
ConsistencyGraph RandomGraph(std::size_t vertices, double density, double planted, unsigned seed) {
  std::mt19937 random(seed);
  std::bernoulli_distribution is_edge(density), is_member(planted);
  std::vector<bool> members;
  for (std::size_t v = 0; v < vertices; ++v) members.push_back(is_member(random));
  std::vector<ConsistencyGraph::Edge> edges;
  for (std::uint32_t a = 0; a < vertices; ++a) {
    for (std::uint32_t b = a + 1; b < vertices; ++b) {
      if ((members[a] && members[b]) || is_edge(random)) edges.emplace_back(a, b);
    }
  }
  return ConsistencyGraph::FromEdges(vertices, edges);
}

/// The clique alone, to the proof, one of several graphs after the other.
void FindClique(benchmark::State& state, std::size_t vertices, double density, double planted) {
  MaxCliqueParameters parameters;
  parameters.min_size = kMinCliqueSize;
  parameters.max_work = ~std::uint64_t{0};
  parameters.deadline = std::chrono::seconds(100);
  std::vector<ConsistencyGraph> graphs;
  for (unsigned seed = 0; seed < 10; ++seed) graphs.push_back(RandomGraph(vertices, density, planted, seed));
  std::size_t next = 0, proven = 0;
  double inliers = 0.0;
  for (auto _ : state) {
    const MaxCliqueResult result = FindMaxClique(graphs[next++ % graphs.size()], parameters);
    proven += result.proven_maximum;
    inliers += static_cast<double>(result.vertices.size());
  }
  state.counters["proven"] = static_cast<double>(proven) / static_cast<double>(state.iterations());
  state.counters["inliers"] = inliers / static_cast<double>(state.iterations());
}

BENCHMARK_CAPTURE(FindClique, inliers_90_percent, 2000, 0.3, 0.9)
    ->Name("maximum clique/2000 vertices, 90 % planted/ours")
    ->Iterations(10)
    ->Unit(benchmark::kMillisecond);
BENCHMARK_CAPTURE(FindClique, dense_random, 100, 0.9, 0.0)
    ->Name("maximum clique/G(100, 0.9)/ours")
    ->Iterations(10)
    ->Unit(benchmark::kMillisecond);
BENCHMARK(GroupWithPcl)->Arg(300)->Arg(2000)->Arg(5500)->Arg(10000)->Unit(benchmark::kMillisecond);
BENCHMARK_CAPTURE(RecognizeOurs, all_pairs, ConsistencyMethod::kAllPairs)
    ->Arg(300)
    ->Arg(2000)
    ->Arg(5500)
    ->Arg(10000)
    ->Unit(benchmark::kMillisecond);
BENCHMARK_CAPTURE(RecognizeOurs, squares, ConsistencyMethod::kPartitioned2D)
    ->Arg(300)
    ->Arg(1000)
    ->Arg(2000)
    ->Arg(5500)
    ->Arg(10000)
    ->Arg(100000)
    ->Unit(benchmark::kMillisecond);
BENCHMARK_CAPTURE(RecognizeInDistricts, squares, ConsistencyMethod::kPartitioned2D)
    ->Arg(1000)
    ->Arg(10000)
    ->Arg(100000)
    ->Unit(benchmark::kMillisecond);
BENCHMARK_CAPTURE(RecognizeOurs, cubes, ConsistencyMethod::kPartitioned3D)
    ->Arg(300)
    ->Arg(2000)
    ->Arg(5500)
    ->Arg(10000)
    ->Arg(100000)
    ->Unit(benchmark::kMillisecond);
BENCHMARK_CAPTURE(RecognizeSequence, squares, ConsistencyMethod::kPartitioned2D)
    ->Arg(300)
    ->Arg(2000)
    ->Arg(5500)
    ->Arg(10000)
    ->Arg(100000)
    ->Unit(benchmark::kMillisecond);
BENCHMARK_CAPTURE(RecognizeSequence, cached, ConsistencyMethod::kCached)
    ->Arg(300)
    ->Arg(2000)
    ->Arg(5500)
    ->Arg(10000)
    ->Arg(100000)
    ->Unit(benchmark::kMillisecond);
BENCHMARK_CAPTURE(RecognizeSequence, automatic, ConsistencyMethod::kAuto)
    ->Arg(300)
    ->Arg(2000)
    ->Arg(5500)
    ->Arg(10000)
    ->Arg(100000)
    ->Unit(benchmark::kMillisecond);

}  // namespace
}  // namespace incremental_segmatch

BENCHMARK_MAIN();
