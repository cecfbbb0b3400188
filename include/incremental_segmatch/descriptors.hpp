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
  bool context = true;      ///< how much stands how far around: see ContextFeatures
  double context_radius_m = 20.0;  ///< of the surroundings that make the context
};

/// The segments of a local map, by their moments, all in one frame. Not owned.
using Surroundings = std::vector<const SegmentMoments*>;

/// Rings around a segment that its context is told by.
inline constexpr Eigen::Index kContextRings = 12;

/// The seven features of METHOD 4 from a covariance: linearity, planarity, scattering, omnivariance, anisotropy,
/// eigenentropy (0 ln 0 = 0), change of curvature. Eigenvalues below zero by rounding count as zero; a zero matrix
/// gives zeros.
Eigen::Matrix<float, 7, 1> EigenvalueFeatures(const Eigen::Vector3d& ascending_eigenvalues);

/// What stands around a segment, whatever its heading: the square root of the sum of the other segments' heights (m) in
/// each of kContextRings rings of equal width up to `radius_m`, by the distance of centroids. A segment between the
/// middles of two rings counts in both, in proportion, so that no value jumps; the first ring begins at its middle.
/// Heights, because pieces that fall apart otherwise on every visit are low, and what stands tall is seen from
/// everywhere. The segment itself, told by its address, does not count. O(surroundings).
Eigen::Matrix<float, kContextRings, 1> ContextFeatures(const SegmentMoments& segment, const Surroundings& surroundings,
                                                       double radius_m);

/// Describes segments from their running moments, and the context from those of the others: the size of a segment
/// costs nothing.
class Describer {
 public:
  /// Throws std::invalid_argument if no feature is selected, or the resolution or the context's radius is not positive
  /// and finite.
  Describer(const DescriptorParameters& parameters, double resolution_m);

  /// \param up_grid  the direction of gravity's opposite (odom's z) in the frame of the moments, unit length.
  /// \param surroundings  segments of the local map, in the same frame; with or without the segment itself.
  /// Requires count() > 0 of all moments. O(surroundings) with context, O(1) without.
  Descriptor Describe(const SegmentMoments& moments, const Eigen::Vector3d& up_grid, const Surroundings& surroundings) const;

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
