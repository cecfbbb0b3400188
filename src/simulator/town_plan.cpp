#include <algorithm>
#include <cmath>

#include "simulator/office_plan.hpp"
#include "simulator/plot.hpp"
#include "simulator/random.hpp"
#include "simulator/town.hpp"

namespace incremental_segmatch::simulator {
namespace {

constexpr double kPi = 3.14159265358979323846;
constexpr double kAxisLeftOfVehicle_m = 1.75;
constexpr double kHalfRoad_m = 3.5;
constexpr double kParkingRow_m = 0.85;  // parked cars' middle beyond the kerb

// What lies beside the carriageway; metres are outwards from the kerb.
struct Profile {
  bool parking;        ///< a row of parked cars comes first
  double furniture_m;  ///< trees, lamps and signs
  double boundary_m;   ///< hedges, fences, walls and facades begin here
};

// A side of a street that no earlier part of the route has passed: places are given by metres along it and metres
// outwards from its kerb.
class StreetSide {
 public:
  StreetSide(const TrajectoryIndex& trajectory, double begin_m, double end_m, bool left, const Profile& profile)
      : trajectory_(trajectory), begin_m_(begin_m), end_m_(end_m), left_(left), profile_(profile) {}

  const Profile& profile() const { return profile_; }

  double length_m() const { return end_m_ - begin_m_; }

  // A footprint that faces the street.
  Footprint At(double along_m, double outwards_m, const Eigen::Vector2d& half_m) const {
    const PathSample& sample = trajectory_.AtPath(begin_m_ + along_m);
    const double lateral =
        left_ ? kAxisLeftOfVehicle_m + kHalfRoad_m + outwards_m : -(kHalfRoad_m - kAxisLeftOfVehicle_m + outwards_m);
    const Eigen::Vector2d normal(-std::sin(sample.yaw_rad), std::cos(sample.yaw_rad));
    return {sample.position_m + lateral * normal, sample.yaw_rad + (left_ ? -kPi / 2 : kPi / 2), half_m};
  }

 private:
  const TrajectoryIndex& trajectory_;
  double begin_m_, end_m_;
  bool left_;
  Profile profile_;
};

enum class District { kDetached, kTerraced, kApartments, kGreen, kCommerce };

// Slowly varying over the town.
District DistrictAt(const Eigen::Vector2d& position_m, std::uint64_t seed, Random& random) {
  static constexpr double kQuarter_m = 110.0;
  const auto x =
      static_cast<std::int64_t>(std::floor(position_m.x() / kQuarter_m + 0.3 * std::sin(position_m.y() / 40)));
  const auto y =
      static_cast<std::int64_t>(std::floor(position_m.y() / kQuarter_m + 0.3 * std::sin(position_m.x() / 40)));
  double pick = ToUnit(HashOf(seed, static_cast<std::uint64_t>(x), static_cast<std::uint64_t>(y)));
  if (random.Chance(0.25)) pick = random.Uniform();
  if (pick < 0.42) return District::kDetached;
  if (pick < 0.72) return District::kTerraced;
  if (pick < 0.88) return District::kApartments;
  if (pick < 0.965) return District::kGreen;
  return District::kCommerce;
}

class Planner {
 public:
  Planner(const TrajectoryIndex& trajectory, const TownParameters& parameters)
      : trajectory_(trajectory),
        parameters_(parameters),
        is_look_alike_(parameters.world == World::kLookAlike),
        random_(HashOf(parameters.seed, 3003)),
        plot_(trajectory) {}

  std::vector<Item> Run() {
    const std::vector<StreetSide> sides = FreshSides();
    if (is_look_alike_) {
      for (const StreetSide& side : sides) LookAlikeSide(side);
    } else {
      for (const StreetSide& side : sides) Lots(side);
      for (const StreetSide& side : sides) CloseGaps(side);
      for (const StreetSide& side : sides) Parking(side);
      for (const StreetSide& side : sides) Furniture(side);
    }
    Background();
    return plot_.Take();
  }

 private:
  std::vector<StreetSide> FreshSides() {
    static constexpr double kSameStreet_m = 8.0, kMinPath_m = 40.0, kShortest_m = 6.0;
    std::vector<StreetSide> sides;
    const auto& samples = trajectory_.samples();
    double begin = -1.0;
    for (std::size_t i = 0; i <= samples.size(); ++i) {
      const bool fresh = i < samples.size() && !trajectory_.WasHereBefore(samples[i], kSameStreet_m, kMinPath_m);
      if (fresh && begin < 0) begin = samples[i].path_m;
      if (!fresh && begin >= 0) {
        const double end = samples[i - 1].path_m;
        if (end - begin > kShortest_m) {
          for (const bool left : {true, false}) AppendSections(sides, begin, end, left);
        }
        begin = -1.0;
      }
    }
    return sides;
  }

