#include "incremental_segmatch/range_image.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <random>
#include <stdexcept>

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

TEST(RangeImage, RefusesParametersOutOfRange) {
  EXPECT_THROW(Validate(FreeSpaceParameters{NAN, 35.0, 0.5}), std::invalid_argument);
  EXPECT_THROW(Validate(FreeSpaceParameters{0.5, 0.0, 0.5}), std::invalid_argument);
  EXPECT_THROW(Validate(FreeSpaceParameters{0.5, 35.0, 0.0}), std::invalid_argument);
}

}  // namespace
}  // namespace incremental_segmatch
