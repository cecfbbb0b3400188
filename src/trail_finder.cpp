#include "incremental_segmatch/trail_finder.hpp"

#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <string>
#include <utility>

namespace incremental_segmatch {
namespace {

constexpr std::size_t kSampleEvery = 8;    // voxels
constexpr double kSamePlace_voxels = 2.0;  // a voxel's centroid stays within its cell

}  // namespace

TrailFinder::TrailFinder(const TrailParameters& parameters) : parameters_(parameters) { Validate(parameters); }

std::vector<SegmentId> TrailFinder::Look(StampNs stamp_ns, const Points& scan_sensor, const Pose& T_odom_sensor,
                                         const DynamicVoxelGrid& grid, const Segmenter& segmenter) {
  if (!parameters_.enabled || static_cast<double>(stamp_ns - last_look_ns_) < 1e9 * parameters_.interval_s) return {};
  last_look_ns_ = stamp_ns;
  const std::vector<Sample> samples = std::exchange(waiting_, std::exchange(recent_, {}));
  if (samples.empty()) return {};

  const RangeImage image(scan_sensor);
  const Pose T_sensor_grid = T_odom_sensor.inverse() * grid.T_odom_grid();
  const double same_place_m = kSamePlace_voxels * grid.parameters().resolution_m;
  const float min_range_m = static_cast<float>(parameters_.min_range_m);
  const float tolerance_m = static_cast<float>(parameters_.tolerance_m);
  std::vector<SegmentId> trails;
  for (const Sample& sample : samples) {
    if (!grid.IsActive(sample.voxel)) continue;
    const SegmentId segment = segmenter.SegmentOf(sample.voxel);
    const Eigen::Vector3d centroid_grid = grid.CentroidGrid(sample.voxel);
    if (segment == kNoSegment || (centroid_grid - sample.centroid_grid).norm() > same_place_m) continue;
    const Eigen::Vector3f p_sensor = (T_sensor_grid * centroid_grid).cast<float>();
    if (p_sensor.norm() < min_range_m) {
      waiting_.push_back(sample);
      continue;
    }
    const Sight sight = image.Look(p_sensor, tolerance_m);
    if (sight == Sight::kUnknown) continue;
    FreeSpaceCounts& counts = judged_[segment];
    ++(sight == Sight::kConfirmed ? counts.confirmed : counts.seen_through);
    trails.push_back(segment);
  }
  std::sort(trails.begin(), trails.end());
  trails.erase(std::unique(trails.begin(), trails.end()), trails.end());
  const auto is_none = [this](SegmentId segment) {
    const FreeSpaceCounts& counts = judged_.at(segment);
    return counts.confirmed + counts.seen_through < parameters_.min_voxels || counts.Contradiction() < parameters_.min_share;
  };
  trails.erase(std::remove_if(trails.begin(), trails.end(), is_none), trails.end());
  return trails;
}

void TrailFinder::Add(const std::vector<VoxelHandle>& activated, const DynamicVoxelGrid& grid) {
  if (!parameters_.enabled) return;
  for (const VoxelHandle voxel : activated) {
    if (++skipped_ < kSampleEvery) continue;
    skipped_ = 0;
    recent_.push_back({voxel, grid.CentroidGrid(voxel)});
  }
}

void TrailFinder::Follow(const SegmentUpdate& update) {
  for (const RenamedSegment& renamed : update.renamed) {
    const auto from = judged_.find(renamed.from);
    if (from == judged_.end()) continue;
    const FreeSpaceCounts counts = from->second;
    judged_.erase(from);
    judged_[renamed.to] += counts;
  }
  for (const RetiredSegment& retired : update.retired) judged_.erase(retired.id);
}

std::size_t TrailFinder::memory_bytes() const {
  constexpr std::size_t kNodeOverhead = 2 * sizeof(void*);
  return (recent_.capacity() + waiting_.capacity()) * sizeof(Sample) +
         judged_.size() * (sizeof(std::pair<SegmentId, FreeSpaceCounts>) + kNodeOverhead);
}

void Validate(const TrailParameters& parameters) {
  const auto require = [](bool holds, const char* what) {
    if (!holds) throw std::invalid_argument(std::string("front_end.trails.") + what);
  };
  require(parameters.interval_s > 0.0 && std::isfinite(parameters.interval_s), "interval_s: must be positive");
  require(parameters.min_range_m >= 0.0, "min_range_m: must not be negative");
  require(parameters.tolerance_m > 0.0, "tolerance_m: must be positive");
  require(parameters.min_voxels >= 1, "min_voxels: must be at least 1");
  require(parameters.min_share > 0.0 && parameters.min_share <= 1.0, "min_share: must be above 0 and at most 1");
}

}  // namespace incremental_segmatch
