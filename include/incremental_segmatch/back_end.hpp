/// \file
/// Map side: changed segments of any number of robots to recognitions; owns the target map (METHOD 4 and 5).
#pragma once

#include <deque>
#include <functional>
#include <limits>
#include <map>
#include <optional>
#include <set>
#include <string>
#include <unordered_map>
#include <vector>

#include "incremental_segmatch/acceptance.hpp"
#include "incremental_segmatch/point_refinement.hpp"
#include "incremental_segmatch/range_image.hpp"
#include "incremental_segmatch/recognizer.hpp"
#include "incremental_segmatch/segment_delta.hpp"
#include "incremental_segmatch/stage_times.hpp"
#include "incremental_segmatch/target_index.hpp"
#include "incremental_segmatch/target_map.hpp"
#include "incremental_segmatch/types.hpp"

namespace incremental_segmatch {

/// What the target map is.
enum class Mode {
  kLoopClosure,  ///< the target map is what the robots of this run have seen so far
  kLocalization  ///< the target map is loaded and fixed
};

/// Which target segments are candidates of a local one.
struct MatchingParameters {
  int nearest = 25;               ///< candidates of a local segment: so many nearest; 0: no limit
  double max_distance = 0.0;      ///< and within this scaled descriptor distance; 0: no limit
  double time_window_s = 60.0;    ///< own views that were taken more recently are no targets (loop closure)
  double min_path_m = 50.0;       ///< nor are those taken less than this much of path ago
  double requery_distance = 0.4;  ///< a segment is matched anew once its scaled descriptor moved so far
};

/// Whose scans are kept along a trajectory, and how many of them make a recognition's counterpart.
struct KeyframeParameters {
  double spacing_m = 2.0;         ///< path between key frames; none where one was recognised to be this near
  double submap_radius_m = 10.0;  ///< scans so near to a key frame's, along the trajectory, are joined to its own
  double reach_m = 50.0;          ///< path between a closure's key frame and poses that matched segments were seen from
};

/// How much of the way that led to a place speaks for or against it: two places that look alike lie on different ways.
struct HistoryParameters {
  double length_m = 150.0;      ///< of path behind the robot
  double spacing_m = 10.0;      ///< path between the scans that are kept
  double max_distance_m = 8.0;  ///< from where a recognition puts such a scan to the key frame that it is held against
  double drift = 0.01;          ///< metres of odometry's drift per metre of path that are allowed for
};

/// When segments that were seen on different visits are one object: after a correction they lie on each other and look alike.
struct MergingParameters {
  double distance_m = 0.5;           ///< between the centroids of two views; 0: nothing is merged
  double descriptor_distance = 3.0;  ///< scaled, between these views
};

/// When a segment is gone: a car that drove away, a piece that fell apart otherwise ever after, or one that was hardly there.
struct ForgettingParameters {
  int missed_visits = 2;  ///< visits in a row on which it was not seen: it leaves after the last of them; 0: never
  int min_views = 2;      ///< of what is new where the robot has been before, or it leaves after that visit: so many, or
                          ///< all that can be kept of a segment, if these are fewer; 0 or 1: any
};

/// Of the map side.
struct BackEndParameters {
  Mode mode = Mode::kLoopClosure;    ///< loop closure or localization
  MatchingParameters matching;       ///< candidates of a local segment
  RecognizerParameters recognizer;   ///< candidates to a transform
  KeyframeParameters keyframes;      ///< which scans are kept
  HistoryParameters history;         ///< of the way here, as evidence
  FreeSpaceParameters free_space;    ///< when a scan contradicts another
  RefinementParameters refinement;   ///< of the transform, on scans
  AcceptanceParameters acceptance;   ///< evidence that a recognition must have
  TargetMapParameters target_map;    ///< what is kept
  MergingParameters merging;         ///< what of it is the same
  ForgettingParameters forgetting;   ///< and what is gone
};

/// A matched pair of segments, for evidence and display.
struct SegmentMatch {
  SegmentKey local;                                               ///< of the query robot's local map
  SegmentKey target;                                              ///< of the target map
  Eigen::Vector3d centroid_local_odom = Eigen::Vector3d::Zero();  ///< in the query robot's odometry frame
  Eigen::Vector3d centroid_target_map = Eigen::Vector3d::Zero();  ///< in the map
  float descriptor_distance = 0.f;                                ///< scaled descriptor distance
};

/// Relative pose of two sensor poses: what every pose graph takes.
struct Closure {
  StampNs stamp_query_ns = 0;              ///< of the newer pose: the scan that recognised the place
  StampNs stamp_target_ns = 0;             ///< of the older pose, from which matched segments were seen
  std::string robot_query;                 ///< whose scan it was
  std::string robot_target;                ///< whose trajectory the older pose belongs to
  Pose T_target_query = Pose::Identity();  ///< pose of the query's sensor in the target sensor's frame
  Covariance6 covariance =
      Covariance6::Identity();         ///< of T_target_query, ROS's order, perturbation on the right: T exp(xi)
  std::size_t inliers = 0;             ///< matches that agree
  std::size_t candidates = 0;          ///< matches of which these agree
  double rms_m = 0.0;                  ///< residual of the inliers' centroids
  Evidence evidence;                   ///< what it was judged by
  Pose T_map_odom = Pose::Identity();  ///< where this recognition puts the query's odom frame
  std::vector<SegmentMatch> matches;   ///< the inliers
};

/// The stage that ended a step: why no loop here?
enum class StepEnd {
  kRecognized,
  kNoSegments,
  kNoTargets,
  kTooFewCandidates,
  kCliqueTooSmall,
  kDegenerate,
  kTilted,
  kLargeResidual,
  kNotRefined,
  kTooYoung,
  kAmbiguous,
  kUncovered,
  kContradicted,
  kUncertain,
  kTooFar
};
/// The name as in steps.csv and StepReport.msg.
const char* ToString(StepEnd end);

/// The map side's part of the funnel.
struct BackEndCounts {
  std::size_t local_segments = 0;      ///< tracked by the robot
  std::size_t target_segments = 0;     ///< in the map
  std::size_t allowed_targets = 0;     ///< of them, open to matching
  std::size_t requeried = 0;           ///< local segments that were matched anew
  std::size_t candidates = 0;          ///< matches that entered recognition
  std::size_t tested_pairs = 0;        ///< of candidates, for consistency
  std::size_t edges = 0;               ///< consistent pairs that may be in a set of the smallest acceptable size
  std::size_t clique = 0;              ///< size of the largest consistent set
  std::optional<Evidence> evidence;    ///< of a recognition that was judged, accepted or not
  StepEnd end = StepEnd::kNoSegments;  ///< the stage that ended the step
};

/// What came of one delta.
struct BackEndStep {
  std::optional<Closure> closure;  ///< the place, if one was recognised
  std::optional<Closure> refused;  ///< what was recognised, but refused for its evidence (counts.end says why)
  std::vector<Closure> settled;    ///< of earlier steps, refused as ambiguous: with this one they are certain; oldest first
  bool missed_delta = false;       ///< a delta is missing: ask the robot for a full state; this one was not applied
  std::vector<SegmentMatch> candidates;  ///< all that entered recognition
  BackEndCounts counts;                  ///< the funnel
  StageTimes times;                      ///< of this step
};

/// Takes the place of Recognizer: the batch baseline's, say.
using RecognizeFunction = std::function<RecognizerResult(const Correspondences&)>;

/// Recognises places. Synchronous; not thread-safe.
class BackEnd {
 public:
  /// Throws std::invalid_argument naming the parameter that is out of range, or in kLocalization.
  explicit BackEnd(const BackEndParameters& parameters, RecognizeFunction recognize = {});
  /// With a map that was loaded: needed for kLocalization, allowed for kLoopClosure.
  BackEnd(const BackEndParameters& parameters, TargetMap map, RecognizeFunction recognize = {});

