// Segmentation: ours, incremental region growing on a k-d tree that is rebuilt every step (the thesis), and PCL's batch; Euclidean and
// with smoothness constraints.

#include <flann/flann.hpp>

#include <map>
#include <utility>

#include "local_map.hpp"

namespace incremental_segmatch::bench {
namespace {

class EuclideanMap : public GridMap {
 public:
  explicit EuclideanMap(const DriveSetup& setup) : GridMap(setup), segmenter_(SegmenterParameters{}, grid_) {}

  void Count(benchmark::State& state) const override {
    GridMap::Count(state);
    state.counters["segments"] = static_cast<double>(segmenter_.counts().segments);
  }

 private:
  double Remove(const VoxelUpdate& update) override {
    return Seconds([&] { benchmark::DoNotOptimize(segmenter_.Remove(update.removed)); });
  }
  double Insert(const VoxelUpdate& update) override {
    return Seconds([&] { benchmark::DoNotOptimize(segmenter_.Insert(update)); });
  }

  IncrementalSegmenter<EuclideanPolicy> segmenter_;
};

/// Algorithm 1 on a k-d tree of the local cloud, as the thesis has it: only new points seed, the tree is built anew in every step.
/// Without segment tracking, moments and events: less work than ours.
class RebuiltTreeMap : public GridMap {
 public:
  using GridMap::GridMap;

 private:
  double Insert(const VoxelUpdate& update) override {
    const Points cloud = LocalCloud();  // in the order of ActiveVoxels
    const std::vector<VoxelHandle> voxels = grid_.ActiveVoxels();
    position_.resize(grid_.handle_capacity());
    cluster_.resize(grid_.handle_capacity());
    for (std::size_t i = 0; i < voxels.size(); ++i) position_[voxels[i]] = i;
    for (const VoxelHandle voxel : update.activated) cluster_[voxel] = 0;
    return Seconds([&] {
      const flann::Matrix<float> points(const_cast<float*>(cloud.front().data()), cloud.size(), 3);
      flann::KDTreeSingleIndex<flann::L2_Simple<float>> tree(points, flann::KDTreeSingleIndexParams(15));
      tree.buildIndex();
      for (const VoxelHandle seed : update.activated)
        if (cluster_[seed] == 0) Grow(seed, voxels, points, tree);
    });
  }

  template <class Tree>
  void Grow(VoxelHandle seed, const std::vector<VoxelHandle>& voxels, const flann::Matrix<float>& points, const Tree& tree) {
    const float radius2 = static_cast<float>(SegmenterParameters{}.growing_radius_m * SegmenterParameters{}.growing_radius_m);
    flann::SearchParams search(-1, 0.f, false);
    std::vector<std::vector<std::size_t>> indices;
    std::vector<std::vector<float>> distances;
    const std::uint32_t cluster = static_cast<std::uint32_t>(parents_.size());
    parents_.push_back(cluster);
    cluster_[seed] = cluster;
    queue_.assign(1, seed);
    while (!queue_.empty()) {
      const flann::Matrix<float> query(points[position_[queue_.back()]], 1, 3);
      queue_.pop_back();
      tree.radiusSearch(query, indices, distances, radius2, search);
      for (const std::size_t index : indices[0]) {
        const VoxelHandle to = voxels[index];
        if (cluster_[to] == 0) {
          cluster_[to] = cluster;
          queue_.push_back(to);
        } else {
          parents_[Find(cluster_[to])] = Find(cluster);
        }
      }
    }
  }
  std::uint32_t Find(std::uint32_t cluster) {
    while (parents_[cluster] != cluster) cluster = parents_[cluster] = parents_[parents_[cluster]];
    return cluster;
  }

  std::vector<std::size_t> position_;
  std::vector<std::uint32_t> cluster_;
  std::vector<std::uint32_t> parents_{0};
  std::vector<VoxelHandle> queue_;
};

/// Normals are brought up to date before the clock starts: they are a stage of their own.
class SmoothMap : public GridMap {
 public:
  explicit SmoothMap(const DriveSetup& setup)
      : GridMap(setup),
        normals_(NormalsParameters{}, grid_),
        segmenter_(SegmenterParameters{}, grid_, SmoothnessPolicy(SmoothnessParameters{}, normals_)),
        stencil_(SegmenterParameters{}.growing_radius_m, grid_.parameters().resolution_m) {}

