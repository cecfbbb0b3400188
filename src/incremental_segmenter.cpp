#include "incremental_segmatch/incremental_segmenter.hpp"

#include <algorithm>
#include <limits>
#include <stdexcept>
#include <string>

namespace incremental_segmatch {

template <class Policy>
IncrementalSegmenter<Policy>::IncrementalSegmenter(const SegmenterParameters& parameters, const DynamicVoxelGrid& grid,
                                                   Policy policy)
    : parameters_(parameters),
      grid_(&grid),
      policy_(std::move(policy)),
      stencil_(parameters.growing_radius_m, grid.parameters().resolution_m) {
  if (parameters.min_cluster_size < 1) throw std::invalid_argument("segmenter.min_cluster_size: must be at least 1");
  if (parameters.max_cluster_size < parameters.min_cluster_size)
    throw std::invalid_argument("segmenter.max_cluster_size: must be at least min_cluster_size (" +
                                std::to_string(parameters.min_cluster_size) + "), is " +
                                std::to_string(parameters.max_cluster_size));
}

template <class Policy>
SegmentUpdate IncrementalSegmenter<Policy>::Remove(const std::vector<RemovedVoxel>& removed) {
  for (const RemovedVoxel& gone : removed) {
    BlockOf(gone.voxel).pending &= ~CellBit(gone.voxel);
    if (!IsClustered(gone.voxel)) continue;
    Cluster& cluster = ClusterAt(FindRoot(LabelOf(gone.voxel)));
    --cluster.live_voxels;
    if (cluster.live_voxels == 0) MarkDirty(&cluster);
    if (parameters_.boundary == BoundaryPolicy::kInvalidate && cluster.state != State::kTooLarge) {
      cluster.moments.Subtract(PointOf(gone.voxel, gone.centroid_block));
      SetState(&cluster, State::kCut);
      MarkDirty(&cluster);
    }
    RemoveCell(&BlockOf(gone.voxel), CellBit(gone.voxel));
  }
  return Settle();
}

template <class Policy>
SegmentUpdate IncrementalSegmenter<Policy>::Insert(const VoxelUpdate& update) {
  blocks_.Grow(grid_->handle_capacity() / DynamicVoxelGrid::kCellsPerBlock);
  FollowCentroids(update.moved);
  for (const VoxelHandle voxel : update.activated) BlockOf(voxel).pending |= CellBit(voxel);
  seeds_ = update.activated;
  policy_.PrepareSeeds(&seeds_);
  constexpr std::size_t kAhead = 8;
  for (std::size_t i = 0; i < seeds_.size(); ++i) {
    if (i + kAhead < seeds_.size()) PrefetchAround(seeds_[i + kAhead]);
    if (!IsClustered(seeds_[i])) GrowFromSeed(seeds_[i]);
  }
  if constexpr (!Policy::kAcceptsAll) {
    rough_.insert(rough_.end(), update.activated.begin(), update.activated.end());
    for (const VoxelHandle voxel : rough_)
      if (!IsClustered(voxel)) JoinFlattestCluster(voxel);
    rough_.clear();
  }
  return Settle();
}

template <class Policy>
SegmentUpdate IncrementalSegmenter<Policy>::DismissTrails(const std::vector<SegmentId>& trails) {
  SegmentUpdate update;
  for (const SegmentId segment : trails) {
    Cluster& cluster = clusters_[TrackedIndex(segment)];
    SetState(&cluster, State::kTrail);
    cluster.id = kNoSegment;
    Untrack(segment);
    update.retired.push_back({segment, RetirementCause::kTrail});
  }
  return update;
}

/// Moved centroids are deltas of their clusters' moments. They come block by block, and most blocks are of one cluster.
template <class Policy>
void IncrementalSegmenter<Policy>::FollowCentroids(const std::vector<MovedVoxel>& moved_voxels) {
  const BlockNode* block = nullptr;
  const Part* part = nullptr;
  Cluster* cluster = nullptr;
  Eigen::Vector3d corner = Eigen::Vector3d::Zero();
  constexpr std::size_t kAhead = 16;
  for (std::size_t i = 0; i < moved_voxels.size(); ++i) {
    const MovedVoxel& moved = moved_voxels[i];
    const std::uint64_t bit = CellBit(moved.voxel);
    if (i + kAhead < moved_voxels.size()) {
      __builtin_prefetch(&BlockOf(moved_voxels[i + kAhead].voxel));
      __builtin_prefetch(&grid_->CentroidInBlock(moved_voxels[i + kAhead].voxel));
    }
    if (block != &BlockOf(moved.voxel)) {
      block = &BlockOf(moved.voxel);
      corner = grid_->BlockCorner(moved.voxel);
      part = nullptr;
    }
    if ((block->clustered & bit) == 0) continue;
    if (part == nullptr || (part->cells & bit) == 0) {
      part = &PartOf(*block, bit);
      cluster = &ClusterAt(FindRoot(part->label));
    }
    if (cluster->state == State::kTooLarge) continue;
    cluster->moments.Move(corner + moved.before_block.cast<double>(),
                          corner + grid_->CentroidInBlock(moved.voxel).cast<double>());
    cluster->grew = true;
    MarkDirty(cluster);
  }
}

/// Starts to fetch what growing from there will read.
template <class Policy>
void IncrementalSegmenter<Policy>::PrefetchAround(VoxelHandle voxel) const {
  grid_->ForEachStencilBlock(stencil_, voxel, [this](std::uint32_t slot, const NeighbourStencil::BlockVisit&) {
    __builtin_prefetch(&blocks_[slot], 1);
    return true;
  });
}

/// Algorithm 1: the region of new voxels that is reached from the seed joins, and links, the clusters that it meets.
template <class Policy>
void IncrementalSegmenter<Policy>::GrowFromSeed(VoxelHandle seed) {
  Label root = kNoLabel;
  region_.clear();
  Queue(seed);
  while (!queue_.empty()) {
    const VoxelHandle from = queue_.back();
    queue_.pop_back();
    region_.push_back(from);
    root = VisitNeighbours(from, root);
  }
  if (root == kNoLabel) root = NewCluster();
  for (const VoxelHandle voxel : region_) AddVoxel(root, voxel);
}

template <class Policy>
void IncrementalSegmenter<Policy>::Queue(VoxelHandle voxel) {
  BlockOf(voxel).pending &= ~CellBit(voxel);
  queue_.push_back(voxel);
}

/// The region with this root (kNoLabel: none yet) meets a cluster; returns the root of what they become.
template <class Policy>
typename IncrementalSegmenter<Policy>::Label IncrementalSegmenter<Policy>::Meet(Label root, Label other) {
  return root == kNoLabel ? FindRoot(other) : Link(root, FindRoot(other));
}

/// Pending neighbours are queued, clusters are met. Of the voxels of a part, one that the region grows to decides, and
/// none need be looked at if the region met their cluster before.
template <class Policy>
typename IncrementalSegmenter<Policy>::Label IncrementalSegmenter<Policy>::VisitNeighbours(VoxelHandle from,
                                                                                           Label root) {
  const float radius2 = static_cast<float>(stencil_.radius_m() * stencil_.radius_m());
  const float block_size_m = static_cast<float>(DynamicVoxelGrid::kBlockSide * grid_->parameters().resolution_m);
  const Eigen::Vector3f center = grid_->CentroidInBlock(from);
  grid_->ForEachStencilBlock(stencil_, from, [&](std::uint32_t slot, const NeighbourStencil::BlockVisit& at) {
    BlockNode& block = blocks_[slot];
    if (((block.pending | block.clustered) & at.cells) == 0) return true;
    const Eigen::Vector3f shift(at.offset[0] * block_size_m - center.x(), at.offset[1] * block_size_m - center.y(),
                                at.offset[2] * block_size_m - center.z());
    const auto first_of = [&](std::uint64_t cells) {
      return slot * DynamicVoxelGrid::kCellsPerBlock + static_cast<VoxelHandle>(__builtin_ctzll(cells));
    };
    const auto is_near = [&](VoxelHandle to) { return (grid_->CentroidInBlock(to) + shift).squaredNorm() <= radius2; };
    for (std::uint64_t cells = block.pending & at.cells; cells != 0; cells &= cells - 1) {
      const VoxelHandle to = first_of(cells);
      if (!is_near(to)) continue;
      if (!policy_.CanPointBeSeed(to)) {
        rough_.push_back(to);  // looked at once all regions have grown
      } else if (policy_.CanGrowToPoint(from, to)) {
        Queue(to);
      }
    }
    if ((block.clustered & at.cells) == 0) return true;
    for (Part* part = &block.parts.front(); part != nullptr; part = Next(part)) {
      std::uint64_t cells = part->cells & at.cells;
      if (cells == 0) continue;
      SetLabel(part, FindRoot(part->label));
      if (part->label == root) continue;
      const auto grows_to = [&](VoxelHandle to) {
        return is_near(to) && policy_.CanPointBeSeed(to) && policy_.CanGrowToPoint(from, to);
      };
      while (cells != 0 && !grows_to(first_of(cells))) cells &= cells - 1;
      if (cells != 0) root = Meet(root, part->label);
    }
    return true;
  });
  return root;
}

/// A point that may not seed: it joins a cluster, but neither links two nor lets others follow, so that the order of
/// such points does not matter.
template <class Policy>
void IncrementalSegmenter<Policy>::JoinFlattestCluster(VoxelHandle voxel) {
  constexpr VoxelHandle kNone = 0xffffffffu;
  std::pair<float, VoxelHandle> flattest{std::numeric_limits<float>::infinity(), kNone};
  grid_->ForEachNeighbour(stencil_, voxel, [&](VoxelHandle from, const Eigen::Vector3f&) {
    if (!IsClustered(from) || !policy_.CanPointBeSeed(from)) return true;
    const auto candidate = std::make_pair(policy_.Roughness(from), from);
    if (candidate < flattest && policy_.CanGrowToPoint(from, voxel)) flattest = candidate;
    return true;
  });
  if (flattest.second == kNone) return;
  BlockOf(voxel).pending &= ~CellBit(voxel);
  AddVoxel(FindRoot(LabelOf(flattest.second)), voxel);
}

template <class Policy>
typename IncrementalSegmenter<Policy>::Label IncrementalSegmenter<Policy>::FindRoot(Label label) const {
  while (nodes_[label].parent != label) {
    const Label parent = nodes_[label].parent;
    const Label grandparent = nodes_[parent].parent;
    if (grandparent == parent) return parent;
    nodes_[label].parent = grandparent;  // path halving
    ++nodes_[grandparent].references;
    Release(parent);
    label = grandparent;
  }
  return label;
}

template <class Policy>
void IncrementalSegmenter<Policy>::Release(Label label) const {
  while (--nodes_[label].references == 0 && nodes_[label].parent != label) {
    free_nodes_.push_back(label);
    label = nodes_[label].parent;
  }
}

template <class Policy>
void IncrementalSegmenter<Policy>::SetLabel(Part* part, Label label) {
  const Label old = part->label;
  if (old == label) return;
  if (label != kNoLabel) ++nodes_[label].references;
  part->label = label;
  if (old != kNoLabel) Release(old);
}

/// The part of a block for voxels of this cluster: parts that have become one cluster become one part.
template <class Policy>
typename IncrementalSegmenter<Policy>::Part& IncrementalSegmenter<Policy>::PartFor(BlockNode* block, Label root) {
  Part* own = nullptr;
  Part* free = nullptr;
  Part* last = nullptr;
  for (Part* part = &block->parts.front(); part != nullptr; part = Next(part)) {
    last = part;
    if (part->cells == 0) {
      if (free == nullptr) free = part;
    } else if (FindRoot(part->label) == root) {
      if (own == nullptr) {
        own = part;
      } else {
        own->cells |= part->cells;
        *part = {0, part->label, part->next};
        SetLabel(part, kNoLabel);
      }
    }
  }
  if (own != nullptr) return *own;
  if (free == nullptr) {
    std::uint32_t index = part_slots_;
    if (free_parts_.empty()) {
      more_parts_.Grow(++part_slots_);
    } else {
      index = free_parts_.back();
      free_parts_.pop_back();
    }
    last->next = index;
    free = &more_parts_[index];
  }
  SetLabel(free, root);
  return *free;
}

template <class Policy>
void IncrementalSegmenter<Policy>::RemoveCell(BlockNode* block, std::uint64_t bit) {
  Part* part = &block->parts.front();
  while ((part->cells & bit) == 0) part = Next(part);
  block->clustered &= ~bit;
  part->cells &= ~bit;
  if (part->cells == 0) SetLabel(part, kNoLabel);
  if (block->clustered != 0) return;
  for (std::uint32_t more = std::exchange(block->parts.back().next, kNoPart); more != kNoPart;) {
    free_parts_.push_back(more);
    more = std::exchange(more_parts_[more].next, kNoPart);
  }
}

template <class Policy>
typename IncrementalSegmenter<Policy>::Label IncrementalSegmenter<Policy>::NewCluster() {
  Label label;
  if (free_nodes_.empty()) {
    label = static_cast<Label>(nodes_.size());
    nodes_.emplace_back();
  } else {
    label = free_nodes_.back();
    free_nodes_.pop_back();
  }
  ClusterIndex index;
  if (free_clusters_.empty()) {
    index = static_cast<ClusterIndex>(clusters_.size());
    clusters_.emplace_back();
  } else {
    index = free_clusters_.back();
    free_clusters_.pop_back();
  }
  nodes_[label] = Node{label, 0, index};
  Cluster& cluster = clusters_[index];
  cluster.root = label;
  SetState(&cluster, State::kSmall);
  return label;
}

template <class Policy>
void IncrementalSegmenter<Policy>::AddVoxel(Label root, VoxelHandle voxel) {
  BlockNode& block = BlockOf(voxel);
  PartFor(&block, root).cells |= CellBit(voxel);
  block.clustered |= CellBit(voxel);
  Cluster& cluster = ClusterAt(root);
  ++cluster.live_voxels;
  if (cluster.state == State::kTooLarge) return;
  cluster.moments.Add(PointOf(voxel, grid_->CentroidInBlock(voxel)));
  cluster.grew = true;
  MarkDirty(&cluster);
}

/// LinkPartialClusters: both roots' sets become one. What that means for segment IDs is settled at the end of the call,
/// so that it does not depend on the order in which clusters meet.
template <class Policy>
typename IncrementalSegmenter<Policy>::Label IncrementalSegmenter<Policy>::Link(Label a, Label b) {
  if (a == b) return a;
  if (ClusterAt(a).live_voxels < ClusterAt(b).live_voxels) std::swap(a, b);
  const ClusterIndex absorbed_index = nodes_[b].cluster;
  Cluster& kept = ClusterAt(a);
  Cluster& absorbed = clusters_[absorbed_index];
  nodes_[b].parent = a;
  ++nodes_[a].references;

  kept.moments.Merge(absorbed.moments);
  kept.live_voxels += absorbed.live_voxels;
  if (absorbed.id != kNoSegment) kept.absorbed.push_back(absorbed.id);
  kept.absorbed.insert(kept.absorbed.end(), absorbed.absorbed.begin(), absorbed.absorbed.end());
  if (absorbed.state > std::max(kept.state, State::kSegment)) SetState(&kept, absorbed.state);
  kept.grew = true;
  MarkDirty(&kept);

  SetState(&absorbed, State::kFree);
  absorbed = Cluster();
  free_clusters_.push_back(absorbed_index);
  return a;
}

template <class Policy>
void IncrementalSegmenter<Policy>::MarkDirty(Cluster* cluster) {
  if (cluster->dirty) return;
  cluster->dirty = true;
  dirty_.push_back(static_cast<ClusterIndex>(cluster - clusters_.data()));
}

/// Ends a call: every set of linked clusters is one cluster now, with one segment ID or none.
template <class Policy>
SegmentUpdate IncrementalSegmenter<Policy>::Settle() {
  SegmentUpdate update;
  for (const ClusterIndex index : dirty_)
    if (clusters_[index].dirty) SettleCluster(index, &update);
  dirty_.clear();
  return update;
}

template <class Policy>
void IncrementalSegmenter<Policy>::SettleCluster(ClusterIndex index, SegmentUpdate* update) {
  Cluster& cluster = clusters_[index];
  cluster.dirty = false;
  const bool grew = std::exchange(cluster.grew, false);
  std::vector<SegmentId> ids = std::exchange(cluster.absorbed, {});
  if (cluster.id != kNoSegment) ids.push_back(cluster.id);
  const auto retire = [&](RetirementCause cause) {
    for (const SegmentId id : ids) {
      update->retired.push_back({id, cause});
      Untrack(id);
    }
    cluster.id = kNoSegment;
  };

  if (cluster.live_voxels == 0) {
    retire(RetirementCause::kLeft);
    free_nodes_.push_back(cluster.root);
    SetState(&cluster, State::kFree);
    cluster = Cluster();
    free_clusters_.push_back(index);
    return;
  }
  const std::size_t size = cluster.moments.count();
  if (size > parameters_.max_cluster_size) SetState(&cluster, State::kTooLarge);
  if (cluster.state == State::kTooLarge) {
    retire(RetirementCause::kTooLarge);
  } else if (cluster.state == State::kCut) {
    retire(RetirementCause::kCut);
  } else if (!ids.empty()) {
    SetState(&cluster, State::kSegment);
    cluster.id = *std::min_element(ids.begin(), ids.end());
    for (const SegmentId id : ids) {
      if (id == cluster.id) continue;
      update->renamed.push_back({id, cluster.id});
      Untrack(id);
    }
    Track(cluster.id, index);
    if (grew) update->grown.push_back(cluster.id);
  } else if (cluster.state != State::kTrail && size >= parameters_.min_cluster_size) {
    SetState(&cluster, State::kSegment);
    cluster.id = next_id_++;
    Track(cluster.id, index);
    update->created.push_back(cluster.id);
  }
}

template <class Policy>
std::size_t& IncrementalSegmenter<Policy>::CountOf(State state) {
  switch (state) {
    case State::kSmall:
      return counts_.too_small;
    case State::kSegment:
      return counts_.segments;
    case State::kTooLarge:
      return counts_.too_large;
    case State::kTrail:
      return counts_.trails;
    default:
      return counts_.cut;
  }
}

template <class Policy>
void IncrementalSegmenter<Policy>::SetState(Cluster* cluster, State state) {
  if (cluster->state == State::kFree) {
    ++counts_.clusters;
  } else {
    --CountOf(cluster->state);
  }
  if (state == State::kFree) {
    --counts_.clusters;
  } else {
    ++CountOf(state);
  }
  cluster->state = state;
}

template <class Policy>
void IncrementalSegmenter<Policy>::Track(SegmentId segment, ClusterIndex cluster) {
  const auto at = std::lower_bound(tracked_.begin(), tracked_.end(), std::make_pair(segment, ClusterIndex{0}));
  if (at != tracked_.end() && at->first == segment) {
    at->second = cluster;
  } else {
    tracked_.insert(at, {segment, cluster});
  }
}

template <class Policy>
void IncrementalSegmenter<Policy>::Untrack(SegmentId segment) {
  tracked_.erase(std::lower_bound(tracked_.begin(), tracked_.end(), std::make_pair(segment, ClusterIndex{0})));
}

template <class Policy>
typename IncrementalSegmenter<Policy>::ClusterIndex IncrementalSegmenter<Policy>::TrackedIndex(
    SegmentId segment) const {
  const auto at = std::lower_bound(tracked_.begin(), tracked_.end(), std::make_pair(segment, ClusterIndex{0}));
  if (at == tracked_.end() || at->first != segment)
    throw std::invalid_argument("segment " + std::to_string(segment) + " is not tracked");
  return at->second;
}

template <class Policy>
const SegmentMoments& IncrementalSegmenter<Policy>::Moments(SegmentId segment) const {
  return clusters_[TrackedIndex(segment)].moments;
}

template <class Policy>
SegmentId IncrementalSegmenter<Policy>::SegmentOf(VoxelHandle voxel) const {
  return IsClustered(voxel) ? clusters_[ClusterOf(voxel)].id : kNoSegment;
}

template <class Policy>
std::uint32_t IncrementalSegmenter<Policy>::ClusterOf(VoxelHandle voxel) const {
  if (!IsClustered(voxel)) throw std::invalid_argument("voxel " + std::to_string(voxel) + " is in no cluster");
  return nodes_[FindRoot(LabelOf(voxel))].cluster;
}

template <class Policy>
std::vector<SegmentId> IncrementalSegmenter<Policy>::Segments() const {
  std::vector<SegmentId> segments;
  segments.reserve(tracked_.size());
  for (const auto& entry : tracked_) segments.push_back(entry.first);
  return segments;
}

template <class Policy>
std::size_t IncrementalSegmenter<Policy>::memory_bytes() const {
  return nodes_.capacity() * sizeof(Node) + free_nodes_.capacity() * sizeof(Label) +
         clusters_.capacity() * sizeof(Cluster) + free_clusters_.capacity() * sizeof(ClusterIndex) +
         blocks_.memory_bytes() + more_parts_.memory_bytes() + free_parts_.capacity() * sizeof(std::uint32_t) +
         (seeds_.capacity() + queue_.capacity() + region_.capacity() + rough_.capacity()) * sizeof(VoxelHandle);
}

template class IncrementalSegmenter<EuclideanPolicy>;
template class IncrementalSegmenter<SmoothnessPolicy>;

}  // namespace incremental_segmatch
