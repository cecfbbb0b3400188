/// \file
/// What happens to pairs of segments that are one object seen twice: how far up the true target is among the
/// candidates, and which stage loses it. Needs ground truth, and is used for nothing but figures.
#pragma once

#include <cstddef>
#include <map>
#include <optional>
#include <vector>

#include "evaluation/scoring.hpp"
#include "incremental_segmatch/back_end.hpp"

namespace incremental_segmatch {

/// A segment of the local map and the segment of the target map that is the same object.
struct TruePair {
  std::size_t step = 0;
  SegmentKey local;
  SegmentKey target;
  double centroid_difference_m = 0.0;  ///< of the two centroids, each placed by the true pose of its scan
  double size_ratio = 0.0;             ///< voxels of the smaller over voxels of the larger one
  bool allowed = false;                ///< the target was open to matching
  std::size_t rank = 0;  ///< of the target among all open ones by descriptor distance, from 1; 0 if it is not allowed
  bool nearest = false;  ///< allowed, and among the `nearest` that are taken
  bool within = false;   ///< nearest, and within `max_distance`
  bool consistent = false;  ///< in the set of the step's recognition, accepted or refused
};

/// Finds the true pairs of a drive's steps. A pair consists of a tracked local segment, its centroid placed by the true
/// pose of the scan that changed it last, and that target segment with the nearest view not farther than the limit: a
/// view whose centroid is placed by the true pose of the scan that it was seen from, which is old enough for a closure.
/// In localization all views of the map are old enough. Not thread-safe.
class TruePairFinder {
 public:
  /// `truth` of the drive, `map_truth` of the loaded map's drive in localization (null: loop closure); both must
  /// outlive this. Throws std::invalid_argument unless each has one pose for each stamp.
  TruePairFinder(const TrueTrajectory& truth, const TrueTrajectory* map_truth, const ScoringParameters& scoring,
                 double max_difference_m = 1.0);

  /// The pairs of a step of the drive, of which the back end has just processed the delta; none unless the step is a
  /// revisit. To be called for every step, in order, before the map is corrected. At revisits O(views) per pair.
  std::vector<TruePair> Step(std::size_t step, const SegmentDelta& delta, const BackEndStep& recognized,
                             const BackEnd& back_end);

 private:
  struct LocalSegment {
    std::size_t seen_at = 0;  // step
    Eigen::Vector3d centroid_world = Eigen::Vector3d::Zero();
    std::uint32_t size = 0;
    Descriptor descriptor;
  };

  void Apply(std::size_t step, const SegmentDelta& delta);

  const TrueTrajectory& truth_;
  const TrueTrajectory& target_truth_;
  bool is_localization_;
  ScoringParameters scoring_;
  double max_difference_m_;
  std::vector<std::optional<std::size_t>> revisit_targets_;
  std::vector<double> path_m_;
  std::map<SegmentId, LocalSegment> local_;
};

/// Figures of true pairs. Ratios and percentiles over nothing are NaN; shares are of all pairs.
struct TruePairStatistics {
  std::size_t pairs = 0;
  std::size_t steps = 0;  ///< with pairs
  double rank_median = 0.0;
  double rank_90 = 0.0;
  std::vector<std::pair<std::size_t, double>> share_within_rank;  ///< the first 1, 5, 10, 25, 100; of allowed pairs
  double kept_allowed = 0.0;
  double kept_nearest = 0.0;
  double kept_within = 0.0;
  double kept_consistent = 0.0;
  double centroid_difference_median_m = 0.0;
  double centroid_difference_90_m = 0.0;
  double size_ratio_median = 0.0;
  double size_ratio_10 = 0.0;  ///< nine in ten are above
};

/// Sums up. Ranks are taken over the allowed pairs, and what is consistent counts whether or not it was allowed when
/// its rank was taken. O(n log n).
TruePairStatistics MeasureTruePairs(const std::vector<TruePair>& pairs);

}  // namespace incremental_segmatch
