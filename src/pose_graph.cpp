#include "incremental_segmatch/pose_graph.hpp"

#include <ceres/ceres.h>
#include <ceres/rotation.h>
#include <ceres/version.h>

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>
#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <map>
#include <numeric>
#include <optional>
#include <stdexcept>
#include <string>

namespace incremental_segmatch {
namespace {

using Matrix6 = Eigen::Matrix<double, 6, 6>;
using Vector6 = Eigen::Matrix<double, 6, 1>;

constexpr double kOutlierSigmas = 3.0;     // mean deviation per axis from which a closure counts as outvoted
constexpr double kCoarseTolerance = 1e-2;  // relative change of cost at which an intermediate solver run ends
constexpr double kFinalTolerance = 1e-6;   // and at which the final one ends
constexpr double kAnnealingFactor = 5.0;   // between the widths of two solver runs of a graduated optimization

// Translation and unit quaternion (Eigen's order x, y, z, w) as Ceres's parameter blocks.
struct Variables {
  std::array<double, 3> t{};
  std::array<double, 4> q{};

  Variables() = default;
  explicit Variables(const Pose& T) {
    Eigen::Map<Eigen::Vector3d>(t.data()) = T.translation();
    Eigen::Map<Eigen::Quaterniond>(q.data()) = Eigen::Quaterniond(T.linear()).normalized();
  }
  Pose ToPose() const {
    Pose T = Pose::Identity();
    T.linear() = Eigen::Map<const Eigen::Quaterniond>(q.data()).normalized().toRotationMatrix();
    T.translation() = Eigen::Map<const Eigen::Vector3d>(t.data());
    return T;
  }
};

// Residual sqrt_information * xi, where T_from^-1 T_to = T_from_to exp(xi), translation and rotation vector apart.
class BetweenFactor {
 public:
  BetweenFactor(const Pose& T_from_to, const Covariance6& covariance)
      : t_(T_from_to.translation()), q_(Eigen::Quaterniond(T_from_to.linear()).normalized()) {
    // covariance = L L^T, so L^-1 whitens.
    sqrt_information_ = covariance.llt().matrixL().solve(Matrix6::Identity());
  }

  template <typename T>
  bool operator()(const T* t_from, const T* q_from, const T* t_to, const T* q_to, T* residual) const {
    const Eigen::Quaternion<T> from = Eigen::Map<const Eigen::Quaternion<T>>(q_from);
    const Eigen::Quaternion<T> to = Eigen::Map<const Eigen::Quaternion<T>>(q_to);
    const Eigen::Matrix<T, 3, 1> difference =
        Eigen::Map<const Eigen::Matrix<T, 3, 1>>(t_to) - Eigen::Map<const Eigen::Matrix<T, 3, 1>>(t_from);
    const Eigen::Matrix<T, 3, 1> translation =
        q_.conjugate().template cast<T>() * (from.conjugate() * difference - t_.template cast<T>());
    const Eigen::Quaternion<T> rotation = q_.conjugate().template cast<T>() * (from.conjugate() * to);
    const T wxyz[4] = {rotation.w(), rotation.x(), rotation.y(), rotation.z()};
    Eigen::Matrix<T, 6, 1> xi;
    xi.template head<3>() = translation;
    T angle_axis[3];
    ceres::QuaternionToAngleAxis(wxyz, angle_axis);
    xi.template tail<3>() = Eigen::Map<const Eigen::Matrix<T, 3, 1>>(angle_axis);
    Eigen::Map<Eigen::Matrix<T, 6, 1>>(residual, 6) = sqrt_information_.template cast<T>() * xi;
    return true;
  }

  static ceres::CostFunction* Create(const Pose& T_from_to, const Covariance6& covariance) {
    return new ceres::AutoDiffCostFunction<BetweenFactor, 6, 3, 4, 3, 4>(new BetweenFactor(T_from_to, covariance));
  }

