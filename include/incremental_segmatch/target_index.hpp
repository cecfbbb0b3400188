/// \file
/// Which views of the target map are open to matching, and the nearest of them (METHOD 4: matching).
#pragma once

#include <cstddef>
#include <cstdint>
#include <map>
#include <optional>
#include <unordered_map>
#include <utility>
#include <vector>

#include "incremental_segmatch/descriptor_index.hpp"
#include "incremental_segmatch/target_map.hpp"

namespace incremental_segmatch {

/// A view that is, or was, open to matching: what a search asks of it, so that many fit into a cache.
struct IndexedView {
  SegmentKey segment;      ///< whose view it is
  std::uint32_t view = 0;  ///< index among the segment's views
  RobotIndex robot = 0;    ///< who took it
  bool live = false;       ///< false once its segment was closed
  bool released = false;   ///< open to that robot as well, not only to others
};

/// A target segment that looks like a local one, by its most alike view.
struct TargetCandidate {
  std::uint64_t item = 0;  ///< names the view in the index
  SegmentKey segment;      ///< the target segment
  float distance = 0.f;    ///< scaled descriptor distance
};

/// Takes a candidate into a list of the `count` nearest segments (0: all), one view of each, by ascending (distance,
/// segment); of views that are equally near that which was opened first. O(list).
void TakeIn(const TargetCandidate& candidate, std::size_t count, std::vector<TargetCandidate>* nearest);

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
  /// differs in size from the descriptors that are there. O(views * dimensions, and views that are near * count).
  std::vector<TargetCandidate> Nearest(const Descriptor& query, RobotIndex robot, std::size_t count, float max_distance,
                                       const std::vector<TargetCandidate>& known = {}) const;
  /// Centroids in the map (m) of the views that are open to this robot and at most `radius_m` from a place there, in no
  /// particular order. O(views in the squares of 20 m around, and a search of a square for each row of them).
  std::vector<Eigen::Vector3d> CentroidsAround(const Eigen::Vector3d& place_map, double radius_m, RobotIndex robot) const;
  /// True if the item still stands for a view that is open to this robot.
  bool IsOpen(std::uint64_t item, RobotIndex robot) const {
    return views_[item].live && (views_[item].released || views_[item].robot != robot);
  }
  /// Scaled distance of two descriptors.
  float Distance(const Eigen::Ref<const Descriptor>& a, const Eigen::Ref<const Descriptor>& b) const {
    return (a - b).cwiseProduct(weights_).norm();
  }

  /// A view by its item. O(1).
  const IndexedView& view(std::uint64_t item) const { return views_[item]; }
  /// Descriptor of a live view, unscaled. O(1).
  Eigen::Map<const Descriptor> descriptor(std::uint64_t item) const {
    return {&descriptors_[item * static_cast<std::size_t>(weights_.size())], weights_.size()};
  }
  /// Centroid of a view in the map (m), at the time of insertion or of the last correction. O(1).
  const Eigen::Vector3d& centroid_map(std::uint64_t item) const { return centroids_map_[item]; }
  /// Items are numbered as they come: those from here on are newer than now.
  std::uint64_t next_item() const { return views_.size(); }
  /// Changes with the scaling: distances and item numbers from before are void then.
  std::uint64_t generation() const { return generation_; }

 private:
  /// A square of the horizontal plane, by x and y.
  using Cell = std::pair<std::int64_t, std::int64_t>;
  static Cell CellOf(const Eigen::Vector3d& centroid_map);

  using DescriptorRef = Eigen::Ref<const Descriptor>;
  void RequireSize(const DescriptorRef& descriptor) const;
  float FarthestOf(const std::vector<TargetCandidate>& known, const Descriptor& query, RobotIndex robot,
                   std::size_t count) const;
  void Insert(const IndexedView& view, const DescriptorRef& descriptor, const Eigen::Vector3d& centroid_map);
  void Erase(std::uint64_t item);
  void Rescale();
  void Compact();

  Descriptor weights_;  // one over the scale of each dimension
  // By item:
  std::vector<IndexedView> views_;
  std::vector<float> descriptors_;  // one after the other
  std::vector<Eigen::Vector3d> centroids_map_;

  std::unordered_map<SegmentKey, std::vector<std::uint64_t>, SegmentKeyHash> items_;
  std::map<Cell, std::vector<std::uint64_t>> cells_;  // live items by where their centroids are
  std::optional<DescriptorIndex> index_;
  std::size_t rescale_at_ = 32;
  std::uint64_t generation_ = 0;
};

}  // namespace incremental_segmatch
