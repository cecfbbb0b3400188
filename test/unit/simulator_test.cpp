// The simulated drive against slow or independent statements of the same thing.
#include <gtest/gtest.h>
#include <unistd.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <limits>
#include <map>
#include <set>
#include <sstream>
#include <utility>

#include "simulator/caster.hpp"
#include "simulator/kitti_writer.hpp"
#include "simulator/random.hpp"
#include "simulator/simulation.hpp"

namespace incremental_segmatch::simulator {
namespace {

namespace fs = std::filesystem;

SimulationOptions Options(const std::string& route, const std::string& sensor = "VLP-16") {
  SimulationOptions options;
  options.route = route;
  options.sensor = sensor;
  options.stride = 2;
  return options;
}

bool SameBytes(const Points& a, const Points& b) {
  return a.size() == b.size() && std::memcmp(a.data(), b.data(), a.size() * sizeof(a[0])) == 0;
}

// A folder that is gone after the test.
class TemporaryFolder {
 public:
  TemporaryFolder() : path_(fs::temp_directory_path() / ("simulator_test_" + std::to_string(::getpid()))) {
    fs::create_directories(path_);
  }
  ~TemporaryFolder() { fs::remove_all(path_); }
  const fs::path& path() const { return path_; }

 private:
  fs::path path_;
};

std::string Contents(const fs::path& path) {
  std::ifstream stream(path, std::ios::binary);
  std::ostringstream text;
  text << stream.rdbuf();
  return text.str();
}

std::vector<Pose> ReadRows(const fs::path& path) {
  std::ifstream stream(path);
  std::vector<Pose> poses;
  double value[12];
  while (stream >> value[0]) {
    for (int i = 1; i < 12; ++i) stream >> value[i];
    Pose pose = Pose::Identity();
    for (int i = 0; i < 12; ++i) pose.matrix()(i / 4, i % 4) = value[i];
    poses.push_back(pose);
  }
  return poses;
}

TEST(SimulationTest, IsDeterministicForASeedAndIndependentOfTheOrderOfScans) {
  Simulation first(Options("loops")), second(Options("loops"));
  const Points late = second.Scan(200);
  second.Scan(3);
  EXPECT_TRUE(SameBytes(first.Scan(0), second.Scan(0)));
  EXPECT_TRUE(SameBytes(first.Scan(200), late));
  EXPECT_TRUE(first.T_odom_sensor(200).matrix() == second.T_odom_sensor(200).matrix());

  SimulationOptions other = Options("loops");
  other.seed = 2;
  EXPECT_FALSE(SameBytes(first.Scan(0), Simulation(other).Scan(0)));
}

TEST(SimulationTest, AnotherDayKeepsTheTownAndChangesTheCars) {
  SimulationOptions options = Options("loops");
  Simulation today(options);
  options.day = 1;
  Simulation tomorrow(options);
  const auto& plan = today.town().plan();
  ASSERT_EQ(plan.size(), tomorrow.town().plan().size());
  std::size_t spots = 0, changed = 0;
  for (std::size_t i = 0; i < plan.size(); ++i) {
    ASSERT_EQ(plan[i].seed, tomorrow.town().plan()[i].seed);
    if (plan[i].kind != ItemKind::kParkingSpot) continue;
    const auto a = today.town().StandsOn(i, 0.0), b = tomorrow.town().StandsOn(i, 0.0);
    ++spots;
    changed += a.has_value() != b.has_value() || (a && a->seed != b->seed);
  }
  ASSERT_GT(spots, 50u);
  EXPECT_GT(changed, spots / 5);
  EXPECT_LT(changed, spots * 4 / 5);
}

TEST(SimulationTest, AllDaysAndPartsOfARouteShareAFrame) {
  SimulationOptions options = Options("loops");
  const Simulation today(options);
  options.day = 1;
  options.first_frame = 300;
  const Simulation tomorrow(options);
  EXPECT_TRUE(today.T_world_start().matrix() == tomorrow.T_world_start().matrix());
  // The sensor stands at the beginning of the route but for the sway of its suspension.
  const Pose sway = today.T_world_start().inverse() * today.T_world_sensor(0);
  EXPECT_LT(sway.translation().norm(), 0.02);
  EXPECT_LT(Eigen::AngleAxisd(sway.linear()).angle(), 0.01);
}

TEST(SimulationTest, SensorsWithANarrowViewSeeNothingBeside) {
  SimulationOptions options = Options("loops", "Livox-Avia");
  Simulation simulation(options);
  const Points first = simulation.Scan(0), second = simulation.Scan(1);
  EXPECT_GT(first.size(), 10000u);
  EXPECT_LT(first.size(), 25000u);
  for (const Eigen::Vector3f& p : first) EXPECT_LT(std::abs(std::atan2(p.y(), p.x())), 0.62f);
  // The pattern does not repeat: most directions of one scan are none of the next.
  std::set<std::pair<int, int>> directions;
  const auto direction = [](const Eigen::Vector3f& p) {
    const double per_step = 180.0 / 3.14159265358979323846 / 0.4;
    return std::make_pair(static_cast<int>(std::lround(per_step * std::atan2(p.y(), p.x()))),
                          static_cast<int>(std::lround(per_step * std::atan2(p.z(), p.head<2>().norm()))));
  };
  for (const Eigen::Vector3f& p : first) directions.insert(direction(p));
  std::size_t again = 0;
  for (const Eigen::Vector3f& p : second) again += directions.count(direction(p));
  EXPECT_GT(again, second.size() / 2);
  EXPECT_LT(again, second.size() * 9 / 10) << "seven tenths of the beams fire, other ones every time";
}

TEST(SimulationTest, TheDeceptiveStreetIsOfEqualThingsAtEqualDistances) {
  const Simulation simulation(Options("deceptive"));
  const Town& town = simulation.town();
  // What stands at the street, by kind: everything but the cars has one and the same make.
  std::map<ItemKind, std::set<std::uint64_t>> makes;
  std::map<ItemKind, std::vector<Eigen::Vector2d>> places;
  for (std::size_t i = 0; i < town.plan().size(); ++i) {
    const Item& item = town.plan()[i];
    if (town.trajectory().Distance(item.footprint, 12.0) >= 12.0) continue;
    makes[item.kind].insert(item.seed);
    places[item.kind].push_back(item.footprint.centre_m);
    for (double time_s = 0.0; item.kind == ItemKind::kParkingSpot && time_s < 400.0; time_s += 20.0) {
      if (const std::optional<Item> parked = town.StandsOn(i, time_s)) makes[ItemKind::kVehicle].insert(parked->seed);
    }
  }
  for (const ItemKind kind : {ItemKind::kHouse, ItemKind::kHedge, ItemKind::kTree, ItemKind::kLamp})
    EXPECT_EQ(makes[kind].size(), 1u) << static_cast<int>(kind);
  EXPECT_EQ(makes[ItemKind::kParkingSpot].size(), places[ItemKind::kParkingSpot].size());
  EXPECT_GT(makes[ItemKind::kVehicle].size(), 50u) << "who parks where is chance";
  ASSERT_GT(places[ItemKind::kHouse].size(), 60u);
  // Houses repeat every sixteen metres.
  std::size_t in_step = 0;
  for (const Eigen::Vector2d& house : places[ItemKind::kHouse]) {
    in_step += std::any_of(places[ItemKind::kHouse].begin(), places[ItemKind::kHouse].end(),
                           [&](const auto& other) { return std::abs((other - house).norm() - 16.0) < 0.05; });
  }
  EXPECT_GT(in_step, places[ItemKind::kHouse].size() * 3 / 4);
}

TEST(SimulationTest, TheOfficeHasFurnitureAndItsChairsAreMoved) {
  const Simulation simulation(Options("office"));
  const Town& town = simulation.town();
  std::map<ItemKind, std::size_t> counts;
  std::size_t seen_again = 0, moved = 0;
  for (std::size_t i = 0; i < town.plan().size(); ++i) {
    const Item& item = town.plan()[i];
    ++counts[item.kind];
    if (item.kind != ItemKind::kChairSpot) continue;
    const std::vector<Visit> visits = town.trajectory().Visits(item.footprint.centre_m, 15.0, 20.0);
    for (std::size_t k = 1; k < visits.size(); ++k) {
      if (visits[k].begin_s - visits[k - 1].end_s < 60.0) continue;
      ++seen_again;
      const Footprint before = town.StandsOn(i, visits[k - 1].end_s)->footprint,
                      after = town.StandsOn(i, visits[k].begin_s)->footprint;
      moved += before.centre_m != after.centre_m;
    }
  }
  for (const ItemKind kind : {ItemKind::kDesk, ItemKind::kCabinet, ItemKind::kPottedPlant, ItemKind::kPillar})
    EXPECT_GE(counts[kind], 10u) << static_cast<int>(kind);
  EXPECT_EQ(counts[ItemKind::kCeiling], 1u);
  ASSERT_GT(seen_again, 20u);
  EXPECT_GT(moved, seen_again / 5);
  EXPECT_LT(moved, seen_again * 3 / 5);
}

TEST(SimulationTest, ParkedCarsChangeOnlyBetweenVisitsAMinuteApart) {
  Simulation simulation(Options("loops"));
  const Town& town = simulation.town();
  const auto state = [&](std::size_t spot, double time_s) {
    const auto parked = town.StandsOn(spot, time_s);
    return parked ? parked->seed : std::uint64_t{0};
  };
  std::size_t returns = 0, changed = 0;
  for (std::size_t spot = 0; spot < town.plan().size(); ++spot) {
    if (town.plan()[spot].kind != ItemKind::kParkingSpot) continue;
    const auto visits = town.trajectory().Visits(town.plan()[spot].footprint.centre_m, 80.0, 20.0);
    for (std::size_t k = 0; k < visits.size(); ++k) {
      EXPECT_EQ(state(spot, visits[k].begin_s), state(spot, visits[k].end_s));
      if (k == 0 || visits[k].begin_s - visits[k - 1].end_s < 60.0) continue;
      ++returns;
      changed += state(spot, visits[k].begin_s) != state(spot, visits[k - 1].end_s);
    }
  }
  ASSERT_GT(returns, 30u);
  EXPECT_GT(static_cast<double>(changed) / static_cast<double>(returns), 0.15);
  EXPECT_LT(static_cast<double>(changed) / static_cast<double>(returns), 0.5);
}

TEST(SimulationTest, SensorIsUprightAtItsHeightOverTheGround) {
  for (const std::string& route : PresetRouteNames()) {
    SCOPED_TRACE(route);
    Simulation simulation(Options(route));
    const Terrain& terrain = simulation.town().terrain();
    double low = 1e9, high = -1e9;
    for (std::size_t i = 0; i < simulation.size(); ++i) {
      const Eigen::Vector3d p = simulation.T_world_sensor(i).translation();
      const double ground = terrain.Height(p.x(), p.y());
      EXPECT_NEAR(p.z() - ground, 1.73, 0.03);
      EXPECT_GT(simulation.T_world_sensor(i).linear()(2, 2), std::cos(0.1));
      low = std::min(low, ground);
      high = std::max(high, ground);
    }
    if (route == "office") {
      EXPECT_EQ(high, low) << "floors are flat";
    } else {
      EXPECT_GT(high - low, 0.3) << "the town has no slopes";
    }
  }
}

TEST(SimulationTest, NothingStandsWhereTheVehiclePasses) {
  // The vehicle's body against the planned footprints, and the sensor's surroundings against all geometry.
  for (const std::string& route : PresetRouteNames()) {
    SCOPED_TRACE(route);
    const bool indoors = route == "office";
    const Eigen::Vector2d body = indoors ? Eigen::Vector2d(0.4, 0.35) : Eigen::Vector2d(1.0, 0.9);
    Simulation simulation(Options(route));
    for (std::size_t i = 0; i < simulation.size(); i += 3) {
      const Eigen::Vector2d p = simulation.T_world_sensor(i).translation().head<2>();
      const double yaw =
          std::atan2(simulation.T_world_sensor(i).linear()(1, 0), simulation.T_world_sensor(i).linear()(0, 0));
      const Footprint vehicle{p, yaw, body};
      for (const Item& item : simulation.town().plan()) {
        if (item.kind == ItemKind::kCeiling || (item.footprint.centre_m - p).norm() > 25.0) continue;
        ASSERT_FALSE(Overlap(vehicle, item.footprint, 0.0)) << "scan " << i << ", kind " << static_cast<int>(item.kind);
      }
      if (i % 15 != 0) continue;
      float nearest = 100.f;
      for (const Eigen::Vector3f& point : simulation.Scan(i)) nearest = std::min(nearest, point.head<2>().norm());
      EXPECT_GT(nearest, indoors ? 0.6f : 1.4f) << "scan " << i;
    }
  }
}

TEST(ItemTest, GeometryBelowHeadHeightStaysInsideTheFootprint) {
  // What PlanTown keeps apart are footprints: bodies must not leave them where vehicles drive. Crowns and lamps may.
  Simulation simulation(Options("loops"));
  for (const Item& item : simulation.town().plan()) {
    if (item.kind == ItemKind::kTree || item.kind == ItemKind::kLamp || item.kind == ItemKind::kSign) continue;
    for (const Primitive& primitive : BuildItem(item)) {
      Eigen::Vector3f reach = primitive.R_item_prim.cwiseAbs() * primitive.half_m;
      if (primitive.centre_m.z() - reach.z() > 2.2f) continue;
      EXPECT_LT(std::abs(primitive.centre_m.x()) + reach.x(), item.footprint.half_m.x() + 0.5)
          << static_cast<int>(item.kind);
      EXPECT_LT(std::abs(primitive.centre_m.y()) + reach.y(), item.footprint.half_m.y() + 0.5)
          << static_cast<int>(item.kind);
    }
  }
}

TEST(CasterTest, EqualsTestingEveryPrimitive) {
  Simulation simulation(Options("loops"));
  const SensorModel sensor = SensorByName("HDL-64E");
  Town town(MakePresetRoute("loops", {10.0, 7.0, 2}), TownParameters{});
  Caster caster(sensor);
  constexpr double kTwoPi = 6.283185307179586;
  std::size_t tested = 0, hits = 0, different = 0;
  for (const std::uint64_t seed : {11u, 12u, 13u}) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    Random random(seed);
    const std::size_t frame = static_cast<std::size_t>(random.Uniform(0, static_cast<double>(simulation.size())));
    Pose pose = simulation.T_world_sensor(frame);
    pose.linear() =
        pose.linear() * Eigen::AngleAxisd(random.Uniform(-0.2, 0.2), Eigen::Vector3d::UnitX()).toRotationMatrix();
    const auto items = town.ItemsNear(pose.translation().head<2>(), sensor.max_range_m, 40.0);
    const Sweep sweep = caster.Cast(pose, items, town.terrain());
    for (int k = 0; k < 400; ++k) {
      const int ring = random.Index(64), column = random.Index(sensor.columns);
      const auto single = [](double v) { return static_cast<float>(v); };
      const float cos_elevation = single(std::cos(sensor.elevations_rad[static_cast<std::size_t>(ring)]));
      const float sin_elevation = single(std::sin(sensor.elevations_rad[static_cast<std::size_t>(ring)]));
      const float cos_azimuth = single(std::cos(kTwoPi * column / sensor.columns));
      const float sin_azimuth = single(std::sin(kTwoPi * column / sensor.columns));
      const Eigen::Vector3f in_sensor(cos_elevation * cos_azimuth, cos_elevation * sin_azimuth, sin_elevation);
      float nearest = GroundRange(town.terrain(), pose.translation(), pose.linear() * in_sensor.cast<double>(), 120.f);
      for (const PlacedItem& item : items) {
        const Pose T_sensor_item = pose.inverse() * item.T_world_item;
        for (const Primitive& primitive : *item.primitives) {
          const Eigen::Vector3f centre =
              T_sensor_item.linear().cast<float>() * primitive.centre_m + T_sensor_item.translation().cast<float>();
          const Eigen::Matrix3f R = (T_sensor_item.linear().cast<float>() * primitive.R_item_prim).transpose();
          nearest = std::min(nearest, Intersect(primitive, -(R * centre), R * in_sensor, 120.f).range_m);
        }
      }
      const float fast = sweep.range_m[static_cast<std::size_t>(ring * sensor.columns + column)];
      ++tested;
      hits += std::isfinite(nearest);
      different +=
          std::isfinite(nearest) != std::isfinite(fast) || (std::isfinite(fast) && std::abs(fast - nearest) > 1e-2f);
    }
  }
  EXPECT_GT(hits, tested / 2);
  // Rays are rounded differently here, and a ray through an edge or a leaf's rim may pass on either side.
  EXPECT_LE(different, tested / 200);
}

TEST(PrimitiveTest, KnownHits) {
  const float far = 100.f;
  const auto box = Primitive::Box({0, 0, 0}, {1, 2, 3}, Material::kMetal);
  EXPECT_FLOAT_EQ(Intersect(box, {-5, 0, 0}, {1, 0, 0}, far).range_m, 4.f);
  EXPECT_FALSE(std::isfinite(Intersect(box, {-5, 2.5, 0}, {1, 0, 0}, far).range_m));
  EXPECT_FALSE(std::isfinite(Intersect(box, {-5, 0, 0}, {1, 0, 0}, 3.9f).range_m));
  const auto cylinder = Primitive::Cylinder({0, 0, 0}, {0, 0, 2}, 0.5f, Material::kBark);
  EXPECT_NEAR(Intersect(cylinder, {-5, 0, 0}, {1, 0, 0}, far).range_m, 4.5f, 1e-5f);
  const auto roof = Primitive::Frustum({0, 0, 0}, 1.f, {2, 2}, {0.f, 2.f}, 0.f, Material::kBrick);
  EXPECT_NEAR(Intersect(roof, {-5, 0, 0}, {1, 0, 0}, far).range_m, 4.f, 1e-5f);
  EXPECT_NEAR(Intersect(roof, {0.5, 0, 5}, {0, 0, -1}, far).range_m, 4.5f, 1e-5f);
  // Through a wall with windows, some beams land behind its plane but never deeper than the recess.
  const auto wall =
      Primitive::Facade({0, 0, 0}, 0.f, 5.f, 3.f, {2.f, 1.f, 1.f, 1.3f, 0.2f, 2.9f}, Material::kPlaster, 5);
  int recessed = 0;
  for (int i = 0; i < 100; ++i) {
    const float range = Intersect(wall, {10, -4.5f + 0.09f * static_cast<float>(i), -0.5f}, {-1, 0, 0}, far).range_m;
    EXPECT_GE(range, 9.999f);
    EXPECT_LE(range, 10.201f);
    recessed += range > 10.1f;
  }
  EXPECT_GT(recessed, 10);
  EXPECT_LT(recessed, 90);
}

TEST(SensorTest, HdlScanLooksLikeAnHdlScan) {
  Simulation simulation(Options("loops", "HDL-64E"));
  const SimulatedScan scan = simulation.ScanWithIntensities(50);
  ASSERT_EQ(scan.points_sensor.size(), scan.intensities.size());
  EXPECT_GT(scan.points_sensor.size(), 100000u);
  EXPECT_LT(scan.points_sensor.size(), 133312u);
  std::size_t obstacles = 0;
  float previous_elevation = 1.f;
  for (const Eigen::Vector3f& p : scan.points_sensor) {
    EXPECT_LT(p.norm(), 121.f);
    obstacles += p.norm() < 50.f && p.z() > -1.f;
    const float elevation = std::atan2(p.z(), p.head<2>().norm());
    EXPECT_LT(elevation, previous_elevation + 1e-3f) << "rings are ordered from the top";
    previous_elevation = elevation;
  }
  EXPECT_GT(obstacles, 12000u);
  EXPECT_LT(obstacles, 70000u);
  for (const float intensity : scan.intensities) {
    EXPECT_GE(intensity, 0.f);
    EXPECT_LE(intensity, 1.f);
  }
}

TEST(DriftTest, IsWhatWasAskedFor) {
  for (const std::uint64_t seed : {1u, 2u, 3u}) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    SimulationOptions options = Options("loops");
    options.seed = seed;
    Simulation simulation(options);
    std::vector<Pose> truth, odometry;
    for (std::size_t i = 0; i < simulation.size(); ++i) {
      truth.push_back(simulation.T_world_sensor(i));
      odometry.push_back(simulation.T_odom_sensor(i));
    }
    const DriftMeasure drift = MeasureDrift(truth, odometry, 100.0);
    EXPECT_GT(drift.translation_percent, 0.5);
    EXPECT_LT(drift.translation_percent, 1.0);
    EXPECT_GT(drift.rotation_deg_per_100m, 0.4);
    EXPECT_LT(drift.rotation_deg_per_100m, 1.2);
    // The odometry's frame is gravity-aligned as the world is.
    EXPECT_NEAR(odometry[0].linear()(2, 2), truth[0].linear()(2, 2), 1e-9);
  }
  SimulationOptions options = Options("loops");
  options.drift = {0.0, 0.0};
  Simulation exact(options);
  const std::size_t last = exact.size() - 1;
  const Pose relative = exact.T_world_sensor(0).inverse() * exact.T_world_sensor(last);
  EXPECT_TRUE(
      (exact.T_odom_sensor(0).inverse() * exact.T_odom_sensor(last)).matrix().isApprox(relative.matrix(), 1e-6));
}