 private:
  Eigen::Vector3d t_;
  Eigen::Quaterniond q_;
  Matrix6 sqrt_information_;
};

void AddRotationBlock(ceres::Problem& problem, double* q) {
#if CERES_VERSION_MAJOR > 2 || (CERES_VERSION_MAJOR == 2 && CERES_VERSION_MINOR >= 1)
  problem.AddParameterBlock(q, 4, new ceres::EigenQuaternionManifold);
#else
  problem.AddParameterBlock(q, 4, new ceres::EigenQuaternionParameterization);
#endif
}

void RequirePositive(double value, const char* name) {
  if (!(value > 0.0) || !std::isfinite(value)) {
    throw std::invalid_argument(std::string("pose_graph.") + name + " is " + std::to_string(value) +
                                "; it must be positive and finite");
  }
}

bool IsFinite(const Pose& T) {
  return T.matrix().allFinite();
}

// Distance of two poses in whitened coordinates: root of the mean square per axis.
double Deviation(const Pose& T_from, const Pose& T_to, const PoseGraphEdge& edge) {
  const Pose error = edge.T_from_to.inverse() * T_from.inverse() * T_to;
  const Eigen::AngleAxisd rotation(error.linear());
  Vector6 xi;
  xi << error.translation(), rotation.angle() * rotation.axis();
  return std::sqrt(xi.dot(edge.covariance.llt().solve(xi)) / 6.0);
}

}  // namespace

class PoseGraph::Impl {
 public:
  explicit Impl(const PoseGraphParameters& parameters) : parameters_(parameters) {
    RequirePositive(parameters.odometry_sigma_m, "odometry_sigma_m");
    RequirePositive(parameters.odometry_sigma_rad, "odometry_sigma_rad");
    RequirePositive(parameters.min_odometry_distance_m, "min_odometry_distance_m");
    RequirePositive(parameters.min_closure_sigma_m, "min_closure_sigma_m");
    RequirePositive(parameters.min_closure_sigma_rad, "min_closure_sigma_rad");
    RequirePositive(parameters.robust_width, "robust_width");
    RequirePositive(parameters.max_iterations, "max_iterations");
  }

  void AddNode(RobotIndex robot, StampNs stamp_ns, const Pose& T_odom_sensor) {
    if (!IsFinite(T_odom_sensor)) throw std::invalid_argument("pose graph: the pose of a node is not finite");
    auto [it, is_new] = robots_.try_emplace(robot);
    Robot& track = it->second;
    if (is_new) {
      track.order = robots_.size() - 1;
      track.map = robot;
    }
    PoseGraphNode node{robot, stamp_ns, T_odom_sensor, T_odom_sensor};
    if (!track.nodes.empty()) {
      const PoseGraphNode& last = nodes_[track.nodes.back()];
      if (stamp_ns <= last.stamp_ns) {
        throw std::invalid_argument("pose graph: stamps of robot " + std::to_string(robot) + " must increase, but " +
                                    std::to_string(stamp_ns) + " ns follows " + std::to_string(last.stamp_ns) +
                                    " ns; start a new graph when a recording starts again");
      }
      const Pose T_last_node = last.T_odom_sensor.inverse() * T_odom_sensor;
      node.T_map_sensor = track.T_map_odom * T_odom_sensor;
      odometry_.push_back({track.nodes.back(), nodes_.size(), T_last_node, OdometryCovariance(T_last_node), false});
    }
    track.nodes.push_back(nodes_.size());
    nodes_.push_back(node);
  }

  bool AddClosure(RobotIndex robot_target, StampNs stamp_target_ns, RobotIndex robot_query, StampNs stamp_query_ns,
                  const Pose& T_target_query, const Covariance6& covariance) {
    if (!IsFinite(T_target_query) || !covariance.allFinite()) {
      throw std::invalid_argument("pose graph: a closure's pose or covariance is not finite");
    }
    Covariance6 padded = 0.5 * (covariance + covariance.transpose());
    padded.diagonal().head<3>().array() += parameters_.min_closure_sigma_m * parameters_.min_closure_sigma_m;
    padded.diagonal().tail<3>().array() += parameters_.min_closure_sigma_rad * parameters_.min_closure_sigma_rad;
    if (padded.llt().info() != Eigen::Success) {
      throw std::invalid_argument("pose graph: a closure's covariance has a negative eigenvalue");
    }
    const std::optional<std::size_t> target = FindNode(robot_target, stamp_target_ns);
    const std::optional<std::size_t> query = FindNode(robot_query, stamp_query_ns);
    if (!target || !query || *target == *query) return false;
    closures_.push_back({*target, *query, T_target_query, padded, true});
    const RobotIndex map_target = robots_.at(robot_target).map;
    const RobotIndex map_query = robots_.at(robot_query).map;
    if (map_target != map_query) JoinMaps(closures_.back());
    return true;
  }

