#include "evaluation/html_report.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include "evaluation/analysis.hpp"
#include "evaluation/svg.hpp"

namespace incremental_segmatch {
namespace {

constexpr const char* kStyle = R"(
:root { --ink: #1a1c1e; --soft: #5d646b; --paper: #ffffff; --panel: #f4f5f6; --rule: #d9dcdf; --path: #a9b0b7;
  --true: #1f8a4c; --false: #c62828; --missed: #c77700; --blue: #2b6cb0; --blue-faint: #bcd3ea; }
@media (prefers-color-scheme: dark) { :root { --ink: #e6e8ea; --soft: #a2a9b0; --paper: #15181b; --panel: #1f2327;
  --rule: #353b41; --path: #5d666f; --true: #4cc07f; --false: #ff6b62; --missed: #f0a53a; --blue: #6cabe8;
  --blue-faint: #2c4a68; } }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 1rem; max-width: 60rem; background: var(--paper); color: var(--ink);
  font: 16px/1.45 system-ui, sans-serif; }
h1 { font-size: 1.35rem; margin: 0 0 .3rem; overflow-wrap: anywhere; }
h2 { font-size: 1.1rem; margin: 2rem 0 .4rem; }
p, ul { margin: .3rem 0 .7rem; }
p.note, li, figcaption { color: var(--soft); font-size: .9rem; }
.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(10rem, 1fr)); gap: .6rem; margin: 1rem 0; }
.tile { background: var(--panel); border-radius: .4rem; padding: .55rem .7rem; }
.tile b { display: block; font-size: 1.2rem; font-weight: 600; }
.tile span { color: var(--soft); font-size: .82rem; }
.tile b span { color: inherit; font-size: inherit; } .tile.good b { color: var(--true); } .tile.bad b { color: var(--false); }
a { color: var(--blue); } figure { margin: .5rem 0; } figure.plot { max-width: 42rem; } svg { width: 100%; height: auto; display: block; }
.table { overflow-x: auto; } table { border-collapse: collapse; font-size: .88rem; width: 100%; }
th, td { padding: .25rem .6rem; border-bottom: 1px solid var(--rule); text-align: right; vertical-align: top;
  font-variant-numeric: tabular-nums; }
th:first-child, td:first-child { text-align: left; } th { color: var(--soft); font-weight: 500; }
svg text { fill: var(--soft); font: 12px system-ui, sans-serif; }
svg text.number { fill: var(--ink); font-weight: 600; font-size: 14px; }
.grid { stroke: var(--rule); stroke-width: 1; } .axis { stroke: var(--soft); stroke-width: 1; }
.mark { stroke: var(--soft); stroke-width: 1; stroke-dasharray: 3 3; }
polyline { fill: none; stroke-linejoin: round; } .curve { stroke-width: 2; }
.c-blue { stroke: var(--blue); } .c-true { stroke: var(--true); } .c-missed { stroke: var(--missed); }
svg text.ink-c-blue { fill: var(--blue); } svg text.ink-c-true { fill: var(--true); }
svg text.ink-c-missed { fill: var(--missed); }
.path { stroke: var(--path); stroke-width: 1.5; } .odometry { stroke: var(--missed); stroke-width: 1; opacity: .7;
  stroke-dasharray: 4 3; }
.optimized { stroke: var(--blue); stroke-width: 1.2; }
.found { fill: var(--true); } .lost { fill: var(--missed); } .unjudged { fill: var(--blue); }
.wrong { fill: none; stroke: var(--false); stroke-width: 2; } line.wrong { stroke-width: 1.5; }
.bar { fill: var(--blue); } .bar-extent { fill: var(--blue-faint); }
.key { display: inline-block; width: .7em; height: .7em; border-radius: 50%; margin: 0 .3em 0 .8em; }
.key.t { background: var(--true); } .key.f { background: var(--false); } .key.m { background: var(--missed); }
.key.p { background: var(--path); } .key.b { background: var(--blue); }
@media print { :root { color-scheme: light; } body { max-width: none; padding: 0; font-size: 11pt; }
  h2, figure, .tile, tr { break-inside: avoid; } h2 { break-after: avoid; } }
)";

std::string Paragraph(const std::string& html, const char* style_class = nullptr) {
  return std::string("<p") + (style_class ? std::string(" class=\"") + style_class + "\"" : "") + ">" + html + "</p>\n";
}

std::string Heading(const std::string& text) {
  return "<h2>" + EscapeHtml(text) + "</h2>\n";
}

std::string Figure(const std::string& svg, const std::string& caption_html, const char* style_class = "plot") {
  return std::string("<figure class=\"") + style_class + "\">" + svg +
         (caption_html.empty() ? "" : "<figcaption>" + caption_html + "</figcaption>") + "</figure>\n";
}

std::string Count(std::size_t count) {
  return std::to_string(count);
}

// A figure of summary.json, which the pointer says.
std::string Tagged(const std::string& pointer, double value, const char* format) {
  return "<span data-figure=\"" + EscapeHtml(pointer) + "\">" + FormatNumber(value, format) + "</span>";
}

std::string Tagged(const std::string& pointer, std::size_t count) {
  return Tagged(pointer, static_cast<double>(count), "%.0f");
}

std::string Tile(const std::string& value, const std::string& meaning, const char* mood = "") {
  return std::string("<div class=\"tile ") + mood + "\"><b>" + value + "</b><span>" + meaning + "</span></div>\n";
}

double TotalMs(const EvaluationResult& result, double share) {
  return Percentile(Values(result.steps, [](const StepRecord& step) { return step.total_ms; }), share);
}

std::string Tiles(const EvaluationResult& result) {
  std::string tiles = "<div class=\"tiles\">\n";
  if (result.score) {
    const Score& score = *result.score;
    tiles += Tile(Tagged("/score/true_closures", score.true_closures),
                  "true closures, at " + Count(score.places) + " places", "good");
    tiles += Tile(Tagged("/score/false_closures", score.false_closures), "false closures",
                  score.false_closures > 0 ? "bad" : "good");
    tiles += Tile(Tagged("/score/precision", score.precision, "%.4f"), "precision");
    tiles += Tile(Tagged("/score/recall", score.recall, "%.3f"), "recall over " + Count(score.revisits) + " revisits");
    if (score.revisits_opposite > 0) {
      tiles += Tile(Tagged("/score/recall_opposite_direction", score.recall_opposite_direction, "%.3f"),
                    "recall in the opposite direction, of " + Count(score.revisits_opposite));
    }
    tiles += Tile(Tagged("/score/translation_error_m/median", score.translation_error_median_m, "%.3f") + " m, " +
                      Tagged("/score/rotation_error_deg/median", score.rotation_error_median_deg, "%.2f") + "°",
                  "error of a closure, median");
    tiles += Tile(Tagged("/at_once/gap_m/p99", result.score_at_once->gap_99_m, "%.1f") + " m",
                  "99 % of the gaps between closures are shorter");
  } else {
    tiles += Tile(Tagged("/closures", result.closures.size()), "closures; no ground truth, nothing is judged");
  }
  if (result.trajectory_error) {
    tiles += Tile(Tagged("/trajectory_error_m/odometry", result.trajectory_error->odometry_m, "%.2f") + " → " +
                      Tagged("/trajectory_error_m/optimized", result.trajectory_error->optimized_m, "%.2f") + " m",
                  "trajectory error before and after");
  }
  tiles += Tile(Tagged("/stages_ms/total/median", TotalMs(result, 0.5), "%.1f") + " ms, " +
                    Tagged("/stages_ms/total/p99", TotalMs(result, 0.99), "%.1f") + " ms",
                "a step, median and 99 %");
  return tiles + "</div>\n";
}

// Consecutive missed revisits: a stretch where nothing was found.
struct Stretch {
  std::size_t first = 0, last = 0;
  double length_m = 0.0;
  bool opposite = false;
  std::map<std::string, std::size_t> causes;
};

std::vector<Stretch> LongestStretches(const std::vector<MissedRevisit>& missed, const std::vector<double>& path_m,
                                      std::size_t most) {
  std::vector<Stretch> stretches;
  for (const MissedRevisit& miss : missed) {
    if (stretches.empty() || stretches.back().last + 1 != miss.step) {
      stretches.emplace_back();
      stretches.back().first = miss.step;
      stretches.back().opposite = miss.opposite;
    }
    Stretch& stretch = stretches.back();
    stretch.last = miss.step;
    ++stretch.causes[miss.cause];
    stretch.length_m = path_m[std::min(stretch.last + 1, path_m.size() - 1)] - path_m[stretch.first];
  }
  std::stable_sort(stretches.begin(), stretches.end(),
                   [](const Stretch& a, const Stretch& b) { return a.length_m > b.length_m; });
  if (stretches.size() > most) stretches.resize(most);
  return stretches;
}

// Places the plane of a drive in a drawing of a given width.
class Projection {
 public:
  Projection(const std::vector<std::vector<Eigen::Vector2d>>& paths, double width) {
    Eigen::Vector2d low = Eigen::Vector2d::Constant(std::numeric_limits<double>::infinity()), high = -low;
    for (const auto& path : paths) {
      for (const Eigen::Vector2d& p : path) {
        low = low.cwiseMin(p);
        high = high.cwiseMax(p);
      }
    }
    // The longer side lies along the page.
    turned_ = high.y() - low.y() > high.x() - low.x();
    if (turned_) {
      low_ = {low.y(), -high.x()};
      high_ = {high.y(), -low.x()};
    } else {
      low_ = low;
      high_ = high;
    }
    const Eigen::Vector2d size = (high_ - low_).cwiseMax(20.0);
    scale_ = (width - 2 * kMargin) / size.x();
    height_ = scale_ * size.y() + 2 * kMargin;
  }

