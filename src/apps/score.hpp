/// \file
/// `segmatch score`: what a run in ROS recorded, judged against the truth.
#pragma once

#include <CLI/CLI.hpp>

namespace incremental_segmatch::apps {

/// Adds the subcommand `score` with its options to the program.
void AddScoreCommand(CLI::App& app);

}  // namespace incremental_segmatch::apps
