/// \file
/// Loop closures judged against ground truth.
#pragma once

#include <cstddef>
#include <optional>
#include <string>
#include <vector>

#include "incremental_segmatch/types.hpp"

namespace incremental_segmatch {

/// One accepted recognition, a row of closures.csv.
struct ClosureRow {
  StampNs stamp_query_ns = 0;
  StampNs stamp_target_ns = 0;
  std::string robot_query;
  std::string robot_target;
  Pose T_target_query = Pose::Identity();  ///< pose of the query's sensor in the frame of the target's sensor
  std::size_t inliers = 0;
  std::size_t candidates = 0;
  double rms_m = 0.0;
  std::optional<Covariance6> covariance = std::nullopt;  ///< of T_target_query, as in Closure; not in closures.csv
};

/// Writes closures.csv: stamps in seconds with nine decimals. Throws std::runtime_error naming the file.
void WriteClosuresCsv(const std::vector<ClosureRow>& closures, const std::string& path);

/// The true poses of a drive's sensor.
struct TrueTrajectory {
  std::vector<StampNs> stamps_ns;    ///< of the scans, increasing
  std::vector<Pose> T_world_sensor;  ///< one for each stamp
};

/// Path from the first pose on, at each pose (m).
std::vector<double> PathLengths(const std::vector<Pose>& poses);

/// The terms of the score.
struct ScoringParameters {
  double min_age_s = 60.0;         ///< a closure's target is more than this older than its query
  double min_path_m = 50.0;        ///< and more than this much of path away
  double revisit_radius_m = 5.0;   ///< a revisit is a step within this of a pose that much older
  double max_translation_m = 1.0;  ///< a closure is true if its relative pose is nearer than this to the truth
  double max_rotation_deg = 3.0;   ///< and nearer than this
};

enum class ClosureVerdict {
  kTrue,
  kFalse,
  kTrivial,    ///< the target is too young: earns nothing
  kUnmatched,  ///< a stamp is no scan's
};

/// A closure with its judgement.
struct JudgedClosure {
  ClosureVerdict verdict = ClosureVerdict::kUnmatched;
  std::size_t query_step = 0;   ///< valid unless unmatched
  std::size_t target_step = 0;  ///< valid unless unmatched
  double translation_error_m = 0.0;
  double rotation_error_deg = 0.0;
  /// Squared error in units of the stated covariance, e^T C^-1 e, e of six dimensions: chi squared, 6 in the mean, where
  /// the covariance is honest. None without a covariance.
  std::optional<double> normalized_error2;
};

/// Score of a drive. Ratios and percentiles over nothing are NaN.
struct Score {
  std::size_t steps = 0;
  std::size_t revisits = 0;
  std::size_t revisits_opposite = 0;  ///< of those, at more than 90 degrees of heading to the nearest old pose
  std::size_t closures = 0;           ///< true and false
  std::size_t true_closures = 0;
  std::size_t false_closures = 0;
  std::size_t trivial_closures = 0;
  std::size_t unmatched_closures = 0;
  double precision = 0.0;
  double recall = 0.0;  ///< share of revisits with a true closure
  double recall_same_direction = 0.0;
  double recall_opposite_direction = 0.0;
  double translation_error_median_m = 0.0;  ///< over true closures, like the next five
  double translation_error_95_m = 0.0;
  double rotation_error_median_deg = 0.0;
  double rotation_error_95_deg = 0.0;
  double normalized_error2_median = 0.0;  ///< 5.35 where the stated covariances are honest, less where they are modest
  double normalized_error2_within_95 = 0.0;  ///< share of true closures within 12.59: 0.95 where they are honest
  double gap_50_m =
      0.0;  ///< metres of revisited path between consecutive true closures, both ends of each stretch included
  double gap_90_m = 0.0;
  double gap_99_m = 0.0;
  double gap_max_m = 0.0;
  std::vector<double> gaps_m;         ///< all of them, in the order of the drive: the curve of thesis fig. 4.8
  std::size_t places = 0;             ///< stretches of revisited path with at least one true closure
  std::size_t places_opposite = 0;    ///< of those, with one in the opposite direction
  std::vector<JudgedClosure> judged;  ///< one for each row given
  std::vector<std::optional<std::size_t>>
      revisit_targets;         ///< per step: the nearest pose that is old enough, if within the radius
  std::vector<bool> opposite;  ///< per step: a revisit in the opposite direction
  std::vector<bool> found;     ///< per step: has a true closure
};

/// Judges closures of a drive with itself. Throws std::invalid_argument unless there is one pose for each stamp. O(n)
/// for drives of bounded density.
Score ScoreClosures(const TrueTrajectory& drive, const std::vector<ClosureRow>& closures,
                    const ScoringParameters& parameters);

/// Judges localizations of a drive in the map of another one, whose truth is in the same world frame. Targets are the
/// map drive's poses, on its clock; every step within the radius of one of them is a revisit, and no closure is
/// trivial. Otherwise as ScoreClosures.
Score ScoreLocalizations(const TrueTrajectory& drive, const TrueTrajectory& map_drive,
                         const std::vector<ClosureRow>& closures, const ScoringParameters& parameters);

/// Share of the values that are at most `limit`; NaN of nothing.
double ShareWithin(const std::vector<double>& values, double limit);

/// The value below which the given share (0..1) of the values lie: the one at floor(share * n) in order; NaN of
/// nothing.
double Percentile(std::vector<double> values, double share);

}  // namespace incremental_segmatch
