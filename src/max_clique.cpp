#include "incremental_segmatch/max_clique.hpp"

#include <algorithm>
#include <iterator>
#include <limits>
#include <numeric>
#include <optional>
#include <stdexcept>
#include <utility>

#include "truss.hpp"

namespace incremental_segmatch {
namespace {

using Word = std::uint64_t;
using Vertices = std::vector<std::uint32_t>;
using Clock = std::chrono::steady_clock;

constexpr std::size_t kWordBits = 64;

std::size_t WordsFor(std::size_t bits) {
  return (bits + kWordBits - 1) / kWordBits;
}
void Set(Word* bits, std::size_t i) {
  bits[i / kWordBits] |= Word{1} << (i % kWordBits);
}
void Clear(Word* bits, std::size_t i) {
  bits[i / kWordBits] &= ~(Word{1} << (i % kWordBits));
}
std::size_t LowestBit(Word word) {
  return static_cast<std::size_t>(__builtin_ctzll(word));
}
inline std::size_t CountBits(Word word) {
  return static_cast<std::size_t>(__builtin_popcountll(word));
}

/// Degeneracy order by bucket sort (Batagelj and Zaversnik): each vertex has at most core[v] neighbours after it.
struct DegeneracyOrder {
  Vertices order;
  Vertices core;  ///< largest k for which the vertex is in a subgraph with all degrees >= k
};

DegeneracyOrder ComputeDegeneracyOrder(const ConsistencyGraph& graph) {
  const std::size_t n = graph.vertices();
  DegeneracyOrder result{Vertices(n), Vertices(n)};
  Vertices position(n);  // of each vertex in the order
  Vertices& degree = result.core;
  std::size_t max_degree = 0;
  for (std::uint32_t v = 0; v < n; ++v) {
    degree[v] = static_cast<std::uint32_t>(graph.Neighbours(v).size());
    max_degree = std::max<std::size_t>(max_degree, degree[v]);
  }
  Vertices bucket_begin(max_degree + 2, 0);
  for (const std::uint32_t d : degree) ++bucket_begin[d + 1];
  for (std::size_t d = 0; d <= max_degree; ++d) bucket_begin[d + 1] += bucket_begin[d];
  Vertices next(bucket_begin.begin(), bucket_begin.end() - 1);
  for (std::uint32_t v = 0; v < n; ++v) {
    position[v] = next[degree[v]]++;
    result.order[position[v]] = v;
  }
  for (std::size_t i = 0; i < n; ++i) {
    const std::uint32_t v = result.order[i];
    for (const std::uint32_t u : graph.Neighbours(v)) {
      if (degree[u] <= degree[v]) continue;
      // Move u to the front of its bucket, which then starts behind it.
      const std::uint32_t front = std::max(bucket_begin[degree[u]], static_cast<std::uint32_t>(i + 1));
      const std::uint32_t w = result.order[front];
      std::swap(result.order[front], result.order[position[u]]);
      std::swap(position[u], position[w]);
      bucket_begin[degree[u]] = front + 1;
      --degree[u];
    }
  }
  return result;
}

/// A dense graph of at most some thousand vertices as rows of bits.
class BitGraph {
 public:
  void Reset(std::size_t vertices) {
    words_ = WordsFor(vertices);
    bits_.assign(vertices * words_, 0);
  }
  std::size_t words() const { return words_; }
  Word* row(std::size_t v) { return bits_.data() + v * words_; }
  const Word* row(std::size_t v) const { return bits_.data() + v * words_; }

 private:
  std::size_t words_ = 0;
  std::vector<Word> bits_;
};

/// What a search has spent, and whether it has to end: 64-bit words of bit sets and neighbours looked at, and time.
class Effort {
 public:
  Effort(std::uint64_t limit, Clock::time_point deadline) : limit_(limit), deadline_(deadline) {}

  void Spend(std::uint64_t work) { spent_ += work; }
  std::uint64_t spent() const { return spent_; }

  bool IsExhausted() {
    constexpr std::uint64_t kBetweenLooksAtTheClock = 1 << 14;
    if (spent_ >= next_look_) {
      next_look_ = spent_ + kBetweenLooksAtTheClock;
      is_late_ = is_late_ || Clock::now() >= deadline_;
    }
    return is_late_ || spent_ > limit_;
  }

