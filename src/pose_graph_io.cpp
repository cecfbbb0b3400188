#include "incremental_segmatch/pose_graph_io.hpp"

#include <Eigen/LU>
#include <cstdio>
#include <fstream>
#include <stdexcept>

namespace incremental_segmatch {
namespace {

std::ofstream Open(const std::string& path) {
  std::ofstream file(path);
  if (!file) throw std::runtime_error("can't write " + path + ": does its folder exist, and may it be written?");
  file.precision(12);
  return file;
}

void Close(std::ofstream& file, const std::string& path) {
  file.close();
  if (!file) throw std::runtime_error("writing " + path + " failed: is the disk full?");
}

void WritePose(std::ofstream& file, const Pose& T) {
  const Eigen::Quaterniond q = Eigen::Quaterniond(T.linear()).normalized();
  file << T.translation().x() << ' ' << T.translation().y() << ' ' << T.translation().z() << ' ' << q.x() << ' '
       << q.y() << ' ' << q.z() << ' ' << q.w();
}

}  // namespace

std::string FormatSeconds(StampNs stamp_ns) {
  constexpr std::int64_t kBillion = 1000000000;
  const bool negative = stamp_ns < 0;
  const std::int64_t magnitude = negative ? -stamp_ns : stamp_ns;
  char text[40];
  std::snprintf(text, sizeof text, "%s%lld.%09lld", negative ? "-" : "", static_cast<long long>(magnitude / kBillion),
                static_cast<long long>(magnitude % kBillion));
  return text;
}

void WriteG2o(const PoseGraph& graph, const std::string& path) {
  std::ofstream file = Open(path);
  const std::vector<PoseGraphNode> nodes = graph.Nodes();
  std::vector<RobotIndex> origins;  // one robot per map, the one that came first
  for (std::size_t i = 0; i < nodes.size(); ++i) {
    file << "VERTEX_SE3:QUAT " << i << ' ';
    WritePose(file, nodes[i].T_map_sensor);
    file << '\n';
    bool known = false;
    for (RobotIndex origin : origins) known = known || graph.AreConnected(origin, nodes[i].robot);
    if (known) continue;
    origins.push_back(nodes[i].robot);
    file << "FIX " << i << '\n';
  }
  for (const PoseGraphEdge& edge : graph.Edges()) {
    Covariance6 scale = Covariance6::Identity();
    scale.diagonal().tail<3>().setConstant(2.0);  // a quaternion's imaginary part is half the rotation vector
    const Covariance6 information = scale * edge.covariance.inverse() * scale;
    file << "EDGE_SE3:QUAT " << edge.from << ' ' << edge.to << ' ';
    WritePose(file, edge.T_from_to);
    for (int row = 0; row < 6; ++row) {
      for (int column = row; column < 6; ++column) file << ' ' << information(row, column);
    }
    file << '\n';
  }
  Close(file, path);
}

void WriteTum(const std::vector<StampedPose>& trajectory, const std::string& path) {
  std::ofstream file = Open(path);
  for (const StampedPose& pose : trajectory) {
    file << FormatSeconds(pose.stamp_ns) << ' ';
    WritePose(file, pose.T_frame_sensor);
    file << '\n';
  }
  Close(file, path);
}

}  // namespace incremental_segmatch
