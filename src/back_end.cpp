#include "incremental_segmatch/back_end.hpp"

#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>
#include <utility>

#include "incremental_segmatch/twist.hpp"

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

StepEnd ToStepEnd(Verdict verdict) {
  switch (verdict) {
    case Verdict::kAccepted: return StepEnd::kRecognized;
    case Verdict::kAmbiguous: return StepEnd::kAmbiguous;
    case Verdict::kUncovered: return StepEnd::kUncovered;
    case Verdict::kContradicted: return StepEnd::kContradicted;
    case Verdict::kUncertain: return StepEnd::kUncertain;
    case Verdict::kTooFar: return StepEnd::kTooFar;
  }
  return StepEnd::kUncertain;
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
  for (std::optional<Closure>* closure : {&step->closure, &step->refused}) {
    if (!*closure) continue;
    (*closure)->T_map_odom = (*closure)->T_map_odom * T_odom_continuous.inverse();
    for (SegmentMatch& match : (*closure)->matches)
      match.centroid_local_odom = T_odom_continuous * match.centroid_local_odom;
  }
}

std::vector<Eigen::Vector3d> ToDoubles(const Points& points) {
  std::vector<Eigen::Vector3d> doubles;
  doubles.reserve(points.size());
  for (const Eigen::Vector3f& p : points) doubles.push_back(p.cast<double>());
  return doubles;
}

