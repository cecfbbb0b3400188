#include "incremental_segmatch/range_image.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>
#include <string>

#include "several_targets.hpp"

namespace incremental_segmatch {
namespace {

constexpr int kColumns = 180;
constexpr int kRows = 60;  // from -45 to 45 degrees of elevation
/// From one row to the next: on either side is the column of the other side once more. Below and above is an empty row.
constexpr int kStride = kColumns + 2;
constexpr float kPi = 3.14159265f;
constexpr int kMinReturns = 2;  // cells around a point that must have returns

/// Arc tangent of a value between -1 and 1, to rounding: Abramowitz and Stegun, 4.4.49.
inline float Arctangent(float t) {
  constexpr float kCoefficients[] = {-0.0161657367f, 0.0429096138f,  -0.0752896400f, 0.1065626393f,
                                     -0.1420889944f, 0.1999355085f, -0.3333314528f, 1.f};
  const float t2 = t * t;
  float sum = 0.0028662257f;
  for (const float coefficient : kCoefficients) sum = sum * t2 + coefficient;
  return sum * t;
}

/// The ranges of points in the image's sensor frame (x, y, z each), and the cells that they lie in: 0, in the empty row below, for
/// those above or below all rows.
SEGMATCH_SEVERAL_TARGETS
void Locate(const float* points, std::size_t count, std::int32_t* cells, float* ranges) {
  constexpr float kLeast = std::numeric_limits<float>::min();
  for (std::size_t i = 0; i < count; ++i) {
    const float x = points[3 * i], y = points[3 * i + 1], z = points[3 * i + 2];
    const float horizontal2 = x * x + y * y;
    ranges[i] = std::sqrt(horizontal2 + z * z);

    const float slope = z / std::max(std::sqrt(horizontal2), kLeast);
    const float elevation = Arctangent(std::min(1.f, std::max(-1.f, slope)));
    const auto row = static_cast<std::int32_t>((elevation + 0.25f * kPi) * (kRows / (0.5f * kPi)));

    const float shorter = std::min(std::abs(x), std::abs(y)), longer = std::max(std::abs(x), std::abs(y));
    const float from_axis = Arctangent(shorter / std::max(longer, kLeast));
    const float from_x_axis = std::abs(y) > std::abs(x) ? 0.5f * kPi - from_axis : from_axis;
    const float azimuth = std::copysign(x < 0.f ? kPi - from_x_axis : from_x_axis, y);
    const auto column = static_cast<std::int32_t>((azimuth + kPi) * (kColumns / (2.f * kPi)));

    const std::int32_t cell = (1 + std::min(row, kRows - 1)) * kStride + 1 + (column < kColumns ? column : 0);
    cells[i] = std::abs(slope) < 1.f ? cell : 0;
  }
}

}  // namespace

RangeImage::RangeImage(const Points& scan_sensor) : cells_((kRows + 2) * kStride) {
  const Located located = LocateAll(scan_sensor);
  for (std::size_t i = 0; i < scan_sensor.size(); ++i) {
    if (located.cells[i] == 0) continue;
    const float range = located.ranges[i];
    Cell& cell = cells_[static_cast<std::size_t>(located.cells[i])];
    cell.nearest = cell.farthest == 0.f ? range : std::min(cell.nearest, range);
    cell.farthest = std::max(cell.farthest, range);
  }
  for (auto row = cells_.begin(); row != cells_.end(); row += kStride) {
    row[0] = row[kColumns];
    row[kColumns + 1] = row[1];
  }
}

RangeImage::Located RangeImage::LocateAll(const Points& points_sensor) {
  Located located{std::vector<std::int32_t>(points_sensor.size()), std::vector<float>(points_sensor.size())};
  if (!points_sensor.empty())
    Locate(points_sensor.front().data(), points_sensor.size(), located.cells.data(), located.ranges.data());
  return located;
}

Sight RangeImage::Look(const Eigen::Vector3f& point_sensor, float tolerance_m) const {
  std::int32_t cell;
  float range;
  Locate(point_sensor.data(), 1, &cell, &range);
  return LookAround(cell, range, tolerance_m);
}

/// What the cell and the eight around it say of something at a range.
Sight RangeImage::LookAround(std::int32_t center, float range, float tolerance_m) const {
  if (center == 0) return Sight::kUnknown;
  int returns = 0;
  bool is_confirmed = false, is_behind_all = true;
  for (const std::int32_t row : {center - kStride, center, center + kStride}) {
    for (std::int32_t i = row - 1; i <= row + 1; ++i) {
      const Cell& cell = cells_[static_cast<std::size_t>(i)];
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
  Points high_sensor;
  high_sensor.reserve(points.size());
  for (const Eigen::Vector3f& point : points)
    if (!(point.z() < min_height)) high_sensor.push_back(R * point + t);
  const Located located = LocateAll(high_sensor);
  FreeSpaceCounts counts;
  for (std::size_t i = 0; i < high_sensor.size(); ++i) {
    if (located.ranges[i] > max_range) continue;
    const Sight sight = LookAround(located.cells[i], located.ranges[i], tolerance);
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
