#include "pose_buffer.hpp"

#include <algorithm>
#include <cstdio>

namespace incremental_segmatch {
namespace {

std::string Seconds(StampNs duration_ns) {
  char text[40];
  std::snprintf(text, sizeof text, "%.3f s", 1e-9 * static_cast<double>(duration_ns));
  return text;
}

bool IsBefore(const StampedPose& pose, StampNs stamp_ns) {
  return pose.stamp_ns < stamp_ns;
}

Pose Interpolate(const StampedPose& a, const StampedPose& b, StampNs stamp_ns) {
  const double share = static_cast<double>(stamp_ns - a.stamp_ns) / static_cast<double>(b.stamp_ns - a.stamp_ns);
  const Eigen::Quaterniond q_a(a.T_frame_sensor.linear());
  const Eigen::Quaterniond q_b(b.T_frame_sensor.linear());
  Pose T = Pose::Identity();
  T.linear() = q_a.slerp(share, q_b).normalized().toRotationMatrix();
  T.translation() = (1.0 - share) * a.T_frame_sensor.translation() + share * b.T_frame_sensor.translation();
  return T;
}

}  // namespace

PoseBuffer::PoseBuffer(double keep_s, double max_gap_s)
    : keep_ns_(static_cast<StampNs>(1e9 * keep_s)), max_gap_ns_(static_cast<StampNs>(1e9 * max_gap_s)) {}

void PoseBuffer::Add(const StampedPose& pose) {
  const std::lock_guard<std::mutex> lock(mutex_);
  if (!poses_.empty() && pose.stamp_ns == poses_.back().stamp_ns) return;
  if (!poses_.empty() && pose.stamp_ns < poses_.back().stamp_ns) poses_.clear();
  poses_.push_back(pose);
  while (poses_.front().stamp_ns < pose.stamp_ns - keep_ns_) poses_.pop_front();
}

void PoseBuffer::Clear() {
  const std::lock_guard<std::mutex> lock(mutex_);
  poses_.clear();
}

std::optional<Pose> PoseBuffer::At(StampNs stamp_ns) const {
  const std::lock_guard<std::mutex> lock(mutex_);
  const auto after = std::lower_bound(poses_.begin(), poses_.end(), stamp_ns, IsBefore);
  if (after == poses_.end()) return std::nullopt;
  if (after->stamp_ns == stamp_ns) return after->T_frame_sensor;
  if (after == poses_.begin()) return std::nullopt;
  const StampedPose& before = *std::prev(after);
  if (after->stamp_ns - before.stamp_ns > max_gap_ns_) return std::nullopt;
  return Interpolate(before, *after, stamp_ns);
}

std::string PoseBuffer::WhyNot(const std::string& topic, StampNs stamp_ns) const {
  const std::lock_guard<std::mutex> lock(mutex_);
  if (poses_.empty()) return "no " + topic + " has come";
  if (stamp_ns > poses_.back().stamp_ns)
    return topic + " ends " + Seconds(stamp_ns - poses_.back().stamp_ns) + " before it";
  if (stamp_ns < poses_.front().stamp_ns)
    return topic + " begins " + Seconds(poses_.front().stamp_ns - stamp_ns) + " after it";
  return topic + " has a gap of more than " + Seconds(max_gap_ns_) + " around it";
}

}  // namespace incremental_segmatch
