#include <cmath>
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <map>
#include <nlohmann/json.hpp>
#include <set>
#include <stdexcept>

#include "evaluation/evaluation.hpp"
#include "incremental_segmatch/pose_graph_io.hpp"

namespace incremental_segmatch {
namespace {

using Json = nlohmann::ordered_json;

// Stages in the order in which steps first ran them.
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

struct Column {
  std::string name;
  std::function<double(const StepRecord&)> value;
};

// The counts of a step, from the scan's points to the clique.
std::vector<Column> CountColumns() {
  return {{"points", [](const StepRecord& s) { return s.front_end.points; }},
          {"points_obstacle", [](const StepRecord& s) { return s.front_end.obstacle_points; }},
          {"points_nonfinite", [](const StepRecord& s) { return s.front_end.dropped_nonfinite; }},
          {"points_outside", [](const StepRecord& s) { return s.front_end.dropped_outside; }},
          {"voxels", [](const StepRecord& s) { return s.front_end.voxels; }},
          {"voxels_activated", [](const StepRecord& s) { return s.front_end.activated_voxels; }},
          {"voxels_removed", [](const StepRecord& s) { return s.front_end.removed_voxels; }},
          {"clusters", [](const StepRecord& s) { return s.front_end.clusters.clusters; }},
          {"clusters_too_small", [](const StepRecord& s) { return s.front_end.clusters.too_small; }},
          {"clusters_too_large", [](const StepRecord& s) { return s.front_end.clusters.too_large; }},
          {"clusters_cut", [](const StepRecord& s) { return s.front_end.clusters.cut; }},
          {"segments", [](const StepRecord& s) { return s.front_end.clusters.segments; }},
          {"target_segments", [](const StepRecord& s) { return s.back_end.target_segments; }},
          {"allowed_targets", [](const StepRecord& s) { return s.back_end.allowed_targets; }},
          {"requeried", [](const StepRecord& s) { return s.back_end.requeried; }},
          {"candidates", [](const StepRecord& s) { return s.back_end.candidates; }},
          {"tested_pairs", [](const StepRecord& s) { return s.back_end.tested_pairs; }},
          {"edges", [](const StepRecord& s) { return s.back_end.edges; }},
          {"clique", [](const StepRecord& s) { return s.back_end.clique; }}};
}

// The evidence of the steps that had a recognition, accepted or not; empty fields in the others.
struct EvidenceColumn {
  std::string name;
  std::function<double(const Evidence&)> value;
};

std::vector<EvidenceColumn> EvidenceColumns() {
  return {{"runner_up", [](const Evidence& e) { return e.runner_up; }},
          {"expected", [](const Evidence& e) { return e.expected; }},
          {"supported", [](const Evidence& e) { return e.supported; }},
          {"overlap", [](const Evidence& e) { return e.overlap; }},
          {"sigma_m", [](const Evidence& e) { return e.sigma_m; }},
          {"sigma_rad", [](const Evidence& e) { return e.sigma_rad; }}};
}

std::vector<double> Values(const std::vector<StepRecord>& steps,
                           const std::function<double(const StepRecord&)>& value) {
  std::vector<double> values;
  values.reserve(steps.size());
  for (const StepRecord& step : steps) values.push_back(value(step));
  return values;
}

double Mean(const std::vector<double>& values) {
  double sum = 0.0;
  for (double value : values) sum += value;
  return sum / static_cast<double>(values.size());  // NaN of nothing
}

std::vector<double> OptimizationTimes(const std::vector<StepRecord>& steps) {
  std::vector<double> times_ms;
  for (const StepRecord& step : steps) {
    if (step.optimize_ms > 0.0) times_ms.push_back(step.optimize_ms);
  }
  return times_ms;
}

// Name and milliseconds per step of each row of the stage table.
std::vector<std::pair<std::string, std::vector<double>>> StageTable(const std::vector<StepRecord>& steps) {
  std::vector<std::pair<std::string, std::vector<double>>> table;
  for (const std::string& name : StageNames(steps)) {
    table.emplace_back(name, Values(steps, [&](const StepRecord& step) { return StageMs(step, name); }));
  }
  table.emplace_back("total", Values(steps, [](const StepRecord& step) { return step.total_ms; }));
  table.emplace_back("reading, apart", Values(steps, [](const StepRecord& step) { return step.read_ms; }));
  table.emplace_back("optimizing, apart", OptimizationTimes(steps));
  return table;
}

std::map<std::string, std::size_t> Ends(const std::vector<StepRecord>& steps) {
  std::map<std::string, std::size_t> ends;
  for (const StepRecord& step : steps) ++ends[ToString(step.back_end.end)];
  return ends;
}

void WriteText(const std::string& path, const std::string& text) {
  std::ofstream file(path);
  file << text;
  file.close();
  if (!file) throw std::runtime_error("can't write " + path);
}

void WriteStepsCsv(const std::vector<StepRecord>& steps, const std::string& path) {
  std::ofstream file(path);
  if (!file) throw std::runtime_error("can't write " + path);
  const std::vector<std::string> stages = StageNames(steps);
  const std::vector<Column> counts = CountColumns();
  file.precision(6);
  file << "step,stamp,total_ms";
  for (const std::string& stage : stages) file << ',' << stage << "_ms";
  file << ",read_ms,optimize_ms";
  const std::vector<EvidenceColumn> evidence = EvidenceColumns();
  for (const Column& column : counts) file << ',' << column.name;
  for (const EvidenceColumn& column : evidence) file << ',' << column.name;
  file << ",end\n";
  for (std::size_t i = 0; i < steps.size(); ++i) {
    const StepRecord& step = steps[i];
    file << i << ',' << FormatSeconds(step.stamp_ns) << ',' << step.total_ms;
    for (const std::string& stage : stages) file << ',' << StageMs(step, stage);
    file << ',' << step.read_ms << ',' << step.optimize_ms;
    for (const Column& column : counts) file << ',' << static_cast<std::uint64_t>(column.value(step));
    for (const EvidenceColumn& column : evidence) {
      file << ',';
      if (step.back_end.evidence) file << column.value(*step.back_end.evidence);
    }
    file << ',' << ToString(step.back_end.end) << '\n';
  }
  file.close();
  if (!file) throw std::runtime_error("writing " + path + " failed: is the disk full?");
}

Json ScoreJson(const Score& score) {
  return {
      {"revisits", score.revisits},
      {"revisits_opposite", score.revisits_opposite},
      {"closures", score.closures},
      {"true_closures", score.true_closures},
      {"false_closures", score.false_closures},
      {"trivial_closures", score.trivial_closures},
      {"unmatched_closures", score.unmatched_closures},
      {"precision", score.precision},
      {"recall", score.recall},
      {"recall_same_direction", score.recall_same_direction},
      {"recall_opposite_direction", score.recall_opposite_direction},
      {"places", score.places},
      {"places_opposite", score.places_opposite},
      {"translation_error_m", {{"median", score.translation_error_median_m}, {"p95", score.translation_error_95_m}}},
      {"rotation_error_deg", {{"median", score.rotation_error_median_deg}, {"p95", score.rotation_error_95_deg}}},
      {"gap_m", {{"p50", score.gap_50_m}, {"p90", score.gap_90_m}, {"p99", score.gap_99_m}, {"max", score.gap_max_m}}}};
}

template <typename... Arguments>
std::string Format(const char* format, Arguments... arguments) {
  char text[512];
  std::snprintf(text, sizeof text, format, arguments...);
  return text;
}

// A number for people; a dash where there is none.
std::string Number(double value, const char* format) {
  return std::isnan(value) ? "-" : Format(format, value);
}

std::string FormatScore(const Score& score) {
  std::string text;
  text += Format("closures            %zu true, %zu false, %zu trivial (target too young)\n", score.true_closures,
                 score.false_closures, score.trivial_closures);
  text += Format("places              %zu with a true closure, %zu of them in the opposite direction\n", score.places,
                 score.places_opposite);
  text += "precision           " + Number(score.precision, "%.4f") + "\n";
  text += "recall              " + Number(score.recall, "%.3f") + Format(" of %zu revisits", score.revisits) +
          " (same direction " + Number(score.recall_same_direction, "%.3f") + ", opposite " +
          Number(score.recall_opposite_direction, "%.3f") + Format(" of %zu)\n", score.revisits_opposite);
  text += "closure error       median " + Number(score.translation_error_median_m, "%.3f m") + ", " +
          Number(score.rotation_error_median_deg, "%.2f deg") + "; 95 % " +
          Number(score.translation_error_95_m, "%.3f m") + ", " + Number(score.rotation_error_95_deg, "%.2f deg") +
          "\n";
  text += "gaps on revisits    50 % " + Number(score.gap_50_m, "%.1f m") + ", 90 % " +
          Number(score.gap_90_m, "%.1f m") + ", 99 % " + Number(score.gap_99_m, "%.1f m") + ", longest " +
          Number(score.gap_max_m, "%.1f m") + "\n";
  return text;
}

std::string FormatErrors(const TrajectoryErrors& errors) {
  std::string text = Format("trajectory error    %.3f m before, %.3f m after\n", errors.odometry_m, errors.optimized_m);
  text += Format("  bound             %.3f m with true closures at the same places, %.3f m at every revisit\n",
                 errors.bound_same_places_m, errors.bound_every_revisit_m);
  return text;
}

}  // namespace

std::string SummaryJson(const EvaluationResult& result) {
  Json json;
  json["drive"] = result.drive;
  json["notes"] = result.notes;
  json["odometry_is_truth"] = result.odometry_is_truth;
  json["steps"] = result.steps.size();
  json["seconds"] = result.seconds;
  json["closures"] = result.closures.size();
  json["closures_in_graph"] = result.graph_closures.size();
  json["closures_outvoted"] = result.last_optimization.outvoted_closures;
  json["score"] = result.score ? ScoreJson(*result.score) : Json();
  json["trajectory_error_m"] = nullptr;
  if (result.trajectory_error) {
    const TrajectoryErrors& errors = *result.trajectory_error;
    json["trajectory_error_m"] = {{"odometry", errors.odometry_m},
                                  {"optimized", errors.optimized_m},
                                  {"bound_same_places", errors.bound_same_places_m},
                                  {"bound_every_revisit", errors.bound_every_revisit_m}};
  }
  for (const auto& [stage, times_ms] : StageTable(result.steps)) {
    json["stages_ms"][stage] = {
        {"median", Percentile(times_ms, 0.5)}, {"p95", Percentile(times_ms, 0.95)}, {"max", Percentile(times_ms, 1.0)}};
  }
  for (const Column& column : CountColumns()) {
    const std::vector<double> values = Values(result.steps, column.value);
    json["counts"][column.name] = {
        {"mean", Mean(values)}, {"median", Percentile(values, 0.5)}, {"max", Percentile(values, 1.0)}};
  }
  json["steps_ended_by"] = Ends(result.steps);
  return json.dump(2) + "\n";
}

std::string FormatSummary(const EvaluationResult& result) {
  std::string text =
      Format("%zu steps of ", result.steps.size()) + result.drive +
      Format(" in %.1f s (%.1f a second)\n", result.seconds, static_cast<double>(result.steps.size()) / result.seconds);
  for (const std::string& note : result.notes) text += "  note: " + note + "\n";
  text += Format("\nrecognitions        %zu accepted, %zu entered the pose graph, %zu outvoted there\n",
                 result.closures.size(), result.graph_closures.size(), result.last_optimization.outvoted_closures);
  text += result.score ? FormatScore(*result.score) : "no ground truth: nothing is scored\n";
  if (result.trajectory_error) text += FormatErrors(*result.trajectory_error);
  text += "steps ended by     ";
  for (const auto& [end, count] : Ends(result.steps)) text += " " + end + Format(" %zu", count);
  const std::vector<double> segments =
      Values(result.steps, [](const StepRecord& step) { return step.front_end.clusters.segments; });
  text += "\nsegments            " + Number(Mean(segments), "%.1f") + " in a local map (mean)\n\n";
  text += Format("%-20s %9s %9s %9s\n", "stage, ms", "median", "95 %", "max");
  for (const auto& [stage, times_ms] : StageTable(result.steps)) {
    text +=
        Format("%-20s %9s %9s %9s\n", stage.c_str(), Number(Percentile(times_ms, 0.5), "%.3f").c_str(),
               Number(Percentile(times_ms, 0.95), "%.3f").c_str(), Number(Percentile(times_ms, 1.0), "%.3f").c_str());
  }
  return text;
}

void WriteResults(const EvaluationResult& result, const EvaluationParameters& parameters, const std::string& folder) {
  std::error_code error;
  std::filesystem::create_directories(folder, error);
  if (error) throw std::runtime_error("can't make the folder " + folder + ": " + error.message());
  WriteClosuresCsv(result.closures, folder + "/closures.csv");
  WriteStepsCsv(result.steps, folder + "/steps.csv");
  WriteTum(result.odometry, folder + "/trajectory_odometry.tum");
  WriteTum(result.optimized, folder + "/trajectory_optimized.tum");
  if (result.pose_graph) WriteG2o(*result.pose_graph, folder + "/pose_graph.g2o");
  WriteText(folder + "/parameters.yaml", ToYaml(parameters.core));
  WriteText(folder + "/summary.json", SummaryJson(result));
}

}  // namespace incremental_segmatch
