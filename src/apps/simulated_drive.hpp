/// \file
/// A simulated drive as input of an evaluation, without files in between.
#pragma once

#include <optional>
#include <string>

#include "apps/simulation_options.hpp"
#include "evaluation/drive_source.hpp"
#include "simulator/simulation.hpp"

namespace incremental_segmatch::apps {

/// Simulates each scan when it is asked for.
class SimulatedDrive : public DriveSource {
 public:
  /// Throws what simulator::Simulation throws.
  explicit SimulatedDrive(const simulator::SimulationOptions& options)
      : simulation_(options),
        name_("simulated drive along " + RouteName(options) + ", seed " + std::to_string(options.seed) + ", day " +
              std::to_string(options.day)) {}

  std::string name() const override { return name_; }
  std::size_t size() const override { return simulation_.size(); }
  StampNs stamp_ns(std::size_t i) const override { return simulation_.stamp_ns(i); }
  Pose T_odom_sensor(std::size_t i) const override { return simulation_.T_odom_sensor(i); }
  std::optional<Pose> T_world_sensor(std::size_t i) const override { return simulation_.T_world_sensor(i); }
  Points ReadPoints(std::size_t i) override { return simulation_.Scan(i); }

 private:
  simulator::Simulation simulation_;
  std::string name_;
};

}  // namespace incremental_segmatch::apps