struct Revisits {
  std::size_t same = 0, opposite = 0, same_places = 0;
};

// The checker's definition: within 5 m of a scan that is older by more than 60 s and 50 m of driving.
Revisits CountRevisits(const Simulation& simulation) {
  std::vector<double> path(simulation.size(), 0.0);
  for (std::size_t i = 1; i < path.size(); ++i) {
    path[i] = path[i - 1] +
              (simulation.T_world_sensor(i).translation() - simulation.T_world_sensor(i - 1).translation()).norm();
  }
  Revisits revisits;
  bool was_same = false;
  for (std::size_t i = 0; i < simulation.size(); ++i) {
    double nearest = 5.0;
    bool found = false, opposite = false;
    for (std::size_t j = 0; j < i; ++j) {
      if (1e-9 * static_cast<double>(simulation.stamp_ns(i) - simulation.stamp_ns(j)) <= 60.0 ||
          path[i] - path[j] <= 50.0)
        break;
      const Pose& a = simulation.T_world_sensor(i);
      const Pose& b = simulation.T_world_sensor(j);
      const double distance = (a.translation() - b.translation()).norm();
      if (distance > nearest) continue;
      nearest = distance;
      found = true;
      opposite = a.linear().col(0).dot(b.linear().col(0)) < 0;
    }
    const bool same = found && !opposite;
    revisits.same_places += same && !was_same;
    was_same = same;
    revisits.same += same;
    revisits.opposite += found && opposite;
  }
  return revisits;
}

