#include "incremental_segmatch/range_image.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <map>
#include <random>
#include <stdexcept>
#include <string>
#include <utility>

namespace incremental_segmatch {
namespace {

// A wall across the x axis as seen from the origin, every degree.
Points Wall(double x_m) {
  Points wall;
  for (int azimuth = -40; azimuth <= 40; ++azimuth) {
    for (int elevation = 2; elevation <= 20; ++elevation) {
      const double a = azimuth * M_PI / 180.0, e = elevation * M_PI / 180.0;
      const double range = x_m / (std::cos(e) * std::cos(a));
      wall.emplace_back(static_cast<float>(x_m), static_cast<float>(range * std::cos(e) * std::sin(a)),
                        static_cast<float>(range * std::sin(e)));
    }
  }
  return wall;
}

FreeSpaceParameters AllHeights() {
  FreeSpaceParameters parameters;
  parameters.min_height_m = -100.0;
  return parameters;
}

TEST(RangeImage, ConfirmsWhatIsThereAndSeesThroughWhatIsNot) {
  const RangeImage image(Wall(20.0));
  const Pose here = Pose::Identity();
  const FreeSpaceCounts same = image.Compare(Wall(20.0), here, 0.0, AllHeights());
  EXPECT_GT(same.confirmed, 1000u);
  EXPECT_EQ(same.seen_through, 0u);
  EXPECT_EQ(same.Contradiction(), 0.0);
  const FreeSpaceCounts nearer = image.Compare(Wall(10.0), here, 0.0, AllHeights());
  EXPECT_EQ(nearer.confirmed, 0u);
  EXPECT_GT(nearer.seen_through, 1000u);
  EXPECT_EQ(nearer.Contradiction(), 1.0);
  const FreeSpaceCounts hidden = image.Compare(Wall(30.0), here, 0.0, AllHeights());  // behind the wall: who knows
  EXPECT_EQ(hidden.confirmed + hidden.seen_through, 0u);
}

TEST(RangeImage, DoesNotDependOnWhereTheOtherScanWasTaken) {
  for (unsigned seed = 0; seed < 50; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    std::mt19937 random(seed);
    std::uniform_real_distribution<double> unit(-1.0, 1.0);
    const Pose T_image_other = Eigen::Translation3d(20.0 * unit(random), 20.0 * unit(random), unit(random)) *
                               Eigen::AngleAxisd(3.0 * unit(random), Eigen::Vector3d::UnitZ());
    Points other;
    for (const Eigen::Vector3f& p : Wall(10.0)) other.push_back((T_image_other.inverse() * p.cast<double>()).cast<float>());
    const FreeSpaceCounts counts = RangeImage(Wall(20.0)).Compare(other, T_image_other, 0.0, AllHeights());
    EXPECT_GT(counts.seen_through, 1000u);
    EXPECT_EQ(counts.confirmed, 0u);
  }
}

TEST(RangeImage, LeavesOutWhatIsLowFarOrWithinTheSlack) {
  const RangeImage image(Wall(20.0));
  FreeSpaceParameters parameters = AllHeights();
  const auto judged = [&](double x_m, double slack_m) {
    const FreeSpaceCounts counts = image.Compare(Wall(x_m), Pose::Identity(), slack_m, parameters);
    return counts.confirmed + counts.seen_through;
  };
  EXPECT_GT(judged(10.0, 0.0), 1000u);
  EXPECT_EQ(judged(10.0, 8.5), 0u);  // neither within 9 m nor farther by 18 m
  parameters.max_range_m = 9.0;
  EXPECT_EQ(judged(10.0, 0.0), 0u);
  parameters = AllHeights();
  parameters.min_height_m = 50.0;
  EXPECT_EQ(judged(10.0, 0.0), 0u);
  EXPECT_EQ(RangeImage(Points()).Compare(Wall(10.0), Pose::Identity(), 0.0, AllHeights()).seen_through, 0u);
}

/// What an image says of a point, with angles by the standard library, and every return looked at.
Sight LookSlowly(const Points& scan, const Eigen::Vector3f& p, float tolerance_m) {
  const auto cell_of = [](const Eigen::Vector3f& q) {
    const double elevation = std::atan2(q.z(), std::hypot(q.x(), q.y())), azimuth = std::atan2(q.y(), q.x());
    return std::make_pair(static_cast<int>(std::floor((elevation * 180.0 / M_PI + 45.0) / 1.5)),
                          static_cast<int>(std::floor((azimuth * 180.0 / M_PI + 180.0) / 2.0)));
  };
  const auto is_in = [](int row) { return row >= 0 && row < 60; };
  const auto [row, column] = cell_of(p);
  if (!is_in(row)) return Sight::kUnknown;
  std::map<std::pair<int, int>, std::pair<float, float>> cells;  // nearest and farthest
  for (const Eigen::Vector3f& q : scan) {
    const auto cell = cell_of(q);
    const int columns_apart = std::abs(cell.second - column);
    if (!is_in(cell.first) || std::abs(cell.first - row) > 1 || (columns_apart > 1 && columns_apart < 179)) continue;
    auto& [nearest, farthest] = cells.try_emplace(cell, q.norm(), q.norm()).first->second;
    nearest = std::min(nearest, q.norm());
    farthest = std::max(farthest, q.norm());
  }
  bool is_confirmed = false, is_behind_all = true;
  for (const auto& [cell, extent] : cells) {
    is_confirmed = is_confirmed || (extent.first - tolerance_m <= p.norm() && p.norm() <= extent.second + tolerance_m);
    is_behind_all = is_behind_all && extent.first > p.norm() + 2.f * tolerance_m;
  }
  if (cells.size() < 2) return Sight::kUnknown;
  return is_confirmed ? Sight::kConfirmed : is_behind_all ? Sight::kSeenThrough : Sight::kUnknown;
}

TEST(RangeImage, LooksAsOneWithExactAnglesDoes) {
  std::map<Sight, int> seen;
  for (unsigned seed = 0; seed < 200; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    std::mt19937 random(seed);
    const auto between = [&](double least, double most) { return std::uniform_real_distribution<double>(least, most)(random); };
    const int columns = seed % 2 == 0 ? 180 : 6;  // all round, or dense beside the seam behind the sensor
    const auto somewhere = [&] {  // not where rounding decides on the cell
      const double row = std::floor(between(-4.0, 64.0)) + between(0.001, 0.999);
      const double column = std::floor(between(0.0, columns)) + between(0.001, 0.999) - 3.0;
      const double elevation = (1.5 * row - 45.0) * M_PI / 180.0, azimuth = (2.0 * column - 180.0) * M_PI / 180.0;
      const double range_m = between(1.0, 40.0);
      return Eigen::Vector3d(range_m * std::cos(elevation) * std::cos(azimuth), range_m * std::cos(elevation) * std::sin(azimuth),
                             range_m * std::sin(elevation)).cast<float>().eval();
    };
    Points scan;
    for (int i = 0; i < (seed % 2 == 0 ? 4000 : 200); ++i) scan.push_back(somewhere());
    const RangeImage image(scan);
    for (int i = 0; i < 100; ++i) {
      const Eigen::Vector3f p = somewhere();
      const Sight sight = LookSlowly(scan, p, 0.5f);
      EXPECT_EQ(image.Look(p, 0.5f), sight) << "at " << p.transpose();
      ++seen[sight];
    }
  }
  for (const Sight sight : {Sight::kUnknown, Sight::kConfirmed, Sight::kSeenThrough}) EXPECT_GT(seen[sight], 1000);
}

TEST(RangeImage, TakesPointsOnTheAxesAndInTheSensorAsTheyAre) {
  for (const auto& p : {Eigen::Vector3f(10.f, 0.f, 0.f), Eigen::Vector3f(-10.f, 0.f, 0.f), Eigen::Vector3f(-10.f, -0.f, 0.f),
                        Eigen::Vector3f(0.f, 10.f, 0.f), Eigen::Vector3f(0.f, -10.f, 0.f)}) {
    const RangeImage image({p, p + Eigen::Vector3f(0.f, 0.f, 0.3f)});
    EXPECT_EQ(image.Look(p, 0.5f), Sight::kConfirmed) << p.transpose();
    EXPECT_EQ(image.Look(0.5f * p, 0.5f), Sight::kSeenThrough) << p.transpose();
    EXPECT_EQ(image.Look(-p, 0.5f), Sight::kUnknown) << p.transpose();
  }
  const RangeImage image({Eigen::Vector3f(0.f, 0.f, 0.f), Eigen::Vector3f(0.f, 0.f, 10.f)});  // in no direction, and above all
  EXPECT_EQ(image.Look(Eigen::Vector3f(0.f, 0.f, 9.f), 2.f), Sight::kUnknown);
}

TEST(RangeImage, RefusesParametersOutOfRange) {
  EXPECT_THROW(Validate(FreeSpaceParameters{NAN, 35.0, 0.5}), std::invalid_argument);
  EXPECT_THROW(Validate(FreeSpaceParameters{0.5, 0.0, 0.5}), std::invalid_argument);
  EXPECT_THROW(Validate(FreeSpaceParameters{0.5, 35.0, 0.0}), std::invalid_argument);
}

}  // namespace
}  // namespace incremental_segmatch
