/// \file
/// A whole drive through front end, back end and pose graph, as fast as it goes, with everything recorded.
#pragma once

#include <functional>
#include <limits>
#include <optional>
#include <string>
#include <vector>

#include "evaluation/batch_comparison.hpp"
#include "evaluation/drive_source.hpp"
#include "evaluation/scoring.hpp"
#include "evaluation/trajectory_error.hpp"
#include "evaluation/true_pairs.hpp"
#include "incremental_segmatch/parameters.hpp"
#include "incremental_segmatch/pose_graph.hpp"

namespace incremental_segmatch {

/// What a drive is run through.
enum class Pipeline {
  kIncremental,
  kBatch,  ///< the original SegMatch on PCL in its place
  kBoth    ///< incremental, and every step's batch stages on the same input beside it, for their times
};

/// What is run, and how it is judged.
struct EvaluationParameters {
  Parameters core;
  Pipeline pipeline = Pipeline::kIncremental;
  PoseGraphParameters pose_graph;
  ScoringParameters scoring;
  bool optimize = true;                  ///< false: recognitions only, nothing is corrected
  double closure_spacing_m = 5.0;        ///< path between closures that enter the pose graph: neighbours are correlated
  double optimization_spacing_m = 10.0;  ///< path between optimizations, each of which needs a new closure
  std::size_t max_steps = std::numeric_limits<std::size_t>::max();
  std::string robot = "robot";  ///< name in the output
  std::string map_file;         ///< to localize in, with core.back_end.mode kLocalization; nothing is optimized then
  std::optional<TrueTrajectory> map_truth;  ///< of the drive that the map was made of; without it nothing is scored
  std::string save_map;                     ///< where to save the map in the end, with its truth beside; empty: nowhere
};

/// Where the truth of a map's drive is, beside the map: TUM rows of T_world_sensor.
std::string MapTruthPath(const std::string& map_file);

/// A row of steps.csv.
struct StepRecord {
  StampNs stamp_ns = 0;
  double total_ms = 0.0;     ///< front end and back end, CPU time; neither reading nor optimizing
  double read_ms = 0.0;      ///< getting the scan
  double optimize_ms = 0.0;  ///< pose graph and correction of the target map, 0 if it was not this step's turn
  StageTimes stages;
  std::size_t described = 0;  ///< segments that changed in this step, and so were described anew
  FrontEndCounts front_end;
  BackEndCounts back_end;
  std::optional<BatchRecord> batch;  ///< with Pipeline::kBoth
};

/// A recognition that came as far as to be judged by its evidence, accepted or not.
struct JudgedRecognition {
  std::size_t step = 0;
  ClosureRow closure;
  Evidence evidence;
  StepEnd end = StepEnd::kRecognized;  ///< kRecognized: accepted
  JudgedClosure judged;                ///< against the truth, where there is one
  std::optional<std::size_t> settled_by = std::nullopt;  ///< refused as ambiguous at first, accepted with a later step: which
  bool is_accepted() const { return end == StepEnd::kRecognized || settled_by; }
};

/// Root mean square position errors after alignment, in metres.
struct TrajectoryErrors {
  double odometry_m = 0.0;
  double optimized_m = 0.0;
  double bound_same_places_m = 0.0;    ///< same graph, the same closures with their true relative poses
  double bound_every_revisit_m = 0.0;  ///< same graph, true closures at every revisit
};

/// All that came of a drive.
struct EvaluationResult {
  std::string drive;
  std::vector<std::string> notes;
  bool odometry_is_truth = false;
  std::vector<StepRecord> steps;
  std::vector<ClosureRow> closures;             ///< accepted recognitions
  std::vector<JudgedRecognition> recognitions;  ///< all that were judged
  std::size_t min_clique = 0;                   ///< T: smaller consistent sets are no recognition
  AcceptanceParameters acceptance;              ///< what recognitions were judged by
  std::vector<GraphClosure> graph_closures;     ///< those that entered the pose graph
  std::vector<StampedPose> odometry;
  std::vector<StampedPose> optimized;   ///< equal to the odometry without optimization
  std::optional<PoseGraph> pose_graph;  ///< with optimization
  PoseGraphReport last_optimization;
  double seconds = 0.0;                              ///< of the whole run, by the clock on the wall
  std::optional<TrueTrajectory> truth;               ///< where there is ground truth
  std::optional<TrueTrajectory> map_truth;           ///< of the map's drive, in localization, where it is known
  std::optional<Score> score;                        ///< where there is ground truth
  std::optional<Score> score_at_once;                ///< the same without what a later step settled
  std::vector<TruePair> true_pairs;                  ///< at revisits, where there is ground truth
  std::optional<TrajectoryErrors> trajectory_error;  ///< where there is ground truth and optimization
};

/// Runs the drive. `progress(done, total)` is called after each step. Throws what the drive and the core throw.
EvaluationResult Evaluate(DriveSource& drive, const EvaluationParameters& parameters,
                          const std::function<void(std::size_t, std::size_t)>& progress = {});

/// Writes report.html, closures.csv, steps.csv, missed.csv (with ground truth), trajectory_odometry.tum,
/// trajectory_optimized.tum, pose_graph.g2o (with optimization), summary.json and parameters.yaml into a folder that is
/// made if need be. Throws std::runtime_error naming the file.
void WriteResults(const EvaluationResult& result, const EvaluationParameters& parameters, const std::string& folder);

/// The summary as text for people.
std::string FormatSummary(const EvaluationResult& result);

/// The summary as JSON; what is not known is null.
std::string SummaryJson(const EvaluationResult& result);

}  // namespace incremental_segmatch
