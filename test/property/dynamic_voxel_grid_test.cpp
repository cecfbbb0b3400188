// Contract 1 of the voxel grid: after any sequence of insertion, removal and transform it equals a map from cell to
// points.

#include "incremental_segmatch/dynamic_voxel_grid.hpp"

#include <gtest/gtest.h>

#include <array>
#include <cmath>
#include <limits>
#include <map>
#include <random>
#include <set>
#include <vector>

namespace incremental_segmatch {
namespace {

using Cell = std::array<long, 3>;

Pose RandomPose(std::mt19937* random, double range_m) {
  std::uniform_real_distribution<double> position(-range_m, range_m), angle(-0.3, 0.3), yaw(-3.14, 3.14);
  Pose pose = Pose::Identity();
  pose.translate(Eigen::Vector3d(position(*random), position(*random), 0.1 * position(*random)));
  pose.rotate(Eigen::AngleAxisd(yaw(*random), Eigen::Vector3d::UnitZ()) *
              Eigen::AngleAxisd(angle(*random), Eigen::Vector3d::UnitX()));
  return pose;
}

/// The slow, obvious grid.
struct Reference {
  struct Content {
    Eigen::Vector3d sum = Eigen::Vector3d::Zero();
    std::uint32_t count = 0;
    Eigen::Vector3d Centroid() const { return sum / count; }
  };
  DynamicVoxelGridParameters parameters;
  Pose T_odom_grid = Pose::Identity();
  std::map<Cell, Content> cells;
  std::map<Cell, std::uint32_t> last_insertions;  // by block