TEST(RouteTest, PresetsRevisitPlacesAsTheyPromise) {
  const Revisits loops = CountRevisits(Simulation(Options("loops")));
  EXPECT_GE(loops.same_places, 3u);
  EXPECT_GE(loops.same, 150u);
  EXPECT_GE(loops.opposite, 20u);
  EXPECT_GE(CountRevisits(Simulation(Options("opposite"))).opposite, 300u);
  EXPECT_GE(CountRevisits(Simulation(Options("deceptive"))).same, 100u);
  EXPECT_GE(CountRevisits(Simulation(Options("lap"))).same, 100u);
}

TEST(RouteTest, RefusesNonsense) {
  SimulationOptions options;
  options.route = "nowhere";
  EXPECT_THROW(Simulation{options}, std::invalid_argument);
  options = {};
  options.sensor = "sonar";
  EXPECT_THROW(Simulation{options}, std::invalid_argument);
  options = {};
  options.stride = 0;
  EXPECT_THROW(Simulation{options}, std::invalid_argument);
  options = {};
  options.first_frame = 1000000;
  EXPECT_THROW(Simulation{options}, std::invalid_argument);
  options = {};
  options.poses_file = "no/such/file.txt";
  EXPECT_THROW(Simulation{options}, std::runtime_error);
}

