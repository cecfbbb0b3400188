// Smoothness constraints: links satisfy the policy, rough points join without linking, and the partition is that of a
// slow segmenter that knows nothing but the rules.

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <map>
#include <random>
#include <set>
#include <string>
#include <vector>

#include "incremental_segmatch/incremental_segmenter.hpp"

namespace incremental_segmatch {
namespace {

/// The slow, obvious segmenter: looks at all pairs, and follows the rules of METHOD 3 to the letter.
class Reference {
 public:
  Reference(const DynamicVoxelGrid& grid, const SmoothnessPolicy& policy, double radius_m)
      : grid_(&grid), policy_(&policy), radius_m_(radius_m) {}

  void Remove(const std::vector<RemovedVoxel>& removed) {
    for (const RemovedVoxel& gone : removed) {
      member_of_.erase(gone.voxel);
      present_.erase(gone.voxel);
    }
  }
  void Insert(const std::vector<VoxelHandle>& activated) {
    present_.insert(activated.begin(), activated.end());
    std::vector<VoxelHandle> front;
    for (const VoxelHandle voxel : activated)
      if (policy_->CanPointBeSeed(voxel)) front.push_back(voxel);
    for (const VoxelHandle voxel : front) Add(voxel);
    std::set<VoxelHandle> rough(activated.begin(), activated.end());
    while (!front.empty()) {
      const VoxelHandle from = front.back();
      front.pop_back();
      for (const VoxelHandle to : present_) {
        if (to == from || !Near(from, to)) continue;
        if (!policy_->CanPointBeSeed(to)) {
          rough.insert(to);
        } else if (policy_->CanGrowToPoint(from, to)) {
          if (member_of_.count(to) == 0) {
            Add(to);
            front.push_back(to);
          }
          parents_[Find(member_of_.at(from))] = Find(member_of_.at(to));
          ++links_;
        }
      }
    }
    for (const VoxelHandle voxel : rough) {
      if (member_of_.count(voxel)) continue;
      std::pair<float, VoxelHandle> flattest{1e9f, 0};
      for (const auto& [from, member] : member_of_)
        if (Near(from, voxel) && policy_->CanPointBeSeed(from) && policy_->CanGrowToPoint(from, voxel))
          flattest = std::min(flattest, {policy_->Roughness(from), from});
      if (flattest.first == 1e9f) continue;
      member_of_[voxel] = Find(member_of_.at(flattest.second));
      ++joined_;
    }
  }
  /// Of the clustered voxels.
  std::map<VoxelHandle, int> Components() const {
    std::map<VoxelHandle, int> components;
    for (const auto& [voxel, member] : member_of_) components[voxel] = Find(member);
    return components;
  }
  const std::set<VoxelHandle>& present() const { return present_; }
  std::size_t links() const { return links_; }
  std::size_t joined() const { return joined_; }

 private:
  void Add(VoxelHandle voxel) {
    member_of_[voxel] = static_cast<int>(parents_.size());
    parents_.push_back(static_cast<int>(parents_.size()));
  }
  int Find(int member) const {
    while (parents_[member] != member) member = parents_[member];
    return member;
  }
  bool Near(VoxelHandle a, VoxelHandle b) const {
    return (grid_->CentroidGrid(a) - grid_->CentroidGrid(b)).norm() <= radius_m_;
  }

