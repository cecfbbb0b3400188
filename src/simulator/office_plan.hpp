/// \file
/// A floor of an office building: corridors around two blocks, rooms along the outer walls, furniture.
#pragma once

#include <cstdint>
#include <vector>

#include "simulator/item.hpp"
#include "simulator/trajectory_index.hpp"

namespace incremental_segmatch::simulator {

/// Size of the ring of corridors that the preset route "office" follows: their middle lines lie at x = 0 and x =
/// kOfficeLength_m, y = 0 and y = kOfficeWidth_m, and one more at half the length.
inline constexpr double kOfficeLength_m = 36.0;
inline constexpr double kOfficeWidth_m = 18.0;
/// Of a room.
inline constexpr double kOfficeHeight_m = 2.7;

/// The plan: items whose footprints overlap neither each other nor the driven path; the ceiling, which is over all of
/// them, comes last.
std::vector<Item> PlanOffice(const TrajectoryIndex& trajectory, std::uint64_t seed);

}  // namespace incremental_segmatch::simulator
