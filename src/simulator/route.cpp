#include "simulator/route.hpp"

#include <algorithm>
#include <cmath>
#include <fstream>
#include <sstream>
#include <stdexcept>

#include "simulator/office_plan.hpp"

namespace incremental_segmatch::simulator {
namespace {

constexpr double kLaneOffset_m = 1.75;   // the vehicle keeps to the right of the road's axis
constexpr double kCornerRadius_m = 9.0;  // of the road's axis
constexpr double kIndoorCornerRadius_m = 0.7;
constexpr double kIndoorSpeed_m_s = 1.0;
constexpr double kStep_m = 0.25;  // sampling of the path before it is driven
constexpr double kLateralLimit_m_s2 = 2.0;
constexpr double kBrakeLimit_m_s2 = 1.5;

using Path = std::vector<Eigen::Vector2d>;

double Cross(const Eigen::Vector2d& a, const Eigen::Vector2d& b) {
  return a.x() * b.y() - a.y() * b.x();
}

void AppendLine(Path& path, const Eigen::Vector2d& to) {
  const Eigen::Vector2d from = path.back();
  const double length = (to - from).norm();
  const int steps = static_cast<int>(std::ceil(length / kStep_m));
  for (int i = 1; i <= steps; ++i) path.push_back(from + (to - from) * (static_cast<double>(i) / steps));
}

// How a path follows its axis.
struct Lane {
  double offset_m;         // to the right
  double corner_radius_m;  // of the axis
};
constexpr Lane kRoad{kLaneOffset_m, kCornerRadius_m};
constexpr Lane kCorridor{0.0, kIndoorCornerRadius_m};

// The arc of the driven lane around a corner of the axis: tangent to both legs at the corner's radius from the axis's
// arc centre.
void AppendCorner(Path& path, const Lane& lane, const Eigen::Vector2d& corner, const Eigen::Vector2d& in,
                  const Eigen::Vector2d& out) {
  const double turn = std::atan2(Cross(in, out), in.dot(out));
  const double side = turn > 0 ? 1.0 : -1.0;
  const double tangent = lane.corner_radius_m * std::tan(std::abs(turn) / 2);
  const Eigen::Vector2d normal(-in.y(), in.x());
  const Eigen::Vector2d centre = corner - in * tangent + normal * side * lane.corner_radius_m;
  const double radius = lane.corner_radius_m + side * lane.offset_m;
  const Eigen::Vector2d start = centre - normal * side * radius;
  AppendLine(path, start);
  const int steps = std::max(2, static_cast<int>(std::ceil(std::abs(turn) * radius / kStep_m)));
  for (int i = 1; i <= steps; ++i) {
    const double angle = turn * i / steps;
    const Eigen::Vector2d arm = start - centre;
    path.push_back(centre + Eigen::Vector2d(std::cos(angle) * arm.x() - std::sin(angle) * arm.y(),
                                            std::sin(angle) * arm.x() + std::cos(angle) * arm.y()));
  }
}

// The lane driven along an axis given by its corners.
Path PathAlong(const std::vector<Eigen::Vector2d>& corners, const Lane& lane) {
  const auto right = [](const Eigen::Vector2d& d) { return Eigen::Vector2d(d.y(), -d.x()); };
  const Eigen::Vector2d first = (corners[1] - corners[0]).normalized();
  Path path{corners[0] + lane.offset_m * right(first)};
  for (std::size_t i = 1; i + 1 < corners.size(); ++i) {
    const Eigen::Vector2d in = (corners[i] - corners[i - 1]).normalized();
    const Eigen::Vector2d out = (corners[i + 1] - corners[i]).normalized();
    if (std::abs(Cross(in, out)) > 1e-6) AppendCorner(path, lane, corners[i], in, out);
  }
  const Eigen::Vector2d last = (corners.back() - corners[corners.size() - 2]).normalized();
  AppendLine(path, corners.back() + lane.offset_m * right(last));
  return path;
}

// Speed at each path point: limited by curvature, then by braking and accelerating.
std::vector<double> SpeedProfile(const Path& path, double speed_m_s) {
  std::vector<double> speed(path.size(), speed_m_s);
  for (std::size_t i = 1; i + 1 < path.size(); ++i) {
    const Eigen::Vector2d in = path[i] - path[i - 1];
    const Eigen::Vector2d out = path[i + 1] - path[i];
    const double curvature = std::abs(std::atan2(Cross(in, out), in.dot(out))) / (0.5 * (in.norm() + out.norm()));
    if (curvature > 1e-3) speed[i] = std::min(speed[i], std::sqrt(kLateralLimit_m_s2 / curvature));
  }
  const auto limit = [&](std::size_t to, std::size_t from) {
    const double step = (path[to] - path[from]).norm();
    speed[to] = std::min(speed[to], std::sqrt(speed[from] * speed[from] + 2 * kBrakeLimit_m_s2 * step));
  };
  for (std::size_t i = 1; i < path.size(); ++i) limit(i, i - 1);
  for (std::size_t i = path.size() - 1; i > 0; --i) limit(i - 1, i);
  return speed;
}

StampNs FrameStamp(std::size_t frame, double rate_hz) {
  return static_cast<StampNs>(std::llround(1e9 * static_cast<double>(frame) / rate_hz));
}

Route Drive(const Path& path, const RouteParameters& parameters) {
  const std::vector<double> speed = SpeedProfile(path, parameters.speed_m_s);
  Route route;
  double time_s = 0.0;
  for (std::size_t i = 0; i + 1 < path.size(); ++i) {
    const Eigen::Vector2d step = path[i + 1] - path[i];
    const double duration_s = step.norm() / (0.5 * (speed[i] + speed[i + 1]));
    while (static_cast<double>(route.size()) / parameters.frame_rate_hz < time_s + duration_s) {
      const double share = (static_cast<double>(route.size()) / parameters.frame_rate_hz - time_s) / duration_s;
      const std::size_t next = std::min(i + 2, path.size() - 1);
      const Eigen::Vector2d ahead = next > i + 1 ? Eigen::Vector2d(path[next] - path[i + 1]) : step;
      const Eigen::Vector2d heading = (1 - share) * step.normalized() + share * ahead.normalized();
      route.push_back({FrameStamp(route.size(), parameters.frame_rate_hz), path[i] + share * step,
                       std::atan2(heading.y(), heading.x())});
    }
    time_s += duration_s;
  }
  return route;
}

using Corners = std::vector<Eigen::Vector2d>;

// Nodes of a street grid, 3 by 2 blocks of unequal size.
Eigen::Vector2d Node(int column, int row) {
  static constexpr double kX[] = {0.0, 106.0, 182.0, 266.0};
  static constexpr double kY[] = {0.0, 76.0, 136.0};
  return {kX[column], kY[row]};
}

Corners LoopsCorners() {
  // Around two blocks, then same-direction revisits of three streets, with one street the other way.
  return {Node(0, 0) + Eigen::Vector2d(15, 0),
          Node(1, 0),
          Node(2, 0),
          Node(2, 1),
          Node(1, 1),
          Node(0, 1),
          Node(0, 0),
          Node(1, 0),
          Node(1, 1),
          Node(2, 1),
          Node(3, 1),
          Node(3, 0),
          Node(2, 0),
          Node(2, 1),
          Node(1, 1),
          Node(1, 2),
          Node(0, 2),
          Node(0, 1),
          Node(0, 0),
          Node(1, 0) - Eigen::Vector2d(15, 0)};
}

Corners OppositeCorners() {
  const Corners out{{0, 0}, {170, 0}, {260, 70}, {430, 70}, {520, 0}, {690, 0}};
  Corners corners = out;
  corners.insert(corners.end(), {{790, 0}, {790, 80}, {690, 80}});
  corners.insert(corners.end(), out.rbegin(), out.rend());
  return corners;
}

Corners DeceptiveCorners() {
  // Twice around a block, along a street to a second block that looks the same, twice around it, and back to the first.
  const auto block = [](double x) { return Corners{{x + 130, 0}, {x + 130, 80}, {x, 80}, {x, 0}}; };
  Corners corners{{20, 0}};
  const auto append = [&corners](const Corners& more) { corners.insert(corners.end(), more.begin(), more.end()); };
  append(block(0));
  append(block(0));
  append(block(260));
  append(block(260));
  append({{390, 0}, {390, 80}, {260, 80}, {130, 80}, {0, 80}, {0, 0}, {110, 0}});
  return corners;
}

Corners LapCorners(int laps) {
  const Corners lap{{160, 0}, {160, 60}, {110, 60}, {110, 100}, {0, 100}, {0, 0}};
  Corners corners{{20, 0}};
  for (int i = 0; i < laps; ++i) corners.insert(corners.end(), lap.begin(), lap.end());
  corners.push_back({60, 0});
  return corners;
}

Corners OfficeCorners() {
  // Twice around the ring of corridors, then through the one in the middle and half of the ring the other way.
  constexpr double kX = kOfficeLength_m, kY = kOfficeWidth_m;
  const Corners lap{{kX, 0}, {kX, kY}, {0, kY}, {0, 0}};
  Corners corners{{4, 0}};
  for (int i = 0; i < 2; ++i) corners.insert(corners.end(), lap.begin(), lap.end());
  corners.insert(corners.end(), {{kX / 2, 0}, {kX / 2, kY}, {kX, kY}, {kX, 0}, {4, 0}});
  return corners;
}

}  // namespace

std::vector<std::string> PresetRouteNames() {
  return {"loops", "opposite", "deceptive", "lap", "office"};
}

Route MakePresetRoute(const std::string& name, const RouteParameters& parameters) {
  if (!(parameters.frame_rate_hz > 0)) throw std::invalid_argument("scan rate must be positive");
  if (!(parameters.speed_m_s > 0)) throw std::invalid_argument("speed must be positive");
  if (parameters.laps < 1) throw std::invalid_argument("laps must be at least 1");
  if (name == "loops") return Drive(PathAlong(LoopsCorners(), kRoad), parameters);
  if (name == "opposite") return Drive(PathAlong(OppositeCorners(), kRoad), parameters);
  if (name == "deceptive") return Drive(PathAlong(DeceptiveCorners(), kRoad), parameters);
  if (name == "lap") return Drive(PathAlong(LapCorners(parameters.laps), kRoad), parameters);
  if (name == "office") {
    RouteParameters walked = parameters;
    walked.speed_m_s = std::min(parameters.speed_m_s, kIndoorSpeed_m_s);
    return Drive(PathAlong(OfficeCorners(), kCorridor), walked);
  }
  throw std::invalid_argument("unknown route '" + name +
                              "': use loops, opposite, deceptive, lap or office, or give a pose file");
}

Route RouteFromKittiPoses(const std::string& file, double frame_rate_hz) {
  if (!(frame_rate_hz > 0)) throw std::invalid_argument("scan rate must be positive");
  std::ifstream stream(file);
  if (!stream) throw std::runtime_error("cannot open pose file " + file);
  Route route;
  std::string line;
  while (std::getline(stream, line)) {
    if (line.find_first_not_of(" \t\r") == std::string::npos) continue;
    std::istringstream numbers(line);
    double row[12];
    for (double& number : row) {
      if (!(numbers >> number) || !std::isfinite(number)) {
        throw std::runtime_error(file + ": row " + std::to_string(route.size() + 1) + " is not 12 numbers");
      }
    }
    // The camera's z axis (forward) and position, seen from above: the town's x is the first camera's z, its y the -x.
    route.push_back({FrameStamp(route.size(), frame_rate_hz), {row[11], -row[3]}, std::atan2(-row[2], row[10])});
  }
  if (route.size() < 2) throw std::runtime_error(file + ": a route needs at least two poses");
  return route;
}

}  // namespace incremental_segmatch::simulator
