#include "simulator/sensor_model.hpp"

#include <stdexcept>

namespace incremental_segmatch::simulator {
namespace {

constexpr double kRadPerDeg = 3.14159265358979323846 / 180.0;

// Appends `count` beams from `top_deg` down to `bottom_deg`, equally spaced.
void AppendBeams(std::vector<double>& elevations_rad, int count, double top_deg, double bottom_deg) {
  for (int i = 0; i < count; ++i) {
    elevations_rad.push_back(kRadPerDeg * (top_deg + (bottom_deg - top_deg) * i / (count - 1)));
  }
}

}  // namespace

std::vector<std::string> SensorNames() {
  return {"HDL-64E", "HDL-32E", "VLP-16", "OS1-128", "Livox-Avia"};
}

SensorModel SensorByName(const std::string& name) {
  SensorModel model;
  model.name = name;
  if (name == "HDL-64E") {
    AppendBeams(model.elevations_rad, 32, 2.0, -8.33);
    AppendBeams(model.elevations_rad, 32, -8.83, -24.8);
    model.columns = 2083;
    model.min_range_m = 2.0;
    model.max_range_m = 120.0;
  } else if (name == "HDL-32E") {
    AppendBeams(model.elevations_rad, 32, 10.67, -30.67);
    model.columns = 1800;
    model.max_range_m = 100.0;
  } else if (name == "VLP-16") {
    AppendBeams(model.elevations_rad, 16, 15.0, -15.0);
    model.columns = 1800;
    model.max_range_m = 100.0;
  } else if (name == "OS1-128") {
    AppendBeams(model.elevations_rad, 128, 22.5, -22.5);
    model.columns = 1024;
    model.max_range_m = 120.0;
  } else if (name == "Livox-Avia") {
    AppendBeams(model.elevations_rad, 194, 38.6, -38.6);
    model.columns = 900;
    model.half_view_rad = kRadPerDeg * 35.2;
    model.share = 0.7;  // 24 000 points in a tenth of a second
    model.max_range_m = 120.0;
  } else {
    throw std::invalid_argument("unknown sensor '" + name + "': use HDL-64E, HDL-32E, VLP-16, OS1-128 or Livox-Avia");
  }
  return model;
}

}  // namespace incremental_segmatch::simulator