  /// Applies a delta of a robot and attempts a recognition.
  BackEndStep Process(const SegmentDelta& delta);

  /// Attempts a recognition once more, from the last delta of a robot: after a change of the parameters, say. Throws
  /// std::invalid_argument if nothing has come from that robot.
  BackEndStep RecognizeAgain(const std::string& robot);

  /// Changes parameters between two deltas. Throws std::invalid_argument naming the parameter that is out of range, or
  /// that holds for life (mode, target_map): nothing has changed then. All local segments are matched anew.
  void ChangeParameters(const BackEndParameters& parameters);

  /// The corrected trajectory of a robot (sensor poses in the map): its target segments move along. Segments that lie on
  /// each other then, with like descriptors, become one, unless they are tracked or were seen on the same visit (METHOD 4).
  /// O(map), but for those near each other along one axis.
  void CorrectTrajectory(const std::string& robot, const std::vector<StampedPose>& T_map_sensor);

  /// The target map.
  const TargetMap& map() const { return map_; }
  /// Which views of it are open to matching, as of the last delta.
  const TargetIndex& targets() const { return index_; }
  /// As given to the constructor, or changed since.
  const BackEndParameters& parameters() const { return parameters_; }
  /// Memory held, about: the map, scans of the way here, scans prepared for refinement, closures that wait. O(map).
  std::size_t memory_bytes() const;

