/// \file
/// Input of the benchmarks: a simulated drive through town with an HDL-64E at full resolution, and a stopwatch per step.
#pragma once

#include <benchmark/benchmark.h>

#include <algorithm>
#include <cstddef>
#include <string>
#include <vector>

#include "incremental_segmatch/stage_times.hpp"
#include "incremental_segmatch/types.hpp"

namespace incremental_segmatch::bench {

/// A local map of some size, and the steps that are measured. All setups end at the same scan of the same drive.
struct DriveSetup {
  std::string name;              ///< in the benchmarks' names
  double scan_radius_m = 50.0;   ///< scans are cut there
  double local_radius_m = 50.0;  ///< of the local map
  std::size_t warm_up_scans = 150;
  std::size_t measured_scans = 100;
  std::size_t batch_every = 10;  ///< batch stages are measured on every so many of them
  bool grows = false;            ///< the local map takes new memory for new voxels; the others have had their size before
};

/// Local maps of about 10^4 voxels, 2 * 10^5 (the preset for KITTI), and over 10^6: everything that the drive has seen, with the
/// same scans as the one before.
const std::vector<DriveSetup>& Setups();

/// The last of them with a local map that grows.
DriveSetup GrowingSetup();

/// A scan without its ground.
struct DriveScan {
  Points obstacles_sensor;
  Pose T_odom_sensor = Pose::Identity();
};

/// The scans of a setup, warm-up first, cut at its radius. The drive is simulated when first asked for.
std::vector<DriveScan> Scans(const DriveSetup& setup);

/// Durations of measured steps, put into a benchmark's counters in milliseconds.
class StepTimes {
 public:
  /// Adds the duration of the running iteration.
  void Add(double seconds, benchmark::State& state) {
    state.SetIterationTime(seconds);
    milliseconds_.push_back(1e3 * seconds);
  }
  void Report(benchmark::State& state) {
    std::sort(milliseconds_.begin(), milliseconds_.end());
    state.counters["median_ms"] = milliseconds_[milliseconds_.size() / 2];
    state.counters["p99_ms"] = milliseconds_[milliseconds_.size() * 99 / 100];
  }

 private:
  std::vector<double> milliseconds_;
};

/// Seconds of CPU time that a call takes, whatever else keeps the machine busy.
template <class Call>
double Seconds(Call&& call) {
  const double start_ms = ThreadCpuMs();
  call();
  return 1e-3 * (ThreadCpuMs() - start_ms);
}

/// Drives through the setup's scans with a local map that has `Step(const DriveScan&)`, which returns the seconds that count. One
/// iteration is one step. A robot's local map takes memory while it comes to its size and reuses it from then on: so has this one, on
/// the same drive elsewhere, unless the setup has it grow.
template <class LocalMap>
void MeasureSteps(benchmark::State& state, const DriveSetup& setup, LocalMap& map) {
  constexpr double kElsewhereM = 2500.0;
  const std::vector<DriveScan> scans = Scans(setup);
  if (!setup.grows) {
    for (DriveScan scan : scans) {
      scan.T_odom_sensor.translation().x() += kElsewhereM;
      map.Step(scan);
    }
  }
  std::size_t next = 0;
  while (next < setup.warm_up_scans) map.Step(scans[next++]);
  StepTimes times;
  for (auto _ : state) times.Add(map.Step(scans.at(next++)), state);
  times.Report(state);
  map.Count(state);
}

/// The same where `Measure(const DriveScan&)` is asked for on every so many of the measured steps; Step comes after it.
template <class LocalMap>
void MeasureBatch(benchmark::State& state, const DriveSetup& setup, LocalMap& map) {
  const std::vector<DriveScan> scans = Scans(setup);
  std::size_t next = 0;
  while (next < setup.warm_up_scans) map.Step(scans[next++]);
  StepTimes times;
  for (auto _ : state) {
    times.Add(map.Measure(scans.at(next)), state);
    for (std::size_t i = 0; i < setup.batch_every; ++i) map.Step(scans.at(next++));
  }
  times.Report(state);
  map.Count(state);
}

/// Registers `run(state, setup)` as "stage/setup/method", one iteration a measured step.
template <class Run>
void RegisterStage(const std::string& stage, const std::string& method, const DriveSetup& setup, std::size_t steps, Run run) {
  benchmark::RegisterBenchmark((stage + "/" + setup.name + "/" + method).c_str(), [=](benchmark::State& state) { run(state, setup); })
      ->UseManualTime()
      ->Unit(benchmark::kMillisecond)
      ->Iterations(static_cast<benchmark::IterationCount>(steps));
}

}  // namespace incremental_segmatch::bench
