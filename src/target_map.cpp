#include "incremental_segmatch/target_map.hpp"

#include <algorithm>
#include <stdexcept>
#include <tuple>

namespace incremental_segmatch {

TargetMap::TargetMap(const TargetMapParameters& parameters) : parameters_(parameters) {
  if (parameters.max_views < 1) {
    throw std::invalid_argument("target_map.max_views is 0; a segment needs at least one view");
  }
}

RobotIndex TargetMap::RobotByName(const std::string& name) {
  const auto it = std::find_if(robots_.begin(), robots_.end(), [&](const Robot& robot) { return robot.name == name; });
  const auto index = static_cast<RobotIndex>(it - robots_.begin());
  if (it == robots_.end()) robots_.push_back({name, {}, Pose::Identity(), {}, {}});
  return index;
}

std::uint32_t TargetMap::AddPose(RobotIndex robot_index, StampNs stamp_ns, const Pose& T_odom_sensor) {
  Robot& robot = robots_.at(robot_index);
  if (!T_odom_sensor.matrix().allFinite()) {
    throw std::invalid_argument("target map: a pose of robot '" + robot.name + "' is not finite");
  }
  if (!robot.trajectory.empty() && stamp_ns <= robot.trajectory.back().stamp_ns) {
    throw std::invalid_argument("target map: stamps of robot '" + robot.name + "' must increase, but " +
                                std::to_string(stamp_ns) + " ns follows " +
                                std::to_string(robot.trajectory.back().stamp_ns) + " ns");
  }
  const double path_m = robot.trajectory.empty() ? 0.0 : PathAfter(robot.trajectory.back(), T_odom_sensor);
  robot.trajectory.push_back({stamp_ns, T_odom_sensor, robot.T_map_odom * T_odom_sensor, path_m});
  return static_cast<std::uint32_t>(robot.trajectory.size() - 1);
}

void TargetMap::AddKeyframe(RobotIndex robot_index, std::shared_ptr<const Points> scan_sensor) {
  Robot& robot = robots_.at(robot_index);
  const std::size_t known = robot.keyframes.empty() ? 0 : robot.keyframes.back().pose + 1;
  if (robot.trajectory.size() <= known) {
    throw std::invalid_argument("target map: robot '" + robot.name + "' has no pose that is newer than its last key frame");
  }
  robot.keyframes.push_back({static_cast<std::uint32_t>(robot.trajectory.size() - 1), std::move(scan_sensor)});
}

void TargetMap::AddSighting(RobotIndex robot_index, const KeyframeName& keyframe) {
  Robot& robot = robots_.at(robot_index);
  robots_.at(keyframe.robot).keyframes.at(keyframe.index);
  const std::size_t known = robot.sightings.empty() ? 0 : robot.sightings.back().pose + 1;
  if (robot.trajectory.size() <= known) {
    throw std::invalid_argument("target map: robot '" + robot.name + "' has no pose that is newer than its last sighting");
  }
  robot.sightings.push_back({static_cast<std::uint32_t>(robot.trajectory.size() - 1), keyframe});
}

std::optional<Pose> TargetMap::OdometryAt(RobotIndex robot, StampNs stamp_ns) const {
  const std::vector<TrajectoryPose>& trajectory = Trajectory(robot);
  const auto after = std::lower_bound(trajectory.begin(), trajectory.end(), stamp_ns,
                                      [](const TrajectoryPose& pose, StampNs stamp) { return pose.stamp_ns < stamp; });
  if (after == trajectory.end()) return std::nullopt;
  if (after->stamp_ns == stamp_ns) return after->T_odom_sensor;
  if (after == trajectory.begin()) return std::nullopt;
  const TrajectoryPose& before = *std::prev(after);
  const double share =
      static_cast<double>(stamp_ns - before.stamp_ns) / static_cast<double>(after->stamp_ns - before.stamp_ns);
  const Eigen::Quaterniond rotation =
      Eigen::Quaterniond(before.T_odom_sensor.linear()).slerp(share, Eigen::Quaterniond(after->T_odom_sensor.linear()));
  Pose T_odom_sensor = Pose::Identity();
  T_odom_sensor.linear() = rotation.toRotationMatrix();
  T_odom_sensor.translation() =
      (1.0 - share) * before.T_odom_sensor.translation() + share * after->T_odom_sensor.translation();
  return T_odom_sensor;
}

void TargetMap::CorrectTrajectory(RobotIndex robot_index, const std::vector<StampedPose>& T_map_sensor) {
  Robot& robot = robots_.at(robot_index);
  struct Correction {
    StampNs stamp_ns;
    Pose T_map_sensor;
    Pose T_map_odom;
  };
  std::vector<Correction> corrections;
  corrections.reserve(T_map_sensor.size());
  for (const StampedPose& pose : T_map_sensor) {
    if (!pose.T_frame_sensor.matrix().allFinite()) {
      throw std::invalid_argument("target map: a corrected pose of robot '" + robot.name + "' is not finite");
    }
    const std::optional<Pose> T_odom_sensor = OdometryAt(robot_index, pose.stamp_ns);
    if (!T_odom_sensor) continue;
    corrections.push_back({pose.stamp_ns, pose.T_frame_sensor, pose.T_frame_sensor * T_odom_sensor->inverse()});
  }
  if (corrections.empty()) return;
  std::stable_sort(corrections.begin(), corrections.end(),
                   [](const Correction& a, const Correction& b) { return a.stamp_ns < b.stamp_ns; });

  auto next = corrections.begin();
  const Correction* current = &*next;  // poses before the first correction follow the first
  for (TrajectoryPose& pose : robot.trajectory) {
    while (next != corrections.end() && next->stamp_ns <= pose.stamp_ns) current = &*next++;
    pose.T_map_sensor =
        current->stamp_ns == pose.stamp_ns ? current->T_map_sensor : current->T_map_odom * pose.T_odom_sensor;
  }
  robot.T_map_odom = corrections.back().T_map_odom;
}

void TargetMap::Anchor(RobotIndex robot, const Pose& T_map_odom) {
  if (!T_map_odom.matrix().allFinite()) {
    throw std::invalid_argument("target map: where robot '" + RobotName(robot) + "' is to go on is not finite");
  }
  robots_.at(robot).T_map_odom = T_map_odom;
}

void TargetMap::UpdateSegment(const SegmentKey& key, SegmentView view, bool keep_last, StampNs stamp_ns) {
  if (view.robot >= robots_.size() || view.pose >= robots_[view.robot].trajectory.size()) {
    throw std::invalid_argument("target map: a view of segment " + std::to_string(key.id) +
                                " hangs on a trajectory pose that was never added");
  }
  TargetSegment& segment = segments_[key];
  segment.last_seen_ns = stamp_ns;
  segment.tracked = true;
  segment.missed_visits = 0;
  if (!keep_last) {
    // The last view of this robot: after segments of two robots were merged, the other one's clock may be ahead.
    const auto last = std::find_if(segment.views.rbegin(), segment.views.rend(),
                                   [&](const SegmentView& other) { return other.robot == view.robot; });
    if (last != segment.views.rend()) segment.views.erase(std::next(last).base());
  }
  segment.views.push_back(std::move(view));
  TidyViews(&segment.views);
}

void TargetMap::MoveViews(const SegmentKey& from, const SegmentKey& to) {
  if (from == to) return;
  const auto it = segments_.find(from);
  if (it == segments_.end()) return;
  TargetSegment moved = std::move(it->second);
  segments_.erase(it);
  const auto [target, is_new] = segments_.try_emplace(to);
  TargetSegment& segment = target->second;
  segment.last_seen_ns = is_new ? moved.last_seen_ns : std::max(segment.last_seen_ns, moved.last_seen_ns);
  segment.tracked = segment.tracked || moved.tracked;
  segment.missed_visits = 0;
  segment.views.insert(segment.views.end(), std::make_move_iterator(moved.views.begin()),
                       std::make_move_iterator(moved.views.end()));
  TidyViews(&segment.views);
}

void TargetMap::TidyViews(std::vector<SegmentView>* views) const {
  std::stable_sort(views->begin(), views->end(), [this](const SegmentView& a, const SegmentView& b) {
    return std::make_tuple(PoseOf(a).stamp_ns, a.robot) < std::make_tuple(PoseOf(b).stamp_ns, b.robot);
  });
  while (views->size() > parameters_.max_views) {
    const auto smallest = std::min_element(views->begin(), std::prev(views->end()),
                                           [](const SegmentView& a, const SegmentView& b) { return a.size < b.size; });
    views->erase(smallest);  // of equally large ones the oldest
  }
}

TargetSegment* TargetMap::Find(const SegmentKey& key) {
  const auto it = segments_.find(key);
  return it == segments_.end() ? nullptr : &it->second;
}

const TargetSegment* TargetMap::Find(const SegmentKey& key) const {
  const auto it = segments_.find(key);
  return it == segments_.end() ? nullptr : &it->second;
}

Eigen::Vector3d TargetMap::CentroidMap(const SegmentView& view) const {
  return PoseOf(view).T_map_sensor * view.centroid_sensor;
}

std::optional<KeyframeName> TargetMap::KeyframeOf(const SegmentView& view) const {
  const Robot& robot = robots_.at(view.robot);
  const auto is_later = [](std::uint32_t pose, const auto& marked) { return pose < marked.pose; };
  const auto keyframe = std::upper_bound(robot.keyframes.begin(), robot.keyframes.end(), view.pose, is_later);
  const auto sighting = std::upper_bound(robot.sightings.begin(), robot.sightings.end(), view.pose, is_later);
  const bool is_kept = keyframe != robot.keyframes.begin(), is_sighted = sighting != robot.sightings.begin();
  if (is_sighted && (!is_kept || std::prev(keyframe)->pose < std::prev(sighting)->pose)) return std::prev(sighting)->keyframe;
  if (!is_kept) return std::nullopt;
  return KeyframeName{view.robot, static_cast<std::uint32_t>(keyframe - robot.keyframes.begin() - 1)};
}

std::vector<KeyframeName> TargetMap::KeyframesAlong(RobotIndex robot_index, double from_m, double to_m) const {
  const Robot& robot = robots_.at(robot_index);
  const auto is_before = [&](const auto& marked, double path_m) { return robot.trajectory[marked.pose].path_m < path_m; };
  const auto is_along = [&](const auto& marked) { return robot.trajectory[marked.pose].path_m <= to_m; };
  std::vector<KeyframeName> found;
  auto keyframe = std::lower_bound(robot.keyframes.begin(), robot.keyframes.end(), from_m, is_before);
  for (; keyframe != robot.keyframes.end() && is_along(*keyframe); ++keyframe)
    found.push_back({robot_index, static_cast<std::uint32_t>(keyframe - robot.keyframes.begin())});
  auto sighting = std::lower_bound(robot.sightings.begin(), robot.sightings.end(), from_m, is_before);
  for (; sighting != robot.sightings.end() && is_along(*sighting); ++sighting) found.push_back(sighting->keyframe);
  return found;
}

std::size_t TargetMap::memory_bytes() const {
  constexpr std::size_t kTreeNodeOverhead = 4 * sizeof(void*);
  std::size_t bytes = sizeof(*this) + robots_.capacity() * sizeof(Robot);
  for (const Robot& robot : robots_) {
    bytes += robot.trajectory.capacity() * sizeof(TrajectoryPose) + robot.keyframes.capacity() * sizeof(Keyframe) +
             robot.sightings.capacity() * sizeof(Sighting);
    for (const Keyframe& keyframe : robot.keyframes)
      if (keyframe.scan_sensor) bytes += keyframe.scan_sensor->capacity() * sizeof(Eigen::Vector3f);
  }
  for (const auto& entry : segments_) {
    bytes += sizeof(entry) + kTreeNodeOverhead + entry.second.views.capacity() * sizeof(SegmentView);
    for (const SegmentView& view : entry.second.views) {
      bytes += static_cast<std::size_t>(view.descriptor.size()) * sizeof(float);
      if (view.points_centroid) bytes += view.points_centroid->capacity() * sizeof(Eigen::Vector3f);
    }
  }
  return bytes;
}

}  // namespace incremental_segmatch
