/// \file
/// Growing policies of the incremental segmenter (METHOD 3; thesis 3.3.5).
#pragma once

#include <vector>

#include "incremental_segmatch/types.hpp"

namespace incremental_segmatch {

/// Euclidean clustering: every neighbour within the growing radius belongs to the region.
struct EuclideanPolicy {
  /// Every point may seed and be grown to: the segmenter may then settle whole blocks of voxels at once.
  static constexpr bool kAcceptsAll = true;

  void PrepareSeeds(std::vector<VoxelHandle>*) const {}
  bool CanGrowToPoint(VoxelHandle, VoxelHandle) const { return true; }
  bool CanPointBeSeed(VoxelHandle) const { return true; }
};

}  // namespace incremental_segmatch
