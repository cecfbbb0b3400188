// Contract 6: the clique's size equals exhaustive search, and nothing depends on the order of the input.
#include "incremental_segmatch/max_clique.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <chrono>
#include <numeric>
#include <random>

namespace incremental_segmatch {
namespace {

using Vertices = std::vector<std::uint32_t>;
using Edges = std::vector<ConsistencyGraph::Edge>;

constexpr std::uint64_t kUnlimited = std::uint64_t{1} << 60;

/// Searches to the end, however long that takes.
MaxCliqueParameters Parameters(std::size_t min_size) {
  MaxCliqueParameters parameters;
  parameters.min_size = min_size;
  parameters.deadline = std::chrono::seconds(1000);
  parameters.max_work = kUnlimited;
  parameters.max_tie_work = 4000000;
  return parameters;
}

/// Every maximum clique by plain enumeration of all cliques, for small graphs.
class ExhaustiveSearch {
 public:
  explicit ExhaustiveSearch(const ConsistencyGraph& graph) : graph_(graph) { Extend(0); }
  const std::vector<Vertices>& largest() const { return largest_; }

 private:
  void Extend(std::uint32_t from) {
    if (largest_.empty() || clique_.size() > largest_.front().size()) largest_.clear();
    if (largest_.empty() || clique_.size() == largest_.front().size()) largest_.push_back(clique_);
    for (std::uint32_t v = from; v < graph_.vertices(); ++v) {
      if (!std::all_of(clique_.begin(), clique_.end(), [&](std::uint32_t u) { return graph_.HasEdge(u, v); })) continue;
      clique_.push_back(v);
      Extend(v + 1);
      clique_.pop_back();
    }
  }

