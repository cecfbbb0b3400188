#include <algorithm>
#include <cmath>
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <nlohmann/json.hpp>
#include <stdexcept>

#include "evaluation/analysis.hpp"
#include "evaluation/html_report.hpp"
#include "incremental_segmatch/pose_graph_io.hpp"

namespace incremental_segmatch {
namespace {

using Json = nlohmann::ordered_json;

void WriteText(const std::string& path, const std::string& text) {
  std::ofstream file(path);
  file << text;
  file.close();
  if (!file) throw std::runtime_error("can't write " + path);
}

// Whether a step is a revisit, and in which direction; nothing without ground truth.
const char* RevisitOf(const EvaluationResult& result, std::size_t step) {
  if (!result.score) return "";
  if (!result.score->revisit_targets[step]) return "no";
  return result.score->opposite[step] ? "opposite" : "same";
}

const char* ToString(ClosureVerdict verdict) {
  switch (verdict) {
    case ClosureVerdict::kTrue:
      return "true";
    case ClosureVerdict::kFalse:
      return "false";
    case ClosureVerdict::kTrivial:
      return "trivial";
    case ClosureVerdict::kUnmatched:
      return "unmatched";
  }
  return "";
}

// Of the recognition of each step that was judged, accepted or not: the later step that settled it, and whether it is true.
struct Judgement {
  std::string settled_by, verdict;
};
std::vector<Judgement> Judgements(const EvaluationResult& result) {
  std::vector<Judgement> judgements(result.steps.size());
  for (const JudgedRecognition& recognition : result.recognitions) {
    Judgement& judgement = judgements[recognition.step];
    if (recognition.settled_by) judgement.settled_by = std::to_string(*recognition.settled_by);
    if (result.score) judgement.verdict = ToString(recognition.judged.verdict);
  }
  return judgements;
}

void WriteStepsCsv(const EvaluationResult& result, const std::string& path) {
  const std::vector<StepRecord>& steps = result.steps;
  const std::vector<Judgement> judgements = Judgements(result);
  std::ofstream file(path);
  if (!file) throw std::runtime_error("can't write " + path);
  const std::vector<std::string> stages = StageNames(steps);
  const std::vector<FunnelColumn> counts = FunnelColumns();
  file.precision(6);
  file << "step,stamp,total_ms";
  for (const std::string& stage : stages) file << ',' << stage << "_ms";
  file << ",read_ms,optimize_ms";
  const std::vector<EvidenceColumn> evidence = EvidenceColumns();
  for (const FunnelColumn& column : counts) file << ',' << column.name;
  for (const EvidenceColumn& column : evidence) file << ',' << column.name;
  file << ",end,settled_by,revisit,verdict";
  const bool has_batch = !steps.empty() && steps.front().batch.has_value();
  if (has_batch) WriteBatchHeader(*steps.front().batch, file);
  file << '\n';
  for (std::size_t i = 0; i < steps.size(); ++i) {
    const StepRecord& step = steps[i];
    file << i << ',' << FormatSeconds(step.stamp_ns) << ',' << step.total_ms;
    for (const std::string& stage : stages) file << ',' << StageMs(step, stage);
    file << ',' << step.read_ms << ',' << step.optimize_ms;
    for (const FunnelColumn& column : counts) file << ',' << static_cast<std::uint64_t>(column.value(step));
    for (const EvidenceColumn& column : evidence) {
      file << ',';
      if (step.back_end.evidence) file << column.value(*step.back_end.evidence);
    }
    file << ',' << ToString(step.back_end.end) << ',' << judgements[i].settled_by;
    file << ',' << RevisitOf(result, i) << ',' << judgements[i].verdict;
    if (has_batch) WriteBatchColumns(*step.batch, file);
    file << '\n';
  }
  file.close();
  if (!file) throw std::runtime_error("writing " + path + " failed: is the disk full?");
}

void WriteMissedCsv(const EvaluationResult& result, const std::string& path) {
  std::ofstream file(path);
  if (!file) throw std::runtime_error("can't write " + path);
  file << "step,stamp,direction,since_m,nearest_old_step,cause,segments,candidates,edges,clique,clique_needed,"
          "seen_before,open,candidates_true\n";
  // How many of a step's local segments were seen before, and how many of them passed which stage.
  struct Seen {
    std::size_t before = 0, open = 0, candidates = 0;
  };
  std::vector<Seen> seen(result.steps.size());
  for (const TruePair& pair : result.true_pairs) {
    ++seen[pair.step].before;
    seen[pair.step].open += pair.allowed;
    seen[pair.step].candidates += pair.within;
  }
  for (const MissedRevisit& miss : FindMissedRevisits(result)) {
    const StepRecord& step = result.steps[miss.step];
    file << miss.step << ',' << FormatSeconds(step.stamp_ns) << ',' << (miss.opposite ? "opposite" : "same") << ','
         << miss.since_m << ',' << miss.target_step << ',' << miss.cause << ',' << step.front_end.clusters.segments
         << ',' << step.back_end.candidates << ',' << step.back_end.edges << ',' << step.back_end.clique << ','
         << result.min_clique << ',' << seen[miss.step].before << ',' << seen[miss.step].open << ','
         << seen[miss.step].candidates << '\n';
  }
  file.close();
  if (!file) throw std::runtime_error("writing " + path + " failed: is the disk full?");
}

Json GapsJson(const Score& score) {
  return {{"p50", score.gap_50_m},
          {"p90", score.gap_90_m},
          {"p99", score.gap_99_m},
          {"max", score.gap_max_m},
          {"share_within_1_5_m", ShareWithin(score.gaps_m, 1.5)}};
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
      {"normalized_error2",
       {{"median", score.normalized_error2_median}, {"share_within_95", score.normalized_error2_within_95}}},
      {"gap_m", GapsJson(score)}};
}

Json TruePairsJson(const TruePairStatistics& statistics) {
  Json within_rank = Json::object();
  for (const auto& [rank, share] : statistics.share_within_rank) within_rank[std::to_string(rank)] = share;
  return {{"pairs", statistics.pairs},
          {"steps", statistics.steps},
          {"rank", {{"median", statistics.rank_median}, {"p90", statistics.rank_90}}},
          {"share_within_rank", within_rank},
          {"kept",
           {{"allowed", statistics.kept_allowed},
            {"nearest", statistics.kept_nearest},
            {"max_distance", statistics.kept_within},
            {"consistent", statistics.kept_consistent}}},
          {"centroid_difference_m",
           {{"median", statistics.centroid_difference_median_m}, {"p90", statistics.centroid_difference_90_m}}},
          {"size_ratio", {{"median", statistics.size_ratio_median}, {"p10", statistics.size_ratio_10}}}};
}

// At most about a hundred points of the curve, both ends included.
Json AcceptanceJson(const std::vector<AcceptancePoint>& curve) {
  Json points = Json::array();
  const std::size_t every = std::max<std::size_t>(1, curve.size() / 100);
  for (std::size_t i = 0; i < curve.size(); ++i) {
    if (i % every != 0 && i + 1 != curve.size()) continue;
    points.push_back({{"threshold", curve[i].threshold},
                      {"accepted", curve[i].accepted},
                      {"precision", curve[i].precision},
                      {"recall", curve[i].recall}});
  }
  return points;
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

std::string FormatGaps(const Score& score) {
  return "50 % " + Number(score.gap_50_m, "%.1f m") + ", 90 % " + Number(score.gap_90_m, "%.1f m") + ", 99 % " +
         Number(score.gap_99_m, "%.1f m") + ", longest " + Number(score.gap_max_m, "%.1f m");
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
  text += "covariances         squared errors over them: median " + Number(score.normalized_error2_median, "%.1f") +
          " (honest: 5.3), " + Number(score.normalized_error2_within_95, "%.3f") + " within 12.6 (honest: 0.95)\n";
  text += "gaps on revisits    " + FormatGaps(score) + "\n";
  return text;
}

// What was accepted at once, where later steps settled something.
std::string FormatAtOnce(const Score& score, const Score& at_once) {
  if (score.closures == at_once.closures) return {};
  return Format("accepted at once    %zu, recall ", at_once.closures) + Number(at_once.recall, "%.3f") + ", gaps " +
         FormatGaps(at_once) + "\n";
}

std::string FormatTruePairs(const TruePairStatistics& statistics) {
  if (statistics.pairs == 0) return "true pairs          none\n";
  std::string text = Format("true pairs          %zu segments seen before, in %zu steps; target ranks ",
                            statistics.pairs, statistics.steps) +
                     Number(statistics.rank_median, "%.0f") + " in the median, 90 % " +
                     Number(statistics.rank_90, "%.0f") + "\n  target among first";
  for (const auto& [rank, share] : statistics.share_within_rank) text += Format(" %zu: ", rank) + Number(share, "%.3f");
  text += "\n  kept              allowed " + Number(statistics.kept_allowed, "%.3f") + ", nearest " +
          Number(statistics.kept_nearest, "%.3f") + ", max_distance " + Number(statistics.kept_within, "%.3f") +
          ", consistent " + Number(statistics.kept_consistent, "%.3f");
  text += "\n  centroids differ  by " + Number(statistics.centroid_difference_median_m, "%.2f m") +
          " in the median, 90 % " + Number(statistics.centroid_difference_90_m, "%.2f m") + "; size ratio " +
          Number(statistics.size_ratio_median, "%.2f") + ", a tenth below " + Number(statistics.size_ratio_10, "%.2f") +
          "\n";
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
  json["at_once"] = nullptr;
  if (const std::optional<Score>& at_once = result.score_at_once)
    json["at_once"] = {{"closures", at_once->closures}, {"recall", at_once->recall}, {"gap_m", GapsJson(*at_once)}};
  json["trajectory_error_m"] = nullptr;
  if (result.trajectory_error) {
    const TrajectoryErrors& errors = *result.trajectory_error;
    json["trajectory_error_m"] = {{"odometry", errors.odometry_m},
                                  {"optimized", errors.optimized_m},
                                  {"bound_same_places", errors.bound_same_places_m},
                                  {"bound_every_revisit", errors.bound_every_revisit_m}};
  }
  json["true_pairs"] = result.score ? TruePairsJson(MeasureTruePairs(result.true_pairs)) : Json();
  json["missed_revisits_by"] = CountCauses(FindMissedRevisits(result));
  json["acceptance_curve"] = AcceptanceJson(AcceptanceCurve(result));
  for (const ThesisFigure& figure : CompareWithThesis(result)) json["thesis_figures"][figure.key] = figure.ours;
  for (const StageStatistics& stage : MeasureStages(result.steps)) {
    json["stages_ms"][stage.name] = {{"mean", stage.mean_ms},
                                     {"median", stage.median_ms},
                                     {"p95", stage.p95_ms},
                                     {"p99", stage.p99_ms},
                                     {"max", stage.max_ms}};
  }
  json["clique_needed"] = result.min_clique;
  for (const FunnelColumn& column : FunnelColumns()) {
    const std::vector<double> values = Values(result.steps, column.value);
    json["counts"][column.name] = {
        {"mean", Mean(values)}, {"median", Percentile(values, 0.5)}, {"max", Percentile(values, 1.0)}};
  }
  json["steps_ended_by"] = CountEnds(result.steps);
  for (const StageComparison& stage : CompareStages(result.steps)) {
    json["batch_comparison"].push_back({{"stage", stage.stage},
                                        {"steps", stage.steps},
                                        {"incremental_median_ms", stage.incremental_ms},
                                        {"batch_median_ms", stage.batch_ms},
                                        {"ratio", stage.ratio()}});
  }
  return json.dump(2) + "\n";
}

std::string FormatSummary(const EvaluationResult& result) {
  std::string text =
      Format("%zu steps of ", result.steps.size()) + result.drive +
      Format(" in %.1f s (%.1f a second)\n", result.seconds, static_cast<double>(result.steps.size()) / result.seconds);
  for (const std::string& note : result.notes) text += "  note: " + note + "\n";
  const auto settled = std::count_if(result.recognitions.begin(), result.recognitions.end(),
                                     [](const JudgedRecognition& recognition) { return recognition.settled_by.has_value(); });
  text += Format("\nrecognitions        %zu accepted, %zu of them settled by later ones, %zu entered the pose graph, %zu outvoted there\n",
                 result.closures.size(), static_cast<std::size_t>(settled), result.graph_closures.size(), result.last_optimization.outvoted_closures);
  text += result.score ? FormatScore(*result.score) : "no ground truth: nothing is scored\n";
  if (result.score_at_once) text += FormatAtOnce(*result.score, *result.score_at_once);
  if (result.score) text += FormatTruePairs(MeasureTruePairs(result.true_pairs));
  if (result.trajectory_error) text += FormatErrors(*result.trajectory_error);
  text += "steps ended by     ";
  for (const auto& [end, count] : CountEnds(result.steps)) text += " " + end + Format(" %zu", count);
  if (result.score) {
    text += "\nmissed revisits by ";
    for (const auto& [cause, count] : CountCauses(FindMissedRevisits(result)))
      text += " " + cause + Format(" %zu", count);
  }
  const std::vector<double> segments =
      Values(result.steps, [](const StepRecord& step) { return step.front_end.clusters.segments; });
  text += "\nsegments            " + Number(Mean(segments), "%.1f") + " in a local map (mean)\n\n";
  text += Format("%-20s %9s %9s %9s %9s\n", "stage, ms", "median", "95 %", "99 %", "max");
  for (const StageStatistics& stage : MeasureStages(result.steps)) {
    text += Format("%-20s %9s %9s %9s %9s\n", stage.name.c_str(), Number(stage.median_ms, "%.3f").c_str(),
                   Number(stage.p95_ms, "%.3f").c_str(), Number(stage.p99_ms, "%.3f").c_str(),
                   Number(stage.max_ms, "%.3f").c_str());
  }
  const std::vector<StageComparison> comparison = CompareStages(result.steps);
  if (!comparison.empty())
    text += Format("\n%-34s %9s %9s %9s %9s\n", "medians, ms", "steps", "ours", "batch", "ratio");
  for (const StageComparison& stage : comparison) {
    text += Format("%-34s %9zu %9.3f %9.3f %9s\n", stage.stage.c_str(), stage.steps, stage.incremental_ms,
                   stage.batch_ms, Number(stage.ratio(), "%.1f").c_str());
  }
  return text;
}

void WriteResults(const EvaluationResult& result, const EvaluationParameters& parameters, const std::string& folder) {
  std::error_code error;
  std::filesystem::create_directories(folder, error);
  if (error) throw std::runtime_error("can't make the folder " + folder + ": " + error.message());
  WriteClosuresCsv(result.closures, folder + "/closures.csv");
  WriteStepsCsv(result, folder + "/steps.csv");
  if (result.score) WriteMissedCsv(result, folder + "/missed.csv");
  WriteTum(result.odometry, folder + "/trajectory_odometry.tum");
  WriteTum(result.optimized, folder + "/trajectory_optimized.tum");
  if (result.pose_graph) WriteG2o(*result.pose_graph, folder + "/pose_graph.g2o");
  WriteText(folder + "/parameters.yaml", ToYaml(parameters.core));
  WriteText(folder + "/summary.json", SummaryJson(result));
  WriteText(folder + "/report.html", ReportHtml(result));
}

}  // namespace incremental_segmatch