  // A long street changes its face now and then.
  void AppendSections(std::vector<StreetSide>& sides, double begin, double end, bool left) {
    while (begin < end) {
      const double length = is_look_alike_ ? end - begin : random_.Uniform(60.0, 140.0);
      const bool parking = is_look_alike_ || random_.Chance(0.6);
      const double pavement = is_look_alike_ ? 1.6 : random_.Uniform(1.3, 2.6);
      const double furniture = parking ? 2.2 : 0.45;
      sides.emplace_back(trajectory_, begin, std::min(end, begin + length), left,
                         Profile{parking, furniture, furniture - 0.3 + pavement});
      begin += length;
    }
  }

  Item Make(ItemKind kind, const Footprint& footprint, double height_m) {
    return {kind, footprint, height_m, random_.Bits(), 0.0};
  }

  Footprint Turned(Footprint footprint, double by_rad) {
    footprint.yaw_rad += by_rad;
    return footprint;
  }

  // Lots with houses, boundaries and gardens.
  void Lots(const StreetSide& side) {
    double along = random_.Uniform(0.0, 4.0);
    while (along < side.length_m()) {
      switch (DistrictAt(side.At(along, 8.0, {0, 0}).centre_m, parameters_.seed, random_)) {
        case District::kDetached:
          along += DetachedLot(side, along);
          break;
        case District::kTerraced:
          along += Terrace(side, along);
          break;
        case District::kApartments:
          along += Apartments(side, along);
          break;
        case District::kGreen:
          along += Green(side, along);
          break;
        case District::kCommerce:
          along += Commerce(side, along);
          break;
      }
      if (random_.Chance(0.05)) along += random_.Uniform(6.0, 10.0);  // a side street
    }
  }

  // A house with its front `setback_m` behind the boundary; a smaller one where that one finds no room.
  bool AddHouse(const StreetSide& side, double middle, double setback_m, Eigen::Vector2d half_m, double turned_rad,
                double height_m, double margin_m) {
    for (int attempt = 0; attempt < 3; ++attempt, half_m *= 0.8) {
      const Footprint at = side.At(middle, side.profile().boundary_m + setback_m + half_m.x(), half_m);
      if (plot_.Add(Make(ItemKind::kHouse, Turned(at, turned_rad), height_m), margin_m)) return true;
    }
    return false;
  }

  // Houses where lots collided and left a hole in the street's face.
  void CloseGaps(const StreetSide& side) {
    for (double along = 0.0; along < side.length_m(); along += 3.0) {
      const Eigen::Vector2d half(random_.Uniform(4.0, 6.0), random_.Uniform(3.2, 5.5));
      const double setback = random_.Uniform(0.2, 4.0), height = random_.Uniform(2.8, 7.0);
      if (random_.Chance(0.5)) AddHouse(side, along, setback, half, 0.0, height, 1.2);
    }
  }

  double DetachedLot(const StreetSide& side, double along) {
    const double width = random_.Uniform(10.5, 17.0), middle = along + 0.5 * width;
    const double setback = random_.Uniform(0.3, 5.0), half_depth = random_.Uniform(5.0, 7.5);
    const double half_width = std::min(0.5 * width - 0.9, random_.Uniform(4.2, 7.5));
    const double shift = random_.Uniform(-0.8, 0.8) * (0.5 * width - half_width - 0.6);
    const double turned = random_.Chance(0.3) ? random_.Uniform(-0.2, 0.2) : 0.0;
    const bool built = AddHouse(side, middle + shift, setback + 0.5 * (turned != 0.0), {half_depth, half_width}, turned,
                                random_.Uniform(2.9, 7.0), 1.0);
    if (random_.Chance(0.55)) {
      const double corner = middle + (shift > 0 ? -1 : 1) * (0.5 * width - 1.9);
      const double drive = random_.Uniform(0.3, 8.0);
      plot_.Add(Make(ItemKind::kShed, side.At(corner, side.profile().boundary_m + drive + 3.0, {3.0, 1.6}),
                     random_.Uniform(2.3, 2.9)),
                0.3);
      if (drive > 5.5)
        AddSpot(side.At(corner, side.profile().boundary_m + drive - 2.7, {2.5, 1.05}), random_.Chance(0.5) ? 0.0 : kPi);
    }
    Boundary(side, along + 0.3, along + width - 0.3);
    Garden(side, along, width, built ? setback : 8.0, 1 + random_.Index(5));
    return width;
  }

