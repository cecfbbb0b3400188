/// \file
/// Options of simulated drives, the same for every subcommand that simulates.
#pragma once

#include <CLI/CLI.hpp>

#include "simulator/simulation.hpp"

namespace incremental_segmatch::apps {

/// What the command line says of a simulated drive.
struct SimulationArguments {
  simulator::SimulationOptions options;  ///< without the drift
  double drift_percent = 0.7;            ///< of the path over 100 m; yaw drifts along

  /// The simulation to make.
  simulator::SimulationOptions Resolve() const;
};

/// Adds --route and --poses: where to drive.
void AddRouteOptions(CLI::App& command, SimulationArguments* arguments);

/// Adds everything else: sensor, seed, day, frames, drift, noise, ground.
void AddSimulationOptions(CLI::App& command, SimulationArguments* arguments);

/// What --route or --poses says, for people: "route loops", or the file.
std::string RouteName(const simulator::SimulationOptions& options);

}  // namespace incremental_segmatch::apps
