/// \file
/// Map side: changed segments of any number of robots to recognitions; owns the target map (METHOD 4 and 5).
#pragma once

#include <optional>
#include <set>
#include <string>
#include <unordered_map>
#include <vector>

#include "incremental_segmatch/descriptor_index.hpp"
#include "incremental_segmatch/point_refinement.hpp"
#include "incremental_segmatch/recognizer.hpp"
#include "incremental_segmatch/segment_delta.hpp"
#include "incremental_segmatch/stage_times.hpp"
#include "incremental_segmatch/target_map.hpp"
#include "incremental_segmatch/types.hpp"

namespace incremental_segmatch {

enum class Mode {
  kLoopClosure,  ///< the target map is what the robots of this run have seen so far
  kLocalization  ///< the target map is loaded and fixed
};

struct MatchingParameters {
  int nearest = 25;                  ///< candidates of a local segment: so many nearest; 0: no limit
  double max_distance = 0.0;         ///< and within this scaled descriptor distance; 0: no limit
  double time_window_s = 60.0;       ///< own segments seen more recently are no targets (loop closure)
  double requery_distance = 0.2;     ///< a segment is matched anew once its scaled descriptor moved so far
};

struct BackEndParameters {
  Mode mode = Mode::kLoopClosure;
  MatchingParameters matching;
  RecognizerParameters recognizer;
  RefinementParameters refinement;
  TargetMapParameters target_map;
};

/// A matched pair of segments, for evidence and display.
struct SegmentMatch {
  SegmentKey local;
  SegmentKey target;
  Eigen::Vector3d centroid_local_odom = Eigen::Vector3d::Zero();
  Eigen::Vector3d centroid_target_map = Eigen::Vector3d::Zero();
};

/// Relative pose of two sensor poses: what every pose graph takes.
struct LoopClosure {
  StampNs stamp_query_ns = 0;
  StampNs stamp_target_ns = 0;
  std::string robot_query;
  std::string robot_target;
  Pose T_target_query = Pose::Identity();              ///< pose of the query's sensor in the target sensor's frame
  Covariance6 covariance = Covariance6::Identity();    ///< of T_target_query, ROS's order, perturbation on the right: T exp(xi)
  std::size_t inliers = 0;
  std::size_t candidates = 0;
  double rms_m = 0.0;
  Pose T_map_odom = Pose::Identity();                  ///< where this recognition puts the query's odom frame
  std::vector<SegmentMatch> matches;                   ///< the inliers
};

/// The stage that ended a step: why no loop here?
enum class StepEnd { kRecognized, kNoSegments, kNoTargets, kTooFewCandidates, kCliqueTooSmall, kDegenerate, kTilted, kLargeResidual,
                     kNotRefined };
const char* ToString(StepEnd end);

/// The map side's part of the funnel.
struct BackEndCounts {
  std::size_t local_segments = 0;
  std::size_t target_segments = 0;      ///< in the map
  std::size_t allowed_targets = 0;      ///< of them, open to matching
  std::size_t requeried = 0;            ///< local segments that were matched anew
  std::size_t candidates = 0;
  std::size_t tested_pairs = 0;
  std::size_t edges = 0;
  std::size_t clique = 0;
  StepEnd end = StepEnd::kNoSegments;
};

struct BackEndStep {
  std::optional<LoopClosure> closure;
  bool missed_delta = false;            ///< a delta is missing: ask the robot for a full state; this one was not applied
  std::vector<SegmentMatch> candidates; ///< all that entered recognition
  BackEndCounts counts;
  StageTimes times;
};

/// Recognises places. Synchronous; not thread-safe.
class BackEnd {
 public:
  /// Throws std::invalid_argument naming the parameter that is out of range, or in kLocalization.
  explicit BackEnd(const BackEndParameters& parameters);
  /// With a map that was loaded: needed for kLocalization, allowed for kLoopClosure.
  BackEnd(const BackEndParameters& parameters, TargetMap map);

  /// Applies a delta of a robot and attempts a recognition.
  BackEndStep Process(const SegmentDelta& delta);

  /// The corrected trajectory of a robot (sensor poses in the map): its target segments move along. O(map).
  void CorrectTrajectory(const std::string& robot, const std::vector<StampedPose>& T_map_sensor);

  const TargetMap& map() const { return map_; }
  const BackEndParameters& parameters() const { return parameters_; }
  std::size_t memory_bytes() const;

 private:
  struct LocalSegment {
    Eigen::Vector3d centroid_odom;
    Descriptor descriptor;
    std::uint32_t size = 0;
    std::shared_ptr<const Points> points_centroid;   ///< of its newest view
    Eigen::Vector3d points_origin_odom;              ///< centroid that those points are relative to
    Descriptor queried;                              ///< descriptor at the last query; empty: never
    std::vector<std::pair<SegmentKey, float>> candidates;
    std::optional<SegmentKey> same_as;               ///< target segment that it was recognised as
  };
  using LocalMap = std::map<SegmentId, LocalSegment>;

  struct Robot {
    std::uint64_t sequence = 0;
    bool started = false;
    LocalMap local;
  };

  bool ApplyDelta(const SegmentDelta& delta, RobotIndex robot);
  void ReleaseTargets(StampNs now_ns);
  void MatchSegments(RobotIndex robot, BackEndCounts* counts);

  BackEndParameters parameters_;
  TargetMap map_;
  Recognizer recognizer_;
  std::vector<Robot> robots_;
};

}  // namespace incremental_segmatch
