#include "evaluation/run_table.hpp"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <fstream>
#include <limits>
#include <map>
#include <nlohmann/json.hpp>
#include <stdexcept>

namespace incremental_segmatch {
namespace {

using Json = nlohmann::ordered_json;

struct Figure {
  const char* key;      ///< in the JSON table
  const char* title;    ///< in the Markdown table
  const char* pointer;  ///< into summary.json
  const char* format;
  bool is_sum = false;  ///< over the runs, and no range
};

constexpr Figure kFigures[] = {
    {"steps", "steps", "/steps", "%.0f"},
    {"revisits", "revisits", "/score/revisits", "%.0f"},
    {"revisits_opposite", "opposite", "/score/revisits_opposite", "%.0f"},
    {"closures", "closures", "/score/closures", "%.0f", true},
    {"false_closures", "false", "/score/false_closures", "%.0f", true},
    {"recall", "recall", "/score/recall", "%.3f"},
    {"recall_at_once", "recall at once", "/at_once/recall", "%.3f"},
    {"recall_opposite", "recall opposite", "/score/recall_opposite_direction", "%.3f"},
    {"gap_99_m", "gap 99 %, m", "/at_once/gap_m/p99", "%.1f"},
    {"gaps_within_1_5_m", "gaps within 1.5 m", "/at_once/gap_m/share_within_1_5_m", "%.3f"},
    {"translation_error_median_m", "error median, m", "/score/translation_error_m/median", "%.3f"},
    {"translation_error_95_m", "95 %, m", "/score/translation_error_m/p95", "%.2f"},
    {"rotation_error_median_deg", "median, °", "/score/rotation_error_deg/median", "%.2f"},
    {"rotation_error_95_deg", "95 %, °", "/score/rotation_error_deg/p95", "%.2f"},
    {"ate_odometry_m", "ATE before, m", "/trajectory_error_m/odometry", "%.2f"},
    {"ate_optimized_m", "after", "/trajectory_error_m/optimized", "%.3f"},
    {"ate_bound_m", "bound", "/trajectory_error_m/bound_every_revisit", "%.3f"},
    {"ate_over_bound", "after / bound", "", "%.2f"},
    {"step_median_ms", "step median, ms", "/stages_ms/total/median", "%.1f"},
    {"step_99_ms", "99 %, ms", "/stages_ms/total/p99", "%.1f"},
};

Json ReadJson(const std::string& path) {
  std::ifstream file(path);
  if (!file) throw std::runtime_error("can't read " + path);
  try {
    return Json::parse(file);
  } catch (const nlohmann::json::exception& error) {
    throw std::runtime_error(path + " is no summary: " + error.what());
  }
}

double NumberAt(const Json& summary, const char* pointer) {
  const Json::json_pointer at(pointer);
  if (!summary.contains(at) || !summary.at(at).is_number()) return std::numeric_limits<double>::quiet_NaN();
  return summary.at(at).get<double>();
}

double ValueOf(const Json& summary, const Figure& figure) {
  if (*figure.pointer != '\0') return NumberAt(summary, figure.pointer);
  return NumberAt(summary, "/trajectory_error_m/optimized") /
         NumberAt(summary, "/trajectory_error_m/bound_every_revisit");
}

// Over those of the runs that have the figure.
struct Spread {
  std::size_t runs = 0;
  double sum = 0.0;
  double least = std::numeric_limits<double>::infinity();
  double greatest = -std::numeric_limits<double>::infinity();

