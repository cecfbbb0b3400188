/// \file
/// A small simulated drive, made once per test program: two laps of one street circuit with a coarse LiDAR.
#pragma once

#include <vector>

#include "evaluation/scoring.hpp"
#include "incremental_segmatch/back_end.hpp"
#include "incremental_segmatch/front_end.hpp"
#include "simulator/simulation.hpp"

namespace incremental_segmatch::test {

struct Drive {
  std::vector<Scan> scans;           ///< with the drifting odometry
  std::vector<StampNs> stamps_ns;
  std::vector<Pose> T_world_sensor;  ///< truth
};

/// Simulates; `day` 1 is the same town with other parked cars and traffic.
inline Drive SimulateLaps(std::uint64_t day, int laps) {
  simulator::SimulationOptions options;
  options.route = "lap";
  options.laps = laps;
  options.sensor = "HDL-64E";
  options.stride = 4;
  options.seed = 5;
  options.day = day;
  simulator::Simulation simulation(options);
  Drive drive;
  for (std::size_t i = 0; i < simulation.size(); ++i) {
    drive.scans.push_back({simulation.stamp_ns(i) + 1, simulation.Scan(i), simulation.T_odom_sensor(i)});
    drive.stamps_ns.push_back(drive.scans.back().stamp_ns);
    drive.T_world_sensor.push_back(simulation.T_world_sensor(i));
  }
  return drive;
}

inline const Drive& TwoLaps() {
  static const Drive drive = SimulateLaps(0, 2);
  return drive;
}

/// What a run of front end and back end over a drive gave.
struct PipelineRun {
  std::vector<BackEndStep> steps;
  std::vector<ClosureRow> closures;
};

/// Scans [first, last) of a drive through a new front end into the back end, odometry moved by T_moved_odom from scan
/// `moved_from` on.
inline PipelineRun Process(const Drive& drive, BackEnd* back_end, const FrontEndParameters& parameters = {}, std::size_t moved_from = ~0ul,
                   const Pose& T_moved_odom = Pose::Identity()) {
  FrontEnd front_end(parameters, "robot");
  PipelineRun run;
  for (std::size_t i = 0; i < drive.scans.size(); ++i) {
    Scan scan = drive.scans[i];
    if (i >= moved_from) scan.T_odom_sensor = T_moved_odom * scan.T_odom_sensor;
    BackEndStep step = back_end->Process(front_end.Process(scan).delta);
    const auto keep = [&run](const Closure& c) {
      run.closures.push_back({c.stamp_query_ns, c.stamp_target_ns, c.robot_query, c.robot_target, c.T_target_query, c.inliers,
                              c.candidates, c.rms_m});
    };
    for (const Closure& closure : step.settled) keep(closure);
    if (step.closure) keep(*step.closure);
    run.steps.push_back(std::move(step));
  }
  return run;
}

inline Score ScoreRun(const Drive& drive, const PipelineRun& run) {
  return ScoreClosures({drive.stamps_ns, drive.T_world_sensor}, run.closures, ScoringParameters());
}

}  // namespace incremental_segmatch::test
