/// \file
/// Things that would be said or done with every scan, done now and then.
#pragma once

#include <chrono>
#include <map>
#include <mutex>
#include <string>

namespace incremental_segmatch {

/// Lets one thing of a kind through in a period of the wall clock. (roscpp's own throttle follows simulated time, and
/// so is silent where that stands still.) All functions may be called from any thread.
class Throttle {
 public:
  /// True if this kind was not let through in the last `period_s`.
  bool IsDue(const std::string& kind, double period_s) {
    const auto now = std::chrono::steady_clock::now();
    const std::lock_guard<std::mutex> lock(mutex_);
    const auto [it, is_first] = last_.try_emplace(kind, now);
    if (!is_first && now - it->second < std::chrono::duration<double>(period_s)) return false;
    it->second = now;
    return true;
  }

 private:
  std::mutex mutex_;
  std::map<std::string, std::chrono::steady_clock::time_point> last_;
};

}  // namespace incremental_segmatch
