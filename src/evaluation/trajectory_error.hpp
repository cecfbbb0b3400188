/// \file
/// Error of a trajectory, and what a pose graph could reach at best.
#pragma once

#include <vector>

#include "incremental_segmatch/pose_graph.hpp"
#include "incremental_segmatch/types.hpp"

namespace incremental_segmatch {

/// The rigid transform (Umeyama, no scale) that brings the positions of `estimate` nearest to those of `truth`. Both of
/// the same size (else std::invalid_argument) and not empty.
Pose AlignTrajectory(const std::vector<Pose>& estimate, const std::vector<Pose>& truth);

/// Absolute trajectory error: root mean square of the distances between corresponding positions after the rigid
/// alignment (Umeyama, no scale) that makes it least, in metres. Both of the same size (else std::invalid_argument);
/// NaN without poses.
double AbsoluteTrajectoryError(const std::vector<Pose>& estimate, const std::vector<Pose>& truth);

/// Poses without their stamps.
std::vector<Pose> PosesOf(const std::vector<StampedPose>& trajectory);
/// Step of the drive whose scan has a stamp. Throws std::invalid_argument if none has. O(log steps).
std::size_t StepAt(const std::vector<StampedPose>& trajectory, StampNs stamp_ns);

/// A closure that went into the graph, by steps of the drive.
struct GraphClosure {
  std::size_t target_step = 0;
  std::size_t query_step = 0;
  Covariance6 covariance = Covariance6::Zero();  ///< as for PoseGraph::AddClosure
};

/// What the pose graph makes of a drive's odometry when each of these closures is given its true relative pose: a bound
/// that no recognition at the same places beats but by luck.
std::vector<StampedPose> OptimizeWithTrueClosures(const std::vector<StampNs>& stamps_ns,
                                                  const std::vector<Pose>& T_odom_sensor,
                                                  const std::vector<Pose>& T_world_sensor,
                                                  const std::vector<GraphClosure>& closures,
                                                  const PoseGraphParameters& parameters);

}  // namespace incremental_segmatch
