/// \file
/// `segmatch simulate`: a LiDAR drive through a town that does not exist, in KITTI layout.
#pragma once

#include <CLI/CLI.hpp>

namespace incremental_segmatch::apps {

/// Adds the subcommand `simulate` with its options to the program.
void AddSimulateCommand(CLI::App& app);

}  // namespace incremental_segmatch::apps
