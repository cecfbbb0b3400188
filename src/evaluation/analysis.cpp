#include "evaluation/analysis.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <set>

namespace incremental_segmatch {
namespace {

constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();

const char* CauseOf(ClosureVerdict verdict) {
  switch (verdict) {
    case ClosureVerdict::kFalse:
      return "false_closure";
    case ClosureVerdict::kTrivial:
      return "trivial_closure";
    default:
      return "unmatched_closure";
  }
}

StageStatistics Measure(const std::string& name, const std::vector<double>& times_ms) {
  return {name,
          Percentile(times_ms, 0.5),
          Percentile(times_ms, 0.95),
          Percentile(times_ms, 0.99),
          Percentile(times_ms, 1.0),
          Mean(times_ms)};
}

double MeanStageMs(const std::vector<StepRecord>& steps, const std::string& stage) {
  return Mean(Values(steps, [&](const StepRecord& step) { return StageMs(step, stage); }));
}

// Share of all pairs of correspondences that were tested for consistency.
double TestedShare(const std::vector<StepRecord>& steps) {
  double tested = 0.0, pairs = 0.0;
  for (const StepRecord& step : steps) {
    const double candidates = static_cast<double>(step.back_end.candidates);
    tested += static_cast<double>(step.back_end.tested_pairs);
    pairs += 0.5 * candidates * (candidates - 1.0);
  }
  return pairs > 0.0 ? tested / pairs : kNaN;
}

double LocalizedShare(const EvaluationResult& result) {
  if (!result.score || result.steps.empty()) return kNaN;
  const auto found = std::count(result.score->found.begin(), result.score->found.end(), true);
  return static_cast<double>(found) / static_cast<double>(result.steps.size());
}

}  // namespace

std::vector<MissedRevisit> FindMissedRevisits(const EvaluationResult& result) {
  std::vector<MissedRevisit> missed;
  if (!result.score) return missed;
  const Score& score = *result.score;
  std::map<std::size_t, ClosureVerdict> verdicts;  // of steps with a closure
  for (const JudgedClosure& judged : score.judged) {
    if (judged.verdict != ClosureVerdict::kUnmatched) verdicts.emplace(judged.query_step, judged.verdict);
  }
  const std::vector<double> path_m = PathLengths(result);
  double mark_m = 0.0;
  for (std::size_t i = 0; i < result.steps.size(); ++i) {
    if (!score.revisit_targets[i]) continue;
    if (i == 0 || !score.revisit_targets[i - 1] || score.found[i]) mark_m = path_m[i];
    if (score.found[i]) continue;
    MissedRevisit miss;
    miss.step = i;
    miss.opposite = score.opposite[i];
    miss.since_m = path_m[i] - mark_m;
    miss.target_step = *score.revisit_targets[i];
    const StepEnd end = result.steps[i].back_end.end;
    const auto verdict = verdicts.find(i);
    if (verdict != verdicts.end())
      miss.cause = CauseOf(verdict->second);
    else
      miss.cause = end == StepEnd::kRecognized ? CauseOf(ClosureVerdict::kUnmatched) : ToString(end);
    missed.push_back(miss);
  }
  return missed;
}

std::map<std::string, std::size_t> CountCauses(const std::vector<MissedRevisit>& missed) {
  std::map<std::string, std::size_t> causes;
  for (const MissedRevisit& miss : missed) ++causes[miss.cause];
  return causes;
}

std::vector<AcceptancePoint> AcceptanceCurve(const EvaluationResult& result) {
  std::vector<AcceptancePoint> curve;
  if (!result.score) return curve;
  std::vector<const JudgedRecognition*> ranked;
  for (const JudgedRecognition& recognition : result.recognitions) {
    const ClosureVerdict verdict = recognition.judged.verdict;
    if (verdict == ClosureVerdict::kTrue || verdict == ClosureVerdict::kFalse) ranked.push_back(&recognition);
  }
  std::stable_sort(ranked.begin(), ranked.end(), [&](const JudgedRecognition* a, const JudgedRecognition* b) {
    return Strength(a->evidence, result.acceptance) > Strength(b->evidence, result.acceptance);
  });
  std::size_t true_ones = 0;
  std::set<std::size_t> found;
  for (std::size_t i = 0; i < ranked.size(); ++i) {
    const JudgedClosure& judged = ranked[i]->judged;
    true_ones += judged.verdict == ClosureVerdict::kTrue;
    if (judged.verdict == ClosureVerdict::kTrue && result.score->revisit_targets[judged.query_step])
      found.insert(judged.query_step);
    const double strength = Strength(ranked[i]->evidence, result.acceptance);
    if (i + 1 < ranked.size() && Strength(ranked[i + 1]->evidence, result.acceptance) == strength) continue;
    AcceptancePoint point;
    point.threshold = strength;
    point.accepted = i + 1;
    point.precision = static_cast<double>(true_ones) / static_cast<double>(i + 1);
    point.recall = result.score->revisits == 0
                       ? kNaN
                       : static_cast<double>(found.size()) / static_cast<double>(result.score->revisits);
    curve.push_back(point);
  }
  return curve;
}

std::vector<StageStatistics> MeasureStages(const std::vector<StepRecord>& steps) {
  std::vector<StageStatistics> table;
  for (const std::string& name : StageNames(steps)) {
    table.push_back(Measure(name, Values(steps, [&](const StepRecord& step) { return StageMs(step, name); })));
  }
  table.push_back(Measure("total", Values(steps, [](const StepRecord& step) { return step.total_ms; })));
  table.push_back(Measure("reading, apart", Values(steps, [](const StepRecord& step) { return step.read_ms; })));
  std::vector<double> optimizations_ms;
  for (const StepRecord& step : steps) {
    if (step.optimize_ms > 0.0) optimizations_ms.push_back(step.optimize_ms);
  }
  table.push_back(Measure("optimizing, apart", optimizations_ms));
  return table;
}

std::vector<std::string> StageNames(const std::vector<StepRecord>& steps) {
  std::vector<std::string> names;
  std::set<std::string> known;
  for (const StepRecord& step : steps) {
    for (const auto& stage : step.stages) {
      if (known.insert(stage.first).second) names.push_back(stage.first);
    }
  }
  return names;
}

double StageMs(const StepRecord& step, const std::string& name) {
  double total_ms = 0.0;
  for (const auto& stage : step.stages) total_ms += stage.first == name ? stage.second : 0.0;
  return total_ms;
}

std::vector<FunnelColumn> FunnelColumns() {
  return {{"points", [](const StepRecord& s) { return s.front_end.points; }},
          {"points_obstacle", [](const StepRecord& s) { return s.front_end.obstacle_points; }},
          {"points_nonfinite", [](const StepRecord& s) { return s.front_end.dropped_nonfinite; }},
          {"points_outside", [](const StepRecord& s) { return s.front_end.dropped_outside; }},
          {"voxels", [](const StepRecord& s) { return s.front_end.voxels; }},
          {"voxels_activated", [](const StepRecord& s) { return s.front_end.activated_voxels; }},
          {"voxels_moved", [](const StepRecord& s) { return s.front_end.moved_voxels; }},
          {"voxels_removed", [](const StepRecord& s) { return s.front_end.removed_voxels; }},
          {"clusters", [](const StepRecord& s) { return s.front_end.clusters.clusters; }},
          {"clusters_too_small", [](const StepRecord& s) { return s.front_end.clusters.too_small; }},
          {"clusters_too_large", [](const StepRecord& s) { return s.front_end.clusters.too_large; }},
          {"clusters_cut", [](const StepRecord& s) { return s.front_end.clusters.cut; }},
          {"clusters_trails", [](const StepRecord& s) { return s.front_end.clusters.trails; }},
          {"segments", [](const StepRecord& s) { return s.front_end.clusters.segments; }},
          {"described", [](const StepRecord& s) { return s.described; }},
          {"target_segments", [](const StepRecord& s) { return s.back_end.target_segments; }},
          {"allowed_targets", [](const StepRecord& s) { return s.back_end.allowed_targets; }},
          {"requeried", [](const StepRecord& s) { return s.back_end.requeried; }},
          {"candidates", [](const StepRecord& s) { return s.back_end.candidates; }},
          {"tested_pairs", [](const StepRecord& s) { return s.back_end.tested_pairs; }},
          {"edges", [](const StepRecord& s) { return s.back_end.edges; }},
          {"clique", [](const StepRecord& s) { return s.back_end.clique; }}};
}

std::vector<EvidenceColumn> EvidenceColumns() {
  return {{"runner_up", [](const Evidence& e) { return e.runner_up; }},
          {"distinction", [](const Evidence& e) { return e.distinction; }},
          {"track_m", [](const Evidence& e) { return e.track_m; }},
          {"track_fit", [](const Evidence& e) { return e.track_fit; }},
          {"on_proven_track", [](const Evidence& e) { return e.on_proven_track; }},
          {"expected", [](const Evidence& e) { return e.expected; }},
          {"supported", [](const Evidence& e) { return e.supported; }},
          {"contradiction", [](const Evidence& e) { return e.contradiction; }},
          {"contradiction_once", [](const Evidence& e) { return e.contradiction_once; }},
          {"overlap", [](const Evidence& e) { return e.overlap; }},
          {"sigma_m", [](const Evidence& e) { return e.sigma_m; }},
          {"sigma_rad", [](const Evidence& e) { return e.sigma_rad; }}};
}

std::map<std::string, std::size_t> CountEnds(const std::vector<StepRecord>& steps) {
  std::map<std::string, std::size_t> ends;
  for (const StepRecord& step : steps) ++ends[ToString(step.back_end.end)];
  return ends;
}

std::vector<double> PathLengths(const EvaluationResult& result) {
  return PathLengths(result.truth ? result.truth->T_world_sensor : PosesOf(result.odometry));
}

double Mean(const std::vector<double>& values) {
  double sum = 0.0;
  for (double value : values) sum += value;
  return sum / static_cast<double>(values.size());  // NaN of nothing
}

std::vector<double> Values(const std::vector<StepRecord>& steps,
                           const std::function<double(const StepRecord&)>& value) {
  std::vector<double> values;
  values.reserve(steps.size());
  for (const StepRecord& step : steps) values.push_back(value(step));
  return values;
}

std::vector<ThesisFigure> CompareWithThesis(const EvaluationResult& result) {
  const std::vector<StepRecord>& steps = result.steps;
  const auto mean = [&](const std::function<double(const StepRecord&)>& value) { return Mean(Values(steps, value)); };
  return {
      {"local_segments", "segments in a local map, mean", "51.7 (KITTI localization)",
       mean([](const StepRecord& s) { return s.front_end.clusters.segments; }), "%.1f"},
      {"step_ms", "whole step, mean, ms", "98.7 (KITTI localization), 53.6 (KITTI loop closure)",
       mean([](const StepRecord& s) { return s.total_ms; }), "%.1f"},
      {"recognition_ms", "recognition, mean, ms", "8.43 (KITTI localization)", MeanStageMs(steps, "recognition"),
       "%.2f"},
      {"tested_pair_share", "share of all pairs of correspondences tested",
       "0.072 of 4.7 million (cached), 0.326 (partitions only)", TestedShare(steps), "%.3f"},
      {"localized_share", "share of the steps with a correct localization or closure",
       "0.83 (KITTI localization), 0.07 (KITTI loop closure), 0.93 (power plant)", LocalizedShare(result), "%.3f"},
      {"gaps_within_1_5_m", "distances between localizations below 1.5 m", "over 0.90; the original's less than 0.10",
       result.score_at_once ? ShareWithin(result.score_at_once->gaps_m, 1.5) : kNaN, "%.3f"}};
}

}  // namespace incremental_segmatch
