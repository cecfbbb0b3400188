#include "markers.hpp"

#include <algorithm>

#include "conversions.hpp"
#include "point_cloud.hpp"

namespace incremental_segmatch {
namespace {

constexpr std::size_t kShownPoints = 300;  // of a segment

const SegmentView& ShownView(const TargetSegment& segment) {
  const auto with_points = std::find_if(segment.views.rbegin(), segment.views.rend(),
                                        [](const SegmentView& view) { return view.points_centroid != nullptr; });
  return with_points == segment.views.rend() ? segment.views.back() : *with_points;
}

}  // namespace

visualization_msgs::Marker LineMarker(const std::vector<Line>& lines, const LineStyle& style,
                                      const std_msgs::Header& header) {
  visualization_msgs::Marker marker;
  marker.header = header;
  marker.ns = style.ns;
  marker.type = visualization_msgs::Marker::LINE_LIST;
  marker.action = lines.empty() ? visualization_msgs::Marker::DELETE : visualization_msgs::Marker::ADD;
  marker.pose.orientation.w = 1.0;
  marker.scale.x = style.width_m;
  marker.color.r = style.red;
  marker.color.g = style.green;
  marker.color.b = style.blue;
  marker.color.a = style.alpha;
  marker.points.reserve(2 * lines.size());
  for (const auto& [from, to] : lines) {
    marker.points.push_back(ToPoint(from));
    marker.points.push_back(ToPoint(to));
  }
  return marker;
}

std::vector<Line> MatchLines(const std::vector<SegmentMatch>& matches, const Pose& T_map_odom, double height_m) {
  std::vector<Line> lines;
  lines.reserve(matches.size());
  for (const SegmentMatch& match : matches)
    lines.emplace_back(T_map_odom * match.centroid_local_odom,
                       match.centroid_target_map + height_m * Eigen::Vector3d::UnitZ());
  return lines;
}

sensor_msgs::PointCloud2 TargetCloud(const TargetMap& map, double height_m, const std_msgs::Header& header) {
  std::vector<ColouredPoint> cloud;
  for (const auto& [key, segment] : map.segments()) {
    const SegmentView& view = ShownView(segment);
    const TrajectoryPose& pose = map.PoseOf(view);
    const Eigen::Vector3d centroid = map.CentroidMap(view) + height_m * Eigen::Vector3d::UnitZ();
    const Eigen::Matrix3d R_map_odom = pose.T_map_sensor.linear() * pose.T_odom_sensor.linear().transpose();
    const std::uint32_t rgb = SegmentColour(key);
    if (!view.points_centroid) {
      cloud.push_back({centroid.cast<float>(), rgb});
      continue;
    }
    const Points& points = *view.points_centroid;
    const std::size_t stride = points.size() / kShownPoints + 1;
    for (std::size_t i = 0; i < points.size(); i += stride)
      cloud.push_back({(centroid + R_map_odom * points[i].cast<double>()).cast<float>(), rgb});
  }
  return ToPointCloud2(cloud, header);
}

}  // namespace incremental_segmatch
