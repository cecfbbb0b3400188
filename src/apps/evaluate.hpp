/// \file
/// `segmatch evaluate`: a drive through the whole pipeline, recorded and scored.
#pragma once

#include <CLI/CLI.hpp>

namespace incremental_segmatch::apps {

/// Adds the subcommand `evaluate` with its options to the program.
void AddEvaluateCommand(CLI::App& app);

}  // namespace incremental_segmatch::apps