  PoseGraphReport Optimize() {
    PoseGraphReport report;
    report.nodes = nodes_.size();
    report.closures = closures_.size();
    if (closures_.empty()) return report;
    RealignRobots();
    std::vector<Variables> variables(nodes_.size());
    std::transform(nodes_.begin(), nodes_.end(), variables.begin(),
                   [](const PoseGraphNode& node) { return Variables(node.T_map_sensor); });
    const std::vector<Variables> start = variables;
    const bool news_disagree = WorstDeviation(start, optimized_closures_) > kOutlierSigmas;

    ceres::Solver::Summary summary = Solve(parameters_.robust_width, kFinalTolerance, variables);
    report.initial_cost = summary.initial_cost;
    report.iterations = static_cast<int>(summary.iterations.size());
    if (news_disagree) {
      // A robust loss that starts far from a closure can't tell a false one from one that corrects much drift. So begin
      // wide enough to believe all, narrow down, and keep whichever of the two ends costs less.
      std::vector<Variables> graduated = start;
      for (double width = WorstDeviation(start, 0) * std::sqrt(6.0); width > parameters_.robust_width;
           width /= kAnnealingFactor) {
        report.iterations += static_cast<int>(Solve(width, kCoarseTolerance, graduated).iterations.size());
      }
      const ceres::Solver::Summary last = Solve(parameters_.robust_width, kFinalTolerance, graduated);
      report.iterations += static_cast<int>(last.iterations.size());
      if (last.final_cost < summary.final_cost) {
        summary = last;
        variables = graduated;
      }
    }
    report.final_cost = summary.final_cost;
    report.converged = summary.termination_type == ceres::CONVERGENCE;
    for (std::size_t i = 0; i < nodes_.size(); ++i) nodes_[i].T_map_sensor = variables[i].ToPose();
    for (auto& entry : robots_) {
      const PoseGraphNode& newest = nodes_[entry.second.nodes.back()];
      entry.second.T_map_odom = newest.T_map_sensor * newest.T_odom_sensor.inverse();
    }
    optimized_closures_ = closures_.size();
    report.outvoted_closures = std::count_if(closures_.begin(), closures_.end(), [this](const PoseGraphEdge& closure) {
      return Deviation(nodes_[closure.from].T_map_sensor, nodes_[closure.to].T_map_sensor, closure) > kOutlierSigmas;
    });
    return report;
  }

  std::vector<StampedPose> Trajectory(RobotIndex robot) const {
    std::vector<StampedPose> trajectory;
    const auto it = robots_.find(robot);
    if (it == robots_.end()) return trajectory;
    trajectory.reserve(it->second.nodes.size());
    for (std::size_t i : it->second.nodes) trajectory.push_back({nodes_[i].stamp_ns, nodes_[i].T_map_sensor});
    return trajectory;
  }

  Pose T_map_odom(RobotIndex robot) const {
    const auto it = robots_.find(robot);
    if (it == robots_.end()) {
      throw std::invalid_argument("pose graph: robot " + std::to_string(robot) + " has no nodes yet");
    }
    return it->second.T_map_odom;
  }

  bool AreConnected(RobotIndex a, RobotIndex b) const {
    if (a == b) return true;
    const auto it_a = robots_.find(a);
    const auto it_b = robots_.find(b);
    return it_a != robots_.end() && it_b != robots_.end() && it_a->second.map == it_b->second.map;
  }

  std::size_t closures() const { return closures_.size(); }
  const std::vector<PoseGraphNode>& nodes() const { return nodes_; }

  std::vector<PoseGraphEdge> Edges() const {
    std::vector<PoseGraphEdge> edges = odometry_;
    edges.insert(edges.end(), closures_.begin(), closures_.end());
    return edges;
  }

 private:
  struct Robot {
    std::size_t order = 0;               // in which the robots came
    RobotIndex map = 0;                  // the robot whose first node is the origin of this robot's map
    Pose T_map_odom = Pose::Identity();  // of the newest node
    std::vector<std::size_t> nodes;
  };

  Covariance6 OdometryCovariance(const Pose& T_last_node) const {
    const double distance_m = std::max(T_last_node.translation().norm(), parameters_.min_odometry_distance_m);
    Covariance6 covariance = Covariance6::Zero();
    covariance.diagonal().head<3>().setConstant(std::pow(parameters_.odometry_sigma_m, 2) * distance_m);
    covariance.diagonal().tail<3>().setConstant(std::pow(parameters_.odometry_sigma_rad, 2) * distance_m);
    return covariance;
  }

