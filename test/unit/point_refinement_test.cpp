#include "incremental_segmatch/point_refinement.hpp"

#include <gtest/gtest.h>

#include <Eigen/Geometry>
#include <Eigen/LU>
#include <cmath>
#include <functional>
#include <limits>
#include <random>
#include <stdexcept>
#include <string>

namespace incremental_segmatch {
namespace {

using Cloud = std::vector<Eigen::Vector3d>;

constexpr double kDegree = M_PI / 180.0;

struct Object {
  enum Kind { kBox, kCylinder } kind;
  Eigen::Vector3d base;
  Eigen::Vector3d size;  // of a cylinder: diameter, diameter, height
  double yaw;
};

// A street scene: houses, cars and posts on flat ground, which itself is not sampled.
std::vector<Object> RandomScene(std::mt19937& random, int count, double radius_m) {
  std::uniform_real_distribution<double> uniform(0.0, 1.0), place(-radius_m, radius_m), yaw(-M_PI, M_PI);
  std::vector<Object> scene;
  for (int i = 0; i < count; ++i) {
    const Eigen::Vector3d base(place(random), place(random), 0.3 * uniform(random));
    const double kind = uniform(random);
    if (kind < 0.3) {
      scene.push_back({Object::kBox, base, {5 + 5 * uniform(random), 4 + 4 * uniform(random), 3.0}, yaw(random)});
    } else if (kind < 0.65) {
      scene.push_back({Object::kBox, base, {4.3, 1.8, 1.4}, yaw(random)});
    } else {
      const double diameter = 0.15 + 0.5 * uniform(random);
      scene.push_back({Object::kCylinder, base, {diameter, diameter, 2 + 4 * uniform(random)}, 0.0});
    }
  }
  return scene;
}

// Points on walls and top, each measured once with noise.
void Sample(const Object& object, double points_per_m2, double noise_m, std::mt19937& random, Cloud* cloud) {
  std::uniform_real_distribution<double> uniform(-0.5, 0.5);
  std::normal_distribution<double> noise(0.0, noise_m);
  const Eigen::Matrix3d R = Eigen::AngleAxisd(object.yaw, Eigen::Vector3d::UnitZ()).toRotationMatrix();
  const Eigen::Vector3d& s = object.size;
  const auto add = [&](const Eigen::Vector3d& p) {
    cloud->push_back(object.base + R * p + Eigen::Vector3d(noise(random), noise(random), noise(random)));
  };
  const auto repeat = [&](double area, const std::function<Eigen::Vector3d()>& make) {
    for (int i = 0; i < static_cast<int>(area * points_per_m2); ++i) add(make());
  };
  if (object.kind == Object::kBox) {
    for (const double side : {-0.5, 0.5}) {
      repeat(s.y() * s.z(),
             [&] { return Eigen::Vector3d(side * s.x(), uniform(random) * s.y(), (uniform(random) + 0.5) * s.z()); });
      repeat(s.x() * s.z(),
             [&] { return Eigen::Vector3d(uniform(random) * s.x(), side * s.y(), (uniform(random) + 0.5) * s.z()); });
    }
    repeat(s.x() * s.y(), [&] { return Eigen::Vector3d(uniform(random) * s.x(), uniform(random) * s.y(), s.z()); });
    return;
  }
  repeat(M_PI * s.x() * s.z(), [&] {
    const double angle = 2.0 * M_PI * uniform(random);
    return Eigen::Vector3d(0.5 * s.x() * std::cos(angle), 0.5 * s.x() * std::sin(angle),
                           (uniform(random) + 0.5) * s.z());
  });
}

Cloud Sample(const std::vector<Object>& objects, std::mt19937& random, double points_per_m2 = 25.0,
             double noise_m = 0.02) {
  Cloud cloud;
  for (const Object& object : objects) Sample(object, points_per_m2, noise_m, random, &cloud);
  return cloud;
}

Pose RandomPose(std::mt19937& random, double translation_m, double angle_rad) {
  std::normal_distribution<double> normal;
  Pose T = Pose::Identity();
  const Eigen::Vector3d axis = Eigen::Vector3d(normal(random), normal(random), normal(random)).normalized();
  const Eigen::Vector3d direction = Eigen::Vector3d(normal(random), normal(random), normal(random)).normalized();
  T.linear() = Eigen::AngleAxisd(angle_rad, axis).toRotationMatrix();
  T.translation() = translation_m * direction;
  return T;
}

struct Problem {
  Cloud local;
  Cloud target;
  Pose T_target_local;  // the truth
};

// Of 30 objects 18 are seen by both sides, 6 by either side alone.
std::optional<RefinedTransform> RefineOnPoints(const Cloud& local, const Cloud& target, const Pose& T_target_local,
                                               const RefinementParameters& parameters) {
  return RefinementTarget(target, parameters).Refine(local, T_target_local);
}

Problem MakeProblem(std::mt19937& random, double radius_m = 20.0) {
  std::uniform_real_distribution<double> far(-500.0, 500.0), yaw(-M_PI, M_PI);
  const std::vector<Object> scene = RandomScene(random, 30, radius_m);
  const std::vector<Object> seen_local(scene.begin(), scene.begin() + 24), seen_target(scene.begin() + 6, scene.end());
  Problem problem;
  problem.T_target_local = Pose::Identity();
  problem.T_target_local.linear() = Eigen::AngleAxisd(yaw(random), Eigen::Vector3d::UnitZ()).toRotationMatrix();
  problem.T_target_local.translation() << far(random), far(random), 3.0;
  for (const Eigen::Vector3d& p : Sample(seen_target, random)) problem.target.push_back(problem.T_target_local * p);
  problem.local = Sample(seen_local, random);
  return problem;
}

// Given the truth disturbed about the scene's middle.
Pose Disturb(const Problem& problem, const Pose& disturbance) {
  return problem.T_target_local * disturbance;
}

Eigen::Matrix<double, 6, 1> ErrorAboutOrigin(const Pose& T_true, const Pose& T) {
  const Pose error = T_true * T.inverse();
  const Eigen::AngleAxisd rotation(error.linear());
  Eigen::Matrix<double, 6, 1> xi;
  xi << error.translation(), rotation.angle() * rotation.axis();
  return xi;
}

// Errors of one seed: metres and radians about the scene's middle, and in standard deviations of the reported
// covariance.
struct Outcome {
  double translation_m;
  double rotation_rad;
  double sigmas;
};

Outcome RefineDisturbed(unsigned seed, double translation_m, double rotation_rad) {
  std::mt19937 random(seed);
  const Problem problem = MakeProblem(random);
  const Pose disturbance = RandomPose(random, translation_m, rotation_rad);
  const auto refined = RefineOnPoints(problem.local, problem.target, Disturb(problem, disturbance), {});
  EXPECT_TRUE(refined) << "refused";
  if (!refined) return {1e9, 1e9, 1e9};
  EXPECT_GT(refined->overlap, 0.3);
  EXPECT_LT(refined->overlap, 0.98);
  EXPECT_LT(refined->rms_m, 0.1);
  EXPECT_TRUE(refined->T_target_local.linear().isUnitary(1e-12));
  EXPECT_TRUE(refined->covariance.isApprox(refined->covariance.transpose(), 1e-9));
  const Pose error = problem.T_target_local.inverse() * refined->T_target_local;
  const auto xi = ErrorAboutOrigin(problem.T_target_local, refined->T_target_local);
  return {error.translation().norm(), Eigen::AngleAxisd(error.linear()).angle(),
          std::sqrt(xi.dot(refined->covariance.fullPivLu().solve(xi)) / 6.0)};
}

TEST(PointRefinement, RecoversDisturbancesInHalfSeenScenes) {
  int good = 0;
  for (unsigned seed = 0; seed < 30; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    const Outcome outcome = RefineDisturbed(seed, 0.6, 3.0 * kDegree);
    EXPECT_LT(outcome.translation_m, 0.03);
    EXPECT_LT(outcome.rotation_rad, 0.15 * kDegree);
    good += outcome.translation_m < 0.02 && outcome.rotation_rad < 0.1 * kDegree;
  }
  EXPECT_GE(good, 29);
}

TEST(PointRefinement, LooksAroundWhereTheFirstAttemptFitsBadly) {
  RefinementParameters alone;
  alone.search_m = 0.0;
  alone.min_overlap = 0.0;
  RefinementParameters with_search;
  with_search.min_overlap = 0.0;
  int good_alone = 0, good_with_search = 0;
  for (unsigned seed = 0; seed < 30; ++seed) {
    std::mt19937 random(seed);
    const Problem problem = MakeProblem(random);
    std::uniform_real_distribution<double> direction(-M_PI, M_PI);
    const double angle = direction(random);
    const Pose begin = Disturb(problem, Pose(Eigen::Translation3d(2.0 * std::cos(angle), 2.0 * std::sin(angle), 0.0)));
    const auto is_good = [&](const RefinementParameters& parameters) {
      const auto refined = RefineOnPoints(problem.local, problem.target, begin, parameters);
      return refined && (problem.T_target_local.inverse() * refined->T_target_local).translation().norm() < 0.03;
    };
    good_alone += is_good(alone);
    good_with_search += is_good(with_search);
  }
  EXPECT_LE(good_alone, 20) << "nothing to look for";
  EXPECT_GE(good_with_search, 25);
}

TEST(PointRefinement, TheCovarianceTellsTheError) {
  int within_two = 0, within_four = 0;
  double sum = 0.0;
  for (unsigned seed = 100; seed < 130; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    const double sigmas = RefineDisturbed(seed, 0.3, 1.0 * kDegree).sigmas;
    within_two += sigmas < 2.0;
    within_four += sigmas < 4.0;
    sum += sigmas;
  }
  EXPECT_GE(within_four, 29);
  EXPECT_GE(within_two, 22);
  EXPECT_GT(sum / 30.0, 0.25) << "too cautious: the floors are for more than this scene's noise";
}

TEST(PointRefinement, DoesNotDependOnWhereTheFramesHaveTheirOrigins) {
  std::mt19937 random(1);
  const Problem problem = MakeProblem(random);
  const auto near = RefineOnPoints(problem.local, problem.target, Disturb(problem, RandomPose(random, 0.3, 0.02)), {});
  ASSERT_TRUE(near);
  const Eigen::Vector3d far_local(2e5, -3e5, 100), far_target(-4e5, 1e5, 50);
  Cloud local = problem.local, target = problem.target;
  for (auto& p : local) p += far_local;
  for (auto& p : target) p += far_target;
  random.seed(1);
  const Problem same = MakeProblem(random);
  const Pose start = Eigen::Translation3d(far_target) * Disturb(same, RandomPose(random, 0.3, 0.02)) *
                     Eigen::Translation3d(-far_local);
  const auto far = RefineOnPoints(local, target, start, {});
  ASSERT_TRUE(far);
  const Pose back = Eigen::Translation3d(-far_target) * far->T_target_local * Eigen::Translation3d(far_local);
  EXPECT_LT((back.matrix() - near->T_target_local.matrix()).cwiseAbs().maxCoeff(), 1e-3);
  // The translation's uncertainty about the far origin contains the rotation's times the lever arm.
  const double lever_m = std::hypot(far_target.x(), far_target.y());
  EXPECT_GT(std::sqrt(far->covariance(0, 0) + far->covariance(1, 1)),
            0.5 * lever_m * std::sqrt(near->covariance(5, 5)));
  EXPECT_NEAR(std::sqrt(far->covariance(5, 5) / near->covariance(5, 5)), 1.0, 0.05);
}

TEST(PointRefinement, IsDeterministic) {
  std::mt19937 random(2);
  const Problem problem = MakeProblem(random);
  const Pose start = Disturb(problem, RandomPose(random, 0.3, 0.02));
  const auto a = RefineOnPoints(problem.local, problem.target, start, {});
  // Of a target that others were laid on before.
  RefinementTarget target(problem.target, {});
  target.Refine(problem.local, Disturb(problem, RandomPose(random, 0.3, 0.02)));
  const auto b = target.Refine(problem.local, start);
  ASSERT_TRUE(a && b);
  EXPECT_EQ(a->T_target_local.matrix(), b->T_target_local.matrix());
  EXPECT_EQ(a->covariance, b->covariance);
}

TEST(PointRefinement, RefusesCloudsThatDoNotOverlap) {
  std::mt19937 random(3);
  const Cloud here = Sample(RandomScene(random, 10, 20.0), random),
              there = Sample(RandomScene(random, 10, 20.0), random);
  EXPECT_FALSE(RefineOnPoints(here, there, Pose(Eigen::Translation3d(100, 0, 0)), {}));
  RefinementParameters strict;
  strict.min_overlap = 0.9;
  const Problem problem = MakeProblem(random);
  ASSERT_TRUE(RefineOnPoints(problem.local, problem.target, problem.T_target_local, {}));
  EXPECT_FALSE(RefineOnPoints(problem.local, problem.target, problem.T_target_local, strict));
}

// Walls without tops: nothing holds the height.
Cloud Walls(const std::vector<Eigen::Vector3d>& from_length_yaw, std::mt19937& random) {
  std::uniform_real_distribution<double> uniform(0.0, 1.0);
  std::normal_distribution<double> noise(0.0, 0.02);
  Cloud cloud;
  for (std::size_t i = 0; i + 1 < from_length_yaw.size(); i += 2) {
    const Eigen::Vector3d& from = from_length_yaw[i];
    const double length = from_length_yaw[i + 1].x(), yaw = from_length_yaw[i + 1].y();
    for (int k = 0; k < static_cast<int>(length * 4.0 * 40.0); ++k) {
      const double along = length * uniform(random), across = noise(random);
      cloud.push_back(from + Eigen::Vector3d(along * std::cos(yaw) - across * std::sin(yaw),
                                             along * std::sin(yaw) + across * std::cos(yaw), 4.0 * uniform(random)));
    }
  }
  return cloud;
}

TEST(PointRefinement, RefusesACorridorAndAWall) {
  std::mt19937 random(4);
  const std::vector<Eigen::Vector3d> wall{{0, 0, 0}, {30, 0, 0}},
      corridor{{0, 0, 0}, {30, 0, 0}, {0, 4, 0}, {30, 0, 0}};
  for (const auto& walls : {wall, corridor}) {
    const Cloud a = Walls(walls, random), b = Walls(walls, random);
    EXPECT_FALSE(RefineOnPoints(a, b, Pose(Eigen::Translation3d(0.1, 0.1, 0)), {}));
  }
}

TEST(PointRefinement, KeepsTheGivenPoseWhereThePointsLeaveItOpen) {
  std::mt19937 random(5);
  const std::vector<Eigen::Vector3d> walls{{0, 0, 0},         {15, 0, 0}, {0, 0, 0},
                                           {12, M_PI / 2, 0}, {18, 2, 0}, {10, 2.0, 0}};
  const Cloud a = Walls(walls, random), b = Walls(walls, random);
  const auto refined = RefineOnPoints(a, b, Pose(Eigen::Translation3d(0.3, -0.2, 0.15)), {});
  ASSERT_TRUE(refined);
  EXPECT_EQ(refined->open_directions, 1);
  EXPECT_LT(refined->T_target_local.translation().head<2>().norm(), 0.02);
  EXPECT_NEAR(refined->T_target_local.translation().z(), 0.15, 0.03);
  EXPECT_NEAR(std::sqrt(refined->covariance(2, 2)), 0.5, 0.1);
  EXPECT_LT(std::sqrt(refined->covariance(0, 0)), 0.05);
  RefinementParameters strict;
  strict.max_open_directions = 0;
  EXPECT_FALSE(RefineOnPoints(a, b, Pose::Identity(), strict));
}

TEST(PointRefinement, HasNothingToSayAboutNothing) {
  std::mt19937 random(6);
  const Cloud cloud = Sample(RandomScene(random, 5, 10.0), random);
  EXPECT_FALSE(RefineOnPoints({}, {}, Pose::Identity(), {}));
  EXPECT_FALSE(RefineOnPoints({}, cloud, Pose::Identity(), {}));
  EXPECT_FALSE(RefineOnPoints(cloud, {}, Pose::Identity(), {}));
  EXPECT_FALSE(RefineOnPoints(Cloud(1000, Eigen::Vector3d(1, 2, 3)), Cloud(1000, Eigen::Vector3d(1, 2, 3)),
                              Pose::Identity(), {}));
}

TEST(PointRefinement, IgnoresPointsThatAreNotFinite) {
  std::mt19937 random(7);
  Problem problem = MakeProblem(random);
  const auto clean = RefineOnPoints(problem.local, problem.target, problem.T_target_local, {});
  problem.target.emplace_back(std::numeric_limits<double>::quiet_NaN(), 0, 0);
  problem.target.emplace_back(0, std::numeric_limits<double>::infinity(), 0);
  const auto dirty = RefineOnPoints(problem.local, problem.target, problem.T_target_local, {});
  ASSERT_TRUE(clean && dirty);
  EXPECT_EQ(clean->T_target_local.matrix(), dirty->T_target_local.matrix());
}

TEST(PointRefinement, NamesTheParameterThatIsOutOfRange) {
  const auto expect_refused = [](const std::string& name, const std::function<void(RefinementParameters*)>& spoil) {
    RefinementParameters parameters;
    spoil(&parameters);
    try {
      RefineOnPoints({}, {}, Pose::Identity(), parameters);
      ADD_FAILURE() << name << " was accepted";
    } catch (const std::invalid_argument& error) {
      EXPECT_NE(std::string(error.what()).find("refinement." + name), std::string::npos) << error.what();
    }
  };
  expect_refused("max_distance_m", [](auto* p) { p->max_distance_m = 0.1; });
  expect_refused("min_distance_m", [](auto* p) { p->min_distance_m = 0.0; });
  expect_refused("search_m", [](auto* p) { p->search_m = -1.0; });
  expect_refused("search_overlap", [](auto* p) { p->search_overlap = 1.1; });
  expect_refused("max_iterations", [](auto* p) { p->max_iterations = 0; });
  expect_refused("min_overlap", [](auto* p) { p->min_overlap = 1.1; });
  expect_refused("normal_radius_m", [](auto* p) { p->normal_radius_m = std::nan(""); });
  expect_refused("max_points", [](auto* p) { p->max_points = 0; });
  expect_refused("min_stiffness", [](auto* p) { p->min_stiffness = 0.0; });
  expect_refused("floor_m", [](auto* p) { p->floor_m = -0.1; });
  expect_refused("floor_rad", [](auto* p) { p->floor_rad = std::nan(""); });
  expect_refused("max_open_directions", [](auto* p) { p->max_open_directions = 6; });
}

}  // namespace
}  // namespace incremental_segmatch
