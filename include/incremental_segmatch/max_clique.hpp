/// \file
/// Exact maximum clique of a consistency graph (METHOD 5; thesis 3.4.3).
#pragma once

#include <chrono>
#include <cstdint>
#include <functional>
#include <vector>

#include "incremental_segmatch/consistency_graph.hpp"

namespace incremental_segmatch {

struct MaxCliqueParameters {
  std::size_t min_size = 6;                                  ///< T: smaller cliques are no answer; >= 3
  std::chrono::microseconds deadline{100000};                ///< then the incumbent is returned, unproven
};

struct MaxCliqueResult {
  std::vector<std::uint32_t> vertices;   ///< sorted; empty if no clique of min_size was found
  std::size_t upper_bound = 0;           ///< no clique is larger than this
  bool proven_maximum = true;            ///< false if the deadline ended the search
};

/// Of several maximum cliques the one that `better(a, b)` prefers is returned (a strict weak order over sorted vertex
/// lists); without it the lexicographically smallest list.
MaxCliqueResult FindMaxClique(const ConsistencyGraph& graph, const MaxCliqueParameters& parameters,
                              const std::function<bool(const std::vector<std::uint32_t>&,
                                                       const std::vector<std::uint32_t>&)>& better = {});

}  // namespace incremental_segmatch