  double Terrace(const StreetSide& side, double along) {
    const int units = 2 + random_.Index(4);
    const double width = random_.Uniform(5.5, 8.5), half_depth = random_.Uniform(5.0, 6.5),
                 setback = random_.Chance(0.6) ? 0.1 : random_.Uniform(0.5, 4.0);
    const double height = random_.Uniform(5.5, 9.0);
    for (int i = 0; i < units; ++i) {
      const double own = setback + (random_.Chance(0.4) ? random_.Uniform(0.0, 1.0) : 0.0);
      AddHouse(side, along + (i + 0.5) * width, own, {half_depth, 0.5 * width - 0.06}, 0.0,
               height + random_.Uniform(-0.4, 0.4), 0.02);
      if (setback > 2.0 && random_.Chance(0.6)) Boundary(side, along + i * width + 0.2, along + (i + 1) * width - 1.2);
      if (setback > 1.5) Garden(side, along + i * width, width, setback, random_.Index(2));
    }
    return units * width + random_.Uniform(0.8, 4.0);
  }

  double Apartments(const StreetSide& side, double along) {
    const double half_width = random_.Uniform(8.0, 14.0), half_depth = random_.Uniform(5.5, 7.0),
                 setback = random_.Chance(0.4) ? 0.2 : random_.Uniform(1.0, 7.0);
    AddHouse(side, along + half_width, setback, {half_depth, half_width}, 0.0, random_.Uniform(8.0, 15.0), 1.0);
    if (random_.Chance(0.5)) Boundary(side, along, along + 2 * half_width);
    Garden(side, along, 2 * half_width, setback, 2 + random_.Index(4));
    return 2 * half_width + random_.Uniform(1.5, 6.0);
  }

  double Green(const StreetSide& side, double along) {
    const double width = random_.Uniform(15.0, 35.0);
    if (random_.Chance(0.5)) Boundary(side, along, along + width);
    Garden(side, along, width, 15.0, static_cast<int>(0.8 * width));
    for (int i = random_.Index(3); i > 0; --i) {
      plot_.Add(Make(ItemKind::kBench,
                     side.At(along + random_.Uniform(0, width), side.profile().boundary_m + random_.Uniform(0.8, 6.0),
                             {0.4, 0.9}),
                     0.9),
                0.3);
    }
    return width;
  }

  double Commerce(const StreetSide& side, double along) {
    const double half_width = random_.Uniform(11.0, 18.0), half_depth = random_.Uniform(8.0, 12.0);
    plot_.Add(Make(ItemKind::kHouse,
                   side.At(along + half_width, side.profile().boundary_m + 9.0 + half_depth, {half_depth, half_width}),
                   random_.Uniform(4.5, 8.0)),
              1.0);
    for (double at = along + 1.5; at < along + 2 * half_width; at += 2.7) {
      AddSpot(side.At(at, side.profile().boundary_m + 4.5, {2.5, 1.15}), random_.Chance(0.5) ? 0.0 : kPi);
    }
    for (double at = along; at < along + 2 * half_width; at += random_.Uniform(1.6, 6.0)) {
      plot_.Add(
          Make(ItemKind::kBollard, side.At(at, side.profile().boundary_m, {0.12, 0.12}), random_.Uniform(0.9, 1.1)),
          0.2);
    }
    return 2 * half_width + random_.Uniform(2.0, 6.0);
  }

  // A hedge, wall or fence in pieces that step down with the slope, with gaps for gates.
  void Boundary(const StreetSide& side, double begin, double end) {
    const int kind = random_.Index(7);
    if (kind == 6) return;
    const double height = kind < 3 ? random_.Uniform(1.0, 2.2) : random_.Uniform(0.85, 1.7);
    const double thickness = random_.Uniform(0.3, 0.65);
    const double gate = random_.Uniform(begin, end), gate_half = random_.Uniform(0.6, 1.9);
    const double piece = random_.Uniform(1.6, 3.6);
    for (double at = begin; at + 0.6 < end; at += piece) {
      const double width = std::min(piece, end - at);
      if (std::abs(at + 0.5 * width - gate) < gate_half + 0.5 * width) continue;
      const ItemKind item = kind < 3 ? ItemKind::kHedge : kind < 5 ? ItemKind::kWall : ItemKind::kPicketFence;
      const double half_x = kind < 3 ? thickness : 0.2;
      plot_.Add(Make(item, side.At(at + 0.5 * width, side.profile().boundary_m, {half_x, 0.5 * width}), height), -0.03);
    }
    // Between neighbours, away from the street.
    if (!random_.Chance(0.6)) return;
    const double depth = random_.Uniform(4.0, 14.0), across_piece = 2.5;
    const ItemKind item = kind < 3 ? ItemKind::kHedge : ItemKind::kPicketFence;
    for (double out = side.profile().boundary_m + 0.8; out < side.profile().boundary_m + depth; out += across_piece) {
      plot_.Add(Make(item, Turned(side.At(begin - 0.2, out + 0.5 * across_piece, {0.3, 0.5 * across_piece}), kPi / 2),
                     height),
                -0.03);
    }
  }

