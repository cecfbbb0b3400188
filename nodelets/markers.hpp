/// \file
/// What rviz shows of a back end. Pure functions.
#pragma once

#include <sensor_msgs/PointCloud2.h>
#include <visualization_msgs/Marker.h>
#include <visualization_msgs/MarkerArray.h>

#include <cstdint>
#include <optional>
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

/// For each match, how far the local centroid lies from its target's, drawn from the target `exaggeration` times as
/// long.
std::vector<Line> ResidualLines(const std::vector<SegmentMatch>& matches, const Pose& T_map_odom, double height_m,
                                double exaggeration);

/// A word somewhere.
struct Label {
  Eigen::Vector3d position = Eigen::Vector3d::Zero();
  std::string text;
  std::uint32_t rgb = 0xffffff;  ///< 0xRRGGBB
};

/// Labels in place of the last ones of this namespace.
visualization_msgs::MarkerArray LabelMarkers(const std::vector<Label>& labels, const std::string& ns, double letter_m,
                                             const std_msgs::Header& header);

/// IDs of the map's segments within a radius of a place, above them. `height_m` as for TargetCloud. O(map).
std::vector<Label> TargetLabels(const TargetMap& map, const Eigen::Vector3d& place, double radius_m, double height_m);

/// The segment of the map whose centroid, shown `height_m` above its place, is nearest to a point; none in an empty
/// map. O(map).
std::optional<SegmentKey> NearestTarget(const TargetMap& map, const Eigen::Vector3d& point, double height_m);

/// The history of a segment: the points of every view that is kept, the oldest dark, the newest bright; lines to the
/// poses that they were seen from; and in words how large it was, when. In place of the last one.
visualization_msgs::MarkerArray HistoryMarkers(const TargetMap& map, const SegmentKey& key, double height_m,
                                               const std_msgs::Header& header);

/// A cloud of the map's segments, coloured by segment, `height_m` above their place. Of each the newest view that has
/// points; its centroid where no view has any. O(map).
sensor_msgs::PointCloud2 TargetCloud(const TargetMap& map, double height_m, const std_msgs::Header& header);

}  // namespace incremental_segmatch
