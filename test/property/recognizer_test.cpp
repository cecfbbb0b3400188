// Contract 7: equivariant under any yaw, translation and small tilt of the target map, independent of the input's
// order.
#include "incremental_segmatch/recognizer.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <random>

namespace incremental_segmatch {
namespace {

class Random {
 public:
  explicit Random(unsigned seed) : engine_(seed) {}
  double Unit() { return std::uniform_real_distribution<double>(0.0, 1.0)(engine_); }
  double Signed() { return 2.0 * Unit() - 1.0; }
  std::size_t Below(std::size_t n) { return engine_() % n; }
  double Normal(double sigma) { return std::normal_distribution<double>(0.0, sigma)(engine_); }
  Eigen::Vector3d Noise(double sigma) { return {Normal(sigma), Normal(sigma), Normal(sigma)}; }
  std::mt19937& engine() { return engine_; }

 private:
  std::mt19937 engine_;
};

Correspondence Make(SegmentId local, SegmentId target, const Eigen::Vector3d& p_local,
                    const Eigen::Vector3d& p_target) {
  Correspondence c;
  c.local = {0, local};
  c.target = {0, target};
  c.centroid_local = p_local;
  c.centroid_target = p_target;
  return c;
}

Eigen::Vector3d LocalPoint(Random& random) {
  return {40.0 * random.Signed(), 40.0 * random.Signed(), 2.0 * random.Signed()};
}

/// A turn about z, then a tilt about a horizontal axis, then a translation.
Pose TurnAndTilt(double yaw, double tilt, double tilt_axis, const Eigen::Vector3d& translation) {
  const Eigen::Vector3d axis(std::cos(tilt_axis), std::sin(tilt_axis), 0.0);
  Pose T = Pose::Identity();
  T.linear() = (Eigen::AngleAxisd(tilt, axis) * Eigen::AngleAxisd(yaw, Eigen::Vector3d::UnitZ())).toRotationMatrix();
  T.translation() = translation;
  return T;
}

/// True matches under T_target_local and false ones.
struct Scene {
  Pose T_target_local = Pose::Identity();
  Correspondences correspondences;
};

Scene RandomScene(Random& random, std::size_t inliers, std::size_t outliers, double noise_m, double tilt) {
  Scene scene;
  scene.T_target_local = TurnAndTilt(6.3 * random.Unit(), tilt, 6.3 * random.Unit(),
                                     {500.0 * random.Signed(), 500.0 * random.Signed(), 3.0});
  std::vector<Eigen::Vector3d> locals;
  for (SegmentId i = 0; i < 40; ++i) locals.push_back(LocalPoint(random));
  for (SegmentId i = 0; i < inliers; ++i) {
    scene.correspondences.push_back(
        Make(i + 1, i + 1, locals[i], scene.T_target_local * locals[i] + random.Noise(noise_m)));
  }
  for (SegmentId i = 0; i < outliers; ++i) {
    const std::size_t local = random.Below(locals.size());
    const Eigen::Vector3d somewhere =
        scene.T_target_local.translation() +
        Eigen::Vector3d(150.0 * random.Signed(), 150.0 * random.Signed(), 2.0 * random.Signed());
    scene.correspondences.push_back(Make(static_cast<SegmentId>(local + 1), 1000 + i, locals[local], somewhere));
  }
  std::shuffle(scene.correspondences.begin(), scene.correspondences.end(), random.engine());
  return scene;
}

double AngleBetween(const Pose& a, const Pose& b) {
  return Eigen::AngleAxisd(a.linear().transpose() * b.linear()).angle();
}

std::vector<std::pair<SegmentKey, SegmentKey>> KeysOf(const Recognition& recognition) {
  std::vector<std::pair<SegmentKey, SegmentKey>> keys;
  for (const Correspondence& c : recognition.inliers) keys.emplace_back(c.local, c.target);
  return keys;
}

TEST(Recognizer, FindsThePoseAmongFalseMatches) {
  std::size_t bent = 0;  // by a false match near the mirror image of the true one, for centroids lie nearly in a plane
  for (unsigned seed = 0; seed < 1000; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    Random random(seed);
    const std::size_t inliers = 8 + random.Below(20);
    const Scene scene = RandomScene(random, inliers, 300, 0.03, 0.05 * random.Unit());
    const RecognizerResult result = Recognizer(RecognizerParameters()).Recognize(scene.correspondences);
    if (result.outcome == RecognitionOutcome::kLargeResidual && result.clique_size > inliers) {
      ++bent;
      continue;
    }
    ASSERT_EQ(result.outcome, RecognitionOutcome::kAccepted);
    const Recognition& recognition = *result.recognition;
    EXPECT_GE(recognition.inliers.size(), inliers);
    EXPECT_EQ(recognition.inliers.size(), result.clique_size);
    EXPECT_TRUE(recognition.proven_maximum);
    EXPECT_EQ(recognition.max_inliers, recognition.inliers.size());
    EXPECT_LT(AngleBetween(recognition.T_target_local, scene.T_target_local), 0.02);
    EXPECT_LT((recognition.T_target_local.translation() - scene.T_target_local.translation()).norm(), 0.3);
    EXPECT_LT(recognition.rms_m, 0.3);
    EXPECT_LT(recognition.runner_up_size, recognition.inliers.size());
  }
  EXPECT_LE(bent, 2u);
}

TEST(Recognizer, IsEquivariant) {
  for (unsigned seed = 0; seed < 1000; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    Random random(seed);
    const Scene scene = RandomScene(random, 6 + random.Below(15), 150, 0.03, 0.01);
    const double far_m = seed % 3 == 0 ? 1e5 : 200.0;
    const Pose T_new_target =
        TurnAndTilt(6.3 * random.Unit(), seed % 2 == 0 ? 0.0 : 0.03 * random.Unit(), 6.3 * random.Unit(),
                    {far_m * random.Signed(), far_m * random.Signed(), 20.0});
    Correspondences moved = scene.correspondences;
    for (Correspondence& c : moved) c.centroid_target = T_new_target * c.centroid_target;

    // Without the limit on heights, which a tilt may push a false pair over.
    RecognizerParameters parameters;
    if (seed % 2 != 0) parameters.consistency.max_vertical_slope = std::numeric_limits<double>::infinity();
    const RecognizerResult before = Recognizer(parameters).Recognize(scene.correspondences);
    const RecognizerResult after = Recognizer(parameters).Recognize(moved);
    ASSERT_EQ(before.outcome, RecognitionOutcome::kAccepted);
    ASSERT_EQ(after.outcome, RecognitionOutcome::kAccepted);
    EXPECT_EQ(before.edges, after.edges);
    EXPECT_EQ(KeysOf(*before.recognition), KeysOf(*after.recognition));
    EXPECT_NEAR(before.recognition->rms_m, after.recognition->rms_m, 1e-8);
    const Pose expected = T_new_target * before.recognition->T_target_local;
    EXPECT_LT(AngleBetween(expected, after.recognition->T_target_local), 1e-6);
    EXPECT_LT((expected * Eigen::Vector3d(10.0, 5.0, 0.0) -
               after.recognition->T_target_local * Eigen::Vector3d(10.0, 5.0, 0.0))
                  .norm(),
              1e-6);
  }
}

void ExpectEqual(const RecognizerResult& a, const RecognizerResult& b) {
  ASSERT_EQ(a.outcome, b.outcome);
  EXPECT_EQ(a.edges, b.edges);
  EXPECT_EQ(a.clique_size, b.clique_size);
  ASSERT_EQ(a.recognition.has_value(), b.recognition.has_value());
  if (!a.recognition) return;
  EXPECT_EQ(KeysOf(*a.recognition), KeysOf(*b.recognition));
  EXPECT_EQ(a.recognition->T_target_local.matrix(), b.recognition->T_target_local.matrix());
  EXPECT_EQ(a.recognition->covariance, b.recognition->covariance);
  EXPECT_EQ(a.recognition->runner_up_size, b.recognition->runner_up_size);
}

TEST(Recognizer, IsIndependentOfTheOrderOfTheInputTiesIncluded) {
  for (unsigned seed = 0; seed < 1000; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    Random random(seed);
    Scene scene = RandomScene(random, 8, 100, 0.05, 0.0);
    // Some segments stand twice in the target map, some exactly at the same place: several maximum cliques.
    const Correspondences originals = scene.correspondences;
    for (const Correspondence& c : originals) {
      if (c.target.id > 8 || random.Unit() < 0.4) continue;
      const Eigen::Vector3d offset = random.Unit() < 0.5 ? Eigen::Vector3d::Zero() : random.Noise(0.02);
      scene.correspondences.push_back(
          Make(c.local.id, 500 + c.target.id, c.centroid_local, c.centroid_target + offset));
    }
    const RecognizerResult first = Recognizer(RecognizerParameters()).Recognize(scene.correspondences);
    ASSERT_TRUE(first.recognition.has_value());
    for (int repetition = 0; repetition < 3; ++repetition) {
      std::shuffle(scene.correspondences.begin(), scene.correspondences.end(), random.engine());
      ExpectEqual(first, Recognizer(RecognizerParameters()).Recognize(scene.correspondences));
    }
  }
}

TEST(Recognizer, PrefersTheSmallerResidualThenTheSmallerKeys) {
  Random random(1);
  Correspondences correspondences;
  for (SegmentId i = 1; i <= 7; ++i) {
    const Eigen::Vector3d p = LocalPoint(random);
    correspondences.push_back(Make(i, 10 + i, p, p));
    if (i == 3) correspondences.push_back(Make(i, 1, p, p + Eigen::Vector3d(0.1, 0.0, 0.0)));  // smaller key, worse
    if (i == 5) correspondences.push_back(Make(i, 2, p, p));                                   // smaller key, as good
  }
  const RecognizerResult result = Recognizer(RecognizerParameters()).Recognize(correspondences);
  ASSERT_TRUE(result.recognition.has_value());
  std::vector<SegmentId> targets;
  for (const Correspondence& c : result.recognition->inliers) targets.push_back(c.target.id);
  EXPECT_EQ(targets, (std::vector<SegmentId>{11, 12, 13, 14, 2, 16, 17}));
}

// Two candidates that mirror each other fit equally well; rounding, which a turned map changes, must not choose.
TEST(Recognizer, ExactTiesAreNotDecidedByRounding) {
  for (unsigned seed = 0; seed < 1000; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    Random random(seed);
    const Pose T = TurnAndTilt(6.3 * random.Unit(), 0.0, 0.0, {900.0 * random.Signed(), 900.0 * random.Signed(), 0.0});
    Correspondences correspondences;
    SegmentId id = 1;
    for (const double x : {-20.0, 3.0, 30.0}) {
      for (const double y : {-15.0, 15.0}) {
        const Eigen::Vector3d p(x, y, 0.0);
        correspondences.push_back(Make(id, 10 + id, p, T * p));
        ++id;
      }
    }
    const Eigen::Vector3d p(11.0, 0.0, 0.0);
    correspondences.push_back(Make(id, seed % 2 == 0 ? 1 : 2, p, T * Eigen::Vector3d(11.0, 0.1, 0.0)));
    correspondences.push_back(Make(id, seed % 2 == 0 ? 2 : 1, p, T * Eigen::Vector3d(11.0, -0.1, 0.0)));
    const RecognizerResult result = Recognizer(RecognizerParameters()).Recognize(correspondences);
    ASSERT_TRUE(result.recognition.has_value());
    EXPECT_EQ(result.recognition->inliers.back().target.id, 1u);
  }
}

TEST(Recognizer, EveryMethodGivesTheSameRecognition) {
  for (unsigned seed = 0; seed < 1000; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    Random random(seed);
    const Scene scene = RandomScene(random, 10, 200, 0.03, 0.02);
    RecognizerParameters parameters;
    const RecognizerResult expected = Recognizer(parameters).Recognize(scene.correspondences);
    for (const auto method : {ConsistencyMethod::kAllPairs, ConsistencyMethod::kPartitioned3D,
                              ConsistencyMethod::kCached, ConsistencyMethod::kAuto}) {
      parameters.consistency.method = method;
      Recognizer recognizer(parameters);
      for (int call = 0; call < 6; ++call) ExpectEqual(expected, recognizer.Recognize(scene.correspondences));
    }
  }
}

// The oracle searches all consistent pairs, where the recognizer looks at those only that enough others support.
TEST(Recognizer, SizesAreThoseOfTheWholeGraph) {
  std::size_t small_winners = 0, rivals = 0;
  for (unsigned seed = 0; seed < 1000; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    Random random(seed);
    Scene scene = RandomScene(random, 5 + random.Below(8), 150, 0.05, 0.0);
    const double again = random.Unit();  // of the true objects these stand elsewhere once more, in the same way
    for (Correspondence c : Correspondences(scene.correspondences)) {
      if (c.target.id >= 1000 || random.Unit() > again) continue;
      c.target.id += 500;
      c.centroid_target += Eigen::Vector3d(90.0, 40.0, 0.0);
      scene.correspondences.push_back(c);
    }
    RecognizerParameters parameters;
    parameters.clique.max_work = parameters.clique.max_tie_work = std::uint64_t{1} << 60;
    parameters.clique.deadline = std::chrono::seconds(1000);
    const RecognizerResult result = Recognizer(parameters).Recognize(scene.correspondences);
    const auto largest = [&](const Correspondences& c, std::size_t min_size) {
      MaxCliqueParameters clique = parameters.clique;
      clique.min_size = min_size;
      return FindMaxClique(ConsistencyGraphBuilder(parameters.consistency).Build(c), clique).vertices.size();
    };
    EXPECT_EQ(result.clique_size, largest(scene.correspondences, parameters.clique.min_size));
    if (!result.recognition) continue;
    const Recognition& winner = *result.recognition;
    Correspondences others;
    for (const Correspondence& c : scene.correspondences) {
      const bool fits =
          (winner.T_target_local * c.centroid_local - c.centroid_target).norm() <= parameters.same_place_m;
      const bool is_inlier = std::any_of(winner.inliers.begin(), winner.inliers.end(), [&](const Correspondence& i) {
        return i.local == c.local && i.target == c.target;
      });
      if (!fits && !is_inlier) others.push_back(c);
    }
    const std::size_t least = std::max<std::size_t>(3, (winner.inliers.size() + 1) / 2);
    EXPECT_EQ(winner.runner_up_size, largest(others, least));
    small_winners += least < parameters.clique.min_size && winner.runner_up_size > 0 ? 1 : 0;
    rivals += least >= parameters.clique.min_size && winner.runner_up_size > 0 ? 1 : 0;
  }
  EXPECT_GT(small_winners, 50u);
  EXPECT_GT(rivals, 10u);
}

// A street seen in a mirror: all distances agree, and with centroids near a plane a roll of 180 degrees fits well.
TEST(Recognizer, RefusesMirroredSets) {
  for (unsigned seed = 0; seed < 1000; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    Random random(seed);
    const Pose T = TurnAndTilt(6.3 * random.Unit(), 0.0, 0.0, {30.0, -20.0, 1.0});
    const double height_m = seed % 2 == 0 ? 0.1 : 2.0;
    Correspondences correspondences;
    for (SegmentId i = 1; i <= 12; ++i) {
      const Eigen::Vector3d p(40.0 * random.Signed(), 40.0 * random.Signed(), height_m * random.Signed());
      correspondences.push_back(Make(i, i, p, T * Eigen::Vector3d(p.x(), -p.y(), p.z())));
    }
    RecognizerParameters parameters;
    EXPECT_FALSE(Recognizer(parameters).Recognize(correspondences).recognition.has_value());
    parameters.consistency.max_vertical_slope = std::numeric_limits<double>::infinity();
    const RecognizerResult result = Recognizer(parameters).Recognize(correspondences);
    EXPECT_EQ(result.clique_size, 12u);
    EXPECT_EQ(result.outcome, RecognitionOutcome::kTilted);
  }
}

TEST(Recognizer, RefusesTiltsBeyondTheLimit) {
  Random random(4);
  const Pose T = TurnAndTilt(1.0, 0.3, 0.5, {1.0, 2.0, 3.0});
  Correspondences correspondences;
  for (SegmentId i = 1; i <= 12; ++i) {
    const Eigen::Vector3d p = LocalPoint(random);
    correspondences.push_back(Make(i, i, p, T * p));
  }
  RecognizerParameters parameters;
  parameters.consistency.max_vertical_slope = 1.0;
  EXPECT_EQ(Recognizer(parameters).Recognize(correspondences).outcome, RecognitionOutcome::kTilted);
  parameters.max_tilt_rad = 0.31;
  const RecognizerResult result = Recognizer(parameters).Recognize(correspondences);
  ASSERT_EQ(result.outcome, RecognitionOutcome::kAccepted);
  EXPECT_NEAR(result.recognition->tilt_rad, 0.3, 1e-9);
}

TEST(Recognizer, RefusesCollinearSets) {
  for (unsigned seed = 0; seed < 1000; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    Random random(seed);
    const Pose T = TurnAndTilt(6.3 * random.Unit(), 0.0, 0.0, {10.0, 0.0, 0.0});
    const double width_m = seed % 2 == 0 ? 0.0 : 0.3;
    Correspondences correspondences;
    for (SegmentId i = 1; i <= 10; ++i) {
      const Eigen::Vector3d p(5.0 * i, width_m * random.Signed(), width_m * random.Signed());
      correspondences.push_back(Make(i, i, p, T * p));
    }
    EXPECT_EQ(Recognizer(RecognizerParameters()).Recognize(correspondences).outcome, RecognitionOutcome::kDegenerate);
  }
}

TEST(Recognizer, RefusesLargeResiduals) {
  Random random(5);
  Correspondences correspondences;
  for (SegmentId i = 1; i <= 12; ++i) {
    const Eigen::Vector3d p = LocalPoint(random);
    correspondences.push_back(Make(i, i, p, p + random.Noise(0.1)));
  }
  RecognizerParameters parameters;
  parameters.consistency.epsilon_m = 2.0;
  EXPECT_EQ(Recognizer(parameters).Recognize(correspondences).outcome, RecognitionOutcome::kAccepted);
  parameters.max_rms_m = 0.05;
  EXPECT_EQ(Recognizer(parameters).Recognize(correspondences).outcome, RecognitionOutcome::kLargeResidual);
}

TEST(Recognizer, SaysWhyThereIsNone) {
  Recognizer recognizer{RecognizerParameters()};
  EXPECT_EQ(recognizer.Recognize({}).outcome, RecognitionOutcome::kTooFewCandidates);
  Correspondences apart;
  for (SegmentId i = 1; i <= 10; ++i) apart.push_back(Make(i, i, {1.0 * i, 0.0, 0.0}, {0.0, 100.0 * i, 0.0}));
  EXPECT_EQ(recognizer.Recognize(apart).outcome, RecognitionOutcome::kCliqueTooSmall);
}

TEST(Recognizer, ReportsTheRunnerUp) {
  // The same pattern of ten objects stands in the target map twice; one of the second is missing.
  Random random(6);
  Correspondences correspondences;
  for (SegmentId i = 1; i <= 10; ++i) {
    const Eigen::Vector3d p = LocalPoint(random);
    correspondences.push_back(Make(i, i, p, p));
    if (i < 10) correspondences.push_back(Make(i, 100 + i, p, p + Eigen::Vector3d(500.0, 0.0, 0.0)));
  }
  RecognizerParameters parameters;
  const RecognizerResult result = Recognizer(parameters).Recognize(correspondences);
  ASSERT_TRUE(result.recognition.has_value());
  EXPECT_EQ(result.recognition->inliers.size(), 10u);
  EXPECT_EQ(result.recognition->runner_up_size, 9u);

  // Further sightings of the winner's own objects, as another visit left them, are no rivals.
  Correspondences seen_twice;
  for (const Correspondence& c : correspondences) {
    if (c.target.id > 100) continue;
    seen_twice.push_back(c);
    seen_twice.push_back(Make(c.local.id, 200 + c.target.id, c.centroid_local, c.centroid_target + random.Noise(0.05)));
  }
  const RecognizerResult alone = Recognizer(parameters).Recognize(seen_twice);
  ASSERT_TRUE(alone.recognition.has_value());
  EXPECT_EQ(alone.recognition->runner_up_size, 0u);
  parameters.same_place_m = 0.0;
  EXPECT_GE(Recognizer(parameters).Recognize(seen_twice).recognition->runner_up_size, 8u);

  parameters.find_runner_up = false;
  EXPECT_EQ(Recognizer(parameters).Recognize(correspondences).recognition->runner_up_size, 0u);
}

// The covariance against the scatter of many fits, moved as the perturbation on the left says.
TEST(Recognizer, CovarianceIsTheScatterOfTheFit) {
  Random random(7);
  const double sigma_m = 0.1;
  const Pose T = TurnAndTilt(0.7, 0.02, 1.0, {120.0, -80.0, 5.0});
  std::vector<Eigen::Vector3d> locals;
  for (int i = 0; i < 12; ++i) locals.push_back(LocalPoint(random) + Eigen::Vector3d(30.0, 10.0, 0.0));
  Covariance6 scatter = Covariance6::Zero();
  Covariance6 stated = Covariance6::Zero();
  constexpr int kTrials = 4000;
  RecognizerParameters parameters;
  parameters.consistency.epsilon_m = 5.0;
  parameters.min_sigma_m = 1e-6;
  parameters.find_runner_up = false;
  Recognizer recognizer(parameters);
  for (int trial = 0; trial < kTrials; ++trial) {
    Correspondences correspondences;
    for (SegmentId i = 0; i < locals.size(); ++i) {
      correspondences.push_back(Make(i + 1, i + 1, locals[i], T * locals[i] + random.Noise(sigma_m)));
    }
    const RecognizerResult result = recognizer.Recognize(correspondences);
    ASSERT_TRUE(result.recognition.has_value());
    ASSERT_EQ(result.recognition->inliers.size(), locals.size());
    const Pose error = result.recognition->T_target_local * T.inverse();  // exp(xi)
    const Eigen::AngleAxisd turn(error.linear());
    Eigen::Matrix<double, 6, 1> xi;
    xi << error.translation(), turn.angle() * turn.axis();
    scatter += xi * xi.transpose() / kTrials;
    stated += result.recognition->covariance / kTrials;
  }
  // Whitened by the stated covariance the scatter is the identity, up to sampling.
  const Covariance6 factor = stated.llt().matrixL();
  const Covariance6 whitened = factor.inverse() * scatter * factor.inverse().transpose();
  EXPECT_LT((whitened - Covariance6::Identity()).cwiseAbs().maxCoeff(), 0.12) << whitened;
}

TEST(Recognizer, CovarianceHasAFloor) {
  Random random(8);
  Correspondences correspondences;
  for (SegmentId i = 1; i <= 10; ++i) {
    const Eigen::Vector3d p = LocalPoint(random);
    correspondences.push_back(Make(i, i, p, p));
  }
  RecognizerParameters parameters;
  const RecognizerResult result = Recognizer(parameters).Recognize(correspondences);
  ASSERT_TRUE(result.recognition.has_value());
  const double floor = parameters.min_sigma_m * parameters.min_sigma_m / 10.0;
  for (int i = 0; i < 3; ++i) EXPECT_GE(result.recognition->covariance(i, i), 0.999 * floor);
}

TEST(Recognizer, RefusesBadParameters) {
  const auto refused = [](auto change) {
    RecognizerParameters parameters;
    change(parameters);
    EXPECT_THROW(Recognizer{parameters}, std::invalid_argument);
  };
  refused([](RecognizerParameters& p) { p.consistency.epsilon_m = 0.0; });
  refused([](RecognizerParameters& p) { p.consistency.max_vertical_slope = 0.05; });
  refused([](RecognizerParameters& p) { p.clique.min_size = 2; });
  refused([](RecognizerParameters& p) { p.clique.max_ties = 0; });
  refused([](RecognizerParameters& p) { p.max_tilt_rad = -0.1; });
  refused([](RecognizerParameters& p) { p.max_rms_m = 0.0; });
  refused([](RecognizerParameters& p) { p.min_spread_m = 0.0; });
  refused([](RecognizerParameters& p) { p.min_sigma_m = 0.0; });
  refused([](RecognizerParameters& p) { p.clique.max_work = 0; });
  refused([](RecognizerParameters& p) { p.clique.deadline = std::chrono::microseconds(0); });
}

}  // namespace
}  // namespace incremental_segmatch
