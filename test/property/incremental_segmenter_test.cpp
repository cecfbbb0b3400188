// Contracts 3 and 4 of the segmenter: clusters are connected components over all voxels ever clustered, and IDs follow
// the rules of METHOD 3 whatever happens.

#include "incremental_segmatch/incremental_segmenter.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <map>
#include <random>
#include <set>
#include <vector>

namespace incremental_segmatch {
namespace {

/// The slow, obvious segmenter: remembers every voxel that was ever clustered and every pair that was joined.
class Reference {
 public:
  Reference(const SegmenterParameters& parameters, const DynamicVoxelGrid& grid)
      : parameters_(parameters), grid_(&grid) {}

  void Remove(const std::vector<RemovedVoxel>& removed) {
    for (const RemovedVoxel& voxel : removed) {
      const int gone = by_handle_.at(voxel.voxel);
      by_handle_.erase(voxel.voxel);
      members_[gone].alive = false;
      if (parameters_.boundary == BoundaryPolicy::kInvalidate) cut_.insert(gone);
    }
  }
  void Insert(const std::vector<VoxelHandle>& activated) {
    for (const VoxelHandle voxel : activated) {
      by_handle_[voxel] = static_cast<int>(members_.size());
      members_.push_back({static_cast<int>(members_.size()), true});
    }
    for (const VoxelHandle voxel : activated)
      for (const auto& [other, index] : by_handle_)
        if (other != voxel &&
            (grid_->CentroidGrid(other) - grid_->CentroidGrid(voxel)).norm() <= parameters_.growing_radius_m)
          Join(by_handle_.at(voxel), index);
  }
  int Component(VoxelHandle voxel) const { return Find(by_handle_.at(voxel)); }
  const std::map<VoxelHandle, int>& by_handle() const { return by_handle_; }

  /// Sizes of the components that have a voxel in the local map: all voxels ever, or those there now.
  std::map<int, std::size_t> Sizes() const {
    std::map<int, std::size_t> sizes;
    std::set<int> alive;
    for (const auto& [voxel, index] : by_handle_) alive.insert(Find(index));
    for (std::size_t i = 0; i < members_.size(); ++i) {
      const int root = Find(static_cast<int>(i));
      if (alive.count(root) && (members_[i].alive || parameters_.boundary == BoundaryPolicy::kKeep)) ++sizes[root];
    }
    return sizes;
  }
  bool IsCut(int root) const {
    return std::any_of(cut_.begin(), cut_.end(), [&](int index) { return Find(index) == root; });
  }
  void Dismiss(VoxelHandle voxel) { dismissed_.insert(by_handle_.at(voxel)); }
  bool IsTrail(int root) const {
    return std::any_of(dismissed_.begin(), dismissed_.end(), [&](int index) { return Find(index) == root; });
  }

 private:
  struct Member {
    int parent;
    bool alive;
  };
  int Find(int index) const {
    while (members_[index].parent != index) index = members_[index].parent;
    return index;
  }
  void Join(int a, int b) { members_[Find(a)].parent = Find(b); }

  SegmenterParameters parameters_;
  const DynamicVoxelGrid* grid_;
  std::vector<Member> members_;
  std::map<VoxelHandle, int> by_handle_;
  std::set<int> cut_, dismissed_;
};

/// What a consumer of the events knows.
class Ledger {
 public:
  void Apply(const SegmentUpdate& update) {
    for (const RenamedSegment& renamed : update.renamed) {
      EXPECT_LT(renamed.to, renamed.from) << "a merge keeps the older ID";
      EXPECT_TRUE(live_.erase(renamed.from));
      EXPECT_TRUE(live_.count(renamed.to));
    }
    for (const RetiredSegment& retired : update.retired) EXPECT_TRUE(live_.erase(retired.id));
    for (const SegmentId created : update.created) {
      EXPECT_NE(created, kNoSegment);
      EXPECT_TRUE(ever_.insert(created).second) << "ID " << created << " was used before";
      live_.insert(created);
    }
    for (const SegmentId grown : update.grown) EXPECT_TRUE(live_.count(grown));
  }
  const std::set<SegmentId>& live() const { return live_; }

