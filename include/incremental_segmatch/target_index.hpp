/// \file
/// Which views of the target map are open to matching, and the nearest of them (METHOD 4: matching).
#pragma once

#include <cstddef>
#include <cstdint>
#include <optional>
#include <unordered_map>
#include <vector>

#include "incremental_segmatch/descriptor_index.hpp"
#include "incremental_segmatch/target_map.hpp"

namespace incremental_segmatch {

/// A view that is, or was, open to matching.
struct IndexedView {
  SegmentKey segment;                                      ///< whose view it is
  std::uint32_t view = 0;                                  ///< index among the segment's views
  RobotIndex robot = 0;                                    ///< who took it
  bool live = false;                                       ///< false once its segment was closed
  bool released = false;                                   ///< open to that robot as well, not only to others
  std::uint64_t first = 0;                                 ///< item of the segment's first view: the same for all of them
  Descriptor descriptor;                                   ///< unscaled
  Eigen::Vector3d centroid_map = Eigen::Vector3d::Zero();  ///< in the map (m), at the time of insertion
};

/// A target segment that looks like a local one, by its most alike view.
struct TargetCandidate {
  std::uint64_t item = 0;  ///< names the view in the index
  SegmentKey segment;      ///< the target segment
  float distance = 0.f;    ///< scaled descriptor distance
};

/// Nearest target segments by descriptor. Dimensions are scaled by their standard deviation over the indexed views,
/// taken anew each time that their number has doubled. Not thread-safe.
class TargetIndex {
 public:
  /// Opens views of a segment of the map to matching: the oldest `released` ones by all robots, and the others, if
  /// `others_too`, by other robots than the one that took them. What is open already stays; close a segment before its
  /// views change. Throws std::invalid_argument if its descriptors differ in size from those that are there. O(views of
  /// it).
  void Open(const SegmentKey& segment, const TargetMap& map, std::size_t released, bool others_too);
  /// Closes a segment; nothing happens if it isn't open.
  void Close(const SegmentKey& segment);
  /// Takes centroids from the map anew, after a correction. O(views).
  void RefreshCentroids(const TargetMap& map);

  /// Segments with views in the index.
  std::size_t segments() const { return items_.size(); }

  /// The `count` nearest segments (0: all) within `max_distance` that are open to this robot, by ascending (distance,
  /// segment). What an earlier query of the same generation found, one view a segment, may be given as `known`: nothing
  /// farther than those need be looked at. The result is the same without. Throws std::invalid_argument if the query
  /// differs in size from the descriptors that are there.
  std::vector<TargetCandidate> Nearest(const Descriptor& query, RobotIndex robot, std::size_t count, float max_distance,
                                       const std::vector<TargetCandidate>& known = {}) const;
  /// True if the item still stands for a view that is open to this robot.
  bool IsOpen(std::uint64_t item, RobotIndex robot) const {
    return views_[item].live && (views_[item].released || views_[item].robot != robot);
  }
  /// Scaled distance of two descriptors.
  float Distance(const Descriptor& a, const Descriptor& b) const { return (a - b).cwiseProduct(weights_).norm(); }

  /// A view by its item. O(1).
  const IndexedView& view(std::uint64_t item) const { return views_[item]; }
  /// Items are numbered as they come: those from here on are newer than now.
  std::uint64_t next_item() const { return views_.size(); }
  /// Changes with the scaling: distances and item numbers from before are void then.
  std::uint64_t generation() const { return generation_; }

 private:
  void RequireSize(const Descriptor& descriptor) const;
  float FarthestOf(const std::vector<TargetCandidate>& known, const Descriptor& query, RobotIndex robot,
                   std::size_t count) const;
  void KeepNearest(RobotIndex robot, std::size_t count, std::vector<TargetCandidate>* candidates) const;
  void Insert(IndexedView view);
  void Erase(std::uint64_t item);
  void Rescale();
  void Compact();

  Descriptor weights_;  // one over the scale of each dimension
  std::vector<IndexedView> views_;
  std::unordered_map<SegmentKey, std::vector<std::uint64_t>, SegmentKeyHash> items_;
  std::optional<DescriptorIndex> index_;
  std::size_t rescale_at_ = 32;
  std::uint64_t generation_ = 0;
};

}  // namespace incremental_segmatch
