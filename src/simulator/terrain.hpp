/// \file
/// The town's ground: a smooth height field with grades of a few per cent.
#pragma once

#include <Eigen/Core>
#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <vector>

namespace incremental_segmatch::simulator {

/// Height over a rectangle, tabulated every few metres and interpolated bilinearly; outside it continues flat.
class Terrain {
 public:
  /// \param low_m, high_m corners of the rectangle \param grade steepest slope (0.05 is five per cent)
  Terrain(std::uint64_t seed, const Eigen::Vector2d& low_m, const Eigen::Vector2d& high_m, double grade);

  /// Height at a place, metres. Inline: casting a sweep asks a million times.
  double Height(double x_m, double y_m) const {
    const double u = std::clamp((x_m - low_m_.x()) * per_spacing_, 0.0, columns_ - 1.0);
    const double v = std::clamp((y_m - low_m_.y()) * per_spacing_, 0.0, rows_ - 1.0);
    const int column = std::min(static_cast<int>(u), columns_ - 2);
    const int row = std::min(static_cast<int>(v), rows_ - 2);
    const double a = u - column;
    const double b = v - row;
    const float* h = &heights_m_[static_cast<std::size_t>(row) * static_cast<std::size_t>(columns_) +
                                 static_cast<std::size_t>(column)];
    return (1 - b) * ((1 - a) * h[0] + a * h[1]) + b * ((1 - a) * h[columns_] + a * h[columns_ + 1]);
  }

  /// Upper bound of the slope between any two points.
  double steepest() const { return steepest_; }

  /// Unit normal of the ground under a vehicle.
  Eigen::Vector3d Normal(const Eigen::Vector2d& position_m) const;

 private:
  Eigen::Vector2d low_m_;
  double spacing_m_;
  double per_spacing_;
  int columns_;
  int rows_;
  double steepest_;
  std::vector<float> heights_m_;
};

}  // namespace incremental_segmatch::simulator
