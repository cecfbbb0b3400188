// Covariances move as perturbed poses do.
#include "incremental_segmatch/twist.hpp"

#include <gtest/gtest.h>

#include <random>
#include <string>

namespace incremental_segmatch {
namespace {

using Vector6 = Eigen::Matrix<double, 6, 1>;

Pose RandomPose(std::mt19937& random) {
  std::uniform_real_distribution<double> unit(-1.0, 1.0);
  const auto three = [&] { return Eigen::Vector3d(unit(random), unit(random), unit(random)); };
  Pose T = Pose::Identity();
  T.linear() = Eigen::AngleAxisd(3.0 * unit(random), three().normalized()).toRotationMatrix();
  T.translation() = 10.0 * three();
  return T;
}

Pose SmallMotion(const Vector6& xi) {
  Pose T = Pose::Identity();
  T.linear() += CrossMatrix(xi.tail<3>());
  T.translation() = xi.head<3>();
  return T;
}

/// Of a small motion.
Vector6 TwistOf(const Pose& T) {
  const Eigen::AngleAxisd rotation(T.linear());
  Vector6 xi;
  xi << T.translation(), rotation.angle() * rotation.axis();
  return xi;
}

TEST(Twist, CrossMatrixIsTheCrossProduct) {
  const Eigen::Vector3d v(1.0, -2.0, 3.0), w(0.5, 4.0, -1.0);
  EXPECT_LT((CrossMatrix(v) * w - v.cross(w)).norm(), 1e-15);
}

TEST(Twist, AdjointAndCovarianceAgreeWithDifferencesOfPoses) {
  for (unsigned seed = 0; seed < 100; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    std::mt19937 random(seed);
    const Pose T = RandomPose(random);
    const double step = 1e-6;
    Covariance6 to_left, to_right;  // Jacobians, column by column
    for (int column = 0; column < 6; ++column) {
      const Pose motion = SmallMotion(step * Vector6::Unit(column));
      to_left.col(column) = TwistOf(T * motion * T.inverse()) / step;
      to_right.col(column) = TwistOf(T.inverse() * motion * T) / step;
    }
    EXPECT_LT((Adjoint(T) - to_left).cwiseAbs().maxCoeff(), 1e-4);
    const Covariance6 root = Covariance6::Random();
    const Covariance6 covariance = root * root.transpose();
    const Covariance6 moved = MoveToTheRight(covariance, T);
    EXPECT_EQ(moved, moved.transpose());
    EXPECT_LT((moved - to_right * covariance * to_right.transpose()).cwiseAbs().maxCoeff(),
              1e-4 * moved.cwiseAbs().maxCoeff());
  }
}

}  // namespace
}  // namespace incremental_segmatch
