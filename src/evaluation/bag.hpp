/// \file
/// ROS bags as input and output. Only built where catkin is found (SEGMATCH_WITH_ROSBAG). No ROS master is needed.
#pragma once

#include <functional>
#include <memory>

#include "evaluation/bag_options.hpp"
#include "evaluation/drive_source.hpp"
#include "evaluation/kitti_io.hpp"

namespace incremental_segmatch {

/// A drive in a bag. PointCloud2 of any field layout with x, y and z; sensor poses from tf or from nav_msgs/Odometry,
/// at the scans' stamps (interpolated). Scans without a pose are left out and counted in the notes. The epoch that
/// kitti2bag records on /segmatch/epoch is taken off the stamps. Odometry of another body (base_link) is brought to the
/// sensor through tf; a geometry_msgs/PoseStamped names no body and is taken as the sensor's own pose. Throws
/// std::runtime_error naming the bag, what is missing in it and what there is instead.
std::unique_ptr<DriveSource> OpenBag(const BagDriveOptions& options);

/// Writes a drive as a bag: clouds, tf with the odometry, static transforms on /tf_static, nav_msgs/Odometry on
/// /odometry and, where known, on /ground_truth; /segmatch/epoch (std_msgs/Time). `progress(done, total)` is called
/// after each scan. Throws std::runtime_error naming the file; an unfinished bag is removed.
void WriteBag(const KittiDrive& drive, const BagWriterOptions& options,
              const std::function<void(std::size_t, std::size_t)>& progress = {});

}  // namespace incremental_segmatch
