/// \file
/// Files that other programs read: g2o graphs and TUM trajectories.
#pragma once

#include <string>
#include <vector>

#include "incremental_segmatch/pose_graph.hpp"

namespace incremental_segmatch {

/// Writes `VERTEX_SE3:QUAT`, `FIX` and `EDGE_SE3:QUAT` lines with the current estimate, the measurements and their
/// information matrices (of the imaginary part of the quaternion, as g2o has it). Throws std::runtime_error naming the
/// file if it can't be written.
void WriteG2o(const PoseGraph& graph, const std::string& path);

/// Writes `stamp x y z qx qy qz qw` lines, stamps in seconds with nine decimals. Throws std::runtime_error naming the
/// file if it can't be written.
void WriteTum(const std::vector<StampedPose>& trajectory, const std::string& path);

/// A stamp as seconds with exactly nine decimals, without passing through a floating-point number.
std::string FormatSeconds(StampNs stamp_ns);

}  // namespace incremental_segmatch
