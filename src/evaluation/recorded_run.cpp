#include "evaluation/recorded_run.hpp"

#include <Eigen/LU>
#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <fstream>
#include <functional>
#include <optional>
#include <sstream>
#include <stdexcept>

namespace incremental_segmatch {
namespace {

constexpr StampNs kSameStampNs = 1'000'000;

// Calls `read` for every line that is not empty; it returns false for a line that it can't read.
void ReadLines(const std::string& path, const std::function<bool(const std::string&)>& read) {
  std::ifstream file(path);
  if (!file) throw std::runtime_error("can't read " + path + ": has the run ended, and was this its output folder?");
  std::string line;
  for (int number = 1; std::getline(file, line); ++number) {
    if (!line.empty() && !read(line)) {
      throw std::runtime_error(path + ", line " + std::to_string(number) + ": can't make sense of \"" + line + "\"");
    }
  }
}

// Seconds with up to nine decimals, without passing through a floating-point number.
std::optional<StampNs> ParseSeconds(const std::string& text) {
  const std::size_t point = std::min(text.find('.'), text.size());
  std::string digits = text.substr(0, point);
  std::string decimals = point < text.size() ? text.substr(point + 1) : "";
  if (decimals.size() > 9) return std::nullopt;
  decimals.resize(9, '0');
  digits += decimals;
  char* end = nullptr;
  const StampNs stamp_ns = std::strtoll(digits.c_str(), &end, 10);
  if (end != digits.c_str() + digits.size()) return std::nullopt;
  return stamp_ns;
}

// x y z qx qy qz qw
std::optional<Pose> ParsePose(std::istream& stream) {
  Eigen::Vector3d t;
  Eigen::Quaterniond q;
  stream >> t.x() >> t.y() >> t.z() >> q.x() >> q.y() >> q.z() >> q.w();
  if (!stream || !(std::abs(q.norm() - 1.0) < 0.01)) return std::nullopt;
  Pose T = Pose::Identity();
  T.translation() = t;
  T.linear() = q.normalized().toRotationMatrix();
  return T;
}

std::optional<ClosureRow> ParseClosure(std::string line) {
  std::replace(line.begin(), line.end(), ',', ' ');
  std::istringstream stream(line);
  std::string query;
  std::string target;
  ClosureRow row;
  stream >> query >> target >> row.robot_query >> row.robot_target;
  const std::optional<StampNs> stamp_query_ns = ParseSeconds(query);
  const std::optional<StampNs> stamp_target_ns = ParseSeconds(target);
  const std::optional<Pose> T_target_query = ParsePose(stream);
  stream >> row.inliers >> row.candidates >> row.rms_m;
  if (!stream || !stamp_query_ns || !stamp_target_ns || !T_target_query) return std::nullopt;
  row.stamp_query_ns = *stamp_query_ns;
  row.stamp_target_ns = *stamp_target_ns;
  row.T_target_query = *T_target_query;
  return row;
}

std::vector<ClosureRow> ReadClosuresCsv(const std::string& path) {
  std::vector<ClosureRow> closures;
  bool is_header = true;
  ReadLines(path, [&](const std::string& line) {
    if (is_header) {
      is_header = false;
      return line.rfind("stamp_query,stamp_target,", 0) == 0;
    }
    const std::optional<ClosureRow> row = ParseClosure(line);
    if (row) closures.push_back(*row);
    return row.has_value();
  });
  return closures;
}

// Edges between poses that don't follow each other, with covariances as the core has them.
std::vector<GraphClosure> ReadG2oClosures(const std::string& path) {
  std::vector<GraphClosure> closures;
  ReadLines(path, [&closures](const std::string& line) {
    std::istringstream stream(line);
    std::string tag;
    stream >> tag;
    if (tag != "EDGE_SE3:QUAT") return tag == "VERTEX_SE3:QUAT" || tag == "FIX";
    GraphClosure closure;
    stream >> closure.target_step >> closure.query_step;
    if (!ParsePose(stream)) return false;
    if (closure.query_step == closure.target_step + 1) return true;
    Covariance6 information;
    for (int row = 0; row < 6; ++row) {
      for (int column = row; column < 6; ++column) {
        stream >> information(row, column);
        information(column, row) = information(row, column);
      }
    }
    if (!stream) return false;
    Covariance6 scale = Covariance6::Identity();
    scale.diagonal().tail<3>().setConstant(2.0);  // a quaternion's imaginary part is half the rotation vector
    closure.covariance = scale * information.inverse() * scale;
    closures.push_back(closure);
    return true;
  });
  return closures;
}

}  // namespace

std::vector<StampedPose> ReadTum(const std::string& path) {
  std::vector<StampedPose> trajectory;
  ReadLines(path, [&trajectory](const std::string& line) {
    std::istringstream stream(line);
    std::string stamp;
    stream >> stamp;
    const std::optional<StampNs> stamp_ns = ParseSeconds(stamp);
    const std::optional<Pose> pose = ParsePose(stream);
    if (!stamp_ns || !pose) return false;
    trajectory.push_back({*stamp_ns, *pose});
    return true;
  });
  return trajectory;
}

RecordedRun ReadRecordedRun(const std::string& folder) {
  RecordedRun run;
  run.closures = ReadClosuresCsv(folder + "/closures.csv");
  run.odometry = ReadTum(folder + "/trajectory_odometry.tum");
  run.optimized = ReadTum(folder + "/trajectory_optimized.tum");
  run.graph_closures = ReadG2oClosures(folder + "/pose_graph.g2o");
  return run;
}

RunErrors MeasureRun(const RecordedRun& run, const std::vector<StampNs>& stamps_ns,
                     const std::vector<Pose>& T_world_sensor) {
  if (run.odometry.size() != run.optimized.size()) {
    throw std::runtime_error("the two trajectories are of different length: are they of one run?");
  }
  std::vector<StampNs> run_stamps_ns;
  std::vector<Pose> truth;
  for (const StampedPose& pose : run.odometry) {
    const auto it = std::lower_bound(stamps_ns.begin(), stamps_ns.end(), pose.stamp_ns - kSameStampNs);
    if (it == stamps_ns.end() || *it > pose.stamp_ns + kSameStampNs) {
      throw std::runtime_error("a pose of the run, at " + std::to_string(1e-9 * static_cast<double>(pose.stamp_ns)) +
                               " s, has no true pose: is it this drive, and this epoch?");
    }
    run_stamps_ns.push_back(pose.stamp_ns);
    truth.push_back(T_world_sensor[static_cast<std::size_t>(it - stamps_ns.begin())]);
  }
  for (const GraphClosure& closure : run.graph_closures) {
    if (std::max(closure.target_step, closure.query_step) >= truth.size()) {
      throw std::runtime_error("the pose graph has more poses than the trajectory: are they of one run?");
    }
  }
  RunErrors errors;
  errors.poses = truth.size();
  const std::vector<Pose> odometry = PosesOf(run.odometry);
  errors.odometry_m = AbsoluteTrajectoryError(odometry, truth);
  errors.optimized_m = AbsoluteTrajectoryError(PosesOf(run.optimized), truth);
  errors.bound_same_places_m = AbsoluteTrajectoryError(
      PosesOf(OptimizeWithTrueClosures(run_stamps_ns, odometry, truth, run.graph_closures, {})), truth);
  return errors;
}

}  // namespace incremental_segmatch
