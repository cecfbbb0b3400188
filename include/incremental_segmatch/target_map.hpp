/// \file
/// Target map: segments by (robot, ID) with their views, and the trajectories that the views hang on (METHOD 4).
#pragma once

#include <cstdint>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <unordered_map>
#include <vector>

#include "incremental_segmatch/segment_delta.hpp"
#include "incremental_segmatch/types.hpp"

namespace incremental_segmatch {

/// A trajectory pose: where odometry had the sensor, and where it is in the map after corrections.
struct TrajectoryPose {
  StampNs stamp_ns = 0;                   ///< of the scan
  Pose T_odom_sensor = Pose::Identity();  ///< as odometry had it
  Pose T_map_sensor = Pose::Identity();   ///< as corrected
  double path_m = 0.0;                    ///< gone since the trajectory began, by odometry
};

/// Path at the pose that follows another one.
inline double PathAfter(const TrajectoryPose& before, const Pose& T_odom_sensor) {
  return before.path_m + (T_odom_sensor.translation() - before.T_odom_sensor.translation()).norm();
}

/// One look at a segment.
struct SegmentView {
  RobotIndex robot = 0;                                       ///< on whose trajectory it hangs
  std::uint32_t pose = 0;                                     ///< index of the trajectory pose that it was seen from
  std::uint32_t size = 0;                                     ///< voxels
  Eigen::Vector3d centroid_sensor = Eigen::Vector3d::Zero();  ///< in the frame of that pose
  Descriptor descriptor;                                      ///< unscaled
  /// Some of the points that were seen, to look at: relative to the centroid, axes of that robot's odom; may be null.
  std::shared_ptr<const Points> points_centroid;
};

/// A segment of the map, with the views that are kept of it.
struct TargetSegment {
  std::vector<SegmentView> views;  ///< oldest first; never empty
  StampNs last_seen_ns = 0;        ///< stamp of the last scan that changed it
  bool tracked = false;            ///< by its robot's local map, now
  std::uint32_t missed_visits = 0;  ///< in a row, of where it was seen from; none after UpdateSegment and MoveViews
};

/// A pose of a trajectory whose scan is kept: what recognitions are refined on and closures refer to.
struct Keyframe {
  std::uint32_t pose = 0;                     ///< index of its trajectory pose
  std::shared_ptr<const Points> scan_sensor;  ///< thinned, in that pose's sensor frame; may be null
};

/// A key frame of the map.
struct KeyframeName {
  RobotIndex robot = 0;     ///< on whose trajectory it lies
  std::uint32_t index = 0;  ///< among that robot's key frames
};
/// Whether two names stand for one key frame.
inline bool operator==(const KeyframeName& a, const KeyframeName& b) {
  return a.robot == b.robot && a.index == b.index;
}
/// By robot, and along its trajectory.
inline bool operator<(const KeyframeName& a, const KeyframeName& b) {
  return a.robot != b.robot ? a.robot < b.robot : a.index < b.index;
}

/// A pose of a trajectory that was recognised to be so near to a key frame that none was kept there.
struct Sighting {
  std::uint32_t pose = 0;  ///< index of the trajectory pose
  KeyframeName keyframe;   ///< of any robot
};

/// What is kept.
struct TargetMapParameters {
  std::size_t max_views = 4;  ///< kept of a segment: the newest, and the largest of the others
};

/// Holds segments and trajectories; knows nothing of matching. Not thread-safe. A robot index that RobotByName never
/// gave throws std::out_of_range.
class TargetMap {
 public:
  /// Throws std::invalid_argument naming the parameter that is out of range.
  explicit TargetMap(const TargetMapParameters& parameters);

  /// Index of a robot, given at the first call with its name.
  RobotIndex RobotByName(const std::string& name);
  /// Name of a robot. Throws std::out_of_range for one that is not in the map.
  const std::string& RobotName(RobotIndex robot) const { return robots_.at(robot).name; }
  /// Number of robots.
  std::size_t robots() const { return robots_.size(); }