 private:
  // A tracked segment of a robot's local map.
  struct LocalSegment {
    Eigen::Vector3d centroid_odom = Eigen::Vector3d::Zero();
    Descriptor descriptor;
    StampNs last_seen_ns = 0;
    std::optional<SegmentKey> same_as;  // target segment that it was recognised as
    Descriptor queried;                                            // descriptor at the last query; empty: never
    std::uint64_t queried_generation = 0;
    std::uint64_t next_item = 0;              // of the index at the last look
    std::vector<TargetCandidate> candidates;  // nearest first
  };
  // A scan of the way that a robot has come.
  struct PastScan {
    Pose T_odom_sensor;
    double path_m = 0.0;
    RangeImage image;
  };
  // How well a scan lay on the map's.
  struct Fit {
    double path_m = 0.0;
    double value = 0.0;  // its overlap over what could be expected
  };
  // A closure that would be accepted, were it not ambiguous.
  struct WaitingClosure {
    double path_m = 0.0;  // of the robot, there
    Closure closure;
  };
  // Recognitions that agree with each other by odometry.
  struct Track {
    KeyframeName target;  // of the last one
    Pose T_target_query;
    Pose T_odom_sensor;
    std::deque<Fit> fits;  // along the way
    bool is_proven = false;  // one of them was accepted
    std::deque<WaitingClosure> waiting;  // ambiguous ones, until then
  };
  // A place where the robot may be.
  struct Hypothesis {
    KeyframeName target;
    Closure closure;
    std::vector<bool> fits;  // whether each of the scan's points lies on something there; empty without refinement
  };
  // That a robot came by a key frame again.
  struct Revisit {
    std::uint32_t pose = 0;  // of the robot when it began
    KeyframeName keyframe;
  };
  struct Robot {
    std::string name;
    RobotIndex frame = 0;  // robots with the same value share a map frame
    bool started = false;
    bool is_corrected = false;  // from outside: until then each closure tells where it goes on
    std::uint64_t sequence = 0;
    StampNs stamp_ns = 0;
    double path_m = 0.0;
    double twin_path_m = -std::numeric_limits<double>::infinity();      // where a place last had a twin
    double keyframe_path_m = -std::numeric_limits<double>::infinity();  // where the last key frame was kept or sighted
    Pose T_odom_sensor = Pose::Identity();      // odom without its jumps, here and in all else that is kept
    Pose T_odom_continuous = Pose::Identity();  // and the jumps
    std::shared_ptr<const Points> scan_sensor;  // of the last delta
    std::deque<PastScan> history;
    std::vector<Track> tracks;
    std::deque<Revisit> revisits;  // that are not over, oldest first
    std::map<SegmentId, LocalSegment> local;
  };

  // What is known of a key frame's surroundings.
  struct Place {
    std::set<SegmentKey> segments;  // seen from there; those that went, or were seen from elsewhere since, may be in still
    std::map<RobotIndex, std::uint32_t> visits;  // a robot's pose at its last visit
  };

  // The joined scans of a key frame and of those around it.
  struct Submap {
    KeyframeName center;
    RefinementTarget target;        // in the sensor's frame of the center
    double expected_overlap = 0.0;  // of the center's scan with the others; 0: not asked for yet
  };

