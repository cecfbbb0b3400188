/// \file
/// The original, batch SegMatch as a whole: the counterparts of FrontEnd and Recognizer, with their inputs and outputs.
///
/// In the library target incremental_segmatch_batch.
#pragma once

#include <string>
#include <vector>

#include "incremental_segmatch/back_end.hpp"
#include "incremental_segmatch/batch_baseline.hpp"
#include "incremental_segmatch/front_end.hpp"

namespace incremental_segmatch {

/// The baseline's parameters that mean the same as these.
BatchBaselineParameters BatchParametersOf(const FrontEndParameters& front_end, const RecognizerParameters& recognizer);

/// The original's recognition: the largest group of pcl::GeometricConsistencyGrouping, as a recognition. Covariance and
/// residual are computed as Recognizer does; there is no runner-up. Stateless.
class BatchRecognizer {
 public:
  /// Throws std::invalid_argument naming the parameter that is out of range.
  BatchRecognizer(const FrontEndParameters& front_end, const RecognizerParameters& recognizer);
  /// O(n^2) in the correspondences.
  RecognizerResult Recognize(const Correspondences& correspondences) const;

 private:
  double min_sigma_m_;
  BatchBaseline grouping_;
};

/// One robot's local map, processed as a whole in every step. Its segments have no identity: all of them are new in
/// every step, and those of the step before are retired. Of segments whose centroids lie near each other the newest
/// stays in the target map, as in the original. Not thread-safe.
class BatchFrontEnd {
 public:
  /// Throws std::invalid_argument naming the parameter that is out of range.
  BatchFrontEnd(const FrontEndParameters& parameters, const RecognizerParameters& recognizer, std::string robot);

  /// Takes one scan. Of the counts those are filled in that a batch step knows.
  FrontEndStep Process(const Scan& scan);

 private:
  std::string robot_;
  GroundFilter ground_filter_;
  BatchBaseline baseline_;
  std::size_t shown_points_;
  std::vector<SegmentState> last_;  // segments of the last step
  std::uint64_t sequence_ = 0;
  SegmentId next_id_ = 1;
};

}  // namespace incremental_segmatch
