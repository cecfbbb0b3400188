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
      EXPECT_LT((index_.centroid_map(found[i].item) - map_.CentroidMap(seen)).norm(), 1e-9);
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

  /// Compares the centroids around a place with those of all open views.
  void ExpectCentroidsAround() {
    const RobotIndex robot = Chance(0.5) ? kOwner : kOther;
    const Eigen::Vector3d place_map = RandomPlace();
    const double radius_m = Chance(0.1) ? 1e6 : 60.0 * Unit();
    std::vector<Eigen::Vector3d> expected;
    for (std::uint64_t item = 0; item < index_.next_item(); ++item) {
      if (!index_.IsOpen(item, robot)) continue;
      const IndexedView& view = index_.view(item);
      const Eigen::Vector3d centroid_map = map_.CentroidMap(map_.Find(view.segment)->views.at(view.view));
      if ((centroid_map - place_map).norm() <= radius_m) expected.push_back(centroid_map);
    }
    std::vector<Eigen::Vector3d> found = index_.CentroidsAround(place_map, radius_m, robot);
    ASSERT_EQ(found.size(), expected.size());
    found_around_ += found.size();
    const auto precedes = [](const Eigen::Vector3d& a, const Eigen::Vector3d& b) { return a.x() < b.x(); };
    std::sort(found.begin(), found.end(), precedes);
    std::sort(expected.begin(), expected.end(), precedes);
    for (std::size_t i = 0; i < found.size(); ++i) EXPECT_EQ(found[i], expected[i]);
  }
  std::size_t found_around() const { return found_around_; }

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
  Eigen::Vector3d RandomPlace() { return {200.0 * (Unit() - 0.5), 200.0 * (Unit() - 0.5), Unit()}; }
  SegmentKey RandomKey() {
    return std::next(map_.segments().begin(), static_cast<long>(Below(map_.segments().size())))->first;
  }

  void AddSegment() {
    const SegmentKey key{kOwner, ++last_id_};
    for (std::size_t views = 1 + Below(3); views > 0; --views) {
      Pose T_odom_sensor = Pose::Identity();
      T_odom_sensor.translation() = RandomPlace();
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
    pose.T_frame_sensor.translation() = RandomPlace();
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
  std::size_t found_around_ = 0;
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

// As long as nothing is scaled, distances between whole numbers are exact, and many are equal.
TEST(TargetIndex, EquallyNearSegmentsComeByNameAndTheirViewsAsTheyWereOpened) {
  std::size_t ties = 0;
  for (unsigned seed = 0; seed < 1000; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    std::mt19937 random(seed);
    const auto random_descriptor = [&] {
      return Descriptor(Descriptor::NullaryExpr(3, [&] { return static_cast<float>(random() % 3); }));
    };
    TargetMap map{TargetMapParameters()};
    map.RobotByName("owner");
    map.AddPose(kOwner, 1, Pose::Identity());
    TargetIndex index;
    for (int view_number = 0; view_number < 30; ++view_number) {
      const SegmentKey key{kOwner, static_cast<SegmentId>(1 + random() % 12)};
      SegmentView view;
      view.descriptor = random_descriptor();
      index.Close(key);
      map.UpdateSegment(key, view, true, 1);
      index.Open(key, map, 1 + random() % 4, true);
      if (index.generation() != 0) break;

      const Descriptor query = random_descriptor();
      const RobotIndex robot = random() % 2 == 0 ? kOwner : kOther;
      const std::size_t count = random() % 8;
      std::map<SegmentKey, std::pair<float, std::uint64_t>> nearest;  // of each segment, item by item
      for (std::uint64_t item = 0; item < index.next_item(); ++item) {
        if (!index.IsOpen(item, robot)) continue;
        const std::pair<float, std::uint64_t> view_at{(index.descriptor(item) - query).norm(), item};
        const auto [it, is_new] = nearest.emplace(index.view(item).segment, view_at);
        ties += !is_new && it->second.first == view_at.first;
        it->second = std::min(it->second, view_at);
      }
      std::vector<std::tuple<float, SegmentKey, std::uint64_t>> expected;
      for (const auto& [segment, view_at] : nearest) expected.emplace_back(view_at.first, segment, view_at.second);
      std::sort(expected.begin(), expected.end());
      if (count != 0 && expected.size() > count) expected.resize(count);
      std::vector<std::tuple<float, SegmentKey, std::uint64_t>> found;
      for (const TargetCandidate& candidate : index.Nearest(query, robot, count, 1e9f))
        found.emplace_back(candidate.distance, candidate.segment, candidate.item);
      ASSERT_EQ(found, expected);
      for (std::size_t i = 1; i < found.size(); ++i) ties += std::get<0>(found[i]) == std::get<0>(found[i - 1]);
    }
  }
  EXPECT_GT(ties, 10000u);
}

TEST(TargetIndex, NearestIsThatOfAllOpenViewsOverRandomSequences) {
  std::size_t found_around = 0;
  for (unsigned seed = 0; seed < 1000; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    RandomMap map(seed);
    const int steps = seed % 50 == 0 ? 6000 : 300;
    for (int step = 0; step < steps; ++step) {
      map.Step();
      if (step % 10 == 0) map.ExpectNearest();
      if (step % 10 == 0) map.ExpectCentroidsAround();
      map.ExpectBounded();
      if (::testing::Test::HasFailure()) return;
    }
    found_around += map.found_around();
  }
  EXPECT_GT(found_around, 10000u);
}

}  // namespace
}  // namespace incremental_segmatch
