#include "incremental_segmatch/descriptors.hpp"

#include <gtest/gtest.h>

#include <Eigen/Eigenvalues>
#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <random>
#include <stdexcept>

namespace incremental_segmatch {
namespace {

constexpr double kResolution = 0.1;

Descriptor Describe(const std::vector<Eigen::Vector3d>& points, const Eigen::Vector3d& up = Eigen::Vector3d::UnitZ(),
                    const DescriptorParameters& parameters = {}) {
  SegmentMoments moments;
  for (const Eigen::Vector3d& p : points) moments.Add(p);
  return Describer(parameters, kResolution).Describe(moments, up, {});
}

std::vector<Eigen::Vector3d> RandomBox(std::mt19937& random, const Eigen::Vector3d& size, const Eigen::Matrix3d& R,
                                       const Eigen::Vector3d& center, int count) {
  std::uniform_real_distribution<double> uniform(-0.5, 0.5);
  std::vector<Eigen::Vector3d> points;
  for (int i = 0; i < count; ++i) {
    const Eigen::Vector3d p(uniform(random), uniform(random), uniform(random));
    points.push_back(R * p.cwiseProduct(size) + center);
  }
  return points;
}

TEST(EigenvalueFeatures, MatchTheirDefinitions) {
  const Eigen::Matrix<float, 7, 1> f = EigenvalueFeatures({1.0, 3.0, 6.0});  // e = 0.6, 0.3, 0.1
  EXPECT_NEAR(f[0], 0.3 / 0.6, 1e-6);
  EXPECT_NEAR(f[1], 0.2 / 0.6, 1e-6);
  EXPECT_NEAR(f[2], 0.1 / 0.6, 1e-6);
  EXPECT_NEAR(f[3], std::cbrt(0.6 * 0.3 * 0.1), 1e-6);
  EXPECT_NEAR(f[4], 0.5 / 0.6, 1e-6);
  EXPECT_NEAR(f[5], -(0.6 * std::log(0.6) + 0.3 * std::log(0.3) + 0.1 * std::log(0.1)), 1e-6);
  EXPECT_NEAR(f[6], 0.1, 1e-6);
}

TEST(EigenvalueFeatures, LinePlaneAndBall) {
  Eigen::Matrix<float, 7, 1> line, plane, ball;
  line << 1, 0, 0, 0, 1, 0, 0;
  plane << 0, 1, 0, 0, 1, std::log(2.f), 0;
  ball << 0, 0, 1, 1.f / 3, 0, std::log(3.f), 1.f / 3;
  EXPECT_TRUE(EigenvalueFeatures({0, 0, 5}).isApprox(line, 1e-6f));
  EXPECT_TRUE(EigenvalueFeatures({0, 2, 2}).isApprox(plane, 1e-6f));
  EXPECT_TRUE(EigenvalueFeatures({2, 2, 2}).isApprox(ball, 1e-6f));
}

TEST(EigenvalueFeatures, RoundingBelowZeroCountsAsZeroAndNothingGivesZeros) {
  EXPECT_EQ(EigenvalueFeatures({-1e-18, 2, 3}), EigenvalueFeatures({0, 2, 3}));
  EXPECT_TRUE(EigenvalueFeatures({0, 0, 0}).isZero());
  EXPECT_TRUE(EigenvalueFeatures({-1e-18, -1e-19, 0}).isZero());
}

SegmentMoments MomentsOf(const std::vector<Eigen::Vector3d>& points) {
  SegmentMoments moments;
  for (const Eigen::Vector3d& p : points) moments.Add(p);
  return moments;
}

/// A pole of this height, the middle of it here.
SegmentMoments Pole(const Eigen::Vector3d& middle, double height) {
  const Eigen::Vector3d half(0, 0, 0.5 * height);
  return MomentsOf({middle - half, middle + half});
}

TEST(ContextFeatures, TellHowMuchStandsHowFar) {
  const double width_m = 2.0, radius_m = width_m * kContextRings;
  const SegmentMoments segment = Pole({100, 200, 1}, 3.0);
  const SegmentMoments on_a_ring = Pole({100 + 3 * width_m, 200, 1}, 4.0);
  const SegmentMoments between_rings = Pole({100, 200 - 5.25 * width_m, 1}, 8.0);
  const SegmentMoments above = Pole({100, 200, 1 + 3 * width_m}, 5.0);
  const SegmentMoments outside = Pole({100 + radius_m, 200, 1}, 7.0);
  Eigen::Matrix<float, kContextRings, 1> expected = Eigen::Matrix<float, kContextRings, 1>::Zero();
  EXPECT_EQ(ContextFeatures(segment, {}, radius_m), expected);
  EXPECT_EQ(ContextFeatures(segment, {&segment, &outside}, radius_m), expected) << "neither is around it";
  expected[3] = std::sqrt(4.f + 5.f);
  expected[5] = std::sqrt(6.f);
  expected[6] = std::sqrt(2.f);
  EXPECT_TRUE(ContextFeatures(segment, {&on_a_ring, &segment, &between_rings, &outside, &above}, radius_m).isApprox(expected, 1e-6f));
}

// By definition: each ring weighs distances like a tent as wide as its neighbours' middles are apart.
TEST(ContextFeatures, AgreeWithAnOracleOverPoints) {
  for (unsigned seed = 0; seed < 200; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    std::mt19937 random(seed);
    std::uniform_real_distribution<double> size(0.1, 6.0), place(-30, 30), radius(1.0, 40.0), far(-1e4, 1e4);
    const Eigen::Vector3d origin(far(random), far(random), far(random));
    const double radius_m = radius(random);
    std::vector<std::vector<Eigen::Vector3d>> clouds;
    for (unsigned i = 0; i < seed % 40 + 1; ++i) {
      const Eigen::Vector3d center = origin + Eigen::Vector3d(place(random), place(random), 0.1 * place(random));
      clouds.push_back(RandomBox(random, {size(random), size(random), size(random)}, Eigen::Matrix3d::Identity(), center, 20));
    }
    std::vector<SegmentMoments> moments;
    for (const auto& cloud : clouds) moments.push_back(MomentsOf(cloud));
    Surroundings surroundings;
    for (const SegmentMoments& m : moments) surroundings.push_back(&m);

    const auto mean = [](const std::vector<Eigen::Vector3d>& cloud) {
      Eigen::Vector3d sum = Eigen::Vector3d::Zero();
      for (const Eigen::Vector3d& p : cloud) sum += p;
      return Eigen::Vector3d(sum / static_cast<double>(cloud.size()));
    };
    const auto context = ContextFeatures(moments[0], surroundings, radius_m);
    for (Eigen::Index ring = 0; ring < kContextRings; ++ring) {
      double heights = 0.0;
      for (std::size_t i = 1; i < clouds.size(); ++i) {
        double low = clouds[i][0].z(), high = low;
        for (const Eigen::Vector3d& p : clouds[i]) {
          low = std::min(low, p.z());
          high = std::max(high, p.z());
        }
        const double distance = (mean(clouds[i]) - mean(clouds[0])).norm();
        const double middle = static_cast<double>(ring) * radius_m / static_cast<double>(kContextRings);
        heights += (high - low) * std::max(0.0, 1.0 - std::abs(distance - middle) * kContextRings / radius_m);
      }
      EXPECT_NEAR(context[ring], std::sqrt(heights), 1e-4);
    }
  }
}

TEST(Describer, NamesEachValueAndSelectsGroups) {
  EXPECT_EQ(Describer({true, true, true, true}, kResolution).size(), 14 + kContextRings);
  EXPECT_EQ(Describer({true, false, false, false}, kResolution).size(), 7);
  EXPECT_EQ(Describer({false, true, false, false}, kResolution).size(), 5);
  EXPECT_EQ(Describer({false, false, true, false}, kResolution).names(), (std::vector<std::string>{"upright_1", "upright_3"}));
  const std::vector<std::string> rings = Describer({false, false, false, true}, kResolution).names();
  ASSERT_EQ(rings.size(), static_cast<std::size_t>(kContextRings));
  EXPECT_EQ(rings.front(), "context_1");
  EXPECT_EQ(rings.back(), "context_" + std::to_string(kContextRings));
  std::mt19937 random(1);
  const auto points = RandomBox(random, {1, 2, 3}, Eigen::Matrix3d::Identity(), {0, 0, 0}, 100);
  const Descriptor all = Describe(points);
  EXPECT_EQ(Describe(points, Eigen::Vector3d::UnitZ(), {true, false, false, false}), all.head(7));
  EXPECT_EQ(Describe(points, Eigen::Vector3d::UnitZ(), {false, true, false, false}), all.segment(7, 5));
  EXPECT_EQ(Describe(points, Eigen::Vector3d::UnitZ(), {false, false, true, false}), all.segment(12, 2));
  EXPECT_TRUE(all.tail(kContextRings).isZero()) << "nothing stands around it";

  const SegmentMoments segment = MomentsOf(points), other = Pole({3, 1, 0}, 2.0);
  const DescriptorParameters parameters{true, true, true, true, 10.0};
  const Descriptor in_context = Describer(parameters, kResolution).Describe(segment, Eigen::Vector3d::UnitZ(), {&other});
  EXPECT_EQ(in_context.head(14), all.head(14));
  EXPECT_EQ(in_context.tail(kContextRings), ContextFeatures(segment, {&other}, 10.0));
}

TEST(Describer, RefusesNoFeaturesAndBadResolutions) {
  EXPECT_THROW(Describer({false, false, false, false}, kResolution), std::invalid_argument);
  EXPECT_THROW(Describer({true, true, true, true, 0.0}, kResolution), std::invalid_argument);
  EXPECT_THROW(Describer({true, true, true, true, std::nan("")}, kResolution), std::invalid_argument);
  EXPECT_THROW(Describer({}, 0.0), std::invalid_argument);
  EXPECT_THROW(Describer({}, std::nan("")), std::invalid_argument);
}

TEST(Describer, SizesOfAPoleAndAWall) {
  std::mt19937 random(2);
  const auto pole = RandomBox(random, {0.2, 0.2, 6.0}, Eigen::Matrix3d::Identity(), {5, 3, 1}, 4000);
  const Descriptor d = Describe(pole);
  EXPECT_NEAR(d[7], std::log(6.0 / std::sqrt(12.0) + kResolution), 0.02);
  EXPECT_NEAR(d[9], std::log(0.2 / std::sqrt(12.0) + kResolution), 0.02);
  EXPECT_NEAR(d[10], std::log(6.0 + kResolution), 0.01);
  EXPECT_NEAR(d[11], std::log(4000.0), 1e-5);
  EXPECT_NEAR(d[12], 1.0, 1e-3);  // the long axis is upright
  const auto wall = RandomBox(random, {8.0, 0.2, 3.0}, Eigen::Matrix3d::Identity(), {5, 3, 1}, 4000);
  const Descriptor w = Describe(wall);
  EXPECT_NEAR(w[12], 0.0, 0.03);  // the long axis lies
  EXPECT_NEAR(w[13], 0.0, 0.03);  // so does the normal
}

TEST(Describer, APointHasNoShape) {
  const Descriptor d = Describe({Eigen::Vector3d(1, 2, 3)});
  EXPECT_TRUE(d.allFinite());
  EXPECT_TRUE(d.head(7).isZero());
  EXPECT_TRUE(d.segment(12, 2).isZero());
}

// Values are those of an iterative decomposition of the two-pass covariance, also for degenerate shapes and far away.
TEST(Describer, AgreesWithATwoPassOracle) {
  for (unsigned seed = 0; seed < 300; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    std::mt19937 random(seed);
    std::uniform_real_distribution<double> size(0.1, 8.0), far(-1e5, 1e5);
    std::normal_distribution<double> normal;
    const Eigen::Matrix3d R = Eigen::Quaterniond(normal(random), normal(random), normal(random), normal(random))
                                  .normalized()
                                  .toRotationMatrix();
    Eigen::Vector3d extent(size(random), size(random), size(random));
    if (seed % 3 == 1) extent[1] = extent[0];
    const auto points = RandomBox(random, extent, R, {far(random), far(random), far(random)}, 200);

    Eigen::Vector3d mean = Eigen::Vector3d::Zero();
    for (const auto& p : points) mean += p / 200.0;
    Eigen::Matrix3d covariance = Eigen::Matrix3d::Zero();
    for (const auto& p : points) covariance += (p - mean) * (p - mean).transpose() / 200.0;
    const Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> solver(covariance);

    const Descriptor d = Describe(points);
    EXPECT_LT((d.head<7>() - EigenvalueFeatures(solver.eigenvalues())).cwiseAbs().maxCoeff(), 1e-5);
    for (int axis = 0; axis < 3; ++axis)
      EXPECT_NEAR(d[7 + axis], std::log(std::sqrt(solver.eigenvalues()[2 - axis]) + kResolution), 1e-5);
    EXPECT_NEAR(d[12], std::abs(solver.eigenvectors()(2, 2)), 1e-4);
    EXPECT_NEAR(d[13], std::abs(solver.eigenvectors()(2, 0)), 1e-4);
  }
}

TEST(Describer, DoesNotDependOnPositionNorHeading) {
  std::mt19937 random(3);
  const auto points = RandomBox(random, {1, 2, 4}, Eigen::Matrix3d::Identity(), {0, 0, 0}, 500);
  std::vector<Eigen::Vector3d> moved;
  const Eigen::AngleAxisd yaw(1.1, Eigen::Vector3d::UnitZ());
  for (const auto& p : points) moved.push_back(yaw * p + Eigen::Vector3d(1000, -2000, 30));
  EXPECT_LT((Describe(points) - Describe(moved)).cwiseAbs().maxCoeff(), 1e-5);
}

TEST(Describer, MeasuresUprightnessAlongTheGivenUp) {
  std::mt19937 random(4);
  const auto pole = RandomBox(random, {0.2, 0.2, 6.0}, Eigen::Matrix3d::Identity(), {0, 0, 0}, 2000);
  EXPECT_NEAR(Describe(pole, Eigen::Vector3d::UnitX())[12], 0.0, 0.01);
}

}  // namespace
}  // namespace incremental_segmatch
