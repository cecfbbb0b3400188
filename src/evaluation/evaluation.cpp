#include "evaluation/evaluation.hpp"

#include <algorithm>
#include <chrono>
#include <memory>
#include <stdexcept>

#include "incremental_segmatch/back_end.hpp"
#include "incremental_segmatch/batch_pipeline.hpp"
#include "incremental_segmatch/front_end.hpp"
#include "incremental_segmatch/pose_graph_io.hpp"

namespace incremental_segmatch {
namespace {

constexpr RobotIndex kRobot = 0;

class Stopwatch {
 public:
  double Milliseconds() const {
    return std::chrono::duration<double, std::milli>(std::chrono::steady_clock::now() - start_).count();
  }

 private:
  std::chrono::steady_clock::time_point start_ = std::chrono::steady_clock::now();
};

// With Pipeline::kBatch, the original's recognition takes the place of ours.
RecognizeFunction MakeRecognition(const EvaluationParameters& parameters) {
  if (parameters.pipeline != Pipeline::kBatch) return {};
  const auto batch = std::make_shared<BatchRecognizer>(parameters.core.front_end, parameters.core.back_end.recognizer);
  return [batch](const Correspondences& correspondences) { return batch->Recognize(correspondences); };
}

BackEnd MakeBackEnd(const EvaluationParameters& parameters) {
  const BackEndParameters& core = parameters.core.back_end;
  if (core.mode == Mode::kLoopClosure && parameters.map_file.empty()) return BackEnd(core, MakeRecognition(parameters));
  if (core.mode == Mode::kLoopClosure || parameters.map_file.empty())
    throw std::invalid_argument("localization and a map to localize in need each other");
  return BackEnd(core, TargetMap::Load(parameters.map_file, core.target_map), MakeRecognition(parameters));
}

ClosureRow ToRow(const Closure& closure) {
  return {closure.stamp_query_ns, closure.stamp_target_ns, closure.robot_query, closure.robot_target,
          closure.T_target_query, closure.inliers,         closure.candidates,  closure.rms_m,
          closure.covariance};
}

// Feeds the pose graph and the corrections that come of it; knows when it is time for either.
class LoopCloser {
 public:
  explicit LoopCloser(const EvaluationParameters& parameters)
      : parameters_(parameters), graph_(parameters.pose_graph) {}

  void AddPose(const StampedPose& odometry) {
    path_m_.push_back(path_m_.empty() ? 0.0
                                      : path_m_.back() + (odometry.T_frame_sensor.translation() - last_position_).norm());
    last_position_ = odometry.T_frame_sensor.translation();
    graph_.AddNode(kRobot, odometry.stamp_ns, odometry.T_frame_sensor);
  }

  // Of the scan of a step. True if the closure entered the graph.
  bool AddClosure(const Closure& closure, std::size_t step) {
    if (path_m_[step] - last_closure_m_ < parameters_.closure_spacing_m) return false;
    if (!graph_.AddClosure(kRobot, closure.stamp_target_ns, kRobot, closure.stamp_query_ns, closure.T_target_query,
                           closure.covariance)) {
      return false;
    }
    last_closure_m_ = path_m_[step];
    has_new_closure_ = true;
    return true;
  }

  // Optimizes and corrects the back end's map if it is time to. True if it did.
  bool CorrectIfDue(BackEnd& back_end) {
    if (!has_new_closure_ || path_m_.back() - last_optimization_m_ < parameters_.optimization_spacing_m) return false;
    Optimize();
    back_end.CorrectTrajectory(parameters_.robot, graph_.Trajectory(kRobot));
    return true;
  }

  void Optimize() {
    report_ = graph_.Optimize();
    last_optimization_m_ = path_m_.back();
    has_new_closure_ = false;
  }

  const PoseGraphReport& report() const { return report_; }
  std::vector<StampedPose> Trajectory() const { return graph_.Trajectory(kRobot); }
  PoseGraph TakeGraph() { return std::move(graph_); }

 private:
  static constexpr double kLongAgo = -std::numeric_limits<double>::infinity();

