// Incremental normals on a simulated scan, anywhere in the world, against PCL's at the origin: PCL itself, and any cloud of floats
// out there, is quantised to millimetres.
#include <gtest/gtest.h>

#include <array>
#include <cmath>
#include <map>
#include <vector>

#include "incremental_segmatch/batch_baseline.hpp"
#include "incremental_segmatch/incremental_normals.hpp"
#include "simulator/simulation.hpp"

namespace incremental_segmatch {
namespace {

Points OneScan() {
  simulator::SimulationOptions options;
  options.sensor = "HDL-64E";
  options.route = "lap";
  options.max_scans = 1;
  Points near;
  for (const Eigen::Vector3f& p : simulator::Simulation(options).Scan(0))
    if (p.allFinite() && p.head<2>().norm() < 30.f && p.z() > -1.f) near.push_back(p);
  return near;
}

using Cell = std::array<long, 3>;

Cell CellOf(const Eigen::Vector3d& p, double side_m) {
  return {std::lround(std::floor(p.x() / side_m)), std::lround(std::floor(p.y() / side_m)),
          std::lround(std::floor(p.z() / side_m))};
}

TEST(IncrementalNormals, AreThoseOfPclAtTheOriginAnywhereInTheWorld) {
  const Points scan = OneScan();
  ASSERT_GT(scan.size(), 10000u);
  const NormalsParameters parameters;
  const DynamicVoxelGridParameters grid_parameters;

  DynamicVoxelGrid origin(grid_parameters);
  origin.Insert(scan, Pose::Identity());
  Points cloud;
  std::map<Cell, std::size_t> index_of;
  for (const VoxelHandle voxel : origin.ActiveVoxels()) {
    index_of.emplace(CellOf(origin.CentroidGrid(voxel), grid_parameters.resolution_m), cloud.size());
    cloud.push_back(origin.CentroidOdom(voxel).cast<float>());
  }
  BatchBaselineParameters batch_parameters;
  batch_parameters.normal_radius_m = parameters.radius_m;
  BatchBaseline pcl(batch_parameters);
  pcl.SetLocalCloud(cloud, Eigen::Vector3d::Zero());
  pcl.EstimateNormals();
  const std::vector<BatchNormal> expected = pcl.Normals();

  for (const double offset_m : {0.0, 1000.0, 100000.0}) {
    SCOPED_TRACE("offset " + std::to_string(offset_m) + " m");
    const Eigen::Vector3d offset(offset_m, -offset_m, 0.0);
    DynamicVoxelGrid grid(grid_parameters);
    IncrementalNormals normals(parameters, grid);
    normals.Insert(grid.Insert(scan, Pose(Eigen::Translation3d(offset))));
    double sum_deg = 0.0;
    std::size_t compared = 0;
    for (const VoxelHandle voxel : grid.ActiveVoxels()) {
      const auto twin = index_of.find(CellOf(grid.CentroidGrid(voxel) - offset, grid_parameters.resolution_m));
      if (twin == index_of.end()) continue;  // a rounding put it into the next cell
      const Eigen::Vector3d normal = normals.NormalOdom(voxel, offset);
      const Eigen::Vector3d reference = expected[twin->second].normal_odom.cast<double>();
      if (!normal.allFinite() || !reference.allFinite()) continue;
      sum_deg += std::atan2(normal.cross(reference).norm(), std::abs(normal.dot(reference))) * 180.0 / M_PI;
      ++compared;
    }
    const double mean_deg = sum_deg / static_cast<double>(compared);
    RecordProperty("mean_deg_at_" + std::to_string(std::lround(offset_m)) + "_m", std::to_string(mean_deg));
    EXPECT_GT(static_cast<double>(compared), 0.95 * static_cast<double>(cloud.size()));
    EXPECT_LT(mean_deg, 1.0);
  }
}

}  // namespace
}  // namespace incremental_segmatch
