/// \file
/// Incremental region growing with segment tracking (METHOD 3; thesis 3.3).
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <utility>
#include <vector>

#include "incremental_segmatch/dynamic_voxel_grid.hpp"
#include "incremental_segmatch/growing_policies.hpp"
#include "incremental_segmatch/paged_array.hpp"
#include "incremental_segmatch/segment_moments.hpp"
#include "incremental_segmatch/types.hpp"

namespace incremental_segmatch {

/// What happens to a segment that the boundary of the local map cuts.
enum class BoundaryPolicy {
  kInvalidate,  ///< thesis: it is no segment any more, nor is what merges with it
  kKeep         ///< it stays a segment until it has left entirely; its sums keep the points that left
};

/// Which clusters are segments.
struct SegmenterParameters {
  double growing_radius_m = 0.2;                    ///< voxels whose centroids are this near belong together
  std::size_t min_cluster_size = 100;               ///< voxels; smaller clusters are no segments
  std::size_t max_cluster_size = 15000;             ///< voxels; larger clusters are no segments
  BoundaryPolicy boundary = BoundaryPolicy::kKeep;  ///< what becomes of segments at the boundary of the local map
};

/// Why tracking of a segment ended; see the table of METHOD 3 for what it means to the target map.
enum class RetirementCause {
  kTooLarge,  ///< it was no segment: it leaves the map
  kCut,       ///< partly left the local map (kInvalidate), or merged with such a cluster: its views stay
  kLeft,      ///< all its points have left the local map: its views stay
  kTrail      ///< it is the trail of a moving object, and was no segment: it leaves the map
};

/// A segment that is tracked no longer.
struct RetiredSegment {
  SegmentId id = kNoSegment;                       ///< which never returns
  RetirementCause cause = RetirementCause::kLeft;  ///< why
};

/// Two segments that merged.
struct RenamedSegment {
  SegmentId from = kNoSegment;  ///< the newer; it exists no longer
  SegmentId to = kNoSegment;    ///< the older
};

/// What one call changed. A segment appears in at most one of the four lists as itself (`renamed.from`, `retired`,
/// `created`, `grown`); the target of a renaming is also in `grown` or `retired`.
struct SegmentUpdate {
  std::vector<SegmentId> created;       ///< new segments
  std::vector<SegmentId> grown;         ///< points came or moved
  std::vector<RenamedSegment> renamed;  ///< merged segments
  std::vector<RetiredSegment> retired;  ///< segments that ended
};

/// Counts for the funnel: clusters by what became of them.
struct ClusterCounts {
  std::size_t clusters = 0;   ///< all
  std::size_t segments = 0;   ///< of them, segments
  std::size_t too_small = 0;  ///< of them, too small so far
  std::size_t too_large = 0;  ///< of them, too large
  std::size_t cut = 0;        ///< of them, cut by the boundary
  std::size_t trails = 0;     ///< of them, trails of moving objects
};

/// Clusters the active voxels of a grid as they come and keeps track of segments: what IncrementalSegmenter is to those
/// who choose its policy at run time. One call of it is one call for a whole step; the policy is called inside of it.
class Segmenter {
 public:
  virtual ~Segmenter() = default;

  /// Takes removed voxels out. To be called before the grid is called again.
  virtual SegmentUpdate Remove(const std::vector<RemovedVoxel>& removed) = 0;

  /// Clusters activated voxels and follows moved centroids.
  virtual SegmentUpdate Insert(const VoxelUpdate& update) = 0;

  /// Segments turned out to be trails of moving objects: they are segments no more. What such a cluster merges with
  /// stays, or becomes, what it is: a segment goes on with the trail as a part of it. Throws std::invalid_argument if
  /// one is not tracked. O(trails log segments).
  virtual SegmentUpdate DismissTrails(const std::vector<SegmentId>& trails) = 0;

  /// Sums over a segment's voxels. O(1).
  virtual const SegmentMoments& Moments(SegmentId segment) const = 0;
  /// The segment of a voxel, kNoSegment if its cluster is none. Amortised nearly O(1).
  virtual SegmentId SegmentOf(VoxelHandle voxel) const = 0;
  /// All tracked segments, ascending.
  virtual std::vector<SegmentId> Segments() const = 0;

