#include "incremental_segmatch/back_end.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>
#include <utility>

namespace incremental_segmatch {
namespace {

StepEnd ToStepEnd(RecognitionOutcome outcome) {
  switch (outcome) {
    case RecognitionOutcome::kAccepted: return StepEnd::kRecognized;
    case RecognitionOutcome::kTooFewCandidates: return StepEnd::kTooFewCandidates;
    case RecognitionOutcome::kCliqueTooSmall: return StepEnd::kCliqueTooSmall;
    case RecognitionOutcome::kDegenerate: return StepEnd::kDegenerate;
    case RecognitionOutcome::kTilted: return StepEnd::kTilted;
    case RecognitionOutcome::kLargeResidual: return StepEnd::kLargeResidual;
  }
  return StepEnd::kTooFewCandidates;
}

/// A delta in the frame that odom would be without its jumps.
SegmentDelta InContinuousFrame(const SegmentDelta& delta) {
  const Pose T_continuous_odom = delta.T_odom_continuous.inverse();
  const Eigen::Matrix3f R = T_continuous_odom.linear().cast<float>();
  SegmentDelta continuous = delta;
  continuous.T_odom_sensor = T_continuous_odom * delta.T_odom_sensor;
  for (SegmentState& state : continuous.changed) {
    state.centroid_odom = T_continuous_odom * state.centroid_odom;
    if (!state.points_centroid) continue;
    auto points = std::make_shared<Points>(*state.points_centroid);
    for (Eigen::Vector3f& p : *points) p = R * p;
    state.points_centroid = std::move(points);
  }
  return continuous;
}

/// A step's results in odom as it is now.
void TakeToJumpingFrame(const Pose& T_odom_continuous, BackEndStep* step) {
  for (SegmentMatch& match : step->candidates) match.centroid_local_odom = T_odom_continuous * match.centroid_local_odom;
  const auto take = [&](Closure* closure) {
    closure->T_map_odom = closure->T_map_odom * T_odom_continuous.inverse();
    for (SegmentMatch& match : closure->matches) match.centroid_local_odom = T_odom_continuous * match.centroid_local_odom;
  };
  if (step->closure) take(&*step->closure);
  if (step->refused) take(&*step->refused);
  for (Closure& closure : step->settled) take(&closure);
}

}  // namespace

const char* ToString(StepEnd end) {
  switch (end) {
    case StepEnd::kRecognized: return "recognized";
    case StepEnd::kNoSegments: return "no_segments";
    case StepEnd::kNoTargets: return "no_targets";
    case StepEnd::kTooFewCandidates: return "too_few_candidates";
    case StepEnd::kCliqueTooSmall: return "clique_too_small";
    case StepEnd::kDegenerate: return "degenerate";
    case StepEnd::kTilted: return "tilted";
    case StepEnd::kLargeResidual: return "large_residual";
    case StepEnd::kNotRefined: return "not_refined";
    case StepEnd::kTooYoung: return "too_young";
    case StepEnd::kAmbiguous: return "ambiguous";
    case StepEnd::kUncovered: return "uncovered";
    case StepEnd::kContradicted: return "contradicted";
    case StepEnd::kUncertain: return "uncertain";
    case StepEnd::kTooFar: return "too_far";
  }
  return "unknown";
}

BackEnd::BackEnd(const BackEndParameters& parameters, RecognizeFunction recognize)
    : BackEnd(parameters, TargetMap(parameters.target_map), std::move(recognize)) {
  if (parameters.mode == Mode::kLocalization)
    throw std::invalid_argument("back_end.mode: localization needs a map; load one, or use loop_closure");
}

BackEnd::BackEnd(const BackEndParameters& parameters, TargetMap map, RecognizeFunction recognize)
    : parameters_(parameters), recognize_(std::move(recognize)), map_(std::move(map)) {
  const MatchingParameters& matching = parameters.matching;
  if (matching.nearest < 0) throw std::invalid_argument("back_end.matching.nearest: must not be negative");
  if (!(matching.max_distance >= 0.0)) throw std::invalid_argument("back_end.matching.max_distance: must not be negative");
  if (matching.nearest == 0 && matching.max_distance == 0.0)
    throw std::invalid_argument("back_end.matching: set nearest, max_distance or both; without either every segment matches all");
  if (!(matching.time_window_s >= 0.0)) throw std::invalid_argument("back_end.matching.time_window_s: must not be negative");
  if (!(matching.min_path_m >= 0.0)) throw std::invalid_argument("back_end.matching.min_path_m: must not be negative");
  if (!(matching.requery_distance >= 0.0))
    throw std::invalid_argument("back_end.matching.requery_distance: must not be negative");
  if (!(parameters.keyframes.reach_m > 0.0)) throw std::invalid_argument("back_end.keyframes.reach_m: must be positive");
  const HistoryParameters& history = parameters.history;
  if (!(history.length_m >= 0.0)) throw std::invalid_argument("back_end.history.length_m: must not be negative");
  if (!(history.spacing_m > 0.0)) throw std::invalid_argument("back_end.history.spacing_m: must be positive");
  if (!(history.max_distance_m > 0.0)) throw std::invalid_argument("back_end.history.max_distance_m: must be positive");
  if (!(history.drift >= 0.0)) throw std::invalid_argument("back_end.history.drift: must not be negative");
  Validate(parameters.free_space);
  Validate(parameters.refinement);
  Validate(parameters.acceptance);
  if (!(parameters.merging.distance_m >= 0.0)) throw std::invalid_argument("back_end.merging.distance_m: must not be negative");
  if (!(parameters.merging.descriptor_distance >= 0.0))
    throw std::invalid_argument("back_end.merging.descriptor_distance: must not be negative");
  const ForgettingParameters& forgetting = parameters.forgetting;
  if (forgetting.missed_visits < 0) throw std::invalid_argument("back_end.forgetting.missed_visits: must not be negative");
  if (forgetting.min_views < 0) throw std::invalid_argument("back_end.forgetting.min_views: must not be negative");
  if (!(parameters.keyframes.spacing_m > 0.0)) throw std::invalid_argument("back_end.keyframes.spacing_m: must be positive");
  if (!(parameters.keyframes.submap_radius_m >= 0.0))
    throw std::invalid_argument("back_end.keyframes.submap_radius_m: must not be negative");
  Recognizer{parameters.recognizer};  // refuses what it does not accept now, not at the first recognition
  for (RobotIndex robot = 0; robot < map_.robots(); ++robot) {
    robots_.emplace_back();
    robots_.back().name = map_.RobotName(robot);
  }
  loaded_robots_ = static_cast<RobotIndex>(robots_.size());
  for (const auto& [key, segment] : map_.segments()) {
    index_.Open(key, map_, segment.views.size(), true);
    if (const std::optional<KeyframeName> keyframe = SeenFrom(segment)) places_[*keyframe].segments.insert(key);
  }
}

BackEndStep BackEnd::Process(const SegmentDelta& delta) {
  const RobotIndex robot = RobotByName(delta.robot);
  if (!delta.full_state && delta.sequence != robots_[robot].sequence + 1) {
    BackEndStep missed;
    missed.missed_delta = true;
    return missed;
  }
  StageTimer timer;

  robots_[robot].T_odom_continuous = delta.T_odom_continuous;
  if (delta.T_odom_continuous.matrix() == Pose::Identity().matrix()) {
    ApplyDelta(delta, robot);
  } else {
    ApplyDelta(InContinuousFrame(delta), robot);
  }
  ReleaseTargets(delta.stamp_ns);
  EndVisits(robot);
  timer.Lap("target_update");
  return AttemptRecognition(robot, std::move(timer));
}

BackEndStep BackEnd::RecognizeAgain(const std::string& name) {
  for (RobotIndex robot = loaded_robots_; robot < robots_.size(); ++robot)
    if (robots_[robot].name == name && robots_[robot].started) return AttemptRecognition(robot, StageTimer());
  throw std::invalid_argument("no segments have come from robot " + name);
}

void BackEnd::ChangeParameters(const BackEndParameters& parameters) {
  if (parameters.mode != parameters_.mode) throw std::invalid_argument("back_end.mode: can't be changed while running");
  if (parameters.target_map.max_views != parameters_.target_map.max_views)
    throw std::invalid_argument("back_end.target_map.max_views: can't be changed while running");
  BackEnd(parameters, TargetMap(parameters.target_map));  // refuses what is out of range
  parameters_ = parameters;
  recognizers_.clear();
  submaps_.clear();
  for (Robot& robot : robots_)
    for (auto& [id, segment] : robot.local) segment.queried.resize(0);
}

/// Matches a robot's local segments and looks for the place. The step's times begin with what the timer holds.
BackEndStep BackEnd::AttemptRecognition(RobotIndex robot, StageTimer timer) {
  BackEndStep step;
  for (auto& [id, segment] : robots_[robot].local)
    if (MatchSegment(robot, &segment)) ++step.counts.requeried;
  const std::map<RobotIndex, Correspondences> by_frame = CollectCorrespondences(robot);
  timer.Lap("matching");

  const RecognizerResult result = Recognize(robot, by_frame);
  timer.Lap("recognition");

  step.counts.end = ToStepEnd(result.outcome);
  std::optional<Hypothesis> judged = Verify(robot, by_frame, result, &step);
  const bool is_recognized = step.counts.end == StepEnd::kRecognized;
  if (judged && HasRival(judged->closure.evidence, parameters_.acceptance) &&
      judged->closure.evidence.runner_up >= parameters_.acceptance.twin_size) {
    robots_[robot].twin_path_m = robots_[robot].path_m;
  }
  for (const Closure& closure : step.settled) AcceptClosure(robot, closure);
  if (is_recognized) AcceptClosure(robot, judged->closure);
  if (IsLoopClosure()) KeepKeyframe(robot, is_recognized ? &*judged : nullptr);
  if (judged) (is_recognized ? step.closure : step.refused) = std::move(judged->closure);
  KeepHistory(robot);
  timer.Lap("refinement");

  step.times = timer.Take();
  step.counts.local_segments = robots_[robot].local.size();
  step.counts.target_segments = map_.segments().size();
  step.counts.allowed_targets = index_.segments();
  step.counts.tested_pairs = result.tested_pairs;
  step.counts.edges = result.edges;
  step.counts.clique = result.clique_size;
  for (const auto& [frame, correspondences] : by_frame) {
    step.counts.candidates += correspondences.size();
    for (const Correspondence& c : correspondences)
      step.candidates.push_back({c.local, c.target, c.centroid_local, c.centroid_target, c.descriptor_distance});
  }
  if (robots_[robot].local.empty()) {
    step.counts.end = StepEnd::kNoSegments;
  } else if (index_.segments() == 0) {
    step.counts.end = StepEnd::kNoTargets;
  }
  TakeToJumpingFrame(robots_[robot].T_odom_continuous, &step);
  return step;
}

void BackEnd::CorrectTrajectory(const std::string& robot, const std::vector<StampedPose>& T_map_sensor) {
  if (!IsLoopClosure()) throw std::invalid_argument("the map is fixed in localization: its trajectories can't be corrected");
  const RobotIndex index = RobotByName(robot);
  robots_[index].is_corrected = true;
  map_.CorrectTrajectory(index, T_map_sensor);
  index_.RefreshCentroids(map_);
  MergeDuplicates();
}

/// The nearest ones first; a segment that was merged is gone, and what it was merged into has the views of both from then on.
void BackEnd::MergeDuplicates() {
  if (index_.segments() == 0) return;  // nothing tells the scale of descriptors yet
  struct View {
    double x;
    SegmentKey key;
    const SegmentView* view;
    Eigen::Vector3d centroid_map;
  };
  std::vector<View> views;
  for (const auto& [key, segment] : map_.segments()) {
    if (segment.tracked) continue;
    for (const SegmentView& view : segment.views) {
      const Eigen::Vector3d centroid_map = map_.CentroidMap(view);
      views.push_back({centroid_map.x(), key, &view, centroid_map});
    }
  }
  std::sort(views.begin(), views.end(), [](const View& a, const View& b) { return std::tie(a.x, a.key) < std::tie(b.x, b.key); });
  struct Pair {
    double distance_m;
    SegmentKey older, newer;
  };
  std::vector<Pair> pairs;
  const MergingParameters& limits = parameters_.merging;
  for (auto a = views.begin(); a != views.end(); ++a) {
    for (auto b = a + 1; b != views.end() && b->x - a->x < limits.distance_m; ++b) {
      const double distance_m = (a->centroid_map - b->centroid_map).norm();
      if (distance_m >= limits.distance_m || a->key == b->key) continue;
      if (robots_[a->key.robot].frame != robots_[b->key.robot].frame) continue;
      if (index_.Distance(a->view->descriptor, b->view->descriptor) > limits.descriptor_distance) continue;
      pairs.push_back({distance_m, std::min(a->key, b->key), std::max(a->key, b->key)});
    }
  }
  std::sort(pairs.begin(), pairs.end(), [](const Pair& a, const Pair& b) {
    return std::tie(a.distance_m, a.older, a.newer) < std::tie(b.distance_m, b.older, b.newer);
  });
  std::map<SegmentKey, SegmentKey> merged_into;
  for (const Pair& pair : pairs) {
    const TargetSegment* const older = map_.Find(pair.older);
    const TargetSegment* const newer = map_.Find(pair.newer);
    if (older == nullptr || newer == nullptr || !AreOfDifferentVisits(*older, *newer)) continue;
    index_.Close(pair.older);
    index_.Close(pair.newer);
    map_.MoveViews(pair.newer, pair.older);
    AwaitRelease(pair.older);
    merged_into[pair.newer] = pair.older;
  }
  for (Robot& robot : robots_) {
    for (auto& [id, segment] : robot.local) {
      if (!segment.same_as) continue;
      for (auto it = merged_into.find(*segment.same_as); it != merged_into.end(); it = merged_into.find(*segment.same_as))
        segment.same_as = it->second;
    }
  }
}

/// What a robot saw within the time window is a segment each.
bool BackEnd::AreOfDifferentVisits(const TargetSegment& a, const TargetSegment& b) const {
  const auto window_ns = static_cast<StampNs>(parameters_.matching.time_window_s * 1e9);
  for (const SegmentView& view_a : a.views)
    for (const SegmentView& view_b : b.views)
      if (view_a.robot == view_b.robot && std::abs(map_.PoseOf(view_a).stamp_ns - map_.PoseOf(view_b).stamp_ns) <= window_ns)
        return false;
  return true;
}

RobotIndex BackEnd::RobotByName(const std::string& name) {
  for (RobotIndex robot = loaded_robots_; robot < robots_.size(); ++robot)
    if (robots_[robot].name == name) return robot;
  const RobotIndex robot = static_cast<RobotIndex>(robots_.size());
  robots_.emplace_back();
  robots_.back().name = name;
  robots_.back().frame = robot;
  if (!IsLoopClosure()) return robot;

  // A robot of the loaded map may have had the same name: in the map, this run's robot gets one of its own.
  std::string name_in_map = name;
  while (map_.RobotByName(name_in_map) != robot) name_in_map += "'";
  // From the second robot on, what is being tracked is open to the others.
  for (const auto& [key, segment] : map_.segments())
    index_.Open(key, map_, segment.tracked ? 0 : CountReleased(segment), true);
  return robot;
}

void BackEnd::ApplyDelta(const SegmentDelta& delta, RobotIndex index) {
  Robot& robot = robots_[index];
  if (robot.started) robot.path_m += (delta.T_odom_sensor.translation() - robot.T_odom_sensor.translation()).norm();
  // No robot goes as far between two scans: it was carried, or its odometry started over.
  if ((delta.T_odom_sensor.translation() - robot.T_odom_sensor.translation()).norm() > parameters_.history.spacing_m)
    robot.history.clear();
  robot.started = true;
  robot.sequence = delta.sequence;
  robot.stamp_ns = delta.stamp_ns;
  robot.T_odom_sensor = delta.T_odom_sensor;
  robot.scan_sensor = delta.scan_sensor;
  if (IsLoopClosure()) {
    map_.AddPose(index, delta.stamp_ns, delta.T_odom_sensor);
  }
  if (delta.full_state) {
    std::vector<RetiredSegment> lost;
    for (const auto& [id, segment] : robot.local) {
      const auto named = [id = id](const SegmentState& state) { return state.id == id; };
      if (std::none_of(delta.changed.begin(), delta.changed.end(), named)) lost.push_back({id, RetirementCause::kLeft});
    }
    for (const RetiredSegment& retired : lost) RetireSegment(index, retired);
  }
  for (const RenamedSegment& renamed : delta.renamed) RenameSegment(index, renamed);
  for (const SegmentState& state : delta.changed) UpdateSegment(index, state, delta);
  for (const RetiredSegment& retired : delta.retired) RetireSegment(index, retired);
}

void BackEnd::RetireSegment(RobotIndex robot, const RetiredSegment& retired) {
  const auto found = robots_[robot].local.find(retired.id);
  if (found == robots_[robot].local.end()) return;
  const LocalSegment segment = std::move(found->second);
  robots_[robot].local.erase(found);
  if (!IsLoopClosure()) return;

  SegmentKey key{robot, retired.id};
  index_.Close(key);
  if (retired.cause == RetirementCause::kTooLarge || retired.cause == RetirementCause::kTrail) {
    map_.Erase(key);
    return;
  }
  if (segment.same_as && map_.Find(*segment.same_as) != nullptr) {
    // The same object, seen on another visit: one target segment with the views of both.
    index_.Close(*segment.same_as);
    map_.MoveViews(key, *segment.same_as);
    key = *segment.same_as;
  }
  TargetSegment* target = map_.Find(key);
  if (target == nullptr) return;
  target->tracked = false;
  target->last_seen_ns = std::max(target->last_seen_ns, segment.last_seen_ns);
  AwaitRelease(key);
}

void BackEnd::RenameSegment(RobotIndex robot, const RenamedSegment& renamed) {
  std::map<SegmentId, LocalSegment>& local = robots_[robot].local;
  const auto from = local.find(renamed.from);
  if (from == local.end()) return;
  LocalSegment absorbed = std::move(from->second);
  local.erase(from);
  const auto to = local.find(renamed.to);
  if (to != local.end() && !to->second.same_as) to->second.same_as = absorbed.same_as;
  if (!IsLoopClosure()) return;
  index_.Close({robot, renamed.from});
  map_.MoveViews({robot, renamed.from}, {robot, renamed.to});
}

void BackEnd::UpdateSegment(RobotIndex robot_index, const SegmentState& state, const SegmentDelta& delta) {
  Robot& robot = robots_[robot_index];
  LocalSegment& segment = robot.local[state.id];
  segment.centroid_odom = state.centroid_odom;
  segment.descriptor = state.descriptor;
  segment.last_seen_ns = delta.stamp_ns;
  if (!IsLoopClosure() || !state.new_view) return;
  const SegmentKey key{robot_index, state.id};
  SegmentView view;
  view.robot = robot_index;
  view.pose = static_cast<std::uint32_t>(map_.Trajectory(robot_index).size() - 1);
  view.size = state.size;
  view.centroid_sensor = delta.T_odom_sensor.inverse() * state.centroid_odom;
  view.descriptor = state.descriptor;
  view.points_centroid = state.points_centroid;
  map_.UpdateSegment(key, std::move(view), true, delta.stamp_ns);
  map_.Find(key)->tracked = true;
  if (robots_.size() > 1) {
    index_.Close(key);
    index_.Open(key, map_, 0, true);
  }
}

/// The views of a segment that is no longer tracked wait, each for itself, until they are old enough to be targets of their
/// own robot: what is seen until late may have been seen long ago as well.
void BackEnd::AwaitRelease(const SegmentKey& key) {
  const TargetSegment& target = *map_.Find(key);
  for (const SegmentView& view : target.views) waiting_.emplace(map_.PoseOf(view).stamp_ns, key);
  if (const std::optional<KeyframeName> keyframe = SeenFrom(target)) places_[*keyframe].segments.insert(key);
  if (robots_.size() > 1) index_.Open(key, map_, 0, true);
}

/// Opens views to their own robot once they were taken longer ago than the time window, in time and in path.
void BackEnd::ReleaseTargets(StampNs now_ns) {
  const StampNs window_ns = static_cast<StampNs>(parameters_.matching.time_window_s * 1e9);
  for (auto it = waiting_.begin(); it != waiting_.end() && now_ns - it->first > window_ns;) {
    const SegmentKey key = it->second;
    const TargetSegment* target = map_.Find(key);
    if (target != nullptr && !target->tracked) {
      const std::size_t released = CountReleased(*target);
      if (released < target->views.size() && map_.PoseOf(target->views[released]).stamp_ns <= it->first) {
        ++it;  // old in time, but not in path
        continue;
      }
      index_.Open(key, map_, released, robots_.size() > 1);
    }
    it = waiting_.erase(it);
  }
}

/// How many of a segment's views, the oldest ones, are old enough for the robots that took them; those of a loaded map are.
std::size_t BackEnd::CountReleased(const TargetSegment& target) const {
  const auto is_young = [&](const SegmentView& view) {
    return view.robot >= loaded_robots_ && IsYoung(view.robot, view.pose);
  };
  return static_cast<std::size_t>(std::find_if(target.views.begin(), target.views.end(), is_young) - target.views.begin());
}

bool BackEnd::NeedsQuery(RobotIndex robot, const LocalSegment& segment) const {
  if (segment.queried.size() == 0 || segment.queried_generation != index_.generation()) return true;
  if (index_.Distance(segment.descriptor, segment.queried) > parameters_.matching.requery_distance) return true;
  const auto closed = [&](const TargetCandidate& candidate) { return !index_.IsOpen(candidate.item, robot); };
  return std::any_of(segment.candidates.begin(), segment.candidates.end(), closed);
}

/// Candidates of a local segment: those of the last query and what was opened since, or a new query, which it returns, where the
/// segment changed.
bool BackEnd::MatchSegment(RobotIndex robot, LocalSegment* segment) const {
  const std::size_t nearest = static_cast<std::size_t>(parameters_.matching.nearest);
  const float max_distance = parameters_.matching.max_distance > 0.0 ? static_cast<float>(parameters_.matching.max_distance)
                                                                     : std::numeric_limits<float>::infinity();
  std::vector<TargetCandidate>& candidates = segment->candidates;
  if (index_.segments() == 0) {
    candidates.clear();
    return false;
  }
  const bool query = NeedsQuery(robot, *segment);
  if (query) {
    if (segment->queried_generation != index_.generation()) candidates.clear();
    candidates = index_.Nearest(segment->descriptor, robot, nearest, max_distance, candidates);
    segment->queried = segment->descriptor;
    segment->queried_generation = index_.generation();
  } else {
    for (std::uint64_t item = segment->next_item; item < index_.next_item(); ++item) {
      if (!index_.IsOpen(item, robot)) continue;
      const float distance = index_.Distance(segment->queried, index_.descriptor(item));
      if (distance <= max_distance) TakeIn({item, index_.view(item).segment, distance}, nearest, &candidates);
    }
  }
  segment->next_item = index_.next_item();
  return query;
}

std::map<RobotIndex, Correspondences> BackEnd::CollectCorrespondences(RobotIndex robot) const {
  std::map<RobotIndex, Correspondences> by_frame;
  for (const auto& [id, segment] : robots_[robot].local)
    for (const TargetCandidate& candidate : segment.candidates) {
      const IndexedView& view = index_.view(candidate.item);
      by_frame[robots_[view.segment.robot].frame].push_back(
          {{robot, id}, view.segment, segment.centroid_odom, index_.centroid_map(candidate.item), candidate.distance});
    }
  return by_frame;
}

/// Robots whose maps were not aligned yet have no common frame: each frame is a target map of its own.
RecognizerResult BackEnd::Recognize(RobotIndex robot, const std::map<RobotIndex, Correspondences>& by_frame) {
  RecognizerResult best;
  for (const auto& [frame, correspondences] : by_frame) {
    RecognizerResult result =
        recognize_ ? recognize_(correspondences)
                   : recognizers_.try_emplace({robot, frame}, parameters_.recognizer).first->second.Recognize(correspondences);
    const bool better = result.recognition.has_value() != best.recognition.has_value() ? result.recognition.has_value()
                                                                                       : result.clique_size > best.clique_size;
    if (better || frame == by_frame.begin()->first) best = std::move(result);
  }
  return best;
}

/// Whether a robot was at a pose of its trajectory too recently, in time or in path, for a closure.
bool BackEnd::IsYoung(RobotIndex robot, std::uint32_t pose) const {
  const double age_s = static_cast<double>(robots_[robot].stamp_ns - map_.Trajectory(robot)[pose].stamp_ns) / 1e9;
  return age_s <= parameters_.matching.time_window_s ||
         robots_[robot].path_m - map_.Trajectory(robot)[pose].path_m <= parameters_.matching.min_path_m;
}

/// Keeps this step's scan if the robot went far enough since the last key frame, or remembers that there is one already,
/// where it was recognised (otherwise null).
void BackEnd::KeepKeyframe(RobotIndex index, const Hypothesis* recognized) {
  Robot& robot = robots_[index];
  const double spacing_m = parameters_.keyframes.spacing_m;
  if (robot.path_m - robot.keyframe_path_m < spacing_m) return;
  if (recognized != nullptr && recognized->closure.T_target_query.translation().norm() < spacing_m) {
    CountVisit(index, recognized->target);
    map_.AddSighting(index, recognized->target);
  } else {
    map_.AddKeyframe(index, robot.scan_sensor);
  }
  robot.keyframe_path_m = robot.path_m;
}

/// The robot comes by a key frame again, and so by those around it along the trajectory. O(what was seen from there).
void BackEnd::CountVisit(RobotIndex robot, const KeyframeName& sighted) {
  const double path_m = PoseOf(sighted).path_m;
  VisitAlong(sighted, [&](std::uint32_t index) {
    const KeyframeName keyframe{sighted.robot, index};
    if (std::abs(PoseOf(keyframe).path_m - path_m) > parameters_.keyframes.submap_radius_m) return false;
    MissVisit(robot, keyframe);
    return true;
  });
}

/// If this is another visit than the last one: what was seen from a key frame has a chance to be seen again now, and has missed
/// the visit until it is, that is, recognised or found to lie there.
void BackEnd::MissVisit(RobotIndex robot, const KeyframeName& keyframe) {
  Place& place = places_[keyframe];
  const auto now = static_cast<std::uint32_t>(map_.Trajectory(robot).size() - 1);
  const auto [visit, is_first] = place.visits.try_emplace(robot, now);
  if (!is_first && IsYoung(robot, visit->second)) return;
  visit->second = now;
  robots_[robot].revisits.push_back({now, keyframe});
  for (const SegmentKey& key : SegmentsSeenFrom(keyframe)) {
    TargetSegment* const segment = map_.Find(key);
    if (!segment->tracked && !IsSeenOnThisVisit(robot, *segment)) ++segment->missed_visits;
  }
}

/// When a visit is over, that is, when what was seen on it is open to matching: what has missed enough visits in a row is gone,
/// and so is what it added to a known place without a second look.
void BackEnd::EndVisits(RobotIndex robot) {
  std::deque<Revisit>& revisits = robots_[robot].revisits;
  for (; !revisits.empty() && !IsYoung(robot, revisits.front().pose); revisits.pop_front()) {
    for (const SegmentKey& key : SegmentsSeenFrom(revisits.front().keyframe)) {
      const TargetSegment& segment = *map_.Find(key);
      if (!HasMissedEnough(segment) && !IsGlimpse(robot, revisits.front(), segment)) continue;
      index_.Close(key);
      map_.Erase(key);
    }
  }
}

bool BackEnd::HasMissedEnough(const TargetSegment& segment) const {
  const int limit = parameters_.forgetting.missed_visits;
  return limit > 0 && segment.missed_visits >= static_cast<std::uint32_t>(limit);
}

/// Whether a segment is known by a few looks on this visit alone.
bool BackEnd::IsGlimpse(RobotIndex robot, const Revisit& revisit, const TargetSegment& segment) const {
  const std::size_t enough = std::min(static_cast<std::size_t>(parameters_.forgetting.min_views), parameters_.target_map.max_views);
  return segment.views.size() < enough &&
         std::all_of(segment.views.begin(), segment.views.end(),
                     [&](const SegmentView& view) { return view.robot == robot && view.pose >= revisit.pose; });
}

/// Segments of the map whose nearest look was from a key frame. What went, or was seen from elsewhere since, is struck off the list.
std::vector<SegmentKey> BackEnd::SegmentsSeenFrom(const KeyframeName& keyframe) {
  std::set<SegmentKey>& seen = places_[keyframe].segments;
  for (auto it = seen.begin(); it != seen.end();) {
    const TargetSegment* const segment = map_.Find(*it);
    it = segment != nullptr && SeenFrom(*segment) == keyframe ? std::next(it) : seen.erase(it);
  }
  return {seen.begin(), seen.end()};
}

/// The key frame of the nearest look at a segment.
std::optional<KeyframeName> BackEnd::SeenFrom(const TargetSegment& segment) const {
  return map_.KeyframeOf(*std::min_element(segment.views.begin(), segment.views.end(), [](const SegmentView& a, const SegmentView& b) {
    return a.centroid_sensor.squaredNorm() < b.centroid_sensor.squaredNorm();
  }));
}

bool BackEnd::IsSeenOnThisVisit(RobotIndex robot, const TargetSegment& segment) const {
  return std::any_of(segment.views.begin(), segment.views.end(),
                     [&](const SegmentView& view) { return view.robot == robot && IsYoung(robot, view.pose); });
}

/// What was recognised is the same: remembered until the local segment's tracking ends.
void BackEnd::AcceptClosure(RobotIndex robot, const Closure& closure) {
  if (!IsLoopClosure()) return;
  for (const SegmentMatch& match : closure.matches) {
    const auto local = robots_[robot].local.find(match.local.id);
    if (local != robots_[robot].local.end()) local->second.same_as = match.target;
    if (TargetSegment* const target = map_.Find(match.target)) target->missed_visits = 0;
  }
  const RobotIndex target_robot = closure.matches.front().target.robot;
  if (robots_[robot].frame != robots_[target_robot].frame) JoinFrames(robot, target_robot, closure.T_map_odom);
  if (!robots_[robot].is_corrected) map_.Anchor(robot, closure.T_map_odom);
}

/// The first closure between robots of different frames aligns their maps: every robot of the query's frame moves.
void BackEnd::JoinFrames(RobotIndex robot, RobotIndex target_robot, const Pose& T_map_odom) {
  const Pose T_new_old = T_map_odom * map_.T_map_odom(robot).inverse();
  const RobotIndex old_frame = robots_[robot].frame;
  for (RobotIndex other = 0; other < robots_.size(); ++other) {
    if (robots_[other].frame != old_frame) continue;
    std::vector<StampedPose> moved;
    for (const TrajectoryPose& pose : map_.Trajectory(other)) moved.push_back({pose.stamp_ns, T_new_old * pose.T_map_sensor});
    map_.CorrectTrajectory(other, moved);
    robots_[other].frame = robots_[target_robot].frame;
  }
  index_.RefreshCentroids(map_);
}

std::size_t BackEnd::memory_bytes() const {
  std::size_t bytes = map_.memory_bytes();
  for (const Submap& submap : submaps_) bytes += submap.target.memory_bytes();
  for (const Robot& robot : robots_) {
    for (const PastScan& scan : robot.history) bytes += scan.image.memory_bytes();
    for (const Track& track : robot.tracks)
      for (const WaitingClosure& kept : track.waiting)
        bytes += sizeof(WaitingClosure) + kept.closure.matches.capacity() * sizeof(SegmentMatch);
  }
  return bytes;
}

}  // namespace incremental_segmatch