  void Garden(const StreetSide& side, double along, double width, double depth, int plants) {
    for (int i = 0; i < plants; ++i) {
      const Footprint at = side.At(along + random_.Uniform(0.5, width - 0.5),
                                   side.profile().boundary_m + random_.Uniform(0.9, std::max(1.2, depth)), {0, 0});
      random_.Chance(0.45) ? AddTree(at, 0.7) : AddBush(at);
    }
  }

  // Trees whose crowns reach over the street are pruned.
  double LowestLeaf(const Footprint& at) const {
    static constexpr double kReach_m = 7.0, kPruned_m = 3.4;
    return trajectory_.Distance(at, kReach_m) < kReach_m ? kPruned_m : 0.0;
  }

  void AddTree(Footprint at, double margin) {
    const double radius = random_.Uniform(0.07, 0.32);
    at.half_m = {radius, radius};
    Item tree = Make(ItemKind::kTree, at, 3.0 + 22.0 * radius + random_.Uniform(0.0, 3.0));
    tree.lowest_leaf_m = LowestLeaf(at);
    plot_.Add(tree, margin);
  }

  void AddBush(Footprint at) {
    const double radius = random_.Uniform(0.4, 1.5);
    at.half_m = {radius, radius};
    plot_.Add(Make(ItemKind::kBush, at, radius * random_.Uniform(1.3, 2.2)), 0.1);
  }

  void AddSpot(const Footprint& footprint, double turned_rad) {
    plot_.Add(Make(ItemKind::kParkingSpot, Turned(footprint, turned_rad), 0.0), 0.2);
  }

  // Rows of kerbside parking along parts of the street.
  void Parking(const StreetSide& side) {
    if (!side.profile().parking) return;
    double along = random_.Uniform(0.0, 20.0);
    while (along < side.length_m()) {
      const int spots = 1 + random_.Index(7);
      const bool row = random_.Chance(0.75);
      const double direction = random_.Chance(0.85) ? 0.0 : kPi;
      for (int i = 0; i < spots; ++i, along += random_.Uniform(5.6, 6.8)) {
        if (row) AddSpot(Turned(side.At(along, kParkingRow_m, {2.6, 1.0}), -kPi / 2), direction);
      }
      along += random_.Uniform(2.0, 12.0);
    }
  }

  // Street trees, lamps, signs and small things between road and pavement.
  void Furniture(const StreetSide& side) {
    const auto at = [&](double along) {
      return side.At(along, side.profile().furniture_m + random_.Uniform(-0.1, 0.3), {0.15, 0.15});
    };
    for (double along = random_.Uniform(3.0, 25.0); along < side.length_m(); along += random_.Uniform(22.0, 38.0)) {
      const bool wooden = random_.Chance(0.2);
      plot_.Add(Make(wooden ? ItemKind::kUtilityPole : ItemKind::kLamp, at(along), random_.Uniform(4.5, 8.0)), 0.5);
    }
    for (double along = random_.Uniform(2.0, 30.0); along < side.length_m();) {
      const int trees = 1 + random_.Index(6);
      const double spacing = random_.Uniform(6.0, 12.0);
      for (int i = 0; i < trees; ++i, along += spacing * random_.Uniform(0.8, 1.2)) AddTree(at(along), 0.8);
      along += random_.Uniform(8.0, 45.0);
    }
    for (double along = random_.Uniform(2.0, 15.0); along < side.length_m(); along += random_.Uniform(7.0, 30.0)) {
      const double pick = random_.Uniform();
      if (pick < 0.45) {
        plot_.Add(Make(ItemKind::kSign, Turned(at(along), kPi / 2), random_.Uniform(2.2, 3.2)), 0.3);
      } else if (pick < 0.7) {
        Footprint bins = side.At(along, side.profile().boundary_m - 0.7, {0.4, 1.0});
        plot_.Add(Make(ItemKind::kBin, bins, 1.1), 0.1);
      } else if (pick < 0.9) {
        for (int i = 0; i < 4; ++i) plot_.Add(Make(ItemKind::kBollard, at(along + 1.6 * i), 1.0), 0.3);
      } else {
        plot_.Add(Make(ItemKind::kBusStop,
                       side.At(along, side.profile().furniture_m + 0.6, {0.85, random_.Uniform(1.5, 2.4)}), 2.5),
                  0.3);
      }
    }
  }