 private:
  std::uint64_t limit_;
  Clock::time_point deadline_;
  std::uint64_t spent_ = 0;
  std::uint64_t next_look_ = 0;
  bool is_late_ = false;
};

/// Branch and bound in the neighbourhood of one vertex: cliques of more than `floor` vertices.
class Search {
 public:
  /// Called with each clique that is large enough (indices into the bit graph); returns the new floor.
  using Report = std::function<std::size_t(const Vertices&)>;

  Search(const BitGraph& graph, std::size_t vertices, std::size_t floor, const Report& report, Effort* effort)
      : graph_(graph), words_(graph.words()), floor_(floor), report_(report), effort_(*effort) {
    std::vector<Word> all(words_, 0);
    for (std::size_t v = 0; v < vertices; ++v) Set(all.data(), v);
    Expand(all.data());
  }

  /// False if the effort was exhausted before the end.
  bool is_complete() const { return is_complete_; }

 private:
  struct Coloured {
    std::uint32_t vertex;
    std::uint32_t bound;  ///< no clique among this vertex and those coloured before it is larger
  };

  std::vector<Coloured> Colour(const Word* candidates);
  bool Recolour(std::size_t vertex, std::size_t classes);
  void Expand(Word* candidates);
  Word* ColourClass(std::size_t colour) {
    if ((colour + 1) * words_ > classes_.size()) classes_.resize((colour + 1) * words_, 0);
    return classes_.data() + colour * words_;
  }

