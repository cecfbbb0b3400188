/// \file
/// Small motions of poses: xi = (translation, rotation vector), in ROS's order, m and rad; exp(xi) is the motion.
#pragma once

#include "incremental_segmatch/types.hpp"

namespace incremental_segmatch {

/// The matrix of the cross product: CrossMatrix(v) * w = v x w.
inline Eigen::Matrix3d CrossMatrix(const Eigen::Vector3d& v) {
  Eigen::Matrix3d m;
  m << 0.0, -v.z(), v.y(), v.z(), 0.0, -v.x(), -v.y(), v.x(), 0.0;
  return m;
}

/// Ad(T): T exp(xi) = exp(Ad(T) xi) T.
inline Covariance6 Adjoint(const Pose& T) {
  Covariance6 adjoint = Covariance6::Zero();
  adjoint.topLeftCorner<3, 3>() = T.linear();
  adjoint.topRightCorner<3, 3>() = CrossMatrix(T.translation()) * T.linear();
  adjoint.bottomRightCorner<3, 3>() = T.linear();
  return adjoint;
}

/// Covariance of a perturbation on the right of T, from that of the same one on its left: exp(xi) T = T exp(Ad(T^-1) xi).
/// Symmetric whatever the rounding.
inline Covariance6 MoveToTheRight(const Covariance6& covariance_left, const Pose& T) {
  const Covariance6 adjoint = Adjoint(T.inverse());
  const Covariance6 covariance = adjoint * covariance_left * adjoint.transpose();
  return 0.5 * (covariance + covariance.transpose());
}

}  // namespace incremental_segmatch
