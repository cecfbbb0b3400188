/// \file
/// SE(3) pose graph: odometry and loop closures in, corrected trajectory out. Own library target (Ceres inside, no
/// ROS).
#pragma once

#include <cstddef>
#include <memory>
#include <vector>

#include "incremental_segmatch/types.hpp"

namespace incremental_segmatch {

/// Noise model and solver settings of a PoseGraph.
struct PoseGraphParameters {
  double odometry_sigma_m = 0.05;        ///< after one metre of travel; grows with the square root of the distance
  double odometry_sigma_rad = 0.005;     ///< after one metre of travel; grows with the square root of the distance
  double min_odometry_distance_m = 0.1;  ///< an odometry edge counts as at least this long (a standing robot)
  double min_closure_sigma_m = 0.05;     ///< added in quadrature to a closure's translation sigmas
  double min_closure_sigma_rad = 0.005;  ///< added in quadrature to a closure's rotation sigmas
  double robust_width = 1.0;             ///< of the Cauchy loss on closures, in sigmas
  int max_iterations = 50;               ///< of one solver run; an optimization is one to a few of them
};

/// A pose of the graph.
struct PoseGraphNode {
  RobotIndex robot = 0;                   ///< whose pose it is
  StampNs stamp_ns = 0;                   ///< of the pose
  Pose T_odom_sensor = Pose::Identity();  ///< as added
  Pose T_map_sensor = Pose::Identity();   ///< as estimated
};

/// A measurement between two nodes, named by their positions in PoseGraph::Nodes().
struct PoseGraphEdge {
  std::size_t from = 0;                              ///< node; of a closure, the target
  std::size_t to = 0;                                ///< node; of a closure, the query
  Pose T_from_to = Pose::Identity();                 ///< as measured
  Covariance6 covariance = Covariance6::Identity();  ///< T_from_to * exp(xi), order x, y, z, rx, ry, rz
  bool is_closure = false;                           ///< false: odometry
};

/// What an optimization did.
struct PoseGraphReport {
  std::size_t nodes = 0;              ///< poses of all robots
  std::size_t closures = 0;           ///< in the graph
  std::size_t outvoted_closures = 0;  ///< closures that end more than three sigmas away and so weigh next to nothing
  int iterations = 0;                 ///< of all solver runs together
  double initial_cost = 0.0;          ///< before, half the sum of squared and robustified residuals in sigmas
  double final_cost = 0.0;            ///< after
  bool converged = true;  ///< false if the last solver run stopped at its iteration limit; the result is usable
};

/// Trajectories of one or several robots, held together by odometry (Gaussian) and loop closures (Cauchy loss, so that
/// a false closure is outvoted). A robot is aligned with the map of an earlier one by its first closure to it. An
/// outlier among the first closures between two robots is undone once more closures agree on another alignment.
///
/// Synchronous and deterministic. Not thread-safe: const functions may run in parallel with each other, but with no
/// other function. Different graphs are independent.
class PoseGraph {
 public:
  /// Throws std::invalid_argument naming a parameter that is not positive.
  explicit PoseGraph(const PoseGraphParameters& parameters);
  ~PoseGraph();
  /// Moves; what was moved from can only be assigned to or destroyed.
  PoseGraph(PoseGraph&&) noexcept;
  /// Moves likewise.
  PoseGraph& operator=(PoseGraph&&) noexcept;

  /// Appends a pose of a robot's odometry; stamps of a robot increase. A new robot's map is its odometry frame until a
  /// closure connects it. Throws std::invalid_argument if a stamp does not increase or the pose is not finite.
  void AddNode(RobotIndex robot, StampNs stamp_ns, const Pose& T_odom_sensor);

  /// Adds a closure between the nodes with these stamps (the nearest node within half a node spacing is taken).
  /// Returns false, and adds nothing, where there is no such node, or where both are the same node. Covariance:
  /// perturbation on the right, T_target_query * exp(xi), that is in the query's sensor frame; ROS order x, y, z, rx,
  /// ry, rz. Throws std::invalid_argument if pose or covariance are not finite or the covariance has a negative
  /// eigenvalue. O(log nodes), but for the closure that aligns a robot: O(nodes of that robot).
  bool AddClosure(RobotIndex robot_target, StampNs stamp_target_ns, RobotIndex robot_query, StampNs stamp_query_ns,
                  const Pose& T_target_query, const Covariance6& covariance);

  /// Optimizes from the current estimate. Of each set of connected robots the first node of the robot that came first
  /// is fixed; robots without any closure keep their odometry.
  PoseGraphReport Optimize();

  /// The corrected trajectory T_map_sensor of a robot; nodes added since the last Optimize() follow rigidly. Empty for
  /// a robot without nodes.
  std::vector<StampedPose> Trajectory(RobotIndex robot) const;

  /// T_map_odom of the newest node of a robot. Throws std::invalid_argument for a robot without nodes.
  Pose T_map_odom(RobotIndex robot) const;

  /// True if both robots' trajectories are in one map: the same robot, or connected by closures.
  bool AreConnected(RobotIndex a, RobotIndex b) const;

  /// Number of closures added.
  std::size_t closures() const;

  /// All nodes in the order in which they were added.
  std::vector<PoseGraphNode> Nodes() const;

  /// All odometry edges, then all closures with the covariances that the optimization uses.
  std::vector<PoseGraphEdge> Edges() const;

 private:
  class Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace incremental_segmatch