  Eigen::Vector2d operator()(Eigen::Vector2d p) const {
    if (turned_) p = {p.y(), -p.x()};
    return {kMargin + scale_ * (p.x() - low_.x()), height_ - kMargin - scale_ * (p.y() - low_.y())};
  }
  double height() const { return height_; }
  double scale() const { return scale_; }

 private:
  static constexpr double kMargin = 16.0;
  bool turned_ = false;
  Eigen::Vector2d low_, high_;
  double scale_ = 1.0, height_ = 0.0;
};

std::vector<Eigen::Vector2d> InPlane(const std::vector<Pose>& poses, const Pose& T_world_frame) {
  std::vector<Eigen::Vector2d> path;
  for (const Pose& pose : poses) path.push_back((T_world_frame * pose.translation()).head<2>());
  return path;
}

std::vector<Eigen::Vector2d> Projected(const std::vector<Eigen::Vector2d>& path, const Projection& project) {
  std::vector<Eigen::Vector2d> projected;
  for (const Eigen::Vector2d& p : path) projected.push_back(project(p));
  return projected;
}

void DrawScale(const Projection& project, Svg* svg) {
  double metres = 10.0;
  while (metres * project.scale() < 60.0) metres *= metres == 20.0 || metres == 200.0 ? 2.5 : 2.0;
  const double y = project.height() - 6;
  svg->Line(16, y, 16 + metres * project.scale(), y, "axis");
  svg->Text(20 + metres * project.scale(), y + 3, FormatNumber(metres, "%.0f m"));
}

std::string Map(const EvaluationResult& result, const std::vector<Stretch>& stretches) {
  constexpr double kWidth = 640.0;
  const bool has_truth = result.truth.has_value();
  const std::vector<Pose> odometry = PosesOf(result.odometry), optimized = PosesOf(result.optimized);
  const std::vector<Pose>& reference = has_truth ? result.truth->T_world_sensor : optimized;
  const auto aligned = [&](const std::vector<Pose>& poses) {
    return InPlane(poses, AlignTrajectory(poses, reference));
  };
  const std::vector<Eigen::Vector2d> path = InPlane(reference, Pose::Identity()), before = aligned(odometry),
                                     after = aligned(optimized);
  std::vector<Eigen::Vector2d> targets = path;
  if (result.map_truth) targets = InPlane(result.map_truth->T_world_sensor, Pose::Identity());
  const Projection project({path, before, after, targets}, kWidth);
  Svg svg(kWidth, project.height() + 4, "Map of the drive with its closures");
  if (result.map_truth) svg.Path(Projected(targets, project), "path");
  if (result.pose_graph && has_truth) svg.Path(Projected(before, project), "odometry");
  svg.Path(Projected(path, project), "path");
  if (result.pose_graph && has_truth) svg.Path(Projected(after, project), "optimized");
  const auto at = [&](std::size_t step) { return project(path[step]); };
  const auto tip = [&](std::size_t step) {
    return "step " + Count(step) + ", " +
           FormatNumber(1e-9 * static_cast<double>(result.steps[step].stamp_ns), "%.1f s");
  };
  if (!result.score) {
    for (const JudgedRecognition& recognition : result.recognitions) {
      if (recognition.is_accepted())
        svg.Circle(at(recognition.step).x(), at(recognition.step).y(), 2, "unjudged", tip(recognition.step));
    }
  } else {
    for (const MissedRevisit& miss : FindMissedRevisits(result))
      svg.Circle(at(miss.step).x(), at(miss.step).y(), 2, "lost", tip(miss.step) + ": " + miss.cause);
    for (const JudgedClosure& judged : result.score->judged) {
      if (judged.verdict == ClosureVerdict::kTrue)
        svg.Circle(at(judged.query_step).x(), at(judged.query_step).y(), 2, "found", tip(judged.query_step));
    }
    for (const JudgedClosure& judged : result.score->judged) {
      if (judged.verdict != ClosureVerdict::kFalse) continue;
      const Eigen::Vector2d from = at(judged.query_step), to = project(targets[judged.target_step]);
      svg.Line(from.x(), from.y(), to.x(), to.y(), "wrong");
      svg.Circle(from.x(), from.y(), 5, "wrong",
                 tip(judged.query_step) + ": off by " + FormatNumber(judged.translation_error_m, "%.2f m") + ", " +
                     FormatNumber(judged.rotation_error_deg, "%.1f°"));
    }
    for (std::size_t i = 0; i < stretches.size(); ++i) {
      const Eigen::Vector2d p = at((stretches[i].first + stretches[i].last) / 2);
      svg.Text(p.x() + 6, p.y() - 6, Count(i + 1), "start", "number");
    }
  }
  DrawScale(project, &svg);
  std::string caption = has_truth ? "<span class=\"key p\"></span>true path" : "<span class=\"key p\"></span>path";
  if (result.map_truth) caption += ", of the map's drive and of this one";
  if (result.score) {
    caption +=
        "<span class=\"key t\"></span>true closure<span class=\"key f\"></span>false closure, with its target<span "
        "class=\"key m\"></span>missed revisit";
    if (!stretches.empty()) caption += "; the numbers are those of the stretches below";
  } else {
    caption += "<span class=\"key b\"></span>closure";
  }
  if (result.pose_graph && has_truth)
    caption += "<br/>blue line: optimized path; dashed: odometry, both aligned with the truth";
  return Figure(svg.Finish(), caption, "map");
}

Curve GapCurve(const std::string& name, const std::string& style, std::vector<double> gaps, double x_max) {
  std::sort(gaps.begin(), gaps.end());
  Curve curve{name, style, {}};
  for (std::size_t i = 0; i < gaps.size(); ++i) {
    const double before = static_cast<double>(i) / static_cast<double>(gaps.size());
    const double after = static_cast<double>(i + 1) / static_cast<double>(gaps.size());
    curve.points.emplace_back(gaps[i], before);
    curve.points.emplace_back(gaps[i], after);
    if (gaps[i] > x_max) break;
  }
  return curve;
}

std::string Gaps(const Score& all, const Score& score) {
  if (score.gaps_m.empty()) return {};
  Plot plot;
  plot.title = "Gaps between consecutive true closures";
  plot.x_label = "metres of revisited path between two true closures";
  plot.y_label = "share of the gaps that are at most so long";
  plot.x_max = std::max(3.0, 1.1 * score.gap_99_m);
  const bool some_came_late = all.closures > score.closures;
  plot.curves.push_back(GapCurve(some_came_late ? "at once" : "", "c-blue", score.gaps_m, plot.x_max));
  if (some_came_late) plot.curves.push_back(GapCurve("with those settled later", "c-true", all.gaps_m, plot.x_max));
  plot.x_marks = {{score.gap_50_m, "50 %: " + FormatNumber(score.gap_50_m, "%.1f m")},
                  {score.gap_90_m, "90 %: " + FormatNumber(score.gap_90_m, "%.1f m")},
                  {score.gap_99_m, "99 %: " + FormatNumber(score.gap_99_m, "%.1f m")}};
  return Heading("Gaps between localizations") +
         Figure(Draw(plot), "As figure 4.8 of the thesis, where over 90 % lie below 1.5 m. Here " +
                                FormatNumber(100.0 * ShareWithin(score.gaps_m, 1.5), "%.1f %%") + "; longest " +
                                FormatNumber(score.gap_max_m, "%.1f m") +
                                ". Both ends of each revisited stretch count.");
}

std::string Stages(const EvaluationResult& result) {
  std::vector<BarRow> rows;
  std::vector<std::vector<std::string>> table{{"stage, ms", "mean", "median", "95 %", "99 %", "max"}};
  for (const StageStatistics& stage : MeasureStages(result.steps)) {
    if (std::isnan(stage.median_ms)) continue;
    const bool apart = stage.name.find("apart") != std::string::npos;
    if (!apart)
      rows.push_back({stage.name, stage.median_ms, stage.p99_ms,
                      FormatNumber(stage.median_ms, "%.2f") + ", 99 % " + FormatNumber(stage.p99_ms, "%.1f ms")});
    const auto cell = [&](const char* key, double value) {
      return Tagged("/stages_ms/" + stage.name + "/" + key, value, "%.3f");
    };
    table.push_back({EscapeHtml(stage.name), cell("mean", stage.mean_ms), cell("median", stage.median_ms),
                     cell("p95", stage.p95_ms), cell("p99", stage.p99_ms), cell("max", stage.max_ms)});
  }
  return Heading("Where the time goes") +
         Figure(DrawBars(rows, "Time per step and stage"), "Dark: median; light: 99 %.") + HtmlTable(table);
}

std::string Acceptance(const EvaluationResult& result) {
  std::vector<AcceptancePoint> curve = AcceptanceCurve(result);
  curve.erase(std::remove_if(curve.begin(), curve.end(),
                             [](const AcceptancePoint& point) { return std::isinf(point.threshold); }),
              curve.end());
  if (curve.size() < 2) return {};
  Plot plot;
  plot.title = "Precision and recall over the acceptance threshold";
  plot.x_label = "least strength that is accepted";
  plot.y_label = "share";
  Curve precision{"precision", "c-true", {}}, recall{"recall", "c-blue", {}};
  for (auto point = curve.rbegin(); point != curve.rend(); ++point) {
    precision.points.emplace_back(point->threshold, point->precision);
    if (!std::isnan(point->recall)) recall.points.emplace_back(point->threshold, point->recall);
    plot.x_max = std::max(1.5, point->threshold);
  }
  plot.curves = {precision, recall};
  plot.x_marks = {{1.0, "as run"}};
  return Heading("What another threshold would give") +
         Figure(Draw(plot),
                Count(result.recognitions.size()) + " recognitions came as far as to be judged, " +
                    Count(result.closures.size()) +
                    " were accepted. The strength of a recognition is by what factor its evidence keeps the limits of "
                    "acceptance, at that limit where the factor is smallest: 1 and more is accepted, and a threshold "
                    "of 2 stands for limits that are all twice as strict. As run: precision " +
                    FormatNumber(result.score->precision, "%.4f") + ", recall " +
                    FormatNumber(result.score->recall, "%.3f") + ".");
}

std::string Errors(const EvaluationResult& result) {
  if (!result.trajectory_error) return {};
  const TrajectoryErrors& errors = *result.trajectory_error;
  const auto metres = [](const char* key, double value) {
    return Tagged(std::string("/trajectory_error_m/") + key, value, "%.3f") + " m";
  };
  return Heading("Trajectory") +
         HtmlTable(
             {{"root mean square error of the positions, after alignment", ""},
              {"odometry", metres("odometry", errors.odometry_m)},
              {"optimized with the " + Count(result.graph_closures.size()) + " closures that entered the pose graph",
               metres("optimized", errors.optimized_m)},
              {"bound: the same closures with their true relative poses",
               metres("bound_same_places", errors.bound_same_places_m)},
              {"bound: true closures at every revisit", metres("bound_every_revisit", errors.bound_every_revisit_m)}});
}

std::string Words(const std::map<std::string, std::size_t>& counts) {
  std::string words;
  for (const auto& [name, count] : counts) words += (words.empty() ? "" : ", ") + EscapeHtml(name) + " " + Count(count);
  return words;
}

std::string Misses(const EvaluationResult& result, const std::vector<Stretch>& stretches) {
  const std::vector<MissedRevisit> missed = FindMissedRevisits(result);
  if (missed.empty()) return {};
  std::vector<BarRow> rows;
  for (const auto& [cause, count] : CountCauses(missed))
    rows.push_back({cause, static_cast<double>(count), 0.0, Count(count)});
  std::stable_sort(rows.begin(), rows.end(), [](const BarRow& a, const BarRow& b) { return a.value > b.value; });
  std::vector<std::vector<std::string>> table{{"stretch", "steps", "length", "direction", "ended by"}};
  for (std::size_t i = 0; i < stretches.size(); ++i) {
    const Stretch& stretch = stretches[i];
    table.push_back({Count(i + 1), Count(stretch.first) + "–" + Count(stretch.last),
                     FormatNumber(stretch.length_m, "%.1f m"), stretch.opposite ? "opposite" : "same",
                     Words(stretch.causes)});
  }
  return Heading("Why revisits were missed") +
         Paragraph(Count(missed.size()) + " of " + Count(result.score->revisits) + " revisits have no true closure.") +
         Figure(DrawBars(rows, "Missed revisits by cause"), "missed.csv lists them all.") + HtmlTable(table);
}

// How far found, missed and all steps come: what a miss lacks.
std::string Funnel(const EvaluationResult& result) {
  const auto mean_of = [&](const FunnelColumn& column, const std::function<bool(std::size_t)>& counts) {
    double sum = 0.0;
    std::size_t steps = 0;
    for (std::size_t i = 0; i < result.steps.size(); ++i) {
      if (!counts(i)) continue;
      sum += column.value(result.steps[i]);
      ++steps;
    }
    return steps == 0 ? std::string("–") : FormatNumber(sum / static_cast<double>(steps), "%.1f");
  };
  std::vector<std::vector<std::string>> table{{"mean per step", "all steps"}};
  if (result.score) table.front().insert(table.front().end(), {"revisits found", "revisits missed"});
  for (const FunnelColumn& column : FunnelColumns()) {
    std::vector<std::string> row{EscapeHtml(column.name), mean_of(column, [](std::size_t) { return true; })};
    if (result.score) {
      const Score& score = *result.score;
      row.push_back(mean_of(column, [&](std::size_t i) { return score.revisit_targets[i] && score.found[i]; }));
      row.push_back(mean_of(column, [&](std::size_t i) { return score.revisit_targets[i] && !score.found[i]; }));
    }
    table.push_back(row);
  }
  return Heading("From points to a place") +
         Paragraph("A place needs a consistent set (clique) of at least " + Count(result.min_clique) +
                   " matches. What ended the steps: " + Words(CountEnds(result.steps)) + ".") +
         HtmlTable(table);
}

// Where segments that were seen before are lost.
std::string TruePairs(const EvaluationResult& result) {
  if (!result.score || result.true_pairs.empty()) return {};
  const TruePairStatistics statistics = MeasureTruePairs(result.true_pairs);
  Plot plot;
  plot.title = "Rank of the true target";
  plot.x_label = "rank of the true target among all open ones, by descriptor distance";
  plot.y_label = "share of the pairs with at most that rank";
  plot.x_max = std::max(25.0, statistics.rank_90);
  std::vector<double> ranks;
  for (const TruePair& pair : result.true_pairs)
    if (pair.allowed) ranks.push_back(static_cast<double>(pair.rank));
  std::sort(ranks.begin(), ranks.end());
  Curve curve{"", "c-blue", {}};
  for (std::size_t i = 0; i < ranks.size() && ranks[i] <= plot.x_max; ++i) {
    if (i + 1 < ranks.size() && ranks[i + 1] == ranks[i]) continue;
    curve.points.emplace_back(ranks[i], static_cast<double>(i + 1) / static_cast<double>(ranks.size()));
  }
  plot.curves = {curve};
  const auto kept = [](const char* filter, double share) {
    return Tagged(std::string("/true_pairs/kept/") + filter, share, "%.3f");
  };
  std::vector<std::vector<std::string>> table{
      {"true pairs", ""},
      {"their target is open to matching", kept("allowed", statistics.kept_allowed)},
      {"and among the nearest that are taken", kept("nearest", statistics.kept_nearest)},
      {"and within the largest distance, if one is set", kept("max_distance", statistics.kept_within)},
      {"in the consistent set of the step's recognition", kept("consistent", statistics.kept_consistent)}};
  for (const auto& [rank, share] : statistics.share_within_rank) {
    table.push_back({"target among the first " + Count(rank) + " of those that are open",
                     Tagged("/true_pairs/share_within_rank/" + Count(rank), share, "%.3f")});
  }
  const auto metres = [](const char* which, double value) {
    return Tagged(std::string("/true_pairs/centroid_difference_m/") + which, value, "%.2f") + " m";
  };
  table.push_back({"centroids differ by, median and 90 %", metres("median", statistics.centroid_difference_median_m) +
                                                               ", " +
                                                               metres("p90", statistics.centroid_difference_90_m)});
  table.push_back({"voxels of the smaller over the larger, median, and a tenth is below",
                   Tagged("/true_pairs/size_ratio/median", statistics.size_ratio_median, "%.2f") + ", " +
                       Tagged("/true_pairs/size_ratio/p10", statistics.size_ratio_10, "%.2f")});
  return Heading("Segments seen before") +
         Paragraph(Tagged("/true_pairs/pairs", statistics.pairs) + " local segments of " +
                   Tagged("/true_pairs/steps", statistics.steps) +
                   " revisits have a target: a segment of the map whose centroid lies within 1 m of theirs, both "
                   "placed by the true poses of the scans that they were seen from, and which was seen long enough "
                   "ago. Its rank is " +
                   Tagged("/true_pairs/rank/median", statistics.rank_median, "%.0f") + " in the median, at 90 % " +
                   Tagged("/true_pairs/rank/p90", statistics.rank_90, "%.0f") + ".") +
         Figure(Draw(plot), "The nearer to the upper left corner, the better the descriptor.") + HtmlTable(table);
}

std::string Thesis(const EvaluationResult& result) {
  std::vector<std::vector<std::string>> table{{"", "this run", "thesis"}};
  for (const ThesisFigure& figure : CompareWithThesis(result))
    table.push_back({EscapeHtml(figure.what), Tagged("/thesis_figures/" + figure.key, figure.ours, figure.format),
                     EscapeHtml(figure.thesis)});
  return Heading("Beside the thesis") + HtmlTable(table) +
         Paragraph(
             "M. Gollub, Incremental Place Recognition in 3D Point Clouds, ETH Zürich, 2017; one thread of an "
             "i7-2600K, "
             "other drives than this one. Most of its table 4.1 is lost.",
             "note");
}

}  // namespace

