/// \file
/// Which edges of a graph may be in a clique of some size, private to the core.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "incremental_segmatch/consistency_graph.hpp"

namespace incremental_segmatch {

using Edges = std::vector<ConsistencyGraph::Edge>;

/// A part of a graph; its vertices are renumbered in their order.
struct NamedGraph {
  ConsistencyGraph graph;
  std::vector<std::uint32_t> names;  ///< of the vertices: their numbers in the whole graph
};

/// The vertices that have edges, of vertices 0..vertices-1. O(vertices + edges).
NamedGraph WithoutLoneVertices(std::size_t vertices, Edges edges);

/// Reduces a graph towards its k-truss (Cohen), the largest subgraph each of whose edges is in k - 2 triangles of it:
/// every clique of k vertices is in that. The graph's vertices are 0..vertices-1, its edges are given once each. Keeps
/// its memory from one graph to the next.
class TrussFinder {
 public:
  static constexpr std::size_t kSketchWords = 8;  ///< a cache line

  /// Whether a graph is so sparse that bits alone tell something.
  static bool HasBounds(std::size_t vertices, std::size_t edges);
  /// Drops edges for which bits alone tell that they are not in the k-truss, in sparse graphs nearly all of these.
  /// O(vertices + edges).
  void DropByBound(std::size_t vertices, std::size_t k, Edges* edges);
  /// Drops all edges that are not in the k-truss. O(vertices + edges), and for each edge up to the neighbours of an
  /// end, again whenever an end has lost some.
  void DropByCount(std::size_t vertices, std::size_t k, Edges* edges);

 private:
  using Vertices = std::vector<std::uint32_t>;
  /// The neighbours of a vertex, folded into one cache line: neighbour u sets bit u modulo its size.
  struct alignas(64) Sketch {
    std::array<std::uint64_t, kSketchWords> words;
  };

  void Fold(std::size_t vertices, const Edges& edges);
  void DropOnce(std::size_t common, Edges* edges);
  void Examine(std::uint32_t v, std::size_t common, bool only_later);
  bool HasMarkedNeighbours(std::uint32_t v, std::size_t number) const;
  void DropEdge(std::uint32_t v, std::uint32_t u);

  Vertices degree_;
  std::vector<Sketch> sketches_;
  Vertices hidden_;  ///< neighbours of each vertex whose bit another one had set
  // While edges are counted, by new numbers:
  ConsistencyGraph graph_;  ///< its rows lose neighbours, and are as long as row_end_ says
  std::vector<std::size_t> row_end_;
  std::vector<std::uint8_t> is_marked_;  ///< neighbours of the vertex that is examined
  Vertices changed_, waiting_;           ///< vertices that have lost an edge since they were examined
  std::vector<std::uint8_t> is_changed_;
};

}  // namespace incremental_segmatch
