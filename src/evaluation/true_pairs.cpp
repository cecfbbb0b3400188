#include "evaluation/true_pairs.hpp"

#include <algorithm>
#include <limits>
#include <set>
#include <utility>

namespace incremental_segmatch {
namespace {

std::size_t IndexOf(const TrueTrajectory& truth, StampNs stamp_ns) {
  const auto it = std::lower_bound(truth.stamps_ns.begin(), truth.stamps_ns.end(), stamp_ns);
  if (it == truth.stamps_ns.end() || *it != stamp_ns) return truth.stamps_ns.size();
  return static_cast<std::size_t>(it - truth.stamps_ns.begin());
}

// A view where the truth has it.
struct PlacedView {
  SegmentKey segment;
  std::uint32_t size = 0;
  Eigen::Vector3d centroid_world;
};

struct Ranked {
  std::size_t rank;  // from 1
  double distance;   // scaled
};

// Of a segment among all that are open to the robot, in the order of TargetIndex::Nearest; nothing if it is not open.
// All views are gone through: sorting them all for each query would be the larger part of a run.
std::optional<Ranked> RankOf(const SegmentKey& segment, const Descriptor& query, RobotIndex robot,
                             const TargetIndex& index) {
  std::vector<std::pair<float, SegmentKey>> views;
  float own = std::numeric_limits<float>::infinity();
  for (std::uint64_t item = 0; item < index.next_item(); ++item) {
    if (!index.IsOpen(item, robot)) continue;
    views.emplace_back(index.Distance(query, index.descriptor(item)), index.view(item).segment);
    if (views.back().second == segment) own = std::min(own, views.back().first);
  }
  if (own == std::numeric_limits<float>::infinity()) return std::nullopt;
  std::set<SegmentKey> before;
  for (const auto& view : views) {
    if (view < std::make_pair(own, segment)) before.insert(view.second);
  }
  return Ranked{before.size() + 1, own};
}

}  // namespace

TruePairFinder::TruePairFinder(const TrueTrajectory& truth, const TrueTrajectory* map_truth,
                               const ScoringParameters& scoring, double max_difference_m)
    : truth_(truth),
      target_truth_(map_truth != nullptr ? *map_truth : truth),
      is_localization_(map_truth != nullptr),
      scoring_(scoring),
      max_difference_m_(max_difference_m),
      revisit_targets_((map_truth != nullptr ? ScoreLocalizations(truth, *map_truth, {}, scoring)
                                             : ScoreClosures(truth, {}, scoring))
                           .revisit_targets),
      path_m_(PathLengths(truth.T_world_sensor)) {}

void TruePairFinder::Apply(std::size_t step, const SegmentDelta& delta) {
  if (delta.full_state) local_.clear();
  for (const RenamedSegment& renamed : delta.renamed) local_.erase(renamed.from);
  const Pose T_world_odom = truth_.T_world_sensor[step] * delta.T_odom_sensor.inverse();
  for (const SegmentState& state : delta.changed)
    local_[state.id] = {step, T_world_odom * state.centroid_odom, state.size, state.descriptor};
  for (const RetiredSegment& retired : delta.retired) local_.erase(retired.id);
}

std::vector<TruePair> TruePairFinder::Step(std::size_t step, const SegmentDelta& delta, const BackEndStep& recognized,
                                           const BackEnd& back_end) {
  Apply(step, delta);
  std::vector<TruePair> pairs;
  if (!revisit_targets_[step]) return pairs;

  double reach_m = 0.0;
  const Eigen::Vector3d place = truth_.T_world_sensor[step].translation();
  for (const auto& [id, local] : local_) reach_m = std::max(reach_m, (local.centroid_world - place).norm());
  reach_m += max_difference_m_;
  std::vector<PlacedView> views;
  for (const auto& [key, segment] : back_end.map().segments()) {
    for (const SegmentView& view : segment.views) {
      const std::size_t seen_at = IndexOf(target_truth_, back_end.map().PoseOf(view).stamp_ns);
      if (seen_at == target_truth_.stamps_ns.size()) continue;
      const double age_s = 1e-9 * static_cast<double>(truth_.stamps_ns[step] - target_truth_.stamps_ns[seen_at]);
      if (!is_localization_ && (age_s <= scoring_.min_age_s || path_m_[step] - path_m_[seen_at] <= scoring_.min_path_m))
        continue;
      const Eigen::Vector3d centroid = target_truth_.T_world_sensor[seen_at] * view.centroid_sensor;
      if ((centroid - place).norm() <= reach_m) views.push_back({key, view.size, centroid});
    }
  }

  std::set<std::pair<SegmentKey, SegmentKey>> consistent;
  for (const std::optional<Closure>* closure : {&recognized.closure, &recognized.refused}) {
    if (!*closure) continue;
    for (const SegmentMatch& match : (*closure)->matches) consistent.emplace(match.local, match.target);
  }

  // Robots of a loaded map come first.
  const RobotIndex robot = is_localization_ ? static_cast<RobotIndex>(back_end.map().robots()) : 0;
  const MatchingParameters& matching = back_end.parameters().matching;
  for (const auto& [id, local] : local_) {
    const PlacedView* target = nullptr;
    double nearest_m = max_difference_m_;
    for (const PlacedView& view : views) {
      if (view.segment == SegmentKey{robot, id}) continue;  // the robot has not been away
      const double difference_m = (view.centroid_world - local.centroid_world).norm();
      if (difference_m > nearest_m || (target != nullptr && difference_m == nearest_m)) continue;
      nearest_m = difference_m;
      target = &view;
    }
    if (target == nullptr) continue;
    TruePair pair;
    pair.step = step;
    pair.local = {robot, id};
    pair.target = target->segment;
    pair.centroid_difference_m = nearest_m;
    pair.size_ratio = static_cast<double>(std::min(local.size, target->size)) /
                      static_cast<double>(std::max({local.size, target->size, 1u}));
    if (const std::optional<Ranked> ranked = RankOf(pair.target, local.descriptor, robot, back_end.targets())) {
      pair.allowed = true;
      pair.rank = ranked->rank;
      pair.nearest = matching.nearest == 0 || pair.rank <= static_cast<std::size_t>(matching.nearest);
      pair.within = pair.nearest && (matching.max_distance == 0.0 || ranked->distance <= matching.max_distance);
    }
    pair.consistent = consistent.count({pair.local, pair.target}) != 0;
    pairs.push_back(pair);
  }
  return pairs;
}

TruePairStatistics MeasureTruePairs(const std::vector<TruePair>& pairs) {
  TruePairStatistics statistics;
  statistics.pairs = pairs.size();
  std::set<std::size_t> steps;
  std::vector<double> ranks, differences_m, ratios;
  std::size_t nearest = 0, within = 0, consistent = 0;
  for (const TruePair& pair : pairs) {
    steps.insert(pair.step);
    differences_m.push_back(pair.centroid_difference_m);
    ratios.push_back(pair.size_ratio);
    if (pair.allowed) ranks.push_back(static_cast<double>(pair.rank));
    nearest += pair.nearest;
    within += pair.within;
    consistent += pair.consistent;
  }
  const auto share = [&](std::size_t count) { return static_cast<double>(count) / static_cast<double>(pairs.size()); };
  statistics.steps = steps.size();
  statistics.rank_median = Percentile(ranks, 0.5);
  statistics.rank_90 = Percentile(ranks, 0.9);
  for (const std::size_t rank : {1, 5, 10, 25, 100})
    statistics.share_within_rank.emplace_back(rank, ShareWithin(ranks, static_cast<double>(rank)));
  statistics.kept_allowed = share(ranks.size());
  statistics.kept_nearest = share(nearest);
  statistics.kept_within = share(within);
  statistics.kept_consistent = share(consistent);
  statistics.centroid_difference_median_m = Percentile(differences_m, 0.5);
  statistics.centroid_difference_90_m = Percentile(differences_m, 0.9);
  statistics.size_ratio_median = Percentile(ratios, 0.5);
  statistics.size_ratio_10 = Percentile(ratios, 0.1);
  return statistics;
}

}  // namespace incremental_segmatch
