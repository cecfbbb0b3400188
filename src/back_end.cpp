#include "incremental_segmatch/back_end.hpp"

#include <Eigen/Eigenvalues>
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

/// The points within the radius of the center, or within the first multiple by two of it that holds enough of them.
std::vector<Eigen::Vector3d> NearPoints(std::vector<Eigen::Vector3d> points, const Eigen::Vector3d& center,
                                        const NearPointsParameters& parameters) {
  for (double radius_m = parameters.radius_m;; radius_m *= 2.0) {
    const auto is_near = [&](const Eigen::Vector3d& p) { return (p - center).squaredNorm() <= radius_m * radius_m; };
    const std::size_t near = static_cast<std::size_t>(std::count_if(points.begin(), points.end(), is_near));
    if (near < std::min(parameters.min_points, points.size())) continue;
    points.erase(std::stable_partition(points.begin(), points.end(), is_near), points.end());
    return points;
  }
}

StepEnd ToStepEnd(Verdict verdict) {
  switch (verdict) {
    case Verdict::kAccepted: return StepEnd::kRecognized;
    case Verdict::kAmbiguous: return StepEnd::kAmbiguous;
    case Verdict::kUncovered: return StepEnd::kUncovered;
    case Verdict::kUncertain: return StepEnd::kUncertain;
    case Verdict::kTooFar: return StepEnd::kTooFar;
  }
  return StepEnd::kUncertain;
}

/// The part of a covariance of T_map_odom, perturbed on the left, that matters to the query sensor's pose in the target
/// sensor's frame, perturbed on the right: T_target_query exp(xi) with xi = Ad(T_map_query^-1) xi_map.
Covariance6 CovarianceAtQuery(const Covariance6& covariance_map, const Pose& T_map_query) {
  const Pose inverse = T_map_query.inverse();
  const Eigen::Matrix3d R = inverse.linear();
  const Eigen::Vector3d t = inverse.translation();
  Eigen::Matrix3d t_cross;
  t_cross << 0, -t.z(), t.y(), t.z(), 0, -t.x(), -t.y(), t.x(), 0;
  Covariance6 adjoint = Covariance6::Zero();
  adjoint.topLeftCorner<3, 3>() = R;
  adjoint.topRightCorner<3, 3>() = t_cross * R;
  adjoint.bottomRightCorner<3, 3>() = R;
  const Covariance6 covariance = adjoint * covariance_map * adjoint.transpose();
  return 0.5 * (covariance + covariance.transpose());
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
  Validate(parameters.refinement);
  Validate(parameters.acceptance);
  if (!(parameters.near_points.radius_m > 0.0)) throw std::invalid_argument("back_end.near_points.radius_m: must be positive");
  Recognizer{parameters.recognizer};  // refuses what it does not accept now, not at the first recognition
  for (RobotIndex robot = 0; robot < map_.robots(); ++robot) {
    robots_.emplace_back();
    robots_.back().name = map_.RobotName(robot);
  }
  loaded_robots_ = static_cast<RobotIndex>(robots_.size());
  for (const auto& [key, segment] : map_.segments()) index_.Add(key, map_, true);
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
    std::optional<Closure> judged = Verify(robot, robots_[robot].stamp_ns, result, &step.counts);
    if (step.counts.end == StepEnd::kRecognized) {
      step.closure = std::move(judged);
      AcceptClosure(robot, *step.closure);
    } else {
      step.refused = std::move(judged);
    }
  }
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
    if (!index_.Contains(key)) index_.Add(key, map_, false);
  return robot;
}

