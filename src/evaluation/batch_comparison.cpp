#include "evaluation/batch_comparison.hpp"

#include <algorithm>
#include <functional>
#include <ostream>

#include "evaluation/evaluation.hpp"

namespace incremental_segmatch {
namespace {

/// Milliseconds of those stages that are named.
double SumOf(const StageTimes& times, const std::vector<std::string>& names) {
  double total_ms = 0.0;
  for (const auto& [stage, ms] : times)
    if (std::find(names.begin(), names.end(), stage) != names.end()) total_ms += ms;
  return total_ms;
}

/// Stages of both pipelines that do the same.
struct Pairing {
  std::string name;
  std::vector<std::string> incremental, batch;
};

std::vector<Pairing> Pairings(bool normals) {
  std::vector<Pairing> pairings{{"voxel grid", {"voxel_removal", "voxel_insertion"}, {"voxel_grid"}}};
  if (normals) {
    pairings.push_back({"normals, tree included", {"normal_removal", "normals"}, {"tree", "normals"}});
    pairings.push_back({"normals, tree shared", {"normal_removal", "normals"}, {"normals"}});
  } else {
    pairings.push_back({"segmentation, tree included", {"segment_removal", "segmentation"}, {"tree", "segmentation"}});
  }
  pairings.push_back({"segmentation, tree shared", {"segment_removal", "segmentation"}, {"segmentation"}});
  if (normals)
    pairings.push_back({"normals and segmentation",
                        {"normal_removal", "normals", "segment_removal", "segmentation"},
                        {"tree", "normals", "segmentation"}});
  pairings.push_back({"description", {"description"}, {"description"}});
  return pairings;
}

}  // namespace

BatchRecord BatchComparison::Run(const FrontEndStep& seen, const BackEndStep& recognized, const Pose& T_odom_sensor) {
  Correspondences correspondences;
  correspondences.reserve(recognized.candidates.size());
  for (const SegmentMatch& match : recognized.candidates)
    correspondences.push_back({match.local, match.target, match.centroid_local_odom, match.centroid_target_map,
                               match.descriptor_distance});
  BatchRecord record;
  BatchStep step = baseline_.Process(seen.obstacles_sensor, T_odom_sensor);
  StageTimer timer;
  const std::optional<BatchRecognition> recognition = baseline_.Recognize(correspondences);
  timer.Lap("recognition");

  record.stages = std::move(step.times);
  record.stages.push_back(timer.Take().front());
  for (const auto& stage : record.stages) record.total_ms += stage.second;
  record.total_ms += SumOf(seen.times, {"ground_filter"}) + SumOf(recognized.times, {"target_update", "matching", "refinement"});
  record.voxels = step.voxels;
  record.segments = step.segments.size();
  record.inliers = recognition ? recognition->inliers.size() : 0;
  return record;
}

void WriteBatchHeader(const BatchRecord& record, std::ostream& stream) {
  stream << ",batch_total_ms";
  for (const auto& stage : record.stages) stream << ",batch_" << stage.first << "_ms";
  stream << ",batch_voxels,batch_segments,batch_inliers";
}

void WriteBatchColumns(const BatchRecord& record, std::ostream& stream) {
  stream << ',' << record.total_ms;
  for (const auto& stage : record.stages) stream << ',' << stage.second;
  stream << ',' << record.voxels << ',' << record.segments << ',' << record.inliers;
}

std::vector<StageComparison> CompareStages(const std::vector<StepRecord>& steps) {
  using Value = std::function<double(const StepRecord&)>;
  std::vector<StageComparison> comparison;
  const auto compare = [&](const std::string& stage, const Value& incremental, const Value& batch,
                           const std::function<bool(const StepRecord&)>& counts) {
    std::vector<double> ours, theirs;
    for (const StepRecord& step : steps) {
      if (!step.batch || !counts(step)) continue;
      ours.push_back(incremental(step));
      theirs.push_back(batch(step));
    }
    if (!ours.empty()) comparison.push_back({stage, ours.size(), Percentile(ours, 0.5), Percentile(theirs, 0.5)});
  };
  const auto all = [](const StepRecord&) { return true; };
  const bool normals = std::any_of(steps.begin(), steps.end(), [](const StepRecord& step) {
    return step.batch && SumOf(step.batch->stages, {"normals"}) > 0.0;
  });
  for (const Pairing& pairing : Pairings(normals))
    compare(
        pairing.name, [&](const StepRecord& step) { return SumOf(step.stages, pairing.incremental); },
        [&](const StepRecord& step) { return SumOf(step.batch->stages, pairing.batch); }, all);
  const auto recognition = [](const StageTimes& times) { return SumOf(times, {"recognition"}); };
  compare(
      "recognition", [&](const StepRecord& step) { return recognition(step.stages); },
      [&](const StepRecord& step) { return recognition(step.batch->stages); },
      [](const StepRecord& step) { return step.back_end.candidates > 0; });
  compare(
      "whole step", [](const StepRecord& step) { return step.total_ms; },
      [](const StepRecord& step) { return step.batch->total_ms; }, all);
  return comparison;
}

}  // namespace incremental_segmatch
