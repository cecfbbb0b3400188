// Matching's index of open views: equal to looking at all of them, whatever was opened, closed and forgotten before.
#include "incremental_segmatch/target_index.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <map>
#include <random>
#include <set>
#include <stdexcept>
#include <tuple>

namespace incremental_segmatch {
namespace {

constexpr RobotIndex kOwner = 0, kOther = 1;

/// A map of one robot's segments that come, are opened view by view, move, and go; and what should be open of it.
class RandomMap {
 public:
  explicit RandomMap(unsigned seed) : random_(seed), map_(Parameters()) {
    map_.RobotByName("owner");
    map_.AddPose(kOwner, ++stamp_ns_, Pose::Identity());
    keep_ = 10 + Below(60);
  }

  void Step() {
    if (Chance(0.3)) AddSegment();
    if (map_.segments().size() > keep_ || (Chance(0.1) && !map_.segments().empty())) RemoveSegment();
    if (!map_.segments().empty() && Chance(0.5)) OpenSome();
    if (!map_.segments().empty() && Chance(0.1)) Close(RandomKey());
    if (Chance(0.05)) Correct();
  }

  /// Compares the nearest segments with those of all open views.
  void ExpectNearest() {
    const Descriptor query = RandomDescriptor();
    const RobotIndex robot = Chance(0.5) ? kOwner : kOther;
    const std::size_t count = Below(12);
    std::map<SegmentKey, float> expected;  // distance of its nearest open view
    for (const auto& [key, released] : open_) {
      const std::vector<SegmentView>& views = map_.Find(key)->views;
      for (std::size_t view = 0; view < (robot == kOther ? views.size() : released); ++view) {
        const float distance = index_.Distance(query, views[view].descriptor);
        const auto [it, is_new] = expected.emplace(key, distance);
        if (!is_new) it->second = std::min(it->second, distance);
      }
    }
    std::vector<float> distances;
    for (const auto& entry : expected) distances.push_back(entry.second);
    std::sort(distances.begin(), distances.end());
    if (count != 0 && distances.size() > count) distances.resize(count);

    const std::vector<TargetCandidate> found = index_.Nearest(query, robot, count, kFar);
    ASSERT_EQ(found.size(), distances.size());
    std::set<SegmentKey> segments;
    for (std::size_t i = 0; i < found.size(); ++i) {
      EXPECT_NEAR(found[i].distance, distances[i], 1e-4f);
      EXPECT_TRUE(segments.insert(found[i].segment).second);
      const IndexedView& view = index_.view(found[i].item);
      EXPECT_TRUE(index_.IsOpen(found[i].item, robot));
      EXPECT_EQ(view.segment, found[i].segment);
      const SegmentView& seen = map_.Find(view.segment)->views.at(view.view);
      EXPECT_NEAR(index_.Distance(query, seen.descriptor), found[i].distance, 1e-4f);
      EXPECT_LT((view.centroid_map - map_.CentroidMap(seen)).norm(), 1e-9);
    }

    // What was found before, for any query, spares work and changes nothing.
    if (known_generation_ != index_.generation()) known_.clear();
    const std::vector<TargetCandidate> again = index_.Nearest(query, robot, count, kFar, known_);
    ASSERT_EQ(again.size(), found.size());
    for (std::size_t i = 0; i < found.size(); ++i) {
      EXPECT_EQ(again[i].segment, found[i].segment);
      EXPECT_EQ(again[i].distance, found[i].distance);
    }
    known_ = found;
    known_generation_ = index_.generation();
  }

  void ExpectBounded() const {
    std::size_t views = 0;
    for (const auto& entry : open_) views += map_.Find(entry.first)->views.size();
    EXPECT_EQ(index_.segments(), open_.size());
    largest_ = std::max(largest_, views);
    EXPECT_LE(index_.next_item(), 4 * largest_ + 200);
  }

