#include "incremental_segmatch/scan_thinning.hpp"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <stdexcept>
#include <string>
#include <vector>

namespace incremental_segmatch {
namespace {

/// A set of 64-bit keys in an open hash table of fixed size.
class KeySet {
 public:
  explicit KeySet(std::size_t most) {
    std::size_t slots = 16;
    while (slots < 2 * most) slots *= 2;
    slots_.assign(slots, kFree);
  }

  /// False if it was there already. No branch depends on that: nobody could predict it.
  bool Add(std::uint64_t key) {
    std::size_t slot = (key * 0x9e3779b97f4a7c15u) >> 40 & (slots_.size() - 1);
    while ((slots_[slot] != kFree) & (slots_[slot] != key)) slot = (slot + 1) & (slots_.size() - 1);
    const bool is_new = slots_[slot] != key;
    slots_[slot] = key;
    return is_new;
  }

 private:
  static constexpr std::uint64_t kFree = ~std::uint64_t{0};
  std::vector<std::uint64_t> slots_;
};

/// 21 bits an axis: 600 km at cells of 0.3 m.
std::uint64_t CellOf(const Eigen::Vector3f& p, float per_metre) {
  const auto index = [per_metre](float value) {
    const float cells = value * per_metre;
    const auto towards_zero = static_cast<std::int64_t>(cells);
    const std::int64_t floor = towards_zero - (cells < static_cast<float>(towards_zero) ? 1 : 0);
    return static_cast<std::uint64_t>(floor + (1 << 20)) & 0x1fffff;
  };
  return index(p.x()) << 42 | index(p.y()) << 21 | index(p.z());
}

}  // namespace

Points ThinScan(const Points& points_sensor, const ScanThinningParameters& parameters) {
  const std::size_t looked_at = std::min(points_sensor.size(), parameters.max_points);
  const float min2 = static_cast<float>(parameters.min_range_m * parameters.min_range_m);
  const float max2 = static_cast<float>(parameters.max_range_m * parameters.max_range_m);
  const float per_metre = static_cast<float>(1.0 / parameters.cell_size_m);
  KeySet cells(looked_at);
  Points thinned(looked_at);
  Eigen::Vector3f* end = thinned.data();
  for (std::size_t i = 0; i < looked_at; ++i) {
    const Eigen::Vector3f& p = points_sensor[i * points_sensor.size() / looked_at];
    const float range2 = p.head<2>().squaredNorm();
    if (!(range2 >= min2 && range2 <= max2) || !std::isfinite(p.z())) continue;
    *end = p;  // stays if the end moves behind it
    end += cells.Add(CellOf(p, per_metre));
  }
  return Points(thinned.data(), end);
}

void Validate(const ScanThinningParameters& parameters) {
  const auto require = [](bool holds, const char* what) {
    if (!holds) throw std::invalid_argument(std::string("front_end.thinning.") + what);
  };
  require(parameters.cell_size_m > 0.0 && std::isfinite(parameters.cell_size_m), "cell_size_m: must be positive");
  require(parameters.min_range_m >= 0.0, "min_range_m: must not be negative");
  require(parameters.max_range_m > parameters.min_range_m, "max_range_m: must be more than min_range_m");
  require(parameters.max_points >= 1, "max_points: must be at least 1");
}

}  // namespace incremental_segmatch