TEST(KittiWriterTest, RoundTrip) {
  TemporaryFolder folder;
  SimulationOptions options = Options("loops");
  options.first_frame = 100;
  options.max_scans = 6;
  Simulation simulation(options);
  std::size_t reported = 0;
  WriteKitti(simulation, folder.path(), "07", [&](std::size_t done) { reported = done; });
  EXPECT_EQ(reported, 6u);

  const fs::path sequence = folder.path() / "sequences" / "07";
  std::string calibration = Contents(sequence / "calib.txt");
  calibration = calibration.substr(calibration.find("Tr: ") + 4);
  std::istringstream numbers(calibration);
  Pose Tr = Pose::Identity();
  for (int i = 0; i < 12; ++i) numbers >> Tr.matrix()(i / 4, i % 4);
  const std::vector<Pose> camera = ReadRows(folder.path() / "poses" / "07.txt");
  const std::vector<Pose> odometry = ReadRows(sequence / "odometry.txt");
  ASSERT_EQ(camera.size(), 6u);
  ASSERT_EQ(odometry.size(), 6u);
  for (std::size_t i = 0; i < 6; ++i) {
    const Pose expected = simulation.T_world_start().inverse() * simulation.T_world_sensor(i);
    EXPECT_TRUE((Tr.inverse() * camera[i] * Tr).matrix().isApprox(expected.matrix(), 1e-9));
    EXPECT_TRUE(odometry[i].matrix().isApprox(simulation.T_odom_sensor(i).matrix(), 1e-9));
  }
  // Camera axes: forward is z, right is x.
  EXPECT_GT(camera[5].translation().z(), 1.0);
  std::istringstream times(Contents(sequence / "times.txt"));
  for (std::size_t i = 0; i < 6; ++i) {
    double time = -1.0;
    times >> time;
    EXPECT_NEAR(time, 1e-9 * static_cast<double>(simulation.stamp_ns(i)), 1e-9);
  }
  const SimulatedScan scan = simulation.ScanWithIntensities(2);
  const std::string bytes = Contents(sequence / "velodyne" / "000002.bin");
  ASSERT_EQ(bytes.size(), 16 * scan.points_sensor.size());
  float point[4];
  std::memcpy(point, bytes.data() + 16 * 77, 16);
  EXPECT_EQ(point[0], scan.points_sensor[77].x());
  EXPECT_EQ(point[2], scan.points_sensor[77].z());
  EXPECT_EQ(point[3], scan.intensities[77]);

  // A route along the written poses is the same drive in the plane.
  const Route route = RouteFromKittiPoses(folder.path() / "poses" / "07.txt", 5.0);
  ASSERT_EQ(route.size(), 6u);
  const Pose last = simulation.T_world_sensor(0).inverse() * simulation.T_world_sensor(5);
  EXPECT_NEAR((route[5].position_m - route[0].position_m).norm(), last.translation().head<2>().norm(), 0.05);

  // A shorter drive written over it leaves no scans behind.
  options.max_scans = 4;
  Simulation shorter(options);
  WriteKitti(shorter, folder.path(), "07");
  EXPECT_TRUE(fs::exists(sequence / "velodyne" / "000003.bin"));
  EXPECT_FALSE(fs::exists(sequence / "velodyne" / "000004.bin"));
  EXPECT_FALSE(fs::exists(sequence / "velodyne" / "000005.bin"));
}

TEST(KittiWriterTest, NamesTheFileThatItCannotRead) {
  TemporaryFolder folder;
  const fs::path file = folder.path() / "damaged.txt";
  std::ofstream(file) << "1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0\n";
  try {
    RouteFromKittiPoses(file, 10.0);
    FAIL() << "accepted a damaged pose file";
  } catch (const std::runtime_error& error) {
    EXPECT_NE(std::string(error.what()).find("damaged.txt"), std::string::npos);
  }
}

}  // namespace
}  // namespace incremental_segmatch::simulator