  // The node of a robot nearest in time, if nearer than half of the smaller interval to its neighbours.
  std::optional<std::size_t> FindNode(RobotIndex robot, StampNs stamp_ns) const {
    const auto it = robots_.find(robot);
    if (it == robots_.end()) return std::nullopt;
    const std::vector<std::size_t>& track = it->second.nodes;
    const auto stamp_at = [&](std::size_t k) { return nodes_[track[k]].stamp_ns; };
    const std::size_t after = static_cast<std::size_t>(
        std::lower_bound(track.begin(), track.end(), stamp_ns,
                         [this](std::size_t node, StampNs stamp) { return nodes_[node].stamp_ns < stamp; }) -
        track.begin());
    std::size_t nearest = std::min(after, track.size() - 1);
    if (after > 0 && after < track.size() && stamp_ns - stamp_at(after - 1) < stamp_at(after) - stamp_ns) {
      nearest = after - 1;
    }
    StampNs spacing_ns = track.size() > 1 ? std::numeric_limits<StampNs>::max() : 0;
    if (nearest > 0) spacing_ns = std::min(spacing_ns, stamp_at(nearest) - stamp_at(nearest - 1));
    if (nearest + 1 < track.size()) spacing_ns = std::min(spacing_ns, stamp_at(nearest + 1) - stamp_at(nearest));
    if (std::abs(stamp_at(nearest) - stamp_ns) > spacing_ns / 2) return std::nullopt;
    return track[nearest];
  }

  void MoveRobot(Robot& track, const Pose& T_new_old) {
    for (std::size_t i : track.nodes) nodes_[i].T_map_sensor = T_new_old * nodes_[i].T_map_sensor;
    track.T_map_odom = T_new_old * track.T_map_odom;
  }

  // Brings the later of the two maps that a closure connects into the frame of the earlier one.
  void JoinMaps(const PoseGraphEdge& closure) {
    const RobotIndex map_from = robots_.at(nodes_[closure.from].robot).map;
    const RobotIndex map_to = robots_.at(nodes_[closure.to].robot).map;
    const bool moves_to = robots_.at(map_from).order < robots_.at(map_to).order;
    const RobotIndex kept = moves_to ? map_from : map_to;
    const RobotIndex moved = moves_to ? map_to : map_from;
    const Pose T_kept_moved = Alignment(moves_to ? closure : Reversed(closure));
    for (auto& entry : robots_) {
      if (entry.second.map != moved) continue;
      entry.second.map = kept;
      MoveRobot(entry.second, T_kept_moved);
    }
  }

  static PoseGraphEdge Reversed(const PoseGraphEdge& edge) {
    PoseGraphEdge reversed = edge;
    std::swap(reversed.from, reversed.to);
    reversed.T_from_to = edge.T_from_to.inverse();
    return reversed;
  }

  // What would have to be applied to the map of `closure.to` for the closure to fit.
  Pose Alignment(const PoseGraphEdge& closure) const {
    return nodes_[closure.from].T_map_sensor * closure.T_from_to * nodes_[closure.to].T_map_sensor.inverse();
  }

  // A robot's closures to earlier robots of its map may agree on another alignment than the one that its first closure
  // gave: then that one was false, and no local optimization would leave it.
  void RealignRobots() {
    std::map<std::size_t, RobotIndex> by_order;
    for (const auto& [robot, track] : robots_) by_order[track.order] = robot;
    for (const auto& entry : by_order) RealignRobot(entry.second);
  }

  void RealignRobot(RobotIndex robot) {
    const std::size_t order = robots_.at(robot).order;
    std::vector<PoseGraphEdge> links;  // from an earlier robot to this one
    for (const PoseGraphEdge& closure : closures_) {
      const std::size_t from = robots_.at(nodes_[closure.from].robot).order;
      const std::size_t to = robots_.at(nodes_[closure.to].robot).order;
      if (to == order && from < order) links.push_back(closure);
      if (from == order && to < order) links.push_back(Reversed(closure));
    }
    if (links.size() < 2) return;
    const auto supporters = [&](const Pose& T_new_old) {
      return std::count_if(links.begin(), links.end(), [&](const PoseGraphEdge& link) {
        const Pose error = T_new_old.inverse() * Alignment(link);
        return error.translation().norm() < kAlignmentTolerance_m &&
               Eigen::AngleAxisd(error.linear()).angle() < kAlignmentTolerance_rad;
      });
    };
    auto most = supporters(Pose::Identity());
    if (2 * most > static_cast<std::ptrdiff_t>(links.size())) return;
    std::optional<Pose> best;
    const std::size_t step = 1 + links.size() / kMaxHypotheses;
    for (std::size_t i = 0; i < links.size(); i += step) {
      const Pose candidate = Alignment(links[i]);
      const auto count = supporters(candidate);
      if (count > most) {
        most = count;
        best = candidate;
      }
    }
    if (best) MoveRobot(robots_.at(robot), *best);
  }

