/// \file
/// The things that stand in the town and how each is built of primitives.
#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <vector>

#include "simulator/primitive.hpp"
#include "simulator/trajectory_index.hpp"

namespace incremental_segmatch::simulator {

enum class ItemKind : std::uint8_t {
  kHouse,
  kShed,
  kHedge,
  kWall,
  kPicketFence,
  kTree,
  kBush,
  kLamp,
  kSign,
  kBollard,
  kBench,
  kBin,
  kBusStop,
  kUtilityPole,
  kParkingSpot,  ///< a vehicle that depends on the visit
  kVehicle,
  kPedestrian,
  kPartition,  ///< an inner wall of any height
  kPillar,
  kDesk,
  kCabinet,
  kPottedPlant,
  kCeiling,
  kChairSpot,  ///< a chair whose place depends on the visit
  kChair
};

/// A planned thing. Its frame: origin on the ground at the footprint's centre, x along footprint.yaw_rad, z up.
/// Buildings face +x; vehicles drive towards +x; long things (hedges, walls, fences) extend along y.
struct Item {
  ItemKind kind = ItemKind::kHouse;
  Footprint footprint;
  double height_m = 1.0;
  std::uint64_t seed = 0;
  double lowest_leaf_m = 0.0;  ///< crowns begin at least this high: street trees are pruned
};

/// Geometry of an item in its own frame; a deterministic function of its argument. Parking and chair spots have none of
/// their own.
std::vector<Primitive> BuildItem(const Item& item);

/// A vehicle of a random make: footprint at the origin, to be placed.
Item RandomVehicle(std::uint64_t seed);

}  // namespace incremental_segmatch::simulator
