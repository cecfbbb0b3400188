/// \file
/// The one thread that owns a nodelet's core object.
#pragma once

#include <condition_variable>
#include <cstddef>
#include <deque>
#include <functional>
#include <future>
#include <memory>
#include <mutex>
#include <string>
#include <thread>
#include <utility>

namespace incremental_segmatch {

/// Runs jobs one after the other in a thread of its own. The queue is bounded: a job that comes when it is full pushes
/// the oldest droppable one out. Jobs still waiting at the end are dropped unrun. All functions may be called from any
/// thread.
class Worker {
 public:
  using Job = std::function<void()>;
  using ErrorHandler = std::function<void(const std::string&)>;

  /// `on_error` is called, in the worker's thread, with the message of an exception that a job throws; the worker goes
  /// on. Throws std::invalid_argument unless capacity > 0.
  Worker(std::size_t capacity, ErrorHandler on_error);
  /// Waits for the running job, drops the others.
  ~Worker();
  Worker(const Worker&) = delete;
  Worker& operator=(const Worker&) = delete;

  /// Queues data, which the oldest data makes room for if the queue is full.
  void Post(Job job);
  /// Queues something that must not be lost: a service call, a setting. Does not count towards the capacity.
  void PostAlways(Job job);

  /// Runs a function in the worker's thread and waits for its result; throws what it throws, or std::future_error if
  /// the worker ends before. Not to be called from a job.
  template <class Function>
  auto Run(Function function) {
    auto task = std::make_shared<std::packaged_task<decltype(function())()>>(std::move(function));
    auto result = task->get_future();
    PostAlways([task] { (*task)(); });
    task.reset();  // the job alone keeps it, so that the future hears of it if the job is dropped
    return result.get();
  }

  /// Data jobs that wait.
  std::size_t queued() const;
  /// Data jobs that were pushed out so far.
  std::size_t dropped() const;
  /// True once the destructor runs: a job that waits for something should give up.
  bool stopping() const;
  /// Sleeps for at most this long, less if the worker is to stop.
  void SleepFor(double seconds);

 private:
  struct Entry {
    Job job;
    bool droppable;
  };
  void Run();

  const std::size_t capacity_;
  const ErrorHandler on_error_;
  mutable std::mutex mutex_;
  std::condition_variable changed_;
  std::deque<Entry> entries_;
  std::size_t queued_ = 0;
  std::size_t dropped_ = 0;
  bool stopping_ = false;
  std::thread thread_;  // last: starts when everything else is there
};

}  // namespace incremental_segmatch