  const BitGraph& graph_;
  const std::size_t words_;
  std::size_t floor_;
  const Report& report_;
  Effort& effort_;
  bool is_complete_ = true;
  Vertices clique_;
  std::vector<Word> classes_;  ///< colour classes of the colouring under way, scratch
};

/// Greedy colouring of the candidates, class after class. Returns the vertices that must be branched on, those whose
/// colour exceeds what is needed to beat the floor, in the order of their colours.
std::vector<Search::Coloured> Search::Colour(const Word* candidates) {
  const std::size_t needed = floor_ >= clique_.size() ? floor_ - clique_.size() : 0;  // colours that may be left alone
  std::vector<Coloured> branches;
  std::vector<Word> uncoloured(candidates, candidates + words_);
  std::vector<Word> available(words_);
  for (std::size_t colour = 0;; ++colour) {
    std::size_t first = 0;
    while (first < words_ && uncoloured[first] == 0) ++first;
    if (first == words_) return branches;
    Word* const members = ColourClass(colour);
    std::fill(members, members + words_, 0);
    std::copy(uncoloured.begin(), uncoloured.end(), available.begin());
    bool empty = true;
    for (std::size_t w = first; w < words_; ++w) {
      while (available[w] != 0) {
        const std::size_t v = w * kWordBits + LowestBit(available[w]);
        const Word* const row = graph_.row(v);
        Clear(uncoloured.data(), v);
        Clear(available.data(), v);
        if (colour >= needed && Recolour(v, needed)) continue;
        for (std::size_t k = w; k < words_; ++k) available[k] &= ~row[k];
        effort_.Spend(words_ - w);
        Set(ColourClass(colour), v);
        empty = false;
        if (colour >= needed)
          branches.push_back({static_cast<std::uint32_t>(v), static_cast<std::uint32_t>(colour + 1)});
      }
    }
    if (empty) --colour;  // all its members were recoloured: the colour is free again
  }
}

/// Tries to give the vertex one of the first `classes` colours by moving the only neighbour it has there to another.
bool Search::Recolour(std::size_t vertex, std::size_t classes) {
  const Word* const row = graph_.row(vertex);
  for (std::size_t a = 0; a + 1 < classes; ++a) {
    Word* const class_a = ColourClass(a);
    std::size_t neighbours = 0;
    std::size_t only = 0;
    for (std::size_t k = 0; k < words_ && neighbours < 2; ++k) {
      const Word common = class_a[k] & row[k];
      if (common == 0) continue;
      neighbours += CountBits(common);
      only = k * kWordBits + LowestBit(common);
    }
    effort_.Spend(words_);
    if (neighbours != 1) continue;
    const Word* const row_of_only = graph_.row(only);
    for (std::size_t b = a + 1; b < classes; ++b) {
      Word* const class_b = ColourClass(b);
      bool disjoint = true;
      for (std::size_t k = 0; k < words_ && disjoint; ++k) disjoint = (class_b[k] & row_of_only[k]) == 0;
      effort_.Spend(words_);
      if (!disjoint) continue;
      Clear(class_a, only);
      Set(class_a, vertex);
      Set(class_b, only);
      return true;
    }
  }
  return false;
}

void Search::Expand(Word* candidates) {
  if (effort_.IsExhausted()) is_complete_ = false;
  if (!is_complete_) return;
  const std::vector<Coloured> branches = Colour(candidates);
  std::vector<Word> next(words_);
  for (auto branch = branches.rbegin(); branch != branches.rend() && is_complete_; ++branch) {
    if (clique_.size() + branch->bound <= floor_) return;
    const Word* const row = graph_.row(branch->vertex);
    Word any = 0;
    for (std::size_t k = 0; k < words_; ++k) any |= next[k] = candidates[k] & row[k];
    effort_.Spend(words_);
    clique_.push_back(branch->vertex);
    if (any != 0) {
      Expand(next.data());
    } else if (clique_.size() > floor_) {
      floor_ = report_(clique_);
    }
    clique_.pop_back();
    Clear(candidates, branch->vertex);
  }
}

/// The subgraph of the vertices for which keep(v), and their numbers in the whole graph.
template <typename Keep>
NamedGraph Subgraph(const ConsistencyGraph& graph, Keep keep) {
  constexpr std::uint32_t kDropped = std::numeric_limits<std::uint32_t>::max();
  Vertices new_index(graph.vertices(), kDropped);
  Vertices names;
  std::size_t most_neighbours = 0;
  for (std::uint32_t v = 0; v < graph.vertices(); ++v) {
    if (!keep(v)) continue;
    new_index[v] = static_cast<std::uint32_t>(names.size());
    names.push_back(v);
    most_neighbours += graph.Neighbours(v).size();
  }
  ConsistencyGraph subgraph;
  subgraph.offsets.reserve(names.size() + 1);
  subgraph.neighbours.resize(most_neighbours);
  std::size_t count = 0;
  for (const std::uint32_t v : names) {
    for (const std::uint32_t u : graph.Neighbours(v)) {
      subgraph.neighbours[count] = new_index[u];
      count += new_index[u] != kDropped ? 1 : 0;
    }
    subgraph.offsets.push_back(count);
  }
  subgraph.neighbours.resize(count);
  subgraph.edges = count / 2;
  return {std::move(subgraph), std::move(names)};
}

/// Without edges that are in no clique of `size` vertices; nothing where none is known to be.
std::optional<NamedGraph> WithoutUnsupportedEdges(const ConsistencyGraph& graph, std::size_t size,
                                                  TrussFinder* finder) {
  if (!TrussFinder::HasBounds(graph.vertices(), graph.edges)) return std::nullopt;
  Edges edges;
  edges.reserve(graph.edges);
  for (std::uint32_t v = 0; v < graph.vertices(); ++v) {
    for (const std::uint32_t u : graph.Neighbours(v))
      if (v < u) edges.emplace_back(v, u);
  }
  finder->DropByBound(graph.vertices(), size, &edges);
  if (edges.size() == graph.edges) return std::nullopt;
  return WithoutLoneVertices(graph.vertices(), std::move(edges));
}

/// The vertices of a graph that are in a core of some order, renumbered in degeneracy order.
class CoreGraph {
 public:
  CoreGraph() = default;
  /// The vertices go by their names in the whole graph.
  CoreGraph(const ConsistencyGraph& whole, const Vertices& names, std::size_t min_core);

  std::size_t size() const { return names_.size(); }
  std::uint32_t name(std::uint32_t v) const { return names_[v]; }
  std::size_t core(std::uint32_t v) const { return core_[v]; }
  ConsistencyGraph::Range Neighbours(std::uint32_t v) const {
    return {neighbours_.data() + offsets_[v], neighbours_.data() + offsets_[v + 1]};
  }
  /// Those that come after v in the order, no more than core(v).
  ConsistencyGraph::Range LaterNeighbours(std::uint32_t v) const {
    const ConsistencyGraph::Range all = Neighbours(v);
    return {std::upper_bound(all.begin(), all.end(), v), all.end()};
  }

