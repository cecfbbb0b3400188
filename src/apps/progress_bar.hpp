/// \file
/// Progress of work that takes longer than seconds.
#pragma once

#include <chrono>
#include <cstddef>
#include <string>

namespace incremental_segmatch::apps {

/// Shows share done and remaining time on standard error: one line that is redrawn on a terminal, a line now and then
/// elsewhere. Nothing is shown of work that is over within a second.
class ProgressBar {
 public:
  /// `label` says what is done; `total` is the number of steps.
  ProgressBar(std::string label, std::size_t total);

  /// Ends the line.
  ~ProgressBar();

  ProgressBar(const ProgressBar&) = delete;
  ProgressBar& operator=(const ProgressBar&) = delete;

  /// `done` steps are finished. Cheap: draws a few times a second at most.
  void Update(std::size_t done);

 private:
  using Clock = std::chrono::steady_clock;

  void Draw(double elapsed_s);

  std::string label_;
  std::size_t total_;
  std::size_t done_ = 0;
  bool is_terminal_;
  bool drawn_ = false;
  Clock::time_point start_ = Clock::now();
  Clock::time_point next_draw_;
};

}  // namespace incremental_segmatch::apps
