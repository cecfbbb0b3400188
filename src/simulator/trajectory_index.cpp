#include "simulator/trajectory_index.hpp"

#include <algorithm>
#include <cmath>

namespace incremental_segmatch::simulator {
namespace {

constexpr double kCell_m = 8.0;
constexpr double kSpacing_m = 0.5;

std::uint64_t Key(std::int64_t x, std::int64_t y) {
  return (static_cast<std::uint64_t>(x) << 32) ^ (static_cast<std::uint64_t>(y) & 0xffffffffULL);
}

std::int64_t CellOf(double v) {
  return static_cast<std::int64_t>(std::floor(v / kCell_m));
}

Eigen::Vector2d Axis(double yaw) {
  return {std::cos(yaw), std::sin(yaw)};
}

double DistanceToPoint(const Footprint& footprint, const Eigen::Vector2d& point) {
  const Eigen::Vector2d x = Axis(footprint.yaw_rad);
  const Eigen::Vector2d d = point - footprint.centre_m;
  const double outside_x = std::max(0.0, std::abs(d.dot(x)) - footprint.half_m.x());
  const double outside_y = std::max(0.0, std::abs(x.x() * d.y() - x.y() * d.x()) - footprint.half_m.y());
  return std::hypot(outside_x, outside_y);
}

}  // namespace

bool Overlap(const Footprint& a, const Footprint& b, double margin_m) {
  const Eigen::Vector2d d = b.centre_m - a.centre_m;
  const Eigen::Vector2d ax = Axis(a.yaw_rad), bx = Axis(b.yaw_rad);
  const Eigen::Vector2d ay(-ax.y(), ax.x()), by(-bx.y(), bx.x());
  for (const Eigen::Vector2d& axis : {ax, ay, bx, by}) {
    const double reach = a.half_m.x() * std::abs(axis.dot(ax)) + a.half_m.y() * std::abs(axis.dot(ay)) +
                         b.half_m.x() * std::abs(axis.dot(bx)) + b.half_m.y() * std::abs(axis.dot(by));
    if (std::abs(d.dot(axis)) > reach + margin_m) return false;
  }
  return true;
}

TrajectoryIndex::TrajectoryIndex(const Route& route) {
  double path_m = 0.0;
  double due_m = 0.0;
  for (std::size_t i = 0; i + 1 < route.size(); ++i) {
    const Eigen::Vector2d step = route[i + 1].position_m - route[i].position_m;
    const double length = step.norm();
    const double begin_s = 1e-9 * static_cast<double>(route[i].stamp_ns);
    const double duration_s = 1e-9 * static_cast<double>(route[i + 1].stamp_ns - route[i].stamp_ns);
    const double turn = std::remainder(route[i + 1].yaw_rad - route[i].yaw_rad, 6.283185307179586);
    for (; due_m < path_m + length; due_m += kSpacing_m) {
      const double share = (due_m - path_m) / length;
      samples_.push_back(
          {route[i].position_m + share * step, route[i].yaw_rad + share * turn, due_m, begin_s + share * duration_s});
    }
    path_m += length;
  }
  const RouteFrame& last = route.back();
  samples_.push_back({last.position_m, last.yaw_rad, path_m, 1e-9 * static_cast<double>(last.stamp_ns)});
  for (std::uint32_t i = 0; i < samples_.size(); ++i) {
    cells_[Key(CellOf(samples_[i].position_m.x()), CellOf(samples_[i].position_m.y()))].push_back(i);
  }
}

template <typename Function>
void TrajectoryIndex::ForEachNear(const Eigen::Vector2d& centre_m, double radius_m, Function function) const {
  for (std::int64_t x = CellOf(centre_m.x() - radius_m); x <= CellOf(centre_m.x() + radius_m); ++x) {
    for (std::int64_t y = CellOf(centre_m.y() - radius_m); y <= CellOf(centre_m.y() + radius_m); ++y) {
      const auto cell = cells_.find(Key(x, y));
      if (cell == cells_.end()) continue;
      for (const std::uint32_t index : cell->second) function(samples_[index]);
    }
  }
}

double TrajectoryIndex::Distance(const Footprint& footprint, double limit_m) const {
  double nearest = limit_m;
  ForEachNear(footprint.centre_m, footprint.half_m.norm() + limit_m, [&](const PathSample& sample) {
    nearest = std::min(nearest, DistanceToPoint(footprint, sample.position_m));
  });
  return nearest;
}

bool TrajectoryIndex::WasHereBefore(const PathSample& sample, double radius_m, double min_path_m) const {
  bool found = false;
  ForEachNear(sample.position_m, radius_m, [&](const PathSample& other) {
    found = found ||
            (other.path_m < sample.path_m - min_path_m && (other.position_m - sample.position_m).norm() < radius_m);
  });
  return found;
}

std::vector<Visit> TrajectoryIndex::Visits(const Eigen::Vector2d& position_m, double radius_m, double min_gap_s) const {
  std::vector<double> times;
  ForEachNear(position_m, radius_m, [&](const PathSample& sample) {
    if ((sample.position_m - position_m).norm() < radius_m) times.push_back(sample.time_s);
  });
  std::sort(times.begin(), times.end());
  std::vector<Visit> visits;
  for (const double time : times) {
    if (visits.empty() || time - visits.back().end_s > min_gap_s) visits.push_back({time, time});
    visits.back().end_s = time;
  }
  return visits;
}

const PathSample& TrajectoryIndex::AtPath(double path_m) const {
  const double index = std::clamp(path_m / kSpacing_m, 0.0, static_cast<double>(samples_.size() - 1));
  return samples_[static_cast<std::size_t>(index)];
}

}  // namespace incremental_segmatch::simulator