  // Over the closures from `first` on.
  double WorstDeviation(const std::vector<Variables>& variables, std::size_t first) const {
    double worst = 0.0;
    for (std::size_t i = first; i < closures_.size(); ++i) {
      const PoseGraphEdge& closure = closures_[i];
      worst = std::max(worst, Deviation(variables[closure.from].ToPose(), variables[closure.to].ToPose(), closure));
    }
    return worst;
  }

  // Optimizes `variables` in place with a Cauchy loss of this width on the closures.
  ceres::Solver::Summary Solve(double width, double tolerance, std::vector<Variables>& variables) const {
    ceres::Problem problem;
    for (Variables& node : variables) {
      problem.AddParameterBlock(node.t.data(), 3);
      AddRotationBlock(problem, node.q.data());
    }
    const auto add = [&](const PoseGraphEdge& edge, ceres::LossFunction* loss) {
      Variables& from = variables[edge.from];
      Variables& to = variables[edge.to];
      problem.AddResidualBlock(BetweenFactor::Create(edge.T_from_to, edge.covariance), loss, from.t.data(),
                               from.q.data(), to.t.data(), to.q.data());
    };
    for (const PoseGraphEdge& edge : odometry_) add(edge, nullptr);
    for (const PoseGraphEdge& edge : closures_) add(edge, new ceres::CauchyLoss(width));
    for (const auto& [robot, track] : robots_) {
      if (track.map != robot) continue;
      problem.SetParameterBlockConstant(variables[track.nodes.front()].t.data());
      problem.SetParameterBlockConstant(variables[track.nodes.front()].q.data());
    }
    ceres::Solver::Options options;
    options.linear_solver_type = ceres::SPARSE_NORMAL_CHOLESKY;
    options.max_num_iterations = parameters_.max_iterations;
    options.function_tolerance = tolerance;
    options.num_threads = 1;
    options.logging_type = ceres::SILENT;
    ceres::Solver::Summary summary;
    ceres::Solve(options, &problem, &summary);
    if (!summary.IsSolutionUsable()) throw std::runtime_error("pose graph: " + summary.message);
    return summary;
  }

  static constexpr double kAlignmentTolerance_m = 5.0;
  static constexpr double kAlignmentTolerance_rad = 0.1;
  static constexpr std::size_t kMaxHypotheses = 100;

  PoseGraphParameters parameters_;
  std::map<RobotIndex, Robot> robots_;
  std::vector<PoseGraphNode> nodes_;
  std::vector<PoseGraphEdge> odometry_;
  std::vector<PoseGraphEdge> closures_;
  std::size_t optimized_closures_ = 0;  // the first so many have been through an optimization
};

PoseGraph::PoseGraph(const PoseGraphParameters& parameters) : impl_(std::make_unique<Impl>(parameters)) {}
PoseGraph::~PoseGraph() = default;
PoseGraph::PoseGraph(PoseGraph&&) noexcept = default;
PoseGraph& PoseGraph::operator=(PoseGraph&&) noexcept = default;

void PoseGraph::AddNode(RobotIndex robot, StampNs stamp_ns, const Pose& T_odom_sensor) {
  impl_->AddNode(robot, stamp_ns, T_odom_sensor);
}

bool PoseGraph::AddClosure(RobotIndex robot_target, StampNs stamp_target_ns, RobotIndex robot_query,
                           StampNs stamp_query_ns, const Pose& T_target_query, const Covariance6& covariance) {
  return impl_->AddClosure(robot_target, stamp_target_ns, robot_query, stamp_query_ns, T_target_query, covariance);
}

PoseGraphReport PoseGraph::Optimize() {
  return impl_->Optimize();
}
std::vector<StampedPose> PoseGraph::Trajectory(RobotIndex robot) const {
  return impl_->Trajectory(robot);
}
Pose PoseGraph::T_map_odom(RobotIndex robot) const {
  return impl_->T_map_odom(robot);
}
bool PoseGraph::AreConnected(RobotIndex a, RobotIndex b) const {
  return impl_->AreConnected(a, b);
}
std::size_t PoseGraph::closures() const {
  return impl_->closures();
}
std::vector<PoseGraphNode> PoseGraph::Nodes() const {
  return impl_->nodes();
}
std::vector<PoseGraphEdge> PoseGraph::Edges() const {
  return impl_->Edges();
}

}  // namespace incremental_segmatch
