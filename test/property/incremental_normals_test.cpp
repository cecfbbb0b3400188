// Contract 2 of the normals: accumulators equal batch sums over the anchors, and normals batch PCA over them, whatever
// happened and wherever it did.

#include "incremental_segmatch/incremental_normals.hpp"

#include <gtest/gtest.h>

#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>
#include <random>
#include <string>
#include <vector>

namespace incremental_segmatch {
namespace {

using Vector3l = Eigen::Matrix<std::int64_t, 3, 1>;

/// A grid with its normals, and what an oracle needs to know of it.
struct Map {
  DynamicVoxelGrid grid;
  IncrementalNormals normals;

  Map(const DynamicVoxelGridParameters& grid_parameters, const NormalsParameters& parameters)
      : grid(grid_parameters), normals(parameters, grid) {}

  VoxelUpdate Insert(const Points& points, const Pose& T_odom_sensor) {
    VoxelUpdate update = grid.Insert(points, T_odom_sensor);
    normals.Insert(update);
    return update;
  }
  VoxelUpdate RemoveOutside(const Eigen::Vector3d& center_odom, double radius_m) {
    VoxelUpdate update = grid.RemoveOutside(center_odom, radius_m);
    normals.Remove(update.removed);
    return update;
  }
  /// Centre of a voxel's cell, in half units: an integer.
  Vector3l CenterHalfUnits(VoxelHandle voxel) const {
    const double resolution = grid.parameters().resolution_m;
    const Eigen::Vector3d grid_center(grid.parameters().center_m[0], grid.parameters().center_m[1],
                                      grid.parameters().center_m[2]);
    const std::int64_t half_units_per_cell = std::llround(2.0 * resolution / normals.unit_m());
    const Eigen::Vector3d corner_cells = (grid.BlockCorner(voxel) - grid_center) / resolution;
    const int cell = static_cast<int>(voxel % DynamicVoxelGrid::kCellsPerBlock);
    const Vector3l index(std::llround(corner_cells.x()) + cell % 4, std::llround(corner_cells.y()) + cell / 4 % 4,
                         std::llround(corner_cells.z()) + cell / 16);
    return index * half_units_per_cell + Vector3l::Constant(half_units_per_cell / 2);
  }
  /// Anchor in units, in a frame common to all voxels.
  Vector3l AnchorUnits(VoxelHandle voxel) const {
    return CenterHalfUnits(voxel) / 2 + normals.Anchor(voxel).cast<std::int64_t>();
  }
};

NormalAccumulators BatchSums(const Map& map, const std::vector<VoxelHandle>& voxels, VoxelHandle of) {
  const double radius_units = map.normals.parameters().radius_m / map.normals.unit_m() * (1.0 + 1e-9);
  const Vector3l anchor = map.AnchorUnits(of), center = map.CenterHalfUnits(of) / 2;
  NormalAccumulators sums;
  for (const VoxelHandle other : voxels) {
    const Vector3l there = map.AnchorUnits(other);
    if (static_cast<double>((there - anchor).squaredNorm()) > std::floor(radius_units * radius_units)) continue;
    const Vector3l p = there - center;
    ++sums.count;
    sums.sum += p;
    sums.outer += p * p.transpose();
  }
  return sums;
}

double AngleOf(const Eigen::Vector3d& a, const Eigen::Vector3d& b) {
  return std::atan2(a.cross(b).norm(), std::abs(a.dot(b)));
}

void ExpectBatchPca(const NormalAccumulators& sums, const NormalEstimate& estimate) {
  if (sums.count < 3) {
    EXPECT_TRUE(std::isnan(estimate.curvature) && std::isnan(estimate.normal_grid.x()));
    return;
  }
  const double n = static_cast<double>(sums.count);
  const Eigen::Vector3d mean = sums.sum.cast<double>() / n;
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> solver(sums.outer.cast<double>() / n - mean * mean.transpose());
  const Eigen::Vector3d values = solver.eigenvalues().cwiseMax(0.0);
  EXPECT_NEAR(estimate.normal_grid.norm(), 1.f, 1e-5f);
  EXPECT_NEAR(estimate.curvature, values.sum() > 0.0 ? values[0] / values.sum() : 0.0, 1e-5);
  if (values[1] - values[0] < 0.02 * values[2]) return;  // no well defined normal
  EXPECT_LT(AngleOf(estimate.normal_grid.cast<double>(), solver.eigenvectors().col(0)), 1e-4);
}

Pose RandomPose(std::mt19937* random, double range_m) {
  std::uniform_real_distribution<double> position(-range_m, range_m), angle(-0.3, 0.3), yaw(-3.14, 3.14);
  Pose pose = Pose::Identity();
  pose.translate(Eigen::Vector3d(position(*random), position(*random), 0.1 * position(*random)));
  pose.rotate(Eigen::AngleAxisd(yaw(*random), Eigen::Vector3d::UnitZ()) *
              Eigen::AngleAxisd(angle(*random), Eigen::Vector3d::UnitX()));
  return pose;
}

TEST(IncrementalNormals, AccumulatorsEqualBatchSumsOverAnchorsAfterAnySequence) {
  std::size_t renewals = 0, kept_anchors = 0, removals = 0;
  for (unsigned seed = 0; seed < 1000; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    std::mt19937 random(seed);
    DynamicVoxelGridParameters grid_parameters;
    grid_parameters.resolution_m = std::uniform_real_distribution<double>(0.05, 0.3)(random);
    grid_parameters.min_points_per_voxel = 1 + static_cast<int>(seed % 2);
    if (seed % 4 == 0) grid_parameters.center_m = {4321.0, -765.0, 12.0};
    NormalsParameters parameters;
    parameters.radius_m = grid_parameters.resolution_m * std::uniform_real_distribution<double>(0.8, 5.5)(random);
    if (seed % 3 == 0) parameters.radius_m = grid_parameters.resolution_m * static_cast<double>(1 + seed % 5);
    parameters.renewal_tolerance_voxels = seed % 5 == 0 ? 0.0 : 0.1;
    Map map(grid_parameters, parameters);
    const double scale = 4.0 * grid_parameters.resolution_m;
    const Eigen::Vector3d center(grid_parameters.center_m[0], grid_parameters.center_m[1], grid_parameters.center_m[2]);
    for (int step = 0; step < 8; ++step) {
      const int action = std::uniform_int_distribution<int>(0, 5)(random);
      if (action == 0) {
        map.grid.Transform(RandomPose(&random, 3.0));
      } else if (action == 1) {
        const Eigen::Vector3d around = center + scale * RandomPose(&random, 1.0).translation();
        removals += map.RemoveOutside(map.grid.T_odom_grid() * around, 1.6 * scale).removed.size();
      } else {
        std::normal_distribution<float> coordinate(0.f, static_cast<float>(scale));
        Points points;
        for (int i = 0; i < 60; ++i)
          points.emplace_back(coordinate(random), coordinate(random), 0.5f * coordinate(random));
        const VoxelUpdate update = map.Insert(points, map.grid.T_odom_grid() * Eigen::Translation3d(center));
        for (const MovedVoxel& moved : update.moved) {
          const Eigen::Vector3d anchor = map.AnchorUnits(moved.voxel).cast<double>() * map.normals.unit_m() + center;
          const double off = (map.grid.CentroidGrid(moved.voxel) - anchor).norm();
          const double tolerance = parameters.renewal_tolerance_voxels * grid_parameters.resolution_m;
          EXPECT_LE(off, tolerance + map.normals.unit_m());
          ++(off < 0.9 * map.normals.unit_m() ? renewals : kept_anchors);
        }
      }
      const std::vector<VoxelHandle> voxels = map.grid.ActiveVoxels();
      for (const VoxelHandle voxel : voxels) {
        const NormalAccumulators expected = BatchSums(map, voxels, voxel), found = map.normals.Accumulators(voxel);
        ASSERT_EQ(found.count, expected.count);
        ASSERT_EQ(found.sum, expected.sum);
        ASSERT_EQ(found.outer, expected.outer);
        if ((voxel + static_cast<VoxelHandle>(step)) % 3 == 0)
          ExpectBatchPca(expected, map.normals.Estimate(voxel));  // others stay unread
      }
      if (HasFailure()) return;
    }
  }
  EXPECT_GT(renewals, 1000u);
  EXPECT_GT(kept_anchors, 100u);
  EXPECT_GT(removals, 1000u);
}

TEST(IncrementalNormals, AccumulatorsDoNotDependOnTheOrderOfScans) {
  std::mt19937 random(5);
  std::uniform_real_distribution<float> coordinate(-0.6f, 0.6f);
  std::vector<Points> scans(20);
  for (Points& scan : scans)
    for (int i = 0; i < 50; ++i) scan.emplace_back(coordinate(random), coordinate(random), 0.2f * coordinate(random));
  NormalsParameters exact;
  exact.renewal_tolerance_voxels = 0.0;
  std::vector<std::vector<std::int64_t>> traces;
  for (int order = 0; order < 2; ++order) {
    Map map(DynamicVoxelGridParameters{}, exact);
    for (const Points& scan : scans) map.Insert(scan, Pose::Identity());
    std::vector<std::int64_t> counts;
    for (const VoxelHandle voxel : map.grid.ActiveVoxels()) counts.push_back(map.normals.Accumulators(voxel).count);
    std::sort(counts.begin(), counts.end());
    traces.push_back(counts);
    std::reverse(scans.begin(), scans.end());
  }
  // Rounding of running means may put an anchor a unit aside, and so a neighbour on the other side of the radius:
  // rarely.
  ASSERT_EQ(traces[0].size(), traces[1].size());
  std::size_t different = 0;
  for (std::size_t i = 0; i < traces[0].size(); ++i) different += traces[0][i] != traces[1][i];
  EXPECT_LE(different, traces[0].size() / 50);
}

TEST(IncrementalNormals, TheSameAnywhereInTheWorld) {
  std::mt19937 random(11);
  std::uniform_real_distribution<float> coordinate(-2.f, 2.f);
  std::normal_distribution<float> noise(0.f, 0.02f);
  Points points;
  for (int i = 0; i < 6000; ++i) points.emplace_back(coordinate(random), coordinate(random), noise(random));
  std::vector<std::vector<float>> curvatures;
  for (const double offset_m : {0.0, 1024.0, 102400.0}) {
    Map map(DynamicVoxelGridParameters{}, NormalsParameters{});
    map.Insert(points, Pose(Eigen::Translation3d(offset_m, -offset_m, 0.0)));
    std::vector<float> found;
    for (const VoxelHandle voxel : map.grid.ActiveVoxels()) found.push_back(map.normals.Estimate(voxel).curvature);
    std::sort(found.begin(), found.end());
    curvatures.push_back(found);
  }
  for (const std::vector<float>& far : curvatures) {
    ASSERT_EQ(far.size(), curvatures[0].size());
    std::size_t different = 0;
    for (std::size_t i = 0; i < far.size(); ++i)
      different += !(std::abs(far[i] - curvatures[0][i]) < 1e-3f) && !std::isnan(far[i]);
    EXPECT_LE(different, far.size() / 100);
  }
}

/// (3.12) for sums of doubles, straight from the thesis with its normals corrected, N <- R N: what the grid's own frame
/// saves.
TEST(IncrementalNormals, AreThoseOfTransformedAccumulatorsAfterATransform) {
  for (unsigned seed = 0; seed < 200; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    std::mt19937 random(seed);
    std::uniform_real_distribution<float> coordinate(-1.f, 1.f);
    Map map(DynamicVoxelGridParameters{}, NormalsParameters{});
    Points points;
    for (int i = 0; i < 800; ++i)
      points.emplace_back(coordinate(random), coordinate(random), 0.1f * coordinate(random));
    map.Insert(points, RandomPose(&random, 5.0));
    const Pose T_before = map.grid.T_odom_grid();
    const Pose T = RandomPose(&random, 50.0);
    map.grid.Transform(T);
    for (const VoxelHandle voxel : map.grid.ActiveVoxels()) {
      const NormalAccumulators sums = map.normals.Accumulators(voxel);
      if (sums.count < 5) continue;
      // A and b about the frame's origin, in metres, before the transform ...
      const double n = static_cast<double>(sums.count), unit = map.normals.unit_m();
      const Eigen::Vector3d c = map.CenterHalfUnits(voxel).cast<double>() * 0.5 * unit,
                            b0 = sums.sum.cast<double>() * unit;
      Eigen::Matrix3d A =
          sums.outer.cast<double>() * unit * unit + b0 * c.transpose() + c * b0.transpose() + n * c * c.transpose();
      Eigen::Vector3d b = b0 + n * c;
      const auto move = [&](const Pose& by) {
        const Eigen::Matrix3d R = by.linear();
        const Eigen::Vector3d t = by.translation();
        A = R * A * R.transpose() + R * b * t.transpose() + t * b.transpose() * R.transpose() + n * t * t.transpose();
        b = n * t + R * b;
      };
      move(T_before);
      move(T);
      const Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> solver(A / n - b * b.transpose() / (n * n));
      if (solver.eigenvalues()[1] - solver.eigenvalues()[0] < 0.1 * solver.eigenvalues()[2]) continue;
      const Eigen::Vector3d viewpoint = T * Eigen::Vector3d(0.0, 0.0, 10.0);
      const Eigen::Vector3d normal = map.normals.NormalOdom(voxel, viewpoint);
      EXPECT_LT(AngleOf(normal, solver.eigenvectors().col(0)), 1e-5);
      EXPECT_GE(normal.dot(viewpoint - map.grid.CentroidOdom(voxel)), 0.0);
    }
  }
}

TEST(SmallestEigen, EqualsEigensSolver) {
  std::mt19937 random(1);
  std::normal_distribution<double> normal;
  for (int i = 0; i < 20000; ++i) {
    SCOPED_TRACE("matrix " + std::to_string(i));
    // Of any rank and scale, with eigenvalues that may be equal.
    Eigen::Matrix3d factor;
    for (int k = 0; k < 9; ++k) factor.data()[k] = normal(random);
    Eigen::Vector3d values(std::exp(3.0 * normal(random)), std::exp(3.0 * normal(random)),
                           std::exp(3.0 * normal(random)));
    if (i % 5 == 0) values[1] = values[0];
    if (i % 7 == 0) values[2] = values[1];
    if (i % 11 == 0) values[i % 3] = 0.0;
    if (i % 13 == 0) values[(i + 1) % 3] = 0.0;
    const Eigen::Matrix3d Q = Eigen::HouseholderQR<Eigen::Matrix3d>(factor).householderQ();
    Eigen::Matrix3d m = Q * values.asDiagonal() * Q.transpose();
    m = (0.5 * (m + m.transpose())).eval();
    const SmallestEigen found = SmallestEigenOf(m);
    EXPECT_NEAR(found.value, values.minCoeff(),
                1e-4 * values.sum());  // three equal roots lose two thirds of the digits
    EXPECT_NEAR(found.vector.norm(), 1.0, 1e-9);
    EXPECT_LT((m * found.vector - values.minCoeff() * found.vector).norm(), 3e-4 * values.sum());
  }
  EXPECT_EQ(SmallestEigenOf(Eigen::Matrix3d::Zero()).value, 0.0);
}

TEST(IncrementalNormals, RefusesBadParametersByName) {
  DynamicVoxelGrid grid(DynamicVoxelGridParameters{});
  const auto message = [&](NormalsParameters parameters) -> std::string {
    try {
      IncrementalNormals(parameters, grid);
    } catch (const std::invalid_argument& error) {
      return error.what();
    }
    return "";
  };
  NormalsParameters parameters;
  parameters.radius_m = 0.9;
  EXPECT_NE(message(parameters).find("radius_m"), std::string::npos);
  parameters = {};
  parameters.renewal_tolerance_voxels = -0.1;
  EXPECT_NE(message(parameters).find("renewal_tolerance_voxels"), std::string::npos);
}

TEST(IncrementalNormals, RefusesVoxelsThatAreNotActive) {
  Map map(DynamicVoxelGridParameters{}, NormalsParameters{});
  EXPECT_THROW(map.normals.Estimate(0), std::invalid_argument);
  map.Insert({{0.f, 0.f, 0.f}}, Pose::Identity());
  const VoxelHandle voxel = map.grid.ActiveVoxels().at(0);
  EXPECT_TRUE(std::isnan(map.normals.Estimate(voxel).curvature));
  map.RemoveOutside({100.0, 0.0, 0.0}, 1.0);
  EXPECT_THROW(map.normals.Estimate(voxel), std::invalid_argument);
}

}  // namespace
}  // namespace incremental_segmatch
