#include "incremental_segmatch/target_index.hpp"

#include <algorithm>
#include <limits>
#include <stdexcept>
#include <string>
#include <tuple>
#include <utility>

namespace incremental_segmatch {

void TargetIndex::Open(const SegmentKey& segment, const TargetMap& map, std::size_t released, bool others_too) {
  const TargetSegment* target = map.Find(segment);
  if (target == nullptr) throw std::invalid_argument("segment " + std::to_string(segment.id) + " is not in the map");
  const std::size_t open = others_too ? target->views.size() : std::min(released, target->views.size());
  for (std::uint32_t view = 0; view < open; ++view) {
    const bool is_released = view < released;
    std::vector<std::uint64_t>& items = items_[segment];
    const auto present =
        std::find_if(items.begin(), items.end(), [&](std::uint64_t item) { return views_[item].view == view; });
    if (present != items.end()) {
      if (views_[*present].released == is_released) continue;
      Erase(*present);  // what its own robot may see from now on is new to it
      items.erase(present);
    }
    const SegmentView& taken = target->views[view];
    Insert({segment, view, taken.robot, true, is_released, 0, taken.descriptor, map.CentroidMap(taken)});
  }
  if (!index_) return;
  if (index_->size() >= rescale_at_) {
    Rescale();
  } else if (views_.size() >= 2 * std::max(index_->size(), rescale_at_)) {
    Compact();
  }
}

void TargetIndex::Close(const SegmentKey& segment) {
  const auto found = items_.find(segment);
  if (found == items_.end()) return;
  for (const std::uint64_t item : found->second) Erase(item);
  items_.erase(found);
}

void TargetIndex::Erase(std::uint64_t item) {
  index_->Remove(item);
  views_[item].live = false;
  views_[item].descriptor = Descriptor();
}

void TargetIndex::RefreshCentroids(const TargetMap& map) {
  for (const auto& [segment, items] : items_) {
    const TargetSegment* target = map.Find(segment);
    for (const std::uint64_t item : items)
      views_[item].centroid_map = map.CentroidMap(target->views[views_[item].view]);
  }
}

std::vector<TargetCandidate> TargetIndex::Nearest(const Descriptor& query, RobotIndex robot, std::size_t count,
                                                  float max_distance, const std::vector<TargetCandidate>& known) const {
  if (!index_) return {};
  RequireSize(query);
  std::vector<TargetCandidate> candidates;
  float radius = std::min(max_distance, FarthestOf(known, query, robot, count));
  index_->Search(query.cwiseProduct(weights_), radius, [&](std::uint64_t item, float distance) {
    __builtin_prefetch(&views_[item]);
    candidates.push_back({item, SegmentKey(), distance});
    if (count != 0 && candidates.size() >= 4 * count) {
      KeepNearest(robot, count, &candidates);
      if (candidates.size() == count) radius = candidates.back().distance;
    }
    return radius;
  });
  KeepNearest(robot, count, &candidates);
  return candidates;
}

/// Leaves the most alike view of each segment, of those that are open to the robot, and of them the `count` nearest (0:
/// all), by ascending (distance, segment). Fills in the segments.
void TargetIndex::KeepNearest(RobotIndex robot, std::size_t count, std::vector<TargetCandidate>* candidates) const {
  const auto closed = [&](const TargetCandidate& c) { return !IsOpen(c.item, robot); };
  candidates->erase(std::remove_if(candidates->begin(), candidates->end(), closed), candidates->end());
  for (TargetCandidate& candidate : *candidates) candidate.segment = views_[candidate.item].segment;

  std::sort(candidates->begin(), candidates->end(), [](const TargetCandidate& a, const TargetCandidate& b) {
    return std::tie(a.distance, a.segment, a.item) < std::tie(b.distance, b.segment, b.item);
  });
  std::vector<bool> seen(views_.size());
  std::size_t kept = 0;
  for (const TargetCandidate& candidate : *candidates) {
    const std::uint64_t first = views_[candidate.item].first;
    if (seen[first]) continue;
    seen[first] = true;
    (*candidates)[kept++] = candidate;
  }
  candidates->resize(count == 0 ? kept : std::min(kept, count));
}

void TargetIndex::RequireSize(const Descriptor& descriptor) const {
  if (descriptor.size() != weights_.size())
    throw std::invalid_argument("a descriptor of " + std::to_string(descriptor.size()) +
                                " values does not fit the map's " + std::to_string(weights_.size()) +
                                ": use the descriptor settings that the map was made with");
}

/// An upper bound of how far the `count` nearest segments are; infinity if fewer than that are known.
float TargetIndex::FarthestOf(const std::vector<TargetCandidate>& known, const Descriptor& query, RobotIndex robot,
                              std::size_t count) const {
  constexpr float kRounding = 1e-5f;
  std::size_t open = 0;
  float farthest = 0.f;
  for (const TargetCandidate& candidate : known) {
    if (open == count) break;
    if (!IsOpen(candidate.item, robot)) continue;
    farthest = std::max(farthest, Distance(query, views_[candidate.item].descriptor));
    ++open;
  }
  if (count == 0 || open < count) return std::numeric_limits<float>::infinity();
  return farthest * (1.f + kRounding) + kRounding;
}

void TargetIndex::Insert(IndexedView view) {
  if (!index_) {
    weights_ = Descriptor::Ones(view.descriptor.size());
    index_.emplace(static_cast<std::size_t>(weights_.size()));
  }
  RequireSize(view.descriptor);
  const std::uint64_t item = views_.size();
  std::vector<std::uint64_t>& items = items_[view.segment];
  view.first = items.empty() ? item : views_[items.front()].first;
  items.push_back(item);
  index_->Insert(item, view.descriptor.cwiseProduct(weights_));
  views_.push_back(std::move(view));
}

/// Scales by the data that are there now.
void TargetIndex::Rescale() {
  rescale_at_ = 2 * index_->size();
  const Eigen::Index dimensions = weights_.size();
  Eigen::VectorXd sum = Eigen::VectorXd::Zero(dimensions), squares = sum;
  for (const IndexedView& view : views_) {
    if (!view.live) continue;
    sum += view.descriptor.cast<double>();
    squares += view.descriptor.cast<double>().cwiseAbs2();
  }
  const double n = static_cast<double>(index_->size());
  const Eigen::VectorXd variance = squares / n - (sum / n).cwiseAbs2();
  constexpr double kLeastDeviation = 1e-3;  // a dimension that never varies tells nothing, whatever its rounding errors
  for (Eigen::Index i = 0; i < dimensions; ++i)
    weights_[i] =
        static_cast<float>(variance[i] > kLeastDeviation * kLeastDeviation ? 1.0 / std::sqrt(variance[i]) : 0.0);

  Compact();
}

/// Forgets items that were closed: in a map that does not grow, segments come and go all the same.
void TargetIndex::Compact() {
  ++generation_;
  std::vector<IndexedView> views;
  for (IndexedView& view : views_)
    if (view.live) views.push_back(std::move(view));
  index_.emplace(static_cast<std::size_t>(weights_.size()));
  views_.clear();
  items_.clear();
  for (IndexedView& view : views) Insert(std::move(view));
}

}  // namespace incremental_segmatch
