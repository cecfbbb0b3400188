#include "incremental_segmatch/range_image.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <optional>
#include <stdexcept>
#include <string>
#include <utility>

namespace incremental_segmatch {
namespace {

constexpr int kColumns = 180;
constexpr int kRows = 60;
constexpr float kLowest = -0.7854f;  // elevation of the lowest row's lower edge: -45 to 45 degrees
constexpr float kPi = 3.14159265f;
constexpr int kMinReturns = 2;  // cells around a point that must have returns

struct Direction {
  int row;
  int column;
};

std::optional<Direction> DirectionOf(const Eigen::Vector3f& p) {
  const float elevation = std::atan2(p.z(), p.head<2>().norm());
  const int row = static_cast<int>(std::floor((elevation - kLowest) * (kRows / (-2.f * kLowest))));
  if (row < 0 || row >= kRows) return std::nullopt;
  const int column = static_cast<int>((std::atan2(p.y(), p.x()) + kPi) * (kColumns / (2.f * kPi)));
  return Direction{row, column % kColumns};
}

}  // namespace

RangeImage::RangeImage(const Points& scan_sensor) : cells_(kRows * kColumns) {
  for (const Eigen::Vector3f& p : scan_sensor) {
    const std::optional<Direction> direction = DirectionOf(p);
    if (!direction) continue;
    Cell& cell = cells_[static_cast<std::size_t>(direction->row * kColumns + direction->column)];
    const float range = p.norm();
    cell.nearest = cell.farthest == 0.f ? range : std::min(cell.nearest, range);
    cell.farthest = std::max(cell.farthest, range);
  }
}

Sight RangeImage::Look(const Eigen::Vector3f& point_sensor, float tolerance_m) const {
  const std::optional<Direction> direction = DirectionOf(point_sensor);
  if (!direction) return Sight::kUnknown;
  const float range = point_sensor.norm();
  int returns = 0;
  bool is_confirmed = false, is_behind_all = true;
  for (int row = std::max(0, direction->row - 1); row <= std::min(kRows - 1, direction->row + 1); ++row) {
    for (int step = kColumns - 1; step <= kColumns + 1; ++step) {
      const Cell& cell = cells_[static_cast<std::size_t>(row * kColumns + (direction->column + step) % kColumns)];
      if (cell.farthest == 0.f) continue;
      ++returns;
      is_confirmed = is_confirmed || (cell.nearest - tolerance_m <= range && range <= cell.farthest + tolerance_m);
      is_behind_all = is_behind_all && cell.nearest > range + 2.f * tolerance_m;
    }
  }
  if (returns < kMinReturns) return Sight::kUnknown;
  return is_confirmed ? Sight::kConfirmed : is_behind_all ? Sight::kSeenThrough : Sight::kUnknown;
}

FreeSpaceCounts RangeImage::Compare(const Points& points, const Pose& T_image_points, double slack_m,
                                    const FreeSpaceParameters& parameters) const {
  const Eigen::Matrix3f R = T_image_points.linear().cast<float>();
  const Eigen::Vector3f t = T_image_points.translation().cast<float>();
  const float tolerance = static_cast<float>(parameters.tolerance_m + slack_m);
  const float min_height = static_cast<float>(parameters.min_height_m);
  const float max_range = static_cast<float>(parameters.max_range_m);
  FreeSpaceCounts counts;
  for (const Eigen::Vector3f& point : points) {
    if (point.z() < min_height) continue;
    const Eigen::Vector3f p = R * point + t;
    if (p.norm() > max_range) continue;
    const Sight sight = Look(p, tolerance);
    counts.confirmed += sight == Sight::kConfirmed;
    counts.seen_through += sight == Sight::kSeenThrough;
  }
  return counts;
}

void Validate(const FreeSpaceParameters& parameters) {
  const auto require = [](bool holds, const char* what) {
    if (!holds) throw std::invalid_argument(std::string("back_end.free_space.") + what);
  };
  require(std::isfinite(parameters.min_height_m), "min_height_m: must be finite");
  require(parameters.max_range_m > 0.0, "max_range_m: must be positive");
  require(parameters.tolerance_m > 0.0, "tolerance_m: must be positive");
}

}  // namespace incremental_segmatch
