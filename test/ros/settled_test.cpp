// What a later recognition settles is published with it: as the back end says, in its order, with the stamps of then.
#include <gtest/gtest.h>
#include <incremental_segmatch/LoopClosure.h>
#include <incremental_segmatch/StepReport.h>
#include <nodelet/loader.h>
#include <ros/ros.h>

#include <string>
#include <utility>
#include <vector>

#include "conversions.hpp"
#include "incremental_segmatch/back_end.hpp"
#include "support/twin_street.hpp"
#include "waiting.hpp"

namespace incremental_segmatch {
namespace {

using test::kBlock_m;
using test::Street;
using test::StreetRobot;
using test::WaitFor;

using Stamps = std::pair<StampNs, StampNs>;  // of query and target

/// Deltas of two passes along a street that is copies in all but for the block in the middle, as messages.
std::vector<SegmentArray> TwoPasses() {
  const Street street(5, false, 1, 2);
  StreetRobot robot(street);
  std::vector<SegmentArray> messages;
  for (const auto& [from_m, to_m] : {std::pair{0.0, 5.0}, std::pair{1.0, 4.5}})
    for (const StreetRobot::Sight& sight : robot.Pass(from_m * kBlock_m, to_m * kBlock_m))
      messages.push_back(ToSegmentArray(sight.delta, {"odom", "", "lidar", Pose::Identity()}, 1, 0.01, true));
  return messages;
}

/// Closures that are due at a distance of so much path, settled ones first, and how many of them were settled.
std::pair<std::vector<Stamps>, int> Expected(const std::vector<SegmentArray>& messages, double min_distance_m) {
  BackEndParameters parameters;
  parameters.free_space.max_range_m = 1e-6;
  BackEnd back_end(parameters);
  std::vector<Stamps> due;
  int settled = 0;
  double last_m = -1e9;
  for (const SegmentArray& message : messages) {
    const BackEndStep step = back_end.Process(ToSegmentDelta(message, "robot"));
    std::vector<Closure> closures = step.settled;
    if (step.closure) closures.push_back(*step.closure);
    for (const Closure& closure : closures) {
      double path_m = 0.0;
      for (const TrajectoryPose& pose : back_end.map().Trajectory(0))
        if (pose.stamp_ns == closure.stamp_query_ns) path_m = pose.path_m;
      if (path_m - last_m < min_distance_m) continue;
      last_m = path_m;
      due.emplace_back(closure.stamp_query_ns, closure.stamp_target_ns);
      settled += closure.stamp_query_ns < ToStampNs(message.header.stamp);
    }
  }
  return {due, settled};
}

TEST(Settled, ClosuresArePublishedWithTheOneThatSettlesThem) {
  const std::vector<SegmentArray> messages = TwoPasses();
  for (const double min_distance_m : {0.0, 5.0}) {
    const std::string name = min_distance_m > 0.0 ? "thinned" : "all";
    SCOPED_TRACE(name);
    ros::param::set("/" + name + "/back_end/free_space/max_range_m", 1e-6);
    ros::param::set("/" + name + "/closure_min_distance_m", min_distance_m);
    ros::param::set("/" + name + "/closure_kind", "sensor");
    nodelet::Loader loader(true);
    nodelet::M_string remappings;
    for (const std::string topic : {"segments", "trajectory", "corrected_odometry", "loop_closures", "back_end_steps"})
      remappings["/" + topic] = "/" + name + "/" + topic;
    ASSERT_TRUE(loader.load("/" + name, "incremental_segmatch/BackEndNodelet", remappings, nodelet::V_string()));

    ros::NodeHandle nh;
    std::vector<Stamps> published;
    std::size_t answered = 0;
    const ros::Publisher segments = nh.advertise<SegmentArray>("/" + name + "/segments", 10);
    const ros::Subscriber closures = nh.subscribe<LoopClosure>(
        "/" + name + "/loop_closures", 1000, boost::function<void(const LoopClosureConstPtr&)>([&](const LoopClosureConstPtr& m) {
          published.emplace_back(ToStampNs(m->stamp_query), ToStampNs(m->stamp_target));
        }));
    const ros::Subscriber steps = nh.subscribe<StepReport>(
        "/" + name + "/back_end_steps", 10,
        boost::function<void(const StepReportConstPtr&)>([&](const StepReportConstPtr&) { ++answered; }));
    ASSERT_TRUE(WaitFor([&] {
      return segments.getNumSubscribers() > 0 && closures.getNumPublishers() > 0 && steps.getNumPublishers() > 0;
    }));
    for (std::size_t i = 0; i < messages.size(); ++i) {
      segments.publish(messages[i]);
      ASSERT_TRUE(WaitFor([&] { return answered == i + 1; }, 5.0)) << "delta " << i;
    }
    const auto [expected, settled] = Expected(messages, min_distance_m);
    EXPECT_GE(settled, 1) << "nothing was settled later";
    EXPECT_TRUE(WaitFor([&, &expected = expected] { return published.size() >= expected.size(); }, 5.0));
    EXPECT_EQ(published, expected);
  }
}

}  // namespace
}  // namespace incremental_segmatch