  const DynamicVoxelGrid* grid_;
  const SmoothnessPolicy* policy_;
  double radius_m_;
  std::set<VoxelHandle> present_;
  std::map<VoxelHandle, int> member_of_;
  std::vector<int> parents_;
  std::size_t links_ = 0, joined_ = 0;
};

/// Noisy planes of any direction around the sensor: walls that meet at edges.
Points RandomPlanes(std::mt19937* random) {
  std::uniform_real_distribution<double> unit(-1.0, 1.0);
  std::normal_distribution<double> noise(0.0, 0.015);
  Points points;
  const int planes = std::uniform_int_distribution<int>(1, 3)(*random);
  for (int plane = 0; plane < planes; ++plane) {
    const Eigen::Vector3d center(0.8 * unit(*random), 0.8 * unit(*random), 0.3 * unit(*random));
    const Eigen::Matrix3d frame(Eigen::AngleAxisd(3.14 * unit(*random), Eigen::Vector3d::UnitZ()) *
                                Eigen::AngleAxisd(1.57 * unit(*random), Eigen::Vector3d::UnitX()));
    const int count = std::uniform_int_distribution<int>(20, 150)(*random);
    for (int i = 0; i < count; ++i)
      points.push_back(
          (center + frame * Eigen::Vector3d(0.6 * unit(*random), 0.6 * unit(*random), noise(*random))).cast<float>());
  }
  return points;
}

TEST(SmoothnessSegmenter, EqualsTheRulesToTheLetter) {
  std::size_t links = 0, joined = 0, unclustered = 0;
  for (unsigned seed = 0; seed < 1000; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    std::mt19937 random(seed);
    DynamicVoxelGrid grid(DynamicVoxelGridParameters{});
    IncrementalNormals normals(NormalsParameters{}, grid);
    SmoothnessParameters smoothness;
    smoothness.max_angle_rad = std::uniform_real_distribution<double>(0.1, 0.6)(random);
    if (seed % 2) {
      smoothness.measure = RoughnessMeasure::kPlaneResidual;
      smoothness.max_residual_m = 0.02;
    }
    SmoothnessPolicy policy(smoothness, normals);
    SegmenterParameters parameters;
    parameters.growing_radius_m = std::uniform_real_distribution<double>(0.12, 0.3)(random);
    parameters.min_cluster_size = 5;
    parameters.max_cluster_size = 1000000;
    IncrementalSegmenter<SmoothnessPolicy> segmenter(parameters, grid, policy);
    Reference reference(grid, policy, parameters.growing_radius_m);
    for (int step = 0; step < 4; ++step) {
      const Eigen::Vector3d sensor(0.5 * step, 0.0, 0.0);
      const VoxelUpdate left = grid.RemoveOutside(sensor, 2.0);
      normals.Remove(left.removed);
      segmenter.Remove(left.removed);
      reference.Remove(left.removed);
      const VoxelUpdate inserted = grid.Insert(RandomPlanes(&random), Pose(Eigen::Translation3d(sensor)));
      normals.Insert(inserted);
      segmenter.Insert(inserted);
      reference.Insert(inserted.activated);

      const std::map<VoxelHandle, int> components = reference.Components();
      std::map<int, std::uint32_t> cluster_of_component;
      std::map<std::uint32_t, int> component_of_cluster;
      for (const VoxelHandle voxel : reference.present()) {
        const auto component = components.find(voxel);
        if (component == components.end()) {
          EXPECT_THROW(segmenter.ClusterOf(voxel), std::invalid_argument);
          ++unclustered;
          continue;
        }
        const std::uint32_t cluster = segmenter.ClusterOf(voxel);
        EXPECT_EQ(cluster_of_component.emplace(component->second, cluster).first->second, cluster);
        EXPECT_EQ(component_of_cluster.emplace(cluster, component->second).first->second, component->second);
      }
      EXPECT_EQ(segmenter.counts().clusters, cluster_of_component.size());
      if (HasFailure()) return;
    }
    links += reference.links();
    joined += reference.joined();
  }
  EXPECT_GT(links, 10000u);
  EXPECT_GT(joined, 500u);
  EXPECT_GT(unclustered, 500u);
}

TEST(SmoothnessSegmenter, WallsThatMeetAreTwoSegments) {
  std::mt19937 random(4);
  std::uniform_real_distribution<float> unit(0.f, 3.f);
  std::normal_distribution<float> noise(0.f, 0.01f);
  DynamicVoxelGrid grid(DynamicVoxelGridParameters{});
  IncrementalNormals normals(NormalsParameters{}, grid);
  SegmenterParameters parameters;
  IncrementalSegmenter<SmoothnessPolicy> smooth(parameters, grid, SmoothnessPolicy({}, normals));
  IncrementalSegmenter<EuclideanPolicy> euclidean(parameters, grid);
  for (int scan = 0; scan < 10; ++scan) {
    Points points;
    for (int i = 0; i < 3000; ++i) {
      points.emplace_back(unit(random), noise(random), unit(random));
      points.emplace_back(noise(random), unit(random), unit(random));
    }
    const VoxelUpdate update = grid.Insert(points, Pose::Identity());
    normals.Insert(update);
    smooth.Insert(update);
    euclidean.Insert(update);
  }
  EXPECT_EQ(euclidean.Segments().size(), 1u);
  EXPECT_EQ(smooth.Segments().size(), 2u);
}

TEST(SmoothnessPolicy, SeedsAreSortedByRoughness) {
  std::mt19937 random(9);
  DynamicVoxelGrid grid(DynamicVoxelGridParameters{});
  IncrementalNormals normals(NormalsParameters{}, grid);
  Points points;
  for (int i = 0; i < 5; ++i) {
    const Points planes = RandomPlanes(&random);
    points.insert(points.end(), planes.begin(), planes.end());
  }
  const VoxelUpdate update = grid.Insert(points, Pose::Identity());
  normals.Insert(update);
  for (const RoughnessMeasure measure : {RoughnessMeasure::kCurvature, RoughnessMeasure::kPlaneResidual}) {
    SmoothnessParameters parameters;
    parameters.measure = measure;
    SmoothnessPolicy policy(parameters, normals);
    std::vector<VoxelHandle> seeds = update.activated;
    policy.PrepareSeeds(&seeds);
    ASSERT_GT(seeds.size(), 10u);
    ASSERT_LT(seeds.size(), update.activated.size());
    for (std::size_t i = 0; i < seeds.size(); ++i) {
      EXPECT_TRUE(policy.CanPointBeSeed(seeds[i]));
      if (i > 0) {
        EXPECT_LE(policy.Roughness(seeds[i - 1]), policy.Roughness(seeds[i]));
      }
    }
    const auto may_seed = [&](VoxelHandle voxel) { return policy.CanPointBeSeed(voxel); };
    EXPECT_EQ(static_cast<std::size_t>(std::count_if(update.activated.begin(), update.activated.end(), may_seed)),
              seeds.size());
  }
}

TEST(SmoothnessPolicy, RefusesBadParametersByName) {
  DynamicVoxelGrid grid(DynamicVoxelGridParameters{});
  IncrementalNormals normals(NormalsParameters{}, grid);
  const auto message = [&](SmoothnessParameters parameters) -> std::string {
    try {
      SmoothnessPolicy(parameters, normals);
    } catch (const std::invalid_argument& error) {
      return error.what();
    }
    return "";
  };
  SmoothnessParameters parameters;
  parameters.max_angle_rad = 2.0;
  EXPECT_NE(message(parameters).find("max_angle_rad"), std::string::npos);
  parameters = {};
  parameters.max_curvature = 0.0;
  EXPECT_NE(message(parameters).find("max_curvature"), std::string::npos);
  parameters = {};
  parameters.measure = RoughnessMeasure::kPlaneResidual;
  parameters.max_residual_m = -1.0;
  EXPECT_NE(message(parameters).find("max_residual_m"), std::string::npos);
}

}  // namespace
}  // namespace incremental_segmatch
