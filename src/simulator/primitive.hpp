/// \file
/// What the town is made of, as a ray sees it: a few solids, patterned walls and foliage.
#pragma once

#include <Eigen/Geometry>
#include <cstdint>
#include <limits>
#include <vector>

namespace incremental_segmatch::simulator {

enum class Shape : std::uint8_t {
  kBox,       ///< half sizes
  kFrustum,   ///< box whose top rectangle differs: see Primitive::Frustum
  kCylinder,  ///< along z, closed
  kFacade,    ///< wall in the plane x = 0, facing +x, with recessed windows
  kPickets,   ///< fence in the plane x = 0: upright slats and two rails
  kFoliage,   ///< leaves scattered through an ellipsoid or a box
};

enum class Material : std::uint8_t {
  kRoad,
  kPlaster,
  kBrick,
  kWood,
  kBark,
  kLeaf,
  kMetal,
  kCarGlass,
  kWindow,
  kRetro,
  kCloth
};

/// Where a ray meets a surface; range is infinite if it does not.
struct RayHit {
  float range_m = std::numeric_limits<float>::infinity();
  float cos_incidence = 1.f;
  Material material = Material::kPlaster;
};

/// One piece of geometry in the frame of the item that it belongs to.
struct Primitive {
  Shape shape = Shape::kBox;
  Material material = Material::kPlaster;
  std::uint32_t seed = 0;  ///< of window patterns and leaves
  Eigen::Matrix3f R_item_prim = Eigen::Matrix3f::Identity();
  Eigen::Vector3f centre_m = Eigen::Vector3f::Zero();  ///< in the item's frame
  Eigen::Vector3f half_m = Eigen::Vector3f::Zero();    ///< bounding half sizes in the primitive's frame
  float parameters[6] = {};                            ///< per shape, see the makers below

  static Primitive Box(const Eigen::Vector3f& centre_m, const Eigen::Vector3f& half_m, Material material);
  /// Bottom rectangle of half sizes `bottom_m` at -half_height, top of `top_m` shifted by top_shift_m along x.
  static Primitive Frustum(const Eigen::Vector3f& centre_m, float half_height_m, const Eigen::Vector2f& bottom_m,
                           const Eigen::Vector2f& top_m, float top_shift_m, Material material);
  /// From `from_m` to `to_m`, in the item's frame.
  static Primitive Cylinder(const Eigen::Vector3f& from_m, const Eigen::Vector3f& to_m, float radius_m,
                            Material material);
  /// Windows of a facade; all in metres. A share of openings is missing, and a share of the rest has closed shutters.
  struct Windows {
    float pitch_m, width_m, sill_m, height_m, recess_m, storey_m;
  };
  /// Wall through `centre_m` facing the direction facing_rad about z; half_width_m along the wall.
  static Primitive Facade(const Eigen::Vector3f& centre_m, float facing_rad, float half_width_m, float half_height_m,
                          const Windows& windows, Material material, std::uint32_t seed);
  static Primitive Pickets(const Eigen::Vector3f& centre_m, float facing_rad, float half_width_m, float half_height_m,
                           float pitch_m, float slat_m, Material material);
  /// Leaves in cells of cell_m; density in [0, 1] is the share of cells with a leaf at the rim.
  static Primitive Foliage(const Eigen::Vector3f& centre_m, const Eigen::Vector3f& half_m, bool ellipsoid, float cell_m,
                           float density, std::uint32_t seed);
};

/// First hit of the ray origin + t * direction, 0 < t < limit_m, in the primitive's frame; direction is a unit vector.
RayHit Intersect(const Primitive& primitive, const Eigen::Vector3f& origin_m, const Eigen::Vector3f& direction,
                 float limit_m);

}  // namespace incremental_segmatch::simulator
