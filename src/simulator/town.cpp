#include "simulator/town.hpp"

#include <algorithm>
#include <cmath>

#include "simulator/random.hpp"

namespace incremental_segmatch::simulator {
namespace {

constexpr double kCell_m = 32.0;
constexpr double kMargin_m = 150.0;  // ground around the path
constexpr double kForget_m = 250.0;  // geometry farther than this is dropped
constexpr double kVisitRadius_m = 80.0;
constexpr double kIndoorVisitRadius_m = 15.0;
constexpr double kVisitGap_s = 20.0;
constexpr double kChangeGap_s = 60.0;
constexpr double kOccupied = 0.72;
constexpr double kMeetingSpan_s = 9.0;
constexpr double kOncomingLane_m = 3.5;

bool IsSpot(ItemKind kind) {
  return kind == ItemKind::kParkingSpot || kind == ItemKind::kChairSpot;
}

std::uint64_t CellKey(const Eigen::Vector2d& p) {
  const auto x = static_cast<std::int64_t>(std::floor(p.x() / kCell_m)),
             y = static_cast<std::int64_t>(std::floor(p.y() / kCell_m));
  return (static_cast<std::uint64_t>(x) << 32) ^ (static_cast<std::uint64_t>(y) & 0xffffffffULL);
}

Terrain TerrainAround(const TrajectoryIndex& trajectory, const TownParameters& parameters) {
  Eigen::Vector2d low = trajectory.samples().front().position_m, high = low;
  for (const PathSample& sample : trajectory.samples()) {
    low = low.cwiseMin(sample.position_m);
    high = high.cwiseMax(sample.position_m);
  }
  const Eigen::Vector2d margin(kMargin_m, kMargin_m);
  return Terrain(parameters.seed, low - margin, high + margin, parameters.grade);
}

}  // namespace

Town::Town(const Route& route, const TownParameters& parameters)
    : parameters_(parameters),
      trajectory_(route),
      terrain_(TerrainAround(trajectory_, parameters)),
      plan_(PlanTown(trajectory_, parameters)) {
  for (std::uint32_t i = 0; i < plan_.size(); ++i) {
    const Eigen::Vector2d& at = plan_[i].footprint.centre_m;
    cells_[CellKey(at)].push_back(i);
    if (IsSpot(plan_[i].kind)) {
      const double radius_m = plan_[i].kind == ItemKind::kChairSpot ? kIndoorVisitRadius_m : kVisitRadius_m;
      visits_[i] = trajectory_.Visits(at, radius_m, kVisitGap_s);
    }
  }
  PlanTraffic();
}

void Town::PlanTraffic() {
  Random random(HashOf(parameters_.seed, 4004, parameters_.day));
  const auto& samples = trajectory_.samples();
  if (parameters_.meetings_per_minute > 0) {
    const double mean_gap_s = 60.0 / parameters_.meetings_per_minute;
    double time_s = samples.front().time_s;
    for (const PathSample& sample : samples) {
      if (sample.time_s < time_s) continue;
      Item vehicle = RandomVehicle(random.Bits());
      meetings_.push_back({sample.time_s, sample.path_m, random.Uniform(6.0, 13.0), vehicle});
      time_s = sample.time_s - mean_gap_s * std::log(1.0 - random.Uniform());
    }
  }
  const int walkers = static_cast<int>(parameters_.pedestrians_per_100m * samples.back().path_m / 100.0);
  for (int i = 0; i < walkers; ++i) {
    Item person;
    person.kind = ItemKind::kPedestrian;
    person.height_m = random.Uniform(1.5, 1.9);
    const double lateral = random.Chance(0.5) ? random.Uniform(8.2, 8.8) : -random.Uniform(4.7, 5.3);
    walkers_.push_back({random.Uniform(0.0, samples.back().path_m), lateral, random.Uniform(-1.6, 1.6), person});
  }
}

PlacedItem Town::Place(const Item& item, std::shared_ptr<const std::vector<Primitive>> primitives) const {
  const Eigen::Vector2d& at = item.footprint.centre_m;
  PlacedItem placed;
  placed.T_world_item.linear() = Eigen::AngleAxisd(item.footprint.yaw_rad, Eigen::Vector3d::UnitZ()).toRotationMatrix();
  placed.T_world_item.translation() = Eigen::Vector3d(at.x(), at.y(), terrain_.Height(at.x(), at.y()));
  placed.primitives = std::move(primitives);
  return placed;
}

// What stands on a spot is drawn from this: it changes by chance between visits, and from day to day.
std::uint64_t Town::StateOf(std::size_t index, double time_s) const {
  const Item& spot = plan_.at(index);
  std::uint64_t state = HashOf(spot.seed, 17);
  if (parameters_.day != 0 && ToUnit(HashOf(spot.seed, 18, parameters_.day)) < parameters_.parked_change * 1.3) {
    state = HashOf(spot.seed, 19, parameters_.day);
  }
  const std::vector<Visit>& visits = visits_.at(index);
  for (std::size_t k = 1; k < visits.size() && visits[k].begin_s <= time_s; ++k) {
    if (visits[k].begin_s - visits[k - 1].end_s < kChangeGap_s) continue;
    const std::uint64_t draw = HashOf(spot.seed, k, parameters_.day);
    if (ToUnit(draw) < parameters_.parked_change) state = Mix(draw);
  }
  return state;
}

std::optional<Item> Town::StandsOn(std::size_t index, double time_s) const {
  const Item& spot = plan_.at(index);
  const Eigen::Vector2d& at = spot.footprint.centre_m;
  const std::uint64_t state = StateOf(index, time_s);
  if (spot.kind == ItemKind::kChairSpot) {
    Random random(state);
    Item chair{ItemKind::kChair, spot.footprint, 1.0, spot.seed, 0.0};
    chair.footprint.centre_m = at + Eigen::Vector2d(random.Uniform(-0.2, 0.2), random.Uniform(-0.2, 0.2));
    chair.footprint.yaw_rad += random.Uniform(-0.6, 0.6);
    chair.footprint.half_m = {0.26, 0.26};
    return chair;
  }
  if (!(ToUnit(HashOf(state, 1)) < kOccupied)) return std::nullopt;
  Item vehicle = RandomVehicle(HashOf(state, 2));
  // Cars longer than the spot don't park there.
  for (std::uint64_t again = 3; vehicle.footprint.half_m.x() > spot.footprint.half_m.x(); ++again) {
    vehicle = RandomVehicle(HashOf(state, again));
  }
  Random random(state);
  const double slack_x = std::max(0.0, spot.footprint.half_m.x() - vehicle.footprint.half_m.x());
  const Eigen::Vector2d shift(random.Uniform(-slack_x, slack_x), random.Uniform(-0.1, 0.1));
  vehicle.footprint.yaw_rad = spot.footprint.yaw_rad + random.Uniform(-0.03, 0.03);
  vehicle.footprint.centre_m = at + Eigen::Rotation2Dd(spot.footprint.yaw_rad) * shift;
  return vehicle;
}

void Town::ForgetFar(const Eigen::Vector2d& position_m) {
  if ((position_m - swept_at_m_).norm() < 50.0) return;
  swept_at_m_ = position_m;
  for (auto it = geometry_.begin(); it != geometry_.end();) {
    const Item& item = plan_[it->first];
    it = (item.footprint.centre_m - position_m).norm() > kForget_m ? geometry_.erase(it) : std::next(it);
  }
}

std::vector<PlacedItem> Town::ItemsNear(const Eigen::Vector2d& position_m, double radius_m, double time_s) {
  ForgetFar(position_m);
  std::vector<std::uint32_t> near;
  const double reach = radius_m + kCell_m;
  for (double x = position_m.x() - reach; x <= position_m.x() + reach; x += kCell_m) {
    for (double y = position_m.y() - reach; y <= position_m.y() + reach; y += kCell_m) {
      const auto cell = cells_.find(CellKey({x, y}));
      if (cell == cells_.end()) continue;
      for (const std::uint32_t index : cell->second) {
        const Footprint& footprint = plan_[index].footprint;
        if ((footprint.centre_m - position_m).norm() < radius_m + footprint.half_m.norm()) near.push_back(index);
      }
    }
  }
  std::sort(near.begin(), near.end());
  std::vector<PlacedItem> items;
  for (const std::uint32_t index : near) {
    const Item& item = plan_[index];
    if (IsSpot(item.kind)) {
      if (const std::optional<Item> now = StandsOn(index, time_s)) {
        items.push_back(Place(*now, std::make_shared<const std::vector<Primitive>>(BuildItem(*now))));
      }
      continue;
    }
    auto& geometry = geometry_[index];
    if (!geometry) geometry = std::make_shared<const std::vector<Primitive>>(BuildItem(item));
    items.push_back(Place(item, geometry));
  }
  AppendTraffic(position_m, radius_m, time_s, items);
  return items;
}

void Town::AppendTraffic(const Eigen::Vector2d& position_m, double radius_m, double time_s,
                         std::vector<PlacedItem>& items) const {
  const auto place = [&](Item item, double path_m, double lateral_m, bool backwards) {
    const PathSample& sample = trajectory_.AtPath(path_m);
    const Eigen::Vector2d left(-std::sin(sample.yaw_rad), std::cos(sample.yaw_rad));
    item.footprint.centre_m = sample.position_m + lateral_m * left;
    item.footprint.yaw_rad = sample.yaw_rad + (backwards ? 3.14159265358979323846 : 0.0);
    if ((item.footprint.centre_m - position_m).norm() > radius_m) return;
    items.push_back(Place(item, std::make_shared<const std::vector<Primitive>>(BuildItem(item))));
  };
  const double end_m = trajectory_.samples().back().path_m;
  for (const Meeting& meeting : meetings_) {
    const double since = time_s - meeting.time_s;
    if (std::abs(since) > kMeetingSpan_s) continue;
    const double path_m = meeting.path_m - meeting.speed_m_s * since;
    if (path_m > 0 && path_m < end_m) place(meeting.vehicle, path_m, kOncomingLane_m, true);
  }
  for (const Walker& walker : walkers_) {
    // Up and down a stretch of a hundred metres.
    const double phase = std::remainder(walker.speed_m_s * time_s, 200.0);
    place(walker.person, walker.path_m + std::abs(phase), walker.lateral_m, phase * walker.speed_m_s < 0);
  }
}

}  // namespace incremental_segmatch::simulator