  Cell CellOf(const Eigen::Vector3d& p_grid) const {
    Cell cell;
    for (int axis = 0; axis < 3; ++axis)
      cell[axis] = static_cast<long>(std::floor((p_grid[axis] - parameters.center_m[axis]) / parameters.resolution_m));
    return cell;
  }
  static Cell BlockOf(const Cell& cell) {
    Cell block;
    for (int axis = 0; axis < 3; ++axis) block[axis] = static_cast<long>(std::floor(cell[axis] / 4.0));
    return block;
  }
  bool Covers(const Cell& cell) const {
    for (int axis = 0; axis < 3; ++axis) {
      const long half = 1L << (parameters.bits[axis] - 1);
      if (cell[axis] < -half || cell[axis] >= half) return false;
    }
    return true;
  }
  bool IsActive(const Content& content) const {
    return content.count >= static_cast<std::uint32_t>(parameters.min_points_per_voxel);
  }
};

Cell CellOfVoxel(const DynamicVoxelGrid& grid, const Reference& reference, VoxelHandle voxel) {
  return reference.CellOf(grid.CentroidGrid(voxel));
}

void ExpectEqual(const DynamicVoxelGrid& grid, const Reference& reference, const std::map<VoxelHandle, Cell>& handles) {
  std::size_t active = 0;
  for (const auto& [cell, content] : reference.cells) active += reference.IsActive(content);
  ASSERT_EQ(grid.occupied_voxels(), reference.cells.size());
  ASSERT_EQ(grid.active_voxels(), active);
  const std::vector<VoxelHandle> voxels = grid.ActiveVoxels();
  ASSERT_EQ(voxels.size(), active);
  ASSERT_EQ(handles.size(), active);
  for (const VoxelHandle voxel : voxels) {
    ASSERT_TRUE(handles.count(voxel)) << "active voxel was never reported as activated";
    const auto content = reference.cells.find(handles.at(voxel));
    ASSERT_NE(content, reference.cells.end());
    EXPECT_EQ(grid.PointCount(voxel), content->second.count);
    EXPECT_LT((grid.CentroidGrid(voxel) - content->second.Centroid()).norm(), 2e-6);
    EXPECT_LT((grid.CentroidOdom(voxel) - reference.T_odom_grid * content->second.Centroid()).norm(), 1e-5);
  }
}

TEST(DynamicVoxelGrid, EqualsMapFromCellToPointsAfterAnySequence) {
  std::size_t removals = 0;
  for (unsigned seed = 0; seed < 1000; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    std::mt19937 random(seed);
    Reference reference;
    const bool walks = seed % 2 != 0;  // else the circles of removal lie anywhere
    reference.parameters.resolution_m = std::uniform_real_distribution<double>(0.05, walks ? 0.1 : 0.5)(random);
    reference.parameters.min_points_per_voxel = 1 + static_cast<int>(seed % 3);
    if (seed % 5 == 0) reference.parameters.center_m = {12345.6, -54321.0, 77.7};
    const Eigen::Vector3d center(reference.parameters.center_m[0], reference.parameters.center_m[1],
                                 reference.parameters.center_m[2]);
    DynamicVoxelGrid grid(reference.parameters);
    std::map<VoxelHandle, Cell> handles;  // of active voxels, as reported
    Eigen::Vector3d walker = RandomPose(&random, 1.0).translation();

    for (int step = 0; step < 12; ++step) {
      const int action = std::uniform_int_distribution<int>(0, 5)(random);
      if (action == 0) {
        const Pose T = RandomPose(&random, 3.0);
        grid.Transform(T);
        reference.T_odom_grid = T * reference.T_odom_grid;
      } else if (action == 1) {
        if (!walks) walker.setZero();
        walker += RandomPose(&random, walks ? 0.5 : 2.0).translation();
        const Eigen::Vector3d odom = reference.T_odom_grid * (center + walker);
        const double radius_m = std::uniform_real_distribution<double>(walks ? 2.0 : 0.5, 4.0)(random);
        const Eigen::Vector3d around = reference.T_odom_grid.inverse() * odom;
        const std::uint32_t oldest =
            walks ? 0 : std::uniform_int_distribution<std::uint32_t>(0, grid.insertions())(random);
        const VoxelUpdate update = grid.RemoveOutside(odom, radius_m, oldest);
        EXPECT_TRUE(update.activated.empty() && update.moved.empty());
        std::set<Cell> expected;
        for (auto it = reference.cells.begin(); it != reference.cells.end();) {
          const bool outside = (it->second.Centroid() - around).head<2>().norm() > radius_m ||
                               reference.last_insertions.at(Reference::BlockOf(it->first)) < oldest;
          if (outside && reference.IsActive(it->second)) expected.insert(it->first);
          it = outside ? reference.cells.erase(it) : std::next(it);
        }
        std::set<Cell> removed;
        for (const RemovedVoxel& voxel : update.removed) {
          ASSERT_TRUE(handles.count(voxel.voxel));
          removed.insert(handles.at(voxel.voxel));
          handles.erase(voxel.voxel);
        }
        EXPECT_EQ(removed, expected);
        EXPECT_EQ(removed.size(), update.removed.size());
        removals += removed.size();
      } else {
        const Pose T_odom_sensor = reference.T_odom_grid * Eigen::Translation3d(center) * RandomPose(&random, 1.0);
        Points points;
        const int count = std::uniform_int_distribution<int>(0, 150)(random);
        std::normal_distribution<float> coordinate(0.f, 1.5f);
        for (int i = 0; i < count; ++i) points.emplace_back(coordinate(random), coordinate(random), coordinate(random));
        points.emplace_back(std::numeric_limits<float>::quiet_NaN(), 0.f, 0.f);
        points.emplace_back(0.f, std::numeric_limits<float>::infinity(), 0.f);
        points.emplace_back(1e9f, 0.f, 0.f);

        std::map<Cell, Reference::Content> before = reference.cells;
        for (const Eigen::Vector3f& p : points) {
          const Eigen::Vector3d p_grid = reference.T_odom_grid.inverse() * (T_odom_sensor * p.cast<double>());
          if (!p_grid.allFinite() || !reference.Covers(reference.CellOf(p_grid))) continue;
          Reference::Content& content = reference.cells[reference.CellOf(p_grid)];
          content.sum += p_grid;
          ++content.count;
          reference.last_insertions[Reference::BlockOf(reference.CellOf(p_grid))] = grid.insertions() + 1;
        }
        const VoxelUpdate update = grid.Insert(points, T_odom_sensor);
        EXPECT_TRUE(update.removed.empty());
        EXPECT_EQ(update.dropped_nonfinite, 2u);
        EXPECT_EQ(update.dropped_outside, 1u);
        for (const VoxelHandle voxel : update.activated) {
          const Cell cell = CellOfVoxel(grid, reference, voxel);
          EXPECT_TRUE(handles.emplace(voxel, cell).second) << "a handle was given twice";
          EXPECT_TRUE(before.count(cell) == 0 || !reference.IsActive(before.at(cell)));
        }
        std::set<VoxelHandle> moved;
        for (const MovedVoxel& voxel : update.moved) {
          ASSERT_TRUE(handles.count(voxel.voxel));
          EXPECT_TRUE(moved.insert(voxel.voxel).second);
          const Reference::Content& old = before.at(handles.at(voxel.voxel));
          EXPECT_TRUE(reference.IsActive(old));
          EXPECT_LT((grid.BlockCorner(voxel.voxel) + voxel.before_block.cast<double>() - old.Centroid()).norm(), 2e-6);
        }
        std::set<Cell> expected_moves, moves;
        for (const auto& [cell, content] : reference.cells)
          if (before.count(cell) && before.at(cell).count != content.count && reference.IsActive(before.at(cell)))
            expected_moves.insert(cell);
        for (const VoxelHandle voxel : moved) moves.insert(handles.at(voxel));
        EXPECT_EQ(moves, expected_moves);
      }
      ASSERT_NO_FATAL_FAILURE(ExpectEqual(grid, reference, handles));
      if (HasFailure()) return;
    }
  }
  EXPECT_GT(removals, 10000u);
}

// Far more blocks than above: their map grows, and empties, over and over.
TEST(DynamicVoxelGrid, EqualsMapFromCellToPointsWithManyBlocks) {
  for (unsigned seed = 0; seed < 6; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    std::mt19937 random(seed);
    Reference reference;
    DynamicVoxelGrid grid(reference.parameters);
    std::map<VoxelHandle, Cell> handles;
    std::uniform_real_distribution<float> coordinate(-40.f, 40.f);
    std::size_t most_voxels = 0;
    for (int step = 0; step < 12; ++step) {
      Points points;
      for (int i = 0; i < 2000; ++i) points.emplace_back(coordinate(random), coordinate(random), 0.1f * coordinate(random));
      if (step > 0) points.insert(points.end(), points.begin(), points.begin() + 500);
      for (const Eigen::Vector3f& p : points) {
        Reference::Content& content = reference.cells[reference.CellOf(p.cast<double>())];
        content.sum += p.cast<double>();
        ++content.count;
      }
      for (const VoxelHandle voxel : grid.Insert(points, Pose::Identity()).activated)
        ASSERT_TRUE(handles.emplace(voxel, CellOfVoxel(grid, reference, voxel)).second) << "a handle was given twice";
      most_voxels = std::max(most_voxels, grid.active_voxels());
      if (step % 3 == 2) {
        const Eigen::Vector3d center(coordinate(random), coordinate(random), 0.0);
        const double radius_m = std::uniform_real_distribution<double>(10.0, 60.0)(random);
        for (const RemovedVoxel& voxel : grid.RemoveOutside(center, radius_m).removed) handles.erase(voxel.voxel);
        for (auto it = reference.cells.begin(); it != reference.cells.end();)
          it = (it->second.Centroid() - center).head<2>().norm() > radius_m ? reference.cells.erase(it) : std::next(it);
      }
      ASSERT_NO_FATAL_FAILURE(ExpectEqual(grid, reference, handles));
      if (HasFailure()) return;
    }
    EXPECT_GT(most_voxels, 5000u);
  }
}

TEST(DynamicVoxelGrid, NeighboursEqualExhaustiveSearch) {
  for (unsigned seed = 0; seed < 1000; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    std::mt19937 random(seed);
    DynamicVoxelGridParameters parameters;
    parameters.min_points_per_voxel = 1 + static_cast<int>(seed % 2);
    DynamicVoxelGrid grid(parameters);
    // Radii on both sides of a block's side, and exact multiples of the resolution.
    const double radius_m =
        seed % 3 == 0 ? 0.1 * (1 + seed % 8) : std::uniform_real_distribution<double>(0.02, 1.2)(random);
    const NeighbourStencil stencil(radius_m, parameters.resolution_m);
    std::uniform_real_distribution<float> coordinate(-1.f, 1.f);
    Points points;
    for (int i = 0; i < 120; ++i)
      points.emplace_back(coordinate(random), coordinate(random), 0.5f * coordinate(random));
    grid.Insert(points, Pose::Identity());
    grid.RemoveOutside({0.3, 0.0, 0.0}, 1.0);
    const std::vector<VoxelHandle> voxels = grid.ActiveVoxels();
    for (const VoxelHandle voxel : voxels) {
      std::set<VoxelHandle> found;
      grid.ForEachNeighbour(stencil, voxel, [&](VoxelHandle neighbour, const Eigen::Vector3f& difference) {
        EXPECT_TRUE(found.insert(neighbour).second);
        EXPECT_LT((difference.cast<double>() - (grid.CentroidGrid(neighbour) - grid.CentroidGrid(voxel))).norm(), 1e-6);
        return true;
      });
      for (const VoxelHandle other : voxels) {
        const double distance = (grid.CentroidGrid(other) - grid.CentroidGrid(voxel)).norm();
        if (other == voxel || std::abs(distance - radius_m) < 1e-6) continue;
        EXPECT_EQ(found.count(other) != 0, distance < radius_m) << distance << " m, radius " << radius_m;
      }
    }
  }
}

TEST(DynamicVoxelGrid, FarFromTheOriginNothingIsLost) {
  Points points;
  std::mt19937 random(7);
  std::uniform_real_distribution<float> coordinate(-5.f, 5.f);
  for (int i = 0; i < 2000; ++i) points.emplace_back(coordinate(random), coordinate(random), coordinate(random));
  std::vector<std::vector<double>> centroid_offsets;
  for (const double offset_m : {0.0, 102400.0}) {  // an exact multiple of the resolution in double and in cells
    DynamicVoxelGrid grid(DynamicVoxelGridParameters{});
    Pose T = Pose::Identity();
    T.translation().x() = offset_m;
    grid.Insert(points, T);
    std::vector<double> offsets;
    for (const VoxelHandle voxel : grid.ActiveVoxels()) offsets.push_back(grid.CentroidGrid(voxel).x() - offset_m);
    std::sort(offsets.begin(), offsets.end());
    centroid_offsets.push_back(offsets);
  }
  ASSERT_EQ(centroid_offsets[0].size(), centroid_offsets[1].size());
  for (std::size_t i = 0; i < centroid_offsets[0].size(); ++i)
    EXPECT_NEAR(centroid_offsets[0][i], centroid_offsets[1][i], 1e-6);
}

TEST(DynamicVoxelGrid, RefusesBadParametersByName) {
  const auto message = [](DynamicVoxelGridParameters parameters) -> std::string {
    try {
      DynamicVoxelGrid{parameters};
    } catch (const std::invalid_argument& error) {
      return error.what();
    }
    return "";
  };
  DynamicVoxelGridParameters parameters;
  parameters.resolution_m = 0.0;
  EXPECT_NE(message(parameters).find("resolution_m"), std::string::npos);
  parameters = {};
  parameters.min_points_per_voxel = 0;
  EXPECT_NE(message(parameters).find("min_points_per_voxel"), std::string::npos);
  parameters = {};
  parameters.bits = {21, 24, 21};
  EXPECT_NE(message(parameters).find("bits"), std::string::npos);
}

}  // namespace
}  // namespace incremental_segmatch
