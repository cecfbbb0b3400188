// What nodelets are made of: the worker, the buffer of poses, the names of sessions.
#include <gtest/gtest.h>

#include <atomic>
#include <future>
#include <random>
#include <stdexcept>
#include <vector>

#include "pose_buffer.hpp"
#include "robot_sessions.hpp"
#include "throttle.hpp"
#include "worker.hpp"

namespace incremental_segmatch {
namespace {

void Ignore(const std::string& /*what*/) {}

TEST(Worker, FullQueueDropsTheOldestDataOnly) {
  std::vector<int> ran;
  std::promise<void> gate;
  std::shared_future<void> open = gate.get_future().share();
  Worker worker(2, Ignore);
  std::promise<void> started;
  worker.PostAlways([&] {
    started.set_value();
    open.wait();
  });
  started.get_future().wait();
  worker.Post([&] { ran.push_back(1); });
  worker.PostAlways([&] { ran.push_back(100); });
  worker.Post([&] { ran.push_back(2); });
  worker.Post([&] { ran.push_back(3); });
  worker.Post([&] { ran.push_back(4); });
  EXPECT_EQ(worker.queued(), 2u);
  EXPECT_EQ(worker.dropped(), 2u);
  gate.set_value();
  worker.Run([] { return 0; });
  EXPECT_EQ(ran, (std::vector<int>{100, 3, 4}));
  EXPECT_EQ(worker.queued(), 0u);
}

TEST(Worker, GoesOnAfterAnException) {
  std::promise<std::string> said;
  Worker worker(3, [&said](const std::string& what) { said.set_value(what); });
  worker.Post([] { throw std::runtime_error("broken"); });
  EXPECT_EQ(said.get_future().get(), "broken");
  EXPECT_EQ(worker.Run([] { return 5; }), 5);
  EXPECT_THROW(worker.Run([]() -> int { throw std::invalid_argument("no"); }), std::invalid_argument);
}

TEST(Worker, StopsWhileAJobWaits) {
  std::atomic<bool> gave_up{false};
  {
    Worker worker(3, Ignore);
    std::promise<void> started;
    worker.Post([&] {
      started.set_value();
      while (!worker.stopping()) worker.SleepFor(60.0);
      gave_up = true;
    });
    worker.Post([] { FAIL() << "a waiting job ran after the end"; });
    started.get_future().wait();
  }
  EXPECT_TRUE(gave_up);
}

TEST(Worker, RefusesAnEmptyQueue) {
  EXPECT_THROW(Worker(0, Ignore), std::invalid_argument);
}

StampedPose PoseAt(StampNs stamp_ns, double x, double yaw) {
  Pose T = Pose::Identity();
  T.linear() = Eigen::AngleAxisd(yaw, Eigen::Vector3d::UnitZ()).toRotationMatrix();
  T.translation().x() = x;
  return {stamp_ns, T};
}

constexpr StampNs kSecond = 1000000000;

TEST(PoseBuffer, InterpolatesAndNeverGuesses) {
  PoseBuffer buffer(10.0, 0.5);
  EXPECT_FALSE(buffer.At(0));
  EXPECT_NE(buffer.WhyNot("odometry", 0).find("no odometry"), std::string::npos);
  buffer.Add(PoseAt(100 * kSecond, 1.0, 0.0));
  buffer.Add(PoseAt(100 * kSecond + kSecond / 4, 2.0, 0.4));
  buffer.Add(PoseAt(102 * kSecond, 9.0, 0.4));
  const auto middle = buffer.At(100 * kSecond + kSecond / 8);
  ASSERT_TRUE(middle);
  EXPECT_NEAR(middle->translation().x(), 1.5, 1e-12);
  EXPECT_NEAR(Eigen::AngleAxisd(middle->linear()).angle(), 0.2, 1e-12);
  EXPECT_TRUE(buffer.At(100 * kSecond));
  EXPECT_TRUE(buffer.At(102 * kSecond));
  EXPECT_FALSE(buffer.At(101 * kSecond));
  EXPECT_NE(buffer.WhyNot("odometry", 101 * kSecond).find("gap"), std::string::npos);
  EXPECT_FALSE(buffer.At(99 * kSecond));
  EXPECT_NE(buffer.WhyNot("odometry", 99 * kSecond).find("begins"), std::string::npos);
  EXPECT_FALSE(buffer.At(103 * kSecond));
  EXPECT_NE(buffer.WhyNot("odometry", 103 * kSecond).find("ends"), std::string::npos);
}

TEST(PoseBuffer, StartsAnewWhenTimeJumpsBackAndForgetsTheOld) {
  PoseBuffer buffer(10.0, 0.5);
  buffer.Add(PoseAt(100 * kSecond, 1.0, 0.0));
  buffer.Add(PoseAt(111 * kSecond, 1.0, 0.0));
  EXPECT_FALSE(buffer.At(100 * kSecond));
  buffer.Add(PoseAt(5 * kSecond, 1.0, 0.0));
  EXPECT_TRUE(buffer.At(5 * kSecond));
  EXPECT_FALSE(buffer.At(111 * kSecond));
  buffer.Clear();
  EXPECT_FALSE(buffer.At(5 * kSecond));
}

TEST(RobotSessions, NamesEverySessionOnce) {
  using Change = RobotSessions::Change;
  RobotSessions sessions;
  EXPECT_EQ(sessions.Find("alice", 7, 10).change, Change::kNewRobot);
  EXPECT_EQ(sessions.Find("bob", 7, 11).name, "bob");
  EXPECT_EQ(sessions.Find("alice", 7, 20).change, Change::kNone);
  const auto restarted = sessions.Find("alice", 8, 30);
  EXPECT_EQ(restarted.change, Change::kRestarted);
  EXPECT_EQ(restarted.name, "alice#2");
  EXPECT_EQ(sessions.Find("alice", 8, 40).name, "alice#2");
  EXPECT_EQ(sessions.Find("bob", 7, 41).change, Change::kNone);
  EXPECT_EQ(sessions.Find("alice", 9, 5).change, Change::kRewound);
  sessions.Clear();
  EXPECT_EQ(sessions.Find("alice", 9, 5).name, "alice");

  // A session that was ended does not come back as another robot.
  sessions.EndAll();
  EXPECT_EQ(sessions.Find("alice", 9, 6).change, Change::kEnded);
  EXPECT_EQ(sessions.Find("alice", 10, 7).change, Change::kNewRobot);
  EXPECT_EQ(sessions.Find("alice", 10, 8).name, "alice");
  EXPECT_EQ(sessions.Find("alice", 9, 8).change, Change::kEnded);
}

TEST(Throttle, LetsOneOfAKindThrough) {
  Throttle throttle;
  EXPECT_TRUE(throttle.IsDue("a", 60.0));
  EXPECT_FALSE(throttle.IsDue("a", 60.0));
  EXPECT_TRUE(throttle.IsDue("b", 60.0));
  EXPECT_TRUE(throttle.IsDue("a", 0.0));
}

}  // namespace
}  // namespace incremental_segmatch