  const ConsistencyGraph& graph_;
  Vertices clique_;
  std::vector<Vertices> largest_;
};

Edges RandomEdges(std::size_t vertices, double density, std::mt19937& random) {
  std::bernoulli_distribution is_edge(density);
  Edges edges;
  for (std::uint32_t a = 0; a < vertices; ++a) {
    for (std::uint32_t b = a + 1; b < vertices; ++b) {
      if (is_edge(random)) edges.emplace_back(a, b);
    }
  }
  return edges;
}

void Plant(const Vertices& members, Edges& edges) {
  for (std::size_t i = 0; i < members.size(); ++i) {
    for (std::size_t j = i + 1; j < members.size(); ++j) edges.emplace_back(std::minmax(members[i], members[j]));
  }
  std::sort(edges.begin(), edges.end());
  edges.erase(std::unique(edges.begin(), edges.end()), edges.end());
}

Vertices RandomPermutation(std::size_t size, std::mt19937& random) {
  Vertices permutation(size);
  std::iota(permutation.begin(), permutation.end(), 0);
  std::shuffle(permutation.begin(), permutation.end(), random);
  return permutation;
}

Vertices Mapped(const Vertices& vertices, const Vertices& map) {
  Vertices mapped;
  for (const std::uint32_t v : vertices) mapped.push_back(map[v]);
  std::sort(mapped.begin(), mapped.end());
  return mapped;
}

bool IsClique(const ConsistencyGraph& graph, const Vertices& vertices) {
  for (std::size_t i = 0; i < vertices.size(); ++i) {
    for (std::size_t j = i + 1; j < vertices.size(); ++j) {
      if (!graph.HasEdge(vertices[i], vertices[j])) return false;
    }
  }
  return true;
}

TEST(MaxClique, EqualsExhaustiveSearchAndTakesTheSmallestList) {
  for (unsigned seed = 0; seed < 1000; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    std::mt19937 random(seed);
    const std::size_t n = 1 + random() % 22;
    const double density = 0.1 + 0.1 * (random() % 8);
    const std::size_t min_size = 3 + random() % 3;
    const ConsistencyGraph graph = ConsistencyGraph::FromEdges(n, RandomEdges(n, density, random));
    const std::vector<Vertices> largest = ExhaustiveSearch(graph).largest();
    const MaxCliqueResult result = FindMaxClique(graph, Parameters(min_size));
    EXPECT_TRUE(result.proven_maximum);
    if (largest.front().size() < min_size) {
      EXPECT_TRUE(result.vertices.empty());
      EXPECT_EQ(result.upper_bound, min_size - 1);
    } else {
      EXPECT_EQ(result.vertices, *std::min_element(largest.begin(), largest.end()));
      EXPECT_EQ(result.upper_bound, largest.front().size());
      EXPECT_TRUE(result.all_ties_compared);
    }
  }
}

/// Size of the largest clique among the candidates that beats `best`, by counting alone: slow, but without colours.
std::size_t LargestSize(const ConsistencyGraph& graph, const Vertices& candidates, std::size_t size, std::size_t best) {
  best = std::max(best, size);
  for (std::size_t i = 0; i < candidates.size() && size + candidates.size() - i > best; ++i) {
    Vertices next;
    for (std::size_t j = i + 1; j < candidates.size(); ++j) {
      if (graph.HasEdge(candidates[i], candidates[j])) next.push_back(candidates[j]);
    }
    best = LargestSize(graph, next, size + 1, best);
  }
  return best;
}

TEST(MaxClique, ColouringNeverCutsOffTheMaximum) {
  for (unsigned seed = 0; seed < 150; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    std::mt19937 random(seed);
    const double density = 0.6 + 0.1 * (random() % 3);
    const std::size_t n = density > 0.75 ? 40 : 60;
    const ConsistencyGraph graph = ConsistencyGraph::FromEdges(n, RandomEdges(n, density, random));
    Vertices all(n);
    std::iota(all.begin(), all.end(), 0);
    const MaxCliqueResult result = FindMaxClique(graph, Parameters(3));
    EXPECT_TRUE(result.proven_maximum);
    EXPECT_TRUE(IsClique(graph, result.vertices));
    EXPECT_EQ(result.vertices.size(), LargestSize(graph, all, 0, 0));
  }
}

TEST(MaxClique, IsIndependentOfTheLabels) {
  for (unsigned seed = 0; seed < 1000; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    std::mt19937 random(seed);
    const std::size_t n = 20 + random() % 60;
    const Edges edges = RandomEdges(n, 0.3 + 0.1 * (random() % 4), random);
    const Vertices label = RandomPermutation(n, random);
    Vertices vertex(n);
    for (std::uint32_t v = 0; v < n; ++v) vertex[label[v]] = v;
    Edges relabelled;
    for (const auto& [a, b] : edges) relabelled.emplace_back(label[a], label[b]);
    std::shuffle(relabelled.begin(), relabelled.end(), random);

    const MaxCliqueResult result = FindMaxClique(ConsistencyGraph::FromEdges(n, edges), Parameters(3));
    const CliqueOrder by_original = [&](const Vertices& a, const Vertices& b) {
      return Mapped(a, vertex) < Mapped(b, vertex);
    };
    const MaxCliqueResult other = FindMaxClique(ConsistencyGraph::FromEdges(n, relabelled), Parameters(3), by_original);
    ASSERT_TRUE(result.all_ties_compared);
    EXPECT_EQ(result.vertices, Mapped(other.vertices, vertex));
  }
}

TEST(MaxClique, FindsPlantedCliques) {
  for (unsigned seed = 0; seed < 200; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    std::mt19937 random(seed);
    const std::size_t n = 500;
    Vertices members = RandomPermutation(n, random);
    members.resize(12 + random() % 20);
    std::sort(members.begin(), members.end());
    Edges edges = RandomEdges(n, 0.05, random);
    Plant(members, edges);
    const MaxCliqueResult result = FindMaxClique(ConsistencyGraph::FromEdges(n, edges), Parameters(6));
    EXPECT_TRUE(result.proven_maximum);
    EXPECT_EQ(result.vertices, members);
  }
}

// Neighbours 512 apart fall on the same bit of a sketch: cliques of such vertices, among edges by chance.
TEST(MaxClique, SketchesLoseNoCliqueOfVerticesOnTheSameBits) {
  constexpr std::uint32_t kSketchBits = 512;
  for (unsigned seed = 0; seed < 60; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    std::mt19937 random(seed);
    const std::uint32_t n = 3 * kSketchBits + random() % 100;
    Edges edges = RandomEdges(n, 0.002 * (1 + random() % 6), random);
    Vertices members;
    for (std::size_t bits = 2 + random() % 3; members.size() < 3 * bits;) {
      const std::uint32_t bit = random() % kSketchBits;
      for (std::uint32_t turn = 0; turn < 3; ++turn) members.push_back(bit + turn * kSketchBits);
    }
    std::sort(members.begin(), members.end());
    members.erase(std::unique(members.begin(), members.end()), members.end());
    Plant(members, edges);
    const ConsistencyGraph graph = ConsistencyGraph::FromEdges(n, edges);
    Vertices all(n);
    std::iota(all.begin(), all.end(), 0);
    const MaxCliqueResult result = FindMaxClique(graph, Parameters(3 + random() % 4));
    EXPECT_TRUE(result.proven_maximum);
    EXPECT_TRUE(IsClique(graph, result.vertices));
    EXPECT_EQ(result.vertices.size(), LargestSize(graph, all, 0, 0));
  }
}

// Graphs where the bound is tight, with the sizes that plain colouring, without recolouring, finds: a bound that is one
// too low loses the largest clique of one of them.
TEST(MaxClique, KnownSizesOfDenseGraphs) {
  const std::vector<std::pair<unsigned, std::size_t>> sizes{{140u, 26u}, {141u, 19u}, {142u, 25u}, {143u, 20u},
                                                            {144u, 26u}, {145u, 21u}, {146u, 25u}, {147u, 20u},
                                                            {148u, 26u}, {149u, 20u}};
  for (const auto& [seed, size] : sizes) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    std::mt19937 random(seed);
    const std::size_t n = 110;
    const unsigned percent = seed % 2 == 0 ? 85 : 80;
    Edges edges;
    for (std::uint32_t a = 0; a < n; ++a) {
      for (std::uint32_t b = a + 1; b < n; ++b) {
        if (random() % 100 < percent) edges.emplace_back(a, b);
      }
    }
    const MaxCliqueResult result = FindMaxClique(ConsistencyGraph::FromEdges(n, edges), Parameters(3));
    EXPECT_TRUE(result.proven_maximum);
    EXPECT_EQ(result.vertices.size(), size);
  }
}

TEST(MaxClique, HandlesNinetyPercentInliers) {
  std::mt19937 random(1);
  const std::size_t n = 2000;
  Vertices members = RandomPermutation(n, random);
  members.resize(n * 9 / 10);
  std::sort(members.begin(), members.end());
  Edges edges = RandomEdges(n, 0.3, random);
  Plant(members, edges);
  const ConsistencyGraph graph = ConsistencyGraph::FromEdges(n, edges);
  const MaxCliqueResult result = FindMaxClique(graph, Parameters(6));
  EXPECT_TRUE(result.proven_maximum);
  EXPECT_EQ(result.vertices, members);
}

TEST(MaxClique, SolvesDenseRandomGraphs) {
  for (unsigned seed = 0; seed < 3; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    std::mt19937 random(seed);
    const ConsistencyGraph graph = ConsistencyGraph::FromEdges(100, RandomEdges(100, 0.9, random));
    const MaxCliqueResult result = FindMaxClique(graph, Parameters(6));
    EXPECT_TRUE(result.proven_maximum);
    EXPECT_TRUE(IsClique(graph, result.vertices));
    EXPECT_GE(result.vertices.size(), 28u);  // 29 to 36 in the literature's instances of this kind
    EXPECT_LE(result.vertices.size(), 38u);
  }
}

TEST(MaxClique, ReturnsTheIncumbentAtTheDeadline) {
  std::mt19937 random(3);
  const ConsistencyGraph graph = ConsistencyGraph::FromEdges(500, RandomEdges(500, 0.9, random));
  MaxCliqueParameters parameters = Parameters(6);
  parameters.deadline = std::chrono::milliseconds(20);
  const auto start = std::chrono::steady_clock::now();
  const MaxCliqueResult result = FindMaxClique(graph, parameters);
  EXPECT_LT(std::chrono::steady_clock::now() - start, std::chrono::seconds(1));
  EXPECT_FALSE(result.proven_maximum);
  EXPECT_GE(result.vertices.size(), 6u);
  EXPECT_TRUE(IsClique(graph, result.vertices));
  EXPECT_GT(result.upper_bound, result.vertices.size());
}

TEST(MaxClique, EndsAtItsEffortRepeatably) {
  std::mt19937 random(4);
  const ConsistencyGraph graph = ConsistencyGraph::FromEdges(400, RandomEdges(400, 0.9, random));
  MaxCliqueParameters parameters = Parameters(6);
  std::size_t size_before = 6;
  for (const std::uint64_t work : {100000u, 1000000u, 3000000u}) {
    parameters.max_work = work;
    const MaxCliqueResult result = FindMaxClique(graph, parameters);
    EXPECT_FALSE(result.proven_maximum);
    EXPECT_FALSE(result.all_ties_compared);
    EXPECT_TRUE(IsClique(graph, result.vertices));
    EXPECT_GE(result.vertices.size(), size_before) << "more effort finds no less";
    EXPECT_GT(result.upper_bound, result.vertices.size());
    EXPECT_GT(result.work, work);
    EXPECT_LT(result.work, work + work / 2) << "it ends soon after the limit";
    EXPECT_EQ(FindMaxClique(graph, parameters).vertices, result.vertices);
    size_before = result.vertices.size();
  }
}

TEST(MaxClique, BoundsTheComparisonOfTiesRepeatably) {
  // Twelve groups of three: 3^12 maximum cliques, one vertex of each group.
  Edges edges;
  for (std::uint32_t a = 0; a < 36; ++a) {
    for (std::uint32_t b = a + 1; b < 36; ++b) {
      if (a / 3 != b / 3) edges.emplace_back(a, b);
    }
  }
  const ConsistencyGraph graph = ConsistencyGraph::FromEdges(36, edges);
  std::size_t comparisons = 0;
  const CliqueOrder counted = [&](const Vertices& a, const Vertices& b) {
    ++comparisons;
    return a < b;
  };
  MaxCliqueParameters parameters = Parameters(6);
  parameters.max_ties = 100;
  const MaxCliqueResult first = FindMaxClique(graph, parameters, counted);
  EXPECT_EQ(first.vertices.size(), 12u);
  EXPECT_TRUE(first.proven_maximum);
  EXPECT_FALSE(first.all_ties_compared);
  EXPECT_LE(comparisons, 100u);
  EXPECT_EQ(FindMaxClique(graph, parameters, counted).vertices, first.vertices);

  parameters.max_ties = 1000000;
  const MaxCliqueResult all = FindMaxClique(graph, parameters);
  EXPECT_TRUE(all.all_ties_compared) << "3^12 cliques of 12 are little work";
  EXPECT_EQ(all.vertices, (Vertices{0, 3, 6, 9, 12, 15, 18, 21, 24, 27, 30, 33}));
}

TEST(MaxClique, HandlesGraphsWithoutEdges) {
  EXPECT_TRUE(FindMaxClique(ConsistencyGraph(), Parameters(3)).vertices.empty());
  EXPECT_TRUE(FindMaxClique(ConsistencyGraph::FromEdges(5, {}), Parameters(3)).vertices.empty());
}

TEST(MaxClique, RefusesBadParameters) {
  EXPECT_THROW(FindMaxClique(ConsistencyGraph(), Parameters(2)), std::invalid_argument);
  MaxCliqueParameters parameters;
  parameters.max_ties = 0;
  EXPECT_THROW(FindMaxClique(ConsistencyGraph(), parameters), std::invalid_argument);
  parameters = Parameters(3);
  parameters.max_work = 0;
  EXPECT_THROW(FindMaxClique(ConsistencyGraph(), parameters), std::invalid_argument);
  parameters = Parameters(3);
  parameters.deadline = std::chrono::microseconds(0);
  EXPECT_THROW(FindMaxClique(ConsistencyGraph(), parameters), std::invalid_argument);
}

}  // namespace
}  // namespace incremental_segmatch
