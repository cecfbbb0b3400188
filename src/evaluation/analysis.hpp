/// \file
/// What a run says beyond its score: why revisits were missed, what another acceptance threshold would give, where the
/// time went. Everything that files, summary and report show of a run is computed here.
#pragma once

#include <functional>
#include <map>
#include <string>
#include <utility>
#include <vector>

#include "evaluation/evaluation.hpp"

namespace incremental_segmatch {

/// A revisit without a true closure.
struct MissedRevisit {
  std::size_t step = 0;
  bool opposite = false;        ///< driven against the earlier visit
  double since_m = 0.0;         ///< path since the last true closure on this stretch, or since its beginning
  std::size_t target_step = 0;  ///< the nearest old pose, a step of the drive or of the map's drive
  std::string cause;            ///< the stage that ended the step, or "false_closure", "trivial_closure"
};

/// In the order of the drive; none without ground truth.
std::vector<MissedRevisit> FindMissedRevisits(const EvaluationResult& result);

/// How many were missed for which cause.
std::map<std::string, std::size_t> CountCauses(const std::vector<MissedRevisit>& missed);

/// What acceptance from some strength on would give; the run itself accepts from 1 on.
struct AcceptancePoint {
  double threshold = 0.0;    ///< a strength; infinite where nothing speaks against a recognition
  std::size_t accepted = 0;  ///< true and false
  double precision = 0.0;
  double recall = 0.0;  ///< share of the revisits that have a true recognition
};

/// The curve over all recognitions that were judged, accepted or not: one point for each strength that occurs, highest
/// threshold first. Recognitions of a place just left don't count. Empty without ground truth.
std::vector<AcceptancePoint> AcceptanceCurve(const EvaluationResult& result);

/// Milliseconds per step of a stage.
struct StageStatistics {
  std::string name;
  double median_ms = 0.0;
  double p95_ms = 0.0;
  double p99_ms = 0.0;
  double max_ms = 0.0;
  double mean_ms = 0.0;
};

/// All stages in the order in which they run, then "total", then reading and optimizing, which are not in it.
std::vector<StageStatistics> MeasureStages(const std::vector<StepRecord>& steps);

/// Stages in the order in which steps first ran them.
std::vector<std::string> StageNames(const std::vector<StepRecord>& steps);

/// Time of a stage in a step; 0 if it did not run.
double StageMs(const StepRecord& step, const std::string& name);

/// A count of the funnel, per step.
struct FunnelColumn {
  std::string name;
  std::function<double(const StepRecord&)> value;
};

/// The counts of a step, from the scan's points to the largest consistent set.
std::vector<FunnelColumn> FunnelColumns();

/// A part of the evidence.
struct EvidenceColumn {
  std::string name;
  std::function<double(const Evidence&)> value;
};

/// The evidence of a step that had a recognition, accepted or not.
std::vector<EvidenceColumn> EvidenceColumns();

/// How many steps were ended by which stage.
std::map<std::string, std::size_t> CountEnds(const std::vector<StepRecord>& steps);

/// Path from the first step on, by the truth, or by the odometry where there is none.
std::vector<double> PathLengths(const EvaluationResult& result);

/// Mean; NaN of nothing.
double Mean(const std::vector<double>& values);

/// A value for each step.
std::vector<double> Values(const std::vector<StepRecord>& steps, const std::function<double(const StepRecord&)>& value);

/// A figure that survives in the text of the thesis, and ours.
struct ThesisFigure {
  std::string key;     ///< in summary.json
  std::string what;    ///< for people
  std::string thesis;  ///< what it says, with its experiment
  double ours = 0.0;   ///< NaN where the run does not have it
  const char* format;  ///< of ours, for printf
};

/// The figures of thesis tables 4.1 and 4.2 and figure 4.8 (METHOD 6) beside this run's.
std::vector<ThesisFigure> CompareWithThesis(const EvaluationResult& result);

}  // namespace incremental_segmatch
