/// \file
/// `segmatch kitti2bag`: KITTI odometry layout to a ROS bag.
#pragma once

#include <CLI/CLI.hpp>

namespace incremental_segmatch::apps {

/// Adds the subcommand `kitti2bag` with its options to the program. Where bags are not built in, running it throws
/// std::runtime_error that says so.
void AddKitti2BagCommand(CLI::App& app);

}  // namespace incremental_segmatch::apps
