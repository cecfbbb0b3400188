/// \file
/// What to say where the program was built without ROS.
#pragma once

#include <stdexcept>
#include <string>

namespace incremental_segmatch::apps {

/// Throws std::runtime_error: `what` needs ROS's bag library.
[[noreturn]] inline void ThrowNoBags(const std::string& what) {
  throw std::runtime_error(what +
                           " is not built in: this program was built without ROS. Install ROS's packages (rosbag, tf2; "
                           "scripts/install_dependencies.sh), and build again");
}

}  // namespace incremental_segmatch::apps