  /// Counts of clusters. O(1).
  virtual const ClusterCounts& counts() const = 0;
  /// Memory held, about. O(1).
  virtual std::size_t memory_bytes() const = 0;
};

/// The segmenter of a growing policy.
///
/// Clusters are the connected components over all voxels ever clustered, under the relation "within the growing radius,
/// and accepted by the policy, when the later of the two was clustered"; a cluster never splits. Where the policy lets
/// not every point seed, only points that may seed link; one that may not joins the flattest of the points around it
/// that accept it, alone. Union-find over labels persists between calls; labels and clusters are reference-counted and
/// reclaimed. Labels are carried by parts of the grid's blocks, so that many voxels can be settled at once. Remove is
/// O(removed), Insert O(activated * neighbours + moved), both nearly. Not thread-safe. The grid must outlive the
/// segmenter.
template <class Policy>
class IncrementalSegmenter final : public Segmenter {
 public:
  /// Throws std::invalid_argument naming the parameter that is out of range.
  IncrementalSegmenter(const SegmenterParameters& parameters, const DynamicVoxelGrid& grid, Policy policy = {});

  SegmentUpdate Remove(const std::vector<RemovedVoxel>& removed) override;
  SegmentUpdate Insert(const VoxelUpdate& update) override;
  SegmentUpdate DismissTrails(const std::vector<SegmentId>& trails) override;
  const SegmentMoments& Moments(SegmentId segment) const override;
  SegmentId SegmentOf(VoxelHandle voxel) const override;
  std::vector<SegmentId> Segments() const override;
  const ClusterCounts& counts() const override { return counts_; }
  std::size_t memory_bytes() const override;

  /// A name of the voxel's cluster that is the same for exactly the voxels of one cluster, until the next call.
  std::uint32_t ClusterOf(VoxelHandle voxel) const;

 private:
  using Label = std::uint32_t;
  using ClusterIndex = std::uint32_t;
  static constexpr Label kNoLabel = 0xffffffffu;
  static constexpr std::uint32_t kNoPart = 0xffffffffu;
  static constexpr std::uint32_t kBeside = 0xfffffffeu;  // the next one in memory

  enum class State : std::uint8_t { kFree, kSmall, kSegment, kTrail, kCut, kTooLarge };  // of two that link, the later

  // A label: node of the union-find forest.
  struct Node {
    Label parent = kNoLabel;       // itself at roots
    std::uint32_t references = 0;  // parts that carry it, and nodes that point to it
    ClusterIndex cluster = 0;      // at roots
  };
  struct Cluster {
    State state = State::kFree;
    bool dirty = false;
    bool grew = false;
    SegmentId id = kNoSegment;
    Label root = kNoLabel;
    std::uint32_t live_voxels = 0;    // in the local map now
    SegmentMoments moments;           // kTooLarge: of the voxels until then, nobody will read them again
    std::vector<SegmentId> absorbed;  // IDs of segments that merged into it in this call
  };
  // Clustered voxels of a block that carry one label.
  struct Part {
    std::uint64_t cells = 0;       // none: the part is free
    Label label = kNoLabel;        // of a free part: none
    std::uint32_t next = kNoPart;  // of more_parts_, or kBeside
  };
  // What is known of a block of the grid, so that its voxels need not be looked at one by one. Active cells that are
  // neither pending nor clustered are of the region that grows now. Few blocks hold more than three clusters: further
  // parts hang on the last of these.
  struct alignas(64) BlockNode {
    std::uint64_t pending = 0;    // cells that are active and neither clustered nor queued yet
    std::uint64_t clustered = 0;  // cells that are clustered: those of all parts
    std::array<Part, 3> parts{{{0, kNoLabel, kBeside}, {0, kNoLabel, kBeside}, {0, kNoLabel, kNoPart}}};
  };

