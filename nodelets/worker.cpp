#include "worker.hpp"

#include <algorithm>
#include <chrono>
#include <exception>
#include <stdexcept>
#include <utility>

namespace incremental_segmatch {
namespace {

std::size_t Positive(std::size_t capacity) {
  if (capacity == 0) throw std::invalid_argument("queue_size: must be at least 1");
  return capacity;
}

}  // namespace

Worker::Worker(std::size_t capacity, ErrorHandler on_error)
    : capacity_(Positive(capacity)), on_error_(std::move(on_error)), thread_([this] { Run(); }) {}

Worker::~Worker() {
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    stopping_ = true;
  }
  changed_.notify_all();
  thread_.join();
}

void Worker::Post(Job job) {
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    if (queued_ == capacity_) {
      entries_.erase(
          std::find_if(entries_.begin(), entries_.end(), [](const Entry& entry) { return entry.droppable; }));
      --queued_;
      ++dropped_;
    }
    entries_.push_back({std::move(job), true});
    ++queued_;
  }
  changed_.notify_all();
}

void Worker::PostAlways(Job job) {
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    entries_.push_back({std::move(job), false});
  }
  changed_.notify_all();
}

std::size_t Worker::queued() const {
  const std::lock_guard<std::mutex> lock(mutex_);
  return queued_;
}

std::size_t Worker::dropped() const {
  const std::lock_guard<std::mutex> lock(mutex_);
  return dropped_;
}

bool Worker::stopping() const {
  const std::lock_guard<std::mutex> lock(mutex_);
  return stopping_;
}

void Worker::SleepFor(double seconds) {
  std::unique_lock<std::mutex> lock(mutex_);
  changed_.wait_for(lock, std::chrono::duration<double>(seconds), [this] { return stopping_; });
}

void Worker::Run() {
  std::unique_lock<std::mutex> lock(mutex_);
  while (true) {
    changed_.wait(lock, [this] { return stopping_ || !entries_.empty(); });
    if (stopping_) return;
    const Entry entry = std::move(entries_.front());
    entries_.pop_front();
    if (entry.droppable) --queued_;
    lock.unlock();
    try {
      entry.job();
    } catch (const std::exception& error) {
      on_error_(error.what());
    }
    lock.lock();
  }
}

}  // namespace incremental_segmatch
