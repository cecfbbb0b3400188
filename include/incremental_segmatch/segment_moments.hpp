/// \file
/// Running first and second moments of a segment's points (METHOD 4: descriptors from running sums).
#pragma once

#include <Eigen/Core>
#include <algorithm>
#include <cstddef>
#include <limits>

namespace incremental_segmatch {

/// Count, sum and sum of outer products of points relative to a reference near them, so that doubles never cancel; and
/// the range of heights that the points ever had. All in the grid's frame. Add, Subtract and Merge are O(1).
class SegmentMoments {
 public:
  /// Adds a point. O(1).
  void Add(const Eigen::Vector3d& point) {
    if (count_ == 0) {
      *this = SegmentMoments();
      reference_ = point;
    }
    const Eigen::Vector3d p = point - reference_;
    ++count_;
    sum_ += p;
    AddOuter(p, 1.0);
    Extend(point.z());
  }
  /// Takes a point out that was added. O(1).
  void Subtract(const Eigen::Vector3d& point) {
    const Eigen::Vector3d p = point - reference_;
    --count_;
    sum_ -= p;
    AddOuter(p, -1.0);
  }
  /// Replaces a point. O(1).
  void Move(const Eigen::Vector3d& before, const Eigen::Vector3d& after) {
    const Eigen::Vector3d a = before - reference_;
    const Eigen::Vector3d b = after - reference_;
    sum_ += b - a;
    AddOuter(a, -1.0);
    AddOuter(b, 1.0);
    Extend(after.z());
  }
  /// Adds another segment's points: A' = A + s bT + b sT + n s sT for sums moved by the shift s of their reference.
  void Merge(const SegmentMoments& other) {
    if (other.count_ == 0) return;
    if (count_ == 0) {
      *this = other;
      return;
    }
    const Eigen::Vector3d s = other.reference_ - reference_;
    const double n = static_cast<double>(other.count_);
    const Eigen::Vector3d& b = other.sum_;
    for (int row = 0, k = 0; row < 3; ++row)
      for (int col = row; col < 3; ++col, ++k)
        outer_[k] += other.outer_[k] + s[row] * b[col] + b[row] * s[col] + n * s[row] * s[col];
    sum_ += b + n * s;
    count_ += other.count_;
    min_z_ = std::min(min_z_, other.min_z_);
    max_z_ = std::max(max_z_, other.max_z_);
  }

  /// Number of points.
  std::size_t count() const { return count_; }
  /// Requires count() > 0.
  Eigen::Vector3d Centroid() const { return reference_ + sum_ / static_cast<double>(count_); }
  /// M = A / n - b bT / n^2, (3.7). Requires count() > 0.
  Eigen::Matrix3d Covariance() const {
    const double n = static_cast<double>(count_);
    const Eigen::Vector3d mean = sum_ / n;
    Eigen::Matrix3d covariance;
    for (int row = 0, k = 0; row < 3; ++row)
      for (int col = row; col < 3; ++col, ++k)
        covariance(row, col) = covariance(col, row) = outer_[k] / n - mean[row] * mean[col];
    return covariance;
  }
  /// Lowest height of any point ever added (m).
  double min_z() const { return min_z_; }
  /// Greatest height of any point ever added (m).
  double max_z() const { return max_z_; }

 private:
  void AddOuter(const Eigen::Vector3d& p, double weight) {
    for (int row = 0, k = 0; row < 3; ++row)
      for (int col = row; col < 3; ++col, ++k) outer_[k] += weight * p[row] * p[col];
  }
  void Extend(double z) {
    min_z_ = std::min(min_z_, z);
    max_z_ = std::max(max_z_, z);
  }

  std::size_t count_ = 0;
  Eigen::Vector3d reference_ = Eigen::Vector3d::Zero();
  Eigen::Vector3d sum_ = Eigen::Vector3d::Zero();
  double outer_[6] = {0, 0, 0, 0, 0, 0};  ///< upper triangle of the sum of p pT
  double min_z_ = std::numeric_limits<double>::infinity();
  double max_z_ = -std::numeric_limits<double>::infinity();
};

}  // namespace incremental_segmatch
