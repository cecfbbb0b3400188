#include "simulator/office_plan.hpp"

#include <algorithm>
#include <cmath>

#include "simulator/plot.hpp"
#include "simulator/random.hpp"

namespace incremental_segmatch::simulator {
namespace {

constexpr double kPi = 3.14159265358979323846;
constexpr double kHalfCorridor_m = 1.2;
constexpr double kRoomDepth_m = 6.5;
constexpr double kHalfWall_m = 0.06;
constexpr double kHalfDoor_m = 0.55;

class OfficePlanner {
 public:
  OfficePlanner(const TrajectoryIndex& trajectory, std::uint64_t seed)
      : random_(HashOf(seed, 7007)), plot_(trajectory) {}

  std::vector<Item> Run() {
    const double outer = kHalfCorridor_m + kRoomDepth_m;
    const Eigen::Vector2d low(-outer, -outer), high(kOfficeLength_m + outer, kOfficeWidth_m + outer);
    for (const double y : {low.y(), high.y()}) Wall({low.x(), y}, {high.x(), y}, kOfficeHeight_m);
    for (const double x : {low.x(), high.x()}) Wall({x, low.y()}, {x, high.y()}, kOfficeHeight_m);
    // Rooms along the outer walls; their fronts face the corridors.
    Rooms({-kHalfCorridor_m, -kHalfCorridor_m}, 0.0, kOfficeLength_m + 2 * kHalfCorridor_m);
    Rooms({kOfficeLength_m + kHalfCorridor_m, kOfficeWidth_m + kHalfCorridor_m}, kPi,
          kOfficeLength_m + 2 * kHalfCorridor_m);
    Rooms({-kHalfCorridor_m, kOfficeWidth_m + kHalfCorridor_m}, -kPi / 2, kOfficeWidth_m + 2 * kHalfCorridor_m);
    Rooms({kOfficeLength_m + kHalfCorridor_m, -kHalfCorridor_m}, kPi / 2, kOfficeWidth_m + 2 * kHalfCorridor_m);
    // Open offices between the corridors.
    const double middle = 0.5 * kOfficeLength_m;
    OpenOffice({kHalfCorridor_m, kHalfCorridor_m}, {middle - kHalfCorridor_m, kOfficeWidth_m - kHalfCorridor_m});
    OpenOffice({middle + kHalfCorridor_m, kHalfCorridor_m},
               {kOfficeLength_m - kHalfCorridor_m, kOfficeWidth_m - kHalfCorridor_m});
    std::vector<Item> items = plot_.Take();
    const Footprint floor{0.5 * (low + high), 0.0, 0.5 * (high - low)};
    items.push_back({ItemKind::kCeiling, floor, kOfficeHeight_m, random_.Bits(), 0.0});
    return items;
  }

 private:
  // Furniture is left out where there is no room for it.
  bool Put(ItemKind kind, const Footprint& footprint, double height_m, double margin_m = 0.05) {
    return plot_.Add({kind, footprint, height_m, random_.Bits(), 0.0}, margin_m);
  }

  // Pieces of at most three metres, so that no corner of one long footprint blocks the rest of it.
  void Wall(const Eigen::Vector2d& from, const Eigen::Vector2d& to, double height_m) {
    const Eigen::Vector2d along = to - from;
    const int pieces = std::max(1, static_cast<int>(std::ceil(along.norm() / 3.0)));
    const double half = 0.5 * along.norm() / pieces;
    for (int i = 0; i < pieces; ++i) {
      const Eigen::Vector2d centre = from + along * ((i + 0.5) / pieces);
      // Long things extend along y.
      Put(ItemKind::kPartition, {centre, std::atan2(along.y(), along.x()) - kPi / 2, {kHalfWall_m, half}}, height_m,
          -0.15);
    }
  }

  // A row of rooms to the right of a line: x along it, y out of the corridor.
  void Rooms(const Eigen::Vector2d& from, double yaw_rad, double length_m) {
    const auto at = [&](double x, double y) {
      return Eigen::Vector2d(from + Eigen::Rotation2Dd(yaw_rad) * Eigen::Vector2d(x, -y));
    };
    for (double begin = 0.0; begin < length_m - 2.0;) {
      double end = begin + random_.Uniform(3.2, 7.5);
      if (length_m - end < 3.0) end = length_m;
      Wall(at(begin, 0.0), at(begin, kRoomDepth_m), kOfficeHeight_m);
      if (random_.Chance(0.6)) {  // closed but for its door
        const double door = random_.Uniform(begin + 0.8, end - 0.8);
        Wall(at(begin, 0.0), at(door - kHalfDoor_m, 0.0), kOfficeHeight_m);
        Wall(at(door + kHalfDoor_m, 0.0), at(end, 0.0), kOfficeHeight_m);
      }
      Furnish([&](double x, double y) { return at(begin + x, y); }, yaw_rad, end - begin, kRoomDepth_m);
      begin = end;
    }
    Wall(at(length_m, 0.0), at(length_m, kRoomDepth_m), kOfficeHeight_m);
  }

