// Normals: ours with those that a segmenter reads, or all, brought up to date; and pcl::NormalEstimation with its tree and without.

#include "local_map.hpp"

namespace incremental_segmatch::bench {
namespace {

/// Which normals are read after each step.
enum class Reader { kSegmenter, kAll };

class NormalsMap : public GridMap {
 public:
  NormalsMap(const DriveSetup& setup, Reader reader)
      : GridMap(setup),
        reader_(reader),
        normals_(NormalsParameters{}, grid_),
        stencil_(SegmenterParameters{}.growing_radius_m, grid_.parameters().resolution_m) {}

  void Count(benchmark::State& state) const override {
    GridMap::Count(state);
    state.counters["bytes_per_voxel"] = static_cast<double>(normals_.memory_bytes()) / static_cast<double>(grid_.active_voxels());
    state.counters["read"] = static_cast<double>(read_);
  }

 private:
  double Remove(const VoxelUpdate& update) override {
    return Seconds([&] { normals_.Remove(update.removed); });
  }
  double Insert(const VoxelUpdate& update) override {
    const std::vector<VoxelHandle> voxels =
        reader_ == Reader::kAll ? grid_.ActiveVoxels() : VoxelsThatASegmenterReads(grid_, stencil_, update.activated);
    read_ = voxels.size();
    return Seconds([&] {
      normals_.Insert(update);
      for (const VoxelHandle voxel : voxels) benchmark::DoNotOptimize(normals_.Estimate(voxel));
    });
  }

  Reader reader_;
  IncrementalNormals normals_;
  NeighbourStencil stencil_;
  std::size_t read_ = 0;
};

void Register() {
  for (const DriveSetup& setup : Setups()) {
    RegisterStage("normals", "incremental", setup, setup.measured_scans, [](benchmark::State& state, const DriveSetup& s) {
      NormalsMap map(s, Reader::kSegmenter);
      MeasureSteps(state, s, map);
    });
    RegisterStage("normals", "incremental_all", setup, setup.measured_scans, [](benchmark::State& state, const DriveSetup& s) {
      NormalsMap map(s, Reader::kAll);
      MeasureSteps(state, s, map);
    });
    RegisterBatch("normals", "pcl_tree_shared", setup, [](BatchBaseline& batch) {
      batch.BuildTree();
      return Seconds([&] { batch.EstimateNormals(); });
    });
    RegisterBatch("normals", "pcl", setup, [](BatchBaseline& batch) {
      return Seconds([&] {
        batch.BuildTree();
        batch.EstimateNormals();
      });
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
