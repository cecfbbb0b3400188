// What a run says beyond its score: misses, acceptance curve, page and tables, against literal restatements.
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <nlohmann/json.hpp>
#include <random>
#include <set>
#include <string>
#include <vector>

#include "evaluation/analysis.hpp"
#include "evaluation/html_report.hpp"
#include "evaluation/run_table.hpp"
#include "evaluation/thesis_page.hpp"
#include "support/temporary_directory.hpp"

namespace incremental_segmatch {
namespace {

// Twice around a circle of 30 m radius, a minute and a half each, with recognitions on the second lap: most of them
// true, some false, some refused.
EvaluationResult RandomResult(unsigned seed) {
  std::mt19937 random(seed);
  std::uniform_real_distribution<double> uniform(0.0, 1.0);
  EvaluationResult result;
  result.drive = "a & b <c>";
  result.notes = {"a note"};
  result.min_clique = 6;
  result.seconds = 12.0;
  result.truth.emplace();
  std::vector<ClosureRow> at_once;
  constexpr int kPerLap = 300;
  for (int i = 0; i < 2 * kPerLap; ++i) {
    const double angle = 2 * M_PI * i / kPerLap;
    Pose T = Pose::Identity();
    T.translation() << 30 * std::cos(angle), 30 * std::sin(angle), 0.0;
    T.linear() = Eigen::AngleAxisd(angle + M_PI / 2, Eigen::Vector3d::UnitZ()).toRotationMatrix();
    const StampNs stamp_ns = StampNs{300000000} * i;
    result.truth->stamps_ns.push_back(stamp_ns);
    result.truth->T_world_sensor.push_back(T);
    result.odometry.push_back({stamp_ns, T});
    StepRecord step;
    step.stamp_ns = stamp_ns;
    step.total_ms = 10.0 * uniform(random);
    step.stages = {{"ground_filter", uniform(random)}, {"recognition", uniform(random)}};
    step.front_end.points = 1000;
    step.front_end.clusters.segments = 40;
    step.back_end.candidates = 100;
    step.back_end.tested_pairs = 495;
    step.back_end.end = i < kPerLap ? StepEnd::kNoTargets : StepEnd::kCliqueTooSmall;
    if (i >= kPerLap && uniform(random) < 0.7) {
      Evidence evidence;
      evidence.expected = 20;
      evidence.supported = static_cast<std::size_t>(20 * uniform(random));
      ClosureRow row;
      row.stamp_query_ns = stamp_ns;
      row.stamp_target_ns = stamp_ns - StampNs{300000000} * kPerLap;
      row.T_target_query.translation().x() = uniform(random) < 0.2 ? 3.0 : 0.3 * uniform(random);
      evidence.contradiction = 0.08 * uniform(random);
      const bool accepted = Judge(evidence, result.acceptance) == Verdict::kAccepted;
      const bool is_settled_later = accepted && uniform(random) < 0.2;
      if (is_settled_later) evidence.since_twin_m = 0.0;
      step.back_end.evidence = evidence;
      step.back_end.end = !accepted ? StepEnd::kUncovered : is_settled_later ? StepEnd::kAmbiguous : StepEnd::kRecognized;
      evidence.on_proven_track = is_settled_later;
      result.recognitions.push_back({static_cast<std::size_t>(i), row, evidence, step.back_end.end, {}});
      if (is_settled_later) result.recognitions.back().settled_by = i + 1;
      if (accepted) result.closures.push_back(row);
      if (accepted && !is_settled_later) at_once.push_back(row);
    }
    if (i >= kPerLap) {
      TruePair pair;
      pair.step = static_cast<std::size_t>(i);
      pair.centroid_difference_m = uniform(random);
      pair.size_ratio = uniform(random);
      pair.allowed = uniform(random) < 0.9;
      pair.rank = pair.allowed ? 1 + random() % 200 : 0;
      pair.nearest = pair.within = pair.allowed && pair.rank <= 25;
      pair.consistent = pair.nearest && uniform(random) < 0.5;
      result.true_pairs.push_back(pair);
    }
    result.steps.push_back(step);
  }
  result.optimized = result.odometry;
  result.score = ScoreClosures(*result.truth, result.closures, {});
  result.score_at_once = ScoreClosures(*result.truth, at_once, {});
  std::vector<ClosureRow> rows;
  for (const JudgedRecognition& recognition : result.recognitions) rows.push_back(recognition.closure);
  const Score judged = ScoreClosures(*result.truth, rows, {});
  for (std::size_t i = 0; i < rows.size(); ++i) result.recognitions[i].judged = judged.judged[i];
  result.trajectory_error = TrajectoryErrors{3.25, 0.5, 0.375, 0.25};
  return result;
}

TEST(Analysis, EveryMissedRevisitHasItsCause) {
  for (unsigned seed = 1; seed <= 5; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    const EvaluationResult result = RandomResult(seed);
    const std::vector<MissedRevisit> missed = FindMissedRevisits(result);
    std::size_t next = 0;
    for (std::size_t i = 0; i < result.steps.size(); ++i) {
      if (!result.score->revisit_targets[i] || result.score->found[i]) continue;
      ASSERT_LT(next, missed.size());
      const MissedRevisit& miss = missed[next++];
      EXPECT_EQ(miss.step, i);
      const auto has_closure = [&](const ClosureRow& row) { return row.stamp_query_ns == result.steps[i].stamp_ns; };
      const bool is_wrong = std::any_of(result.closures.begin(), result.closures.end(), has_closure);
      EXPECT_EQ(miss.cause, is_wrong ? "false_closure" : ToString(result.steps[i].back_end.end));
      // Metres back to the last step that was found, or to the beginning of the stretch.
      std::size_t mark = i;
      while (mark > 0 && result.score->revisit_targets[mark - 1] && !result.score->found[mark]) --mark;
      const double step_m = 60 * std::sin(M_PI / 300);
      EXPECT_NEAR(miss.since_m, step_m * static_cast<double>(i - mark), 1e-9);
    }
    EXPECT_EQ(next, missed.size());
    std::size_t counted = 0;
    for (const auto& [cause, count] : CountCauses(missed)) counted += count;
    EXPECT_EQ(counted, missed.size());
    EXPECT_GT(CountCauses(missed)["false_closure"], 0u) << "the test must see every case";
    EXPECT_GT(CountCauses(missed)["uncovered"], 0u);
  }
}

TEST(Analysis, AcceptanceCurveHasTheRunItselfAtAStrengthOfOne) {
  const EvaluationResult result = RandomResult(1);
  const std::vector<AcceptancePoint> curve = AcceptanceCurve(result);
  const auto as_run = std::find_if(curve.rbegin(), curve.rend(),
                                   [](const AcceptancePoint& point) { return point.threshold >= 1.0; });
  ASSERT_NE(as_run, curve.rend());
  EXPECT_EQ(as_run->accepted, result.closures.size());
  EXPECT_DOUBLE_EQ(as_run->precision, result.score->precision);
  EXPECT_DOUBLE_EQ(as_run->recall, result.score->recall);
  EXPECT_GT(curve.back().accepted, result.closures.size()) << "refused recognitions belong to the curve";
}

TEST(Analysis, AcceptanceCurveEqualsAcceptingAnewAtEveryThreshold) {
  for (unsigned seed = 1; seed <= 5; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    const EvaluationResult result = RandomResult(seed);
    const std::vector<AcceptancePoint> curve = AcceptanceCurve(result);
    std::set<double> strengths;
    for (const JudgedRecognition& recognition : result.recognitions) strengths.insert(Strength(recognition.evidence, result.acceptance));
    ASSERT_EQ(curve.size(), strengths.size());
    ASSERT_GT(curve.size(), 5u);
    for (const AcceptancePoint& point : curve) {
      std::vector<ClosureRow> accepted;
      for (const JudgedRecognition& recognition : result.recognitions) {
        if (Strength(recognition.evidence, result.acceptance) >= point.threshold) accepted.push_back(recognition.closure);
      }
      const Score score = ScoreClosures(*result.truth, accepted, {});
      EXPECT_EQ(point.accepted, accepted.size());
      EXPECT_DOUBLE_EQ(point.precision, score.precision);
      EXPECT_DOUBLE_EQ(point.recall, score.recall);
    }
  }
}

// The names of the elements that are open at the end of a text, as XML has them; "?" where one is closed that is not
// the last one opened.
std::string OpenElements(const std::string& html) {
  std::vector<std::string> open;
  for (std::size_t at = html.find('<'); at != std::string::npos; at = html.find('<', at + 1)) {
    const std::size_t end = html.find('>', at);
    if (end == std::string::npos) return "?";
    if (html.compare(at, 2, "<!") == 0) continue;
    const std::string tag = html.substr(at + 1, end - at - 1);
    if (tag.find('<') != std::string::npos) return "?";
    if (tag.back() == '/') continue;
    const std::string name = tag.substr(0, tag.find(' '));
    if (name[0] != '/') {
      open.push_back(name);
    } else if (open.empty() || open.back() != name.substr(1)) {
      return "?";
    } else {
      open.pop_back();
    }
  }
  std::string names;
  for (const std::string& name : open) names += name + " ";
  return names;
}

TEST(Report, IsWellFormedAndComesAlone) {
  const std::string html = ReportHtml(RandomResult(1));
  EXPECT_EQ(OpenElements(html), "");
  EXPECT_NE(html.find("a &amp; b &lt;c&gt;"), std::string::npos);
  for (const char* from_elsewhere : {"http:", "https:", "<script", "<link", "@import", "url("})
    EXPECT_EQ(html.find(from_elsewhere), std::string::npos) << from_elsewhere;
  EXPECT_EQ(OpenElements("<p>a<br/></p>"), "") << "the test's own reader";
  EXPECT_EQ(OpenElements("<p><b></p>"), "?");
  EXPECT_EQ(OpenElements("<p>"), "p ");
}

TEST(Report, ItsNumbersAreThoseOfTheSummary) {
  const EvaluationResult result = RandomResult(2);
  const std::string html = ReportHtml(result);
  const nlohmann::json summary = nlohmann::json::parse(SummaryJson(result));
  std::size_t figures = 0;
  const std::string tag = "data-figure=\"";
  for (std::size_t at = html.find(tag); at != std::string::npos; at = html.find(tag, at + 1)) {
    const std::size_t begin = at + tag.size(), end = html.find('"', begin), text = html.find('>', end) + 1;
    const std::string pointer = html.substr(begin, end - begin);
    const std::string word = html.substr(text, html.find('<', text) - text);
    SCOPED_TRACE(pointer + ": " + word);
    ASSERT_TRUE(summary.contains(nlohmann::json::json_pointer(pointer)));
    const nlohmann::json& value = summary.at(nlohmann::json::json_pointer(pointer));
    ++figures;
    if (value.is_null()) {
      EXPECT_EQ(word, "–");
      continue;
    }
    const std::size_t point = word.find('.');
    const double half_digit =
        0.5 * std::pow(10.0, point == std::string::npos ? 0.0 : -static_cast<double>(word.size() - point - 1));
    EXPECT_NEAR(std::stod(word), value.get<double>(), 1.001 * half_digit);
  }
  EXPECT_GT(figures, 30u);
  // A mark for each true closure and each miss, a ring and a line for each false closure.
  const auto count = [&](const std::string& word) {
    std::size_t times = 0;
    for (std::size_t at = html.find(word); at != std::string::npos; at = html.find(word, at + 1)) ++times;
    return times;
  };
  EXPECT_EQ(count("<circle class=\"found\""), result.score->true_closures);
  EXPECT_EQ(count("<circle class=\"lost\""), FindMissedRevisits(result).size());
  EXPECT_EQ(count("<circle class=\"wrong\""), result.score->false_closures);
  EXPECT_EQ(count("<line class=\"wrong\""), result.score->false_closures);
  EXPECT_GT(result.score->false_closures, 0u);
}

TEST(Report, ComesOfRunsWithoutTruthAndWithoutSteps) {
  EvaluationResult unjudged = RandomResult(3);
  unjudged.truth.reset();
  unjudged.score.reset();
  unjudged.score_at_once.reset();
  unjudged.trajectory_error.reset();
  EXPECT_EQ(OpenElements(ReportHtml(unjudged)), "");
  EXPECT_NE(ReportHtml(unjudged).find("nothing is judged"), std::string::npos);
  EvaluationResult nothing;
  nothing.drive = "nothing";
  EXPECT_EQ(OpenElements(ReportHtml(nothing)), "");
}

TEST(ThesisPage, ShowsBothExperimentsBesideTheThesis) {
  std::vector<ThesisRun> runs;
  for (const bool is_localization : {false, true}) {
    runs.push_back({"the <drive>", is_localization, "folder/report.html", RandomResult(is_localization ? 5 : 4)});
    for (StepRecord& step : runs.back().result.steps) {
      // Eight times as long for the grid, in every step.
      step.stages = {{"voxel_insertion", 0.5}};
      step.batch.emplace();
      step.batch->stages = {{"voxel_grid", 4.0}};
    }
  }
  const std::string page = ThesisPage(runs);
  EXPECT_EQ(OpenElements(page), "");
  EXPECT_NE(page.find("the &lt;drive&gt;, localization"), std::string::npos);
  EXPECT_NE(page.find("<td>8.0 (4.00 / 0.500 ms)</td><td>8.0 (4.00 / 0.500 ms)</td><td>8.08</td>"), std::string::npos);
  EXPECT_NE(page.find("<td>" + std::to_string(runs[1].result.score->true_closures) + "</td>"), std::string::npos);
}

TEST(RunTable, GivesMeanAndRangeOverRuns) {
  const test::TemporaryDirectory directory;
  std::vector<std::string> paths;
  std::vector<double> recalls;
  std::size_t closures = 0, false_ones = 0;
  for (unsigned seed = 1; seed <= 3; ++seed) {
    const EvaluationResult result = RandomResult(seed);
    paths.push_back(directory.Write("summary" + std::to_string(seed) + ".json", SummaryJson(result)));
    recalls.push_back(result.score->recall);
    closures += result.score->closures;
    false_ones += result.score->false_closures;
  }
  const std::vector<RunGroup> groups{{"circle", paths}, {"again", {paths[0]}}};
  const nlohmann::json table = nlohmann::json::parse(RunTableJson(groups));
  EXPECT_NEAR(table["circle"]["recall"]["mean"].get<double>(), (recalls[0] + recalls[1] + recalls[2]) / 3, 1e-12);
  EXPECT_EQ(table["circle"]["recall"]["least"], *std::min_element(recalls.begin(), recalls.end()));
  EXPECT_EQ(table["circle"]["recall"]["greatest"], *std::max_element(recalls.begin(), recalls.end()));
  EXPECT_EQ(table["circle"]["false_closures"], false_ones);
  EXPECT_NEAR(table["circle"]["precision"].get<double>(),
              1.0 - static_cast<double>(false_ones) / static_cast<double>(closures), 1e-12);
  EXPECT_TRUE(table["circle"]["recall_opposite"].is_null()) << "nothing was driven in the opposite direction";
  EXPECT_EQ(table["all"]["runs"], 4);
  EXPECT_EQ(table["again"]["ate_over_bound"]["mean"], 2.0);
  const std::string markdown = RunTableMarkdown(groups);
  EXPECT_NE(markdown.find("| circle | 3 |"), std::string::npos);
  EXPECT_NE(markdown.find("false_closure "), std::string::npos);
  EXPECT_THROW(RunTableMarkdown({{"x", {directory.path() + "/nothing.json"}}}), std::runtime_error);
  EXPECT_THROW(RunTableMarkdown({{"x", {directory.Write("bad.json", "{")}}}), std::runtime_error);
}

}  // namespace
}  // namespace incremental_segmatch