 private:
  Vertices names_;
  Vertices core_;
  std::vector<std::size_t> offsets_{0};
  Vertices neighbours_;
};

CoreGraph::CoreGraph(const ConsistencyGraph& whole, const Vertices& names, std::size_t min_core) {
  // Most vertices of a sparse graph have too low a degree: without them the rest is cheap.
  const auto [graph, whole_name] =
      Subgraph(whole, [&](std::uint32_t v) { return whole.Neighbours(v).size() >= min_core; });
  constexpr std::uint32_t kDropped = std::numeric_limits<std::uint32_t>::max();
  const DegeneracyOrder degeneracy = ComputeDegeneracyOrder(graph);
  Vertices new_index(graph.vertices(), kDropped);
  Vertices ordered;
  for (const std::uint32_t v : degeneracy.order) {
    if (degeneracy.core[v] < min_core) continue;
    new_index[v] = static_cast<std::uint32_t>(ordered.size());
    ordered.push_back(v);
    names_.push_back(names[whole_name[v]]);
    core_.push_back(degeneracy.core[v]);
  }
  for (const std::uint32_t v : ordered) {
    std::size_t degree = 0;
    for (const std::uint32_t u : graph.Neighbours(v)) degree += new_index[u] != kDropped ? 1 : 0;
    offsets_.push_back(offsets_.back() + degree);
  }
  neighbours_.resize(offsets_.back());
  std::vector<std::size_t> next(offsets_.begin(), offsets_.end() - 1);
  for (std::uint32_t v = 0; v < ordered.size(); ++v) {
    for (const std::uint32_t u : graph.Neighbours(ordered[v])) {
      if (new_index[u] != kDropped) neighbours_[next[new_index[u]]++] = v;
    }
  }
}

/// One search over a graph: the vertices in degeneracy order, each with its later neighbourhood.
class Finder {
 public:
  Finder(const ConsistencyGraph& graph, const MaxCliqueParameters& parameters, const CliqueOrder& better)
      : parameters_(parameters),
        better_(better),
        effort_(parameters.max_work, Clock::now() + parameters.deadline),
        remaining_(&graph),
        names_(graph.vertices()),
        floor_(parameters.min_size - 1) {
    std::iota(names_.begin(), names_.end(), 0);
  }

  MaxCliqueResult Find();

 private:
  using Report = std::function<std::size_t(Vertices)>;

  void GrowGreedily();
  void KeepCliquesOf(std::size_t size);
  bool Maximize();
  void CompareTies();
  Vertices Members(std::uint32_t v, std::size_t floor, Effort* effort);
  bool SearchFrom(std::uint32_t v, std::size_t floor, const Report& report, Effort* effort);
  Vertices Named(const Vertices& clique) const;

