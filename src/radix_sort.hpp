/// \file
/// Stable sort of indices by integer keys, private to the core.
#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <tuple>
#include <utility>
#include <vector>

namespace incremental_segmatch {

/// Sorts `order` (indices into `keys`) by key, stably: least significant byte first, skipping bytes that all keys
/// share.
inline std::vector<std::uint32_t> SortedByKey(std::vector<std::uint32_t> order,
                                              const std::vector<std::uint64_t>& keys) {
  struct Entry {
    std::uint64_t key;
    std::uint32_t index;
  };
  std::uint64_t varying_bits = 0;
  for (const std::uint32_t i : order) varying_bits |= keys[i] ^ keys[order.front()];
  if (varying_bits == 0) return order;
  std::vector<Entry> entries, sorted(order.size());
  entries.reserve(order.size());
  for (const std::uint32_t i : order) entries.push_back({keys[i], i});
  for (int shift = 0; shift < 64; shift += 8) {
    if (((varying_bits >> shift) & 0xff) == 0) continue;
    std::array<std::uint32_t, 256> begin{};
    for (const Entry& entry : entries) ++begin[(entry.key >> shift) & 0xff];
    std::uint32_t total = 0;
    for (std::uint32_t& count : begin) total += std::exchange(count, total);
    for (const Entry& entry : entries) sorted[begin[(entry.key >> shift) & 0xff]++] = entry;
    entries.swap(sorted);
  }
  for (std::size_t i = 0; i < order.size(); ++i) order[i] = entries[i].index;
  return order;
}

/// Sorts `order` by the first key, then by the second, stably. O(n) compares where it is sorted already.
inline std::vector<std::uint32_t> SortedByKeys(std::vector<std::uint32_t> order,
                                               const std::vector<std::uint64_t>& first_keys,
                                               const std::vector<std::uint64_t>& second_keys) {
  const auto less = [&](std::uint32_t a, std::uint32_t b) {
    return std::tie(first_keys[a], second_keys[a]) < std::tie(first_keys[b], second_keys[b]);
  };
  if (std::is_sorted(order.begin(), order.end(), less)) return order;
  return SortedByKey(SortedByKey(std::move(order), second_keys), first_keys);
}

}  // namespace incremental_segmatch
