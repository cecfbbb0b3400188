/// \file
/// Writes a simulated drive in KITTI's odometry layout.
#pragma once

#include <functional>
#include <string>

#include "simulator/simulation.hpp"

namespace incremental_segmatch::simulator {

/// T_camera_sensor of the written calib.txt: the camera looks along the sensor's x axis, and sits below and before it.
Pose KittiCalibration();

/// Writes ROOT/sequences/SS/{velodyne/NNNNNN.bin, calib.txt, times.txt, odometry.txt} and ROOT/poses/SS.txt. Poses are
/// KITTI's (camera frame, relative to the beginning of the route, so that the drives of all days are in one frame);
/// odometry.txt holds 3x4 rows of T_odom_sensor in the LiDAR's frame. `progress` is called with the number of scans
/// written so far. Scans of an earlier, longer drive in the same place are deleted. Throws std::runtime_error naming
/// the file that can't be written.
void WriteKitti(Simulation& simulation, const std::string& root, const std::string& sequence,
                const std::function<void(std::size_t)>& progress = {});

}  // namespace incremental_segmatch::simulator