  const MaxCliqueParameters& parameters_;
  const CliqueOrder& better_;
  Effort effort_;                      ///< of the search for the maximum
  const ConsistencyGraph* remaining_;  ///< the given graph, or the reduced one
  ConsistencyGraph reduced_;           ///< without what can't matter any more
  Vertices names_;                     ///< of the remaining vertices: their numbers in the given graph
  CoreGraph graph_;                    ///< of the remaining one
  Vertices best_;                      ///< incumbent in the original graph, sorted
  std::size_t floor_;                  ///< only larger cliques are looked for
  MaxCliqueResult result_;
  TrussFinder truss_finder_;
  BitGraph bits_;
  Vertices local_index_;  ///< scratch, all 0 between uses: one more than the index in the bit graph
};

Vertices Finder::Named(const Vertices& clique) const {
  Vertices names;
  for (const std::uint32_t v : clique) names.push_back(graph_.name(v));
  std::sort(names.begin(), names.end());
  return names;
}

/// An incumbent, if one of the cliques around the vertices of the highest degrees is larger than the last: grown by the
/// candidate of the highest degree, again and again, from vertices that are in none yet.
void Finder::GrowGreedily() {
  constexpr std::size_t kStarts = 16;
  const ConsistencyGraph& graph = *remaining_;
  Vertices degree, starts(graph.vertices());
  degree.reserve(graph.vertices());
  for (std::uint32_t v = 0; v < graph.vertices(); ++v)
    degree.push_back(static_cast<std::uint32_t>(graph.Neighbours(v).size()));
  std::iota(starts.begin(), starts.end(), 0);
  const std::size_t count = std::min(kStarts, starts.size());
  std::partial_sort(
      starts.begin(), starts.begin() + static_cast<std::ptrdiff_t>(count), starts.end(),
      [&](std::uint32_t a, std::uint32_t b) { return degree[a] > degree[b] || (degree[a] == degree[b] && a < b); });
  starts.resize(count);
  Vertices candidates, common;
  for (const std::uint32_t start : starts) {
    if (degree[start] < floor_ || effort_.IsExhausted()) return;
    if (std::binary_search(best_.begin(), best_.end(), names_[start])) continue;  // it would grow into the same one
    candidates.assign(graph.Neighbours(start).begin(), graph.Neighbours(start).end());
    Vertices clique{start};
    while (!candidates.empty() && clique.size() + candidates.size() > floor_) {
      clique.push_back(*std::max_element(candidates.begin(), candidates.end(),
                                         [&](std::uint32_t a, std::uint32_t b) { return degree[a] < degree[b]; }));
      const ConsistencyGraph::Range all = graph.Neighbours(clique.back());
      effort_.Spend(candidates.size() + all.size());
      common.clear();
      std::set_intersection(candidates.begin(), candidates.end(), all.begin(), all.end(), std::back_inserter(common));
      candidates.swap(common);
    }
    if (!candidates.empty() || clique.size() <= floor_) continue;
    floor_ = clique.size();
    for (std::uint32_t& v : clique) v = names_[v];
    std::sort(clique.begin(), clique.end());
    best_ = std::move(clique);
  }
}

/// Drops what is in no clique of at least `size` vertices.
void Finder::KeepCliquesOf(std::size_t size) {
  if (std::optional<NamedGraph> kept = WithoutUnsupportedEdges(*remaining_, size, &truss_finder_)) {
    for (std::uint32_t& name : kept->names) name = names_[name];
    names_ = std::move(kept->names);
    reduced_ = std::move(kept->graph);
    remaining_ = &reduced_;
  }
  graph_ = CoreGraph(*remaining_, names_, size - 1);
  local_index_.resize(graph_.size(), 0);
}

/// Later neighbours of v that may be with it in a clique of more than `floor` vertices: each has at least floor - 1
/// neighbours among them. High degrees first, as colouring wants them.
Vertices Finder::Members(std::uint32_t v, std::size_t floor, Effort* effort) {
  Vertices members;
  for (const std::uint32_t u : graph_.LaterNeighbours(v)) {
    if (graph_.core(u) >= floor) members.push_back(u);
  }
  Vertices degree;
  for (;;) {
    if (members.size() < floor) return {};
    for (std::uint32_t i = 0; i < members.size(); ++i) local_index_[members[i]] = i + 1;
    degree.assign(members.size(), 0);
    for (std::size_t i = 0; i < members.size(); ++i) {
      const ConsistencyGraph::Range later = graph_.LaterNeighbours(members[i]);
      effort->Spend(later.size());
      for (const std::uint32_t u : later) {
        if (local_index_[u] == 0) continue;
        ++degree[i];
        ++degree[local_index_[u] - 1];
      }
    }
    for (const std::uint32_t u : members) local_index_[u] = 0;
    Vertices kept;
    for (std::size_t i = 0; i < members.size(); ++i) {
      if (degree[i] + 1 >= floor) kept.push_back(members[i]);
    }
    if (kept.size() == members.size()) break;
    members.swap(kept);
  }
  Vertices by_degree(members.size());
  for (std::uint32_t i = 0; i < by_degree.size(); ++i) by_degree[i] = i;
  std::stable_sort(by_degree.begin(), by_degree.end(),
                   [&](std::uint32_t a, std::uint32_t b) { return degree[a] > degree[b]; });
  for (std::uint32_t& i : by_degree) i = members[i];
  return by_degree;
}

/// Searches the later neighbourhood of v for cliques of more than `floor` vertices, v included. False if the effort
/// was exhausted.
bool Finder::SearchFrom(std::uint32_t v, std::size_t floor, const Report& report, Effort* effort) {
  if (effort->IsExhausted()) return false;
  const Vertices members = Members(v, floor, effort);
  if (members.empty()) return true;
  bits_.Reset(members.size());
  for (std::uint32_t i = 0; i < members.size(); ++i) local_index_[members[i]] = i + 1;
  for (std::uint32_t i = 0; i < members.size(); ++i) {
    for (const std::uint32_t u : graph_.LaterNeighbours(members[i])) {
      if (local_index_[u] == 0) continue;
      Set(bits_.row(i), local_index_[u] - 1);
      Set(bits_.row(local_index_[u] - 1), i);
    }
  }
  for (const std::uint32_t u : members) local_index_[u] = 0;

  const Search::Report report_members = [&](const Vertices& clique) {
    Vertices vertices{v};
    for (const std::uint32_t i : clique) vertices.push_back(members[i]);
    return report(Named(vertices)) - 1;  // v is not among the bit graph's vertices
  };
  return Search(bits_, members.size(), floor - 1, report_members, effort).is_complete();
}

/// Raises the incumbent to a maximum clique; false if the effort was exhausted before that was proven.
bool Finder::Maximize() {
  const Report report = [&](Vertices clique) {
    floor_ = clique.size();
    best_ = std::move(clique);
    return floor_;
  };
  result_.upper_bound = floor_;
  for (std::uint32_t v = 0; v < graph_.size(); ++v) {
    if (graph_.core(v) < floor_) continue;
    if (SearchFrom(v, floor_, report, &effort_)) continue;
    // What is left lies in a vertex with its later neighbours, no more than the core number.
    for (std::uint32_t u = v; u < graph_.size(); ++u) {
      result_.upper_bound = std::max(result_.upper_bound, graph_.LaterNeighbours(u).size() + 1);
    }
    result_.upper_bound = std::max(result_.upper_bound, floor_);
    return result_.upper_bound == floor_;
  }
  result_.upper_bound = floor_;
  return true;
}

/// Looks through the cliques of the maximum size for the best one, as far as the limits allow.
void Finder::CompareTies() {
  std::size_t ties = 0;
  Effort effort(parameters_.max_tie_work, Clock::time_point::max());
  const std::size_t floor = floor_ - 1;
  const Report report = [&](Vertices clique) {
    ++ties;
    if (better_ ? better_(clique, best_) : clique < best_) best_ = std::move(clique);
    // A clique above the maximum does not exist: asking for one ends the search.
    return ties >= parameters_.max_ties ? graph_.size() : floor;
  };
  for (std::uint32_t v = 0; v < graph_.size(); ++v) {
    if (graph_.core(v) < floor) continue;
    if (SearchFrom(v, floor, report, &effort) && ties < parameters_.max_ties) continue;
    result_.all_ties_compared = false;
    return;
  }
}

MaxCliqueResult Finder::Find() {
  const bool compares_ties = parameters_.max_ties > 1;
  const auto smallest_wanted = [&] { return std::max(parameters_.min_size, compares_ties ? floor_ : floor_ + 1); };
  GrowGreedily();
  const std::size_t known = floor_;
  KeepCliquesOf(smallest_wanted());
  GrowGreedily();
  if (floor_ > known) KeepCliquesOf(smallest_wanted());
  const std::size_t kept = smallest_wanted();
  result_.proven_maximum = Maximize();
  if (!best_.empty()) {
    if (result_.proven_maximum && compares_ties) {
      if (floor_ > kept) KeepCliquesOf(floor_);
      CompareTies();
    } else {
      result_.all_ties_compared = false;
    }
  }
  result_.vertices = std::move(best_);
  result_.work = effort_.spent();
  return std::move(result_);
}

}  // namespace

MaxCliqueResult FindMaxClique(const ConsistencyGraph& graph, const MaxCliqueParameters& parameters,
                              const CliqueOrder& better) {
  if (parameters.min_size < 3) throw std::invalid_argument("MaxCliqueParameters: min_size must be at least 3");
  if (parameters.max_work == 0) throw std::invalid_argument("MaxCliqueParameters: max_work must be positive");
  if (parameters.deadline.count() <= 0) throw std::invalid_argument("MaxCliqueParameters: deadline must be positive");
  if (parameters.max_ties < 1) throw std::invalid_argument("MaxCliqueParameters: max_ties must be at least 1");
  return Finder(graph, parameters, better).Find();
}

}  // namespace incremental_segmatch
