#include "simulator/item.hpp"

#include <algorithm>
#include <cmath>

#include "simulator/random.hpp"

namespace incremental_segmatch::simulator {
namespace {

using Eigen::Vector2f;
using Eigen::Vector3f;
using Primitives = std::vector<Primitive>;

constexpr float kPi = 3.14159265f;
constexpr float kFoot_m = 1.f;  // how far bodies reach below ground, so that slopes leave no gap

std::uint32_t Seed32(Random& random) {
  return static_cast<std::uint32_t>(random.Bits() >> 32);
}

Primitive::Windows DrawWindows(Random& random) {
  return {random.UniformF(1.9, 4.2), random.UniformF(0.8, 1.7),   random.UniformF(0.7, 1.2),
          random.UniformF(1.1, 1.6), random.UniformF(0.06, 0.28), random.UniformF(2.7, 3.2)};
}

// Four walls and a roof around `centre`, half sizes `half` (x: depth, y: width).
void AppendBody(Primitives& out, const Vector2f& centre, const Vector2f& half, float height,
                const Primitive::Windows& windows, Material material, Random& random) {
  const float half_height = 0.5f * (height + kFoot_m);
  const float middle = half_height - kFoot_m;
  const float facing[] = {0.f, kPi, 0.5f * kPi, -0.5f * kPi};
  const Vector2f offset[] = {{half.x(), 0}, {-half.x(), 0}, {0, half.y()}, {0, -half.y()}};
  for (int i = 0; i < 4; ++i) {
    const Vector2f at = centre + offset[i];
    Primitive::Windows own = windows;
    if (i > 1 && random.Chance(0.6)) own.pitch_m *= 2.f;  // gable walls have fewer windows
    out.push_back(Primitive::Facade({at.x(), at.y(), middle}, facing[i], i < 2 ? half.y() : half.x(), half_height, own,
                                    material, Seed32(random)));
  }
  const float eaves = 0.35f;
  const float rise = random.UniformF(1.0, 3.5);
  const Vector2f foot(half.x() + eaves, half.y() + eaves);
  const bool ridge_along_y = half.y() > half.x();
  const float hip = random.Chance(0.3) ? 0.6f : 0.f;
  const Vector2f top = ridge_along_y ? Vector2f(0.02f, foot.y() * (1 - hip)) : Vector2f(foot.x() * (1 - hip), 0.02f);
  out.push_back(Primitive::Frustum({centre.x(), centre.y(), height + 0.5f * rise}, 0.5f * rise, foot, top, 0.f,
                                   Material::kBrick));
}

void AppendDownpipe(Primitives& out, float x, float y, float height) {
  out.push_back(Primitive::Cylinder({x, y, -0.5f}, {x, y, height}, 0.06f, Material::kMetal));
}

void AppendPorch(Primitives& out, float front, float y, Random& random) {
  const float depth = random.UniformF(0.6, 0.95), half_width = random.UniformF(0.8, 1.4);
  const float roof = random.UniformF(2.3, 2.7);
  out.push_back(Primitive::Box({front + 0.5f * depth, y, roof}, {0.5f * depth, half_width, 0.08f}, Material::kWood));
  out.push_back(Primitive::Box({front + 0.5f * depth, y, -0.3f}, {0.5f * depth, half_width, 0.6f}, Material::kPlaster));
  if (random.Chance(0.5)) {
    out.push_back(Primitive::Box({front + 0.5f * depth, y - half_width, 0.5f * roof},
                                 {0.5f * depth, 0.06f, 0.5f * roof}, Material::kBrick));
  } else {
    for (const float side : {-1.f, 1.f}) {
      out.push_back(Primitive::Cylinder({front + depth - 0.1f, y + side * (half_width - 0.1f), 0.f},
                                        {front + depth - 0.1f, y + side * (half_width - 0.1f), roof}, 0.08f,
                                        Material::kWood));
    }
  }
}

void AppendBay(Primitives& out, float front, float y, float height, Random& random) {
  const float depth = random.UniformF(0.45, 0.95), half_width = random.UniformF(0.9, 1.9);
  const float top = random.Chance(0.6) ? random.UniformF(2.6, 3.2) : height;
  const Primitive::Windows windows{2.f * half_width, 1.2f * half_width, 0.9f, 1.4f, 0.1f, 2.9f};
  const float half_height = 0.5f * (top + kFoot_m);
  out.push_back(Primitive::Facade({front + depth, y, half_height - kFoot_m}, 0.f, half_width, half_height, windows,
                                  Material::kPlaster, Seed32(random)));
  out.push_back(Primitive::Frustum({front + 0.5f * depth - 0.02f, y, half_height - kFoot_m}, half_height,
                                   {0.5f * depth - 0.16f, half_width}, {0.5f * depth - 0.16f, half_width}, 0.f,
                                   Material::kPlaster));
}

void AppendBalcony(Primitives& out, float front, float y, Random& random) {
  const float depth = random.UniformF(0.7, 0.95), half_width = random.UniformF(1.2, 2.2),
              floor = random.UniformF(2.5, 3.0);
  out.push_back(Primitive::Box({front + 0.5f * depth, y, floor}, {0.5f * depth, half_width, 0.1f}, Material::kPlaster));
  out.push_back(
      Primitive::Pickets({front + depth, y, floor + 0.6f}, 0.f, half_width, 0.5f, 0.12f, 0.03f, Material::kMetal));
  for (const float side : {-1.f, 1.f}) {
    out.push_back(Primitive::Cylinder({front + depth - 0.1f, y + side * (half_width - 0.1f), -0.5f},
                                      {front + depth - 0.1f, y + side * (half_width - 0.1f), floor}, 0.07f,
                                      Material::kMetal));
  }
}

// A house of the footprint's size; its parts stay inside the footprint, which leaves a metre in front for porches.
Primitives BuildHouse(const Item& item) {
  Random random(item.seed);
  Primitives out;
  const float half_depth = static_cast<float>(item.footprint.half_m.x()),
              half_width = static_cast<float>(item.footprint.half_m.y());
  const float height = static_cast<float>(item.height_m);
  const float front = half_depth - 1.f;
  const Material material = random.Chance(0.7) ? Material::kPlaster : Material::kBrick;
  const Primitive::Windows windows = DrawWindows(random);
  const bool wing = half_width > 5.f && random.Chance(0.45);
  const float split = wing ? random.UniformF(-0.3, 0.3) * half_width : half_width;
  const float step_back = wing ? random.UniformF(0.8, 3.0) : 0.f;
  const Vector2f main_centre(0.5f * (front - half_depth), 0.5f * (split - half_width));
  AppendBody(out, main_centre, {0.5f * (front + half_depth), 0.5f * (split + half_width)}, height, windows, material,
             random);
  if (wing) {
    const float wing_front = front - step_back;
    AppendBody(out, {0.5f * (wing_front - half_depth), 0.5f * (split + half_width)},
               {0.5f * (wing_front + half_depth), 0.5f * (half_width - split)}, height * random.UniformF(0.5, 1.0),
               windows, material, random);
  }
  const float main_width = split + half_width;
  const auto along_front = [&](double share) {
    return -half_width + 1.6f + static_cast<float>(share) * std::max(0.f, main_width - 3.2f);
  };
  if (random.Chance(0.7)) AppendPorch(out, front, along_front(random.Uniform()), random);
  if (main_width > 7.f && random.Chance(0.4)) AppendBay(out, front, along_front(random.Uniform()), height, random);
  if (height > 5.f && random.Chance(0.35)) AppendBalcony(out, front, along_front(random.Uniform()), random);
  if (random.Chance(0.8)) AppendDownpipe(out, front + 0.12f, -half_width + 0.15f, height);
  if (random.Chance(0.6)) AppendDownpipe(out, front + 0.12f, split - 0.15f, height);
  out.push_back(
      Primitive::Box({main_centre.x(), main_centre.y() + 1.f, height + 2.f}, {0.3f, 0.4f, 2.2f}, Material::kBrick));
  return out;
}

// Garages and garden sheds: a box with a flat or pitched roof.
Primitives BuildShed(const Item& item) {
  Random random(item.seed);
  const Vector2f half = item.footprint.half_m.cast<float>();
  const float height = static_cast<float>(item.height_m);
  Primitives out{Primitive::Box({0, 0, 0.5f * (height - kFoot_m)},
                                {half.x() - 0.1f, half.y() - 0.1f, 0.5f * (height + kFoot_m)},
                                random.Chance(0.5) ? Material::kPlaster : Material::kWood)};
  const float rise = random.UniformF(0.1, 1.2);
  out.push_back(Primitive::Frustum({0, 0, height + 0.5f * rise}, 0.5f * rise, half, {half.x(), 0.1f * half.y()}, 0.f,
                                   Material::kWood));
  return out;
}

Primitives BuildHedge(const Item& item) {
  Random random(item.seed);
  const Vector2f half = item.footprint.half_m.cast<float>();
  const float height = static_cast<float>(item.height_m);
  return {Primitive::Foliage({0, 0, 0.5f * (height - 0.4f)}, {half.x(), half.y(), 0.5f * (height + 0.4f)}, false, 0.16f,
                             random.UniformF(0.85, 1.3), Seed32(random))};
}

Primitives BuildWall(const Item& item) {
  Random random(item.seed);
  const Vector2f half = item.footprint.half_m.cast<float>();
  const float height = static_cast<float>(item.height_m);
  Primitives out{
      Primitive::Box({0, 0, 0.5f * (height - kFoot_m)}, {0.1f, half.y(), 0.5f * (height + kFoot_m)}, Material::kBrick)};
  out.push_back(Primitive::Box({0, -half.y(), 0.5f * height}, {0.18f, 0.18f, 0.5f * height + 0.12f}, Material::kBrick));
  return out;
}

Primitives BuildPicketFence(const Item& item) {
  Random random(item.seed);
  const float half_width = static_cast<float>(item.footprint.half_m.y()), height = static_cast<float>(item.height_m);
  const float pitch = random.UniformF(0.09, 0.16);
  Primitives out{Primitive::Pickets({0, 0, 0.5f * height}, 0.f, half_width, 0.5f * height, pitch,
                                    pitch * random.UniformF(0.4, 0.75), Material::kWood)};
  for (float y = -half_width; y < half_width + 0.1f; y += 2.f * half_width) {
    out.push_back(Primitive::Box({0, y, 0.5f * height}, {0.06f, 0.06f, 0.5f * height + 0.08f}, Material::kWood));
  }
  return out;
}

Primitives BuildTree(const Item& item) {
  Random random(item.seed);
  Primitives out;
  const float height = static_cast<float>(std::max(item.height_m, item.lowest_leaf_m + 2.0));
  const float radius = static_cast<float>(item.footprint.half_m.x());
  const bool conifer = random.Chance(0.15) && item.lowest_leaf_m == 0.0;
  const float natural_base = conifer ? random.UniformF(0.3, 1.2) : std::min(0.55f * height, random.UniformF(1.2, 3.2));
  const float crown_base = std::max(natural_base, static_cast<float>(item.lowest_leaf_m));
  const float lean_x = random.UniformF(-0.15, 0.15), lean_y = random.UniformF(-0.15, 0.15);
  const Vector3f fork(lean_x, lean_y, crown_base + 0.25f * (height - crown_base));
  out.push_back(Primitive::Cylinder({0, 0, -0.5f}, fork, radius, Material::kBark));
  const float half_height = 0.5f * (height - crown_base);
  if (conifer) {
    for (int i = 0; i < 3; ++i) {
      const float share = 0.25f + 0.27f * static_cast<float>(i);
      const float r = (1.f - share) * half_height * 0.75f + 0.3f;
      out.push_back(Primitive::Foliage({lean_x, lean_y, crown_base + 2.f * half_height * share},
                                       {r, r, 0.45f * half_height}, true, 0.2f, 0.9f, Seed32(random)));
    }
    return out;
  }
  const float spread = half_height * random.UniformF(0.7, 1.15);
  const int lobes = 2 + random.Index(3);
  const float density = random.UniformF(0.6, 1.1);
  for (int i = 0; i < lobes; ++i) {
    const float angle = random.UniformF(0, 2 * kPi), out_m = 0.45f * spread * random.UniformF(0.3, 1.0);
    const Vector3f centre(lean_x + out_m * std::cos(angle), lean_y + out_m * std::sin(angle),
                          crown_base + half_height * random.UniformF(0.75, 1.15));
    const float r = spread * random.UniformF(0.6, 0.85);
    out.push_back(Primitive::Foliage(centre,
                                     {r, r * random.UniformF(0.8, 1.2), half_height * random.UniformF(0.65, 0.9)}, true,
                                     0.22f, density, Seed32(random)));
    out.push_back(Primitive::Cylinder({lean_x, lean_y, fork.z() - random.UniformF(0.1, 0.8)}, centre, 0.45f * radius,
                                      Material::kBark));
  }
  return out;
}

Primitives BuildBush(const Item& item) {
  Random random(item.seed);
  const float r = static_cast<float>(item.footprint.half_m.x()), height = static_cast<float>(item.height_m);
  Primitives out;
  const int lobes = 1 + random.Index(3);
  for (int i = 0; i < lobes; ++i) {
    const float share = i == 0 ? 1.f : random.UniformF(0.5, 0.8);
    const float x = i == 0 ? 0.f : random.UniformF(-0.5, 0.5) * r, y = i == 0 ? 0.f : random.UniformF(-0.5, 0.5) * r;
    out.push_back(Primitive::Foliage({x, y, 0.45f * height * share},
                                     {0.8f * r * share, 0.8f * r * share, 0.55f * height * share}, true, 0.16f,
                                     random.UniformF(0.8, 1.2), Seed32(random)));
  }
  return out;
}

Primitives BuildLamp(const Item& item) {
  Random random(item.seed);
  const float height = static_cast<float>(item.height_m);
  const float r = random.UniformF(0.06, 0.1);
  Primitives out{Primitive::Cylinder({0, 0, -0.5f}, {0, 0, height}, r, Material::kMetal)};
  out.push_back(Primitive::Cylinder({0, 0, -0.5f}, {0, 0, random.UniformF(0.9, 1.6)}, r + 0.05f, Material::kMetal));
  out.push_back(Primitive::Box({0.6f, 0, height}, {0.6f, 0.12f, 0.08f}, Material::kMetal));
  return out;
}

Primitives BuildSign(const Item& item) {
  Random random(item.seed);
  const float height = static_cast<float>(item.height_m);
  Primitives out{Primitive::Cylinder({0, 0, -0.5f}, {0, 0, height}, 0.04f, Material::kMetal)};
  const int plates = 1 + random.Index(2);
  for (int i = 0; i < plates; ++i) {
    out.push_back(Primitive::Box({0.05f, 0, height - 0.3f - 0.7f * static_cast<float>(i)},
                                 {0.015f, random.UniformF(0.25, 0.45), 0.3f}, Material::kRetro));
  }
  return out;
}

Primitives BuildBollard(const Item& item) {
  return {Primitive::Cylinder({0, 0, -0.3f}, {0, 0, static_cast<float>(item.height_m)}, 0.09f, Material::kMetal)};
}

Primitives BuildBench(const Item&) {
  return {Primitive::Box({0, 0, 0.45f}, {0.25f, 0.8f, 0.03f}, Material::kWood),
          Primitive::Box({-0.25f, 0, 0.7f}, {0.03f, 0.8f, 0.2f}, Material::kWood),
          Primitive::Box({0, -0.6f, 0.2f}, {0.2f, 0.05f, 0.25f}, Material::kMetal),
          Primitive::Box({0, 0.6f, 0.2f}, {0.2f, 0.05f, 0.25f}, Material::kMetal)};
}

// Wheeled bins, one to three in a row.
Primitives BuildBin(const Item& item) {
  Random random(item.seed);
  Primitives out;
  const int count = 1 + random.Index(3);
  for (int i = 0; i < count; ++i) {
    const float height = random.UniformF(0.95, 1.25),
                y = 0.65f * (static_cast<float>(i) - 0.5f * static_cast<float>(count - 1));
    out.push_back(Primitive::Frustum({0, y, 0.5f * height}, 0.5f * height, {0.26f, 0.24f}, {0.34f, 0.29f}, 0.f,
                                     Material::kMetal));
  }
  return out;
}

Primitives BuildBusStop(const Item& item) {
  Random random(item.seed);
  const float half = static_cast<float>(item.footprint.half_m.y()) - 0.1f;
  Primitives out{Primitive::Box({-0.6f, 0, 1.2f}, {0.03f, half, 1.0f}, Material::kCarGlass),
                 Primitive::Box({0, 0, 2.45f}, {0.75f, half, 0.06f}, Material::kMetal),
                 Primitive::Box({-0.35f, 0, 0.5f}, {0.2f, 0.7f * half, 0.04f}, Material::kWood),
                 Primitive::Box({0, half, 1.3f}, {0.55f, 0.05f, 0.9f}, Material::kMetal)};
  for (const float side : {-1.f, 1.f}) {
    out.push_back(
        Primitive::Cylinder({-0.6f, side * half, -0.3f}, {-0.6f, side * half, 2.45f}, 0.05f, Material::kMetal));
    out.push_back(Primitive::Cylinder({0.6f, side * half, -0.3f}, {0.6f, side * half, 2.45f}, 0.05f, Material::kMetal));
  }
  return out;
}

Primitives BuildUtilityPole(const Item& item) {
  Random random(item.seed);
  const float height = static_cast<float>(item.height_m);
  Primitives out{Primitive::Cylinder({0, 0, -0.5f}, {0, 0, height}, random.UniformF(0.12, 0.18), Material::kBark)};
  if (random.Chance(0.6)) {
    out.push_back(Primitive::Box({0.25f, 0, random.UniformF(1.0, 1.5)}, {0.15f, 0.25f, random.UniformF(0.3, 0.6)},
                                 Material::kMetal));
  }
  return out;
}

// Half sizes come from the footprint, proportions from the seed.
Primitives BuildVehicle(const Item& item) {
  Random random(item.seed);
  const float l = static_cast<float>(item.footprint.half_m.x()),
              w = static_cast<float>(item.footprint.half_m.y()) - 0.08f;
  const float height = static_cast<float>(item.height_m);
  Primitives out;
  if (height > 1.85f) {  // van or small lorry: a cab, and a box that is higher on lorries
    const bool lorry = height > 2.5f;
    const float split = l - (lorry ? 1.7f : 1.3f);
    const float cab_height = lorry ? 2.2f : height;
    out.push_back(Primitive::Box({0.5f * (split - l), 0, 0.5f * (height + 0.35f)},
                                 {0.5f * (split + l), w, 0.5f * (height - 0.35f)}, Material::kMetal));
    out.push_back(Primitive::Frustum({0.5f * (split + l), 0, 0.75f}, 0.45f, {0.5f * (l - split), w},
                                     {0.5f * (l - split), w}, 0.f, Material::kMetal));
    out.push_back(Primitive::Frustum({0.5f * (split + l) - 0.1f, 0, 0.5f * (1.2f + cab_height)},
                                     0.5f * (cab_height - 1.2f), {0.5f * (l - split) - 0.1f, w - 0.03f},
                                     {0.5f * (l - split) - 0.35f, w - 0.12f}, -0.2f, Material::kCarGlass));
  } else {
    const float belt = random.UniformF(0.84, 0.98) + (height > 1.6f ? 0.12f : 0.f);
    const float bonnet = random.UniformF(0.25, 0.33) * 2 * l;
    const float boot = (random.Chance(0.35) ? random.UniformF(0.15, 0.22) : random.UniformF(0.01, 0.05)) * 2 * l;
    const float cabin_half = 0.5f * (2 * l - bonnet - boot), cabin_centre = 0.5f * (boot - bonnet);
    const float slant = random.UniformF(0.25, 0.45);
    out.push_back(Primitive::Frustum({0, 0, 0.42f}, 0.2f, {l - 0.08f, w - 0.03f}, {l, w}, 0.f, Material::kMetal));
    out.push_back(Primitive::Frustum({0, 0, 0.5f * (0.62f + belt)}, 0.5f * (belt - 0.62f), {l, w},
                                     {l - 0.18f, w - 0.08f}, -0.05f, Material::kMetal));
    out.push_back(Primitive::Frustum({cabin_centre, 0, 0.5f * (belt + height)}, 0.5f * (height - belt),
                                     {cabin_half, w - 0.08f}, {cabin_half - slant, w - 0.25f}, -0.12f,
                                     Material::kCarGlass));
    out.push_back(
        Primitive::Box({cabin_centre - 0.12f, 0, height}, {cabin_half - slant, w - 0.25f, 0.03f}, Material::kMetal));
    for (const float side : {-1.f, 1.f}) {
      out.push_back(Primitive::Box({cabin_centre + cabin_half - 0.35f, side * (w + 0.02f), belt + 0.05f},
                                   {0.06f, 0.06f, 0.07f}, Material::kMetal));
    }
  }
  for (const float x : {-0.6f * l, 0.62f * l}) {
    for (const float side : {-1.f, 1.f}) {
      out.push_back(
          Primitive::Cylinder({x, side * (w - 0.2f), 0.31f}, {x, side * (w + 0.01f), 0.31f}, 0.31f, Material::kCloth));
    }
  }
  return out;
}

Primitives BuildPedestrian(const Item& item) {
  const float height = static_cast<float>(item.height_m);
  return {
      Primitive::Cylinder({0, 0.09f, 0}, {0, 0.09f, 0.5f * height}, 0.08f, Material::kCloth),
      Primitive::Cylinder({0, -0.09f, 0}, {0, -0.09f, 0.5f * height}, 0.08f, Material::kCloth),
      Primitive::Frustum({0, 0, 0.67f * height}, 0.18f * height, {0.11f, 0.17f}, {0.13f, 0.24f}, 0.f, Material::kCloth),
      Primitive::Cylinder({0, 0, 0.84f * height}, {0, 0, height}, 0.1f, Material::kCloth)};
}

Primitives BuildBlock(const Item& item, Material material) {
  const Vector2f half = item.footprint.half_m.cast<float>();
  const float height = static_cast<float>(item.height_m);
  return {Primitive::Box({0, 0, 0.5f * height}, {half.x(), half.y(), 0.5f * height}, material)};
}

// Table top, sides, perhaps drawers, perhaps screens.
Primitives BuildDesk(const Item& item) {
  Random random(item.seed);
  const Vector2f half = item.footprint.half_m.cast<float>();
  const float height = static_cast<float>(item.height_m);
  Primitives out{Primitive::Box({0, 0, height}, {half.x(), half.y(), 0.02f}, Material::kWood)};
  for (const float side : {-1.f, 1.f}) {
    out.push_back(Primitive::Box({0, side * (half.y() - 0.03f), 0.5f * height},
                                 {half.x() - 0.05f, 0.02f, 0.5f * height}, Material::kWood));
  }
  if (random.Chance(0.6)) {
    const float side = random.Chance(0.5) ? 1.f : -1.f;
    out.push_back(
        Primitive::Box({0, side * (half.y() - 0.28f), 0.3f}, {half.x() - 0.08f, 0.2f, 0.29f}, Material::kMetal));
  }
  if (random.Chance(0.4))
    out.push_back(
        Primitive::Box({0.05f - half.x(), 0, 0.5f * height}, {0.02f, half.y(), 0.35f * height}, Material::kWood));
  for (int screens = random.Index(3), i = 0; i < screens; ++i) {
    out.push_back(Primitive::Box(
        {-0.6f * half.x(), (static_cast<float>(i) - 0.5f * static_cast<float>(screens - 1)) * 0.6f, height + 0.28f},
        {0.03f, 0.27f, 0.2f}, Material::kMetal));
  }
  return out;
}

Primitives BuildPottedPlant(const Item& item) {
  Random random(item.seed);
  const float r = static_cast<float>(item.footprint.half_m.x()), height = static_cast<float>(item.height_m);
  return {Primitive::Cylinder({0, 0, 0}, {0, 0, 0.35f}, 0.7f * r, Material::kPlaster),
          Primitive::Foliage({0, 0, 0.5f * (height + 0.35f)}, {r, r, 0.5f * (height - 0.35f)}, true, 0.1f,
                             random.UniformF(0.7, 1.1), Seed32(random))};
}

Primitives BuildCeiling(const Item& item) {
  const Vector2f half = item.footprint.half_m.cast<float>();
  return {
      Primitive::Box({0, 0, static_cast<float>(item.height_m) + 0.1f}, {half.x(), half.y(), 0.1f}, Material::kPlaster)};
}

// Looks towards +x.
Primitives BuildChair(const Item&) {
  return {Primitive::Box({0, 0, 0.47f}, {0.23f, 0.23f, 0.04f}, Material::kCloth),
          Primitive::Box({-0.22f, 0, 0.78f}, {0.03f, 0.21f, 0.24f}, Material::kCloth),
          Primitive::Cylinder({0, 0, 0.06f}, {0, 0, 0.45f}, 0.04f, Material::kMetal),
          Primitive::Box({0, 0, 0.06f}, {0.26f, 0.03f, 0.03f}, Material::kMetal),
          Primitive::Box({0, 0, 0.06f}, {0.03f, 0.26f, 0.03f}, Material::kMetal)};
}

}  // namespace

std::vector<Primitive> BuildItem(const Item& item) {
  switch (item.kind) {
    case ItemKind::kHouse:
      return BuildHouse(item);
    case ItemKind::kShed:
      return BuildShed(item);
    case ItemKind::kHedge:
      return BuildHedge(item);
    case ItemKind::kWall:
      return BuildWall(item);
    case ItemKind::kPicketFence:
      return BuildPicketFence(item);
    case ItemKind::kTree:
      return BuildTree(item);
    case ItemKind::kBush:
      return BuildBush(item);
    case ItemKind::kLamp:
      return BuildLamp(item);
    case ItemKind::kSign:
      return BuildSign(item);
    case ItemKind::kBollard:
      return BuildBollard(item);
    case ItemKind::kBench:
      return BuildBench(item);
    case ItemKind::kBin:
      return BuildBin(item);
    case ItemKind::kBusStop:
      return BuildBusStop(item);
    case ItemKind::kUtilityPole:
      return BuildUtilityPole(item);
    case ItemKind::kVehicle:
      return BuildVehicle(item);
    case ItemKind::kPedestrian:
      return BuildPedestrian(item);
    case ItemKind::kPartition:
    case ItemKind::kPillar:
      return BuildBlock(item, Material::kPlaster);
    case ItemKind::kDesk:
      return BuildDesk(item);
    case ItemKind::kCabinet:
      return BuildBlock(item, Material::kWood);
    case ItemKind::kPottedPlant:
      return BuildPottedPlant(item);
    case ItemKind::kCeiling:
      return BuildCeiling(item);
    case ItemKind::kChair:
      return BuildChair(item);
    case ItemKind::kParkingSpot:
    case ItemKind::kChairSpot:
      return {};
  }
  return {};
}

Item RandomVehicle(std::uint64_t seed) {
  Random random(seed);
  Item item;
  item.kind = ItemKind::kVehicle;
  item.seed = random.Bits();
  const double kind = random.Uniform();
  double length = 0.0, width = 0.0;
  if (kind < 0.35) {  // small car
    length = random.Uniform(3.5, 4.1), width = random.Uniform(1.62, 1.75), item.height_m = random.Uniform(1.42, 1.55);
  } else if (kind < 0.7) {  // saloon or estate
    length = random.Uniform(4.3, 4.9), width = random.Uniform(1.74, 1.88), item.height_m = random.Uniform(1.4, 1.52);
  } else if (kind < 0.88) {  // high cars
    length = random.Uniform(4.2, 4.8), width = random.Uniform(1.78, 1.92), item.height_m = random.Uniform(1.62, 1.82);
  } else if (kind < 0.97) {  // vans
    length = random.Uniform(4.8, 5.6), width = random.Uniform(1.9, 2.0), item.height_m = random.Uniform(1.92, 2.45);
  } else {
    length = random.Uniform(5.6, 6.2), width = 2.1, item.height_m = random.Uniform(2.7, 3.0);
  }
  item.footprint.half_m = {0.5 * length, 0.5 * width + 0.08};
  return item;
}

}  // namespace incremental_segmatch::simulator
