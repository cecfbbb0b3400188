#include "incremental_segmatch/growing_policies.hpp"

#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <string>

namespace incremental_segmatch {

SmoothnessPolicy::SmoothnessPolicy(const SmoothnessParameters& parameters, const IncrementalNormals& normals)
    : normals_(&normals), measure_(parameters.measure), min_cosine_(static_cast<float>(std::cos(parameters.max_angle_rad))) {
  if (!(parameters.max_angle_rad > 0.0) || !(parameters.max_angle_rad < 1.5708))
    throw std::invalid_argument("smoothness.max_angle_rad: must be between 0 and pi/2, is " +
                                std::to_string(parameters.max_angle_rad));
  const bool by_curvature = measure_ == RoughnessMeasure::kCurvature;
  const double max_roughness = by_curvature ? parameters.max_curvature : parameters.max_residual_m;
  if (!(max_roughness > 0.0))
    throw std::invalid_argument(std::string("smoothness.") + (by_curvature ? "max_curvature" : "max_residual_m") +
                                ": must be positive, is " + std::to_string(max_roughness));
  max_roughness_ = static_cast<float>(max_roughness);
}

void SmoothnessPolicy::PrepareSeeds(std::vector<VoxelHandle>* voxels) {
  order_.clear();
  for (const VoxelHandle voxel : *voxels) {
    const float roughness = Roughness(voxel);
    if (roughness <= max_roughness_) order_.emplace_back(roughness, voxel);
  }
  std::sort(order_.begin(), order_.end());
  voxels->clear();
  for (const auto& entry : order_) voxels->push_back(entry.second);
}

}  // namespace incremental_segmatch