 private:
  static constexpr float kFar = 1e9f;
  static TargetMapParameters Parameters() {
    TargetMapParameters parameters;
    parameters.max_views = 3;
    return parameters;
  }
  std::size_t Below(std::size_t n) { return random_() % n; }
  double Unit() { return std::uniform_real_distribution<double>(0.0, 1.0)(random_); }
  bool Chance(double p) { return Unit() < p; }
  Descriptor RandomDescriptor() {
    Descriptor descriptor(5);
    for (int i = 0; i < 5; ++i)
      descriptor[i] = static_cast<float>((i + 1) * std::normal_distribution<double>()(random_));
    return descriptor;
  }
  SegmentKey RandomKey() {
    return std::next(map_.segments().begin(), static_cast<long>(Below(map_.segments().size())))->first;
  }

  void AddSegment() {
    const SegmentKey key{kOwner, ++last_id_};
    for (std::size_t views = 1 + Below(3); views > 0; --views) {
      Pose T_odom_sensor = Pose::Identity();
      T_odom_sensor.translation() = Eigen::Vector3d(Unit(), Unit(), 0.0);
      SegmentView view;
      view.pose = map_.AddPose(kOwner, ++stamp_ns_, T_odom_sensor);
      view.size = static_cast<std::uint32_t>(Below(100));
      view.centroid_sensor = {Unit(), Unit(), Unit()};
      view.descriptor = RandomDescriptor();
      map_.UpdateSegment(key, view, true, stamp_ns_);
    }
  }
  void OpenSome() {
    const SegmentKey key = RandomKey();
    const std::size_t views = map_.Find(key)->views.size();
    // What was released stays so.
    const std::size_t released = std::min(views, (open_.count(key) ? open_.at(key) : 0) + Below(3));
    index_.Open(key, map_, released, true);
    open_[key] = released;
  }
  void Close(const SegmentKey& key) {
    index_.Close(key);
    open_.erase(key);
  }
  void RemoveSegment() {
    const SegmentKey key = RandomKey();
    Close(key);
    map_.Erase(key);
  }
  void Correct() {
    StampedPose pose;
    pose.stamp_ns = 1 + static_cast<StampNs>(Below(static_cast<std::size_t>(stamp_ns_)));
    pose.T_frame_sensor.translation() = Eigen::Vector3d(10.0 * Unit(), 10.0 * Unit(), 0.0);
    map_.CorrectTrajectory(kOwner, {pose});
    index_.RefreshCentroids(map_);
  }

  std::mt19937 random_;
  TargetMap map_;
  TargetIndex index_;
  std::map<SegmentKey, std::size_t> open_;  // to the owner: so many views; to others: all
  StampNs stamp_ns_ = 0;
  SegmentId last_id_ = 0;
  std::size_t keep_;
  std::vector<TargetCandidate> known_;
  std::uint64_t known_generation_ = 0;
  mutable std::size_t largest_ = 0;
};

TEST(TargetIndex, RefusesDescriptorsOfOtherSettings) {
  TargetMap map{TargetMapParameters()};
  map.RobotByName("owner");
  map.AddPose(kOwner, 1, Pose::Identity());
  for (const SegmentId id : {1, 2}) {
    SegmentView view;
    view.descriptor = Descriptor::Ones(id + 2);
    map.UpdateSegment({kOwner, id}, view, false, 1);
  }
  TargetIndex index;
  index.Open({kOwner, 1}, map, 1, false);
  EXPECT_THROW(index.Open({kOwner, 2}, map, 1, false), std::invalid_argument);
  EXPECT_THROW(index.Nearest(Descriptor::Ones(4), kOwner, 1, 1e9f), std::invalid_argument);
  EXPECT_EQ(index.Nearest(Descriptor::Ones(3), kOwner, 1, 1e9f).size(), 1u);
}

TEST(TargetIndex, NearestIsThatOfAllOpenViewsOverRandomSequences) {
  for (unsigned seed = 0; seed < 1000; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    RandomMap map(seed);
    const int steps = seed % 50 == 0 ? 6000 : 300;
    for (int step = 0; step < steps; ++step) {
      map.Step();
      if (step % 10 == 0) map.ExpectNearest();
      map.ExpectBounded();
      if (::testing::Test::HasFailure()) return;
    }
  }
}

}  // namespace
}  // namespace incremental_segmatch
