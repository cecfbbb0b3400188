/// \file
/// Correspondences to consistency graph (METHOD 5; thesis 3.4.1 and 3.4.2).
#pragma once

#include <cstddef>
#include <cstdint>
#include <limits>
#include <memory>
#include <utility>
#include <vector>

#include "incremental_segmatch/correspondence.hpp"

namespace incremental_segmatch {

/// Undirected graph over correspondences 0..n-1 in compressed rows: the neighbours of v are
/// neighbours[k] for offsets[v] <= k < offsets[v + 1], sorted by index, no self loops, every edge in both rows.
struct ConsistencyGraph {
  /// The neighbours of one vertex.
  struct Range {
    const std::uint32_t* first = nullptr;  ///< the first neighbour
    const std::uint32_t* last = nullptr;   ///< behind the last one
    /// For loops.
    const std::uint32_t* begin() const { return first; }
    /// For loops.
    const std::uint32_t* end() const { return last; }
    /// Number of neighbours.
    std::size_t size() const { return static_cast<std::size_t>(last - first); }
  };
  /// Two vertices.
  using Edge = std::pair<std::uint32_t, std::uint32_t>;

  std::vector<std::size_t> offsets{0};    ///< vertices() + 1 entries
  std::vector<std::uint32_t> neighbours;  ///< 2 * edges entries
  std::size_t edges = 0;                  ///< number of edges, each counted once

  /// Number of vertices.
  std::size_t vertices() const { return offsets.size() - 1; }
  /// Neighbours of a vertex, ascending. O(1).
  Range Neighbours(std::uint32_t vertex) const {
    return {neighbours.data() + offsets[vertex], neighbours.data() + offsets[vertex + 1]};
  }
  /// O(log degree).
  bool HasEdge(std::uint32_t a, std::uint32_t b) const;

  /// The graph with these edges, each given once, in any order and direction. O(vertices + edges).
  static ConsistencyGraph FromEdges(std::size_t vertices, const std::vector<Edge>& edges);
};

/// Which correspondences agree.
struct ConsistentPairs {
  std::vector<ConsistencyGraph::Edge> pairs;  ///< of indices, each once, in any order and direction
  std::uint64_t tested_pairs = 0;             ///< how many pairs were tested for consistency
};

/// How the pairs to be tested are found. Every method returns the same edges.
enum class ConsistencyMethod {
  kAllPairs,       ///< every pair, O(n^2)
  kPartitioned2D,  ///< squares over the target centroids (3.14 to 3.17); linear in n at constant density
  kPartitioned3D,  ///< cubes over the target centroids; pays where targets lie above each other (storeys)
  kCached,         ///< candidates are remembered between calls (3.18, 3.19)
  kAuto            ///< whichever of the others measured fastest in the last calls
};

/// The best instructions that are used, on processors that have them.
enum class Instructions {
  kPortable,  ///< none beyond those of every processor
  kAvx2,      ///< eight floats at a time
  kAvx512     ///< sixteen
};

/// When two correspondences agree, and how that is found out.
struct ConsistencyParameters {
  double epsilon_m = 0.4;                                        ///< tolerance of (2.3), > 0
  ConsistencyMethod method = ConsistencyMethod::kPartitioned2D;  ///< all give the same graph
  double cache_theta_m = 3.0;                                    ///< theta of (3.19), for kCached and kAuto, > 0
  /// Both maps have z roughly along gravity: the height difference of a pair may differ between the maps by at most
  /// epsilon plus this slope (metres per metre of the pair's distance; a tilt in radians suffices). Infinity: no limit.
  double max_vertical_slope = 0.1;
  Instructions instructions = Instructions::kAvx512;  ///< the edges are the same with all of them
};

/// The predicate that decides on every edge, in double precision: true if the pair shares neither a local nor a target
/// segment, satisfies (2.3), |d_l - d_t| <= epsilon, and |dz_l - dz_t| <= epsilon + max_vertical_slope * d_l.
/// A rotation by a tilt of at most max_vertical_slope radians changes a height difference by no more than the latter.
/// False for coordinates that are not finite or beyond 1e12 m.
bool AreConsistent(const Correspondence& a, const Correspondence& b, double epsilon_m,
                   double max_vertical_slope = std::numeric_limits<double>::infinity());

/// Builds the graph, statelessly for all methods but kCached and kAuto, which remember candidates between calls.
/// Every method returns the same edges, those for which AreConsistent holds.
///
/// Squares: the grid has squares of side b + epsilon, b an upper bound of the 3-D distance between any two local
/// centroids, each divided into two rows of sixteen columns; the correspondences of a column look only as far as the
/// farthest other local centroid is from any of theirs. Pairs are screened in single precision, relative to the middle
/// of each map, with a tolerance widened by the rounding that the maps' extents allow; the predicate decides on what
/// remains.
///
/// Cache: a correspondence (by the keys of both segments) keeps those candidates for which |d_l - d_t| between the
/// anchors, where both were when they were cached, is at most theta + epsilon. It is cached anew once the drifts of its
/// local and its target centroid from their anchors sum to theta / 2 or more; so any pair that is consistent now is
/// among the candidates. The candidates are tested again only once the two have moved far enough to change the answer.
///
/// Not thread-safe; one builder per thread.
class ConsistencyGraphBuilder {
 public:
  /// Throws std::invalid_argument naming the parameter that is out of range.
  explicit ConsistencyGraphBuilder(const ConsistencyParameters& parameters);
  ~ConsistencyGraphBuilder();
  /// Moves; what was moved from can only be assigned to or destroyed.
  ConsistencyGraphBuilder(ConsistencyGraphBuilder&&) noexcept;
  /// Moves likewise.
  ConsistencyGraphBuilder& operator=(ConsistencyGraphBuilder&&) noexcept;

  /// The pairs that may be in a consistent set of `set_size` correspondences: the consistent ones whose two have
  /// set_size - 2 others in common with which both are such pairs again (the truss of that order). All consistent pairs
  /// for a set of two. A correspondence without usable coordinates is in none.
  ConsistentPairs FindPairs(const Correspondences& correspondences, std::size_t set_size);

  /// All consistent pairs as a graph, whose vertex i is correspondences[i].
  ConsistencyGraph Build(const Correspondences& correspondences);

 private:
  class Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace incremental_segmatch
