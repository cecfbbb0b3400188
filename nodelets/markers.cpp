#include "markers.hpp"

#include <algorithm>
#include <cstdio>
#include <limits>

#include "conversions.hpp"
#include "point_cloud.hpp"

namespace incremental_segmatch {
namespace {

constexpr double kLabelHeight_m = 1.0;    // over the centroid
constexpr double kHistoryLetter_m = 1.0;  // height of a line of the history

std_msgs::ColorRGBA ToColour(std::uint32_t rgb, float alpha = 1.f) {
  std_msgs::ColorRGBA colour;
  colour.r = static_cast<float>((rgb >> 16) & 0xff) / 255.f;
  colour.g = static_cast<float>((rgb >> 8) & 0xff) / 255.f;
  colour.b = static_cast<float>(rgb & 0xff) / 255.f;
  colour.a = alpha;
  return colour;
}

visualization_msgs::Marker MakeMarker(int type, const std::string& ns, int id, const std_msgs::Header& header) {
  visualization_msgs::Marker marker;
  marker.header = header;
  marker.ns = ns;
  marker.id = id;
  marker.type = type;
  marker.action = visualization_msgs::Marker::ADD;
  marker.pose.orientation.w = 1.0;
  return marker;
}

/// Takes all markers of the topic away.
visualization_msgs::Marker DeleteAll(const std_msgs::Header& header) {
  visualization_msgs::Marker marker = MakeMarker(visualization_msgs::Marker::POINTS, "", 0, header);
  marker.action = visualization_msgs::Marker::DELETEALL;
  return marker;
}

/// A view's points in the map; its centroid where it has none.
std::vector<Eigen::Vector3d> ViewPoints(const TargetMap& map, const SegmentView& view, double height_m) {
  const Eigen::Vector3d centroid = map.CentroidMap(view) + height_m * Eigen::Vector3d::UnitZ();
  if (!view.points_centroid) return {centroid};
  const TrajectoryPose& pose = map.PoseOf(view);
  const Eigen::Matrix3d R_map_odom = pose.T_map_sensor.linear() * pose.T_odom_sensor.linear().transpose();
  std::vector<Eigen::Vector3d> shown;
  for (const Eigen::Vector3f& p : *view.points_centroid) shown.push_back(centroid + R_map_odom * p.cast<double>());
  return shown;
}

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

std::vector<Line> ResidualLines(const std::vector<SegmentMatch>& matches, const Pose& T_map_odom, double height_m,
                                double exaggeration) {
  std::vector<Line> lines;
  for (const SegmentMatch& match : matches) {
    const Eigen::Vector3d target = match.centroid_target_map + height_m * Eigen::Vector3d::UnitZ();
    const Eigen::Vector3d residual = T_map_odom * match.centroid_local_odom - match.centroid_target_map;
    lines.emplace_back(target, target + exaggeration * residual);
  }
  return lines;
}

visualization_msgs::MarkerArray LabelMarkers(const std::vector<Label>& labels, const std::string& ns, double letter_m,
                                             const std_msgs::Header& header) {
  visualization_msgs::MarkerArray array;
  array.markers.push_back(DeleteAll(header));
  for (const Label& label : labels) {
    array.markers.push_back(
        MakeMarker(visualization_msgs::Marker::TEXT_VIEW_FACING, ns, static_cast<int>(array.markers.size()), header));
    visualization_msgs::Marker& marker = array.markers.back();
    marker.pose.position = ToPoint(label.position);
    marker.scale.z = letter_m;
    marker.color = ToColour(label.rgb);
    marker.text = label.text;
  }
  return array;
}

std::vector<Label> TargetLabels(const TargetMap& map, const Eigen::Vector3d& place, double radius_m, double height_m) {
  std::vector<Label> labels;
  for (const auto& [key, segment] : map.segments()) {
    const Eigen::Vector3d centroid = map.CentroidMap(segment.views.back());
    if ((centroid - place).head<2>().norm() > radius_m) continue;
    labels.push_back({centroid + (height_m + kLabelHeight_m) * Eigen::Vector3d::UnitZ(), std::to_string(key.id),
                      SegmentColour(key)});
  }
  return labels;
}

std::optional<SegmentKey> NearestTarget(const TargetMap& map, const Eigen::Vector3d& point, double height_m) {
  std::optional<SegmentKey> nearest;
  double nearest_m = std::numeric_limits<double>::infinity();
  for (const auto& [key, segment] : map.segments()) {
    const Eigen::Vector3d centroid = map.CentroidMap(segment.views.back()) + height_m * Eigen::Vector3d::UnitZ();
    const double distance_m = (centroid - point).norm();
    if (distance_m >= nearest_m) continue;
    nearest_m = distance_m;
    nearest = key;
  }
  return nearest;
}

visualization_msgs::MarkerArray HistoryMarkers(const TargetMap& map, const SegmentKey& key, double height_m,
                                               const std_msgs::Header& header) {
  visualization_msgs::MarkerArray array;
  array.markers.push_back(DeleteAll(header));
  const TargetSegment* segment = map.Find(key);
  if (segment == nullptr) return array;
  visualization_msgs::Marker lines = MakeMarker(visualization_msgs::Marker::LINE_LIST, "seen_from", 0, header);
  lines.scale.x = 0.1;
  lines.color = ToColour(0xffffff, 0.6f);
  std::string text =
      map.RobotName(key.robot) + " " + std::to_string(key.id) + (segment->tracked ? ", tracked now" : "");
  Eigen::Vector3d top = Eigen::Vector3d::Constant(-std::numeric_limits<double>::infinity());
  for (std::size_t i = 0; i < segment->views.size(); ++i) {
    const SegmentView& view = segment->views[i];
    visualization_msgs::Marker points =
        MakeMarker(visualization_msgs::Marker::POINTS, "views", static_cast<int>(i), header);
    points.scale.x = points.scale.y = 0.25;
    const double brightness = static_cast<double>(i + 1) / static_cast<double>(segment->views.size());
    points.color.r = static_cast<float>(brightness);
    points.color.g = static_cast<float>(0.5 * brightness);
    points.color.b = static_cast<float>(1.0 - 0.7 * brightness);
    points.color.a = 1.f;
    for (const Eigen::Vector3d& point : ViewPoints(map, view, height_m)) {
      points.points.push_back(ToPoint(point));
      if (point.z() > top.z()) top = point;
    }
    const Eigen::Vector3d centroid = map.CentroidMap(view) + height_m * Eigen::Vector3d::UnitZ();
    lines.points.push_back(ToPoint(map.PoseOf(view).T_map_sensor.translation()));
    lines.points.push_back(ToPoint(centroid));
    char line[120];
    std::snprintf(line, sizeof line, "\n%s %u voxels, %.1f s", map.RobotName(view.robot).c_str(), view.size,
                  1e-9 * static_cast<double>(map.PoseOf(view).stamp_ns));
    text += line;
    array.markers.push_back(std::move(points));
  }
  // Text is centred about its place: so high that its last line, too, is over the segment.
  const double text_height_m = static_cast<double>(segment->views.size() + 1) * 1.5 * kHistoryLetter_m;
  const Eigen::Vector3d foot = top + 1.5 * kHistoryLetter_m * Eigen::Vector3d::UnitZ();
  lines.points.push_back(ToPoint(top));
  lines.points.push_back(ToPoint(foot));
  array.markers.push_back(std::move(lines));
  visualization_msgs::Marker label = MakeMarker(visualization_msgs::Marker::TEXT_VIEW_FACING, "words", 0, header);
  label.pose.position = ToPoint(foot + 0.5 * text_height_m * Eigen::Vector3d::UnitZ());
  label.scale.z = kHistoryLetter_m;
  label.color = ToColour(0xffffff);
  label.text = text;
  array.markers.push_back(std::move(label));
  return array;
}

sensor_msgs::PointCloud2 TargetCloud(const TargetMap& map, double height_m, const std_msgs::Header& header) {
  std::vector<ColouredPoint> cloud;
  for (const auto& [key, segment] : map.segments()) {
    const std::uint32_t rgb = SegmentColour(key);
    for (const Eigen::Vector3d& point : ViewPoints(map, ShownView(segment), height_m))
      cloud.push_back({point.cast<float>(), rgb});
  }
  return ToPointCloud2(cloud, header);
}

}  // namespace incremental_segmatch
