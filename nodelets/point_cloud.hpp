/// \file
/// sensor_msgs/PointCloud2 of any layout to points, and coloured points to PointCloud2.
#pragma once

#include <sensor_msgs/PointCloud2.h>

#include <cstdint>
#include <string>
#include <vector>

#include "incremental_segmatch/types.hpp"

namespace incremental_segmatch {

/// Points of a cloud, in the cloud's order and frame: x, y, z as FLOAT32 or FLOAT64 at any offset, with any other
/// fields and padding, organised or not, either byte order; NaN are kept. Throws std::invalid_argument, naming the
/// fields that are there, if x, y or z is missing or of another type, or if the data is shorter than the header says.
/// O(points).
Points ReadPoints(const sensor_msgs::PointCloud2& cloud);

/// The same, moved into frame a before they are rounded to float: so double clouds far from their origin stay exact.
Points ReadPoints(const sensor_msgs::PointCloud2& cloud, const Pose& T_a_cloud);

/// A point to look at.
struct ColouredPoint {
  Eigen::Vector3f position = Eigen::Vector3f::Zero();
  std::uint32_t rgb = 0;  ///< 0xRRGGBB
};

/// A cloud with the fields x, y, z, rgb as rviz and PCL read them.
sensor_msgs::PointCloud2 ToPointCloud2(const std::vector<ColouredPoint>& points, const std_msgs::Header& header);

/// A colour for a segment, the same at all times, well apart for neighbouring IDs; grey for kNoSegment. 0xRRGGBB.
std::uint32_t SegmentColour(const SegmentKey& segment);

}  // namespace incremental_segmatch
