#include "tuning.hpp"

#include <type_traits>

namespace incremental_segmatch {
namespace {

using FrontEndNodelets = NodeletParameters<FrontEndNodeParameters>;
using BackEndNodelets = NodeletParameters<BackEndNodeParameters>;

/// Visits every value that may change, in the configuration and in the parameters.
template <class Visit>
void Pair(FrontEndConfig& config, FrontEndNodelets& parameters, const Visit& visit) {
  FrontEndParameters& core = parameters.core.front_end;
  visit(config.min_height_m, core.ground.min_height_m);
  visit(config.sensor_height_m, core.ground.sensor_height_m);
  visit(config.clearance_m, core.ground.clearance_m);
  visit(config.max_slope, core.ground.max_slope);
  visit(config.min_range_m, core.ground.min_range_m);
  visit(config.max_range_m, core.ground.max_range_m);
  visit(config.max_height_m, core.ground.max_height_m);
  visit(config.local_radius_m, core.local_radius_m);
  visit(config.view_growth_factor, core.view.growth_factor);
  visit(config.view_baseline_m, core.view.baseline_m);
  visit(config.pose_timeout_s, parameters.node.pose_timeout_s);
}

template <class Visit>
void Pair(BackEndConfig& config, BackEndNodelets& parameters, const Visit& visit) {
  BackEndParameters& core = parameters.core.back_end;
  visit(config.nearest, core.matching.nearest);
  visit(config.max_distance, core.matching.max_distance);
  visit(config.time_window_s, core.matching.time_window_s);
  visit(config.min_path_m, core.matching.min_path_m);
  visit(config.requery_distance, core.matching.requery_distance);
  visit(config.epsilon_m, core.recognizer.consistency.epsilon_m);
  visit(config.min_clique_size, core.recognizer.clique.min_size);
  visit(config.max_tilt_rad, core.recognizer.max_tilt_rad);
  visit(config.max_rms_m, core.recognizer.max_rms_m);
  visit(config.min_spread_m, core.recognizer.min_spread_m);
  visit(config.refine, core.refinement.enabled);
  visit(config.submap_radius_m, core.keyframes.submap_radius_m);
  visit(config.min_overlap, core.refinement.min_overlap);
  visit(config.support_distance_m, core.acceptance.support_distance_m);
  visit(config.neighbourhood_m, core.acceptance.neighbourhood_m);
  visit(config.min_coverage, core.acceptance.min_coverage);
  visit(config.min_ratio, core.acceptance.min_ratio);
  visit(config.twin_memory_m, core.acceptance.twin_memory_m);
  visit(config.min_track_m, core.acceptance.min_track_m);
  visit(config.min_track_fit, core.acceptance.min_track_fit);
  visit(config.min_distinction, core.acceptance.min_distinction);
  visit(config.max_contradiction, core.acceptance.max_contradiction);
  visit(config.max_contradiction_once, core.acceptance.max_contradiction_once);
  visit(config.max_distance_m, core.acceptance.max_distance_m);
  visit(config.max_sigma_m, core.acceptance.max_sigma_m);
  visit(config.max_sigma_rad, core.acceptance.max_sigma_rad);
  visit(config.closure_min_distance_m, parameters.node.closure_min_distance_m);
  visit(config.closure_min_interval_s, parameters.node.closure_min_interval_s);
  visit(config.display_period_s, parameters.node.display_period_s);
  visit(config.display_height_m, parameters.node.display_height_m);
}

template <class Config, class NodeParameters>
Config FromParameters(NodeletParameters<NodeParameters> parameters) {
  Config config = Config::__getDefault__();
  Pair(config, parameters, [](auto& configured, const auto& parameter) {
    configured = static_cast<std::decay_t<decltype(configured)>>(parameter);
  });
  return config;
}

template <class Config, class NodeParameters>
void ToParameters(Config* config, NodeletParameters<NodeParameters>* parameters) {
  Pair(*config, *parameters, [](const auto& configured, auto& parameter) {
    parameter = static_cast<std::decay_t<decltype(parameter)>>(configured);
  });
}

}  // namespace

FrontEndConfig ToConfig(const FrontEndNodelets& parameters) {
  return FromParameters<FrontEndConfig>(parameters);
}

BackEndConfig ToConfig(const BackEndNodelets& parameters) {
  return FromParameters<BackEndConfig>(parameters);
}

FrontEndNodelets WithConfig(FrontEndNodelets parameters, FrontEndConfig config) {
  ToParameters(&config, &parameters);
  Validate(parameters.node);
  Validate(parameters.core);
  return parameters;
}

BackEndNodelets WithConfig(BackEndNodelets parameters, BackEndConfig config) {
  ToParameters(&config, &parameters);
  Validate(parameters.node);
  Validate(parameters.core);
  return parameters;
}

}  // namespace incremental_segmatch
