#include "incremental_segmatch/ground_filter.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <functional>
#include <limits>
#include <random>
#include <stdexcept>

namespace incremental_segmatch {
namespace {

const float kNan = std::numeric_limits<float>::quiet_NaN();
const float kInfinity = std::numeric_limits<float>::infinity();

GroundFilterParameters Elevation() {
  GroundFilterParameters parameters;
  parameters.model = GroundModel::kElevation;
  return parameters;
}

Points RandomPoints(std::mt19937& random, std::size_t count) {
  std::uniform_real_distribution<float> horizontal(-60.f, 60.f), vertical(-4.f, 8.f), uniform(0.f, 1.f);
  Points points;
  for (std::size_t i = 0; i < count; ++i) {
    points.emplace_back(horizontal(random), horizontal(random), vertical(random));
    if (uniform(random) < 0.05f) points.back() *= 0.02f;  // near the sensor
    if (uniform(random) < 0.02f) points.back()[i % 3] = i % 2 == 0 ? kNan : (i % 4 == 1 ? kInfinity : -kInfinity);
  }
  return points;
}

TEST(GroundFilter, HeightThresholdEqualsAPlainLoop) {
  for (unsigned seed = 0; seed < 20; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    std::mt19937 random(seed);
    GroundFilterParameters parameters;
    parameters.model = seed % 2 == 0 ? GroundModel::kHeightThreshold : GroundModel::kNone;
    parameters.max_height_m = 6.0;
    const Points points = RandomPoints(random, 3000);
    GroundFilterResult expected;
    for (const Eigen::Vector3f& p : points) {
      const double range = std::hypot(p.x(), p.y());
      if (!p.allFinite()) {
        ++expected.dropped_nonfinite;
      } else if (range < 1.5 || range > 50.0 || p.z() > 6.f) {
        ++expected.dropped_range;
      } else if (seed % 2 == 0 && p.z() < -1.f) {
        ++expected.dropped_ground;
      } else {
        expected.obstacles_sensor.push_back(p);
      }
    }
    const GroundFilterResult result = GroundFilter(parameters).Filter(points, Pose::Identity());
    EXPECT_EQ(result.obstacles_sensor, expected.obstacles_sensor);
    EXPECT_EQ(result.dropped_nonfinite, expected.dropped_nonfinite);
    EXPECT_EQ(result.dropped_range, expected.dropped_range);
    EXPECT_EQ(result.dropped_ground, expected.dropped_ground);
    EXPECT_GT(expected.dropped_nonfinite, 0u);
    EXPECT_GT(expected.dropped_range, 0u);
  }
}

TEST(GroundFilter, ElevationCountsEachPointOnceAndKeepsTheOrder) {
  std::mt19937 random(1);
  const Points points = RandomPoints(random, 5000);
  const GroundFilterResult result = GroundFilter(Elevation()).Filter(points, Pose::Identity());
  EXPECT_EQ(result.obstacles_sensor.size() + result.dropped_nonfinite + result.dropped_range + result.dropped_ground,
            points.size());
  EXPECT_GT(result.dropped_nonfinite, 0u);
  std::size_t at = 0;
  for (const Eigen::Vector3f& kept : result.obstacles_sensor) {
    while (at < points.size() && points[at] != kept) ++at;
    ASSERT_LT(at++, points.size());
  }
}

TEST(GroundFilter, AnEmptyScanGivesNothing) {
  for (const auto model : {GroundModel::kNone, GroundModel::kHeightThreshold, GroundModel::kElevation}) {
    GroundFilterParameters parameters;
    parameters.model = model;
    EXPECT_TRUE(GroundFilter(parameters).Filter({}, Pose::Identity()).obstacles_sensor.empty());
  }
}

TEST(GroundFilter, PointsOnTheRimOfTheElevationMapAreSafe) {
  const Points rim{{50, 0, 5}, {-50, 0, 5}, {0, 50, 5}, {0, -50, 5}};
  EXPECT_EQ(GroundFilter(Elevation()).Filter(rim, Pose::Identity()).obstacles_sensor, rim);
}

struct Box {
  Eigen::Vector2d center;
  Eigen::Vector2d half;
  double height;
};

struct Shot {
  Points points_world;
  std::vector<bool> is_ground;
  std::vector<double> clearance;  ///< true height over the ground
};

// A spinning LiDAR 1.73 m over the terrain at the origin; gravity along z. Rays are marched.
Shot Shoot(const std::function<double(double, double)>& terrain, const std::vector<Box>& boxes, std::mt19937& random) {
  std::normal_distribution<double> noise(0.0, 0.02);
  const Eigen::Vector3d sensor(0, 0, terrain(0, 0) + 1.73);
  Shot shot;
  for (int ring = 0; ring < 48; ++ring) {
    const double elevation = (-24.0 + 30.0 * ring / 48.0) * M_PI / 180.0;
    for (int step = 0; step < 360; ++step) {
      const double azimuth = step * M_PI / 180.0;
      const Eigen::Vector3d direction(std::cos(elevation) * std::cos(azimuth), std::cos(elevation) * std::sin(azimuth),
                                      std::sin(elevation));
      for (double range = 2.0; range < 45.0; range += 0.02) {
        const Eigen::Vector3d p = sensor + range * direction;
        const double height = p.z() - terrain(p.x(), p.y());
        bool in_box = false;
        for (const Box& box : boxes) {
          in_box = in_box || (((p.head<2>() - box.center).cwiseAbs() - box.half).maxCoeff() < 0 && height < box.height);
        }
        if (height > 0 && !in_box) continue;
        shot.points_world.push_back((p - sensor + noise(random) * direction).cast<float>());
        shot.is_ground.push_back(!in_box);
        shot.clearance.push_back(height);
        break;
      }
    }
  }
  return shot;
}

struct Rates {
  double ground_removed;
  double obstacles_kept;  ///< of those that are well above the clearance
};

Rates Measure(const Shot& shot, const Pose& T_gravity_sensor) {
  Points points_sensor;
  const Eigen::Matrix3f R = T_gravity_sensor.linear().transpose().cast<float>();
  for (const Eigen::Vector3f& p : shot.points_world) points_sensor.push_back(R * p);
  GroundFilter filter(Elevation());
  const Points kept = filter.Filter(points_sensor, T_gravity_sensor).obstacles_sensor;
  std::size_t at = 0, ground = 0, ground_removed = 0, high = 0, high_kept = 0;
  for (std::size_t i = 0; i < points_sensor.size(); ++i) {
    const bool is_kept = at < kept.size() && kept[at] == points_sensor[i];
    at += is_kept;
    if (shot.is_ground[i]) {
      ++ground;
      ground_removed += !is_kept;
    } else if (shot.clearance[i] > 0.75) {
      ++high;
      high_kept += is_kept;
    }
  }
  EXPECT_GT(ground, 1000u);
  EXPECT_GT(high, 300u);
  return {static_cast<double>(ground_removed) / ground, static_cast<double>(high_kept) / high};
}

const std::vector<Box>& Boxes() {
  static const std::vector<Box> boxes{{{8, 3}, {2.2, 0.9}, 1.5},  {{-10, -6}, {2.2, 0.9}, 1.5}, {{15, -12}, {4, 4}, 6},
                                      {{-5, 14}, {10, 0.3}, 2.5}, {{5, -6}, {0.15, 0.15}, 5},   {{-20, 3}, {2, 3}, 8}};
  return boxes;
}

TEST(GroundFilter, ElevationRemovesFlatGroundAndKeepsObstacles) {
  std::mt19937 random(1);
  const Rates rates = Measure(Shoot([](double, double) { return 0.0; }, Boxes(), random), Pose::Identity());
  EXPECT_GT(rates.ground_removed, 0.999);
  EXPECT_GT(rates.obstacles_kept, 0.999);
}

TEST(GroundFilter, ElevationFollowsSlopesWhereAHeightCutFails) {
  std::mt19937 random(2);
  for (const double slope : {-0.1, 0.1}) {
    const Shot shot = Shoot([&](double x, double y) { return slope * x + 0.4 * std::sin(0.15 * y); }, Boxes(), random);
    const Rates rates = Measure(shot, Pose::Identity());
    EXPECT_GT(rates.ground_removed, 0.99) << slope;
    EXPECT_GT(rates.obstacles_kept, 0.99) << slope;
    const Points cut = GroundFilter({}).Filter(shot.points_world, Pose::Identity()).obstacles_sensor;
    std::size_t obstacles = 0;
    for (std::size_t i = 0; i < shot.is_ground.size(); ++i) obstacles += !shot.is_ground[i];
    EXPECT_GT(cut.size(), obstacles) << "the height cut should have let ground pass";
  }
}

TEST(GroundFilter, ElevationMeasuresAlongGravityWhateverTheSensorsTilt) {
  std::mt19937 random(3);
  const Shot shot = Shoot([](double, double) { return 0.0; }, Boxes(), random);
  for (const double tilt : {-0.2, 0.2}) {
    Pose T_gravity_sensor = Pose::Identity();
    T_gravity_sensor.linear() =
        (Eigen::AngleAxisd(1.0, Eigen::Vector3d::UnitZ()) * Eigen::AngleAxisd(tilt, Eigen::Vector3d::UnitY()))
            .toRotationMatrix();
    T_gravity_sensor.translation() << 100, 200, 300;  // has no effect
    const Rates rates = Measure(shot, T_gravity_sensor);
    EXPECT_GT(rates.ground_removed, 0.999);
    EXPECT_GT(rates.obstacles_kept, 0.999);
  }
}

TEST(GroundFilter, ElevationSurvivesEchoesFromBelowTheGround) {
  std::mt19937 random(4);
  Shot shot = Shoot([](double, double) { return 0.0; }, Boxes(), random);
  std::uniform_real_distribution<float> uniform(-30.f, 30.f);
  for (int i = 0; i < 100; ++i) {
    shot.points_world.emplace_back(uniform(random), uniform(random), -6.f);
    shot.is_ground.push_back(true);
    shot.clearance.push_back(-4.0);
  }
  const Rates rates = Measure(shot, Pose::Identity());
  EXPECT_GT(rates.ground_removed, 0.995);
  EXPECT_GT(rates.obstacles_kept, 0.99);
}

TEST(GroundFilter, WorkSpaceDoesNotLeakFromScanToScan) {
  std::mt19937 random(5);
  const Points a = RandomPoints(random, 3000), b = RandomPoints(random, 2000);
  GroundFilter filter(Elevation());
  const Points first = filter.Filter(a, Pose::Identity()).obstacles_sensor;
  filter.Filter(b, Pose::Identity());
  EXPECT_EQ(filter.Filter(a, Pose::Identity()).obstacles_sensor, first);
}

TEST(GroundFilter, NamesTheParameterThatIsOutOfRange) {
  const auto expect_refused = [](const std::string& name, const std::function<void(GroundFilterParameters*)>& spoil) {
    GroundFilterParameters parameters = Elevation();
    spoil(&parameters);
    try {
      GroundFilter filter(parameters);
      ADD_FAILURE() << name << " was accepted";
    } catch (const std::invalid_argument& error) {
      EXPECT_NE(std::string(error.what()).find("ground." + name), std::string::npos) << error.what();
    }
  };
  expect_refused("min_height_m", [](auto* p) { p->min_height_m = kNan; });
  expect_refused("min_range_m", [](auto* p) { p->min_range_m = -1; });
  expect_refused("max_range_m", [](auto* p) { p->max_range_m = 1; });
  expect_refused("max_height_m", [](auto* p) { p->max_height_m = kNan; });
  expect_refused("sensor_height_m", [](auto* p) { p->sensor_height_m = 0; });
  expect_refused("clearance_m", [](auto* p) { p->clearance_m = -0.1; });
  expect_refused("clearance_m", [](auto* p) { p->clearance_m = 0.1; });  // below the rise over a cell
  expect_refused("cell_size_m", [](auto* p) { p->cell_size_m = 0; });
  expect_refused("cell_size_m", [](auto* p) { p->cell_size_m = 1e-3; });
  expect_refused("max_slope", [](auto* p) { p->max_slope = kInfinity; });
}

TEST(GroundFilter, RefusesARotationThatIsNotFinite) {
  Pose broken = Pose::Identity();
  broken.linear()(0, 0) = kNan;
  EXPECT_THROW(GroundFilter(Elevation()).Filter({}, broken), std::invalid_argument);
}

}  // namespace
}  // namespace incremental_segmatch
