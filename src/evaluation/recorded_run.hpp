/// \file
/// What a run left in files, read back for scoring: of `segmatch evaluate`, or of the nodelets' `output_dir`.
#pragma once

#include <string>
#include <vector>

#include "evaluation/scoring.hpp"
#include "evaluation/trajectory_error.hpp"
#include "incremental_segmatch/types.hpp"

namespace incremental_segmatch {

/// One robot's run. Stamps are on the clock of its input.
struct RecordedRun {
  std::vector<ClosureRow> closures;          ///< of closures.csv
  std::vector<StampedPose> odometry;         ///< of trajectory_odometry.tum; step i below is row i
  std::vector<StampedPose> optimized;        ///< of trajectory_optimized.tum
  std::vector<GraphClosure> graph_closures;  ///< of pose_graph.g2o: the edges that are no odometry
};

/// Reads a trajectory in TUM's format: seconds x y z qx qy qz qw. Throws std::runtime_error naming the file and line.
std::vector<StampedPose> ReadTum(const std::string& path);

/// Reads a folder. All errors are std::runtime_error naming the file and line.
RecordedRun ReadRecordedRun(const std::string& folder);

/// How the trajectories of a run compare with the truth.
struct RunErrors {
  std::size_t poses = 0;    ///< of the run, each of which has a true one
  double odometry_m = 0.0;  ///< root mean square position errors after alignment
  double optimized_m = 0.0;
  double bound_same_places_m = 0.0;  ///< of the same graph whose closures are given their true relative poses
};

/// Scores the trajectories of a run against the true poses of the sensor at their stamps (increasing). Throws
/// std::runtime_error if a pose of the run has no true one within a millisecond, or the files don't fit each other.
RunErrors MeasureRun(const RecordedRun& run, const std::vector<StampNs>& stamps_ns,
                     const std::vector<Pose>& T_world_sensor);

}  // namespace incremental_segmatch
