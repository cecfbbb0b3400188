#include "simulator/caster.hpp"

#include <algorithm>
#include <cmath>
#include <functional>
#include <limits>

namespace incremental_segmatch::simulator {
namespace {

using Eigen::Matrix3f;
using Eigen::Vector2f;
using Eigen::Vector3f;

constexpr float kInfinity = std::numeric_limits<float>::infinity();
constexpr double kTwoPi = 6.283185307179586;
constexpr float kSlack = 1e-3f;  // rad, on every side of a window

}  // namespace

Caster::Caster(const SensorModel& sensor) : sensor_(sensor) {
  for (const double elevation : sensor.elevations_rad) {
    cos_elevation_.push_back(static_cast<float>(std::cos(elevation)));
    sin_elevation_.push_back(static_cast<float>(std::sin(elevation)));
    tan_elevation_.push_back(static_cast<float>(std::tan(elevation)));
  }
  for (int i = 0; i < sensor.columns; ++i) {
    cos_azimuth_.push_back(static_cast<float>(std::cos(kTwoPi * i / sensor.columns)));
    sin_azimuth_.push_back(static_cast<float>(std::sin(kTwoPi * i / sensor.columns)));
    in_view_.push_back(std::abs(std::remainder(kTwoPi * i / sensor.columns, kTwoPi)) <= sensor.half_view_rad);
  }
}

Vector3f Caster::Direction(std::size_t ring, std::size_t column) const {
  return {cos_elevation_[ring] * cos_azimuth_[column], cos_elevation_[ring] * sin_azimuth_[column],
          sin_elevation_[ring]};
}

Caster::Window Caster::WindowOf(const Vector3f& centre, const Matrix3f& R_sensor_prim, const Vector3f& half) const {
  // Bounds of the box over its corners; the distance of its shadow from the vertical axis is bounded from below by the
  // best of a few separating directions.
  Vector3f corners[8];
  for (int i = 0; i < 8; ++i) {
    corners[i] = centre + R_sensor_prim * Vector3f(i & 1 ? half.x() : -half.x(), i & 2 ? half.y() : -half.y(),
                                                   i & 4 ? half.z() : -half.z());
  }
  float low = corners[0].z(), high = low, rho_max = 0.f;
  for (const Vector3f& corner : corners) {
    low = std::min(low, corner.z());
    high = std::max(high, corner.z());
    rho_max = std::max(rho_max, corner.head<2>().norm());
  }
  float rho_min = 0.f;
  const Vector2f directions[] = {centre.head<2>(), R_sensor_prim.col(0).head<2>(), R_sensor_prim.col(1).head<2>(),
                                 R_sensor_prim.col(2).head<2>()};
  for (const Vector2f& direction : directions) {
    const float length = direction.norm();
    if (length < 1e-3f) continue;
    Vector2f unit = direction / length;
    if (unit.dot(centre.head<2>()) < 0) unit = -unit;
    float least = kInfinity;
    for (const Vector3f& corner : corners) least = std::min(least, unit.dot(corner.head<2>()));
    rho_min = std::max(rho_min, least);
  }
  Window window;
  window.near_m = rho_min;
  window.ring_end = static_cast<int>(tan_elevation_.size());
  window.columns = sensor_.columns;
  if (rho_min < 1e-2f) return window;
  const float tan_high = (high > 0 ? high / rho_min : high / rho_max) + kSlack;
  const float tan_low = (low < 0 ? low / rho_min : low / rho_max) - kSlack;
  const auto first = std::lower_bound(tan_elevation_.begin(), tan_elevation_.end(), tan_high, std::greater<float>());
  const auto last = std::upper_bound(tan_elevation_.begin(), tan_elevation_.end(), tan_low, std::greater<float>());
  window.ring_begin = static_cast<int>(first - tan_elevation_.begin());
  window.ring_end = static_cast<int>(last - tan_elevation_.begin());
  const Vector2f ahead = centre.head<2>();
  float left = 0.f, right = 0.f;
  for (const Vector3f& corner : corners) {
    const float angle =
        std::atan2(ahead.x() * corner.y() - ahead.y() * corner.x(), ahead.x() * corner.x() + ahead.y() * corner.y());
    left = std::max(left, angle);
    right = std::min(right, angle);
  }
  const float per_column = static_cast<float>(kTwoPi / sensor_.columns);
  const float middle = std::atan2(ahead.y(), ahead.x());
  const int begin = static_cast<int>(std::ceil((middle + right - kSlack) / per_column));
  const int end = static_cast<int>(std::floor((middle + left + kSlack) / per_column)) + 1;
  window.columns = std::clamp(end - begin, 0, sensor_.columns);
  window.column_begin = ((begin % sensor_.columns) + sensor_.columns) % sensor_.columns;
  return window;
}

void Caster::Collect(const Eigen::Isometry3d& T_world_sensor, const std::vector<PlacedItem>& items) {
  candidates_.clear();
  const float range = static_cast<float>(sensor_.max_range_m);
  for (const PlacedItem& item : items) {
    const Eigen::Isometry3d T_sensor_item = T_world_sensor.inverse(Eigen::Isometry) * item.T_world_item;
    const Matrix3f R_sensor_item = T_sensor_item.linear().cast<float>();
    const Vector3f t_sensor_item = T_sensor_item.translation().cast<float>();
    for (const Primitive& primitive : *item.primitives) {
      const Vector3f centre = R_sensor_item * primitive.centre_m + t_sensor_item;
      if (centre.norm() - primitive.half_m.norm() > range) continue;
      const Matrix3f R_sensor_prim = R_sensor_item * primitive.R_item_prim;
      const Window window = WindowOf(centre, R_sensor_prim, primitive.half_m);
      if (window.ring_begin >= window.ring_end || window.columns == 0) continue;
      const Matrix3f R_prim_sensor = R_sensor_prim.transpose();
      candidates_.push_back({window, &primitive, R_prim_sensor, -(R_prim_sensor * centre)});
    }
  }
  std::stable_sort(candidates_.begin(), candidates_.end(),
                   [](const Candidate& a, const Candidate& b) { return a.window.near_m < b.window.near_m; });
}

void Caster::Draw(const Candidate& candidate) {
  const Matrix3f& R = candidate.R_prim_sensor;
  const Window& window = candidate.window;
  for (int i = 0, column = window.column_begin; i < window.columns;
       ++i, column = column + 1 == sensor_.columns ? 0 : column + 1) {
    const Vector3f level = cos_azimuth_[static_cast<std::size_t>(column)] * R.col(0) +
                           sin_azimuth_[static_cast<std::size_t>(column)] * R.col(1);
    for (int ring = window.ring_begin; ring < window.ring_end; ++ring) {
      const std::size_t index =
          static_cast<std::size_t>(ring) * static_cast<std::size_t>(sensor_.columns) + static_cast<std::size_t>(column);
      const float limit = sweep_.range_m[index];
      if (limit <= window.near_m) continue;
      const Vector3f direction = cos_elevation_[static_cast<std::size_t>(ring)] * level +
                                 sin_elevation_[static_cast<std::size_t>(ring)] * R.col(2);
      const RayHit hit = Intersect(*candidate.primitive, candidate.origin_prim_m, direction, limit);
      if (!(hit.range_m < limit)) continue;
      sweep_.range_m[index] = hit.range_m;
      sweep_.cos_incidence[index] = hit.cos_incidence;
      sweep_.material[index] = hit.material;
    }
  }
}

float GroundRange(const Terrain& terrain, const Eigen::Vector3d& o, const Eigen::Vector3d& d, float limit_m) {
  // Steps that the steepest slope allows; over the shortest step the ground is straight, so the crossing is
  // interpolated.
  constexpr double kShortestStep_m = 0.4;
  const double closing = terrain.steepest() * d.head<2>().norm() - d.z();
  if (closing <= 0) return kInfinity;
  double above = o.z() - terrain.Height(o.x(), o.y());
  double t = 0.0;
  while (above > 0 && t < limit_m) {
    const double step = std::max(kShortestStep_m, above / closing);
    const double next = t + step;
    const double there = o.z() + next * d.z() - terrain.Height(o.x() + next * d.x(), o.y() + next * d.y());
    if (there <= 0) {
      const float range = static_cast<float>(t + step * above / (above - there));
      return range < limit_m ? range : kInfinity;
    }
    t = next;
    above = there;
  }
  return kInfinity;
}

void Caster::DrawGround(const Eigen::Isometry3d& T_world_sensor, const Terrain& terrain) {
  const Eigen::Matrix3d R = T_world_sensor.linear();
  const Eigen::Vector3d origin = T_world_sensor.translation();
  const Eigen::Vector3d normal = terrain.Normal(origin.head<2>());
  for (std::size_t ring = 0; ring < cos_elevation_.size(); ++ring) {
    for (std::size_t column = 0; column < cos_azimuth_.size(); ++column) {
      const std::size_t index = ring * cos_azimuth_.size() + column;
      const float limit = std::min(sweep_.range_m[index], static_cast<float>(sensor_.max_range_m));
      const Eigen::Vector3d direction = R * Direction(ring, column).cast<double>();
      const float range = GroundRange(terrain, origin, direction, limit);
      if (!(range < limit)) continue;
      sweep_.range_m[index] = range;
      sweep_.cos_incidence[index] = std::abs(static_cast<float>(normal.dot(direction)));
      sweep_.material[index] = Material::kRoad;
    }
  }
}

const Sweep& Caster::Cast(const Eigen::Isometry3d& T_world_sensor, const std::vector<PlacedItem>& items,
                          const Terrain& terrain) {
  const std::size_t beams = cos_elevation_.size() * cos_azimuth_.size();
  sweep_.range_m.assign(beams, static_cast<float>(sensor_.max_range_m));
  sweep_.cos_incidence.assign(beams, 1.f);
  sweep_.material.assign(beams, Material::kRoad);
  // A beam of range 0 is hit by nothing.
  for (std::size_t beam = 0; beam < beams; ++beam) {
    if (!in_view_[beam % in_view_.size()]) sweep_.range_m[beam] = 0.f;
  }
  Collect(T_world_sensor, items);
  for (const Candidate& candidate : candidates_) Draw(candidate);
  DrawGround(T_world_sensor, terrain);
  for (std::size_t beam = 0; beam < beams; ++beam) {
    float& range = sweep_.range_m[beam];
    if (!(range < static_cast<float>(sensor_.max_range_m)) || !in_view_[beam % in_view_.size()]) range = kInfinity;
  }
  return sweep_;
}

}  // namespace incremental_segmatch::simulator
