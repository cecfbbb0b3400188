/// \file
/// Nearest neighbours over descriptors, with insertion and removal and without rebuilding (METHOD 4; FLANN inside).
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <vector>

#include "incremental_segmatch/descriptors.hpp"

namespace incremental_segmatch {

/// An item near a query.
struct DescriptorMatch {
  std::uint64_t item = 0;  ///< as numbered at insertion
  float distance = 0.f;    ///< Euclidean
};

/// Exact k-nearest and radius search over a changing set of points. A logarithmic forest: static FLANN k-d trees of
/// doubling sizes, a small buffer searched directly, removed items skipped until half of a tree is dead. Insertion and
/// removal cost O(log^2 n) amortised; a query that of O(log n) trees. Not thread-safe.
class DescriptorIndex {
 public:
  /// Throws std::invalid_argument if there are no dimensions.
  explicit DescriptorIndex(std::size_t dimensions);
  ~DescriptorIndex();
  /// Moves; what was moved from can only be assigned to or destroyed.
  DescriptorIndex(DescriptorIndex&&) noexcept;
  /// Moves likewise.
  DescriptorIndex& operator=(DescriptorIndex&&) noexcept;

  /// Throws std::invalid_argument on a wrong dimension, a value that is not finite, or an item that is there already.
  void Insert(std::uint64_t item, const Descriptor& descriptor);
  /// False if there is no such item.
  bool Remove(std::uint64_t item);
  /// Number of items.
  std::size_t size() const;

  /// The `count` nearest items among those within `radius` (infinity: no limit), by ascending (distance, item),
  /// whatever the order of insertions and removals. Throws std::invalid_argument on a wrong dimension or a value that
  /// is not finite.
  std::vector<DescriptorMatch> Nearest(const Descriptor& query, std::size_t count, float radius) const;

 private:
  class Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace incremental_segmatch
