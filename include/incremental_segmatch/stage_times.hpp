/// \file
/// Per-stage times of a step, for every run's output.
#pragma once

#include <time.h>

#include <string>
#include <utility>
#include <vector>

namespace incremental_segmatch {

/// CPU time of the calling thread in milliseconds, from an arbitrary start: what a synchronous stage costs, whatever else
/// keeps the machine busy.
inline double ThreadCpuMs() {
  timespec now;
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
  return 1e3 * static_cast<double>(now.tv_sec) + 1e-6 * static_cast<double>(now.tv_nsec);
}

/// Milliseconds of CPU time by stage, in the order in which the stages ran.
using StageTimes = std::vector<std::pair<std::string, double>>;

/// Stopwatch of the thread that makes it, which appends one stage after the other.
class StageTimer {
 public:
  /// Ends the running stage under this name and starts the next.
  void Lap(const char* stage) {
    const double now_ms = ThreadCpuMs();
    times_.emplace_back(stage, now_ms - start_ms_);
    start_ms_ = now_ms;
  }
  /// All laps so far; the timer is empty then.
  StageTimes Take() { return std::move(times_); }

 private:
  double start_ms_ = ThreadCpuMs();
  StageTimes times_;
};

}  // namespace incremental_segmatch
