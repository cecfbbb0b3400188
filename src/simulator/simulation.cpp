#include "simulator/simulation.hpp"

#include <algorithm>
#include <cmath>
#include <stdexcept>

#include "simulator/caster.hpp"
#include "simulator/random.hpp"

namespace incremental_segmatch::simulator {
namespace {

constexpr double kTwoPi = 6.283185307179586;

void Check(bool condition, const char* message) {
  if (!condition) throw std::invalid_argument(message);
}

void Check(const SimulationOptions& options) {
  Check(options.stride >= 1, "stride must be at least 1");
  Check(options.frame_rate_hz > 0, "scan rate must be positive");
  Check(options.sensor_height_m > 0, "sensor height must be positive");
  Check(options.drift.translation_percent >= 0 && options.drift.rotation_deg_per_100m >= 0,
        "drift must not be negative");
  Check(options.range_noise_m >= 0, "range noise must not be negative");
  Check(options.dropout >= 0 && options.dropout < 1, "drop-out must be in [0, 1)");
  Check(options.town.grade >= 0 && options.town.grade <= 0.2, "grade must be in [0, 0.2]");
}

Route RouteOf(const SimulationOptions& options) {
  if (!options.poses_file.empty()) return RouteFromKittiPoses(options.poses_file, options.frame_rate_hz);
  return MakePresetRoute(options.route, {options.frame_rate_hz, options.speed_m_s, options.laps});
}

TownParameters TownOf(const SimulationOptions& options) {
  TownParameters town = options.town;
  town.seed = options.seed;
  town.day = options.day;
  if (!options.poses_file.empty()) return town;
  if (options.route == "deceptive") town.world = World::kLookAlike;
  if (options.route != "office") return town;
  town.world = World::kOffice;
  town.grade = town.meetings_per_minute = town.pedestrians_per_100m = 0.0;
  return town;
}

// The sensor upright on the ground.
Pose UprightPose(const RouteFrame& frame, const Terrain& terrain, double height_m) {
  const Eigen::Vector3d up = terrain.Normal(frame.position_m);
  const Eigen::Vector3d heading(std::cos(frame.yaw_rad), std::sin(frame.yaw_rad), 0.0);
  const Eigen::Vector3d x = (heading - up * up.dot(heading)).normalized();
  Pose pose = Pose::Identity();
  pose.linear() << x, up.cross(x), up;
  pose.translation() << frame.position_m, terrain.Height(frame.position_m.x(), frame.position_m.y()) + height_m;
  return pose;
}

// The same with what the vehicle's suspension adds: small slow errors.
Pose SensorPose(const RouteFrame& frame, const Terrain& terrain, double height_m, std::uint64_t seed) {
  const double time_s = 1e-9 * static_cast<double>(frame.stamp_ns);
  const auto sway = [&](std::uint64_t which, double hertz) {
    return std::sin(kTwoPi * (hertz * time_s + ToUnit(HashOf(seed, which)))) +
           0.6 * std::sin(kTwoPi * (1.618 * hertz * time_s + ToUnit(HashOf(seed, which + 100))));
  };
  Pose pose = UprightPose(frame, terrain, height_m);
  pose.linear() = pose.linear() * Eigen::AngleAxisd(0.002 * sway(1, 0.9), Eigen::Vector3d::UnitY()).toRotationMatrix() *
                  Eigen::AngleAxisd(0.002 * sway(2, 0.7), Eigen::Vector3d::UnitX()).toRotationMatrix();
  pose.translation().z() += 0.008 * sway(3, 1.3);
  return pose;
}

float Reflectivity(Material material) {
  switch (material) {
    case Material::kRoad:
      return 0.22f;
    case Material::kPlaster:
      return 0.5f;
    case Material::kBrick:
      return 0.35f;
    case Material::kWood:
      return 0.4f;
    case Material::kBark:
      return 0.3f;
    case Material::kLeaf:
      return 0.35f;
    case Material::kMetal:
      return 0.25f;
    case Material::kCarGlass:
      return 0.1f;
    case Material::kWindow:
      return 0.1f;
    case Material::kRetro:
      return 0.98f;
    case Material::kCloth:
      return 0.3f;
  }
  return 0.f;
}

// The chance that a beam returns nothing: glass, grazing incidence and long ranges lose more.
float LossOf(Material material, float cos_incidence, float range_share, float dropout) {
  float loss = dropout + 0.25f * range_share * range_share;
  if (cos_incidence < 0.12f) loss += 0.7f * (1.f - cos_incidence / 0.12f);
  if (material == Material::kWindow) loss += 0.7f;
  if (material == Material::kCarGlass) loss += 0.45f;
  return loss;
}

// A rounded normal from one hash: the sum of four uniform numbers, scaled to unit variance.
float NormalFrom(std::uint64_t hash) {
  const auto part = [&](int shift) { return static_cast<float>((hash >> shift) & 0xffff); };
  return ((part(0) + part(16) + part(32) + part(48)) / 65535.f - 2.f) * 1.7320508f;
}

}  // namespace

class Simulation::Impl {
 public:
  explicit Impl(const SimulationOptions& options)
      : options_((Check(options), options)),
        sensor_(SensorByName(options.sensor)),
        route_(RouteOf(options)),
        town_(route_, TownOf(options)),
        caster_(sensor_) {
    sensor_.range_noise_m = options.range_noise_m;
    sensor_.dropout = options.dropout;
    const std::uint64_t own_seed = HashOf(options.seed, 5005, options.day);
    start_ = UprightPose(route_.front(), town_.terrain(), options.sensor_height_m);
    std::vector<Pose> truth;
    for (const RouteFrame& frame : route_)
      truth.push_back(SensorPose(frame, town_.terrain(), options.sensor_height_m, own_seed));
    // Drift is drawn over all frames of the route, so that it does not depend on which of them are kept.
    const std::vector<Pose> odometry = MakeDriftingOdometry(truth, own_seed, options.drift);
    for (std::size_t i = options.first_frame; i < route_.size(); i += options.stride) {
      if (options.max_scans > 0 && truth_.size() == options.max_scans) break;
      stamps_.push_back(route_[i].stamp_ns - route_[options.first_frame].stamp_ns);
      town_times_s_.push_back(1e-9 * static_cast<double>(route_[i].stamp_ns));
      truth_.push_back(truth[i]);
      odometry_.push_back(odometry[i]);
    }
    if (truth_.empty())
      throw std::invalid_argument("the route has no frame after the first " + std::to_string(options.first_frame));
  }

