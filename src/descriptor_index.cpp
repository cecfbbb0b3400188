#include "incremental_segmatch/descriptor_index.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>
#include <string>
#include <unordered_map>
#include <utility>

// FLANN's C++ interface is templates over its k-d tree; nothing of it leaves this file.
#include <flann/algorithms/dist.h>
#include <flann/algorithms/kdtree_single_index.h>

namespace incremental_segmatch {
namespace {

/// Squared distance; FLANN's own takes one value at a time.
struct Distance : flann::L2<float> {
  float operator()(const float* a, const float* b, std::size_t size, float /*worst*/ = -1.f) const {
    using Values = Eigen::Map<const Eigen::VectorXf>;
    return (Values(a, static_cast<Eigen::Index>(size)) - Values(b, static_cast<Eigen::Index>(size))).squaredNorm();
  }
};
using KdTree = flann::KDTreeSingleIndex<Distance>;

constexpr std::size_t kBufferSize = 64;  // items searched directly; a tree of level i holds up to kBufferSize << i
constexpr int kLeafSize = 12;
constexpr int kInBuffer = -1;

// FLANN sums the distance to a cell up in float on the way down: a cell may seem farther than it is by a few roundings.
constexpr float kPruningMargin = 1e-5f;

bool Nearer(const DescriptorMatch& a, const DescriptorMatch& b) {
  return a.distance < b.distance || (a.distance == b.distance && a.item < b.item);
}

/// Items with their descriptors, row by row.
struct Rows {
  std::vector<std::uint64_t> items;
  std::vector<float> values;

  void Append(std::uint64_t item, const float* descriptor, std::size_t dimensions) {
    items.push_back(item);
    values.insert(values.end(), descriptor, descriptor + dimensions);
  }
};

/// The best items so far, over all trees of the forest: FLANN asks it how far it still has to look.
class BestMatches final : public flann::ResultSet<float> {
 public:
  BestMatches(std::size_t count, float radius) : count_(count), radius_(radius) { SetBound(radius); }

  /// Rows that FLANN's indices refer to from now on, and which of them are dead.
  void Enter(const std::vector<std::uint64_t>& items, const std::vector<bool>& dead) {
    items_ = &items;
    dead_ = &dead;
  }

  bool full() const override { return true; }
  float worstDist() const override { return bound_; }
  void addPoint(float squared_distance, std::size_t row) override {
    if (!(*dead_)[row]) Add(squared_distance, (*items_)[row]);
  }

  void Add(float squared_distance, std::uint64_t item) {
    const DescriptorMatch match{item, std::sqrt(squared_distance)};
    if (!(match.distance <= radius_)) return;
    if (heap_.size() == count_) {
      if (!Nearer(match, heap_.front())) return;
      std::pop_heap(heap_.begin(), heap_.end(), Nearer);
      heap_.pop_back();
    }
    heap_.push_back(match);
    std::push_heap(heap_.begin(), heap_.end(), Nearer);
    if (heap_.size() == count_) SetBound(heap_.front().distance);
  }

  std::vector<DescriptorMatch> Take() {
    std::sort_heap(heap_.begin(), heap_.end(), Nearer);
    return std::move(heap_);
  }

 private:
  /// FLANN passes on what is strictly nearer than its bound; what is as far as the worst match may still win by its
  /// item.
  void SetBound(float distance) {
    bound_ = distance * distance * (1.f + kPruningMargin) + std::numeric_limits<float>::min();
  }

  std::size_t count_;
  float radius_;
  float bound_ = 0.f;
  std::vector<DescriptorMatch> heap_;  ///< the worst in front
  const std::vector<std::uint64_t>* items_ = nullptr;
  const std::vector<bool>* dead_ = nullptr;
};

/// A static k-d tree over rows that it owns.
class Tree {
 public:
  Tree(Rows rows, std::size_t dimensions)
      : rows_(std::move(rows)), dead_(rows_.items.size(), false), live_(rows_.items.size()) {
    const flann::Matrix<float> matrix(rows_.values.data(), rows_.items.size(), dimensions);
    index_ = std::make_unique<KdTree>(matrix, flann::KDTreeSingleIndexParams(kLeafSize));
    index_->buildIndex();
  }

  void Search(const float* query, BestMatches* best) const {
    best->Enter(rows_.items, dead_);
    index_->findNeighbors(*best, query, flann::SearchParams(flann::FLANN_CHECKS_UNLIMITED, 0.f));
  }
  void Kill(std::size_t row) {
    dead_[row] = true;
    --live_;
  }
  std::size_t live() const { return live_; }
  bool IsHalfDead() const { return 2 * live_ <= rows_.items.size(); }
  const std::vector<std::uint64_t>& items() const { return rows_.items; }

  void AppendLive(Rows* rows, std::size_t dimensions) const {
    for (std::size_t row = 0; row < rows_.items.size(); ++row)
      if (!dead_[row]) rows->Append(rows_.items[row], rows_.values.data() + row * dimensions, dimensions);
  }

 private:
  Rows rows_;
  std::vector<bool> dead_;
  std::size_t live_;
  std::unique_ptr<KdTree> index_;
};

}  // namespace

class DescriptorIndex::Impl {
 public:
  explicit Impl(std::size_t dimensions) : dimensions_(dimensions) {
    if (dimensions == 0) throw std::invalid_argument("descriptor index: descriptors must have at least one value");
  }

