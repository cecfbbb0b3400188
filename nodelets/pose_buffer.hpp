/// \file
/// The poses of a topic, interpolated.
#pragma once

#include <deque>
#include <mutex>
#include <optional>
#include <string>

#include "incremental_segmatch/types.hpp"

namespace incremental_segmatch {

/// The last poses of a moving frame. All functions may be called from any thread.
class PoseBuffer {
 public:
  /// \param keep_s      how far back from the newest pose poses are kept
  /// \param max_gap_s   longest time between two poses over which is interpolated
  PoseBuffer(double keep_s, double max_gap_s);

  /// Adds a pose. One that is older than the newest starts the buffer anew (time jumped back); one with the same stamp
  /// is ignored.
  void Add(const StampedPose& pose);
  void Clear();

  /// The pose at a stamp, linearly interpolated (rotation: slerp). Nothing if the stamp is not between two poses that
  /// are at most the gap apart. O(log poses).
  std::optional<Pose> At(StampNs stamp_ns) const;

  /// In words, why there is no pose at a stamp; `topic` names what the poses come from.
  std::string WhyNot(const std::string& topic, StampNs stamp_ns) const;

 private:
  const StampNs keep_ns_;
  const StampNs max_gap_ns_;
  mutable std::mutex mutex_;
  std::deque<StampedPose> poses_;
};

}  // namespace incremental_segmatch