  const EvaluationParameters& parameters_;
  PoseGraph graph_;
  PoseGraphReport report_;
  std::vector<double> path_m_;  // at each step
  bool has_new_closure_ = false;
  Eigen::Vector3d last_position_ = Eigen::Vector3d::Zero();
  double last_closure_m_ = kLongAgo;
  double last_optimization_m_ = kLongAgo;
};

// Truth of the first `steps` scans; nothing if any of them has none.
std::optional<TrueTrajectory> ReadTruth(const DriveSource& drive, std::size_t steps) {
  TrueTrajectory truth;
  for (std::size_t i = 0; i < steps; ++i) {
    const std::optional<Pose> pose = drive.T_world_sensor(i);
    if (!pose) return std::nullopt;
    truth.stamps_ns.push_back(drive.stamp_ns(i));
    truth.T_world_sensor.push_back(*pose);
  }
  return truth;
}

// Of recognitions in the order of the drive the one of a scan.
JudgedRecognition& RecognitionAt(StampNs stamp_ns, std::vector<JudgedRecognition>* recognitions) {
  return *std::lower_bound(recognitions->begin(), recognitions->end(), stamp_ns,
                           [](const JudgedRecognition& r, StampNs stamp) { return r.closure.stamp_query_ns < stamp; });
}

// Scores what was accepted, and judges all that was judged.
void ScoreResult(const ScoringParameters& parameters, EvaluationResult* result) {
  const auto score = [&](const std::vector<ClosureRow>& closures) {
    return result->map_truth ? ScoreLocalizations(*result->truth, *result->map_truth, closures, parameters)
                             : ScoreClosures(*result->truth, closures, parameters);
  };
  result->score = score(result->closures);
  std::vector<ClosureRow> at_once;
  for (const JudgedRecognition& recognition : result->recognitions)
    if (recognition.end == StepEnd::kRecognized) at_once.push_back(recognition.closure);
  result->score_at_once = score(at_once);
  std::vector<ClosureRow> rows;
  for (const JudgedRecognition& recognition : result->recognitions) rows.push_back(recognition.closure);
  const Score judged = score(rows);
  for (std::size_t i = 0; i < rows.size(); ++i) result->recognitions[i].judged = judged.judged[i];
}

// With the map goes the truth of the drive that it was made of, for scoring localizations in it.
void SaveMap(const TargetMap& map, const std::optional<TrueTrajectory>& truth, const std::string& path) {
  map.Save(path);
  if (!truth) return;
  std::vector<StampedPose> trajectory;
  for (std::size_t i = 0; i < truth->stamps_ns.size(); ++i)
    trajectory.push_back({truth->stamps_ns[i], truth->T_world_sensor[i]});
  WriteTum(trajectory, MapTruthPath(path));
}

TrajectoryErrors MeasureErrors(const EvaluationResult& result, const PoseGraphParameters& parameters) {
  const std::vector<Pose> odometry = PosesOf(result.odometry);
  const std::vector<Pose>& truth = result.truth->T_world_sensor;
  const auto bound = [&](const std::vector<GraphClosure>& closures) {
    return AbsoluteTrajectoryError(
        PosesOf(OptimizeWithTrueClosures(result.truth->stamps_ns, odometry, truth, closures, parameters)), truth);
  };
  std::vector<GraphClosure> every_revisit;
  for (std::size_t i = 0; i < truth.size(); ++i) {
    const std::optional<std::size_t> target = result.score->revisit_targets[i];
    if (target) every_revisit.push_back({*target, i, Covariance6::Zero()});
  }
  TrajectoryErrors errors;
  errors.odometry_m = AbsoluteTrajectoryError(odometry, truth);
  errors.optimized_m = AbsoluteTrajectoryError(PosesOf(result.optimized), truth);
  errors.bound_same_places_m = bound(result.graph_closures);
  errors.bound_every_revisit_m = bound(every_revisit);
  return errors;
}

}  // namespace

std::string MapTruthPath(const std::string& map_file) {
  return map_file + ".truth.tum";
}

EvaluationResult Evaluate(DriveSource& drive, const EvaluationParameters& parameters,
                          const std::function<void(std::size_t, std::size_t)>& progress) {
  const Stopwatch run;
  const std::size_t steps = std::min(drive.size(), parameters.max_steps);
  const FrontEndParameters& front_end_parameters = parameters.core.front_end;
  const RecognizerParameters& recognizer_parameters = parameters.core.back_end.recognizer;
  const bool is_batch = parameters.pipeline == Pipeline::kBatch;
  FrontEnd front_end(front_end_parameters, parameters.robot);
  std::optional<BatchFrontEnd> batch_front_end;
  if (is_batch) batch_front_end.emplace(front_end_parameters, recognizer_parameters, parameters.robot);
  BackEnd back_end = MakeBackEnd(parameters);
  const bool optimize = parameters.optimize && parameters.map_file.empty();
  BatchComparison comparison(BatchParametersOf(front_end_parameters, recognizer_parameters));
  LoopCloser closer(parameters);
  EvaluationResult result;
  result.drive = drive.name();
  result.notes = drive.notes();
  result.odometry_is_truth = drive.odometry_is_truth();
  result.min_clique = parameters.core.back_end.recognizer.clique.min_size;
  result.acceptance = parameters.core.back_end.acceptance;
  if (steps > 0) result.truth = ReadTruth(drive, steps);
  result.map_truth = parameters.map_truth;
  const bool is_scored = result.truth && (parameters.map_file.empty() || result.map_truth);
  std::optional<TruePairFinder> true_pairs;
  if (is_scored)
    true_pairs.emplace(*result.truth, result.map_truth ? &*result.map_truth : nullptr, parameters.scoring);

  for (std::size_t i = 0; i < steps; ++i) {
    StepRecord record;
    const Stopwatch reading;
    const Scan scan{drive.stamp_ns(i), drive.ReadPoints(i), drive.T_odom_sensor(i)};
    record.read_ms = reading.Milliseconds();
    record.stamp_ns = scan.stamp_ns;

    const double step_start_ms = ThreadCpuMs();
    FrontEndStep seen = is_batch ? batch_front_end->Process(scan) : front_end.Process(scan);
    BackEndStep recognized = back_end.Process(seen.delta);
    record.total_ms = ThreadCpuMs() - step_start_ms;

    if (true_pairs) {
      const std::vector<TruePair> pairs = true_pairs->Step(i, seen.delta, recognized, back_end);
      result.true_pairs.insert(result.true_pairs.end(), pairs.begin(), pairs.end());
    }
    if (parameters.pipeline == Pipeline::kBoth)
      record.batch = comparison.Run(seen, recognized, scan.T_odom_sensor);
    record.stages = std::move(seen.times);
    record.stages.insert(record.stages.end(), recognized.times.begin(), recognized.times.end());
    record.front_end = seen.counts;
    record.back_end = recognized.counts;
    record.described = seen.delta.changed.size();
    result.odometry.push_back({scan.stamp_ns, scan.T_odom_sensor});
    std::vector<Closure> accepted = recognized.settled;
    if (recognized.closure) accepted.push_back(*recognized.closure);
    for (const Closure& closure : accepted) result.closures.push_back(ToRow(closure));
    for (const Closure& closure : recognized.settled) {
      JudgedRecognition& recognition = RecognitionAt(closure.stamp_query_ns, &result.recognitions);
      recognition.evidence = closure.evidence;
      recognition.settled_by = i;
    }
    if (const std::optional<Closure>& judged = recognized.closure ? recognized.closure : recognized.refused)
      result.recognitions.push_back({i, ToRow(*judged), judged->evidence, recognized.counts.end, {}});

    if (optimize) {
      closer.AddPose(result.odometry.back());
      const Stopwatch optimization;
      for (const Closure& closure : accepted) {
        const std::size_t query = StepAt(result.odometry, closure.stamp_query_ns);
        if (closer.AddClosure(closure, query))
          result.graph_closures.push_back({StepAt(result.odometry, closure.stamp_target_ns), query, closure.covariance});
      }
      if (closer.CorrectIfDue(back_end)) record.optimize_ms = optimization.Milliseconds();
    }
    result.steps.push_back(std::move(record));
    if (progress) progress(i + 1, steps);
  }

  result.optimized = result.odometry;
  if (optimize && steps > 0) {
    closer.Optimize();
    result.last_optimization = closer.report();
    result.optimized = closer.Trajectory();
    result.pose_graph = closer.TakeGraph();
  }
  if (!parameters.save_map.empty()) {
    if (optimize) back_end.CorrectTrajectory(parameters.robot, result.optimized);
    SaveMap(back_end.map(), result.truth, parameters.save_map);
  }
  if (is_scored) ScoreResult(parameters.scoring, &result);
  if (result.score && optimize) result.trajectory_error = MeasureErrors(result, parameters.pose_graph);
  if (!parameters.map_file.empty() && !result.map_truth)
    result.notes.push_back("the truth of the map's drive is not known: nothing is scored");
  result.seconds = run.Milliseconds() / 1000.0;
  return result;
}

}  // namespace incremental_segmatch
