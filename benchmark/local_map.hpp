/// \file
/// The incremental stages together, and the batch baseline on the same local cloud.
#pragma once

#include <memory>
#include <utility>
#include <vector>

#include "drive.hpp"
#include "incremental_segmatch/batch_baseline.hpp"
#include "incremental_segmatch/incremental_normals.hpp"
#include "incremental_segmatch/incremental_segmenter.hpp"

namespace incremental_segmatch::bench {

/// Runs the grid; the stages behind it are a subclass's.
class GridMap {
 public:
  explicit GridMap(const DriveSetup& setup) : setup_(setup), grid_(DynamicVoxelGridParameters{}) {}
  GridMap(const GridMap&) = delete;
  virtual ~GridMap() = default;

  /// Returns the seconds that the stages behind the grid took.
  double Step(const DriveScan& scan) {
    const VoxelUpdate left = grid_.RemoveOutside(scan.T_odom_sensor.translation(), setup_.local_radius_m);
    const double removal_s = Remove(left);
    const VoxelUpdate inserted = grid_.Insert(scan.obstacles_sensor, scan.T_odom_sensor);
    return removal_s + Insert(inserted);
  }
  virtual void Count(benchmark::State& state) const { state.counters["voxels"] = static_cast<double>(grid_.active_voxels()); }

 protected:
  virtual double Remove(const VoxelUpdate&) { return 0.0; }
  virtual double Insert(const VoxelUpdate&) { return 0.0; }

  Points LocalCloud() const {
    Points points;
    points.reserve(grid_.active_voxels());
    for (const VoxelHandle voxel : grid_.ActiveVoxels()) points.push_back(grid_.CentroidOdom(voxel).cast<float>());
    return points;
  }

  DriveSetup setup_;
  DynamicVoxelGrid grid_;
};

/// A batch stage over the grid's local cloud. `stage(batch)` returns the seconds that count.
template <class Stage>
class BatchOnGrid : public GridMap {
 public:
  BatchOnGrid(const DriveSetup& setup, Stage stage) : GridMap(setup), batch_(Parameters(setup)), stage_(std::move(stage)) {}

  double Measure(const DriveScan& scan) {
    batch_.SetLocalCloud(LocalCloud(), scan.T_odom_sensor.translation());
    return stage_(batch_);
  }

 private:
  static BatchBaselineParameters Parameters(const DriveSetup& setup) {
    BatchBaselineParameters parameters;
    parameters.local_radius_m = setup.local_radius_m;
    parameters.normal_radius_m = NormalsParameters{}.radius_m;
    return parameters;
  }

  BatchBaseline batch_;
  Stage stage_;
};

/// Registers a batch stage.
template <class Stage>
void RegisterBatch(const std::string& stage_name, const std::string& method, const DriveSetup& setup, Stage stage) {
  RegisterStage(stage_name, method, setup, setup.measured_scans / setup.batch_every,
                [stage](benchmark::State& state, const DriveSetup& s) {
                  BatchOnGrid<Stage> map(s, stage);
                  MeasureBatch(state, s, map);
                });
}

/// Active voxels that were activated, and those within the growing radius of one: whose normals a segmenter reads in a step.
inline std::vector<VoxelHandle> VoxelsThatASegmenterReads(const DynamicVoxelGrid& grid, const NeighbourStencil& stencil,
                                                          const std::vector<VoxelHandle>& activated) {
  std::vector<VoxelHandle> voxels = activated;
  for (const VoxelHandle voxel : activated)
    grid.ForEachNeighbour(stencil, voxel, [&](VoxelHandle neighbour, const Eigen::Vector3f&) {
      voxels.push_back(neighbour);
      return true;
    });
  std::sort(voxels.begin(), voxels.end());
  voxels.erase(std::unique(voxels.begin(), voxels.end()), voxels.end());
  return voxels;
}

}  // namespace incremental_segmatch::bench
