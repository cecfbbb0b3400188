#include "node_parameters.hpp"

#include <cmath>
#include <cstdio>
#include <filesystem>
#include <set>
#include <stdexcept>
#include <type_traits>

namespace incremental_segmatch {
namespace {

using XmlRpc::XmlRpcValue;

std::string QuoteYaml(const std::string& text) {
  std::string quoted = "'";
  for (const char c : text) quoted += c == '\'' ? std::string("''") : std::string(1, c);
  return quoted + "'";
}

std::string DoubleToYaml(double value) {
  if (std::isnan(value)) return ".nan";
  if (std::isinf(value)) return value > 0 ? ".inf" : "-.inf";
  char text[40];
  std::snprintf(text, sizeof text, "%.17g", value);
  return text;
}

void Require(bool condition, const std::string& full_name, const std::string& what) {
  if (!condition) throw std::invalid_argument("parameter " + full_name + ": " + what);
}

/// Hands out the values of one subtree and remembers which were asked for.
class SubtreeReader {
 public:
  SubtreeReader(XmlRpcValue tree, std::string path) : tree_(std::move(tree)), path_(std::move(path)) {
    if (tree_.getType() != XmlRpcValue::TypeStruct)
      throw std::invalid_argument("parameter " + path_ + ": expected names with values below it");
  }

  /// Overwrites the default in `value` if the parameter is set.
  template <class T>
  void Read(const std::string& name, T& value) {
    if (XmlRpcValue* found = Take(name)) value = Convert<T>(*found, name);
  }

  /// A parameter with few values, by their names.
  template <class Enum>
  void Read(const std::string& name, Enum& value, const std::vector<std::pair<std::string, Enum>>& choices) {
    std::string word;
    Read(name, word);
    if (word.empty()) return;
    std::string known;
    for (const auto& [choice, meaning] : choices) {
      if (choice == word) {
        value = meaning;
        return;
      }
      known += (known.empty() ? "" : ", ") + choice;
    }
    throw std::invalid_argument("parameter " + Full(name) + ": " + word + " is none of: " + known);
  }

  /// A path, empty for none.
  void ReadPath(const std::string& name, std::string& path) {
    Read(name, path);
    try {
      if (!path.empty()) RequireWholePath(path);
    } catch (const std::invalid_argument& error) {
      Require(false, name, error.what());
    }
  }

  /// The subtree's value, null if it is not set.
  XmlRpcValue* Take(const std::string& name) {
    known_.insert(name);
    return tree_.hasMember(name) ? &tree_[name] : nullptr;
  }

  /// Throws if anything was not asked for.
  void RefuseOthers() {
    std::string unknown;
    for (auto& [name, value] : tree_)
      if (known_.count(name) == 0) unknown += (unknown.empty() ? "" : ", ") + Full(name);
    if (unknown.empty()) return;
    std::string list;
    for (const std::string& name : known_) list += (list.empty() ? "" : ", ") + name;
    throw std::invalid_argument("unknown parameter " + unknown + "; those of " + path_ + " are: " + list);
  }

  const std::string& path() const { return path_; }
  std::string Full(const std::string& name) const { return path_ + "/" + name; }

  void Require(bool condition, const std::string& name, const std::string& what) const {
    incremental_segmatch::Require(condition, Full(name), what);
  }

 private:
  template <class T>
  T Convert(XmlRpcValue& value, const std::string& name) const {
    const auto type = value.getType();
    if constexpr (std::is_same_v<T, bool>) {
      Require(type == XmlRpcValue::TypeBoolean, name, "expected true or false");
      return static_cast<bool>(value);
    } else if constexpr (std::is_same_v<T, int>) {
      Require(type == XmlRpcValue::TypeInt, name, "expected an integer");
      return static_cast<int>(value);
    } else if constexpr (std::is_same_v<T, double>) {
      if (type == XmlRpcValue::TypeInt) return static_cast<int>(value);
      Require(type == XmlRpcValue::TypeDouble, name, "expected a number");
      const double number = static_cast<double>(value);
      Require(std::isfinite(number), name, "must be finite");
      return number;
    } else if constexpr (std::is_same_v<T, std::string>) {
      Require(type == XmlRpcValue::TypeString, name, "expected text");
      return static_cast<std::string>(value);
    } else {
      static_assert(std::is_same_v<T, std::vector<std::string>>, "no other type is read");
      Require(type == XmlRpcValue::TypeArray, name, "expected a list of names");
      std::vector<std::string> list;
      for (int i = 0; i < value.size(); ++i) list.push_back(Convert<std::string>(value[i], name));
      return list;
    }
  }

