#include "incremental_segmatch/descriptor_index.hpp"

#include <limits>
#include <stdexcept>

#include "several_targets.hpp"

namespace incremental_segmatch {
namespace {

constexpr float kRoom = std::numeric_limits<float>::quiet_NaN();  // for one more value; near nothing

/// Sixteen floats that are computed with at once (GCC, Clang): each processor with the widest registers that it has.
using Vector = float __attribute__((vector_size(64), may_alias));

/// From `*block` on, looks for the first block with a square of a distance within the bound. Returns which of its items
/// have one, a bit each, and the squares of all; 0 if there is no such block. Lines hold one value of each item, the same
/// number of lines a block.
SEGMATCH_SEVERAL_TARGETS
std::uint32_t FindNearBlock(const float* lines, std::size_t blocks, const float* query, std::size_t dimensions,
                            float square_bound, std::size_t* block, float* squares) {
  constexpr std::size_t kLanes = sizeof(Vector) / sizeof(float);
  for (; *block < blocks; ++*block) {
    const auto* const values = reinterpret_cast<const Vector*>(lines + *block * dimensions * kLanes);
    Vector sum = {};
    for (std::size_t i = 0; i < dimensions; ++i) {
      const Vector difference = values[i] - query[i];
      sum += difference * difference;
    }
    *reinterpret_cast<Vector*>(squares) = sum;
    int any = 0;
    for (std::size_t lane = 0; lane < kLanes; ++lane) any |= squares[lane] <= square_bound;
    if (any == 0) continue;
    std::uint32_t near = 0;
    for (std::size_t lane = 0; lane < kLanes; ++lane) near |= std::uint32_t{squares[lane] <= square_bound} << lane;
    return near;
  }
  return 0;
}

}  // namespace

DescriptorIndex::DescriptorIndex(std::size_t dimensions) : dimensions_(dimensions) {
  if (dimensions == 0) throw std::invalid_argument("descriptor index: descriptors must have at least one value");
}

void DescriptorIndex::Insert(std::uint64_t item, const Descriptor& descriptor) {
  RequireValid(descriptor, "the descriptor of item " + std::to_string(item));
  const std::size_t place = items_.size();
  if (!places_.emplace(item, place).second) {
    throw std::invalid_argument("descriptor index: item " + std::to_string(item) +
                                " is there already; remove it before it is inserted anew");
  }
  items_.push_back(item);
  if (place % kBlock == 0) {
    Lanes room;
    room.values.fill(kRoom);
    lanes_.resize(lanes_.size() + dimensions_, room);
  }
  for (std::size_t i = 0; i < dimensions_; ++i)
    lanes_[place / kBlock * dimensions_ + i].values[place % kBlock] = descriptor[static_cast<Eigen::Index>(i)];
}

/// The last item takes the place.
bool DescriptorIndex::Remove(std::uint64_t item) {
  const auto found = places_.find(item);
  if (found == places_.end()) return false;
  const std::size_t place = found->second;
  const std::size_t last = items_.size() - 1;
  for (std::size_t i = 0; i < dimensions_; ++i) {
    float* const last_value = &lanes_[last / kBlock * dimensions_ + i].values[last % kBlock];
    lanes_[place / kBlock * dimensions_ + i].values[place % kBlock] = *last_value;
    *last_value = kRoom;
  }
  items_[place] = items_[last];
  places_[items_[place]] = place;
  places_.erase(found);
  items_.pop_back();
  if (last % kBlock == 0) lanes_.resize(lanes_.size() - dimensions_);
  return true;
}

void DescriptorIndex::RequireValid(const Descriptor& descriptor, const std::string& what) const {
  if (static_cast<std::size_t>(descriptor.size()) != dimensions_) {
    throw std::invalid_argument("descriptor index: " + what + " has " + std::to_string(descriptor.size()) +
                                " values instead of " + std::to_string(dimensions_));
  }
  if (!descriptor.allFinite()) throw std::invalid_argument("descriptor index: " + what + " is not finite");
}

/// From `*block` on, the first block that has items within the bound: which ones, a bit each, and the squares of all its
/// items' distances; 0 if there is none.
std::uint32_t DescriptorIndex::FindNear(const Descriptor& query, float square_bound, std::size_t* block,
                                        Lanes* squares) const {
  return FindNearBlock(lanes_.data()->values.data(), lanes_.size() / dimensions_, query.data(), dimensions_, square_bound,
                       block, squares->values.data());
}

}  // namespace incremental_segmatch
