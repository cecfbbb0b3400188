/// \file
/// The thesis's two KITTI experiments, loop closure and localization, on one page.
#pragma once

#include <string>
#include <vector>

#include "evaluation/evaluation.hpp"

namespace incremental_segmatch {

/// A run of one of the experiments, with Pipeline::kBoth for the speed-ups.
struct ThesisRun {
  std::string drive;
  bool is_localization = false;
  std::string report;  ///< path of its report.html, relative to the page
  EvaluationResult result;
};

/// The comparison: what was found, speed-up over the batch version per stage beside the thesis's, the gaps between
/// localizations as curves (fig. 4.8).
std::string ThesisPage(const std::vector<ThesisRun>& runs);

}  // namespace incremental_segmatch