  XmlRpcValue tree_;
  std::string path_;
  std::set<std::string> known_;
};

SubtreeReader ReadTree(const ros::NodeHandle& private_nh) {
  XmlRpcValue tree;
  if (!private_nh.getParam(private_nh.getNamespace(), tree)) {
    tree = XmlRpcValue();
    tree.begin();  // makes it an empty struct
  }
  SubtreeReader reader(tree, private_nh.getNamespace());
  reader.Take("diagnostic_period");  // read by diagnostic_updater
  reader.Take("tuning");             // left by dynamic_reconfigure, for people to see
  return reader;
}

/// The core's parameters from `config_file`, or from the given subtree. A file may hold both sides' parameters.
Parameters ReadCore(SubtreeReader& reader, const std::string& subtree_name) {
  std::string config_file;
  reader.ReadPath("config_file", config_file);
  const XmlRpcValue* subtree = reader.Take(subtree_name);
  if (!config_file.empty() && subtree != nullptr)
    throw std::invalid_argument("parameters " + reader.Full("config_file") + " and " + reader.Full(subtree_name) +
                                " are both set: give the one or the other");
  if (!config_file.empty()) return LoadParameters(config_file);
  if (subtree == nullptr) return ParseParameters("{}", reader.Full(subtree_name));
  return ParseParameters("{" + subtree_name + ": " + ToYamlText(*subtree) + "}", reader.path());
}

const std::vector<std::pair<std::string, FrameKind>> kFrameKinds{{"base", FrameKind::kBase},
                                                                 {"sensor", FrameKind::kSensor}};

void ReadPoseGraph(XmlRpcValue* tree, const std::string& path, PoseGraphParameters& parameters) {
  if (tree == nullptr) return;
  SubtreeReader reader(*tree, path);
  reader.Read("odometry_sigma_m", parameters.odometry_sigma_m);
  reader.Read("odometry_sigma_rad", parameters.odometry_sigma_rad);
  reader.Read("min_odometry_distance_m", parameters.min_odometry_distance_m);
  reader.Read("min_closure_sigma_m", parameters.min_closure_sigma_m);
  reader.Read("min_closure_sigma_rad", parameters.min_closure_sigma_rad);
  reader.Read("robust_width", parameters.robust_width);
  reader.Read("max_iterations", parameters.max_iterations);
  reader.RefuseOthers();
}

}  // namespace

NodeletParameters<FrontEndNodeParameters> ReadFrontEndParameters(const ros::NodeHandle& private_nh) {
  SubtreeReader reader = ReadTree(private_nh);
  NodeletParameters<FrontEndNodeParameters> parameters;
  FrontEndNodeParameters& node = parameters.node;
  reader.Read("robot", node.robot);
  reader.Read("pose_source", node.pose_source,
              {{"tf", PoseSource::kTf}, {"odometry", PoseSource::kOdometry}, {"pose", PoseSource::kPose}});
  reader.Read("registered", node.registered);
  reader.Read("odom_frame", node.odom_frame);
  reader.Read("base_frame", node.base_frame);
  reader.Read("sensor_frame", node.sensor_frame);
  reader.Read("pose_timeout_s", node.pose_timeout_s);
  reader.Read("odometry_max_gap_s", node.odometry_max_gap_s);
  reader.Read("frame_jumps", node.frame_jumps);
  reader.Read("trajectory_kind", node.trajectory_kind, kFrameKinds);
  reader.Read("trajectory_wait_s", node.trajectory_wait_s);
  reader.Read("queue_size", node.queue_size);
  reader.Read("send_points", node.send_points);
  parameters.core = ReadCore(reader, "front_end");
  reader.RefuseOthers();
  Validate(node, reader.path());
  return parameters;
}

NodeletParameters<BackEndNodeParameters> ReadBackEndParameters(const ros::NodeHandle& private_nh) {
  SubtreeReader reader = ReadTree(private_nh);
  NodeletParameters<BackEndNodeParameters> parameters;
  BackEndNodeParameters& node = parameters.node;
  reader.Read("robots", node.robots);
  reader.Read("map_frame", node.map_frame);
  reader.Read("closure_kind", node.closure_kind, kFrameKinds);
  reader.Read("trajectory_kind", node.trajectory_kind, kFrameKinds);
  reader.Read("closure_min_distance_m", node.closure_min_distance_m);
  reader.Read("closure_min_interval_s", node.closure_min_interval_s);
  reader.ReadPath("map_file", node.map_file);
  reader.ReadPath("output_dir", node.output_dir);
  reader.Read("publish_tf", node.publish_tf);
  reader.Read("tf_tolerance_s", node.tf_tolerance_s);
  reader.Read("display_period_s", node.display_period_s);
  reader.Read("display_height_m", node.display_height_m);
  reader.Read("queue_size", node.queue_size);
  parameters.core = ReadCore(reader, "back_end");
  reader.RefuseOthers();
  Validate(node, reader.path());
  reader.Require(parameters.core.back_end.mode != Mode::kLocalization || !node.map_file.empty(), "map_file",
                 "must name a saved map: back_end/mode is localization");
  return parameters;
}

PoseGraphNodeParameters ReadPoseGraphParameters(const ros::NodeHandle& private_nh) {
  SubtreeReader reader = ReadTree(private_nh);
  PoseGraphNodeParameters node;
  reader.Read("robots", node.robots);
  reader.Read("map_frame", node.map_frame);
  reader.Read("trajectory_kind", node.trajectory_kind, kFrameKinds);
  reader.Read("publish_tf", node.publish_tf);
  reader.Read("tf_tolerance_s", node.tf_tolerance_s);
  reader.ReadPath("output_dir", node.output_dir);
  reader.Read("queue_size", node.queue_size);
  ReadPoseGraph(reader.Take("pose_graph"), reader.Full("pose_graph"), node.pose_graph);
  reader.RefuseOthers();
  reader.Require(!node.map_frame.empty(), "map_frame", "must not be empty");
  reader.Require(node.tf_tolerance_s >= 0.0, "tf_tolerance_s", "must not be negative");
  reader.Require(node.queue_size > 0, "queue_size", "must be at least 1");
  return node;
}

void Validate(const FrontEndNodeParameters& node, const std::string& path) {
  const auto require = [&path](bool condition, const std::string& name, const std::string& what) {
    Require(condition, path + "/" + name, what);
  };
  require(!node.robot.empty(), "robot", "must not be empty");
  require(!node.odom_frame.empty(), "odom_frame", "must not be empty");
  require(!node.registered || !node.sensor_frame.empty(), "sensor_frame",
          "must be set where clouds are registered: their frame_id does not tell it");
  require(node.pose_timeout_s >= 0.0, "pose_timeout_s", "must not be negative");
  require(node.odometry_max_gap_s > 0.0, "odometry_max_gap_s", "must be positive");
  require(node.trajectory_wait_s >= 0.0, "trajectory_wait_s", "must not be negative");
  require(node.queue_size > 0, "queue_size", "must be at least 1");
}

void Validate(const BackEndNodeParameters& node, const std::string& path) {
  const auto require = [&path](bool condition, const std::string& name, const std::string& what) {
    Require(condition, path + "/" + name, what);
  };
  require(!node.map_frame.empty(), "map_frame", "must not be empty");
  require(node.closure_min_distance_m >= 0.0, "closure_min_distance_m", "must not be negative");
  require(node.closure_min_interval_s >= 0.0, "closure_min_interval_s", "must not be negative");
  require(node.tf_tolerance_s >= 0.0, "tf_tolerance_s", "must not be negative");
  require(node.display_period_s >= 0.0, "display_period_s", "must not be negative");
  require(node.queue_size > 0, "queue_size", "must be at least 1");
}

void RequireWholePath(const std::string& path) {
  if (path.empty()) throw std::invalid_argument("no path is given");
  if (path.front() != '/')
    throw std::invalid_argument(path + " is no whole path, and this node runs in " +
                                std::filesystem::current_path().string() + ": begin it with /");
}

std::string ToYamlText(const XmlRpcValue& constant) {
  XmlRpcValue value = constant;  // its accessors are not const
  switch (value.getType()) {
    case XmlRpcValue::TypeBoolean:
      return static_cast<bool>(value) ? "true" : "false";
    case XmlRpcValue::TypeInt:
      return std::to_string(static_cast<int>(value));
    case XmlRpcValue::TypeDouble:
      return DoubleToYaml(static_cast<double>(value));
    case XmlRpcValue::TypeString:
      return QuoteYaml(static_cast<std::string>(value));
    case XmlRpcValue::TypeArray: {
      std::string text;
      for (int i = 0; i < value.size(); ++i) text += (i == 0 ? "" : ", ") + ToYamlText(value[i]);
      return "[" + text + "]";
    }
    case XmlRpcValue::TypeStruct: {
      std::string text;
      for (auto& [name, member] : value)
        text += (text.empty() ? "" : ", ") + QuoteYaml(name) + ": " + ToYamlText(member);
      return "{" + text + "}";
    }
    default:
      throw std::invalid_argument("a parameter is neither number, text, list nor tree");
  }
}

}  // namespace incremental_segmatch
