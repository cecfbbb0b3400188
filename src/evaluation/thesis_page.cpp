#include "evaluation/thesis_page.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include "evaluation/analysis.hpp"
#include "evaluation/html_report.hpp"
#include "evaluation/svg.hpp"

namespace incremental_segmatch {
namespace {

// Speed-ups over PCL's batch versions (thesis 4, METHOD 6), by the names of CompareStages.
struct ThesisSpeedUp {
  const char* stage;
  const char* localization;
  const char* loop_closure;
  const char* power_plant;
};

constexpr ThesisSpeedUp kSpeedUps[] = {
    {"voxel grid", "8.08", "11.18", "12.92"},  {"normals, tree included", "", "", "7.65"},
    {"normals, tree shared", "", "", "17.17"}, {"segmentation, tree included", "5.82", "5.15", "11.52"},
    {"recognition", "15.58", "15.68", "6.16"}, {"whole step", "4.84", "2.34", "7.41"},
};

std::string NameOf(const ThesisRun& run) {
  return EscapeHtml(run.drive) + (run.is_localization ? ", localization" : ", loop closure");
}

std::string FoundTable(const std::vector<ThesisRun>& runs) {
  std::vector<std::vector<std::string>> table{{"", "steps", "true", "false", "recall over revisits",
                                               "share of steps with a true one", "error, median", "gaps within 1.5 m",
                                               "step, mean and 99 %"}};
  for (const ThesisRun& run : runs) {
    if (!run.result.score) continue;
    const Score& score = *run.result.score;
    const std::vector<double> total_ms = Values(run.result.steps, [](const StepRecord& step) { return step.total_ms; });
    const auto found = std::count(score.found.begin(), score.found.end(), true);
    table.push_back(
        {"<a href=\"" + EscapeHtml(run.report) + "\">" + NameOf(run) + "</a>", std::to_string(score.steps),
         std::to_string(score.true_closures), std::to_string(score.false_closures),
         FormatNumber(score.recall, "%.3f") + " of " + std::to_string(score.revisits),
         FormatNumber(static_cast<double>(found) / static_cast<double>(std::max<std::size_t>(1, score.steps)), "%.2f"),
         FormatNumber(score.translation_error_median_m, "%.2f m") + ", " +
             FormatNumber(score.rotation_error_median_deg, "%.2f°"),
         FormatNumber(ShareWithin(score.gaps_m, 1.5), "%.3f"),
         FormatNumber(Mean(total_ms), "%.1f") + ", " + FormatNumber(Percentile(total_ms, 0.99), "%.1f ms")});
  }
  table.push_back({"thesis, KITTI localization", "", "", "", "", "0.83", "", "over 0.90", "98.7 ms"});
  table.push_back({"thesis, KITTI loop closure", "", "", "", "", "0.07", "", "", "53.6 ms"});
  return HtmlTable(table);
}

std::string SpeedUpTable(const std::vector<ThesisRun>& runs) {
  std::vector<std::vector<std::string>> table{{"batch time over ours, medians"}};
  std::vector<std::string> stages;
  std::vector<std::vector<StageComparison>> comparisons;
  for (const ThesisRun& run : runs) {
    table.front().push_back(NameOf(run));
    comparisons.push_back(CompareStages(run.result.steps));
    for (const StageComparison& stage : comparisons.back()) {
      if (std::find(stages.begin(), stages.end(), stage.stage) == stages.end()) stages.push_back(stage.stage);
    }
  }
  for (const char* column : {"thesis, localization", "thesis, loop closure", "thesis, power plant"})
    table.front().push_back(column);
  for (const std::string& name : stages) {
    std::vector<std::string> row{EscapeHtml(name)};
    for (const std::vector<StageComparison>& comparison : comparisons) {
      const auto stage = std::find_if(comparison.begin(), comparison.end(),
                                      [&](const StageComparison& candidate) { return candidate.stage == name; });
      row.push_back(stage == comparison.end()
                        ? std::string("–")
                        : FormatNumber(stage->ratio(), "%.1f") + " (" + FormatNumber(stage->batch_ms, "%.2f") + " / " +
                              FormatNumber(stage->incremental_ms, "%.3f ms") + ")");
    }
    const auto thesis = std::find_if(std::begin(kSpeedUps), std::end(kSpeedUps),
                                     [&](const ThesisSpeedUp& candidate) { return candidate.stage == name; });
    if (thesis == std::end(kSpeedUps)) {
      row.insert(row.end(), 3, "");
    } else {
      row.insert(row.end(), {thesis->localization, thesis->loop_closure, thesis->power_plant});
    }
    table.push_back(row);
  }
  return HtmlTable(table);
}

std::string GapCurves(const std::vector<ThesisRun>& runs) {
  static constexpr const char* kColours[] = {"c-blue", "c-true", "c-missed"};
  Plot plot;
  plot.title = "Gaps between localizations";
  plot.x_label = "metres driven between two localizations";
  plot.y_label = "share of the gaps";
  plot.x_max = 3.0;
  for (const ThesisRun& run : runs) {
    if (!run.is_localization || !run.result.score || run.result.score->gaps_m.empty()) continue;
    std::vector<double> gaps = run.result.score->gaps_m;
    std::sort(gaps.begin(), gaps.end());
    plot.x_max = std::max(plot.x_max, 1.1 * run.result.score->gap_99_m);
    Curve curve{run.drive, kColours[plot.curves.size() % std::size(kColours)], {}};
    for (std::size_t i = 0; i < gaps.size(); ++i)
      curve.points.emplace_back(gaps[i], static_cast<double>(i + 1) / static_cast<double>(gaps.size()));
    plot.curves.push_back(curve);
  }
  if (plot.curves.empty()) return {};
  plot.x_marks = {{1.5, "1.5 m"}};
  return "<h2>Gaps between localizations</h2>\n<figure class=\"plot\">" + Draw(plot) +
         "<figcaption>Figure 4.8 of the thesis: over 90 % of the distances between localizations are below 1.5 m, of "
         "the "
         "original's less than 10 %.</figcaption></figure>\n";
}

}  // namespace

std::string ThesisPage(const std::vector<ThesisRun>& runs) {
  return HtmlPage("The thesis's experiments",
                  "<p>Loop closure: each drive by itself. Localization: the drive of another day in the map that the "
                  "first has left. Both "
                  "beside the figures of M. Gollub, Incremental Place Recognition in 3D Point Clouds, ETH Zürich, 2017 "
                  "(one thread of an "
                  "i7-2600K).</p>\n<h2>What was found</h2>\n" +
                      FoundTable(runs) + GapCurves(runs) + "<h2>Speed-up over batch processing</h2>\n" +
                      SpeedUpTable(runs) +
                      "<p class=\"note\">Batch: the same step's input through PCL's voxel grid, normals, Euclidean "
                      "clusters or region "
                      "growing, and geometric consistency grouping, one thread.</p>\n");
}

}  // namespace incremental_segmatch
