#include "incremental_segmatch/front_end.hpp"

#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <utility>

namespace incremental_segmatch {
namespace {

std::unique_ptr<IncrementalNormals> MakeNormals(const FrontEndParameters& parameters, const DynamicVoxelGrid& grid) {
  if (parameters.segmentation != Segmentation::kSmoothness) return nullptr;
  return std::make_unique<IncrementalNormals>(parameters.normals, grid);
}

std::unique_ptr<Segmenter> MakeSegmenter(const FrontEndParameters& parameters, const DynamicVoxelGrid& grid,
                                         const IncrementalNormals* normals) {
  if (parameters.segmentation != Segmentation::kSmoothness)
    return std::make_unique<IncrementalSegmenter<EuclideanPolicy>>(parameters.segmenter, grid);
  return std::make_unique<IncrementalSegmenter<SmoothnessPolicy>>(parameters.segmenter, grid,
                                                                  SmoothnessPolicy(parameters.smoothness, *normals));
}

void Validate(double local_radius_m, const ViewParameters& view) {
  if (!(local_radius_m > 0.0)) throw std::invalid_argument("front_end.local_radius_m: must be positive");
  if (!(view.growth_factor > 1.0)) throw std::invalid_argument("front_end.view.growth_factor: must exceed 1");
  if (!(view.baseline_m > 0.0)) throw std::invalid_argument("front_end.view.baseline_m: must be positive");
}

/// Every so many of the voxels that got points: enough to see what a segment looks like.
std::vector<VoxelHandle> VoxelsSeen(const VoxelUpdate& update) {
  constexpr std::size_t kStride = 4;
  std::vector<VoxelHandle> seen;
  for (std::size_t i = 0; i < update.moved.size(); i += kStride) seen.push_back(update.moved[i].voxel);
  for (std::size_t i = 0; i < update.activated.size(); i += kStride) seen.push_back(update.activated[i]);
  return seen;
}

}  // namespace

FrontEnd::FrontEnd(const FrontEndParameters& parameters, std::string robot)
    : parameters_(parameters),
      robot_(std::move(robot)),
      ground_filter_(parameters.ground),
      grid_(parameters.grid),
      normals_(MakeNormals(parameters, grid_)),
      segmenter_(MakeSegmenter(parameters, grid_, normals_.get())),
      trail_finder_(parameters.trails),
      describer_(parameters.descriptor, parameters.grid.resolution_m) {
  Validate(parameters.local_radius_m, parameters.view);
  if (!(parameters.local_path_m > 0.0)) throw std::invalid_argument("front_end.local_path_m: must be positive");
  Validate(parameters.thinning);
}

void FrontEnd::ChangeParameters(const GroundFilterParameters& ground, double local_radius_m,
                                const ViewParameters& view) {
  Validate(local_radius_m, view);
  ground_filter_ = GroundFilter(ground);
  parameters_.ground = ground;
  parameters_.local_radius_m = local_radius_m;
  parameters_.view = view;
}

FrontEndStep FrontEnd::Process(const Scan& scan) {
  if (started_ && scan.stamp_ns <= last_stamp_ns_)
    throw std::invalid_argument("scan at " + std::to_string(scan.stamp_ns) + " ns is not after the last one at " +
                                std::to_string(last_stamp_ns_) + " ns; start a new front end when time goes back");
  if (!scan.T_odom_sensor.matrix().allFinite())
    throw std::invalid_argument("the sensor pose of the scan at " + std::to_string(scan.stamp_ns) +
                                " ns is not finite");
  if (started_) path_m_ += (scan.T_odom_sensor.translation() - last_T_odom_sensor_.translation()).norm();
  started_ = true;
  last_stamp_ns_ = scan.stamp_ns;
  last_T_odom_sensor_ = scan.T_odom_sensor;
  ++sequence_;

  FrontEndStep step;
  StageTimer timer;

  GroundFilterResult filtered = ground_filter_.Filter(scan.points_sensor, scan.T_odom_sensor);
  timer.Lap("ground_filter");

  const VoxelUpdate left =
      grid_.RemoveOutside(scan.T_odom_sensor.translation(), parameters_.local_radius_m, OldestInsertion());
  timer.Lap("voxel_removal");
  if (normals_) {
    normals_->Remove(left.removed);
    timer.Lap("normal_removal");
  }
  SegmentUpdate left_segments = segmenter_->Remove(left.removed);
  trail_finder_.Follow(left_segments);
  timer.Lap("segment_removal");

  auto thinned_sensor = std::make_shared<const Points>(ThinScan(scan.points_sensor, parameters_.thinning));
  timer.Lap("scan_thinning");

  const SegmentUpdate trails = segmenter_->DismissTrails(
      trail_finder_.Look(scan.stamp_ns, *thinned_sensor, scan.T_odom_sensor, grid_, *segmenter_));
  trail_finder_.Follow(trails);
  left_segments.retired.insert(left_segments.retired.end(), trails.retired.begin(), trails.retired.end());
  timer.Lap("trail_search");

  const VoxelUpdate inserted = grid_.Insert(filtered.obstacles_sensor, scan.T_odom_sensor);
  timer.Lap("voxel_insertion");
  if (normals_) {
    normals_->Insert(inserted);
    timer.Lap("normals");
  }
  const SegmentUpdate grown_segments = segmenter_->Insert(inserted);
  trail_finder_.Add(inserted.activated, grid_);
  trail_finder_.Follow(grown_segments);
  timer.Lap("segmentation");

  step.delta = DescribeChanges(left_segments, grown_segments);
  ShowViews(VoxelsSeen(inserted), &step.delta);
  timer.Lap("description");

  step.delta.scan_sensor = std::move(thinned_sensor);

  step.times = timer.Take();
  step.counts.points = scan.points_sensor.size();
  step.counts.obstacle_points = filtered.obstacles_sensor.size();
  step.counts.dropped_nonfinite = filtered.dropped_nonfinite + inserted.dropped_nonfinite;
  step.counts.dropped_outside = inserted.dropped_outside;
  step.counts.voxels = grid_.active_voxels();
  step.counts.activated_voxels = inserted.activated.size();
  step.counts.moved_voxels = inserted.moved.size();
  step.counts.removed_voxels = left.removed.size();
  step.counts.clusters = segmenter_->counts();
  step.obstacles_sensor = std::move(filtered.obstacles_sensor);
  return step;
}

void FrontEnd::ApplyJump(const Pose& T_new_old) {
  grid_.Transform(T_new_old);
  last_T_odom_sensor_ = T_new_old * last_T_odom_sensor_;
  T_odom_continuous_ = T_new_old * T_odom_continuous_;
  for (auto& [segment, tracked] : tracked_) tracked.view_position_odom = T_new_old * tracked.view_position_odom;
  jumped_ = true;
}

/// Of the grid's insertions, the first that is no farther back than local_path_m. Counts the coming one in.
std::uint32_t FrontEnd::OldestInsertion() {
  if (!std::isfinite(parameters_.local_path_m)) return 0;
  while (!insertion_path_m_.empty() && path_m_ - insertion_path_m_.front() > parameters_.local_path_m)
    insertion_path_m_.pop_front();
  const std::uint32_t oldest = grid_.insertions() + 1 - static_cast<std::uint32_t>(insertion_path_m_.size());
  insertion_path_m_.push_back(path_m_);
  return oldest;
}

/// What both updates of a step did to segments, in the terms of the table in METHOD 3.
SegmentDelta FrontEnd::DescribeChanges(const SegmentUpdate& left, const SegmentUpdate& grown) {
  SegmentDelta delta = EmptyDelta();
  delta.retired = left.retired;
  delta.retired.insert(delta.retired.end(), grown.retired.begin(), grown.retired.end());
  delta.renamed = grown.renamed;
  for (const RetiredSegment& retired : delta.retired) tracked_.erase(retired.id);
  for (const RenamedSegment& renamed : delta.renamed) tracked_.erase(renamed.from);

  std::vector<SegmentId> changed;
  if (jumped_) {
    changed = segmenter_->Segments();
    jumped_ = false;
  } else {
    changed = grown.grown;
    changed.insert(changed.end(), grown.created.begin(), grown.created.end());
    std::sort(changed.begin(), changed.end());
  }
  delta.changed.reserve(changed.size());
  const Surroundings surroundings = AllSegments();
  for (const SegmentId segment : changed) {
    SegmentState state = DescribeSegment(segment, surroundings);
    state.new_view = IsNewView(state);
    delta.changed.push_back(std::move(state));
  }
  return delta;
}

/// What the context of a segment is made of.
Surroundings FrontEnd::AllSegments() const {
  Surroundings all;
  for (const SegmentId segment : segmenter_->Segments()) all.push_back(&segmenter_->Moments(segment));
  return all;
}

SegmentState FrontEnd::DescribeSegment(SegmentId segment, const Surroundings& surroundings) const {
  const SegmentMoments& moments = segmenter_->Moments(segment);
  SegmentState state;
  state.id = segment;
  state.size = static_cast<std::uint32_t>(moments.count());
  state.centroid_odom = grid_.T_odom_grid() * moments.Centroid();
  const Eigen::Vector3d up_grid = grid_.T_odom_grid().linear().transpose() * Eigen::Vector3d::UnitZ();
  state.descriptor = describer_.Describe(moments, up_grid, surroundings);
  return state;
}

bool FrontEnd::IsNewView(const SegmentState& state) {
  const Eigen::Vector3d position = last_T_odom_sensor_.translation();
  const auto [it, added] = tracked_.try_emplace(state.id);
  Tracked& tracked = it->second;
  const bool is_new = added || state.size >= parameters_.view.growth_factor * tracked.view_size ||
                      (position - tracked.view_position_odom).norm() >= parameters_.view.baseline_m;
  if (is_new) tracked = {state.size, position};
  return is_new;
}

/// New views show those of the voxels that belong to them, thinned.
void FrontEnd::ShowViews(const std::vector<VoxelHandle>& voxels, SegmentDelta* delta) const {
  const std::size_t most = parameters_.view.shown_points;
  if (most == 0) return;
  std::unordered_map<SegmentId, std::vector<VoxelHandle>> shown;
  for (const SegmentState& state : delta->changed)
    if (state.new_view) shown.emplace(state.id, std::vector<VoxelHandle>());
  if (shown.empty()) return;
  for (const VoxelHandle voxel : voxels) {
    const auto view = shown.find(segmenter_->SegmentOf(voxel));
    if (view != shown.end()) view->second.push_back(voxel);
  }
  for (SegmentState& state : delta->changed) {
    if (!state.new_view) continue;
    const std::vector<VoxelHandle>& seen = shown.at(state.id);
    auto points = std::make_shared<Points>();
    points->reserve(std::min(most, seen.size()));
    for (std::size_t i = 0; i < seen.size(); i += ShownStride(seen.size(), most))
      points->push_back((grid_.CentroidOdom(seen[i]) - state.centroid_odom).cast<float>());
    state.points_centroid = std::move(points);
  }
}

SegmentDelta FrontEnd::EmptyDelta() const {
  SegmentDelta delta;
  delta.robot = robot_;
  delta.sequence = sequence_;
  delta.stamp_ns = last_stamp_ns_;
  delta.T_odom_sensor = last_T_odom_sensor_;
  delta.T_odom_continuous = T_odom_continuous_;
  return delta;
}

SegmentDelta FrontEnd::FullState() const {
  SegmentDelta delta = EmptyDelta();
  delta.full_state = true;
  const Surroundings surroundings = AllSegments();
  for (const SegmentId segment : segmenter_->Segments()) {
    SegmentState state = DescribeSegment(segment, surroundings);
    state.new_view = true;
    delta.changed.push_back(std::move(state));
  }
  ShowViews(grid_.ActiveVoxels(), &delta);
  return delta;
}

std::vector<LocalPoint> FrontEnd::LocalCloud() const {
  std::vector<LocalPoint> cloud;
  cloud.reserve(grid_.active_voxels());
  for (const VoxelHandle voxel : grid_.ActiveVoxels())
    cloud.push_back({grid_.CentroidOdom(voxel).cast<float>(), segmenter_->SegmentOf(voxel)});
  return cloud;
}

std::size_t FrontEnd::memory_bytes() const {
  return grid_.memory_bytes() + segmenter_->memory_bytes() + trail_finder_.memory_bytes() +
         (normals_ ? normals_->memory_bytes() : 0);
}

}  // namespace incremental_segmatch
