/// \file
/// Exact maximum clique of a consistency graph (METHOD 5; thesis 3.4.3).
#pragma once

#include <chrono>
#include <cstdint>
#include <functional>
#include <vector>

#include "incremental_segmatch/consistency_graph.hpp"

namespace incremental_segmatch {

/// Of the search. Its effort is counted in 64-bit words of bit sets and in neighbours looked at: a count, unlike a
/// time, makes the answer repeatable on any machine under any load. A million takes one to three milliseconds.
struct MaxCliqueParameters {
  std::size_t min_size = 6;           ///< T: smaller cliques are no answer; >= 3
  std::uint64_t max_work = 10000000;  ///< effort, after which the incumbent is returned, unproven; > 0
  /// The same as a time, for machines so slow or so loaded that the effort takes longer; > 0.
  std::chrono::microseconds deadline{100000};
  /// How many maximum cliques are compared at most; 1 takes the first one found.
  std::size_t max_ties = 1000;
  std::uint64_t max_tie_work = 400000;  ///< effort of the search for further maximum cliques
};

/// What the search found.
struct MaxCliqueResult {
  std::vector<std::uint32_t> vertices;  ///< sorted; empty if no clique of min_size was found
  std::size_t upper_bound = 0;          ///< no clique is larger than this (min_size - 1 where there is proof of none)
  bool proven_maximum = true;           ///< false if max_work or the deadline ended the search
  bool all_ties_compared = true;  ///< false if max_ties or max_tie_work ended the comparison, or nothing was proven
  std::uint64_t work = 0;         ///< effort of the search, that for further maximum cliques apart
};

/// A strict weak order over sorted vertex lists: true if the first one is the better answer.
using CliqueOrder = std::function<bool(const std::vector<std::uint32_t>&, const std::vector<std::uint32_t>&)>;

/// A maximum clique of at least min_size vertices. Of several the one that `better` prefers is returned; without it the
/// lexicographically smallest list.
///
/// A first incumbent is grown greedily around the vertices of the highest degrees. What is in no larger clique, because
/// a vertex is in no core of that order or an edge in too few triangles (trusses, Cohen; of most such edges a bound on
/// bits tells it), is dropped. Vertices that are left are visited in degeneracy order (bucket sort, Batagelj and
/// Zaversnik); each one's later neighbourhood is searched by branch and bound on bit sets with greedy colouring and
/// recolouring as bound (after Tomita et al., MCS).
/// A second pass, only when the size is proven, looks through the cliques of that size for the best of them.
///
/// Deterministic for a given labelling of the vertices unless the deadline passes before max_work is spent. Where
/// all_ties_compared the answer does not depend on the labelling either, given that `better` does not; label by
/// something canonical for the rest. Exponential in the worst case, near O(vertices + edges) where few edges survive.
/// Throws std::invalid_argument naming a parameter that is out of range.
MaxCliqueResult FindMaxClique(const ConsistencyGraph& graph, const MaxCliqueParameters& parameters,
                              const CliqueOrder& better = {});

}  // namespace incremental_segmatch
