/// \file
/// Segment descriptors (METHOD 4; thesis 1.2.3).
#pragma once

#include <Eigen/Core>
#include <string>
#include <vector>

#include "incremental_segmatch/segment_moments.hpp"
#include "incremental_segmatch/types.hpp"

namespace incremental_segmatch {

/// Feature values in the order of Describer; unscaled unless said otherwise.
using Descriptor = Eigen::VectorXf;

/// Which features a descriptor has.
struct DescriptorParameters {
  bool eigenvalues = true;  ///< the seven eigenvalue features of Weinmann et al.
  bool sizes = true;        ///< logarithms of sizes along the principal axes and along gravity, and of the count
  bool orientation = true;  ///< how upright the principal axes are
};

/// The seven features of METHOD 4 from a covariance: linearity, planarity, scattering, omnivariance, anisotropy,
/// eigenentropy (0 ln 0 = 0), change of curvature. Eigenvalues below zero by rounding count as zero; a zero matrix
/// gives zeros.
Eigen::Matrix<float, 7, 1> EigenvalueFeatures(const Eigen::Vector3d& ascending_eigenvalues);

/// Describes segments from their running moments alone: O(1) for a segment of any size.
class Describer {
 public:
  /// Throws std::invalid_argument if no feature is selected.
  Describer(const DescriptorParameters& parameters, double resolution_m);

  /// \param up_grid  the direction of gravity's opposite (odom's z) in the frame of the moments, unit length.
  /// Requires moments.count() > 0.
  Descriptor Describe(const SegmentMoments& moments, const Eigen::Vector3d& up_grid) const;

  /// Number of features.
  Eigen::Index size() const { return static_cast<Eigen::Index>(names_.size()); }
  /// Name of each value, in order.
  const std::vector<std::string>& names() const { return names_; }

 private:
  DescriptorParameters parameters_;
  double resolution_m_;
  std::vector<std::string> names_;
};

}  // namespace incremental_segmatch
