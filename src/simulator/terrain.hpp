/// \file
/// The town's ground: a smooth height field with grades of a few per cent.
#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <vector>

namespace incremental_segmatch::simulator {

/// Height over a rectangle, tabulated every few metres and interpolated bilinearly; outside it continues flat.
class Terrain {
 public:
  /// \param low_m, high_m corners of the rectangle \param grade steepest slope (0.05 is five per cent)
  Terrain(std::uint64_t seed, const Eigen::Vector2d& low_m, const Eigen::Vector2d& high_m, double grade);

  /// Height at a place, metres.
  double Height(double x_m, double y_m) const;

  /// Upper bound of the slope between any two points.
  double steepest() const { return steepest_; }

  /// Unit normal of the ground under a vehicle.
  Eigen::Vector3d Normal(const Eigen::Vector2d& position_m) const;

 private:
  Eigen::Vector2d low_m_;
  double spacing_m_;
  int columns_;
  int rows_;
  double steepest_;
  std::vector<float> heights_m_;
};

}  // namespace incremental_segmatch::simulator