  /// Appends a pose to a robot's trajectory and returns its index. It follows the last correction rigidly. Throws
  /// std::invalid_argument if the stamp is not after the last one's or the pose is not finite.
  std::uint32_t AddPose(RobotIndex robot, StampNs stamp_ns, const Pose& T_odom_sensor);
  /// Trajectory of a robot, stamps ascending.
  const std::vector<TrajectoryPose>& Trajectory(RobotIndex robot) const { return robots_.at(robot).trajectory; }
  /// Where a robot's odometry had the sensor at a stamp within its trajectory, interpolated; none before and after it.
  /// O(log trajectory).
  std::optional<Pose> OdometryAt(RobotIndex robot, StampNs stamp_ns) const;
  /// T_map_odom of a robot now.
  const Pose& T_map_odom(RobotIndex robot) const { return robots_.at(robot).T_map_odom; }
  /// Sets it for the poses that come from now on. Throws std::invalid_argument if it is not finite.
  void Anchor(RobotIndex robot, const Pose& T_map_odom);
  /// A corrected trajectory, in any order: poses at corrected stamps are taken as they are; the others follow the
  /// nearest earlier corrected pose rigidly, those before the first the first. A corrected pose between two stamps of
  /// the trajectory counts from where odometry, interpolated, had the sensor then; one before or after the trajectory
  /// is ignored. T_map_odom is then that of the newest corrected pose. Throws std::invalid_argument if a pose is not
  /// finite: nothing has changed then. O((trajectory + corrections) log).
  void CorrectTrajectory(RobotIndex robot, const std::vector<StampedPose>& T_map_sensor);

  /// Keeps the scan of a robot's newest pose. Throws std::invalid_argument if the robot has no pose that is newer than
  /// its last key frame's.
  void AddKeyframe(RobotIndex robot, std::shared_ptr<const Points> scan_sensor);
  /// Key frames of a robot, in order of its trajectory.
  const std::vector<Keyframe>& Keyframes(RobotIndex robot) const { return robots_.at(robot).keyframes; }

  /// Notes that a robot's newest pose lies at a key frame. Throws std::invalid_argument if the robot has no pose that is
  /// newer than its last sighting, and std::out_of_range if there is no such key frame.
  void AddSighting(RobotIndex robot, const KeyframeName& keyframe);
  /// Where a robot came by key frames again, in order of its trajectory.
  const std::vector<Sighting>& Sightings(RobotIndex robot) const { return robots_.at(robot).sightings; }

  /// Sets the newest state of a segment, which is tracked from now on: `view` replaces the last view of its robot
  /// unless `keep_last`. Throws std::invalid_argument if the view's pose does not exist.
  void UpdateSegment(const SegmentKey& key, SegmentView view, bool keep_last, StampNs stamp_ns);
  /// Moves the views of `from` to `to`, which is made if there is none; `from` is gone. Views stay ordered by their
  /// pose's stamp; `to` is tracked if either was, and last seen when the later of both was. Nothing happens if there is
  /// no `from`.
  void MoveViews(const SegmentKey& from, const SegmentKey& to);
  /// Takes a segment out, if it is in.
  void Erase(const SegmentKey& key) { segments_.erase(key); }
  /// The segment, or null. Valid until the map is changed.
  TargetSegment* Find(const SegmentKey& key);
  /// The same.
  const TargetSegment* Find(const SegmentKey& key) const;

  /// Ordered by key.
  const std::map<SegmentKey, TargetSegment>& segments() const { return segments_; }

  /// Centroid of a view in the map, after all corrections.
  Eigen::Vector3d CentroidMap(const SegmentView& view) const;
  /// Pose in the map that a view was seen from.
  const TrajectoryPose& PoseOf(const SegmentView& view) const {
    return robots_.at(view.robot).trajectory.at(view.pose);
  }

  /// The key frame that was kept or sighted last when a view was taken; none if there was none yet. O(log key frames).
  std::optional<KeyframeName> KeyframeOf(const SegmentView& view) const;

  /// The key frames that were kept, then those that were sighted, between two distances along a robot's path (m), both
  /// included, in order of its trajectory. O(log key frames, and what is found).
  std::vector<KeyframeName> KeyframesAlong(RobotIndex robot, double from_m, double to_m) const;

  /// Memory held, about. O(map).
  std::size_t memory_bytes() const;

  /// Writes the map; a crash while writing leaves the previous file whole. Throws std::runtime_error naming the file.
  void Save(const std::string& path) const;
  /// Reads a map; no segment of it is tracked. Of a segment with more views than `parameters` allow the same ones stay
  /// as ever. Throws std::runtime_error naming the file and what is wrong with it: damaged, truncated, of another kind
  /// or of a newer version.
  static TargetMap Load(const std::string& path, const TargetMapParameters& parameters);

 private:
  struct Robot {
    std::string name;
    std::vector<TrajectoryPose> trajectory;
    Pose T_map_odom = Pose::Identity();
    std::vector<Keyframe> keyframes;
    std::vector<Sighting> sightings;
  };
  /// Orders views by their pose's stamp and keeps max_views of them.
  void TidyViews(std::vector<SegmentView>* views) const;

  TargetMapParameters parameters_;
  std::vector<Robot> robots_;
  std::map<SegmentKey, TargetSegment> segments_;
};

}  // namespace incremental_segmatch
