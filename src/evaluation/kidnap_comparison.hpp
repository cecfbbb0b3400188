/// \file
/// Whether a robot that was carried elsewhere recognises what it would have recognised (METHOD 5: no prior on the
/// pose).
#pragma once

#include <cstddef>
#include <string>
#include <vector>

#include "evaluation/evaluation.hpp"

namespace incremental_segmatch {

/// Accepted recognitions of a run that was disturbed beside those of the run that was not, over a part of the drive.
/// Percentiles over nothing are NaN.
struct KidnapPart {
  std::string name;               ///< which part
  std::size_t steps = 0;          ///< of the drive
  std::size_t undisturbed = 0;    ///< steps with a recognition
  std::size_t carried = 0;        ///< the same of the disturbed run
  std::size_t both = 0;           ///< steps in which both recognised something
  double difference_95_m = 0.0;   ///< between the two poses in steps with both
  double difference_max_m = 0.0;  ///< the same, the largest
  double difference_max_deg = 0.0;
};

/// The comparison of one drive.
struct KidnapComparison {
  std::string drive;
  std::vector<KidnapPart> parts;  ///< before, the way after it on which the local map fills again, and the rest
  std::size_t false_undisturbed = 0;
  std::size_t false_carried = 0;
};

/// Compares two runs without optimization over the same scans; from step `first_moved` on the odometry of `carried` is
/// moved by a rigid transform. Where the targets of a step differ, they are joined by the undisturbed odometry.
/// `refill_m` of path behind that step are told apart: the local map begins anew there. Throws std::invalid_argument if
/// the runs differ in their stamps or have no score.
KidnapComparison CompareKidnapped(const std::string& drive, const EvaluationResult& undisturbed,
                                  const EvaluationResult& carried, std::size_t first_moved, double refill_m);

/// One row per drive and part, in Markdown.
std::string KidnapMarkdown(const std::vector<KidnapComparison>& comparisons);

/// The same for programs.
std::string KidnapJson(const std::vector<KidnapComparison>& comparisons);

}  // namespace incremental_segmatch
