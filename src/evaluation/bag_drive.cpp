#include <geometry_msgs/PoseStamped.h>
#include <nav_msgs/Odometry.h>
#include <rosbag/bag.h>
#include <rosbag/view.h>
#include <sensor_msgs/PointCloud2.h>
#include <std_msgs/Time.h>
#include <tf2/buffer_core.h>
#include <tf2/exceptions.h>
#include <tf2_msgs/TFMessage.h>

#include <algorithm>
#include <filesystem>
#include <map>
#include <stdexcept>

#include "evaluation/bag.hpp"
#include "evaluation/bag_common.hpp"

namespace incremental_segmatch {
namespace {

const ros::Duration kWholeBag(1e9);  // tf's memory: longer than any recording

// Poses of a body over time, from messages of one topic; interpolates between them.
class PoseTopic {
 public:
  void Add(const std_msgs::Header& header, const std::string& body, const geometry_msgs::Pose& pose) {
    body_ = body;
    geometry_msgs::TransformStamped transform = ToMessage(FromMessage(pose), header.stamp, "origin", "body");
    buffer_.setTransform(transform, "bag");
    empty_ = false;
  }
  bool empty() const { return empty_; }
  const std::string& body() const { return body_; }  // its frame; empty: the sensor itself
  Pose At(const ros::Time& stamp) const {
    return FromMessage(buffer_.lookupTransform("origin", "body", stamp).transform);
  }

 private:
  tf2::BufferCore buffer_{kWholeBag};
  std::string body_;
  bool empty_ = true;
};

// Names in tf 1's manner carry a slash at their front, which tf2 refuses.
std::string WithoutSlash(const std::string& frame) {
  return !frame.empty() && frame[0] == '/' ? frame.substr(1) : frame;
}

std::string Join(const std::vector<std::string>& words) {
  std::string text;
  for (const std::string& word : words) text += (text.empty() ? "" : ", ") + word;
  return text.empty() ? "none" : text;
}

class BagDrive : public DriveSource {
 public:
  explicit BagDrive(const BagDriveOptions& options) : options_(options) {
    Open();
    const std::string cloud_topic = ChooseCloudTopic();
    ReadTf();
    ReadEpoch();
    if (!options_.odometry_topic.empty()) ReadPoses(options_.odometry_topic, odometry_, true);
    ReadPoses(options_.ground_truth_topic, truth_, false);
    IndexScans(cloud_topic);
  }

  std::string name() const override { return options_.path; }
  std::size_t size() const override { return scans_.size(); }
  StampNs stamp_ns(std::size_t i) const override { return scans_.at(i).stamp_ns; }
  Pose T_odom_sensor(std::size_t i) const override { return scans_.at(i).T_odom_sensor; }
  std::optional<Pose> T_world_sensor(std::size_t i) const override { return scans_.at(i).T_world_sensor; }
  std::vector<std::string> notes() const override { return notes_; }

  Points ReadPoints(std::size_t i) override {
    const auto cloud = scans_.at(i).message.instantiate<sensor_msgs::PointCloud2>();
    try {
      return PointsFromMessage(*cloud);
    } catch (const std::runtime_error& error) {
      Fail("scan " + std::to_string(i) + ": " + error.what());
    }
  }

 private:
  struct ScanEntry {
    StampNs stamp_ns;
    Pose T_odom_sensor;
    std::optional<Pose> T_world_sensor;
    rosbag::MessageInstance message;
  };

  [[noreturn]] void Fail(const std::string& what) const {
    throw std::runtime_error("bag " + options_.path + ": " + what);
  }

  void Open() {
    if (!std::filesystem::exists(options_.path)) Fail("there is no such file");
    try {
      bag_.open(options_.path, rosbag::bagmode::Read);
    } catch (const rosbag::BagException& error) {
      Fail(std::string(error.what()) + " (a recording that was cut off may be mended by `rosbag reindex`)");
    }
  }

  std::vector<std::string> TopicsOfType(const std::string& type) {
    std::vector<std::string> topics;
    rosbag::View view(bag_);
    for (const rosbag::ConnectionInfo* connection : view.getConnections()) {
      if (!type.empty() && connection->datatype != type) continue;
      if (std::find(topics.begin(), topics.end(), connection->topic) == topics.end())
        topics.push_back(connection->topic);
    }
    std::sort(topics.begin(), topics.end());
    return topics;
  }

  bool HasTopic(const std::string& topic) {
    const std::vector<std::string> topics = TopicsOfType("");
    return std::find(topics.begin(), topics.end(), topic) != topics.end();
  }

  std::string ChooseCloudTopic() {
    const std::vector<std::string> topics = TopicsOfType("sensor_msgs/PointCloud2");
    if (!options_.cloud_topic.empty()) {
      if (std::find(topics.begin(), topics.end(), options_.cloud_topic) != topics.end()) return options_.cloud_topic;
      Fail("no sensor_msgs/PointCloud2 on " + options_.cloud_topic + "; such topics here: " + Join(topics));
    }
    if (topics.size() == 1) return topics.front();
    if (topics.empty()) Fail("no topic of type sensor_msgs/PointCloud2; topics here: " + Join(TopicsOfType("")));
    Fail("several topics of type sensor_msgs/PointCloud2, choose one with --topic: " + Join(topics));
  }

