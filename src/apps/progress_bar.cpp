#include "apps/progress_bar.hpp"

#include <unistd.h>

#include <algorithm>
#include <cstdio>
#include <utility>

namespace incremental_segmatch::apps {
namespace {

using std::chrono::milliseconds;
constexpr milliseconds kFirstDraw{1000};
constexpr milliseconds kTerminalInterval{200};
constexpr milliseconds kLogInterval{15000};
constexpr int kBarWidth = 30;

std::string FormatDuration(double seconds) {
  const int total = static_cast<int>(seconds + 0.5);
  char text[32];
  if (total >= 3600) {
    std::snprintf(text, sizeof text, "%d:%02d:%02d", total / 3600, total / 60 % 60, total % 60);
  } else {
    std::snprintf(text, sizeof text, "%d:%02d", total / 60, total % 60);
  }
  return text;
}

}  // namespace

ProgressBar::ProgressBar(std::string label, std::size_t total)
    : label_(std::move(label)),
      total_(total),
      is_terminal_(isatty(STDERR_FILENO) == 1),
      next_draw_(start_ + kFirstDraw) {}

ProgressBar::~ProgressBar() {
  if (!drawn_) return;
  const double elapsed_s = std::chrono::duration<double>(Clock::now() - start_).count();
  if (is_terminal_) {
    Draw(elapsed_s);
    std::fputc('\n', stderr);
  } else {
    std::fprintf(stderr, "%s: %zu of %zu in %s\n", label_.c_str(), done_, total_, FormatDuration(elapsed_s).c_str());
  }
}

void ProgressBar::Update(std::size_t done) {
  done_ = done;
  const Clock::time_point now = Clock::now();
  if (now < next_draw_) return;
  next_draw_ = now + (is_terminal_ ? kTerminalInterval : kLogInterval);
  drawn_ = true;
  Draw(std::chrono::duration<double>(now - start_).count());
}

void ProgressBar::Draw(double elapsed_s) {
  const double share = total_ > 0 ? std::min(1.0, static_cast<double>(done_) / static_cast<double>(total_)) : 1.0;
  const std::string left = done_ > 0 ? FormatDuration(elapsed_s / share * (1.0 - share)) + " left" : "starting";
  const double per_second = elapsed_s > 0.0 ? static_cast<double>(done_) / elapsed_s : 0.0;
  if (!is_terminal_) {
    std::fprintf(stderr, "%s: %zu of %zu, %.1f a second, %s\n", label_.c_str(), done_, total_, per_second,
                 left.c_str());
    return;
  }
  const int filled = static_cast<int>(share * kBarWidth);
  std::fprintf(stderr, "\r%s [%s%s] %3.0f %%  %zu/%zu  %.1f/s  %s   ", label_.c_str(), std::string(filled, '#').c_str(),
               std::string(kBarWidth - filled, '.').c_str(), 100.0 * share, done_, total_, per_second, left.c_str());
  std::fflush(stderr);
}

}  // namespace incremental_segmatch::apps
