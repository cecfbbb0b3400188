/// \file
/// Whether a recognition may be published: the evidence beyond the clique (METHOD 5, beyond).
#pragma once

#include <Eigen/Core>
#include <cstddef>
#include <limits>
#include <vector>

#include "incremental_segmatch/recognizer.hpp"

namespace incremental_segmatch {

/// What evidence a recognition must have.
struct AcceptanceParameters {
  double support_distance_m =
      1.0;  ///< a local segment is supported by a target segment this near, under the recognised transform
  double neighbourhood_m =
      10.0;                    ///< and is expected to be, where any target segment is this near: the map was seen there
  double min_coverage = 0.25;  ///< least share of the expected local segments that are supported
  double min_ratio = 1.75;     ///< of the inliers to the best clique that speaks for another place; less: that is a rival
  std::size_t twin_size = 12;  ///< a rival of at least so many matches is no chance: there are twins hereabouts
  /// For so much of path after twins, though some steps may see no rival, and where there is one, more is demanded:
  double twin_memory_m = 100.0;
  double min_track_m = 50.0;      ///< path over which recognitions agree with each other by odometry,
  double min_track_fit = 0.99;    ///< scans that overlap the map's along it, in the mean, as well as those each other,
  double min_distinction = 0.75;  ///< and a rival that explains so much less of what only one of the places explains
  double max_distance_m = 20.0;  ///< of the query from the pose its target was seen from: odometry drifts in between
  double max_sigma_m = 0.5;      ///< largest standard deviation of the query's position, along its worst axis
  double max_sigma_rad = 0.02;   ///< the same of its orientation
  double max_contradiction = 0.06;        ///< share of what the map has there that the scans see through, over all
  double max_contradiction_once = 0.2;    ///< and in any one of the scans
};

/// What speaks for and against a recognition.
struct Evidence {
  std::size_t inliers = 0;    ///< matches that agree
  std::size_t runner_up = 0;  ///< size of the best clique that speaks for another place
  double since_twin_m = std::numeric_limits<double>::infinity();  ///< path since a place had a twin
  double distinction = 0.0;  ///< of the scan's points that fit only one of this and the rival's place: share that fits this
  double track_m = 0.0;      ///< path over which recognitions agree by odometry; where there are twins, a rival, or acceptance
  double track_fit = 0.0;    ///< mean overlap over that path, over the overlap that the map's scans have with each other
  bool on_proven_track = false;  ///< one of those recognitions had all the evidence that it needed: where it is, this is
  std::size_t expected = 0;   ///< local segments where the map was seen
  std::size_t supported = 0;  ///< of them, those with a target segment in their place
  double overlap =
      0.0;  ///< share of the inlier segments' points that lie on points of their targets; 0 without refinement
  double sigma_m = 0.0;    ///< standard deviation of the query's position, along its worst axis
  double sigma_rad = 0.0;  ///< and of its orientation

  double contradiction = 0.0;       ///< share of what the map has along the way here that the scans see through
  double contradiction_once = 0.0;  ///< the same of the scan that contradicts most
  double distance_m = 0.0;  ///< between the two sensor poses of the closure

  /// Share of what should be seen that is seen; 0 where nothing is expected.
  double Coverage() const {
    return expected == 0 ? 0.0 : static_cast<double>(supported) / static_cast<double>(expected);
  }
};

/// Counts expected and supported segments. Both lists in the map's frame. O(local * targets).
void MeasureCoverage(const std::vector<Eigen::Vector3d>& centroids_local,
                     const std::vector<Eigen::Vector3d>& centroids_target, const AcceptanceParameters& parameters,
                     Evidence* evidence);

/// Whether a recognition is accepted, or why not.
enum class Verdict { kAccepted, kAmbiguous, kUncovered, kContradicted, kUncertain, kTooFar };

/// Whether another set of correspondences is too large beside the inliers.
bool HasRival(const Evidence& evidence, const AcceptanceParameters& parameters);

/// Whether segments alone can't be trusted here: there is a rival, or there was one of some size a little way back.
bool IsDeceptive(const Evidence& evidence, const AcceptanceParameters& parameters);

/// Judges the evidence. O(1).
Verdict Judge(const Evidence& evidence, const AcceptanceParameters& parameters);

/// By what factor the evidence keeps its limits, at the limit where it is smallest: what is demanded over what is there,
/// or the other way round. At least 1 where Judge accepts, less where it refuses; infinite where no limit binds. O(1).
double Strength(const Evidence& evidence, const AcceptanceParameters& parameters);

/// Throws std::invalid_argument naming the parameter that is out of range.
void Validate(const AcceptanceParameters& parameters);

}  // namespace incremental_segmatch
