/// \file
/// Casts a sweep: all beams leave one point, so primitives are drawn into an image of beams with a depth buffer.
#pragma once

#include <Eigen/Geometry>
#include <cstddef>
#include <vector>

#include "simulator/primitive.hpp"
#include "simulator/sensor_model.hpp"
#include "simulator/terrain.hpp"
#include "simulator/town.hpp"

namespace incremental_segmatch::simulator {

/// Hits of a sweep, ring by ring from the top, in each ring by column; no noise.
struct Sweep {
  std::vector<float> range_m;  ///< infinite where nothing was hit within the sensor's range
  std::vector<float> cos_incidence;
  std::vector<Material> material;
};

/// Each primitive is tested only against the beams of a window that surely contains it, nearest primitives first; the
/// cost grows with the windows' areas, and there is nothing to build. Reuse one object: it keeps its buffers.
class Caster {
 public:
  explicit Caster(const SensorModel& sensor);

  /// Direction of a beam in the sensor's frame.
  Eigen::Vector3f Direction(std::size_t ring, std::size_t column) const;

  const Sweep& Cast(const Eigen::Isometry3d& T_world_sensor, const std::vector<PlacedItem>& items,
                    const Terrain& terrain);

 private:
  struct Window {
    float near_m = 0.f;
    int ring_begin = 0, ring_end = 0;
    int column_begin = 0, columns = 0;  ///< columns wrap around
  };
  struct Candidate {
    Window window;
    const Primitive* primitive;
    Eigen::Matrix3f R_prim_sensor;
    Eigen::Vector3f origin_prim_m;
  };

  Window WindowOf(const Eigen::Vector3f& centre_sensor_m, const Eigen::Matrix3f& R_sensor_prim,
                  const Eigen::Vector3f& half_m) const;
  void Collect(const Eigen::Isometry3d& T_world_sensor, const std::vector<PlacedItem>& items);
  void Draw(const Candidate& candidate);
  void DrawGround(const Eigen::Isometry3d& T_world_sensor, const Terrain& terrain);

  SensorModel sensor_;
  std::vector<bool> in_view_;  // by column
  std::vector<float> cos_elevation_, sin_elevation_, tan_elevation_, cos_azimuth_, sin_azimuth_;
  std::vector<Candidate> candidates_;
  Sweep sweep_;
};

/// Range at which a ray meets the ground, infinite beyond limit_m.
float GroundRange(const Terrain& terrain, const Eigen::Vector3d& origin_m, const Eigen::Vector3d& direction,
                  float limit_m);

}  // namespace incremental_segmatch::simulator
