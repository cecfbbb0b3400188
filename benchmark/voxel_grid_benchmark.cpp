// The voxel grid's step, removal and insertion: ours, the thesis's sorted vector, and pcl::VoxelGrid over local cloud and new points.

#include "drive.hpp"
#include "incremental_segmatch/batch_baseline.hpp"
#include "incremental_segmatch/dynamic_voxel_grid.hpp"
#include "sorted_vector_grid.hpp"

namespace incremental_segmatch::bench {
namespace {

struct IncrementalMap {
  DynamicVoxelGrid grid;
  double local_radius_m;

  double Step(const DriveScan& scan) {
    return Seconds([&] {
      benchmark::DoNotOptimize(grid.RemoveOutside(scan.T_odom_sensor.translation(), local_radius_m));
      benchmark::DoNotOptimize(grid.Insert(scan.obstacles_sensor, scan.T_odom_sensor));
    });
  }
  void Count(benchmark::State& state) const {
    state.counters["voxels"] = static_cast<double>(grid.active_voxels());
    state.counters["bytes_per_voxel"] = static_cast<double>(grid.memory_bytes()) / static_cast<double>(grid.active_voxels());
  }
};

struct SortedMap {
  SortedVectorGrid grid;
  double local_radius_m;

  double Step(const DriveScan& scan) {
    return Seconds([&] {
      grid.RemoveOutside(scan.T_odom_sensor.translation(), local_radius_m);
      benchmark::DoNotOptimize(grid.Insert(scan.obstacles_sensor, scan.T_odom_sensor));
    });
  }
  void Count(benchmark::State& state) const { state.counters["voxels"] = static_cast<double>(grid.size()); }
};

struct BatchMap {
  BatchBaseline batch;

  double Step(const DriveScan& scan) {
    return Seconds([&] { batch.UpdateLocalCloud(scan.obstacles_sensor, scan.T_odom_sensor); });
  }
  void Count(benchmark::State& state) const { state.counters["voxels"] = static_cast<double>(batch.size()); }
};

void RegisterIncremental(const DriveSetup& setup) {
  RegisterStage("voxel_grid", "incremental", setup, setup.measured_scans, [](benchmark::State& state, const DriveSetup& s) {
    IncrementalMap map{DynamicVoxelGrid(DynamicVoxelGridParameters{}), s.local_radius_m};
    MeasureSteps(state, s, map);
  });
}

void Register() {
  RegisterIncremental(GrowingSetup());
  for (const DriveSetup& setup : Setups()) {
    RegisterIncremental(setup);
    RegisterStage("voxel_grid", "sorted_vector", setup, setup.measured_scans, [](benchmark::State& state, const DriveSetup& s) {
      SortedMap map{SortedVectorGrid(DynamicVoxelGridParameters{}.resolution_m), s.local_radius_m};
      MeasureSteps(state, s, map);
    });
    RegisterStage("voxel_grid", "pcl", setup, setup.measured_scans, [](benchmark::State& state, const DriveSetup& s) {
      BatchBaselineParameters parameters;
      parameters.local_radius_m = s.local_radius_m;
      BatchMap map{BatchBaseline(parameters)};
      MeasureSteps(state, s, map);
    });
  }
}

}  // namespace
}  // namespace incremental_segmatch::bench

int main(int argc, char** argv) {
  incremental_segmatch::bench::Register();
  benchmark::Initialize(&argc, argv);
  benchmark::RunSpecifiedBenchmarks();
}
