/// \file
/// Refines a recognition on the points of both visits (METHOD 5, beyond).
#pragma once

#include <cstddef>
#include <memory>
#include <optional>
#include <vector>

#include "incremental_segmatch/types.hpp"

namespace incremental_segmatch {

/// Of the refinement.
struct RefinementParameters {
  bool enabled = true;          ///< false: the transform over centroids stays
  double max_distance_m = 1.0;  ///< of a point to its partner, in the first iteration
  double min_distance_m = 0.3;  ///< in the last one; also the spacing of the points that the first iterations take
  int max_iterations = 20;      ///< of nearest neighbours and least squares
  double min_overlap =
      0.3;  ///< share of the local points with a partner in the last iteration; less refuses the recognition
  double search_m = 1.5;        ///< so far around, along x and y, a better place to begin is looked for; 0: nowhere
  double search_overlap = 0.9;  ///< where the first attempt ends with less overlap than this
  double normal_radius_m = 0.4;   ///< of the neighbourhood that tells which way a target point's surface faces
  std::size_t max_points = 3000;  ///< local points that are used, spread evenly over the list
  double min_stiffness =
      0.005;  ///< information of a direction over that of the best one, below which the points leave it open
  int max_open_directions = 1;  ///< of six; more refuses the recognition; walls and poles alone leave the height open
  double floor_m = 0.01;        ///< standard deviation per axis of what the points don't tell: the target's own drift
  double floor_rad = 0.0005;    ///< and of the rotation about each axis
};

/// A refined transform with its evidence.
struct RefinedTransform {
  Pose T_target_local = Pose::Identity();  ///< p_map = T * p_odom
  double overlap = 0.0;                    ///< share of the local points with a partner
  std::vector<bool> has_partner;           ///< of each local point that was used: the same ones for every target
  double rms_m = 0.0;                      ///< point-to-plane residual
  int open_directions = 0;  ///< directions of six in which the points say nothing and the given pose stays
  /// From the information of the point pairs (points of one cell of min_distance_m count as one), ROS's order,
  /// perturbation on the left: T_true = exp(xi) T in the axes and about the origin of the target's frame. Open
  /// directions have a standard deviation of max_distance_m / 2 at the points. The floors are part of it.
  Covariance6 covariance = Covariance6::Identity();
};

/// A cloud that others are laid on, prepared once for many of them.
///
/// Iterative closest points over two clouds in their own frames (metres, relative to any origin): robustly weighted
/// Gauss-Newton on distances across what is thin about a target point (a surface, a pole), or to the point itself where
/// nothing is. Where that ends with little overlap, places around are tried: what begins too far away may come to rest in a
/// wrong minimum. Deterministic; points that are not finite are ignored. Not thread-safe.
class RefinementTarget {
 public:
  /// Throws std::invalid_argument naming the parameter that is out of range. O(points).
  RefinementTarget(const std::vector<Eigen::Vector3d>& points_target, const RefinementParameters& parameters);
  ~RefinementTarget();
  RefinementTarget(RefinementTarget&&) noexcept;             ///< what was moved from can only be assigned to or destroyed
  RefinementTarget& operator=(RefinementTarget&&) noexcept;  ///< likewise

  /// Nothing if the clouds overlap too little or leave more directions of the pose open than allowed.
  /// O(points + max_points * iterations).
  std::optional<RefinedTransform> Refine(const std::vector<Eigen::Vector3d>& points_local, const Pose& T_target_local);

  /// Share of the local points that Refine would use which have a partner under a given transform. O(points).
  double Overlap(const std::vector<Eigen::Vector3d>& points_local, const Pose& T_target_local) const;

  /// Memory held. O(1).
  std::size_t memory_bytes() const;

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

/// Throws std::invalid_argument naming the parameter that is out of range.
void Validate(const RefinementParameters& parameters);

}  // namespace incremental_segmatch
