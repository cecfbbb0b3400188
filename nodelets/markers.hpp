/// \file
/// What rviz shows of a back end. Pure functions.
#pragma once

#include <sensor_msgs/PointCloud2.h>
#include <visualization_msgs/Marker.h>

#include <string>
#include <utility>
#include <vector>

#include "incremental_segmatch/back_end.hpp"
#include "incremental_segmatch/types.hpp"

namespace incremental_segmatch {

/// How lines look.
struct LineStyle {
  std::string ns;  ///< marker namespace
  float red = 1.f;
  float green = 1.f;
  float blue = 1.f;
  float alpha = 1.f;
  double width_m = 0.1;
};

using Line = std::pair<Eigen::Vector3d, Eigen::Vector3d>;

/// One marker of all the lines; without lines, a marker that takes the last ones away.
visualization_msgs::Marker LineMarker(const std::vector<Line>& lines, const LineStyle& style,
                                      const std_msgs::Header& header);

/// Lines from local to target centroids in the map frame. Targets are shown `height_m` above their place.
std::vector<Line> MatchLines(const std::vector<SegmentMatch>& matches, const Pose& T_map_odom, double height_m);

/// A cloud of the map's segments, coloured by segment, `height_m` above their place. Of each the newest view that has
/// points, a few hundred of them; its centroid where no view has any. O(map).
sensor_msgs::PointCloud2 TargetCloud(const TargetMap& map, double height_m, const std_msgs::Header& header);

}  // namespace incremental_segmatch
