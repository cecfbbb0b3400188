/// \file
/// Correspondences to a recognition with its evidence (METHOD 5; thesis 3.4).
#pragma once

#include <optional>
#include <vector>

#include "incremental_segmatch/consistency_graph.hpp"
#include "incremental_segmatch/max_clique.hpp"

namespace incremental_segmatch {

/// When a set of correspondences is a place.
struct RecognizerParameters {
  ConsistencyParameters consistency;  ///< its max_vertical_slope must be at least max_tilt_rad
  MaxCliqueParameters clique;         ///< of the searches for the largest consistent set and for the best beside it
  double max_tilt_rad = 0.1;          ///< between the two gravity-aligned maps; refuses mirrored fits; 0 to pi
  double max_rms_m = 0.4;             ///< residual of the fit over all inliers, > 0
  double min_spread_m = 1.0;          ///< second largest standard deviation of the inlier centroids; refuses lines; > 0
  double min_sigma_m = 0.05;          ///< floor of a centroid's standard deviation per axis in the covariance, > 0
  bool find_runner_up = true;         ///< also look for the best clique beside the winner: evidence against ambiguity
  double same_place_m = 2.0;          ///< correspondences that fit the winner's transform so well are no rivals of it
};

/// Why there was no recognition, or that there was one.
enum class RecognitionOutcome { kAccepted, kTooFewCandidates, kCliqueTooSmall, kDegenerate, kTilted, kLargeResidual };

/// A place that was recognised, by the centroids of its segments.
struct Recognition {
  Pose T_target_local = Pose::Identity();  ///< p_map = T * p_odom, least squares over all inliers (Umeyama, no scale)
  /// Of T_target_local in ROS's order (x, y, z, rotation about x, y, z, metres and radians), perturbation on the left:
  /// T_true = exp(xi) T, in the axes and about the origin of the target map, to first order (see TransformCovariance).
  Covariance6 covariance = Covariance6::Identity();
  std::vector<Correspondence> inliers;  ///< sorted by (local, target)
  double rms_m = 0.0;                   ///< root mean square distance of the inliers after the fit
  double tilt_rad = 0.0;                ///< angle between the z axes of the two maps
  bool proven_maximum = true;           ///< false if the search for a larger clique was cut short
  std::size_t max_inliers = 0;          ///< no clique is larger than this; inliers.size() if proven
  /// Size of the largest clique that shares no correspondence with the inliers, nor has any that fits their transform:
  /// near inliers.size() means that another place is as likely. 0 if it is smaller than 3 or than half of the inliers,
  /// or not looked for. A lower bound if the search for it was as long as that for the inliers may be.
  std::size_t runner_up_size = 0;
};

/// A recognition, or the stage that ended it, with counts and times.
struct RecognizerResult {
  std::optional<Recognition> recognition;  ///< where the outcome is kAccepted
  std::optional<Recognition>
      runner_up;  ///< the other place that its runner-up speaks for, if that passes the same tests
  RecognitionOutcome outcome = RecognitionOutcome::kTooFewCandidates;  ///< how it ended
  std::size_t candidates = 0;                                          ///< correspondences given
  std::size_t edges = 0;  ///< consistent pairs among those that may be in a set of the smallest acceptable size
  std::uint64_t tested_pairs = 0;  ///< pairs tested for consistency
  std::size_t clique_size = 0;     ///< of the best clique found, 0 below the smallest acceptable size
  double graph_ms = 0.0;           ///< time for the consistency graph (these three: CPU time of the thread)
  double clique_ms = 0.0;          ///< including the search for the runner-up
  double transform_ms = 0.0;       ///< time for the transform and its tests
};

/// Covariance of the least-squares transform of points to `points_target` (the transformed points, target frame) with
/// independent errors of `sigma_m` per axis: sigma^2 (J^T J)^-1, J the Jacobian of the residuals by the perturbation on
/// the left, exp(xi) T, xi = (translation, rotation). Computed about the points' centroid, where the two parts are
/// uncorrelated, and carried to the frame's origin; far from it the translation inherits the rotation's uncertainty
/// times the lever arm. The points must not be collinear.
Covariance6 TransformCovariance(const std::vector<Eigen::Vector3d>& points_target, double sigma_m);

/// Standard deviation per axis of a centroid's error, from the residual of a rigid fit, which took six degrees of
/// freedom; at least min_sigma_m.
double CentroidSigma(double rms_m, std::size_t inliers, double min_sigma_m);

/// Maximum geometrically consistent set of the correspondences and its rigid transform. No prior on the pose enters.
/// The result does not depend on the order of the correspondences, which are sorted by their keys first; of several
/// maximum sets the one with the smaller residual (to the micrometre) wins, then the smallest list of keys.
/// Not thread-safe (the cached graph has state); one recognizer per robot and thread.
class Recognizer {
 public:
  /// Throws std::invalid_argument naming the parameter that is out of range.
  explicit Recognizer(const RecognizerParameters& parameters);
  /// The best supported transform. Independent of the order of the correspondences.
  RecognizerResult Recognize(const Correspondences& correspondences);

 private:
  RecognitionOutcome FitAndTest(const Correspondences& sorted, const std::vector<std::uint32_t>& clique,
                                Recognition* recognition) const;

  RecognizerParameters parameters_;
  ConsistencyGraphBuilder graph_builder_;
};

}  // namespace incremental_segmatch