  void ReadTf() {
    for (const std::string topic : {"/tf", "/tf_static"}) {
      rosbag::View view(bag_, rosbag::TopicQuery(topic));
      for (const rosbag::MessageInstance& message : view) {
        const auto tf = message.instantiate<tf2_msgs::TFMessage>();
        if (!tf) continue;
        for (geometry_msgs::TransformStamped transform : tf->transforms) {
          transform.header.frame_id = WithoutSlash(transform.header.frame_id);
          transform.child_frame_id = WithoutSlash(transform.child_frame_id);
          tf_.setTransform(transform, "bag", topic == "/tf_static");
        }
      }
    }
  }

  void ReadEpoch() {
    rosbag::View view(bag_, rosbag::TopicQuery(std::string(kEpochTopic)));
    for (const rosbag::MessageInstance& message : view) {
      if (const auto epoch = message.instantiate<std_msgs::Time>()) epoch_ns_ = ToStampNs(epoch->data);
    }
  }

  void ReadPoses(const std::string& topic, PoseTopic& poses, bool required) {
    rosbag::View view(bag_, rosbag::TopicQuery(topic));
    for (const rosbag::MessageInstance& message : view) {
      if (const auto odometry = message.instantiate<nav_msgs::Odometry>()) {
        if (odometry->child_frame_id.empty()) {
          Fail("messages on " + topic + " have no child_frame_id, so it is not known whose pose they are");
        }
        poses.Add(odometry->header, WithoutSlash(odometry->child_frame_id), odometry->pose.pose);
      } else if (const auto pose = message.instantiate<geometry_msgs::PoseStamped>()) {
        poses.Add(pose->header, "", pose->pose);
      } else {
        Fail(topic + " is " + message.getDataType() + ", expected nav_msgs/Odometry or geometry_msgs/PoseStamped");
      }
    }
    if (required && poses.empty()) {
      Fail("nothing on " + topic + "; nav_msgs/Odometry here: " + Join(TopicsOfType("nav_msgs/Odometry")));
    }
  }

  std::string OdometryFrame() {
    if (!options_.odometry_frame.empty()) return WithoutSlash(options_.odometry_frame);
    for (const std::string& frame : TfFrames()) {
      if (frame == "odom") return frame;
    }
    return "world";
  }

  std::vector<std::string> TfFrames() const {
    std::vector<std::string> frames;
    tf_._getFrameStrings(frames);
    std::sort(frames.begin(), frames.end());
    return frames;
  }

  // Pose of the sensor from that of the body which the topic tells of.
  Pose SensorPose(const PoseTopic& poses, const std::string& sensor_frame, const ros::Time& stamp) const {
    const Pose T_origin_body = poses.At(stamp);
    if (poses.body().empty() || poses.body() == sensor_frame) return T_origin_body;
    return T_origin_body * FromMessage(tf_.lookupTransform(poses.body(), sensor_frame, stamp).transform);
  }

  void IndexScans(const std::string& topic) {
    const std::string odometry_frame = OdometryFrame();
    std::size_t without_pose = 0, without_truth = 0, not_later = 0;
    std::string reason;
    StampNs last_ns = 0;
    rosbag::View view(bag_, rosbag::TopicQuery(topic));
    for (const rosbag::MessageInstance& message : view) {
      const auto cloud = message.instantiate<sensor_msgs::PointCloud2>();
      const ros::Time stamp = cloud->header.stamp;
      const std::string sensor_frame = WithoutSlash(cloud->header.frame_id);
      if (ToStampNs(stamp) <= last_ns) {
        ++not_later;
        continue;
      }
      ScanEntry scan{ToStampNs(stamp) - epoch_ns_, Pose::Identity(), std::nullopt, message};
      try {
        scan.T_odom_sensor = odometry_.empty()
                                 ? FromMessage(tf_.lookupTransform(odometry_frame, sensor_frame, stamp).transform)
                                 : SensorPose(odometry_, sensor_frame, stamp);
      } catch (const tf2::TransformException& error) {
        ++without_pose;
        reason = error.what();
        continue;
      }
      if (!truth_.empty()) {
        try {
          scan.T_world_sensor = SensorPose(truth_, sensor_frame, stamp);
        } catch (const tf2::TransformException&) {
          ++without_truth;
        }
      }
      last_ns = ToStampNs(stamp);
      scans_.push_back(scan);
    }
    if (scans_.empty()) {
      Fail("no scan on " + topic + " has a pose: " + (reason.empty() ? "there are no scans" : reason) +
           "; frames in tf: " + Join(TfFrames()) +
           "; choose with --odometry-frame, or take a topic with --odometry-topic");
    }
    notes_.push_back("scans: " + topic +
                     "; odometry: " + (odometry_.empty() ? "tf from " + odometry_frame : options_.odometry_topic));
    const auto note = [this](std::size_t count, const std::string& what) {
      if (count > 0) notes_.push_back(std::to_string(count) + " scans " + what);
    };
    note(without_pose, "left out, for want of a pose: " + reason);
    note(not_later, "left out, their stamps do not increase");
    note(without_truth, "have no ground truth, so nothing is scored");
    if (truth_.empty()) notes_.push_back("no ground truth on " + options_.ground_truth_topic + ": nothing is scored");
  }

  BagDriveOptions options_;
  rosbag::Bag bag_;
  tf2::BufferCore tf_{kWholeBag};
  PoseTopic odometry_;
  PoseTopic truth_;
  StampNs epoch_ns_ = 0;
  std::vector<ScanEntry> scans_;
  std::vector<std::string> notes_;
};

}  // namespace

std::unique_ptr<DriveSource> OpenBag(const BagDriveOptions& options) {
  return std::make_unique<BagDrive>(options);
}

}  // namespace incremental_segmatch