  SimulatedScan Scan(std::size_t i, bool with_intensities) {
    const Pose& pose = truth_.at(i);
    const auto items = town_.ItemsNear(pose.translation().head<2>(), sensor_.max_range_m, town_times_s_[i]);
    const Sweep& sweep = caster_.Cast(pose, items, town_.terrain());
    const std::uint64_t seed = HashOf(options_.seed, 6006 + options_.day, static_cast<std::uint64_t>(stamps_[i]));
    const float noise = static_cast<float>(sensor_.range_noise_m), dropout = static_cast<float>(sensor_.dropout);
    const float max_range = static_cast<float>(sensor_.max_range_m),
                min_range = static_cast<float>(sensor_.min_range_m);
    SimulatedScan scan;
    scan.points_sensor.reserve(sweep.range_m.size());
    if (with_intensities) scan.intensities.reserve(sweep.range_m.size());
    const std::size_t columns = static_cast<std::size_t>(sensor_.columns);
    for (std::size_t ring = 0, k = 0; ring < sensor_.elevations_rad.size(); ++ring) {
      for (std::size_t column = 0; column < columns; ++column, ++k) {
        if (!(sweep.range_m[k] < max_range)) continue;
        const std::uint64_t hash = Mix(seed + k);
        if (sensor_.share < 1.0 && ToUnit(Mix(hash + 2)) >= sensor_.share) continue;
        const float cosine = sweep.cos_incidence[k];
        const float share = sweep.range_m[k] / max_range;
        if (static_cast<float>(ToUnit(Mix(hash))) < LossOf(sweep.material[k], cosine, share, dropout)) continue;
        const float range = sweep.range_m[k] + noise * NormalFrom(hash);
        if (range < min_range) continue;
        scan.points_sensor.push_back(range * caster_.Direction(ring, column));
        if (!with_intensities) continue;
        const float shade = Reflectivity(sweep.material[k]) * (0.4f + 0.6f * cosine) * (1.f - 0.3f * share);
        scan.intensities.push_back(std::clamp(shade + 0.02f * NormalFrom(Mix(hash + 1)), 0.f, 1.f));
      }
    }
    return scan;
  }

  SimulationOptions options_;
  SensorModel sensor_;
  Route route_;
  Town town_;
  Caster caster_;
  std::vector<StampNs> stamps_;
  std::vector<double> town_times_s_;
  Pose start_ = Pose::Identity();
  std::vector<Pose> truth_;
  std::vector<Pose> odometry_;
};

Simulation::Simulation(const SimulationOptions& options) : impl_(std::make_unique<Impl>(options)) {}
Simulation::~Simulation() = default;
Simulation::Simulation(Simulation&&) noexcept = default;
Simulation& Simulation::operator=(Simulation&&) noexcept = default;

std::size_t Simulation::size() const {
  return impl_->truth_.size();
}
StampNs Simulation::stamp_ns(std::size_t i) const {
  return impl_->stamps_.at(i);
}
const Pose& Simulation::T_world_sensor(std::size_t i) const {
  return impl_->truth_.at(i);
}
const Pose& Simulation::T_world_start() const {
  return impl_->start_;
}
const Pose& Simulation::T_odom_sensor(std::size_t i) const {
  return impl_->odometry_.at(i);
}
Points Simulation::Scan(std::size_t i) {
  return impl_->Scan(i, false).points_sensor;
}
SimulatedScan Simulation::ScanWithIntensities(std::size_t i) {
  return impl_->Scan(i, true);
}
const Town& Simulation::town() const {
  return impl_->town_;
}

}  // namespace incremental_segmatch::simulator