std::string HtmlPage(const std::string& title, const std::string& body) {
  return "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\"/>\n<meta name=\"viewport\" "
         "content=\"width=device-width, initial-scale=1\"/>\n<meta name=\"color-scheme\" content=\"light "
         "dark\"/>\n<title>" +
         EscapeHtml(title) + "</title>\n<style>" + kStyle + "</style>\n</head>\n<body>\n<h1>" + EscapeHtml(title) +
         "</h1>\n" + body + "</body>\n</html>\n";
}

std::string HtmlTable(const std::vector<std::vector<std::string>>& rows) {
  std::string table = "<div class=\"table\"><table>\n";
  for (std::size_t i = 0; i < rows.size(); ++i) {
    table += "<tr>";
    for (const std::string& cell : rows[i]) table += (i == 0 ? "<th>" : "<td>") + cell + (i == 0 ? "</th>" : "</td>");
    table += "</tr>\n";
  }
  return table + "</table></div>\n";
}

std::string ReportHtml(const EvaluationResult& result) {
  const std::vector<double> path_m = PathLengths(result);
  const std::vector<Stretch> stretches = LongestStretches(FindMissedRevisits(result), path_m, 8);
  std::string body =
      Paragraph(Count(result.steps.size()) + " steps, " + FormatNumber(path_m.empty() ? 0.0 : path_m.back(), "%.0f m") +
                " of path, " + (result.map_truth ? "localization in a saved map" : "loop closure") + "; run in " +
                FormatNumber(result.seconds, "%.0f s") + ".");
  if (!result.notes.empty()) {
    body += "<ul>\n";
    for (const std::string& note : result.notes) body += "<li>" + EscapeHtml(note) + "</li>\n";
    body += "</ul>\n";
  }
  body += Tiles(result);
  if (!result.steps.empty()) body += Map(result, stretches);
  if (result.score) {
    body += Paragraph(
        "A closure counts if its target is more than 60 s and 50 m of path older (any pose of the map in "
        "localization), and is true if its relative pose is within 1 m and 3° of the truth. A revisit is a step "
        "within 5 m of such a pose.",
        "note");
    body += Gaps(*result.score, *result.score_at_once);
    body += Misses(result, stretches);
  }
  body += Funnel(result) + TruePairs(result) + Acceptance(result) + Errors(result) + Stages(result) + Thesis(result);
  return HtmlPage(result.drive, body);
}

}  // namespace incremental_segmatch
