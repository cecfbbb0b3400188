/// \file
/// Correspondences to a recognition with its evidence (METHOD 5; thesis 3.4).
#pragma once

#include <optional>
#include <vector>

#include "incremental_segmatch/consistency_graph.hpp"
#include "incremental_segmatch/max_clique.hpp"

namespace incremental_segmatch {

struct RecognizerParameters {
  ConsistencyParameters consistency;
  MaxCliqueParameters clique;
  double max_tilt_rad = 0.1;           ///< between the two gravity-aligned maps; refuses mirrored fits
  double max_rms_m = 0.4;              ///< residual of the fit over all inliers
  double min_spread_m = 1.0;           ///< second largest standard deviation of the inlier centroids; refuses lines
};

/// Why there was no recognition, or that there was one.
enum class RecognitionOutcome { kAccepted, kTooFewCandidates, kCliqueTooSmall, kDegenerate, kTilted, kLargeResidual };

struct Recognition {
  Pose T_target_local = Pose::Identity();     ///< p_map = T * p_odom, least squares over all inliers (Umeyama, no scale)
  Covariance6 covariance = Covariance6::Identity();  ///< of T_target_local, perturbation on the left: exp(xi) T
  std::vector<Correspondence> inliers;        ///< sorted by (local, target)
  double rms_m = 0.0;                         ///< residual over the inliers
  bool proven_maximum = true;
};

struct RecognizerResult {
  std::optional<Recognition> recognition;
  RecognitionOutcome outcome = RecognitionOutcome::kTooFewCandidates;
  std::size_t candidates = 0;
  std::size_t edges = 0;
  std::uint64_t tested_pairs = 0;
  std::size_t clique_size = 0;                ///< of the best clique found, 0 below the smallest acceptable size
  double graph_ms = 0.0;
  double clique_ms = 0.0;
  double transform_ms = 0.0;
};

/// Maximum geometrically consistent set of the correspondences and its rigid transform. No prior on the pose enters.
/// The result does not depend on the order of the correspondences.
class Recognizer {
 public:
  explicit Recognizer(const RecognizerParameters& parameters);
  RecognizerResult Recognize(const Correspondences& correspondences);

 private:
  RecognizerParameters parameters_;
  ConsistencyGraphBuilder graph_builder_;
};

}  // namespace incremental_segmatch
