#include "incremental_segmatch/acceptance.hpp"

#include <algorithm>
#include <limits>
#include <stdexcept>
#include <string>

namespace incremental_segmatch {

void MeasureCoverage(const std::vector<Eigen::Vector3d>& centroids_local, const std::vector<Eigen::Vector3d>& centroids_target,
                     const AcceptanceParameters& parameters, Evidence* evidence) {
  evidence->expected = evidence->supported = 0;
  for (const Eigen::Vector3d& local : centroids_local) {
    double nearest2 = std::numeric_limits<double>::infinity();
    for (const Eigen::Vector3d& target : centroids_target) nearest2 = std::min(nearest2, (target - local).squaredNorm());
    evidence->expected += nearest2 <= parameters.neighbourhood_m * parameters.neighbourhood_m;
    evidence->supported += nearest2 <= parameters.support_distance_m * parameters.support_distance_m;
  }
}

bool HasRival(const Evidence& evidence, const AcceptanceParameters& parameters) {
  return static_cast<double>(evidence.inliers) < parameters.min_ratio * static_cast<double>(evidence.runner_up);
}

bool IsDeceptive(const Evidence& evidence, const AcceptanceParameters& parameters) {
  return HasRival(evidence, parameters) || evidence.since_twin_m < parameters.twin_memory_m;
}

Verdict Judge(const Evidence& evidence, const AcceptanceParameters& parameters) {
  if (IsDeceptive(evidence, parameters) && !evidence.on_proven_track) {
    const bool outdoes_rival =
        !HasRival(evidence, parameters) || evidence.distinction >= parameters.min_distinction;
    if (!outdoes_rival || evidence.track_m < parameters.min_track_m || evidence.track_fit < parameters.min_track_fit)
      return Verdict::kAmbiguous;
  }
  if (evidence.Coverage() < parameters.min_coverage) return Verdict::kUncovered;
  if (evidence.contradiction > parameters.max_contradiction ||
      evidence.contradiction_once > parameters.max_contradiction_once) {
    return Verdict::kContradicted;
  }
  if (evidence.sigma_m > parameters.max_sigma_m || evidence.sigma_rad > parameters.max_sigma_rad) return Verdict::kUncertain;
  if (evidence.distance_m > parameters.max_distance_m) return Verdict::kTooFar;
  return Verdict::kAccepted;
}

double Strength(const Evidence& evidence, const AcceptanceParameters& parameters) {
  constexpr double kUnbound = std::numeric_limits<double>::infinity();
  const auto at_least = [](double value, double least) { return least > 0.0 ? value / least : kUnbound; };
  const auto at_most = [](double value, double most) { return value > 0.0 ? most / value : kUnbound; };
  const double unrivalled =
      at_least(static_cast<double>(evidence.inliers), parameters.min_ratio * static_cast<double>(evidence.runner_up));
  const double plain = std::min(unrivalled, at_least(evidence.since_twin_m, parameters.twin_memory_m));
  const double borne_out = std::min({std::max(unrivalled, at_least(evidence.distinction, parameters.min_distinction)),
                                     at_least(evidence.track_m, parameters.min_track_m),
                                     at_most(1.0 - evidence.track_fit, 1.0 - parameters.min_track_fit)});
  const double on_track = evidence.on_proven_track ? kUnbound : 0.0;
  return std::min(
      {std::max({plain, borne_out, on_track}), at_least(evidence.Coverage(), parameters.min_coverage),
       at_most(evidence.contradiction, parameters.max_contradiction),
       at_most(evidence.contradiction_once, parameters.max_contradiction_once),
       at_most(evidence.sigma_m, parameters.max_sigma_m), at_most(evidence.sigma_rad, parameters.max_sigma_rad),
       at_most(evidence.distance_m, parameters.max_distance_m)});
}

void Validate(const AcceptanceParameters& parameters) {
  const auto require = [](bool holds, const char* what) {
    if (!holds) throw std::invalid_argument(std::string("back_end.acceptance.") + what);
  };
  require(parameters.support_distance_m > 0.0, "support_distance_m: must be positive");
  require(parameters.neighbourhood_m >= parameters.support_distance_m, "neighbourhood_m: must be at least support_distance_m");
  require(parameters.min_coverage >= 0.0 && parameters.min_coverage <= 1.0, "min_coverage: must be between 0 and 1");
  require(parameters.max_contradiction >= 0.0 && parameters.max_contradiction <= 1.0, "max_contradiction: must be between 0 and 1");
  require(parameters.max_contradiction_once >= 0.0 && parameters.max_contradiction_once <= 1.0,
          "max_contradiction_once: must be between 0 and 1");
  require(parameters.min_ratio >= 0.0, "min_ratio: must not be negative");
  require(parameters.twin_size >= 1, "twin_size: must be at least 1");
  require(parameters.twin_memory_m >= 0.0, "twin_memory_m: must not be negative");
  require(parameters.min_track_m >= 0.0, "min_track_m: must not be negative");
  require(parameters.min_track_fit >= 0.0 && parameters.min_track_fit <= 1.0, "min_track_fit: must be between 0 and 1");
  require(parameters.min_distinction >= 0.0 && parameters.min_distinction <= 1.0,
          "min_distinction: must be between 0 and 1");
  require(parameters.max_distance_m > 0.0, "max_distance_m: must be positive");
  require(parameters.max_sigma_m > 0.0, "max_sigma_m: must be positive");
  require(parameters.max_sigma_rad > 0.0, "max_sigma_rad: must be positive");
}

}  // namespace incremental_segmatch
