/// \file
/// Refines a recognition on the points of its matched segments (METHOD 5, beyond).
#pragma once

#include <optional>
#include <utility>
#include <vector>

#include "incremental_segmatch/types.hpp"

namespace incremental_segmatch {

struct RefinementParameters {
  bool enabled = true;
  double max_distance_m = 1.0;       ///< of a point to its partner, in the first iteration
  double min_distance_m = 0.3;       ///< in the last one
  int max_iterations = 20;
  double min_overlap = 0.3;          ///< share of the local points with a partner in the last iteration; less refuses the recognition
};

struct RefinedTransform {
  Pose T_target_local = Pose::Identity();
  double overlap = 0.0;              ///< share of the local points with a partner
  double rms_m = 0.0;                ///< point-to-plane residual
  Covariance6 covariance = Covariance6::Identity();  ///< from the information of the point pairs, perturbation on the left
};

/// Iterative closest points, point to plane where the target has one, over two clouds in their own frames (metres, relative
/// to any origin near them). Nothing if the clouds overlap too little or leave the pose undetermined. O(points * iterations).
std::optional<RefinedTransform> RefineOnPoints(const std::vector<Eigen::Vector3d>& points_local,
                                               const std::vector<Eigen::Vector3d>& points_target,
                                               const Pose& T_target_local, const RefinementParameters& parameters);

}  // namespace incremental_segmatch
