/// \file
/// Correspondences to consistency graph (METHOD 5; thesis 3.4.1 and 3.4.2).
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <vector>

#include "incremental_segmatch/correspondence.hpp"

namespace incremental_segmatch {

/// Undirected graph over correspondences 0..n-1; neighbours are sorted by index, no self loops.
struct ConsistencyGraph {
  std::vector<std::vector<std::uint32_t>> neighbours;
  std::uint64_t tested_pairs = 0;  ///< how many pairs were tested for consistency
  std::size_t edges = 0;
};

enum class ConsistencyMethod { kAllPairs, kPartitioned2D, kPartitioned3D, kCached, kAuto };

struct ConsistencyParameters {
  double epsilon_m = 0.4;                                          ///< tolerance of (2.3)
  ConsistencyMethod method = ConsistencyMethod::kPartitioned2D;    ///< all give the same graph
  double cache_theta_m = 3.0;                                      ///< theta of (3.19), for kCached
};

/// True if the pair satisfies (2.3), |d_l - d_t| <= epsilon, and shares neither a local nor a target segment.
bool AreConsistent(const Correspondence& a, const Correspondence& b, double epsilon_m);

/// Builds the graph, statelessly for all methods but kCached, which remembers candidates between calls.
/// Every method returns the same edges.
class ConsistencyGraphBuilder {
 public:
  explicit ConsistencyGraphBuilder(const ConsistencyParameters& parameters);
  ~ConsistencyGraphBuilder();
  ConsistencyGraphBuilder(ConsistencyGraphBuilder&&) noexcept;
  ConsistencyGraphBuilder& operator=(ConsistencyGraphBuilder&&) noexcept;

  ConsistencyGraph Build(const Correspondences& correspondences);

 private:
  class Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace incremental_segmatch
