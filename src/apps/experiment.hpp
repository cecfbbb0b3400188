/// \file
/// `segmatch experiment`: sets of runs on simulated drives, and the page that comes of them.
#pragma once

#include <CLI/CLI.hpp>

namespace incremental_segmatch::apps {

/// Adds the subcommand `experiment` with its own subcommands to the program.
void AddExperimentCommand(CLI::App& app);

}  // namespace incremental_segmatch::apps
