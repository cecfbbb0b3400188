/// \file
/// A street whose blocks are copies of each other, and a robot's segments along it.
#pragma once

#include <cmath>
#include <map>
#include <memory>
#include <random>
#include <vector>

#include "incremental_segmatch/segment_delta.hpp"

namespace incremental_segmatch::test {

inline constexpr double kBlock_m = 40.0, kReach_m = 15.0, kStep_m = 2.0;
inline constexpr int kPosts = 14;  // in a block

struct Thing {
  double size;
  std::vector<Eigen::Vector3d> points;
  Eigen::Vector3d centroid;
};

inline Thing Post(double x, double y, double size) {
  Thing post{size, {}, {x, y, 1.0}};
  for (double z = 0.0; z < 2.0; z += 0.1) post.points.push_back({x, y, z});
  return post;
}

/// Equal rows of posts, which are segments, and clutter, which is none, that may differ from block to block. One block may
/// have posts of its own.
class Street {
 public:
  Street(int blocks, bool clutter_differs, unsigned seed, int own_block = -1) {
    std::mt19937 random(seed);
    std::uniform_real_distribution<double> along(0.0, kBlock_m), aside(4.0, 12.0), unit(0.0, 1.0);
    const auto across = [&] { return (unit(random) < 0.5 ? -1.0 : 1.0) * aside(random); };
    std::vector<Eigen::Vector3d> posts;  // x, y, size
    for (int i = 0; i < kPosts; ++i) posts.push_back({along(random), across(), 100.0 * (i + 1)});
    std::vector<Eigen::Vector2d> clutter;
    for (int block = 0; block < blocks; ++block) {
      for (const Eigen::Vector3d& p : posts) {
        const bool is_own = block == own_block;
        segments_.push_back(Post(kBlock_m * block + (is_own ? along(random) : p.x()), p.y(), p.z() + (is_own ? 2000.0 : 0.0)));
      }
      if (block == 0 || clutter_differs) {
        clutter.clear();
        for (int i = 0; i < kPosts / 2; ++i) clutter.push_back({along(random), across()});
      }
      for (const Eigen::Vector2d& p : clutter) clutter_.push_back(Post(kBlock_m * block + p.x(), p.y(), 0.0));
    }
  }

  const std::vector<Thing>& segments() const { return segments_; }
  /// Points that are seen from a place on the x axis, relative to it.
  std::shared_ptr<const Points> ScanAt(double x) const {
    auto scan = std::make_shared<Points>();
    for (const std::vector<Thing>* things : {&segments_, &clutter_})
      for (const Thing& thing : *things)
        if (std::abs(thing.centroid.x() - x) <= kReach_m)
          for (const Eigen::Vector3d& p : thing.points) scan->push_back((p - Eigen::Vector3d(x, 0, 0)).cast<float>());
    return scan;
  }

 private:
  std::vector<Thing> segments_, clutter_;
};

/// A robot that sees all segments within reach. Odometry starts anew with each pass, where and how turned nobody knows.
class StreetRobot {
 public:
  explicit StreetRobot(const Street& street) : street_(street) {}

  struct Sight {
    double x = 0.0;
    SegmentDelta delta;
  };
  /// What it sees on its next pass, from here to there, long after the last one.
  std::vector<Sight> Pass(double from_m, double to_m) {
    time_s_ += 100.0;
    const Pose T_odom_world = Eigen::Translation3d(30.0 * pass_, -500.0 * pass_, 0.0) *
                              Eigen::AngleAxisd(0.8 * pass_, Eigen::Vector3d::UnitZ());
    ++pass_;
    std::vector<Sight> sights;
    for (double x = from_m; x <= to_m; x += kStep_m) {
      time_s_ += 0.5;
      SegmentDelta delta;
      delta.robot = "robot";
      delta.sequence = ++sequence_;
      delta.full_state = true;
      delta.stamp_ns = static_cast<StampNs>(time_s_ * 1e9);
      const Pose T_world_sensor(Eigen::Translation3d(x, 0.0, 0.0));
      delta.T_odom_sensor = T_odom_world * T_world_sensor;
      delta.scan_sensor = street_.ScanAt(x);
      for (std::size_t i = 0; i < street_.segments().size(); ++i) {
        const Thing& thing = street_.segments()[i];
        if (std::abs(thing.centroid.x() - x) > kReach_m) continue;
        SegmentState state;
        state.id = street_.segments().size() * pass_ + i + 1;
        state.size = static_cast<std::uint32_t>(thing.size);
        state.centroid_odom = T_odom_world * thing.centroid;
        state.descriptor = Descriptor::Constant(4, static_cast<float>(thing.size / 1000.0));
        state.new_view = true;
        delta.changed.push_back(state);
      }
      truth_[delta.stamp_ns] = T_world_sensor;
      sights.push_back({x, std::move(delta)});
    }
    return sights;
  }

  /// Where it was, in the street's frame.
  const Pose& T_world_sensor(StampNs stamp_ns) const { return truth_.at(stamp_ns); }

 private:
  const Street& street_;
  std::map<StampNs, Pose> truth_;
  std::uint64_t sequence_ = 0, pass_ = 0;
  double time_s_ = 0.0;
};

}  // namespace incremental_segmatch::test
