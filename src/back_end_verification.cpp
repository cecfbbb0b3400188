// Whether a robot is where its segments were recognised: laid on scans, held against the map and the way there.
// The rest of BackEnd is in back_end.cpp.

#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>
#include <utility>

#include "incremental_segmatch/back_end.hpp"
#include "incremental_segmatch/twist.hpp"

namespace incremental_segmatch {
namespace {

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

const SegmentView& BackEnd::MatchedView(RobotIndex robot, const Correspondence& inlier) const {
  for (const TargetCandidate& candidate : robots_[robot].local.at(inlier.local.id).candidates)
    if (candidate.segment == inlier.target) return map_.Find(inlier.target)->views[index_.view(candidate.item).view];
  throw std::logic_error("an inlier is none of the candidates");
}

/// Gathers the evidence for the best hypothesis and judges it. The step's counts get the evidence and the end, which says
/// whether what comes back is accepted; with it, what waited for that is settled.
std::optional<BackEnd::Hypothesis> BackEnd::Verify(RobotIndex robot, const std::map<RobotIndex, Correspondences>& by_frame,
                                                   const RecognizerResult& result, BackEndStep* step) {
  const AcceptanceParameters& limits = parameters_.acceptance;
  ForgetTracks(robot);
  std::optional<Hypothesis> best = BestHypothesis(robot, by_frame, result, &step->counts.end);
  if (!best) return std::nullopt;

  Closure& closure = best->closure;
  Evidence& evidence = closure.evidence;
  MeasureCoverage(robot, closure.T_map_odom, &evidence);
  MeasureContradiction(robot, best->target, closure, &evidence);
  evidence.distance_m = closure.T_target_query.translation().norm();
  evidence.sigma_m = LargestSigma(closure.covariance.topLeftCorner<3, 3>());
  evidence.sigma_rad = LargestSigma(closure.covariance.bottomRightCorner<3, 3>());
  closure.candidates = result.candidates;
  const bool is_deceptive = IsDeceptive(evidence, limits);
  Track* track = nullptr;
  if (is_deceptive && !best->fits.empty())
    track = &FollowTrack(robot, *best, evidence.overlap / ExpectedOverlap(best->target), &evidence);
  const Verdict verdict = Judge(evidence, limits);
  // What is accepted without twins can be relied on.
  if (!is_deceptive && verdict == Verdict::kAccepted) track = &FollowTrack(robot, *best, 1.0, &evidence);
  if (track != nullptr) SettleTrack(robot, closure, verdict, track, &step->settled);
  step->counts.evidence = evidence;
  step->counts.end = ToStepEnd(verdict);
  return best;
}

/// Lays a recognition on scans; where there is a rival, the rival as well; and where neither continues a proven track, what
/// does. None, and why, if nothing can be laid on scans.
std::optional<BackEnd::Hypothesis> BackEnd::BestHypothesis(RobotIndex robot,
                                                           const std::map<RobotIndex, Correspondences>& by_frame,
                                                           const RecognizerResult& result, StepEnd* end) {
  std::optional<Hypothesis> best;
  if (result.recognition) best = LayOnScans(robot, *result.recognition, end);
  if (result.runner_up && (!best || HasRival(best->closure.evidence, parameters_.acceptance))) {
    StepEnd end_of_rival;
    std::optional<Hypothesis> rival = LayOnScans(robot, *result.runner_up, &end_of_rival);
    if (rival && (!best || IsBetter(robot, *rival, *best))) std::swap(best, rival);
    if (best) best->closure.evidence.distinction = rival ? Distinction(*best, *rival) : 1.0;
  }
  if (!best || !IsOnProvenTrack(robot, *best)) {
    std::optional<Hypothesis> along = ContinueTrack(robot, by_frame, result.clique_size);
    if (along && (!best || IsBetter(robot, *along, *best))) {
      along->closure.evidence.distinction = best ? Distinction(*along, *best) : 1.0;
      best = std::move(along);
    }
  }
  return best;
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

/// The place where a proven track goes on, if enough matches agree there, be it fewer than elsewhere.
std::optional<BackEnd::Hypothesis> BackEnd::ContinueTrack(RobotIndex index, const std::map<RobotIndex, Correspondences>& by_frame,
                                                          std::size_t rival_size) {
  const Robot& robot = robots_[index];
  const auto track =
      std::find_if(robot.tracks.rbegin(), robot.tracks.rend(), [](const Track& track) { return track.is_proven; });
  if (track == robot.tracks.rend()) return std::nullopt;
  const auto matches = by_frame.find(robots_[track->target.robot].frame);
  if (matches == by_frame.end()) return std::nullopt;
  const Pose T_map_odom = PlaceNow(index, *track) * robot.T_odom_sensor.inverse();
  Correspondences there;
  for (const Correspondence& c : matches->second)
    if ((T_map_odom * c.centroid_local - c.centroid_target).norm() <= parameters_.recognizer.same_place_m) there.push_back(c);
  std::optional<Recognition> recognition = Recognizer(parameters_.recognizer).Recognize(there).recognition;
  if (!recognition) return std::nullopt;
  recognition->runner_up_size = rival_size;
  StepEnd end;
  std::optional<Hypothesis> hypothesis = LayOnScans(index, *recognition, &end);
  if (hypothesis && !IsOnProvenTrack(index, *hypothesis)) return std::nullopt;
  return hypothesis;
}

/// Where a track puts the sensor now, by odometry, in the map.
Pose BackEnd::PlaceNow(RobotIndex robot, const Track& track) const {
  return PoseOf(track.target).T_map_sensor * track.T_target_query * track.T_odom_sensor.inverse() * robots_[robot].T_odom_sensor;
}

/// Drops the tracks that nothing has continued for as long as a track must be.
void BackEnd::ForgetTracks(RobotIndex index) {
  Robot& robot = robots_[index];
  robot.tracks.erase(std::remove_if(robot.tracks.begin(), robot.tracks.end(),
                                    [&](const Track& track) {
                                      return robot.path_m - track.fits.back().path_m > parameters_.acceptance.min_track_m;
                                    }),
                     robot.tracks.end());
}

/// Of two hypotheses that which continues a proven track, unless scans speak for the other one; otherwise that which explains
/// more of the scan.
bool BackEnd::IsBetter(RobotIndex robot, const Hypothesis& first, const Hypothesis& second) const {
  const double distinction = Distinction(first, second);
  const bool first_on_track = IsOnProvenTrack(robot, first), second_on_track = IsOnProvenTrack(robot, second);
  if (first_on_track == second_on_track) return distinction > 0.5;
  return first_on_track ? distinction > 1.0 - parameters_.acceptance.min_distinction
                        : distinction >= parameters_.acceptance.min_distinction;
}

/// A recognition that is accepted proves its track: what was recognised along it before is settled with it. One that is
/// only ambiguous waits for that.
void BackEnd::SettleTrack(RobotIndex robot, const Closure& closure, Verdict verdict, Track* track,
                          std::vector<Closure>* settled) const {
  const double path_m = robots_[robot].path_m;
  std::deque<WaitingClosure>& waiting = track->waiting;
  constexpr std::size_t kMostWaiting = 1000;  // a robot that stands still goes no way
  while (!waiting.empty() &&
         (path_m - waiting.front().path_m > parameters_.history.length_m || waiting.size() >= kMostWaiting)) {
    waiting.pop_front();
  }
  if (!waiting.empty() && waiting.back().closure.stamp_query_ns == closure.stamp_query_ns) waiting.pop_back();  // tried again
  if (verdict == Verdict::kAccepted) {
    track->is_proven = true;
    for (WaitingClosure& kept : waiting) settled->push_back(std::move(kept.closure));
    waiting.clear();
  } else if (verdict == Verdict::kAmbiguous) {
    WaitingClosure kept{path_m, closure};
    kept.closure.evidence.on_proven_track = true;  // when it will be accepted
    if (Judge(kept.closure.evidence, parameters_.acceptance) == Verdict::kAccepted) waiting.push_back(std::move(kept));
  }
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

/// Of the tracks the one that a hypothesis continues, by odometry: the first. None: the end.
std::vector<BackEnd::Track>::const_iterator BackEnd::FindTrack(RobotIndex index, const Hypothesis& hypothesis) const {
  const std::vector<Track>& tracks = robots_[index].tracks;
  const Eigen::Vector3d place = (PoseOf(hypothesis.target).T_map_sensor * hypothesis.closure.T_target_query).translation();
  return std::find_if(tracks.begin(), tracks.end(), [&](const Track& track) {
    return (PlaceNow(index, track).translation() - place).norm() <= parameters_.recognizer.same_place_m;
  });
}

bool BackEnd::IsOnProvenTrack(RobotIndex robot, const Hypothesis& hypothesis) const {
  const auto track = FindTrack(robot, hypothesis);
  return track != robots_[robot].tracks.end() && track->is_proven;
}

/// Recognitions that agree by odometry make a track. Adds a hypothesis to the one that it continues, and says how long that is,
/// how well the scans have fitted along it, and whether it is proven.
BackEnd::Track& BackEnd::FollowTrack(RobotIndex index, const Hypothesis& hypothesis, double fit, Evidence* evidence) {
  Robot& robot = robots_[index];
  auto track = robot.tracks.begin() + (FindTrack(index, hypothesis) - robot.tracks.cbegin());
  if (track == robot.tracks.end()) track = robot.tracks.insert(track, Track{});
  track->target = hypothesis.target;
  track->T_target_query = hypothesis.closure.T_target_query;
  track->T_odom_sensor = robot.T_odom_sensor;
  if (!track->fits.empty() && robot.path_m - track->fits.back().path_m > parameters_.history.spacing_m)
    track->fits.clear();  // what lies between speaks for nothing
  track->fits.push_back({robot.path_m, std::min(1.0, fit)});
  // As long as need be, and no longer.
  while (track->fits.size() > 1 && robot.path_m - track->fits[1].path_m >= parameters_.acceptance.min_track_m)
    track->fits.pop_front();
  evidence->track_m = robot.path_m - track->fits.front().path_m;
  for (const Fit& link : track->fits) evidence->track_fit += link.value / static_cast<double>(track->fits.size());
  evidence->on_proven_track = track->is_proven;
  return *track;
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
  incremental_segmatch::MeasureCoverage(local, index_.CentroidsAround(place, reach_m, robot), parameters_.acceptance, evidence);
}

const TrajectoryPose& BackEnd::PoseOf(const KeyframeName& keyframe) const {
  return map_.Trajectory(keyframe.robot)[map_.Keyframes(keyframe.robot)[keyframe.index].pose];
}

/// Of the key frames along the passes on which the matched segments were seen, kept or recognised there, the one nearest to the
/// recognised place: other passes may lie where they don't belong, until a correction. None if all of them are too young.
std::optional<KeyframeName> BackEnd::NearestKeyframe(RobotIndex robot, const Recognition& recognition) const {
  std::map<RobotIndex, std::set<double>> seen_from_m;  // path of the poses, by robot
  for (const Correspondence& inlier : recognition.inliers) {
    const SegmentView& view = MatchedView(robot, inlier);
    seen_from_m[view.robot].insert(map_.PoseOf(view).path_m);
  }
  const Eigen::Vector3d place = recognition.T_target_local * robots_[robot].T_odom_sensor.translation();
  const double reach_m = parameters_.keyframes.reach_m;
  std::optional<KeyframeName> nearest;
  double nearest2 = std::numeric_limits<double>::infinity();
  for (const auto& [other, paths_m] : seen_from_m) {
    for (auto first = paths_m.begin(), next = first; first != paths_m.end(); first = next) {
      // Poses from which one pass saw the segments are at most so far apart that what is within reach of them is one stretch.
      double last_m = *first;
      while (++next != paths_m.end() && *next - last_m <= 2.0 * reach_m) last_m = *next;
      for (const KeyframeName& keyframe : map_.KeyframesAlong(other, *first - reach_m, last_m + reach_m)) {
        const double distance2 = (PoseOf(keyframe).T_map_sensor.translation() - place).squaredNorm();
        if (distance2 >= nearest2) continue;
        if (keyframe.robot == robot && IsYoung(robot, map_.Keyframes(robot)[keyframe.index].pose)) continue;
        nearest2 = distance2;
        nearest = keyframe;
      }
    }
  }
  return nearest;
}

/// Of the key frames of one pass, within so much of path around one of them, the nearest to a place, if it is near enough.
std::optional<KeyframeName> BackEnd::NearestKeyframeAlong(const KeyframeName& around, double along_m,
                                                                   const Eigen::Vector3d& place) const {
  const double path_m = PoseOf(around).path_m;
  std::optional<KeyframeName> nearest;
  double nearest2 = parameters_.history.max_distance_m * parameters_.history.max_distance_m;
  VisitAlong(around, [&](std::uint32_t index) {
    const TrajectoryPose& pose = PoseOf({around.robot, index});
    if (std::abs(pose.path_m - path_m) > along_m) return false;
    const double distance2 = (pose.T_map_sensor.translation() - place).squaredNorm();
    if (distance2 < nearest2) {
      nearest2 = distance2;
      nearest = KeyframeName{around.robot, index};
    }
    return true;
  });
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
  VisitAlong(center, [&](std::uint32_t index) {
    const Pose T_center_sensor = T_center_odom * PoseOf({center.robot, index}).T_odom_sensor;
    if (T_center_sensor.translation().norm() > parameters_.keyframes.submap_radius_m) return false;
    if (keyframes[index].scan_sensor && (with_center || index != center.index))
      for (const Eigen::Vector3f& p : *keyframes[index].scan_sensor) points.push_back(T_center_sensor * p.cast<double>());
    return true;
  });
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

}  // namespace incremental_segmatch
