/// \file
/// Beam tables and noise of the simulated LiDARs.
#pragma once

#include <string>
#include <vector>

namespace incremental_segmatch::simulator {

/// A LiDAR as an instantaneous (motion-compensated) sweep: a grid of beams, all of which fire, as in a spinning one, or
/// a part of which fires that is drawn anew for every scan, as in one whose pattern does not repeat.
struct SensorModel {
  std::string name;
  std::vector<double> elevations_rad;  ///< from the top beam down
  int columns = 0;                     ///< firings in one turn, counter-clockwise from the x axis
  double half_view_rad = 3.2;          ///< columns farther than this from the x axis do not exist; over pi: all do
  double share = 1.0;                  ///< of the beams that fire in a scan
  double min_range_m = 1.0;
  double max_range_m = 120.0;
  double range_noise_m = 0.02;  ///< standard deviation
  double dropout = 0.02;        ///< share of beams lost at near range and steep incidence
};

/// Names that SensorByName knows: HDL-64E, HDL-32E, VLP-16, OS1-128, Livox-Avia.
std::vector<std::string> SensorNames();

/// Throws std::invalid_argument for an unknown name.
SensorModel SensorByName(const std::string& name);

}  // namespace incremental_segmatch::simulator
