#include "trajectory_error.hpp"

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>

namespace incremental_segmatch {

Pose AlignTrajectory(const std::vector<Pose>& estimate, const std::vector<Pose>& truth) {
  if (estimate.size() != truth.size()) {
    throw std::invalid_argument("the trajectory error needs as many estimated as true poses");
  }
  Eigen::Matrix3Xd from(3, estimate.size()), to(3, truth.size());
  for (std::size_t i = 0; i < truth.size(); ++i) {
    from.col(static_cast<Eigen::Index>(i)) = estimate[i].translation();
    to.col(static_cast<Eigen::Index>(i)) = truth[i].translation();
  }
  return Pose(Eigen::umeyama(from, to, false));
}

double AbsoluteTrajectoryError(const std::vector<Pose>& estimate, const std::vector<Pose>& truth) {
  if (estimate.empty() && truth.empty()) return std::numeric_limits<double>::quiet_NaN();
  const Pose T = AlignTrajectory(estimate, truth);
  double sum_m2 = 0.0;
  for (std::size_t i = 0; i < truth.size(); ++i)
    sum_m2 += (T * estimate[i].translation() - truth[i].translation()).squaredNorm();
  return std::sqrt(sum_m2 / static_cast<double>(truth.size()));
}

std::vector<Pose> PosesOf(const std::vector<StampedPose>& trajectory) {
  std::vector<Pose> poses;
  poses.reserve(trajectory.size());
  for (const StampedPose& pose : trajectory) poses.push_back(pose.T_frame_sensor);
  return poses;
}

std::size_t StepAt(const std::vector<StampedPose>& trajectory, StampNs stamp_ns) {
  const auto it = std::lower_bound(trajectory.begin(), trajectory.end(), stamp_ns,
                                   [](const StampedPose& pose, StampNs stamp) { return pose.stamp_ns < stamp; });
  if (it == trajectory.end() || it->stamp_ns != stamp_ns)
    throw std::invalid_argument("a closure's stamp is no scan's");
  return static_cast<std::size_t>(it - trajectory.begin());
}

std::vector<StampedPose> OptimizeWithTrueClosures(const std::vector<StampNs>& stamps_ns,
                                                  const std::vector<Pose>& T_odom_sensor,
                                                  const std::vector<Pose>& T_world_sensor,
                                                  const std::vector<GraphClosure>& closures,
                                                  const PoseGraphParameters& parameters) {
  PoseGraph graph(parameters);
  for (std::size_t i = 0; i < stamps_ns.size(); ++i) graph.AddNode(0, stamps_ns[i], T_odom_sensor[i]);
  for (const GraphClosure& closure : closures) {
    graph.AddClosure(0, stamps_ns[closure.target_step], 0, stamps_ns[closure.query_step],
                     T_world_sensor[closure.target_step].inverse() * T_world_sensor[closure.query_step],
                     closure.covariance);
  }
  graph.Optimize();
  return graph.Trajectory(0);
}

}  // namespace incremental_segmatch
