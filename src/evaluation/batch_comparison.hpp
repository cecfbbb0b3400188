/// \file
/// The batch baseline beside the incremental pipeline, step by step on the same input.
#pragma once

#include <cstddef>
#include <iosfwd>
#include <limits>
#include <string>
#include <vector>

#include "incremental_segmatch/back_end.hpp"
#include "incremental_segmatch/batch_baseline.hpp"
#include "incremental_segmatch/front_end.hpp"

namespace incremental_segmatch {

struct StepRecord;

/// What the batch stages took and found in a step.
struct BatchRecord {
  double total_ms = 0.0;      ///< own stages, and those that both share: ground filter, target update, matching, refinement
  StageTimes stages;          ///< own ones: voxel_grid, tree, (normals,) segmentation, description, recognition
  std::size_t voxels = 0;     ///< in the local cloud
  std::size_t segments = 0;   ///< in the local cloud
  std::size_t inliers = 0;    ///< of the largest consistent group, 0 if there is none of the smallest size
};

/// Runs the batch stages on obstacle points and correspondences of the incremental pipeline.
class BatchComparison {
 public:
  /// Throws std::invalid_argument naming the parameter that is out of range.
  explicit BatchComparison(const BatchBaselineParameters& parameters) : baseline_(parameters) {}

  /// To be called after every step with what the incremental pipeline made of it.
  BatchRecord Run(const FrontEndStep& seen, const BackEndStep& recognized, const Pose& T_odom_sensor);

 private:
  BatchBaseline baseline_;
};

/// Columns of steps.csv, each with a comma in front of it.
void WriteBatchHeader(const BatchRecord& record, std::ostream& stream);
void WriteBatchColumns(const BatchRecord& record, std::ostream& stream);

/// A stage of both pipelines.
struct StageComparison {
  std::string stage;
  std::size_t steps = 0;        ///< that the medians are taken over: recognition's are those that had correspondences
  double incremental_ms = 0.0;  ///< median
  double batch_ms = 0.0;        ///< median
  double ratio() const { return incremental_ms > 0.0 ? batch_ms / incremental_ms : std::numeric_limits<double>::quiet_NaN(); }
};

/// Stage by stage, over the steps that have a batch record; nothing if there are none.
std::vector<StageComparison> CompareStages(const std::vector<StepRecord>& steps);

}  // namespace incremental_segmatch
