/// \file
/// Stable sort of indices by integer keys, private to the core.
#pragma once

#include <array>
#include <cstdint>
#include <utility>
#include <vector>

namespace incremental_segmatch {

/// Sorts `order` (indices into `keys`) by key, stably: least significant byte first, skipping bytes that all keys
/// share.
inline std::vector<std::uint32_t> SortedByKey(std::vector<std::uint32_t> order,
                                              const std::vector<std::uint64_t>& keys) {
  if (order.empty()) return order;
  std::uint64_t varying_bits = 0;
  for (const std::uint32_t i : order) varying_bits |= keys[i] ^ keys[order.front()];
  std::vector<std::uint32_t> sorted(order.size());
  for (int shift = 0; shift < 64; shift += 8) {
    if (((varying_bits >> shift) & 0xff) == 0) continue;
    std::array<std::uint32_t, 256> begin{};
    for (const std::uint32_t i : order) ++begin[(keys[i] >> shift) & 0xff];
    std::uint32_t total = 0;
    for (std::uint32_t& count : begin) total += std::exchange(count, total);
    for (const std::uint32_t i : order) sorted[begin[(keys[i] >> shift) & 0xff]++] = i;
    order.swap(sorted);
  }
  return order;
}

}  // namespace incremental_segmatch
