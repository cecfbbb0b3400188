#include "incremental_segmatch/batch_pipeline.hpp"

#include <algorithm>
#include <cmath>
#include <memory>
#include <stdexcept>
#include <utility>

namespace incremental_segmatch {
namespace {

/// Segments of successive steps whose centroids are this near are the same object.
constexpr double kDuplicateDistanceM = 1.0;

std::shared_ptr<const Points> PointsOf(const std::vector<std::int32_t>& cluster, const Points& cloud,
                                       const Eigen::Vector3d& centroid, std::size_t shown_points) {
  if (shown_points == 0) return nullptr;
  const std::size_t stride = ShownStride(cluster.size(), shown_points);
  auto points = std::make_shared<Points>();
  const Eigen::Vector3f origin = centroid.cast<float>();
  for (std::size_t i = 0; i < cluster.size(); i += stride)
    points->push_back(cloud[static_cast<std::size_t>(cluster[i])] - origin);
  return points;
}

}  // namespace

BatchBaselineParameters BatchParametersOf(const FrontEndParameters& front_end, const RecognizerParameters& recognizer) {
  BatchBaselineParameters batch;
  batch.segmentation = front_end.segmentation;
  batch.local_radius_m = front_end.local_radius_m;
  batch.resolution_m = front_end.grid.resolution_m;
  batch.min_points_per_voxel = front_end.grid.min_points_per_voxel;
  batch.growing_radius_m = front_end.segmenter.growing_radius_m;
  batch.min_cluster_size = front_end.segmenter.min_cluster_size;
  batch.max_cluster_size = front_end.segmenter.max_cluster_size;
  batch.normal_radius_m = front_end.normals.radius_m;
  batch.smoothness = front_end.smoothness;
  batch.epsilon_m = recognizer.consistency.epsilon_m;
  batch.min_consistent = recognizer.clique.min_size;
  batch.descriptor = front_end.descriptor;
  return batch;
}

BatchRecognizer::BatchRecognizer(const FrontEndParameters& front_end, const RecognizerParameters& recognizer)
    : min_sigma_m_(recognizer.min_sigma_m), grouping_(BatchParametersOf(front_end, recognizer)) {}

RecognizerResult BatchRecognizer::Recognize(const Correspondences& correspondences) const {
  RecognizerResult result;
  result.candidates = correspondences.size();
  result.tested_pairs = correspondences.size() * (correspondences.size() - std::min<std::size_t>(correspondences.size(), 1)) / 2;
  if (correspondences.size() < grouping_.parameters().min_consistent) return result;
  std::optional<BatchRecognition> group = grouping_.Recognize(correspondences);
  result.outcome = RecognitionOutcome::kCliqueTooSmall;
  if (!group) return result;

  Recognition recognition;
  recognition.T_target_local = group->T_target_local;
  recognition.inliers = std::move(group->inliers);
  std::sort(recognition.inliers.begin(), recognition.inliers.end(), [](const Correspondence& a, const Correspondence& b) {
    return std::tie(a.local, a.target) < std::tie(b.local, b.target);
  });
  double squares = 0.0;
  std::vector<Eigen::Vector3d> moved;
  for (const Correspondence& inlier : recognition.inliers) {
    moved.push_back(recognition.T_target_local * inlier.centroid_local);
    squares += (moved.back() - inlier.centroid_target).squaredNorm();
  }
  result.clique_size = moved.size();
  recognition.rms_m = std::sqrt(squares / static_cast<double>(moved.size()));
  const Eigen::Vector3d up = recognition.T_target_local.linear().col(2);
  recognition.tilt_rad = std::atan2(up.head<2>().norm(), up.z());
  recognition.covariance = TransformCovariance(moved, CentroidSigma(recognition.rms_m, moved.size(), min_sigma_m_));
  recognition.proven_maximum = false;  // the grouping is greedy
  recognition.max_inliers = correspondences.size();
  result.outcome = RecognitionOutcome::kAccepted;
  result.recognition = std::move(recognition);
  return result;
}

BatchFrontEnd::BatchFrontEnd(const FrontEndParameters& parameters, const RecognizerParameters& recognizer, std::string robot)
    : robot_(std::move(robot)),
      ground_filter_(parameters.ground),
      baseline_(BatchParametersOf(parameters, recognizer)),
      shown_points_(parameters.view.shown_points) {
  if (std::isfinite(parameters.local_path_m))
    throw std::invalid_argument("front_end.local_path_m: the batch pipeline knows no such limit; set it to .inf");
}

FrontEndStep BatchFrontEnd::Process(const Scan& scan) {
  FrontEndStep step;
  StageTimer timer;
  GroundFilterResult filtered = ground_filter_.Filter(scan.points_sensor, scan.T_odom_sensor);
  timer.Lap("ground_filter");
  step.times = timer.Take();

  const BatchStep batch = baseline_.Process(filtered.obstacles_sensor, scan.T_odom_sensor);
  step.times.insert(step.times.end(), batch.times.begin(), batch.times.end());

  StageTimer delta_timer;
  SegmentDelta& delta = step.delta;
  delta.robot = robot_;
  delta.sequence = ++sequence_;
  delta.stamp_ns = scan.stamp_ns;
  delta.T_odom_sensor = scan.T_odom_sensor;
  const Points cloud = baseline_.LocalCloud();
  for (const BatchSegment& segment : batch.segments) {
    SegmentState state;
    state.id = next_id_++;
    state.size = static_cast<std::uint32_t>(segment.cluster.size());
    state.centroid_odom = segment.centroid_odom;
    state.descriptor = segment.descriptor;
    state.new_view = true;
    state.points_centroid = PointsOf(segment.cluster, cloud, segment.centroid_odom, shown_points_);
    delta.changed.push_back(std::move(state));
  }
  for (const SegmentState& last : last_) {
    const bool seen_again = std::any_of(delta.changed.begin(), delta.changed.end(), [&](const SegmentState& now) {
      return (now.centroid_odom - last.centroid_odom).norm() <= kDuplicateDistanceM;
    });
    // What is retired as no segment leaves the target map.
    delta.retired.push_back({last.id, seen_again ? RetirementCause::kTooLarge : RetirementCause::kLeft});
  }
  last_ = delta.changed;
  for (SegmentState& state : last_) state.points_centroid.reset();
  delta_timer.Lap("segment_clouds");
  const StageTimes delta_times = delta_timer.Take();
  step.times.insert(step.times.end(), delta_times.begin(), delta_times.end());

  step.counts.points = scan.points_sensor.size();
  step.counts.obstacle_points = filtered.obstacles_sensor.size();
  step.counts.dropped_nonfinite = filtered.dropped_nonfinite;
  step.counts.voxels = batch.voxels;
  step.counts.clusters.segments = batch.segments.size();
  step.obstacles_sensor = std::move(filtered.obstacles_sensor);
  return step;
}

}  // namespace incremental_segmatch
