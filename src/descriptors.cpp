#include "incremental_segmatch/descriptors.hpp"

#include <Eigen/Eigenvalues>
#include <cmath>
#include <stdexcept>

namespace incremental_segmatch {
namespace {

using Solver = Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d>;

constexpr double kMaxRelativeResidual = 1e-6;  // |M v - l v| / l_max that the closed form is trusted with

/// Eigenvalues in ascending order and their vectors. The closed form is several times faster than the iteration, but
/// loses the vectors of nearly equal eigenvalues.
Solver Decompose(const Eigen::Matrix3d& covariance) {
  Solver solver;
  solver.computeDirect(covariance);
  const Eigen::Matrix3d residual =
      covariance * solver.eigenvectors() - solver.eigenvectors() * solver.eigenvalues().asDiagonal();
  // Negated, so that a NaN takes the iteration too.
  if (!(residual.norm() <= kMaxRelativeResidual * solver.eigenvalues()[2])) solver.compute(covariance);
  return solver;
}

}  // namespace

Eigen::Matrix<float, 7, 1> EigenvalueFeatures(const Eigen::Vector3d& ascending_eigenvalues) {
  const Eigen::Vector3d clamped = ascending_eigenvalues.cwiseMax(0.0);
  const double sum = clamped.sum();
  if (!(sum > 0.0)) return Eigen::Matrix<float, 7, 1>::Zero();
  const Eigen::Vector3d e = clamped / sum;
  const double e1 = e[2], e2 = e[1], e3 = e[0];
  double entropy = 0.0;
  for (int i = 0; i < 3; ++i)
    if (e[i] > 0.0) entropy -= e[i] * std::log(e[i]);
  Eigen::Matrix<double, 7, 1> features;
  features << (e1 - e2) / e1, (e2 - e3) / e1, e3 / e1, std::cbrt(e1 * e2 * e3), (e1 - e3) / e1, entropy, e3;
  return features.cast<float>();
}

Eigen::Matrix<float, kContextRings, 1> ContextFeatures(const SegmentMoments& segment, const Surroundings& surroundings,
                                                       double radius_m) {
  const Eigen::Vector3d center = segment.Centroid();
  const double rings_per_m = static_cast<double>(kContextRings) / radius_m;
  // One ring more, which takes what fades out.
  Eigen::Matrix<double, kContextRings + 1, 1> heights = Eigen::Matrix<double, kContextRings + 1, 1>::Zero();
  for (const SegmentMoments* other : surroundings) {
    if (other == &segment) continue;
    const double at = (other->Centroid() - center).norm() * rings_per_m;
    if (!(at < static_cast<double>(kContextRings))) continue;
    const auto ring = static_cast<Eigen::Index>(at);
    const double share = at - static_cast<double>(ring);
    const double height = other->max_z() - other->min_z();
    heights[ring] += (1.0 - share) * height;
    heights[ring + 1] += share * height;
  }
  return heights.head<kContextRings>().cwiseSqrt().cast<float>();
}

Describer::Describer(const DescriptorParameters& parameters, double resolution_m)
    : parameters_(parameters), resolution_m_(resolution_m) {
  if (!(resolution_m > 0.0) || !std::isfinite(resolution_m)) {
    throw std::invalid_argument("descriptor: the resolution is " + std::to_string(resolution_m) +
                                " m; it must be positive and finite");
  }
  if (parameters.eigenvalues) {
    names_.insert(names_.end(), {"linearity", "planarity", "scattering", "omnivariance", "anisotropy", "eigenentropy",
                                 "change_of_curvature"});
  }
  if (parameters.sizes) {
    names_.insert(names_.end(), {"log_size_1", "log_size_2", "log_size_3", "log_height", "log_count"});
  }
  if (parameters.orientation) names_.insert(names_.end(), {"upright_1", "upright_3"});
  if (parameters.context) {
    for (Eigen::Index ring = 1; ring <= kContextRings; ++ring) names_.push_back("context_" + std::to_string(ring));
  }
  if (!(parameters.context_radius_m > 0.0) || !std::isfinite(parameters.context_radius_m)) {
    throw std::invalid_argument("descriptor: context_radius_m is " + std::to_string(parameters.context_radius_m) +
                                "; it must be positive and finite");
  }
  if (names_.empty()) {
    throw std::invalid_argument("descriptor: no feature is selected; switch on eigenvalues, sizes, orientation or context");
  }
}

Descriptor Describer::Describe(const SegmentMoments& moments, const Eigen::Vector3d& up_grid,
                               const Surroundings& surroundings) const {
  const Solver solver = Decompose(moments.Covariance());
  const Eigen::Vector3d eigenvalues = solver.eigenvalues().cwiseMax(0.0);
  Descriptor descriptor(size());
  Eigen::Index at = 0;
  if (parameters_.eigenvalues) {
    descriptor.segment<7>(at) = EigenvalueFeatures(eigenvalues);
    at += 7;
  }
  if (parameters_.sizes) {
    for (int axis = 2; axis >= 0; --axis)
      descriptor[at++] = static_cast<float>(std::log(std::sqrt(eigenvalues[axis]) + resolution_m_));
    descriptor[at++] = static_cast<float>(std::log(moments.max_z() - moments.min_z() + resolution_m_));
    descriptor[at++] = static_cast<float>(std::log(static_cast<double>(moments.count())));
  }
  if (parameters_.orientation) {
    // A segment without any extent has no axes.
    const bool has_axes = eigenvalues[2] > 0.0;
    descriptor[at++] = has_axes ? static_cast<float>(std::abs(solver.eigenvectors().col(2).dot(up_grid))) : 0.f;
    descriptor[at++] = has_axes ? static_cast<float>(std::abs(solver.eigenvectors().col(0).dot(up_grid))) : 0.f;
  }
  if (parameters_.context)
    descriptor.segment<kContextRings>(at) = ContextFeatures(moments, surroundings, parameters_.context_radius_m);
  return descriptor;
}

}  // namespace incremental_segmatch
