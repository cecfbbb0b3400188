#include "evaluation/kidnap_comparison.hpp"

#include <cmath>
#include <nlohmann/json.hpp>
#include <stdexcept>

#include "evaluation/analysis.hpp"
#include "evaluation/svg.hpp"
#include "evaluation/trajectory_error.hpp"

namespace incremental_segmatch {
namespace {

using Json = nlohmann::ordered_json;

constexpr double kDegPerRad = 180.0 / M_PI;

std::vector<const ClosureRow*> ByStep(const EvaluationResult& result) {
  std::vector<const ClosureRow*> rows(result.odometry.size(), nullptr);
  for (const ClosureRow& row : result.closures) rows[StepAt(result.odometry, row.stamp_query_ns)] = &row;
  return rows;
}

}  // namespace

KidnapComparison CompareKidnapped(const std::string& drive, const EvaluationResult& undisturbed,
                                  const EvaluationResult& carried, std::size_t first_moved, double refill_m) {
  const std::size_t steps = undisturbed.odometry.size();
  if (!undisturbed.score || !carried.score) throw std::invalid_argument("runs without ground truth have no score");
  if (carried.odometry.size() != steps) throw std::invalid_argument("the runs differ in their number of steps");
  for (std::size_t i = 0; i < steps; ++i) {
    if (undisturbed.odometry[i].stamp_ns != carried.odometry[i].stamp_ns)
      throw std::invalid_argument("the runs differ in the stamp of step " + std::to_string(i));
  }
  const std::vector<const ClosureRow*> expected = ByStep(undisturbed), found = ByStep(carried);
  const std::vector<double> path_m = PathLengths(undisturbed);
  const auto target_in_odom = [&](const ClosureRow& row) -> const Pose& {
    return undisturbed.odometry[StepAt(undisturbed.odometry, row.stamp_target_ns)].T_frame_sensor;
  };

  KidnapComparison comparison;
  comparison.drive = drive;
  comparison.false_undisturbed = undisturbed.score->false_closures;
  comparison.false_carried = carried.score->false_closures;
  comparison.parts = {{"before"}, {"after, within " + FormatNumber(refill_m, "%.0f m")}, {"after that"}};
  std::vector<std::vector<double>> differences_m(comparison.parts.size()), differences_deg(comparison.parts.size());
  for (std::size_t i = 0; i < steps; ++i) {
    const std::size_t which = i < first_moved ? 0 : path_m[i] - path_m[first_moved] <= refill_m ? 1 : 2;
    KidnapPart& part = comparison.parts[which];
    ++part.steps;
    part.undisturbed += expected[i] != nullptr;
    part.carried += found[i] != nullptr;
    if (expected[i] == nullptr || found[i] == nullptr) continue;
    ++part.both;
    const Pose T_expected_query = target_in_odom(*expected[i]) * expected[i]->T_target_query;
    const Pose T_found_query = target_in_odom(*found[i]) * found[i]->T_target_query;
    const Pose difference = T_expected_query.inverse() * T_found_query;
    differences_m[which].push_back(difference.translation().norm());
    differences_deg[which].push_back(kDegPerRad * Eigen::AngleAxisd(difference.linear()).angle());
  }
  for (std::size_t k = 0; k < comparison.parts.size(); ++k) {
    comparison.parts[k].difference_95_m = Percentile(differences_m[k], 0.95);
    comparison.parts[k].difference_max_m = Percentile(differences_m[k], 1.0);
    comparison.parts[k].difference_max_deg = Percentile(differences_deg[k], 1.0);
  }
  return comparison;
}

std::string KidnapMarkdown(const std::vector<KidnapComparison>& comparisons) {
  std::string text =
      "| drive | part | steps | recognised: undisturbed | carried | both | poses differ: 95 % | most | false: "
      "undisturbed, carried |\n|---|---|---|---|---|---|---|---|---|\n";
  for (const KidnapComparison& comparison : comparisons) {
    for (const KidnapPart& part : comparison.parts) {
      text += "| " + comparison.drive + " | " + part.name + " | " + std::to_string(part.steps) + " | " +
              std::to_string(part.undisturbed) + " | " + std::to_string(part.carried) + " | " +
              std::to_string(part.both) + " | " + FormatNumber(part.difference_95_m, "%.3f m") + " | " +
              FormatNumber(part.difference_max_m, "%.3f m") + ", " + FormatNumber(part.difference_max_deg, "%.2f°") + " | " +
              std::to_string(comparison.false_undisturbed) + ", " + std::to_string(comparison.false_carried) + " |\n";
    }
  }
  return text;
}

std::string KidnapJson(const std::vector<KidnapComparison>& comparisons) {
  Json json = Json::array();
  for (const KidnapComparison& comparison : comparisons) {
    Json parts = Json::array();
    for (const KidnapPart& part : comparison.parts) {
      parts.push_back({{"part", part.name},
                       {"steps", part.steps},
                       {"undisturbed", part.undisturbed},
                       {"carried", part.carried},
                       {"both", part.both},
                       {"difference_95_m", part.difference_95_m},
                       {"difference_max_m", part.difference_max_m},
                       {"difference_max_deg", part.difference_max_deg}});
    }
    json.push_back({{"drive", comparison.drive},
                    {"parts", parts},
                    {"false_undisturbed", comparison.false_undisturbed},
                    {"false_carried", comparison.false_carried}});
  }
  return json.dump(2) + "\n";
}

}  // namespace incremental_segmatch