  void Insert(std::uint64_t item, const Descriptor& descriptor) {
    RequireValid(descriptor, "the descriptor of item " + std::to_string(item));
    if (!places_.emplace(item, Place{kInBuffer, buffer_.items.size()}).second) {
      throw std::invalid_argument("descriptor index: item " + std::to_string(item) +
                                  " is there already; remove it before it is inserted anew");
    }
    buffer_.Append(item, descriptor.data(), dimensions_);
    if (buffer_.items.size() == kBufferSize) EmptyBuffer();
  }

  bool Remove(std::uint64_t item) {
    const auto it = places_.find(item);
    if (it == places_.end()) return false;
    const Place place = it->second;
    places_.erase(it);
    if (place.level == kInBuffer) {
      RemoveFromBuffer(place.row);
      return true;
    }
    Tree& tree = *trees_[place.level];
    tree.Kill(place.row);
    if (tree.IsHalfDead()) Rebuild(place.level);
    return true;
  }

  std::size_t size() const { return places_.size(); }

  std::vector<DescriptorMatch> Nearest(const Descriptor& query, std::size_t count, float radius) const {
    RequireValid(query, "a query");
    if (count == 0) return {};
    BestMatches best(count, radius);
    // The largest tree first: it is the likeliest to hold near items, which spare work in the others.
    for (auto tree = trees_.rbegin(); tree != trees_.rend(); ++tree)
      if (*tree) (*tree)->Search(query.data(), &best);
    const Distance distance;
    for (std::size_t row = 0; row < buffer_.items.size(); ++row)
      best.Add(distance(query.data(), buffer_.values.data() + row * dimensions_, dimensions_), buffer_.items[row]);
    return best.Take();
  }

 private:
  struct Place {
    int level;  ///< of the tree, or kInBuffer
    std::size_t row;
  };

  void RequireValid(const Descriptor& descriptor, const std::string& what) const {
    if (static_cast<std::size_t>(descriptor.size()) != dimensions_) {
      throw std::invalid_argument("descriptor index: " + what + " has " + std::to_string(descriptor.size()) +
                                  " values instead of " + std::to_string(dimensions_));
    }
    if (!descriptor.allFinite()) throw std::invalid_argument("descriptor index: " + what + " is not finite");
  }

  void RemoveFromBuffer(std::size_t row) {
    const std::size_t last = buffer_.items.size() - 1;
    if (row != last) {
      buffer_.items[row] = buffer_.items[last];
      std::copy_n(buffer_.values.begin() + last * dimensions_, dimensions_, buffer_.values.begin() + row * dimensions_);
      places_.at(buffer_.items[row]).row = row;
    }
    buffer_.items.pop_back();
    buffer_.values.resize(last * dimensions_);
  }

  /// Bentley and Saxe: buffer and all trees below the lowest free level become one tree there.
  void EmptyBuffer() {
    Rows rows = std::move(buffer_);
    buffer_ = Rows();
    std::size_t level = 0;
    for (; level < trees_.size() && trees_[level]; ++level) {
      trees_[level]->AppendLive(&rows, dimensions_);
      trees_[level].reset();
    }
    PutTree(level, std::move(rows));
  }

  /// Drops the dead items of a tree and puts the rest as low as there is place.
  void Rebuild(std::size_t level) {
    Rows rows;
    trees_[level]->AppendLive(&rows, dimensions_);
    trees_[level].reset();
    if (!rows.items.empty()) {
      for (std::size_t lower = 0; lower < level; ++lower) {
        if (trees_[lower] || rows.items.size() > (kBufferSize << lower)) continue;
        level = lower;
        break;
      }
      PutTree(level, std::move(rows));
    }
    while (!trees_.empty() && !trees_.back()) trees_.pop_back();
  }

  void PutTree(std::size_t level, Rows rows) {
    if (trees_.size() <= level) trees_.resize(level + 1);
    trees_[level] = std::make_unique<Tree>(std::move(rows), dimensions_);
    const std::vector<std::uint64_t>& items = trees_[level]->items();
    for (std::size_t row = 0; row < items.size(); ++row) places_[items[row]] = {static_cast<int>(level), row};
  }

  std::size_t dimensions_;
  Rows buffer_;
  std::vector<std::unique_ptr<Tree>> trees_;  ///< by level, null where there is none
  std::unordered_map<std::uint64_t, Place> places_;
};

DescriptorIndex::DescriptorIndex(std::size_t dimensions) : impl_(std::make_unique<Impl>(dimensions)) {}
DescriptorIndex::~DescriptorIndex() = default;
DescriptorIndex::DescriptorIndex(DescriptorIndex&&) noexcept = default;
DescriptorIndex& DescriptorIndex::operator=(DescriptorIndex&&) noexcept = default;

void DescriptorIndex::Insert(std::uint64_t item, const Descriptor& descriptor) {
  impl_->Insert(item, descriptor);
}
bool DescriptorIndex::Remove(std::uint64_t item) {
  return impl_->Remove(item);
}
std::size_t DescriptorIndex::size() const {
  return impl_->size();
}
std::vector<DescriptorMatch> DescriptorIndex::Nearest(const Descriptor& query, std::size_t count, float radius) const {
  return impl_->Nearest(query, count, radius);
}

}  // namespace incremental_segmatch
