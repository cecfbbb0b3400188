#include "incremental_segmatch/scan_thinning.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <random>
#include <set>
#include <stdexcept>
#include <tuple>

namespace incremental_segmatch {
namespace {

Points RandomScan(unsigned seed, std::size_t size, float extent_m) {
  std::mt19937 random(seed);
  std::uniform_real_distribution<float> metres(-extent_m, extent_m);
  Points points(size);
  for (Eigen::Vector3f& p : points) p << metres(random), metres(random), 0.1f * metres(random);
  return points;
}

// One after the other, with a set of cells.
Points ThinSlowly(const Points& points, const ScanThinningParameters& parameters) {
  std::set<std::tuple<double, double, double>> cells;
  Points thinned;
  for (const Eigen::Vector3f& p : points) {
    const double range = std::hypot(p.x(), p.y());
    if (!p.allFinite() || range < parameters.min_range_m || range > parameters.max_range_m) continue;
    const auto cell = [&](float value) { return std::floor(value * static_cast<float>(1.0 / parameters.cell_size_m)); };
    if (cells.insert({cell(p.x()), cell(p.y()), cell(p.z())}).second) thinned.push_back(p);
  }
  return thinned;
}

TEST(ScanThinning, AgreesWithTheObviousOne) {
  for (unsigned seed = 0; seed < 200; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    Points points = RandomScan(seed, 1000, 5.f + 0.25f * static_cast<float>(seed));
    points[seed].x() = std::numeric_limits<float>::quiet_NaN();
    points[seed + 7].z() = std::numeric_limits<float>::infinity();
    ScanThinningParameters parameters;
    parameters.cell_size_m = 0.1 + 0.05 * (seed % 7);
    EXPECT_EQ(ThinScan(points, parameters), ThinSlowly(points, parameters));
  }
}

TEST(ScanThinning, LooksAtSoManyPointsEvenlySpread) {
  Points line;
  for (int i = 0; i < 1000; ++i) line.push_back({5.f + 0.03f * static_cast<float>(i), 0.f, 0.f});
  ScanThinningParameters parameters;
  parameters.cell_size_m = 0.001;
  parameters.max_points = 10;
  const Points thinned = ThinScan(line, parameters);
  ASSERT_EQ(thinned.size(), 10u);
  for (std::size_t i = 0; i < 10; ++i) EXPECT_EQ(thinned[i], line[100 * i]);
  EXPECT_TRUE(ThinScan({}, parameters).empty());
}

TEST(ScanThinning, RefusesParametersOutOfRange) {
  const auto refuses = [](double cell, double min_range, double max_range, std::size_t points) {
    EXPECT_THROW(Validate(ScanThinningParameters{cell, min_range, max_range, points}), std::invalid_argument);
  };
  refuses(0.0, 1.0, 2.0, 1);
  refuses(0.1, -1.0, 2.0, 1);
  refuses(0.1, 2.0, 2.0, 1);
  refuses(0.1, 1.0, 2.0, 0);
}

}  // namespace
}  // namespace incremental_segmatch
