/// \file
/// Exact maximum clique of a consistency graph (METHOD 5; thesis 3.4.3).
#pragma once

#include <chrono>
#include <cstdint>
#include <functional>
#include <vector>

#include "incremental_segmatch/consistency_graph.hpp"

namespace incremental_segmatch {

/// Of the search.
struct MaxCliqueParameters {
  std::size_t min_size = 6;                    ///< T: smaller cliques are no answer; >= 3
  std::chrono::microseconds deadline{100000};  ///< then the incumbent is returned, unproven; > 0
  /// How many maximum cliques are compared at most; 1 takes the first one found.
  std::size_t max_ties = 1000;
  /// Effort of the search for further maximum cliques, in 64-bit words of bit sets touched. A count and not a time, so
  /// that the answer is repeatable. 4 million take some milliseconds.
  std::uint64_t max_tie_work = 4000000;
};

/// What the search found.
struct MaxCliqueResult {
  std::vector<std::uint32_t> vertices;  ///< sorted; empty if no clique of min_size was found
  std::size_t upper_bound = 0;          ///< no clique is larger than this (min_size - 1 where there is proof of none)
  bool proven_maximum = true;           ///< false if the deadline ended the search
  bool all_ties_compared = true;        ///< false if max_ties, max_tie_work or the deadline ended the comparison
};

/// A strict weak order over sorted vertex lists: true if the first one is the better answer.
using CliqueOrder = std::function<bool(const std::vector<std::uint32_t>&, const std::vector<std::uint32_t>&)>;

/// A maximum clique of at least min_size vertices. Of several the one that `better` prefers is returned; without it the
/// lexicographically smallest list.
///
/// A first incumbent is grown greedily around the vertices of the highest degrees. What is in no larger clique, because a
/// vertex is in no core of that order or an edge in too few triangles (trusses, Cohen), is dropped. Vertices that are
/// left are visited in degeneracy order (bucket sort, Batagelj and Zaversnik); each one's later neighbourhood is searched
/// by branch and bound on bit sets with greedy colouring and recolouring as bound (after Tomita et al., MCS). A second
/// pass, only when the size is proven, looks through the cliques of that size for the best of them.
///
/// Deterministic for a given labelling of the vertices unless the deadline passes. Where all_ties_compared the answer
/// does not depend on the labelling either, given that `better` does not; label by something canonical for the rest.
/// Exponential in the worst case, near O(vertices + edges) where few edges survive. Throws
/// std::invalid_argument naming a parameter that is out of range.
MaxCliqueResult FindMaxClique(const ConsistencyGraph& graph, const MaxCliqueParameters& parameters,
                              const CliqueOrder& better = {});

}  // namespace incremental_segmatch
