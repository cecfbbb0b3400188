/// \file
/// Answers, for any place, how near the vehicle ever comes and when.
#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <unordered_map>
#include <vector>

#include "simulator/route.hpp"

namespace incremental_segmatch::simulator {

/// A rectangle on the ground: centre, direction of its x axis, half sizes.
struct Footprint {
  Eigen::Vector2d centre_m = Eigen::Vector2d::Zero();
  double yaw_rad = 0.0;
  Eigen::Vector2d half_m = Eigen::Vector2d::Zero();
};

/// True if the two rectangles come nearer than margin_m (separating axes; exact for margin 0, else slightly generous).
bool Overlap(const Footprint& a, const Footprint& b, double margin_m);

/// A point of the driven path.
struct PathSample {
  Eigen::Vector2d position_m;
  double yaw_rad;
  double path_m;  ///< driven length up to here
  double time_s;
};

/// A span of time during which the vehicle was near a place.
struct Visit {
  double begin_s;
  double end_s;
};

/// The driven path, sampled every half metre and hashed.
class TrajectoryIndex {
 public:
  explicit TrajectoryIndex(const Route& route);

  const std::vector<PathSample>& samples() const { return samples_; }

  /// Distance from the path to a rectangle, at most limit_m.
  double Distance(const Footprint& footprint, double limit_m) const;

  /// True if an earlier sample, by more than min_path_m of driving, lies within radius_m.
  bool WasHereBefore(const PathSample& sample, double radius_m, double min_path_m) const;

  /// The visits to a place, in time order; two passes less than min_gap_s apart are one visit.
  std::vector<Visit> Visits(const Eigen::Vector2d& position_m, double radius_m, double min_gap_s) const;

  /// The sample at a driven length, clamped to the path.
  const PathSample& AtPath(double path_m) const;

 private:
  template <typename Function>
  void ForEachNear(const Eigen::Vector2d& centre_m, double radius_m, Function function) const;

  std::vector<PathSample> samples_;
  std::unordered_map<std::uint64_t, std::vector<std::uint32_t>> cells_;
};

}  // namespace incremental_segmatch::simulator
