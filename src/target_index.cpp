#include "incremental_segmatch/target_index.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>
#include <string>
#include <tuple>
#include <utility>

namespace incremental_segmatch {
namespace {

bool Precedes(const TargetCandidate& a, const TargetCandidate& b) {
  return std::tie(a.distance, a.segment, a.item) < std::tie(b.distance, b.segment, b.item);
}

}  // namespace

void TakeIn(const TargetCandidate& candidate, std::size_t count, std::vector<TargetCandidate>* nearest) {
  const auto same = std::find_if(nearest->begin(), nearest->end(),
                                 [&](const TargetCandidate& other) { return other.segment == candidate.segment; });
  if (same != nearest->end()) {
    if (!Precedes(candidate, *same)) return;
    nearest->erase(same);
  }
  nearest->insert(std::upper_bound(nearest->begin(), nearest->end(), candidate, Precedes), candidate);
  if (count != 0 && nearest->size() > count) nearest->pop_back();
}

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
    Insert({segment, view, taken.robot, true, is_released}, taken.descriptor, map.CentroidMap(taken));
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
  const auto cell = cells_.find(CellOf(centroids_map_[item]));
  cell->second.erase(std::find(cell->second.begin(), cell->second.end(), item));
  if (cell->second.empty()) cells_.erase(cell);
  views_[item].live = false;
}

void TargetIndex::RefreshCentroids(const TargetMap& map) {
  cells_.clear();
  for (const auto& [segment, items] : items_) {
    const TargetSegment* target = map.Find(segment);
    for (const std::uint64_t item : items) {
      centroids_map_[item] = map.CentroidMap(target->views[views_[item].view]);
      cells_[CellOf(centroids_map_[item])].push_back(item);
    }
  }
}

std::vector<TargetCandidate> TargetIndex::Nearest(const Descriptor& query, RobotIndex robot, std::size_t count,
                                                  float max_distance, const std::vector<TargetCandidate>& known) const {
  if (!index_) return {};
  RequireSize(query);
  std::vector<TargetCandidate> nearest;
  nearest.reserve(std::min(count, segments()) + 1);
  float radius = std::min(max_distance, FarthestOf(known, query, robot, count));
  index_->Search(query.cwiseProduct(weights_), radius, [&](std::uint64_t item, float distance) {
    if (!IsOpen(item, robot)) return radius;
    TakeIn({item, views_[item].segment, distance}, count, &nearest);
    if (count != 0 && nearest.size() == count) radius = nearest.back().distance;
    return radius;
  });
  return nearest;
}

std::vector<Eigen::Vector3d> TargetIndex::CentroidsAround(const Eigen::Vector3d& place_map, double radius_m,
                                                          RobotIndex robot) const {
  std::vector<Eigen::Vector3d> centroids_map;
  const Eigen::Vector3d reach = Eigen::Vector3d::Constant(radius_m);
  const Cell first = CellOf(place_map - reach), last = CellOf(place_map + reach);
  for (auto it = cells_.lower_bound(first); it != cells_.end() && it->first.first <= last.first;) {
    const auto [x, y] = it->first;
    if (y < first.second || y > last.second) {  // on to the next of these rows that there is
      it = cells_.lower_bound({y < first.second ? x : x + 1, first.second});
      continue;
    }
    for (const std::uint64_t item : it->second) {
      const Eigen::Vector3d& centroid_map = centroids_map_[item];
      if (IsOpen(item, robot) && (centroid_map - place_map).squaredNorm() <= radius_m * radius_m)
        centroids_map.push_back(centroid_map);
    }
    ++it;
  }
  return centroids_map;
}

TargetIndex::Cell TargetIndex::CellOf(const Eigen::Vector3d& centroid_map) {
  constexpr double kCellM = 20.0;
  return {static_cast<std::int64_t>(std::floor(centroid_map.x() / kCellM)),
          static_cast<std::int64_t>(std::floor(centroid_map.y() / kCellM))};
}

void TargetIndex::RequireSize(const DescriptorRef& descriptor) const {
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
    farthest = std::max(farthest, Distance(query, descriptor(candidate.item)));
    ++open;
  }
  if (count == 0 || open < count) return std::numeric_limits<float>::infinity();
  return farthest * (1.f + kRounding) + kRounding;
}

void TargetIndex::Insert(const IndexedView& view, const DescriptorRef& descriptor, const Eigen::Vector3d& centroid_map) {
  if (!index_) {
    weights_ = Descriptor::Ones(descriptor.size());
    index_.emplace(static_cast<std::size_t>(weights_.size()));
  }
  RequireSize(descriptor);
  const std::uint64_t item = views_.size();
  index_->Insert(item, descriptor.cwiseProduct(weights_));
  items_[view.segment].push_back(item);
  cells_[CellOf(centroid_map)].push_back(item);
  views_.push_back(view);
  descriptors_.insert(descriptors_.end(), descriptor.begin(), descriptor.end());
  centroids_map_.push_back(centroid_map);
}

/// Scales by the data that are there now.
void TargetIndex::Rescale() {
  rescale_at_ = 2 * index_->size();
  const Eigen::Index dimensions = weights_.size();
  Eigen::VectorXd sum = Eigen::VectorXd::Zero(dimensions), squares = sum;
  for (std::uint64_t item = 0; item < next_item(); ++item) {
    if (!views_[item].live) continue;
    sum += descriptor(item).cast<double>();
    squares += descriptor(item).cast<double>().cwiseAbs2();
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
  index_.emplace(static_cast<std::size_t>(weights_.size()));
  items_.clear();
  cells_.clear();
  const std::vector<IndexedView> views = std::exchange(views_, {});
  const std::vector<float> descriptors = std::exchange(descriptors_, {});
  const std::vector<Eigen::Vector3d> centroids_map = std::exchange(centroids_map_, {});
  const auto size = static_cast<std::size_t>(weights_.size());
  for (std::size_t item = 0; item < views.size(); ++item)
    if (views[item].live)
      Insert(views[item], Eigen::Map<const Descriptor>(&descriptors[item * size], weights_.size()), centroids_map[item]);
}

}  // namespace incremental_segmatch