double LargestSigma(const Eigen::Matrix3d& covariance) {
  return std::sqrt(std::max(0.0, Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d>(covariance, Eigen::EigenvaluesOnly).eigenvalues()[2]));
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
  if (!(parameters.keyframes.spacing_m > 0.0)) throw std::invalid_argument("back_end.keyframes.spacing_m: must be positive");
  if (!(parameters.keyframes.submap_radius_m >= 0.0))
    throw std::invalid_argument("back_end.keyframes.submap_radius_m: must not be negative");
  Recognizer{parameters.recognizer};  // refuses what it does not accept now, not at the first recognition
  for (RobotIndex robot = 0; robot < map_.robots(); ++robot) {
    robots_.emplace_back();
    robots_.back().name = map_.RobotName(robot);
  }
  loaded_robots_ = static_cast<RobotIndex>(robots_.size());
  for (const auto& [key, segment] : map_.segments()) index_.Open(key, map_, segment.views.size(), true);
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
  if (result.recognition) {
    std::optional<Closure> judged = Verify(robot, result, &step.counts);
    if (judged && HasRival(judged->evidence, parameters_.acceptance) &&
        judged->evidence.runner_up >= parameters_.acceptance.twin_size) {
      robots_[robot].twin_path_m = robots_[robot].path_m;
    }
    if (step.counts.end == StepEnd::kRecognized) {
      step.closure = std::move(judged);
      AcceptClosure(robot, *step.closure);
    } else {
      step.refused = std::move(judged);
    }
  }
  if (IsLoopClosure()) KeepKeyframe(robot, step.closure);
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
  map_.CorrectTrajectory(RobotByName(robot), T_map_sensor);
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
    candidates = index_.Nearest(segment->descriptor, robot, nearest, max_distance);
    segment->queried = segment->descriptor;
    segment->queried_generation = index_.generation();
  } else {
    for (std::uint64_t item = segment->next_item; item < index_.next_item(); ++item) {
      if (!index_.IsOpen(item, robot)) continue;
      const TargetCandidate added{item, index_.view(item).segment, index_.Distance(segment->queried, index_.view(item).descriptor)};
      if (added.distance > max_distance) continue;
      const auto same = std::find_if(candidates.begin(), candidates.end(),
                                     [&](const TargetCandidate& c) { return c.segment == added.segment; });
      if (same != candidates.end()) {
        if (same->distance <= added.distance) continue;
        candidates.erase(same);
      }
      candidates.insert(std::upper_bound(candidates.begin(), candidates.end(), added,
                                         [](const TargetCandidate& a, const TargetCandidate& b) {
                                           return std::tie(a.distance, a.segment) < std::tie(b.distance, b.segment);
                                         }),
                        added);
      if (nearest != 0 && candidates.size() > nearest) candidates.pop_back();
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
          {{robot, id}, view.segment, segment.centroid_odom, view.centroid_map, candidate.distance});
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

const SegmentView& BackEnd::MatchedView(RobotIndex robot, const Correspondence& inlier) const {
  for (const TargetCandidate& candidate : robots_[robot].local.at(inlier.local.id).candidates)
    if (candidate.segment == inlier.target) return map_.Find(inlier.target)->views[index_.view(candidate.item).view];
  throw std::logic_error("an inlier is none of the candidates");
}

/// Lays a recognition on scans, and where there is a rival, the rival as well: what fits better is the recognition. Gathers the
/// evidence for it and judges that. `counts` gets the evidence and the end, which says whether what comes back is accepted.
std::optional<Closure> BackEnd::Verify(RobotIndex robot, const RecognizerResult& result, BackEndCounts* counts) {
  std::optional<Hypothesis> best = LayOnScans(robot, *result.recognition, &counts->end);
  if (result.runner_up && (!best || HasRival(best->closure.evidence, parameters_.acceptance))) {
    StepEnd end;
    std::optional<Hypothesis> rival = LayOnScans(robot, *result.runner_up, &end);
    if (rival && (!best || Distinction(*rival, *best) > 0.5)) std::swap(best, rival);
    if (best) best->closure.evidence.distinction = rival ? Distinction(*best, *rival) : 1.0;
  }
  if (!best) return std::nullopt;

  robots_[robot].target = best->target;
  Closure& closure = best->closure;
  Evidence& evidence = closure.evidence;
  MeasureCoverage(robot, closure.T_map_odom, &evidence);
  MeasureContradiction(robot, best->target, closure, &evidence);
  evidence.distance_m = closure.T_target_query.translation().norm();
  evidence.sigma_m = LargestSigma(closure.covariance.topLeftCorner<3, 3>());
  evidence.sigma_rad = LargestSigma(closure.covariance.bottomRightCorner<3, 3>());
  const bool is_deceptive = IsDeceptive(evidence, parameters_.acceptance);
  if (is_deceptive && !best->fits.empty())
    FollowTrack(robot, *best, evidence.overlap / ExpectedOverlap(best->target), &evidence);
  const Verdict verdict = Judge(evidence, parameters_.acceptance);
  // What is accepted without twins can be relied on.
  if (!is_deceptive && verdict == Verdict::kAccepted) FollowTrack(robot, *best, 1.0, &evidence);
  counts->evidence = evidence;
  counts->end = ToStepEnd(verdict);
  closure.candidates = result.candidates;
  return std::move(closure);
}

/// A recognition as a closure to the key frame there, refined on scans. Nothing, and why, if that can't be.
std::optional<BackEnd::Hypothesis> BackEnd::LayOnScans(RobotIndex robot, const Recognition& recognition, StepEnd* end) {
  const std::optional<KeyframeName> target = NearestKeyframe(robot, recognition);
  if (!target) {
    *end = StepEnd::kTooYoung;
    return std::nullopt;
  }
  Hypothesis hypothesis{*target, MakeClosure(robot, robots_[robot].stamp_ns, recognition, *target), {}};
  Evidence& evidence = hypothesis.closure.evidence;
  evidence.inliers = recognition.inliers.size();
  evidence.runner_up = recognition.runner_up_size;
  evidence.since_twin_m = robots_[robot].path_m - robots_[robot].twin_path_m;
  const bool is_near = hypothesis.closure.T_target_query.translation().norm() <= parameters_.acceptance.max_distance_m;
  if (parameters_.refinement.enabled && is_near && !Refine(robot, &hypothesis)) {
    *end = StepEnd::kNotRefined;
    return std::nullopt;
  }
  return hypothesis;
}

/// Of the scan's points that lie on something at only one of two places the share that does so at the first. One half where
/// nothing tells the places apart, or one of them was not laid on scans.
double BackEnd::Distinction(const Hypothesis& first, const Hypothesis& second) {
  std::size_t only_first = 0, only_second = 0;
  for (std::size_t i = 0; i < std::min(first.fits.size(), second.fits.size()); ++i) {
    only_first += first.fits[i] && !second.fits[i];
    only_second += second.fits[i] && !first.fits[i];
  }
  const std::size_t all = only_first + only_second;
  return all == 0 ? 0.5 : static_cast<double>(only_first) / static_cast<double>(all);
}

/// Recognitions that agree by odometry make a track. Adds a hypothesis to the one that it continues, and says how long that is,
/// and how well the scans have fitted along it.
void BackEnd::FollowTrack(RobotIndex index, const Hypothesis& hypothesis, double fit, Evidence* evidence) {
  Robot& robot = robots_[index];
  const auto position = [&](const KeyframeName& target, const Pose& T_target_sensor) {
    return Eigen::Vector3d((PoseOf(target).T_map_sensor * T_target_sensor).translation());
  };
  const auto is_over = [&](const Track& track) {
    return robot.path_m - track.fits.back().path_m > parameters_.history.spacing_m;
  };
  robot.tracks.erase(std::remove_if(robot.tracks.begin(), robot.tracks.end(), is_over), robot.tracks.end());
  const Eigen::Vector3d place = position(hypothesis.target, hypothesis.closure.T_target_query);
  const auto continues = [&](const Track& track) {
    const Pose T_target_now = track.T_target_query * track.T_odom_sensor.inverse() * robot.T_odom_sensor;
    return (position(track.target, T_target_now) - place).norm() <= parameters_.recognizer.same_place_m;
  };
  auto track = std::find_if(robot.tracks.begin(), robot.tracks.end(), continues);
  if (track == robot.tracks.end()) track = robot.tracks.insert(track, Track{});
  track->target = hypothesis.target;
  track->T_target_query = hypothesis.closure.T_target_query;
  track->T_odom_sensor = robot.T_odom_sensor;
  track->fits.push_back({robot.path_m, std::min(1.0, fit)});
  // As long as need be, and no longer.
  while (track->fits.size() > 1 && robot.path_m - track->fits[1].path_m >= parameters_.acceptance.min_track_m)
    track->fits.pop_front();
  evidence->track_m = robot.path_m - track->fits.front().path_m;
  for (const Fit& link : track->fits) evidence->track_fit += link.value / static_cast<double>(track->fits.size());
}

/// How much of a key frame's scan lies on those of its neighbours along the trajectory: what can be expected of a scan that is
/// laid on them.
double BackEnd::ExpectedOverlap(const KeyframeName& keyframe) {
  Submap& submap = SubmapAround(keyframe);
  if (submap.expected_overlap == 0.0) {
    const std::shared_ptr<const Points>& scan = map_.Keyframes(submap.center.robot)[submap.center.index].scan_sensor;
    const RefinementTarget others(JoinScans(submap.center, false), parameters_.refinement);
    if (scan) submap.expected_overlap = others.Overlap(ToDoubles(*scan), Pose::Identity());
    if (!(submap.expected_overlap > 0.0)) submap.expected_overlap = 1.0;  // a scan that is alone
  }
  return submap.expected_overlap;
}

/// Holds all local segments, not the inliers alone, against the map around the recognised place.
void BackEnd::MeasureCoverage(RobotIndex robot, const Pose& T_map_odom, Evidence* evidence) const {
  std::vector<Eigen::Vector3d> local;
  double reach_m = 0.0;
  const Eigen::Vector3d place = T_map_odom * robots_[robot].T_odom_sensor.translation();
  for (const auto& [id, segment] : robots_[robot].local) {
    local.push_back(T_map_odom * segment.centroid_odom);
    reach_m = std::max(reach_m, (local.back() - place).norm());
  }
  reach_m += parameters_.acceptance.neighbourhood_m;
  std::vector<Eigen::Vector3d> target;
  for (std::uint64_t item = 0; item < index_.next_item(); ++item)
    if (index_.IsOpen(item, robot) && (index_.view(item).centroid_map - place).squaredNorm() <= reach_m * reach_m)
      target.push_back(index_.view(item).centroid_map);
  incremental_segmatch::MeasureCoverage(local, target, parameters_.acceptance, evidence);
}

const TrajectoryPose& BackEnd::PoseOf(const KeyframeName& keyframe) const {
  return map_.Trajectory(keyframe.robot)[map_.Keyframes(keyframe.robot)[keyframe.index].pose];
}

/// Of the key frames along the passes on which the matched segments were seen, kept or recognised there, the one nearest to the
/// recognised place: other passes may lie where they don't belong, until a correction. None if all of them are too young.
std::optional<BackEnd::KeyframeName> BackEnd::NearestKeyframe(RobotIndex robot, const Recognition& recognition) const {
  std::map<RobotIndex, std::vector<double>> seen_from_m;  // path of the poses, by robot
  for (const Correspondence& inlier : recognition.inliers) {
    const SegmentView& view = MatchedView(robot, inlier);
    seen_from_m[view.robot].push_back(map_.PoseOf(view).path_m);
  }
  const Eigen::Vector3d place = recognition.T_target_local * robots_[robot].T_odom_sensor.translation();
  std::optional<KeyframeName> nearest;
  double nearest2 = std::numeric_limits<double>::infinity();
  for (auto& [other, paths_m] : seen_from_m) {
    std::sort(paths_m.begin(), paths_m.end());
    const auto consider = [&, &paths_m = paths_m](const KeyframeName& keyframe, double path_m) {
      const double distance2 = (PoseOf(keyframe).T_map_sensor.translation() - place).squaredNorm();
      if (distance2 >= nearest2) return;
      const auto next = std::lower_bound(paths_m.begin(), paths_m.end(), path_m - parameters_.keyframes.reach_m);
      if (next == paths_m.end() || *next > path_m + parameters_.keyframes.reach_m) return;
      if (keyframe.robot == robot && IsYoung(robot, map_.Keyframes(robot)[keyframe.index].pose)) return;
      nearest2 = distance2;
      nearest = keyframe;
    };
    for (std::size_t i = 0; i < map_.Keyframes(other).size(); ++i) consider({other, i}, PoseOf({other, i}).path_m);
    for (const Sighting& sighting : robots_[other].sightings) consider(sighting.keyframe, sighting.path_m);
  }
  return nearest;
}

/// Of the key frames of one pass, within so much of path around one of them, the nearest to a place, if it is near enough.
std::optional<BackEnd::KeyframeName> BackEnd::NearestKeyframeAlong(const KeyframeName& around, double along_m,
                                                                   const Eigen::Vector3d& place) const {
  const double path_m = PoseOf(around).path_m;
  std::optional<KeyframeName> nearest;
  double nearest2 = parameters_.history.max_distance_m * parameters_.history.max_distance_m;
  const auto consider = [&](std::size_t index) {
    const TrajectoryPose& pose = PoseOf({around.robot, index});
    if (std::abs(pose.path_m - path_m) > along_m) return false;
    const double distance2 = (pose.T_map_sensor.translation() - place).squaredNorm();
    if (distance2 < nearest2) {
      nearest2 = distance2;
      nearest = KeyframeName{around.robot, index};
    }
    return true;
  };
  for (std::size_t i = around.index; i < map_.Keyframes(around.robot).size() && consider(i); ++i) {
  }
  for (std::size_t i = around.index; i > 0 && consider(i - 1); --i) {
  }
  return nearest;
}

/// Holds the key frames around the place, and along the way to it, against what the robot's scans saw there.
void BackEnd::MeasureContradiction(RobotIndex index, const KeyframeName& target, const Closure& closure,
                                   Evidence* evidence) const {
  constexpr std::size_t kMinJudged = 50;  // points, for a share to mean something
  const Robot& robot = robots_[index];
  const Points* scan_target = map_.Keyframes(target.robot)[target.index].scan_sensor.get();
  if (!robot.scan_sensor || scan_target == nullptr) return;
  FreeSpaceCounts all;
  const auto compare = [&](const RangeImage& image, const Points& points, const Pose& T_image_points, double slack_m) {
    const FreeSpaceCounts counts = image.Compare(points, T_image_points, slack_m, parameters_.free_space);
    all += counts;
    if (counts.confirmed + counts.seen_through >= kMinJudged)
      evidence->contradiction_once = std::max(evidence->contradiction_once, counts.Contradiction());
  };
  compare(RangeImage(*robot.scan_sensor), *scan_target, closure.T_target_query.inverse(), 0.0);
  for (const PastScan& past : robot.history) {
    const double back_m = robot.path_m - past.path_m;
    const Pose T_map_past = closure.T_map_odom * past.T_odom_sensor;
    const std::optional<KeyframeName> there =
        NearestKeyframeAlong(target, back_m + parameters_.keyframes.reach_m, T_map_past.translation());
    if (!there) continue;
    // The same pass again would only tell its own drift.
    if (there->robot == index && past.path_m - PoseOf(*there).path_m <= parameters_.matching.min_path_m) continue;
    const Points* scan_there = map_.Keyframes(there->robot)[there->index].scan_sensor.get();
    if (scan_there == nullptr) continue;
    // Both visits have drifted on the way between there and here.
    compare(past.image, *scan_there, T_map_past.inverse() * PoseOf(*there).T_map_sensor,
            2.0 * parameters_.history.drift * back_m);
  }
  evidence->contradiction = all.confirmed + all.seen_through >= kMinJudged ? all.Contradiction() : 0.0;
}

/// Keeps this step's scan for the history if the robot went far enough, and forgets what is too far back.
void BackEnd::KeepHistory(RobotIndex index) {
  Robot& robot = robots_[index];
  while (!robot.history.empty() && robot.path_m - robot.history.front().path_m > parameters_.history.length_m)
    robot.history.pop_front();
  if (!robot.scan_sensor) return;
  if (!robot.history.empty() && robot.path_m - robot.history.back().path_m < parameters_.history.spacing_m) return;
  robot.history.push_back({robot.T_odom_sensor, robot.path_m, RangeImage(*robot.scan_sensor)});
}

/// Whether a robot was at a pose of its trajectory too recently, in time or in path, for a closure.
bool BackEnd::IsYoung(RobotIndex robot, std::uint32_t pose) const {
  const double age_s = static_cast<double>(robots_[robot].stamp_ns - map_.Trajectory(robot)[pose].stamp_ns) / 1e9;
  return age_s <= parameters_.matching.time_window_s ||
         robots_[robot].path_m - map_.Trajectory(robot)[pose].path_m <= parameters_.matching.min_path_m;
}

/// The scan that made the recognition is laid on those around the key frame: neither has drifted, as the local map and the
/// segments that were gathered along the way have. False if it doesn't fit.
bool BackEnd::Refine(RobotIndex index, Hypothesis* hypothesis) {
  const Robot& robot = robots_[index];
  const KeyframeName& target = hypothesis->target;
  Closure* const closure = &hypothesis->closure;
  if (!robot.scan_sensor) return false;
  Submap& submap = SubmapAround(target);
  const Pose T_center_target = PoseOf(submap.center).T_odom_sensor.inverse() * PoseOf(target).T_odom_sensor;
  const std::optional<RefinedTransform> refined =
      submap.target.Refine(ToDoubles(*robot.scan_sensor), T_center_target * closure->T_target_query);
  if (!refined) return false;
  const Pose T_target_query = T_center_target.inverse() * refined->T_target_local;
  closure->T_map_odom = closure->T_map_odom * robot.T_odom_sensor * closure->T_target_query.inverse() * T_target_query *
                        robot.T_odom_sensor.inverse();
  closure->T_target_query = T_target_query;
  closure->covariance = MoveToTheRight(refined->covariance, refined->T_target_local);
  closure->evidence.overlap = refined->overlap;
  hypothesis->fits = refined->has_partner;
  return true;
}

/// Of the last submaps one whose center is near, or a new one around the key frame.
BackEnd::Submap& BackEnd::SubmapAround(const KeyframeName& keyframe) {
  constexpr std::size_t kKept = 4;  // passes of one street take turns, and rivals
  const auto is_near = [&](const Submap& submap) {
    return submap.center.robot == keyframe.robot &&
           std::abs(PoseOf(submap.center).path_m - PoseOf(keyframe).path_m) <= 0.5 * parameters_.keyframes.submap_radius_m;
  };
  const auto found = std::find_if(submaps_.begin(), submaps_.end(), is_near);
  if (found != submaps_.end()) {
    std::rotate(submaps_.begin(), found, found + 1);
  } else {
    submaps_.push_front({keyframe, RefinementTarget(JoinScans(keyframe, true), parameters_.refinement)});
    if (submaps_.size() > kKept) submaps_.pop_back();
  }
  return submaps_.front();
}

/// Scans of a key frame, or not, and of its neighbours along the trajectory, in its sensor's frame. Odometry joins them.
std::vector<Eigen::Vector3d> BackEnd::JoinScans(const KeyframeName& center, bool with_center) const {
  const std::vector<Keyframe>& keyframes = map_.Keyframes(center.robot);
  const Pose T_center_odom = PoseOf(center).T_odom_sensor.inverse();
  std::vector<Eigen::Vector3d> points;
  const auto add = [&](std::size_t index) {
    const Pose T_center_sensor = T_center_odom * PoseOf({center.robot, index}).T_odom_sensor;
    if (T_center_sensor.translation().norm() > parameters_.keyframes.submap_radius_m) return false;
    if (keyframes[index].scan_sensor && (with_center || index != center.index))
      for (const Eigen::Vector3f& p : *keyframes[index].scan_sensor) points.push_back(T_center_sensor * p.cast<double>());
    return true;
  };
  for (std::size_t i = center.index; i < keyframes.size() && add(i); ++i) {
  }
  for (std::size_t i = center.index; i > 0 && add(i - 1); --i) {
  }
  return points;
}

/// The closure between the query's sensor and a key frame's, as the segments' centroids have it.
Closure BackEnd::MakeClosure(RobotIndex robot, StampNs stamp_ns, const Recognition& recognition,
                             const KeyframeName& keyframe) const {
  const TrajectoryPose& target = PoseOf(keyframe);
  const Pose T_map_query = recognition.T_target_local * robots_[robot].T_odom_sensor;
  Closure closure;
  closure.stamp_query_ns = stamp_ns;
  closure.stamp_target_ns = target.stamp_ns;
  closure.robot_query = robots_[robot].name;
  closure.robot_target = map_.RobotName(keyframe.robot);
  closure.T_target_query = target.T_map_sensor.inverse() * T_map_query;
  closure.covariance = MoveToTheRight(recognition.covariance, T_map_query);
  closure.inliers = recognition.inliers.size();
  closure.rms_m = recognition.rms_m;
  closure.T_map_odom = recognition.T_target_local;
  for (const Correspondence& c : recognition.inliers)
    closure.matches.push_back({c.local, c.target, c.centroid_local, c.centroid_target, c.descriptor_distance});
  return closure;
}

/// Keeps this step's scan if the robot went far enough since the last key frame, or remembers that there is one already.
void BackEnd::KeepKeyframe(RobotIndex index, const std::optional<Closure>& closure) {
  Robot& robot = robots_[index];
  const double spacing_m = parameters_.keyframes.spacing_m;
  if (robot.path_m - robot.keyframe_path_m < spacing_m) return;
  if (closure && closure->T_target_query.translation().norm() < spacing_m) {
    robot.sightings.push_back({robot.path_m, robot.target});
  } else {
    map_.AddKeyframe(index, robot.scan_sensor);
  }
  robot.keyframe_path_m = robot.path_m;
}

/// What was recognised is the same: remembered until the local segment's tracking ends.
void BackEnd::AcceptClosure(RobotIndex robot, const Closure& closure) {
  if (!IsLoopClosure()) return;
  for (const SegmentMatch& match : closure.matches) robots_[robot].local.at(match.local.id).same_as = match.target;
  const RobotIndex target_robot = closure.matches.front().target.robot;
  if (robots_[robot].frame != robots_[target_robot].frame) JoinFrames(robot, target_robot, closure.T_map_odom);
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
  for (const Robot& robot : robots_)
    for (const PastScan& scan : robot.history) bytes += scan.image.memory_bytes();
  return bytes;
}

}  // namespace incremental_segmatch