  bool IsClustered(VoxelHandle voxel) const {
    return voxel / DynamicVoxelGrid::kCellsPerBlock < blocks_.size() &&
           (BlockOf(voxel).clustered & CellBit(voxel)) != 0;
  }
  // The block's part after this one; null after the last.
  const Part* Next(const Part* part) const {
    if (part->next == kBeside) return part + 1;
    return part->next != kNoPart ? &more_parts_[part->next] : nullptr;
  }
  Part* Next(Part* part) { return const_cast<Part*>(Next(static_cast<const Part*>(part))); }
  // The part of a clustered cell.
  const Part& PartOf(const BlockNode& block, std::uint64_t bit) const {
    const Part* part = &block.parts.front();
    while ((part->cells & bit) == 0) part = Next(part);
    return *part;
  }
  // Of a clustered voxel.
  Label LabelOf(VoxelHandle voxel) const { return PartOf(BlockOf(voxel), CellBit(voxel)).label; }
  Eigen::Vector3d PointOf(VoxelHandle voxel, const Eigen::Vector3f& in_block) const {
    return grid_->BlockCorner(voxel) + in_block.cast<double>();
  }
  static std::uint64_t CellBit(VoxelHandle voxel) {
    return std::uint64_t{1} << (voxel % DynamicVoxelGrid::kCellsPerBlock);
  }
  BlockNode& BlockOf(VoxelHandle voxel) { return blocks_[voxel / DynamicVoxelGrid::kCellsPerBlock]; }
  const BlockNode& BlockOf(VoxelHandle voxel) const { return blocks_[voxel / DynamicVoxelGrid::kCellsPerBlock]; }
  Label FindRoot(Label label) const;
  void Release(Label label) const;
  Cluster& ClusterAt(Label root) { return clusters_[nodes_[root].cluster]; }
  Label NewCluster();
  void PrefetchAround(VoxelHandle voxel) const;
  void GrowFromSeed(VoxelHandle seed);
  void FollowCentroids(const std::vector<MovedVoxel>& moved);
  void Queue(VoxelHandle voxel);
  Label Meet(Label root, Label other);
  void SetLabel(Part* part, Label label);
  Part& PartFor(BlockNode* block, Label root);
  void RemoveCell(BlockNode* block, std::uint64_t bit);
  Label VisitNeighbours(VoxelHandle from, Label root);
  void JoinFlattestCluster(VoxelHandle voxel);
  void AddVoxel(Label root, VoxelHandle voxel);
  Label Link(Label a, Label b);
  void MarkDirty(Cluster* cluster);
  SegmentUpdate Settle();
  void SettleCluster(ClusterIndex index, SegmentUpdate* update);
  void SetState(Cluster* cluster, State state);
  std::size_t& CountOf(State state);
  void Track(SegmentId segment, ClusterIndex cluster);
  void Untrack(SegmentId segment);
  ClusterIndex TrackedIndex(SegmentId segment) const;

  SegmenterParameters parameters_;
  const DynamicVoxelGrid* grid_;
  Policy policy_;
  NeighbourStencil stencil_;
  mutable std::vector<Node> nodes_;  // mutable: finding a root shortens its path
  mutable std::vector<Label> free_nodes_;
  std::vector<Cluster> clusters_;
  std::vector<ClusterIndex> free_clusters_;
  PagedArray<BlockNode> blocks_;  // by handle / DynamicVoxelGrid::kCellsPerBlock
  PagedArray<Part> more_parts_;   // of blocks that have more than they hold
  std::uint32_t part_slots_ = 0;  // of them, ever used
  std::vector<std::uint32_t> free_parts_;
  std::vector<ClusterIndex> dirty_;
  std::vector<std::pair<SegmentId, ClusterIndex>> tracked_;  // ascending IDs
  std::vector<VoxelHandle> seeds_, queue_, region_, rough_;  // work space
  SegmentId next_id_ = 1;
  ClusterCounts counts_;
};

extern template class IncrementalSegmenter<EuclideanPolicy>;
extern template class IncrementalSegmenter<SmoothnessPolicy>;

}  // namespace incremental_segmatch
