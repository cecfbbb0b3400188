// Trails of moving objects don't become segments of the map; what stands there and is hidden later does.
#include "incremental_segmatch/trail_finder.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <set>
#include <stdexcept>
#include <string>
#include <vector>

#include "incremental_segmatch/back_end.hpp"
#include "incremental_segmatch/front_end.hpp"

namespace incremental_segmatch {
namespace {

constexpr double kPeriod_s = 0.2;
constexpr double kSensorHeight_m = 1.7;
constexpr double kLane_m = 3.5;  // the oncoming traffic's y

struct Box {
  Eigen::Vector3d low;
  Eigen::Vector3d high;
};

Box BoxAt(double x, double y, double length, double width, double height) {
  return {{x - 0.5 * length, y - 0.5 * width, 0.0}, {x + 0.5 * length, y + 0.5 * width, height}};
}

/// Where a ray enters a box; infinity if it does not.
double EnterBox(const Eigen::Vector3d& from, const Eigen::Vector3d& direction, const Box& box) {
  double enter = 0.0, leave = std::numeric_limits<double>::infinity();
  for (int axis = 0; axis < 3; ++axis) {
    const double a = (box.low[axis] - from[axis]) / direction[axis], b = (box.high[axis] - from[axis]) / direction[axis];
    enter = std::max(enter, std::min(a, b));
    leave = std::min(leave, std::max(a, b));
  }
  return enter <= leave && enter > 0.0 ? enter : std::numeric_limits<double>::infinity();
}

/// What a level sensor sees of boxes on a plane with a wall along either side.
Points Cast(const Eigen::Vector3d& sensor, std::vector<Box> boxes) {
  boxes.push_back(BoxAt(0.0, 15.0, 400.0, 1.0, 8.0));
  boxes.push_back(BoxAt(0.0, -15.0, 400.0, 1.0, 8.0));
  Points points;
  for (double azimuth = 0.05; azimuth < 360.0; azimuth += 0.4) {
    for (double elevation = -24.05; elevation < 6.0; elevation += 0.6) {
      const double a = azimuth * M_PI / 180.0, e = elevation * M_PI / 180.0;
      const Eigen::Vector3d direction(std::cos(e) * std::cos(a), std::cos(e) * std::sin(a), std::sin(e));
      double range = direction.z() < 0.0 ? -sensor.z() / direction.z() : std::numeric_limits<double>::infinity();
      for (const Box& box : boxes) range = std::min(range, EnterBox(sensor, direction, box));
      if (range < 60.0) points.push_back((range * direction).cast<float>());
    }
  }
  return points;
}

class Trails : public testing::TestWithParam<double> {
 protected:
  struct Outcome {
    std::set<SegmentId> trails;                // IDs that were retired as such
    std::vector<Eigen::Vector3d> target;       // centroids in the map's frame, of segments in the map at the end
    std::vector<Eigen::Vector3d> local;        // of those that are tracked
    std::size_t dismissed_clusters = 0;        // at the end
  };

  /// A car comes from ahead and passes; a pillar and a parked car stand by the road, and after 2 s a lorry stops in front
  /// of the pillar. The robot drives at a speed.
  static Outcome Drive(double speed_mps, const TrailParameters& trails) {
    FrontEndParameters parameters;
    parameters.trails = trails;
    FrontEnd front_end(parameters, "robot");
    BackEnd back_end(BackEndParameters{});
    Outcome outcome;
    for (int step = 0; step < 45; ++step) {
      const double t = kPeriod_s * step;
      std::vector<Box> boxes{BoxAt(38.0 - 9.0 * t, kLane_m, 4.2, 1.8, 1.5), BoxAt(14.0, -7.0, 0.6, 0.6, 4.0),
                             BoxAt(9.0, 7.0, 4.2, 1.8, 1.5)};
      if (t > 2.0) boxes.push_back(BoxAt(13.5, -5.0, 8.0, 2.0, 6.0));
      Scan scan;
      scan.stamp_ns = static_cast<StampNs>(1e9 * (100.0 + t));
      scan.T_odom_sensor.translation() << speed_mps * t, 0.0, kSensorHeight_m;
      scan.points_sensor = Cast(scan.T_odom_sensor.translation(), boxes);
      const FrontEndStep now = front_end.Process(scan);
      for (const RetiredSegment& retired : now.delta.retired)
        if (retired.cause == RetirementCause::kTrail) outcome.trails.insert(retired.id);
      outcome.dismissed_clusters = now.counts.clusters.trails;
      back_end.Process(now.delta);
    }
    for (const auto& [key, segment] : back_end.map().segments())
      outcome.target.push_back(back_end.map().CentroidMap(segment.views.back()));
    for (const SegmentState& state : front_end.FullState().changed) outcome.local.push_back(state.centroid_odom);
    return outcome;
  }

  static std::size_t InLane(const std::vector<Eigen::Vector3d>& centroids) {
    return std::count_if(centroids.begin(), centroids.end(),
                         [](const Eigen::Vector3d& c) { return std::abs(c.y() - kLane_m) < 1.2; });
  }
  static bool IsAt(const std::vector<Eigen::Vector3d>& centroids, double x, double y) {
    return std::any_of(centroids.begin(), centroids.end(), [&](const Eigen::Vector3d& c) {
      return std::hypot(c.x() - x, c.y() - y) < 2.5;
    });
  }
};

TEST_P(Trails, OfACarThatPassesLeaveTheMapAndWhatIsHiddenLaterStays) {
  const Outcome found = Drive(GetParam(), TrailParameters{});
  EXPECT_FALSE(found.trails.empty());
  EXPECT_EQ(InLane(found.target), 0u);
  EXPECT_EQ(InLane(found.local), 0u);
  EXPECT_TRUE(IsAt(found.target, 14.0, -7.0)) << "the pillar that was hidden";
  EXPECT_TRUE(IsAt(found.target, 9.0, 7.0)) << "the parked car";

  TrailParameters blind;
  blind.enabled = false;
  const Outcome unfound = Drive(GetParam(), blind);
  EXPECT_TRUE(unfound.trails.empty());
  EXPECT_GT(InLane(unfound.target), 0u) << "the car leaves no trail that could be found";
}

INSTANTIATE_TEST_SUITE_P(Speeds, Trails, testing::Values(0.0, 4.0, 8.0));

TEST(TrailFinder, RefusesParametersOutOfRange) {
  const auto refused = [](auto change) {
    TrailParameters parameters;
    change(&parameters);
    EXPECT_THROW(TrailFinder{parameters}, std::invalid_argument);
  };
  refused([](TrailParameters* p) { p->interval_s = 0.0; });
  refused([](TrailParameters* p) { p->min_range_m = -1.0; });
  refused([](TrailParameters* p) { p->tolerance_m = 0.0; });
  refused([](TrailParameters* p) { p->min_voxels = 0; });
  refused([](TrailParameters* p) { p->min_share = 1.5; });
}

}  // namespace
}  // namespace incremental_segmatch
