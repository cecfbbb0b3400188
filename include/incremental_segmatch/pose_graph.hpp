/// \file
/// SE(3) pose graph: odometry and loop closures in, corrected trajectory out. Own library target (Ceres inside, no ROS).
#pragma once

#include <cstddef>
#include <memory>
#include <vector>

#include "incremental_segmatch/types.hpp"

namespace incremental_segmatch {

struct PoseGraphParameters {
  double odometry_sigma_m = 0.05;            ///< per metre travelled, and at least per node
  double odometry_sigma_rad = 0.005;         ///< per metre travelled, and at least per node
  double min_closure_sigma_m = 0.05;         ///< floor of a closure's translation sigma
  double min_closure_sigma_rad = 0.005;      ///< floor of a closure's rotation sigma
  double robust_width = 1.0;                 ///< of the Cauchy loss on closures, in sigmas
  int max_iterations = 50;
};

/// One robot's trajectory (several robots: several trajectories in one graph, see AddNode).
class PoseGraph {
 public:
  explicit PoseGraph(const PoseGraphParameters& parameters);
  ~PoseGraph();
  PoseGraph(PoseGraph&&) noexcept;
  PoseGraph& operator=(PoseGraph&&) noexcept;

  /// Appends a pose of a robot's odometry; stamps of a robot increase. Throws std::invalid_argument if they do not.
  void AddNode(RobotIndex robot, StampNs stamp_ns, const Pose& T_odom_sensor);

  /// Adds a closure between the nodes with these stamps (nearest node within half a node spacing is taken).
  /// Returns false, and adds nothing, where there is no such node. Covariance: perturbation on the right (target frame to
  /// query frame pose, ROS order x, y, z, rx, ry, rz).
  bool AddClosure(RobotIndex robot_target, StampNs stamp_target_ns, RobotIndex robot_query, StampNs stamp_query_ns,
                  const Pose& T_target_query, const Covariance6& covariance);

  /// Optimizes; the first node of the first robot is fixed. Robots without any closure to it keep their odometry.
  void Optimize();

  /// The corrected trajectory T_map_sensor of a robot; nodes added since the last Optimize() follow rigidly.
  std::vector<StampedPose> Trajectory(RobotIndex robot) const;

  /// T_map_odom of the newest node of a robot.
  Pose T_map_odom(RobotIndex robot) const;

  std::size_t closures() const;

 private:
  class Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace incremental_segmatch
