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

/// Adds the options that say which drive: route or pose file, which part of it, seed and day.
void AddDriveOptions(CLI::App& command, SimulationArguments* arguments);

/// Adds the options that say how it is driven and seen: sensor, rates, drift, noise, ground.
void AddSensorOptions(CLI::App& command, SimulationArguments* arguments);

/// What --route or --poses says, for people: "route loops", or the file.
std::string RouteName(const simulator::SimulationOptions& options);

}  // namespace incremental_segmatch::apps
