/// \file
/// The thesis's own dynamic voxel grid (3.1.2 and 3.1.3), for comparison: voxels in a vector sorted by index; new points are sorted
/// and merged into it, and removal compacts it.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <utility>
#include <vector>

#include "incremental_segmatch/types.hpp"

namespace incremental_segmatch::bench {

/// One point makes a voxel active. Cost of a step: O(new points * log(new points) + local cloud).
class SortedVectorGrid {
 public:
  explicit SortedVectorGrid(double resolution_m) : cells_per_m_(1.0 / resolution_m) {}

  void RemoveOutside(const Eigen::Vector3d& center_odom, double radius_m) {
    const Eigen::Vector2f center = center_odom.head<2>().cast<float>();
    const float radius2 = static_cast<float>(radius_m * radius_m);
    const auto outside = [&](const Voxel& voxel) { return (voxel.centroid.head<2>() - center).squaredNorm() > radius2; };
    voxels_.erase(std::remove_if(voxels_.begin(), voxels_.end(), outside), voxels_.end());
  }

  /// Returns the positions in the vector of voxels that became active.
  std::vector<std::uint32_t> Insert(const Points& points_sensor, const Pose& T_odom_sensor) {
    arrivals_.clear();
    for (const Eigen::Vector3f& p_sensor : points_sensor) {
      const Eigen::Vector3d p = T_odom_sensor * p_sensor.cast<double>();
      arrivals_.push_back({IndexOf(p), p.cast<float>(), 1});
    }
    std::sort(arrivals_.begin(), arrivals_.end(), [](const Voxel& a, const Voxel& b) { return a.index < b.index; });

    std::vector<std::uint32_t> activated;
    merged_.clear();
    merged_.reserve(voxels_.size() + arrivals_.size());
    auto old = voxels_.cbegin();
    for (auto arrival = arrivals_.cbegin(); arrival != arrivals_.cend();) {
      const std::uint64_t index = arrival->index;
      while (old != voxels_.cend() && old->index < index) merged_.push_back(*old++);
      const bool is_new = old == voxels_.cend() || old->index != index;
      Voxel voxel = is_new ? Voxel{index, Eigen::Vector3f::Zero(), 0} : *old++;
      Eigen::Vector3f sum = static_cast<float>(voxel.count) * voxel.centroid;
      for (; arrival != arrivals_.cend() && arrival->index == index; ++arrival, ++voxel.count) sum += arrival->centroid;
      voxel.centroid = sum / static_cast<float>(voxel.count);
      if (is_new) activated.push_back(static_cast<std::uint32_t>(merged_.size()));
      merged_.push_back(voxel);
    }
    merged_.insert(merged_.end(), old, voxels_.cend());
    voxels_.swap(merged_);
    return activated;
  }

  std::size_t size() const { return voxels_.size(); }

 private:
  struct Voxel {
    std::uint64_t index;
    Eigen::Vector3f centroid;
    std::uint32_t count;
  };

  std::uint64_t IndexOf(const Eigen::Vector3d& p) const {
    std::uint64_t index = 0;
    for (int axis = 2; axis >= 0; --axis) {
      const auto cell = static_cast<std::int64_t>(std::floor(p[axis] * cells_per_m_)) + (std::int64_t{1} << 20);
      index = (index << 21) | (static_cast<std::uint64_t>(cell) & ((1u << 21) - 1));
    }
    return index;
  }

  double cells_per_m_;
  std::vector<Voxel> voxels_, merged_, arrivals_;
};

}  // namespace incremental_segmatch::bench
