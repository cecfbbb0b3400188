// Nodelets in the process of the test: messages are passed as pointers, and what comes too fast is dropped, not queued.
#include <diagnostic_msgs/DiagnosticArray.h>
#include <gtest/gtest.h>
#include <nodelet/loader.h>
#include <ros/ros.h>
#include <sensor_msgs/PointCloud2.h>
#include <tf2_ros/transform_broadcaster.h>

#include <algorithm>
#include <boost/make_shared.hpp>
#include <cmath>
#include <functional>
#include <map>
#include <string>
#include <vector>

#include "conversions.hpp"
#include "synthetic_drive.hpp"
#include "waiting.hpp"

namespace incremental_segmatch {
namespace {

using test::SyntheticDrive;
using test::WaitFor;

/// A front end under `/name`, in a loader of its own, as a nodelet manager has one.
class IntraProcess : public testing::Test {
 protected:
  void Load(const std::string& name) {
    ros::param::set("/" + name + "/base_frame", std::string());
    nodelet::M_string remappings;
    for (const std::string topic : {"points", "segments", "local_cloud", "front_end_steps"})
      remappings["/" + topic] = "/" + name + "/" + topic;
    ASSERT_TRUE(loader_.load("/" + name, "incremental_segmatch/FrontEndNodelet", remappings, nodelet::V_string()));
    clouds_ = nh_.advertise<sensor_msgs::PointCloud2>("/" + name + "/points", 1000);
    ASSERT_TRUE(WaitFor([this] { return clouds_.getNumSubscribers() > 0; }));
  }

  void PublishTf(int scan, StampNs stamp_ns) {
    tf_.sendTransform(ToTransform(drive_.T_odom_sensor(scan), "odom", "lidar", ToTime(stamp_ns)));
  }

  SyntheticDrive drive_;
  ros::NodeHandle nh_;
  ros::Publisher clouds_;
  tf2_ros::TransformBroadcaster tf_;
  nodelet::Loader loader_{true};
};

TEST_F(IntraProcess, CloudsAndSegmentsArePassedAsPointers) {
  Load("pointers");
  std::vector<SegmentArrayConstPtr> first, second;
  const auto keep_in = [](std::vector<SegmentArrayConstPtr>* list) {
    return boost::function<void(const SegmentArrayConstPtr&)>(
        [list](const SegmentArrayConstPtr& m) { list->push_back(m); });
  };
  ros::NodeHandle other;
  ros::Subscriber one = nh_.subscribe<SegmentArray>("/pointers/segments", 10, keep_in(&first));
  ros::Subscriber two = other.subscribe<SegmentArray>("/pointers/segments", 10, keep_in(&second));
  ASSERT_TRUE(WaitFor([&] { return one.getNumPublishers() > 0 && two.getNumPublishers() > 0; }));

  // The front end waits for the pose of the very cloud that was published: it holds the pointer itself.
  const auto cloud = boost::make_shared<const sensor_msgs::PointCloud2>(drive_.Cloud(0, "lidar"));
  const sensor_msgs::PointCloud2 before = *cloud;
  clouds_.publish(cloud);
  ASSERT_TRUE(WaitFor([&] { return cloud.use_count() > 1; }, 5.0)) << "the cloud was copied on its way";
  PublishTf(0, drive_.stamp_ns(0));
  ASSERT_TRUE(WaitFor([&] { return first.size() == 1 && second.size() == 1; }, 5.0));
  EXPECT_EQ(first[0].get(), second[0].get()) << "the segments were copied on their way";
  ASSERT_TRUE(WaitFor([&] { return cloud.use_count() == 1; }, 5.0)) << "the cloud is held for longer than needed";
  EXPECT_TRUE(cloud->data == before.data && cloud->header.stamp == before.header.stamp) << "the cloud was changed";

  // What was published stays as it was while the front end goes on.
  const SegmentArray published = *first[0];
  for (int scan = 1; scan < 5; ++scan) {
    PublishTf(scan, drive_.stamp_ns(scan));
    clouds_.publish(boost::make_shared<const sensor_msgs::PointCloud2>(drive_.Cloud(scan, "lidar")));
    ASSERT_TRUE(WaitFor([&] { return first.size() == static_cast<std::size_t>(scan + 1); }, 5.0));
  }
  ASSERT_EQ(first[0]->changed.size(), published.changed.size());
  for (std::size_t i = 0; i < published.changed.size(); ++i) {
    EXPECT_EQ(first[0]->changed[i].id, published.changed[i].id);
    EXPECT_EQ(first[0]->changed[i].points, published.changed[i].points);
  }
}

TEST_F(IntraProcess, UnderOverloadTheNewestIsKept) {
  // Clouds that take some milliseconds each, published without a pause.
  constexpr int kClouds = 300;
  constexpr int kQueue = 2;
  ros::param::set("/overload/queue_size", kQueue);
  Load("overload");
  std::vector<StampNs> done;
  ros::Subscriber steps =
      nh_.subscribe<StepReport>("/overload/front_end_steps", 1000,
                                boost::function<void(const StepReportConstPtr&)>([&](const StepReportConstPtr& m) {
                                  done.push_back(ToStampNs(m->header.stamp));
                                }));
  std::map<std::string, std::string> diagnosed;
  ros::Subscriber diagnostics = nh_.subscribe<diagnostic_msgs::DiagnosticArray>(
      "/diagnostics", 100,
      boost::function<void(const diagnostic_msgs::DiagnosticArrayConstPtr&)>(
          [&](const diagnostic_msgs::DiagnosticArrayConstPtr& m) {
            for (const auto& status : m->status)
              if (status.name == "overload: front end")
                for (const auto& value : status.values) diagnosed[value.key] = value.value;
          }));
  ASSERT_TRUE(WaitFor([&] { return steps.getNumPublishers() > 0 && diagnostics.getNumPublishers() > 0; }));

  sensor_msgs::PointCloud2 cloud = drive_.Cloud(0, "lidar");
  const auto stamp_ns = [this](int i) { return drive_.stamp_ns(0) + i * 10000000LL; };
  // Poses first, so that nothing waits for them.
  for (int i = 0; i < kClouds; ++i) PublishTf(0, stamp_ns(i));
  ros::WallDuration(0.2).sleep();
  for (int i = 0; i < kClouds; ++i) {
    cloud.header.stamp = ToTime(stamp_ns(i));
    const auto message = boost::make_shared<const sensor_msgs::PointCloud2>(cloud);
    clouds_.publish(message);
  }
  const StampNs last_ns = stamp_ns(kClouds - 1);
  ASSERT_TRUE(WaitFor([&] { return !done.empty() && done.back() == last_ns; }, 20.0))
      << "the newest cloud was not processed";

  // Every cloud is either processed or counted as dropped.
  ASSERT_LT(done.size(), static_cast<std::size_t>(kClouds)) << "this machine is too fast for the test: nothing was dropped";
  EXPECT_GT(done.size(), 1u);
  const auto number = [&](const char* key) { return diagnosed.count(key) ? std::stoul(diagnosed[key]) : 0ul; };
  EXPECT_TRUE(WaitFor(
      [&] {
        return number("scans received") == kClouds && number("scans waiting") == 0 && number("scans processed") == done.size() &&
               done.size() + number("scans dropped by the full queue") == kClouds;
      },
      5.0))
      << number("scans received") << " received, " << done.size() << " processed, "
      << number("scans dropped by the full queue") << " dropped";

  // None waits behind a newer one.
  EXPECT_EQ(std::adjacent_find(done.begin(), done.end(), std::greater_equal<>()), done.end());
}

}  // namespace
}  // namespace incremental_segmatch
