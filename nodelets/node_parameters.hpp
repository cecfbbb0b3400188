/// \file
/// Parameters of the nodelets: plain structs, read from the private ROS parameter tree. Unknown names are refused. The
/// core's parameters come from one YAML file (`config_file`) or from the subtree of the same names (`front_end`,
/// `back_end`).
#pragma once

#include <XmlRpcValue.h>
#include <ros/node_handle.h>

#include <string>
#include <vector>

#include "conversions.hpp"
#include "incremental_segmatch/parameters.hpp"
#include "incremental_segmatch/pose_graph.hpp"

namespace incremental_segmatch {

/// Where a front end takes the sensor's pose from.
enum class PoseSource { kTf, kOdometry, kPose };

/// Of FrontEndNodelet.
struct FrontEndNodeParameters {
  std::string robot = "robot";               ///< name of the robot, unique among those of one back end
  PoseSource pose_source = PoseSource::kTf;  ///< `tf` (odom_frame to sensor), `odometry` (topic, plus tf from its child
                                             ///< frame to the sensor) or `pose` (topic, of base_frame, plus tf to the
                                             ///< sensor)
  bool registered =
      false;  ///< clouds are in odom_frame, or one that tf relates to it, instead of in the sensor's frame
  std::string odom_frame = "odom";       ///< frame that drifts but does not jump
  std::string base_frame = "base_link";  ///< frame that trajectories and closures are about; empty: the sensor's
  std::string sensor_frame;              ///< of the LiDAR; empty: the cloud's frame_id (not possible if registered)
  double pose_timeout_s = 0.5;           ///< how long a cloud waits for its pose, by the wall clock
  double odometry_max_gap_s = 0.5;       ///< longest time between two poses of a topic over which is interpolated
  bool frame_jumps = false;              ///< odom_frame jumps at corrections: follow the topic `trajectory`
  FrameKind trajectory_kind = FrameKind::kBase;  ///< whose poses `trajectory` holds: `base` or `sensor`
  double trajectory_wait_s = 0.0;                ///< with frame_jumps: how long a cloud waits for a trajectory stamped no
                                                 ///< earlier, which may tell of a jump; 0: it has come before
  int queue_size = 5;                            ///< clouds; when full, the oldest goes
  bool send_points = true;                       ///< the thinned scan, for refinement, and of new views those that are shown
};

/// Of BackEndNodelet.
struct BackEndNodeParameters {
  std::vector<std::string>
      robots;  ///< topics are <robot>/segments and <robot>/trajectory; none: segments and trajectory
  std::string map_frame = "map";
  FrameKind closure_kind = FrameKind::kBase;     ///< frames of published closures: `base` or `sensor`
  FrameKind trajectory_kind = FrameKind::kBase;  ///< whose poses corrected trajectories hold
  double closure_min_distance_m = 2.0;           ///< way of the robot between published closures; 0: no limit
  double closure_min_interval_s = 0.0;           ///< time between published closures; 0: no limit
  std::string map_file;                          ///< target map to load; empty: none
  std::string output_dir;                        ///< folder for closures.csv; empty: none
  bool publish_tf = true;                        ///< in localization: map_frame to odom
  double tf_tolerance_s = 0.1;                   ///< so far in the future is the transform's stamp
  double display_period_s = 1.0;                 ///< between target maps for rviz
  double display_height_m = 0.0;  ///< target segments, and the matches' ends there, are shown so much higher
  int queue_size = 100;           ///< segment arrays; when full, the oldest goes
};

/// Of PoseGraphNodelet.
struct PoseGraphNodeParameters {
  std::vector<std::string> robots;  ///< as for the back end
  std::string map_frame = "map";
  FrameKind trajectory_kind = FrameKind::kBase;  ///< whose poses published paths hold
  bool publish_tf = true;                        ///< map_frame to odom
  double tf_tolerance_s = 0.1;                   ///< so far in the future is the transform's stamp
  std::string output_dir;          ///< folder for trajectories (TUM) and graph (g2o) at the end; empty: none
  int queue_size = 1000;           ///< segment arrays; when full, the oldest goes
  PoseGraphParameters pose_graph;  ///< subtree `pose_graph`
};

/// What one nodelet reads: its own parameters and the core's.
template <class NodeParameters>
struct NodeletParameters {
  NodeParameters node;
  Parameters core;
};

/// Read the private tree of a nodelet. Throw std::invalid_argument naming the parameter by its full name (unknown, of a
/// wrong type, out of range), std::runtime_error naming the configuration file if it can't be read.
NodeletParameters<FrontEndNodeParameters> ReadFrontEndParameters(const ros::NodeHandle& private_nh);
NodeletParameters<BackEndNodeParameters> ReadBackEndParameters(const ros::NodeHandle& private_nh);
PoseGraphNodeParameters ReadPoseGraphParameters(const ros::NodeHandle& private_nh);

/// Throw std::invalid_argument naming a parameter that is out of range, by its full name below `path`.
void Validate(const FrontEndNodeParameters& node, const std::string& path = "");
void Validate(const BackEndNodeParameters& node, const std::string& path = "");

/// Throws std::invalid_argument unless a path is whole: roslaunch starts nodes in a folder that nobody means.
void RequireWholePath(const std::string& path);

/// A parameter tree as YAML text (flow style). Throws std::invalid_argument for types that YAML has no word for.
std::string ToYamlText(const XmlRpc::XmlRpcValue& value);

}  // namespace incremental_segmatch