void BackEnd::ApplyDelta(const SegmentDelta& delta, RobotIndex index) {
  Robot& robot = robots_[index];
  if (robot.started) robot.path_m += (robot.T_odom_sensor.inverse() * delta.T_odom_sensor).translation().norm();
  robot.started = true;
  robot.sequence = delta.sequence;
  robot.stamp_ns = delta.stamp_ns;
  robot.T_odom_sensor = delta.T_odom_sensor;
  if (IsLoopClosure()) {
    const std::uint32_t pose = map_.AddPose(index, delta.stamp_ns, delta.T_odom_sensor);
    robot.path_at_pose_m.resize(pose + 1, robot.path_m);
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
  index_.Remove(key);
  if (retired.cause == RetirementCause::kTooLarge) {
    map_.Erase(key);
    return;
  }
  if (segment.same_as && map_.Find(*segment.same_as) != nullptr) {
    // The same object, seen on another visit: one target segment with the views of both.
    index_.Remove(*segment.same_as);
    map_.MoveViews(key, *segment.same_as);
    key = *segment.same_as;
  }
  TargetSegment* target = map_.Find(key);
  if (target == nullptr) return;
  target->tracked = false;
  target->last_seen_ns = std::max(target->last_seen_ns, segment.last_seen_ns);
  waiting_.emplace(target->last_seen_ns, Waiting{key, segment.last_seen_path_m});
  if (robots_.size() > 1) index_.Add(key, map_, false);
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
  index_.Remove({robot, renamed.from});
  map_.MoveViews({robot, renamed.from}, {robot, renamed.to});
}

void BackEnd::UpdateSegment(RobotIndex robot_index, const SegmentState& state, const SegmentDelta& delta) {
  Robot& robot = robots_[robot_index];
  LocalSegment& segment = robot.local[state.id];
  segment.centroid_odom = state.centroid_odom;
  segment.descriptor = state.descriptor;
  segment.last_seen_ns = delta.stamp_ns;
  segment.last_seen_path_m = robot.path_m;
  if (state.points_centroid) {
    segment.points_centroid = state.points_centroid;
    segment.points_origin_odom = state.centroid_odom;
  }
  if (!IsLoopClosure() || !state.new_view) return;
  const SegmentKey key{robot_index, state.id};
  SegmentView view;
  view.robot = robot_index;
  view.pose = static_cast<std::uint32_t>(robot.path_at_pose_m.size() - 1);
  view.size = state.size;
  view.centroid_sensor = delta.T_odom_sensor.inverse() * state.centroid_odom;
  view.descriptor = state.descriptor;
  view.points_centroid = state.points_centroid;
  map_.UpdateSegment(key, std::move(view), true, delta.stamp_ns);
  map_.Find(key)->tracked = true;
  if (robots_.size() > 1) index_.Add(key, map_, false);
}

/// Opens segments to their own robot once they were last seen longer ago than the time window, in time and in path.
void BackEnd::ReleaseTargets(StampNs now_ns) {
  const StampNs window_ns = static_cast<StampNs>(parameters_.matching.time_window_s * 1e9);
  for (auto it = waiting_.begin(); it != waiting_.end() && now_ns - it->first > window_ns;) {
    const auto& [last_seen_ns, waiting] = *it;
    const TargetSegment* target = map_.Find(waiting.segment);
    const bool current = target != nullptr && target->last_seen_ns == last_seen_ns;  // neither gone nor seen again since
    if (current) {
      const Robot& robot = robots_[target->views.back().robot];
      if (robot.path_m - waiting.last_seen_path_m <= parameters_.matching.min_path_m) {
        ++it;
        continue;
      }
      index_.Add(waiting.segment, map_, true);
    }
    it = waiting_.erase(it);
  }
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

/// Refines a recognition on points, gathers the evidence for it and judges that. `counts` gets the evidence and the end, which
/// says whether what comes back is accepted.
std::optional<Closure> BackEnd::Verify(RobotIndex robot, StampNs stamp_ns, const RecognizerResult& result,
                                           BackEndCounts* counts) const {
  Recognition recognition = *result.recognition;
  Evidence evidence;
  evidence.inliers = recognition.inliers.size();
  evidence.runner_up = recognition.runner_up_size;
  if (parameters_.refinement.enabled) {
    const std::optional<RefinedTransform> refined = Refine(robot, recognition);
    if (!refined) {
      counts->end = StepEnd::kNotRefined;
      return std::nullopt;
    }
    recognition.T_target_local = refined->T_target_local;
    recognition.covariance = refined->covariance;
    evidence.overlap = refined->overlap;
  }
  std::optional<Closure> closure = MakeClosure(robot, stamp_ns, recognition);
  if (!closure) {
    counts->end = StepEnd::kTooYoung;
    return std::nullopt;
  }
  MeasureCoverage(robot, recognition.T_target_local, &evidence);
  evidence.distance_m = closure->T_target_query.translation().norm();
  evidence.sigma_m = LargestSigma(closure->covariance.topLeftCorner<3, 3>());
  evidence.sigma_rad = LargestSigma(closure->covariance.bottomRightCorner<3, 3>());
  counts->evidence = evidence;
  counts->end = ToStepEnd(Judge(evidence, parameters_.acceptance));
  closure->candidates = result.candidates;
  closure->evidence = evidence;
  return closure;
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

std::optional<RefinedTransform> BackEnd::Refine(RobotIndex robot, const Recognition& recognition) const {
  std::vector<Eigen::Vector3d> points_local, points_target;
  for (const Correspondence& inlier : recognition.inliers) {
    const LocalSegment& segment = robots_[robot].local.at(inlier.local.id);
    const SegmentView& view = MatchedView(robot, inlier);
    if (!segment.points_centroid || !view.points_centroid) continue;
    for (const Eigen::Vector3f& p : *segment.points_centroid)
      points_local.push_back(segment.points_origin_odom + p.cast<double>());
    const TrajectoryPose& pose = map_.PoseOf(view);
    const Eigen::Vector3d centroid_map = map_.CentroidMap(view);
    const Eigen::Matrix3d R_map_odom = pose.T_map_sensor.linear() * pose.T_odom_sensor.linear().transpose();
    for (const Eigen::Vector3f& p : *view.points_centroid)
      points_target.push_back(centroid_map + R_map_odom * p.cast<double>());
  }
  return RefineOnPoints(NearPoints(std::move(points_local), robots_[robot].T_odom_sensor.translation(), parameters_.near_points),
                        points_target, recognition.T_target_local, parameters_.refinement);
}

/// The closure to the nearest of the poses that the matched views were seen from. None if all of them are too young.
std::optional<Closure> BackEnd::MakeClosure(RobotIndex robot, StampNs stamp_ns, const Recognition& recognition) const {
  const Pose T_map_query = recognition.T_target_local * robots_[robot].T_odom_sensor;
  const SegmentView* nearest = nullptr;
  double nearest_m = std::numeric_limits<double>::infinity();
  for (const Correspondence& inlier : recognition.inliers) {
    const SegmentView& view = MatchedView(robot, inlier);
    const TrajectoryPose& pose = map_.PoseOf(view);
    const bool own = view.robot == robot;
    if (own && (static_cast<double>(stamp_ns - pose.stamp_ns) <= parameters_.matching.time_window_s * 1e9 ||
                robots_[robot].path_m - robots_[robot].path_at_pose_m[view.pose] <= parameters_.matching.min_path_m))
      continue;
    const double distance_m = (pose.T_map_sensor.translation() - T_map_query.translation()).norm();
    if (distance_m < nearest_m) {
      nearest_m = distance_m;
      nearest = &view;
    }
  }
  if (nearest == nullptr) return std::nullopt;

  const TrajectoryPose& target = map_.PoseOf(*nearest);
  Closure closure;
  closure.stamp_query_ns = stamp_ns;
  closure.stamp_target_ns = target.stamp_ns;
  closure.robot_query = robots_[robot].name;
  closure.robot_target = map_.RobotName(nearest->robot);
  closure.T_target_query = target.T_map_sensor.inverse() * T_map_query;
  closure.covariance = CovarianceAtQuery(recognition.covariance, T_map_query);
  closure.inliers = recognition.inliers.size();
  closure.rms_m = recognition.rms_m;
  closure.T_map_odom = recognition.T_target_local;
  for (const Correspondence& c : recognition.inliers)
    closure.matches.push_back({c.local, c.target, c.centroid_local, c.centroid_target, c.descriptor_distance});
  return closure;
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

std::size_t BackEnd::memory_bytes() const { return map_.memory_bytes(); }

}  // namespace incremental_segmatch
