#include "simulator/primitive.hpp"

#include <algorithm>
#include <array>
#include <cmath>

#include "simulator/random.hpp"

namespace incremental_segmatch::simulator {
namespace {

using Eigen::Matrix3f;
using Eigen::Vector2f;
using Eigen::Vector3f;

// The stretch of a ray inside a box around the origin, and the axis through which it enters.
struct Span {
  float enter, leave;
  int axis;
  bool Empty() const { return enter > leave || leave <= 0.f; }
};

inline Span BoxSpan(const Vector3f& o, const Vector3f& d, const Vector3f& half) {
  Span span{-1e9f, 1e9f, 0};
  for (int i = 0; i < 3; ++i) {
    const float inverse = 1.f / (std::abs(d[i]) > 1e-12f ? d[i] : 1e-12f);
    const float a = (-half[i] - o[i]) * inverse;
    const float b = (half[i] - o[i]) * inverse;
    const float near = std::min(a, b);
    if (near > span.enter) {
      span.enter = near;
      span.axis = i;
    }
    span.leave = std::min(span.leave, std::max(a, b));
  }
  return span;
}

inline RayHit IntersectBox(const Primitive& p, const Vector3f& o, const Vector3f& d, float limit) {
  const Span span = BoxSpan(o, d, p.half_m);
  if (span.Empty() || span.enter <= 0.f || span.enter >= limit) return {};
  return {span.enter, std::abs(d[span.axis]), p.material};
}

inline RayHit IntersectFrustum(const Primitive& p, const Vector3f& o, const Vector3f& d, float limit) {
  const float h = p.half_m.z();
  const float* q = p.parameters;
  // The middle rectangle and how each side leans per metre of height.
  const float mid_x = 0.5f * (q[0] + q[2]), mid_y = 0.5f * (q[1] + q[3]);
  const float lean_front = (q[4] + q[2] - q[0]) / (2 * h), lean_back = (-q[4] + q[2] - q[0]) / (2 * h);
  const float lean_side = (q[3] - q[1]) / (2 * h), shift = 0.5f * q[4];
  const Vector3f normals[6] = {{1, 0, -lean_front}, {-1, 0, -lean_back}, {0, 1, -lean_side},
                               {0, -1, -lean_side}, {0, 0, 1},           {0, 0, -1}};
  const float offsets[6] = {mid_x + shift, mid_x - shift, mid_y, mid_y, h, h};
  float enter = -1e9f, leave = 1e9f;
  int face = 0;
  for (int i = 0; i < 6; ++i) {
    const float towards = normals[i].dot(d);
    const float distance = offsets[i] - normals[i].dot(o);
    if (std::abs(towards) < 1e-12f) {
      if (distance < 0) return {};
      continue;
    }
    const float t = distance / towards;
    if (towards < 0) {
      if (t > enter) {
        enter = t;
        face = i;
      }
    } else {
      leave = std::min(leave, t);
    }
  }
  if (enter > leave || enter <= 0.f || enter >= limit) return {};
  const Material material = p.material == Material::kCarGlass && face >= 4 ? Material::kMetal : p.material;
  return {enter, std::abs(normals[face].dot(d)) / normals[face].norm(), material};
}

inline RayHit IntersectCylinder(const Primitive& p, const Vector3f& o, const Vector3f& d, float limit) {
  const float r = p.half_m.x(), h = p.half_m.z();
  const float a = d.x() * d.x() + d.y() * d.y();
  if (a > 1e-12f) {
    const float b = o.x() * d.x() + o.y() * d.y();
    const float c = o.x() * o.x() + o.y() * o.y() - r * r;
    const float discriminant = b * b - a * c;
    if (discriminant < 0) return {};
    const float t = (-b - std::sqrt(discriminant)) / a;
    if (t > 0 && std::abs(o.z() + t * d.z()) <= h) {
      if (t >= limit) return {};
      const float cosine = std::abs((o.x() + t * d.x()) * d.x() + (o.y() + t * d.y()) * d.y()) / r;
      return {t, cosine, p.material};
    }
  }
  if (std::abs(d.z()) < 1e-9f) return {};
  const float t = ((d.z() < 0 ? h : -h) - o.z()) / d.z();
  const float x = o.x() + t * d.x(), y = o.y() + t * d.y();
  if (t <= 0 || t >= limit || x * x + y * y > r * r) return {};
  return {t, std::abs(d.z()), p.material};
}

inline RayHit IntersectFacade(const Primitive& p, const Vector3f& o, const Vector3f& d, float limit) {
  if (o.x() <= 0.f || d.x() >= -1e-9f) return {};
  const float t = -o.x() / d.x();
  if (t >= limit) return {};
  const float y = o.y() + t * d.y(), z = o.z() + t * d.z();
  if (std::abs(y) > p.half_m.y() || std::abs(z) > p.half_m.z()) return {};
  const RayHit wall{t, -d.x(), p.material};
  const float* q = p.parameters;
  const float pitch = q[0], width = q[1], sill = q[2], height = q[3], recess = q[4], storey = q[5];
  // The wall's foot is one metre below ground, so that slopes leave no gap.
  const float up = z + p.half_m.z() - 1.f;
  const float along = y + p.half_m.y();
  const int column = static_cast<int>(along / pitch);
  const int floor = static_cast<int>(std::floor(up / storey));
  if (up < 0 || (column + 1) * pitch > 2 * p.half_m.y() || (floor + 1) * storey > 2 * p.half_m.z() - 1.f) return wall;
  const std::uint64_t hash = HashOf(p.seed, static_cast<std::uint64_t>(column), static_cast<std::uint64_t>(floor));
  if ((hash & 7) == 0) return wall;  // no opening here
  const bool door = floor == 0 && ((hash >> 3) & 7) == 0;
  const float half_width = 0.5f * width * (0.75f + 0.5f * static_cast<float>((hash >> 8) & 255) / 255.f);
  const float middle = (column + 0.5f) * pitch + 0.2f * (static_cast<float>((hash >> 16) & 255) / 255.f - 0.5f) * pitch;
  const float low = floor * storey + (door ? 0.f : sill), high = floor * storey + sill + height;
  if (std::abs(along - middle) > half_width || up < low || up > high) return wall;
  const bool shut = door || ((hash >> 24) & 3) == 0;
  const float behind = t - recess / d.x();
  const float y_behind = along + (behind - t) * d.y(), z_behind = up + (behind - t) * d.z();
  if (std::abs(y_behind - middle) <= half_width && z_behind >= low && z_behind <= high) {
    if (behind >= limit) return {};
    return {behind, -d.x(), shut ? Material::kWood : Material::kWindow};
  }
  const float reveal_y = d.y() > 0 ? (middle + half_width - along) / d.y() : (middle - half_width - along) / d.y();
  const float reveal_z = d.z() > 0 ? (high - up) / d.z() : (low - up) / d.z();
  const bool sideways = !(reveal_z < reveal_y);
  const float reveal = t + std::max(0.f, sideways ? reveal_y : reveal_z);
  if (!(reveal < limit)) return {};
  return {reveal, std::abs(sideways ? d.y() : d.z()), p.material};
}

inline RayHit IntersectPickets(const Primitive& p, const Vector3f& o, const Vector3f& d, float limit) {
  if (std::abs(d.x()) < 1e-9f) return {};
  const float t = -o.x() / d.x();
  if (t <= 0 || t >= limit) return {};
  const float y = o.y() + t * d.y(), z = o.z() + t * d.z();
  if (std::abs(y) > p.half_m.y() || std::abs(z) > p.half_m.z()) return {};
  const float pitch = p.parameters[0], slat = p.parameters[1];
  const float phase = (y + p.half_m.y()) / pitch;
  const bool on_slat = (phase - std::floor(phase)) * pitch < slat;
  const bool on_rail = std::abs(std::abs(z) - 0.75f * p.half_m.z()) < 0.04f;
  if (!on_slat && !on_rail) return {};
  return {t, std::abs(d.x()), p.material};
}

// A periodic block of leaves: per cell one disc, and a threshold that decides at which density it exists.
struct Leaf {
  Vector3f centre;  // in units of the cell
  Vector3f normal;
  float radius_squared;
  float threshold;
};

constexpr int kLeafBlock = 16;

std::vector<Leaf> MakeLeaves() {
  Random random(77);
  std::array<float, 64> clumps;
  for (float& clump : clumps) clump = random.UniformF(-0.35, 0.35);
  std::vector<Leaf> leaves(kLeafBlock * kLeafBlock * kLeafBlock);
  for (std::size_t i = 0; i < leaves.size(); ++i) {
    const std::size_t x = i % kLeafBlock, y = i / kLeafBlock % kLeafBlock, z = i / kLeafBlock / kLeafBlock;
    Leaf& leaf = leaves[i];
    for (int k = 0; k < 3; ++k) leaf.centre[k] = random.UniformF(0.25, 0.75);
    do {
      for (int k = 0; k < 3; ++k) leaf.normal[k] = random.UniformF(-1, 1);
    } while (leaf.normal.squaredNorm() > 1.f || leaf.normal.squaredNorm() < 0.01f);
    leaf.normal.normalize();
    const float radius = random.UniformF(0.35, 0.6);
    leaf.radius_squared = radius * radius;
    leaf.threshold = random.UniformF(0, 1) + clumps[x / 4 + 4 * (y / 4) + 16 * (z / 4)];
  }
  return leaves;
}

const std::vector<Leaf>& Leaves() {
  static const std::vector<Leaf> leaves = MakeLeaves();
  return leaves;
}

// The stretch of a ray inside the ellipsoid of half sizes `half`.
inline Span EllipsoidSpan(const Vector3f& o, const Vector3f& d, const Vector3f& half) {
  const Vector3f oo = o.cwiseQuotient(half), dd = d.cwiseQuotient(half);
  const float a = dd.squaredNorm(), b = oo.dot(dd), c = oo.squaredNorm() - 1.f;
  const float discriminant = b * b - a * c;
  if (discriminant < 0) return {1.f, 0.f, 0};
  const float root = std::sqrt(discriminant);
  return {(-b - root) / a, (-b + root) / a, 0};
}

inline RayHit IntersectFoliage(const Primitive& p, const Vector3f& o, const Vector3f& d, float limit) {
  const bool ellipsoid = p.parameters[0] != 0.f;
  const Span span = ellipsoid ? EllipsoidSpan(o, d, p.half_m) : BoxSpan(o, d, p.half_m);
  if (span.Empty() || span.enter >= limit) return {};
  const std::vector<Leaf>& leaves = Leaves();
  const float cell = p.parameters[1], density = p.parameters[2];
  const float t0 = std::max(0.f, span.enter) / cell, t1 = std::min(limit, span.leave) / cell;
  const Vector3f origin = (o + p.half_m) / cell;
  int at[3], step[3];
  float next[3], delta[3];
  for (int i = 0; i < 3; ++i) {
    const float x = origin[i] + t0 * d[i];
    at[i] = static_cast<int>(std::floor(x));
    const float slope = std::abs(d[i]) > 1e-9f ? d[i] : 1e-9f;
    step[i] = slope > 0 ? 1 : -1;
    delta[i] = std::abs(1.f / slope);
    next[i] = t0 + ((slope > 0 ? static_cast<float>(at[i]) + 1.f : static_cast<float>(at[i])) - x) / slope;
  }
  const Vector3f inverse_half = p.half_m.cwiseInverse() * cell;
  const int shift[3] = {static_cast<int>(p.seed & 15), static_cast<int>((p.seed >> 4) & 15),
                        static_cast<int>((p.seed >> 8) & 15)};
  for (float t = t0; t < t1;) {
    const int axis = next[0] < next[1] ? (next[0] < next[2] ? 0 : 2) : (next[1] < next[2] ? 1 : 2);
    const std::size_t index = static_cast<std::size_t>(((at[0] + shift[0]) & 15) | (((at[1] + shift[1]) & 15) << 4) |
                                                       (((at[2] + shift[2]) & 15) << 8));
    const Leaf& leaf = leaves[index];
    const Vector3f centre =
        leaf.centre + Vector3f(static_cast<float>(at[0]), static_cast<float>(at[1]), static_cast<float>(at[2]));
    // Leaves hang at the rim of a crown, few grow inside.
    const Vector3f from_middle = centre.cwiseProduct(inverse_half) - Vector3f::Ones();
    const float outwards = ellipsoid ? from_middle.squaredNorm() : from_middle.cwiseAbs().maxCoeff();
    if (leaf.threshold < density * (0.35f + 0.65f * outwards)) {
      const float towards = leaf.normal.dot(d);
      const float hit = leaf.normal.dot(centre - origin) / (std::abs(towards) > 1e-6f ? towards : 1e-6f);
      // Leaves end at their cell: so the first hit found is the nearest.
      if (hit >= t && hit < std::min(t1, next[axis]) &&
          (origin + hit * d - centre).squaredNorm() < leaf.radius_squared) {
        return {hit * cell, std::max(0.3f, std::abs(towards)), p.material};
      }
    }
    t = next[axis];
    next[axis] += delta[axis];
    at[axis] += step[axis];
  }
  return {};
}

Matrix3f TurnAboutZ(float angle) {
  Matrix3f r;
  r << std::cos(angle), -std::sin(angle), 0, std::sin(angle), std::cos(angle), 0, 0, 0, 1;
  return r;
}

}  // namespace

Primitive Primitive::Box(const Vector3f& centre_m, const Vector3f& half_m, Material material) {
  Primitive p;
  p.shape = Shape::kBox;
  p.material = material;
  p.centre_m = centre_m;
  p.half_m = half_m;
  return p;
}

Primitive Primitive::Frustum(const Vector3f& centre_m, float half_height_m, const Vector2f& bottom_m,
                             const Vector2f& top_m, float top_shift_m, Material material) {
  Primitive p;
  p.shape = Shape::kFrustum;
  p.material = material;
  p.centre_m = centre_m;
  p.half_m = {std::max(bottom_m.x(), top_m.x() + std::abs(top_shift_m)), std::max(bottom_m.y(), top_m.y()),
              half_height_m};
  const float q[] = {bottom_m.x(), bottom_m.y(), top_m.x(), top_m.y(), top_shift_m};
  std::copy(std::begin(q), std::end(q), p.parameters);
  return p;
}

Primitive Primitive::Cylinder(const Vector3f& from_m, const Vector3f& to_m, float radius_m, Material material) {
  Primitive p;
  p.shape = Shape::kCylinder;
  p.material = material;
  p.centre_m = 0.5f * (from_m + to_m);
  const Vector3f axis = (to_m - from_m).normalized();
  const Vector3f across = std::abs(axis.z()) < 0.9f ? Vector3f::UnitZ().cross(axis).normalized().eval()
                                                    : axis.cross(Vector3f::UnitX()).normalized().eval();
  p.R_item_prim << across, axis.cross(across), axis;
  p.half_m = {radius_m, radius_m, 0.5f * (to_m - from_m).norm()};
  return p;
}

Primitive Primitive::Facade(const Vector3f& centre_m, float facing_rad, float half_width_m, float half_height_m,
                            const Windows& windows, Material material, std::uint32_t seed) {
  Primitive p;
  p.shape = Shape::kFacade;
  p.material = material;
  p.seed = seed;
  p.centre_m = centre_m;
  p.R_item_prim = TurnAboutZ(facing_rad);
  p.half_m = {windows.recess_m, half_width_m, half_height_m};
  const float q[] = {windows.pitch_m,  windows.width_m,  windows.sill_m,
                     windows.height_m, windows.recess_m, windows.storey_m};
  std::copy(std::begin(q), std::end(q), p.parameters);
  return p;
}

Primitive Primitive::Pickets(const Vector3f& centre_m, float facing_rad, float half_width_m, float half_height_m,
                             float pitch_m, float slat_m, Material material) {
  Primitive p;
  p.shape = Shape::kPickets;
  p.material = material;
  p.centre_m = centre_m;
  p.R_item_prim = TurnAboutZ(facing_rad);
  p.half_m = {0.01f, half_width_m, half_height_m};
  p.parameters[0] = pitch_m;
  p.parameters[1] = slat_m;
  return p;
}

Primitive Primitive::Foliage(const Vector3f& centre_m, const Vector3f& half_m, bool ellipsoid, float cell_m,
                             float density, std::uint32_t seed) {
  Primitive p;
  p.shape = Shape::kFoliage;
  p.material = Material::kLeaf;
  p.seed = seed;
  p.centre_m = centre_m;
  p.half_m = half_m;
  p.parameters[0] = ellipsoid ? 1.f : 0.f;
  p.parameters[1] = cell_m;
  p.parameters[2] = density;
  return p;
}

RayHit Intersect(const Primitive& primitive, const Vector3f& origin_m, const Vector3f& direction, float limit_m) {
  switch (primitive.shape) {
    case Shape::kBox:
      return IntersectBox(primitive, origin_m, direction, limit_m);
    case Shape::kFrustum:
      return IntersectFrustum(primitive, origin_m, direction, limit_m);
    case Shape::kCylinder:
      return IntersectCylinder(primitive, origin_m, direction, limit_m);
    case Shape::kFacade:
      return IntersectFacade(primitive, origin_m, direction, limit_m);
    case Shape::kPickets:
      return IntersectPickets(primitive, origin_m, direction, limit_m);
    case Shape::kFoliage:
      return IntersectFoliage(primitive, origin_m, direction, limit_m);
  }
  return {};
}

}  // namespace incremental_segmatch::simulator