  double mean() const { return runs == 0 ? std::numeric_limits<double>::quiet_NaN() : sum / static_cast<double>(runs); }
};

Spread SpreadOf(const std::vector<Json>& summaries, const Figure& figure) {
  Spread spread;
  for (const Json& summary : summaries) {
    const double value = ValueOf(summary, figure);
    if (std::isnan(value)) continue;
    ++spread.runs;
    spread.sum += value;
    spread.least = std::min(spread.least, value);
    spread.greatest = std::max(spread.greatest, value);
  }
  return spread;
}

std::string Format(double value, const char* format) {
  char text[64];
  std::snprintf(text, sizeof text, format, value);
  return text;
}

std::string Format(const Spread& spread, const Figure& figure) {
  if (spread.runs == 0) return "–";
  if (figure.is_sum) return Format(spread.sum, figure.format);
  const std::string mean = Format(spread.mean(), figure.format), least = Format(spread.least, figure.format),
                    greatest = Format(spread.greatest, figure.format);
  return least == greatest ? mean : mean + " (" + least + " to " + greatest + ")";
}

struct Group {
  std::string drive;
  std::vector<Json> summaries;
};

std::vector<Group> Read(const std::vector<RunGroup>& groups) {
  std::vector<Group> read;
  Group all{"all", {}};
  for (const RunGroup& group : groups) {
    read.push_back({group.drive, {}});
    for (const std::string& path : group.summaries) read.back().summaries.push_back(ReadJson(path));
    all.summaries.insert(all.summaries.end(), read.back().summaries.begin(), read.back().summaries.end());
  }
  read.push_back(all);
  return read;
}

double Precision(const std::vector<Json>& summaries) {
  double closures = 0.0, false_ones = 0.0;
  for (const Json& summary : summaries) {
    const double own = NumberAt(summary, "/score/closures");
    if (std::isnan(own)) continue;
    closures += own;
    false_ones += NumberAt(summary, "/score/false_closures");
  }
  return closures > 0.0 ? 1.0 - false_ones / closures : std::numeric_limits<double>::quiet_NaN();
}

std::map<std::string, std::size_t> Causes(const std::vector<Json>& summaries) {
  std::map<std::string, std::size_t> causes;
  for (const Json& summary : summaries) {
    if (!summary.contains("missed_revisits_by") || !summary["missed_revisits_by"].is_object()) continue;
    for (const auto& [cause, count] : summary["missed_revisits_by"].items()) causes[cause] += count.get<std::size_t>();
  }
  return causes;
}

}  // namespace

std::string RunTableMarkdown(const std::vector<RunGroup>& groups) {
  const std::vector<Group> read = Read(groups);
  std::string head = "| drive | runs | precision |", rule = "|---|---|---|", rows;
  for (const Figure& figure : kFigures) {
    head += std::string(" ") + figure.title + " |";
    rule += "---|";
  }
  for (const Group& group : read) {
    const double precision = Precision(group.summaries);
    rows += "| " + group.drive + " | " + std::to_string(group.summaries.size()) + " | " +
            (std::isnan(precision) ? "–" : Format(precision, "%.4f")) + " |";
    for (const Figure& figure : kFigures) rows += " " + Format(SpreadOf(group.summaries, figure), figure) + " |";
    rows += "\n";
  }
  std::string causes = "| drive | missed revisits, by what ended their steps |\n|---|---|\n";
  for (const Group& group : read) {
    std::string words;
    for (const auto& [cause, count] : Causes(group.summaries))
      words += (words.empty() ? "" : ", ") + cause + " " + std::to_string(count);
    causes += "| " + group.drive + " | " + (words.empty() ? "–" : words) + " |\n";
  }
  return head + "\n" + rule + "\n" + rows + "\n" + causes;
}

std::string RunTableJson(const std::vector<RunGroup>& groups) {
  Json table;
  for (const Group& group : Read(groups)) {
    Json& drive = table[group.drive];
    drive["runs"] = group.summaries.size();
    drive["precision"] = Precision(group.summaries);
    for (const Figure& figure : kFigures) {
      const Spread spread = SpreadOf(group.summaries, figure);
      if (figure.is_sum) {
        drive[figure.key] = spread.sum;
      } else if (spread.runs == 0) {
        drive[figure.key] = nullptr;
      } else {
        drive[figure.key] = {
            {"mean", spread.mean()}, {"least", spread.least}, {"greatest", spread.greatest}, {"runs", spread.runs}};
      }
    }
    drive["missed_revisits_by"] = Causes(group.summaries);
  }
  return table.dump(2) + "\n";
}

}  // namespace incremental_segmatch