  // Everything that is built or planted is equal, at equal distances: the seed of each kind is one and the same.
  // Parking spots lie at equal distances too; which cars stand there is chance, as in reality.
  void LookAlikeSide(const StreetSide& side) {
    const auto add = [&](ItemKind kind, const Footprint& footprint, double height, double margin, std::uint64_t make) {
      plot_.Add({kind, footprint, height, HashOf(parameters_.seed, make), LowestLeaf(footprint)}, margin);
    };
    for (double along = 12.0; along < side.length_m(); along += 16.0) {
      add(ItemKind::kHouse, side.At(along, side.profile().boundary_m + 9.5, {6.0, 5.5}), 5.5, 1.0, 1);
      add(ItemKind::kShed, side.At(along + 7.5, side.profile().boundary_m + 9.0, {3.0, 1.6}), 2.5, 0.3, 2);
      for (int i = 0; i < 4; ++i)
        add(ItemKind::kHedge, side.At(along - 4.5 + 2.5 * i, side.profile().boundary_m, {0.4, 1.25}), 1.4, -0.03, 3);
      add(ItemKind::kTree, side.At(along + 6.0, side.profile().furniture_m, {0.18, 0.18}), 8.0, 0.5, 4);
      for (const double at : {along, along + 8.0})
        AddSpot(Turned(side.At(at, kParkingRow_m, {2.6, 1.0}), -kPi / 2), 0.0);
    }
    for (double along = 20.0; along < side.length_m(); along += 32.0)
      add(ItemKind::kLamp, side.At(along, side.profile().furniture_m, {0.15, 0.15}), 6.0, 0.3, 5);
  }

  // Back rows: houses, sheds and trees on a jittered grid wherever the streets left room.
  void Background() {
    static constexpr double kSpacing_m = 13.0, kNearest_m = 13.0, kFarthest_m = 65.0;
    Eigen::Vector2d low = trajectory_.samples().front().position_m, high = low;
    for (const PathSample& sample : trajectory_.samples()) {
      low = low.cwiseMin(sample.position_m);
      high = high.cwiseMax(sample.position_m);
    }
    low.array() -= kFarthest_m;
    high.array() += kFarthest_m;
    for (double x = low.x(); x < high.x(); x += kSpacing_m) {
      for (double y = low.y(); y < high.y(); y += kSpacing_m) {
        const Eigen::Vector2d place(x + random_.Uniform(0, kSpacing_m), y + random_.Uniform(0, kSpacing_m));
        const double pick = random_.Uniform();
        Footprint at{place, random_.Index(4) * kPi / 2 + random_.Uniform(-0.2, 0.2), {0, 0}};
        const double distance = trajectory_.Distance(at, kFarthest_m);
        if (distance < kNearest_m || distance >= kFarthest_m) continue;
        if (pick < 0.35) {
          at.half_m = {random_.Uniform(4.5, 7.0), random_.Uniform(4.0, 8.0)};
          plot_.Add(Make(ItemKind::kHouse, at, random_.Uniform(3.0, 7.5)), 2.0);
        } else if (pick < 0.5) {
          at.half_m = {random_.Uniform(1.5, 3.0), random_.Uniform(1.2, 2.0)};
          plot_.Add(Make(ItemKind::kShed, at, random_.Uniform(2.1, 2.9)), 0.6);
        } else if (pick < 0.8) {
          AddTree(at, 0.7);
        } else {
          AddBush(at);
        }
      }
    }
  }

  const TrajectoryIndex& trajectory_;
  const TownParameters& parameters_;
  bool is_look_alike_;
  Random random_;
  Plot plot_;
};

}  // namespace

std::vector<Item> PlanTown(const TrajectoryIndex& trajectory, const TownParameters& parameters) {
  return parameters.world == World::kOffice ? PlanOffice(trajectory, parameters.seed)
                                            : Planner(trajectory, parameters).Run();
}

}  // namespace incremental_segmatch::simulator
