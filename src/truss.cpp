#include "truss.hpp"

#include <algorithm>

#include "several_targets.hpp"

namespace incremental_segmatch {
namespace {

constexpr std::size_t kWordBits = 64;
constexpr std::size_t kWords = TrussFinder::kSketchWords;

std::size_t CountBits(std::uint64_t word) {
  return static_cast<std::size_t>(__builtin_popcountll(word));
}

}  // namespace

NamedGraph WithoutLoneVertices(std::size_t vertices, Edges edges) {
  std::vector<std::uint32_t> number(vertices, 0);
  for (const auto& [a, b] : edges) number[a] = number[b] = 1;
  NamedGraph kept;
  for (std::uint32_t v = 0; v < vertices; ++v) {
    if (number[v] == 0) continue;
    number[v] = static_cast<std::uint32_t>(kept.names.size());
    kept.names.push_back(v);
  }
  for (auto& [a, b] : edges) {
    a = number[a];
    b = number[b];
  }
  kept.graph = ConsistencyGraph::FromEdges(kept.names.size(), edges);
  return kept;
}

bool TrussFinder::HasBounds(std::size_t vertices, std::size_t edges) {
  return edges <= kSketchWords * kWordBits / 4 * vertices;  // half of a sketch's bits are set, in the mean
}

void TrussFinder::DropByBound(std::size_t vertices, std::size_t k, Edges* edges) {
  if (k < 3 || !HasBounds(vertices, edges->size())) return;
  for (bool pays = true; pays;) {
    const std::size_t before = edges->size();
    Fold(vertices, *edges);
    DropOnce(k - 2, edges);
    pays = 4 * edges->size() < 3 * before;
  }
}

/// Counts and sketches the neighbours of every vertex.
SEGMATCH_SEVERAL_TARGETS
void TrussFinder::Fold(std::size_t vertices, const Edges& edges) {
  degree_.assign(vertices, 0);
  sketches_.assign(vertices, {});
  for (const auto& [a, b] : edges) {
    ++degree_[a];
    ++degree_[b];
    sketches_[a].words[b / kWordBits % kWords] |= std::uint64_t{1} << (b % kWordBits);
    sketches_[b].words[a / kWordBits % kWords] |= std::uint64_t{1} << (a % kWordBits);
  }
  hidden_.resize(vertices);
  for (std::size_t v = 0; v < vertices; ++v) {
    std::size_t set = 0;
    for (const std::uint64_t word : sketches_[v].words) set += CountBits(word);
    hidden_[v] = static_cast<std::uint32_t>(degree_[v] - set);
  }
}

/// Bits that two sketches have in common, and the hidden neighbours of one of the two, bound the common neighbours.
SEGMATCH_SEVERAL_TARGETS
void TrussFinder::DropOnce(std::size_t common, Edges* edges) {
  std::size_t kept = 0;
  for (const ConsistencyGraph::Edge& edge : *edges) {
    const auto& a = sketches_[edge.first].words;
    const auto& b = sketches_[edge.second].words;
    std::size_t most = std::min(hidden_[edge.first], hidden_[edge.second]);
    for (std::size_t w = 0; w < kWords; ++w) most += CountBits(a[w] & b[w]);
    (*edges)[kept] = edge;
    kept += most >= common ? 1 : 0;
  }
  edges->resize(kept);
}

/// Counts what ends have in common, again for the edges of whatever vertex has lost some, until no edge goes any more.
void TrussFinder::DropByCount(std::size_t vertices, std::size_t k, Edges* edges) {
  if (k < 3) return;
  const std::size_t common = k - 2;
  NamedGraph named = WithoutLoneVertices(vertices, *edges);
  graph_ = std::move(named.graph);
  row_end_.assign(graph_.offsets.begin() + 1, graph_.offsets.end());
  is_marked_.assign(named.names.size(), 0);
  is_changed_.assign(named.names.size(), 0);
  changed_.clear();

  for (std::uint32_t v = 0; v < named.names.size(); ++v) Examine(v, common, true);
  while (!changed_.empty()) {
    waiting_.swap(changed_);
    changed_.clear();
    for (const std::uint32_t v : waiting_) {
      is_changed_[v] = 0;
      Examine(v, common, false);
    }
  }

  edges->clear();
  for (std::uint32_t v = 0; v < named.names.size(); ++v) {
    for (std::size_t k = graph_.offsets[v]; k < row_end_[v]; ++k) {
      const std::uint32_t u = graph_.neighbours[k];
      if (v < u) edges->emplace_back(named.names[v], named.names[u]);
    }
  }
}

/// Drops those edges of a vertex whose ends have too little in common.
void TrussFinder::Examine(std::uint32_t v, std::size_t common, bool only_later) {
  for (std::size_t k = graph_.offsets[v]; k < row_end_[v]; ++k) is_marked_[graph_.neighbours[k]] = 1;
  for (std::size_t k = graph_.offsets[v]; k < row_end_[v];) {
    const std::uint32_t u = graph_.neighbours[k];
    if ((only_later && u < v) || HasMarkedNeighbours(u, common)) {
      ++k;
    } else {
      is_marked_[u] = 0;
      DropEdge(v, u);  // another neighbour takes its place
    }
  }
  for (std::size_t k = graph_.offsets[v]; k < row_end_[v]; ++k) is_marked_[graph_.neighbours[k]] = 0;
}

bool TrussFinder::HasMarkedNeighbours(std::uint32_t v, std::size_t number) const {
  std::size_t count = 0;
  for (std::size_t k = graph_.offsets[v]; k < row_end_[v]; ++k) {
    count += is_marked_[graph_.neighbours[k]];
    if (count == number) return true;
  }
  return false;
}

void TrussFinder::DropEdge(std::uint32_t v, std::uint32_t u) {
  for (const auto& [own, other] : {std::make_pair(v, u), std::make_pair(u, v)}) {
    const auto row = graph_.neighbours.begin() + static_cast<std::ptrdiff_t>(graph_.offsets[own]);
    const auto last = graph_.neighbours.begin() + static_cast<std::ptrdiff_t>(--row_end_[own]);
    *std::find(row, last, other) = *last;  // where it is the last one, it stands there already
    if (is_changed_[own]) continue;
    is_changed_[own] = 1;
    changed_.push_back(own);
  }
}

}  // namespace incremental_segmatch
