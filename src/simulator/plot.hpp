/// \file
/// Ground on which things are planned: they keep apart from each other and from the driven path.
#pragma once

#include <cmath>
#include <cstdint>
#include <unordered_map>
#include <utility>
#include <vector>

#include "simulator/item.hpp"
#include "simulator/trajectory_index.hpp"

namespace incremental_segmatch::simulator {

/// Takes items as long as there is room for them. The trajectory must outlive it.
class Plot {
 public:
  explicit Plot(const TrajectoryIndex& trajectory) : trajectory_(trajectory) {}

  /// Adds an item, unless it would be nearer than the margin to another one, or too near to the driven path.
  bool Add(const Item& item, double margin_m) {
    if (!IsFree(item, margin_m)) return false;
    ForEachCell(item.footprint, 0.0,
                [&](std::uint64_t key) { cells_[key].push_back(static_cast<std::uint32_t>(items_.size())); });
    items_.push_back(item);
    return true;
  }

  /// All items, in the order in which they were added.
  std::vector<Item> Take() { return std::move(items_); }

 private:
  static constexpr double kCell_m = 16.0;

  // From the path to the item: half a vehicle, or half a robot, and room.
  static double Clearance(ItemKind kind) {
    switch (kind) {
      case ItemKind::kHouse:
      case ItemKind::kShed:
        return 2.8;
      case ItemKind::kTree:
      case ItemKind::kBush:
        return 2.4;
      case ItemKind::kParkingSpot:
        return 1.55;
      case ItemKind::kPartition:
      case ItemKind::kPillar:
      case ItemKind::kDesk:
      case ItemKind::kCabinet:
      case ItemKind::kPottedPlant:
      case ItemKind::kChairSpot:
        return 0.8;
      default:
        return 1.9;
    }
  }

  bool IsFree(const Item& item, double margin_m) const {
    const double clearance = Clearance(item.kind);
    if (trajectory_.Distance(item.footprint, clearance) < clearance) return false;
    bool free = true;
    ForEachCell(item.footprint, margin_m, [&](std::uint64_t key) {
      const auto cell = cells_.find(key);
      if (cell == cells_.end()) return;
      for (const std::uint32_t index : cell->second) {
        free = free && !Overlap(items_[index].footprint, item.footprint, margin_m);
      }
    });
    return free;
  }

  template <typename Function>
  static void ForEachCell(const Footprint& footprint, double margin_m, Function function) {
    const double reach = footprint.half_m.norm() + margin_m;
    const auto cell = [](double v) { return static_cast<std::int64_t>(std::floor(v / kCell_m)); };
    for (std::int64_t x = cell(footprint.centre_m.x() - reach); x <= cell(footprint.centre_m.x() + reach); ++x) {
      for (std::int64_t y = cell(footprint.centre_m.y() - reach); y <= cell(footprint.centre_m.y() + reach); ++y) {
        function((static_cast<std::uint64_t>(x) << 32) ^ (static_cast<std::uint64_t>(y) & 0xffffffffULL));
      }
    }
  }

  const TrajectoryIndex& trajectory_;
  std::vector<Item> items_;
  std::unordered_map<std::uint64_t, std::vector<std::uint32_t>> cells_;
};

}  // namespace incremental_segmatch::simulator