  RobotIndex RobotByName(const std::string& name);
  bool IsLoopClosure() const { return parameters_.mode == Mode::kLoopClosure; }
  BackEndStep AttemptRecognition(RobotIndex robot, StageTimer timer);
  void ApplyDelta(const SegmentDelta& delta, RobotIndex robot);
  void RetireSegment(RobotIndex robot, const RetiredSegment& retired);
  void RenameSegment(RobotIndex robot, const RenamedSegment& renamed);
  void UpdateSegment(RobotIndex robot, const SegmentState& state, const SegmentDelta& delta);
  void AwaitRelease(const SegmentKey& key);
  void MergeDuplicates();
  bool AreOfDifferentVisits(const TargetSegment& a, const TargetSegment& b) const;
  void ReleaseTargets(StampNs now_ns);
  std::size_t CountReleased(const TargetSegment& target) const;
  bool MatchSegment(RobotIndex robot, LocalSegment* segment) const;
  bool NeedsQuery(RobotIndex robot, const LocalSegment& segment) const;
  std::map<RobotIndex, Correspondences> CollectCorrespondences(RobotIndex robot) const;
  RecognizerResult Recognize(RobotIndex robot, const std::map<RobotIndex, Correspondences>& by_frame);
  std::optional<Hypothesis> Verify(RobotIndex robot, const std::map<RobotIndex, Correspondences>& by_frame,
                                   const RecognizerResult& result, BackEndStep* step);
  std::optional<Hypothesis> BestHypothesis(RobotIndex robot, const std::map<RobotIndex, Correspondences>& by_frame,
                                           const RecognizerResult& result, StepEnd* end);
  std::optional<Hypothesis> ContinueTrack(RobotIndex robot, const std::map<RobotIndex, Correspondences>& by_frame,
                                          std::size_t rival_size);
  std::optional<Hypothesis> LayOnScans(RobotIndex robot, const Recognition& recognition, StepEnd* end);
  static double Distinction(const Hypothesis& first, const Hypothesis& second);
  bool IsBetter(RobotIndex robot, const Hypothesis& first, const Hypothesis& second) const;
  Pose PlaceNow(RobotIndex robot, const Track& track) const;
  void ForgetTracks(RobotIndex robot);
  std::vector<Track>::const_iterator FindTrack(RobotIndex robot, const Hypothesis& hypothesis) const;
  bool IsOnProvenTrack(RobotIndex robot, const Hypothesis& hypothesis) const;
  Track& FollowTrack(RobotIndex robot, const Hypothesis& hypothesis, double fit, Evidence* evidence);
  void SettleTrack(RobotIndex robot, const Closure& closure, Verdict verdict, Track* track, std::vector<Closure>* settled) const;
  double ExpectedOverlap(const KeyframeName& keyframe);
  const SegmentView& MatchedView(RobotIndex robot, const Correspondence& inlier) const;
  const TrajectoryPose& PoseOf(const KeyframeName& keyframe) const;
  // Calls visit(index) for a key frame and for those around it along its trajectory, either way as long as it is true.
  template <typename Visit>
  void VisitAlong(const KeyframeName& around, Visit visit) const {
    for (std::uint32_t i = around.index; i < map_.Keyframes(around.robot).size() && visit(i); ++i) {
    }
    for (std::uint32_t i = around.index; i > 0 && visit(i - 1); --i) {
    }
  }
  std::optional<KeyframeName> NearestKeyframeAlong(const KeyframeName& around, double along_m, const Eigen::Vector3d& place) const;
  void MeasureContradiction(RobotIndex robot, const KeyframeName& target, const Closure& closure, Evidence* evidence) const;
  void KeepHistory(RobotIndex robot);
  bool IsYoung(RobotIndex robot, std::uint32_t pose) const;
  std::optional<KeyframeName> NearestKeyframe(RobotIndex robot, const Recognition& recognition) const;
  bool Refine(RobotIndex robot, Hypothesis* hypothesis);
  Submap& SubmapAround(const KeyframeName& keyframe);
  std::vector<Eigen::Vector3d> JoinScans(const KeyframeName& center, bool with_center) const;
  void MeasureCoverage(RobotIndex robot, const Pose& T_map_odom, Evidence* evidence) const;
  Closure MakeClosure(RobotIndex robot, StampNs stamp_ns, const Recognition& recognition, const KeyframeName& keyframe) const;
  void KeepKeyframe(RobotIndex robot, const Hypothesis* recognized);
  void CountVisit(RobotIndex robot, const KeyframeName& sighted);
  void MissVisit(RobotIndex robot, const KeyframeName& keyframe);
  void EndVisits(RobotIndex robot);
  bool HasMissedEnough(const TargetSegment& segment) const;
  bool IsGlimpse(RobotIndex robot, const Revisit& revisit, const TargetSegment& segment) const;
  std::vector<SegmentKey> SegmentsSeenFrom(const KeyframeName& keyframe);
  std::optional<KeyframeName> SeenFrom(const TargetSegment& segment) const;
  bool IsSeenOnThisVisit(RobotIndex robot, const TargetSegment& segment) const;
  void AcceptClosure(RobotIndex robot, const Closure& closure);
  void JoinFrames(RobotIndex robot, RobotIndex target_robot, const Pose& T_map_odom);

  BackEndParameters parameters_;
  RecognizeFunction recognize_;  // none: recognizers_
  TargetMap map_;
  TargetIndex index_;
  std::map<std::pair<RobotIndex, RobotIndex>, Recognizer> recognizers_;  // by robot and frame of its targets
  std::vector<Robot> robots_;  // by RobotIndex; those of a loaded map come first
  RobotIndex loaded_robots_ = 0;
  std::multimap<StampNs, SegmentKey> waiting_;  // segments by when views of them were taken that are not released yet
  std::map<KeyframeName, Place> places_;
  std::deque<Submap> submaps_;               // of the last refinements, newest first: the next one is near
};

}  // namespace incremental_segmatch
