/// \file
/// Per-stage times of a step, for every run's output.
#pragma once

#include <chrono>
#include <string>
#include <utility>
#include <vector>

namespace incremental_segmatch {

/// Milliseconds by stage, in the order in which the stages ran.
using StageTimes = std::vector<std::pair<std::string, double>>;

/// Stopwatch that appends one stage after the other.
class StageTimer {
 public:
  /// Ends the running stage under this name and starts the next.
  void Lap(const char* stage) {
    const auto now = std::chrono::steady_clock::now();
    times_.emplace_back(stage, std::chrono::duration<double, std::milli>(now - start_).count());
    start_ = now;
  }
  /// All laps so far; the timer is empty then.
  StageTimes Take() { return std::move(times_); }

 private:
  std::chrono::steady_clock::time_point start_ = std::chrono::steady_clock::now();
  StageTimes times_;
};

}  // namespace incremental_segmatch
