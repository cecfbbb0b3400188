/// \file
/// A town along a route: what stands where is planned once, its geometry is built when the sensor comes near.
#pragma once

#include <Eigen/Geometry>
#include <cstdint>
#include <memory>
#include <optional>
#include <unordered_map>
#include <vector>

#include "simulator/item.hpp"
#include "simulator/terrain.hpp"
#include "simulator/trajectory_index.hpp"

namespace incremental_segmatch::simulator {

/// What kind of place it is.
enum class World {
  kTown,
  kLookAlike,  ///< a town of equal houses, hedges, trees and lamps at equal distances; cars park by chance
  kOffice      ///< a floor of an office building, flat and without traffic
};

struct TownParameters {
  World world = World::kTown;
  std::uint64_t seed = 1;      ///< of everything that stands still
  std::uint64_t day = 0;       ///< another day: other parked cars and traffic in the same town
  double grade = 0.04;         ///< steepest slope of the ground
  double parked_change = 0.4;  ///< chance that a parked car or a chair changes between two visits more than 60 s apart
  double meetings_per_minute = 6.0;  ///< with oncoming vehicles
  double pedestrians_per_100m = 2.0;
};

/// Geometry and where it is now.
struct PlacedItem {
  Eigen::Isometry3d T_world_item = Eigen::Isometry3d::Identity();
  std::shared_ptr<const std::vector<Primitive>> primitives;
};

/// The plan is a deterministic function of route and parameters; nothing stands in the way of any pass of the route.
/// Not thread-safe: geometry is cached.
class Town {
 public:
  Town(const Route& route, const TownParameters& parameters);

  const Terrain& terrain() const { return terrain_; }
  const TrajectoryIndex& trajectory() const { return trajectory_; }
  /// Everything planned that stands still, parking spots included.
  const std::vector<Item>& plan() const { return plan_; }

  /// What is within radius_m of a place at a time, in an order that depends only on the plan.
  std::vector<PlacedItem> ItemsNear(const Eigen::Vector2d& position_m, double radius_m, double time_s);

  /// The vehicle or chair on a spot, given by its index in the plan, at a time, if any: footprint in the world.
  std::optional<Item> StandsOn(std::size_t spot, double time_s) const;

 private:
  struct Meeting {
    double time_s, path_m, speed_m_s;
    Item vehicle;
  };
  struct Walker {
    double path_m, lateral_m, speed_m_s;
    Item person;
  };

  PlacedItem Place(const Item& item, std::shared_ptr<const std::vector<Primitive>> primitives) const;
  std::uint64_t StateOf(std::size_t spot, double time_s) const;
  void PlanTraffic();
  void AppendTraffic(const Eigen::Vector2d& position_m, double radius_m, double time_s,
                     std::vector<PlacedItem>& items) const;
  void ForgetFar(const Eigen::Vector2d& position_m);

  TownParameters parameters_;
  TrajectoryIndex trajectory_;
  Terrain terrain_;
  std::vector<Item> plan_;
  std::unordered_map<std::uint64_t, std::vector<std::uint32_t>> cells_;
  std::unordered_map<std::uint64_t, std::shared_ptr<const std::vector<Primitive>>> geometry_;  // by item index and make
  std::unordered_map<std::size_t, std::vector<Visit>> visits_;  // by index of the spot in the plan
  Eigen::Vector2d swept_at_m_ = Eigen::Vector2d::Zero();
  std::vector<Meeting> meetings_;
  std::vector<Walker> walkers_;
};

/// The plan alone: items whose footprints overlap neither each other nor the driven path.
std::vector<Item> PlanTown(const TrajectoryIndex& trajectory, const TownParameters& parameters);

}  // namespace incremental_segmatch::simulator
