#include "incremental_segmatch/ground_filter.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>
#include <string>
#include <utility>

namespace incremental_segmatch {
namespace {

constexpr float kNoHeight = std::numeric_limits<float>::infinity();
constexpr int kMaxHalfCells = 1000;

// Where ground was not seen for a while it may have risen by max_slope times that distance, but over longer ones a
// wall's upper part or a roof would pass for ground.
constexpr float kMaxClimbM = 7.f;

void Refuse(const char* name, double value, const char* remedy) {
  throw std::invalid_argument(std::string("ground.") + name + " is " + std::to_string(value) + "; it must be " +
                              remedy);
}

void RequirePositive(const char* name, double value) {
  if (!(value > 0.0) || !std::isfinite(value)) Refuse(name, value, "positive and finite");
}

bool IsFinite(const Eigen::Vector3f& p) {
  return (p.x() - p.x()) + (p.y() - p.y()) + (p.z() - p.z()) == 0.f;  // a single branch-free expression
}

}  // namespace

GroundFilter::GroundFilter(const GroundFilterParameters& parameters) : parameters_(parameters) {
  if (!std::isfinite(parameters.min_height_m)) Refuse("min_height_m", parameters.min_height_m, "finite");
  if (!(parameters.min_range_m >= 0.0)) Refuse("min_range_m", parameters.min_range_m, "zero or positive");
  if (!(parameters.max_range_m > parameters.min_range_m) || !std::isfinite(parameters.max_range_m))
    Refuse("max_range_m", parameters.max_range_m, "finite and larger than min_range_m");
  if (std::isnan(parameters.max_height_m)) Refuse("max_height_m", parameters.max_height_m, "a number");
  RequirePositive("sensor_height_m", parameters.sensor_height_m);
  RequirePositive("clearance_m", parameters.clearance_m);
  RequirePositive("cell_size_m", parameters.cell_size_m);
  RequirePositive("max_slope", parameters.max_slope);
  if (parameters.model == GroundModel::kElevation) PrepareElevation();
}

void GroundFilter::PrepareElevation() {
  const double rise = parameters_.max_slope * parameters_.cell_size_m;
  if (parameters_.clearance_m <= rise)
    Refuse("clearance_m", parameters_.clearance_m, "larger than max_slope * cell_size_m, or slopes pass for obstacles");
  const double half_cells = std::ceil(parameters_.max_range_m / parameters_.cell_size_m);
  if (half_cells > kMaxHalfCells)
    Refuse("cell_size_m", parameters_.cell_size_m, "at least a thousandth of max_range_m");
  half_cells_ = static_cast<int>(half_cells);

  const int side = 2 * half_cells_;
  const auto index = [&](int x, int y) {
    return static_cast<std::uint32_t>((y + half_cells_) * side + x + half_cells_);
  };
  const auto inwards = [](int i) { return i > 0 ? i - 1 : i < -1 ? i + 1 : i; };  // -1 and 0 touch the sensor
  const auto distance2 = [](int x, int y) { return (2 * x + 1) * (2 * x + 1) + (2 * y + 1) * (2 * y + 1); };
  std::vector<std::pair<int, Cell>> cells;
  cells.reserve(static_cast<std::size_t>(side) * side);
  for (int y = -half_cells_; y < half_cells_; ++y) {
    for (int x = -half_cells_; x < half_cells_; ++x) {
      cells.push_back({distance2(x, y),
                       {index(x, y), {index(inwards(x), inwards(y)), index(inwards(x), y), index(x, inwards(y))}}});
    }
  }
  std::stable_sort(cells.begin(), cells.end(), [](const auto& a, const auto& b) { return a.first < b.first; });
  for (const auto& cell : cells) outward_.push_back(cell.second);
  lowest_.resize(outward_.size());
  ground_.resize(outward_.size());
  unseen_.resize(outward_.size());
}

GroundFilterResult GroundFilter::Filter(const Points& points_sensor, const Pose& T_gravity_sensor) {
  if (parameters_.model != GroundModel::kElevation) return FilterByHeight(points_sensor);
  if (!T_gravity_sensor.linear().allFinite()) {
    throw std::invalid_argument("ground filter: the rotation of the sensor's pose is not finite");
  }
  return FilterByElevation(points_sensor, T_gravity_sensor.linear().cast<float>());
}

GroundFilterResult GroundFilter::FilterByHeight(const Points& points_sensor) const {
  const float min_range2 = static_cast<float>(parameters_.min_range_m * parameters_.min_range_m);
  const float max_range2 = static_cast<float>(parameters_.max_range_m * parameters_.max_range_m);
  const float max_height = static_cast<float>(parameters_.max_height_m);
  const float min_height = parameters_.model == GroundModel::kHeightThreshold
                               ? static_cast<float>(parameters_.min_height_m)
                               : -std::numeric_limits<float>::infinity();
  GroundFilterResult result;
  result.obstacles_sensor.resize(points_sensor.size());
  Eigen::Vector3f* end = result.obstacles_sensor.data();
  std::size_t finite_points = 0, in_range = 0;
  // Every point is written, but the end moves only behind those that stay: no branch depends on the data.
  for (const Eigen::Vector3f& p : points_sensor) {
    const float range2 = p.x() * p.x() + p.y() * p.y();
    const bool finite = IsFinite(p);
    const bool near = finite & (range2 >= min_range2) & (range2 <= max_range2) & (p.z() <= max_height);
    *end = p;
    end += near & (p.z() >= min_height);
    finite_points += finite;
    in_range += near;
  }
  result.obstacles_sensor.resize(static_cast<std::size_t>(end - result.obstacles_sensor.data()));
  result.dropped_nonfinite = points_sensor.size() - finite_points;
  result.dropped_range = finite_points - in_range;
  result.dropped_ground = in_range - result.obstacles_sensor.size();
  return result;
}

GroundFilterResult GroundFilter::FilterByElevation(const Points& points_sensor,
                                                   const Eigen::Matrix3f& R_gravity_sensor) {
  const float min_range2 = static_cast<float>(parameters_.min_range_m * parameters_.min_range_m);
  const float max_range2 = static_cast<float>(parameters_.max_range_m * parameters_.max_range_m);
  const float max_height = static_cast<float>(parameters_.max_height_m);
  const float cells_per_metre = static_cast<float>(1.0 / parameters_.cell_size_m);
  const auto cell_of = [&](float coordinate) {
    const float from_rim =
        coordinate * cells_per_metre + static_cast<float>(half_cells_);  // never negative but by rounding
    return std::clamp(static_cast<int>(from_rim), 0, 2 * half_cells_ - 1);
  };
  GroundFilterResult result;
  std::fill(lowest_.begin(), lowest_.end(), kNoHeight);
  heights_.resize(points_sensor.size());
  cells_.resize(points_sensor.size());
  for (std::size_t i = 0; i < points_sensor.size(); ++i) {
    cells_[i] = -1;
    if (!IsFinite(points_sensor[i])) {
      ++result.dropped_nonfinite;
      continue;
    }
    const Eigen::Vector3f p = R_gravity_sensor * points_sensor[i];
    const float range2 = p.x() * p.x() + p.y() * p.y();
    if (!(range2 >= min_range2 && range2 <= max_range2 && p.z() <= max_height)) {
      ++result.dropped_range;
      continue;
    }
    const int cell = cell_of(p.y()) * 2 * half_cells_ + cell_of(p.x());
    cells_[i] = cell;
    heights_[i] = p.z();
    lowest_[cell] = std::min(lowest_[cell], p.z());
  }

  EstimateGround();

  const float clearance = static_cast<float>(parameters_.clearance_m);
  result.obstacles_sensor.reserve(points_sensor.size());
  for (std::size_t i = 0; i < points_sensor.size(); ++i) {
    if (cells_[i] < 0) continue;
    if (heights_[i] < ground_[cells_[i]] + clearance) {
      ++result.dropped_ground;
    } else {
      result.obstacles_sensor.push_back(points_sensor[i]);
    }
  }
  return result;
}

void GroundFilter::EstimateGround() {
  const float start = static_cast<float>(-parameters_.sensor_height_m);
  const float slope = static_cast<float>(parameters_.max_slope);
  const float cell_size = static_cast<float>(parameters_.cell_size_m);
  std::fill(unseen_.begin(), unseen_.end(), kNoHeight);
  const std::array<float, 3> steps{cell_size * std::sqrt(2.f), cell_size, cell_size};
  for (const Cell& cell : outward_) {
    float expected = start;
    float unseen = cell.inner[0] == cell.index ? cell_size : kNoHeight;  // the innermost cells follow the start
    for (std::size_t i = 0; i < steps.size(); ++i) {
      const float height = ground_[cell.inner[i]];
      const float distance = unseen_[cell.inner[i]] + steps[i];
      // Where ground was seen most recently it is known best; of equals the lower.
      if (distance > unseen || (distance == unseen && height >= expected)) continue;
      expected = height;
      unseen = distance;
    }
    const float highest = expected + slope * std::min(unseen, std::max(steps[0], kMaxClimbM));
    const float deepest = expected - slope * unseen;
    const float lowest = lowest_[cell.index];
    const bool is_ground = lowest >= deepest && lowest <= highest;
    ground_[cell.index] = is_ground ? lowest : expected;
    unseen_[cell.index] = is_ground ? 0.f : unseen;
  }
}

}  // namespace incremental_segmatch