  // Desks with their chairs, cabinets along the walls, plants and what else stands about.
  template <typename Place>
  void Furnish(Place at, double yaw_rad, double length_m, double depth_m) {
    const int desks = 1 + random_.Index(1 + static_cast<int>(length_m * depth_m / 9.0));
    for (int i = 0; i < desks; ++i) {
      Desk(at(random_.Uniform(1.0, std::max(1.1, length_m - 1.0)), random_.Uniform(1.0, depth_m - 1.0)),
           yaw_rad + random_.Index(4) * kPi / 2);
    }
    for (int i = 1 + random_.Index(3); i > 0; --i) {
      const double x = random_.Chance(0.5) ? 0.5 : length_m - 0.5;
      Cabinet(at(x, random_.Uniform(0.8, depth_m - 0.8)), yaw_rad);
    }
    for (int i = random_.Index(3); i > 0; --i)
      Plant(at(random_.Uniform(0.6, length_m - 0.6), random_.Uniform(0.6, depth_m - 0.6)));
  }

  void OpenOffice(const Eigen::Vector2d& low, const Eigen::Vector2d& high) {
    for (double x = low.x() + 2.6; x < high.x(); x += 5.2) {
      for (double y = low.y() + 2.6; y < high.y(); y += 5.2)
        Put(ItemKind::kPillar, {{x, y}, 0.0, {0.22, 0.22}}, kOfficeHeight_m);
    }
    for (double x = low.x() + 1.2; x < high.x() - 1.0; x += random_.Uniform(2.3, 3.6)) {
      for (double y = low.y() + 1.2; y < high.y() - 1.0; y += random_.Uniform(2.0, 3.4)) {
        const double pick = random_.Uniform();
        const Eigen::Vector2d place(x + random_.Uniform(-0.3, 0.3), y + random_.Uniform(-0.3, 0.3));
        if (pick < 0.6) {
          Desk(place, random_.Index(4) * kPi / 2);
        } else if (pick < 0.72) {
          Cabinet(place, random_.Index(2) * kPi / 2);
        } else if (pick < 0.84) {
          Plant(place);
        } else if (pick < 0.92) {
          Put(ItemKind::kPartition, {place, random_.Index(2) * kPi / 2, {kHalfWall_m, random_.Uniform(0.7, 1.3)}},
              random_.Uniform(1.2, 1.7));
        }
      }
    }
  }

  void Desk(const Eigen::Vector2d& place, double yaw_rad) {
    const Eigen::Vector2d half(random_.Uniform(0.35, 0.45), random_.Uniform(0.6, 0.95));
    if (!Put(ItemKind::kDesk, {place, yaw_rad, half}, random_.Uniform(0.7, 0.76), 0.15)) return;
    // Room for a chair that is not always in the same place.
    const Eigen::Vector2d seat = place + Eigen::Rotation2Dd(yaw_rad) * Eigen::Vector2d(half.x() + 0.65, 0.0);
    if (random_.Chance(0.85)) Put(ItemKind::kChairSpot, {seat, yaw_rad + kPi, {0.5, 0.5}}, 0.0, 0.0);
  }

  void Cabinet(const Eigen::Vector2d& place, double yaw_rad) {
    Put(ItemKind::kCabinet, {place, yaw_rad, {random_.Uniform(0.2, 0.32), random_.Uniform(0.4, 1.0)}},
        random_.Chance(0.5) ? random_.Uniform(0.8, 1.3) : random_.Uniform(1.7, 2.1), 0.12);
  }

  void Plant(const Eigen::Vector2d& place) {
    const double radius = random_.Uniform(0.22, 0.5);
    Put(ItemKind::kPottedPlant, {place, 0.0, {radius, radius}}, random_.Uniform(0.9, 2.0), 0.12);
  }

  Random random_;
  Plot plot_;
};

}  // namespace

std::vector<Item> PlanOffice(const TrajectoryIndex& trajectory, std::uint64_t seed) {
  return OfficePlanner(trajectory, seed).Run();
}

}  // namespace incremental_segmatch::simulator