 private:
  std::set<SegmentId> live_, ever_;
};

void ExpectAgreement(const DynamicVoxelGrid& grid, const IncrementalSegmenter<EuclideanPolicy>& segmenter,
                     const Reference& reference, const SegmenterParameters& parameters, const Ledger& ledger) {
  // Same partition, up to names.
  std::map<int, std::uint32_t> cluster_of_component;
  std::map<std::uint32_t, int> component_of_cluster;
  std::map<int, SegmentId> segment_of_component;
  std::map<int, std::vector<VoxelHandle>> members;
  for (const auto& [voxel, index] : reference.by_handle()) {
    const int component = reference.Component(voxel);
    const std::uint32_t cluster = segmenter.ClusterOf(voxel);
    EXPECT_EQ(cluster_of_component.emplace(component, cluster).first->second, cluster);
    EXPECT_EQ(component_of_cluster.emplace(cluster, component).first->second, component);
    EXPECT_EQ(segment_of_component.emplace(component, segmenter.SegmentOf(voxel)).first->second,
              segmenter.SegmentOf(voxel));
    members[component].push_back(voxel);
  }
  EXPECT_EQ(segmenter.counts().clusters, cluster_of_component.size());

  std::set<SegmentId> segments;
  std::map<int, std::size_t> sizes = reference.Sizes();
  for (const auto& [component, segment] : segment_of_component) {
    const std::size_t size = sizes.at(component);
    if (size < parameters.min_cluster_size || size > parameters.max_cluster_size || reference.IsCut(component)) {
      const bool grows_only =
          parameters.boundary == BoundaryPolicy::kKeep;  // else it may have shrunk below the minimum
      if (grows_only || reference.IsCut(component) || size > parameters.max_cluster_size) {
        EXPECT_EQ(segment, kNoSegment);
      }
      continue;
    }
    if (segment == kNoSegment) continue;  // was too large once (kInvalidate shrinks)
    EXPECT_TRUE(segments.insert(segment).second) << "two clusters have one segment ID";
    EXPECT_EQ(segmenter.Moments(segment).count(), size);
    const std::vector<VoxelHandle>& voxels = members.at(component);
    if (size != voxels.size()) continue;  // its moments include voxels that left
    Eigen::Vector3d mean = Eigen::Vector3d::Zero();
    for (const VoxelHandle voxel : voxels) mean += grid.CentroidGrid(voxel) / static_cast<double>(voxels.size());
    Eigen::Matrix3d covariance = Eigen::Matrix3d::Zero();
    for (const VoxelHandle voxel : voxels) {
      const Eigen::Vector3d p = grid.CentroidGrid(voxel) - mean;
      covariance += p * p.transpose() / static_cast<double>(voxels.size());
    }
    EXPECT_LT((segmenter.Moments(segment).Centroid() - mean).norm(), 1e-9);
    EXPECT_LT((segmenter.Moments(segment).Covariance() - covariance).norm(), 1e-9);
  }
  const std::vector<SegmentId> tracked = segmenter.Segments();
  EXPECT_EQ(std::set<SegmentId>(tracked.begin(), tracked.end()), ledger.live());
  EXPECT_EQ(segments, ledger.live());
  EXPECT_EQ(segmenter.counts().segments, segments.size());
}

VoxelHandle AnyVoxel(const Reference& reference, const IncrementalSegmenter<EuclideanPolicy>& segmenter,
                     SegmentId segment) {
  const auto found = std::find_if(reference.by_handle().begin(), reference.by_handle().end(),
                                  [&](const auto& entry) { return segmenter.SegmentOf(entry.first) == segment; });
  return found->first;
}

class SegmenterSequences : public ::testing::TestWithParam<BoundaryPolicy> {};

TEST_P(SegmenterSequences, ClustersAreComponentsAndIdsFollowTheRules) {
  std::size_t renamings = 0, retirements = 0, too_large = 0, trails = 0;
  for (unsigned seed = 0; seed < 1000; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    std::mt19937 random(seed);
    DynamicVoxelGridParameters grid_parameters;
    grid_parameters.min_points_per_voxel = 1 + static_cast<int>(seed % 2);
    SegmenterParameters parameters;
    parameters.boundary = GetParam();
    parameters.growing_radius_m = std::uniform_real_distribution<double>(0.15, 0.35)(random);
    parameters.min_cluster_size = 5;
    parameters.max_cluster_size = 60;
    DynamicVoxelGrid grid(grid_parameters);
    IncrementalSegmenter<EuclideanPolicy> segmenter(parameters, grid);
    Reference reference(parameters, grid);
    Ledger ledger;
    std::uniform_real_distribution<double> unit(-1.0, 1.0);
    double x = 0.0;
    for (int step = 0; step < 12; ++step) {
      x += 0.4;  // the sensor moves on, objects enter and leave
      const VoxelUpdate left = grid.RemoveOutside({x, 0.0, 0.0}, 2.0);
      reference.Remove(left.removed);
      const SegmentUpdate removal = segmenter.Remove(left.removed);
      ledger.Apply(removal);
      std::vector<SegmentId> dismissed;
      for (const SegmentId segment : segmenter.Segments())
        if (seed % 4 == 3 && random() % 2 == 0) dismissed.push_back(segment);
      for (const SegmentId segment : dismissed) reference.Dismiss(AnyVoxel(reference, segmenter, segment));
      const SegmentUpdate dismissal = segmenter.DismissTrails(dismissed);
      EXPECT_EQ(dismissal.retired.size(), dismissed.size());
      ledger.Apply(dismissal);
      trails += dismissed.size();

      Points points;
      const int objects = std::uniform_int_distribution<int>(0, 5)(random);
      for (int object = 0; object < objects; ++object) {
        const Eigen::Vector3d center(x + 1.8 * unit(random), 0.8 * unit(random), 0.3 * unit(random));
        const int count = std::uniform_int_distribution<int>(1, 30)(random);
        for (int i = 0; i < count; ++i)
          points.push_back((center + 0.25 * Eigen::Vector3d(unit(random), unit(random), unit(random))).cast<float>());
      }
      const VoxelUpdate inserted = grid.Insert(points, Pose::Identity());
      reference.Insert(inserted.activated);
      const SegmentUpdate growth = segmenter.Insert(inserted);
      ledger.Apply(growth);
      for (const SegmentId created : growth.created)
        EXPECT_FALSE(reference.IsTrail(reference.Component(AnyVoxel(reference, segmenter, created))))
            << "a trail became a segment by itself";

      renamings += growth.renamed.size();
      for (const SegmentUpdate* update : {&removal, &growth})
        for (const RetiredSegment& retired : update->retired) {
          ++retirements;
          too_large += retired.cause == RetirementCause::kTooLarge;
        }
      ExpectAgreement(grid, segmenter, reference, parameters, ledger);
      if (HasFailure()) return;
    }
  }
  EXPECT_GT(renamings, 50u) << "the sequences should exercise merging";
  EXPECT_GT(retirements, 200u);
  EXPECT_GT(too_large, 10u);
  EXPECT_GT(trails, 50u);
}

INSTANTIATE_TEST_SUITE_P(BothBoundaries, SegmenterSequences,
                         ::testing::Values(BoundaryPolicy::kInvalidate, BoundaryPolicy::kKeep));

TEST(IncrementalSegmenter, LabelsAreReclaimed) {
  DynamicVoxelGrid grid(DynamicVoxelGridParameters{});
  SegmenterParameters parameters;
  parameters.min_cluster_size = 5;
  IncrementalSegmenter<EuclideanPolicy> segmenter(parameters, grid);
  std::mt19937 random(3);
  std::uniform_real_distribution<float> unit(-1.f, 1.f);
  std::size_t bytes_early = 0;
  for (int step = 0; step < 2000; ++step) {
    const double x = 0.5 * step;
    segmenter.Remove(grid.RemoveOutside({x, 0, 0}, 5.0).removed);
    Points points;
    for (int i = 0; i < 200; ++i) points.emplace_back(5.f * unit(random), 5.f * unit(random), unit(random));
    segmenter.Insert(grid.Insert(points, Pose(Eigen::Translation3d(x, 0, 0))));
    if (step == 400) bytes_early = segmenter.memory_bytes() + grid.memory_bytes();
  }
  EXPECT_LT(segmenter.memory_bytes() + grid.memory_bytes(), 1.2 * bytes_early);
}

/// Tiny scans at 10 Hz for a day: labels, clusters and IDs come and go, and what is held stays what it was after
/// minutes.
TEST(IncrementalSegmenter, ADayLongRunHoldsNoMoreThanAShortOne) {
  constexpr int kStepsADay = 864000;
  DynamicVoxelGrid grid(DynamicVoxelGridParameters{});
  SegmenterParameters parameters;
  parameters.min_cluster_size = 2;
  IncrementalSegmenter<EuclideanPolicy> segmenter(parameters, grid);
  std::mt19937 random(4);
  const auto unit = [&] { return static_cast<float>(random() % 1000) * 1e-3f; };
  std::size_t bytes_early = 0;
  for (int step = 0; step < kStepsADay; ++step) {
    const double x = 0.1 * step;
    if (step % 4 == 0) segmenter.Remove(grid.RemoveOutside({x, 0, 0}, 2.0).removed);
    const Points points{{unit(), unit(), 0.f}, {unit(), unit(), 0.f}, {unit(), unit(), 0.f}};
    segmenter.Insert(grid.Insert(points, Pose(Eigen::Translation3d(x, 0, 0))));
    if (step == kStepsADay / 100) bytes_early = segmenter.memory_bytes() + grid.memory_bytes();
  }
  EXPECT_LT(segmenter.memory_bytes() + grid.memory_bytes(), 1.2 * bytes_early);
}

TEST(IncrementalSegmenter, MergedSegmentsKeepTheOlderIdInEveryOrder) {
  // Two segments, then a bridge: one renaming, from the newer to the older.
  DynamicVoxelGrid grid(DynamicVoxelGridParameters{});
  SegmenterParameters parameters;
  parameters.min_cluster_size = 3;
  IncrementalSegmenter<EuclideanPolicy> segmenter(parameters, grid);
  const auto insert = [&](float from_x, int count) {
    Points points;
    for (int i = 0; i < count; ++i) points.emplace_back(from_x + 0.1f * static_cast<float>(i) + 0.05f, 0.05f, 0.05f);
    return segmenter.Insert(grid.Insert(points, Pose::Identity()));
  };
  EXPECT_EQ(insert(0.f, 4).created, std::vector<SegmentId>{1});
  EXPECT_EQ(insert(1.f, 8).created, std::vector<SegmentId>{2});
  const SegmentUpdate bridge = insert(0.4f, 6);
  ASSERT_EQ(bridge.renamed.size(), 1u);
  EXPECT_EQ(bridge.renamed[0].from, 2u);
  EXPECT_EQ(bridge.renamed[0].to, 1u);
  EXPECT_EQ(segmenter.Moments(1).count(), 18u);
}

}  // namespace
}  // namespace incremental_segmatch