  void Count(benchmark::State& state) const override {
    GridMap::Count(state);
    state.counters["segments"] = static_cast<double>(segmenter_.counts().segments);
    state.counters["rand_index_with_pcl"] = AgreementWithPcl();
  }

 private:
  double Remove(const VoxelUpdate& update) override {
    normals_.Remove(update.removed);
    return Seconds([&] { benchmark::DoNotOptimize(segmenter_.Remove(update.removed)); });
  }
  double Insert(const VoxelUpdate& update) override {
    normals_.Insert(update);
    for (const VoxelHandle voxel : VoxelsThatASegmenterReads(grid_, stencil_, update.activated))
      benchmark::DoNotOptimize(normals_.Estimate(voxel));
    return Seconds([&] { benchmark::DoNotOptimize(segmenter_.Insert(update)); });
  }

  /// Adjusted Rand index over the voxels that are in a segment of both: 1 for the same partition, 0 for chance.
  double AgreementWithPcl() const {
    BatchBaselineParameters parameters;
    BatchBaseline batch(parameters);
    batch.SetLocalCloud(LocalCloud(), Eigen::Vector3d::Zero());
    batch.EstimateNormals();
    const std::vector<VoxelHandle> voxels = grid_.ActiveVoxels();
    std::map<std::pair<SegmentId, std::size_t>, double> both;
    std::map<SegmentId, double> ours;
    std::map<std::size_t, double> theirs;
    double total = 0.0;
    const BatchClusters clusters = batch.GrowSmoothRegions();
    for (std::size_t c = 0; c < clusters.size(); ++c)
      for (const std::int32_t index : clusters[c]) {
        const SegmentId segment = segmenter_.SegmentOf(voxels[static_cast<std::size_t>(index)]);
        if (segment == kNoSegment) continue;
        ++both[{segment, c}];
        ++ours[segment];
        ++theirs[c];
        ++total;
      }
    const auto pairs = [](const auto& table) {
      double sum = 0.0;
      for (const auto& entry : table) sum += entry.second * (entry.second - 1.0) / 2.0;
      return sum;
    };
    const double chance = pairs(ours) * pairs(theirs) / (total * (total - 1.0) / 2.0);
    return (pairs(both) - chance) / (0.5 * (pairs(ours) + pairs(theirs)) - chance);
  }

  IncrementalNormals normals_;
  IncrementalSegmenter<SmoothnessPolicy> segmenter_;
  NeighbourStencil stencil_;
};

template <class Map>
void Run(benchmark::State& state, const DriveSetup& setup) {
  Map map(setup);
  MeasureSteps(state, setup, map);
}

void Register() {
  const DriveSetup growing = GrowingSetup();
  RegisterStage("euclidean", "incremental", growing, growing.measured_scans, Run<EuclideanMap>);
  for (const DriveSetup& setup : Setups()) {
    RegisterStage("euclidean", "incremental", setup, setup.measured_scans, Run<EuclideanMap>);
    RegisterStage("euclidean", "rebuilt_tree", setup, setup.measured_scans, Run<RebuiltTreeMap>);
    RegisterBatch("euclidean", "pcl_tree_shared", setup, [](BatchBaseline& batch) {
      batch.BuildTree();
      return Seconds([&] { benchmark::DoNotOptimize(batch.ClusterEuclidean()); });
    });
    RegisterBatch("euclidean", "pcl", setup, [](BatchBaseline& batch) {
      return Seconds([&] {
        batch.BuildTree();
        benchmark::DoNotOptimize(batch.ClusterEuclidean());
      });
    });
    RegisterStage("smoothness", "incremental", setup, setup.measured_scans, Run<SmoothMap>);
    RegisterBatch("smoothness", "pcl_tree_shared", setup, [](BatchBaseline& batch) {
      batch.EstimateNormals();
      return Seconds([&] { benchmark::DoNotOptimize(batch.GrowSmoothRegions()); });
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
