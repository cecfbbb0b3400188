/// \file
/// Which descriptors lie near one, over a set that changes (METHOD 4: matching).
#pragma once

#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <string>
#include <unordered_map>
#include <vector>

#include "incremental_segmatch/descriptors.hpp"

namespace incremental_segmatch {

/// Exact search over a changing set of points: all of them are looked at, sixteen at a time, in blocks that hold the same
/// value of sixteen items side by side. In as many dimensions as descriptors have, a tree looks at most of what it holds
/// as well, one by one. Insertion and removal cost O(dimensions), a search O(items * dimensions). Not thread-safe.
class DescriptorIndex {
 public:
  /// Throws std::invalid_argument if there are no dimensions.
  explicit DescriptorIndex(std::size_t dimensions);

  /// Throws std::invalid_argument on a wrong dimension, a value that is not finite, or an item that is there already.
  void Insert(std::uint64_t item, const Descriptor& descriptor);
  /// False if there is no such item.
  bool Remove(std::uint64_t item);
  /// Number of items.
  std::size_t size() const { return items_.size(); }

  /// Calls `float visit(std::uint64_t item, float distance)` for the items within a Euclidean distance (infinity: all),
  /// in no particular order; it returns the radius that holds from then on, which may be smaller. Throws
  /// std::invalid_argument on a wrong dimension or a value that is not finite.
  template <class Visit>
  void Search(const Descriptor& query, float radius, Visit&& visit) const;

 private:
  static constexpr std::size_t kBlock = 16;  ///< items
  /// One value of each item in a block: a cache line.
  struct alignas(64) Lanes {
    std::array<float, kBlock> values;
  };

  void RequireValid(const Descriptor& descriptor, const std::string& what) const;
  std::uint32_t FindNear(const Descriptor& query, float square_bound, std::size_t* block, Lanes* squares) const;

  /// No square of a distance within the radius is larger, whatever root and square are rounded to.
  static float SquareBound(float radius) {
    constexpr float kMargin = 1e-5f;
    return radius * radius * (1.f + kMargin) + std::numeric_limits<float>::min();
  }

  std::size_t dimensions_;
  std::vector<Lanes> lanes_;          ///< block after block, `dimensions_` each; room in the last one is NaN
  std::vector<std::uint64_t> items_;  ///< in the order of the blocks
  std::unordered_map<std::uint64_t, std::size_t> places_;  ///< index of an item in items_
};

template <class Visit>
void DescriptorIndex::Search(const Descriptor& query, float radius, Visit&& visit) const {
  RequireValid(query, "a query");
  float square_bound = SquareBound(radius);
  Lanes squares;
  for (std::size_t block = 0; std::uint32_t near = FindNear(query, square_bound, &block, &squares); ++block) {
    for (; near != 0; near &= near - 1) {
      const auto lane = static_cast<std::size_t>(__builtin_ctz(near));
      const float distance = std::sqrt(squares.values[lane]);
      if (!(distance <= radius)) continue;
      radius = visit(items_[block * kBlock + lane], distance);
    }
    square_bound = SquareBound(radius);
  }
}

}  // namespace incremental_segmatch
