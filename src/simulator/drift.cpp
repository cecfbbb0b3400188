#include "simulator/drift.hpp"

#include <algorithm>
#include <cmath>

#include "simulator/random.hpp"

namespace incremental_segmatch::simulator {
namespace {

constexpr double kStretch_m = 100.0;
constexpr double kCorrelation_m = 100.0;
constexpr double kDegPerRad = 57.29577951308232;

using Vector6d = Eigen::Matrix<double, 6, 1>;

std::vector<double> PathLengths(const std::vector<Pose>& poses) {
  std::vector<double> lengths(poses.size(), 0.0);
  for (std::size_t i = 1; i < poses.size(); ++i) {
    lengths[i] = lengths[i - 1] + (poses[i].translation() - poses[i - 1].translation()).norm();
  }
  return lengths;
}

// Unscaled error of each step: rotation vector and translation in the sensor's frame. A slowly varying bias per metre
// plus white noise; yaw drifts most, as LiDAR odometry on the ground does.
std::vector<Vector6d> DrawErrors(const std::vector<double>& lengths, std::uint64_t seed) {
  Random random(HashOf(seed, 2002));
  Vector6d bias_scale, white_scale;
  bias_scale << 3e-5, 3e-5, 2e-4, 4e-3, 1e-3, 1e-3;
  white_scale << 1e-4, 1e-4, 3e-4, 4e-3, 3e-3, 2e-3;
  const auto normals = [&random] {
    Vector6d v;
    for (int i = 0; i < 6; ++i) v[i] = random.Normal();
    return v;
  };
  Vector6d bias = normals();
  std::vector<Vector6d> errors(lengths.size(), Vector6d::Zero());
  for (std::size_t i = 1; i < lengths.size(); ++i) {
    const double step = lengths[i] - lengths[i - 1];
    const double keep = std::exp(-step / kCorrelation_m);
    bias = keep * bias + std::sqrt(1 - keep * keep) * normals();
    errors[i] = step * bias_scale.cwiseProduct(bias) + std::sqrt(step) * white_scale.cwiseProduct(normals());
  }
  return errors;
}

Pose FirstOdometryPose(const Pose& T_world_sensor) {
  const double yaw = std::atan2(T_world_sensor.linear()(1, 0), T_world_sensor.linear()(0, 0));
  Pose first = Pose::Identity();
  first.linear() = Eigen::AngleAxisd(-yaw, Eigen::Vector3d::UnitZ()).toRotationMatrix() * T_world_sensor.linear();
  return first;
}

std::vector<Pose> Integrate(const std::vector<Pose>& truth, const std::vector<Vector6d>& errors, double rotation_scale,
                            double translation_scale) {
  std::vector<Pose> odometry{FirstOdometryPose(truth.front())};
  for (std::size_t i = 1; i < truth.size(); ++i) {
    Pose error = Pose::Identity();
    const Eigen::Vector3d rotation = rotation_scale * errors[i].head<3>();
    const double angle = rotation.norm();
    if (angle > 0) error.linear() = Eigen::AngleAxisd(angle, rotation / angle).toRotationMatrix();
    error.translation() = translation_scale * errors[i].tail<3>();
    Pose next = odometry.back() * (truth[i - 1].inverse() * truth[i]) * error;
    next.linear() = Eigen::Quaterniond(next.linear()).normalized().toRotationMatrix();
    odometry.push_back(next);
  }
  return odometry;
}

}  // namespace

DriftMeasure MeasureDrift(const std::vector<Pose>& truth, const std::vector<Pose>& estimate, double stretch_m) {
  const std::vector<double> lengths = PathLengths(truth);
  double translation = 0.0, rotation = 0.0;
  std::size_t count = 0;
  for (std::size_t first = 0, last = 0; first < truth.size(); ++first) {
    while (last < truth.size() && lengths[last] < lengths[first] + stretch_m) ++last;
    if (last == truth.size()) break;
    const Pose error = (truth[first].inverse() * truth[last]).inverse() * (estimate[first].inverse() * estimate[last]);
    const double length = lengths[last] - lengths[first];
    translation += error.translation().norm() / length;
    rotation += Eigen::AngleAxisd(error.linear()).angle() / length;
    ++count;
  }
  if (count == 0) return {};
  return {100.0 * translation / static_cast<double>(count), 100.0 * kDegPerRad * rotation / static_cast<double>(count)};
}

std::vector<Pose> MakeDriftingOdometry(const std::vector<Pose>& truth, std::uint64_t seed,
                                       const DriftParameters& parameters) {
  if (truth.empty()) return {};
  const std::vector<double> lengths = PathLengths(truth);
  const std::vector<Vector6d> errors = DrawErrors(lengths, seed);
  const double stretch_m = std::min(kStretch_m, 0.5 * lengths.back());
  double rotation_scale = parameters.rotation_deg_per_100m > 0 ? 1.0 : 0.0;
  double translation_scale = parameters.translation_percent > 0 ? 1.0 : 0.0;
  // Rotation errors bend the path and so cause most of the translation error: first the rotation is brought to its
  // size, then the remaining translation error, and both together if the rotation alone were already too much.
  for (int iteration = 0; iteration < 20; ++iteration) {
    const DriftMeasure now =
        MeasureDrift(truth, Integrate(truth, errors, rotation_scale, translation_scale), stretch_m);
    if (now.rotation_deg_per_100m > 0) {
      rotation_scale *= parameters.rotation_deg_per_100m / now.rotation_deg_per_100m;
    }
    if (now.translation_percent > 0) {
      const double ratio = parameters.translation_percent / now.translation_percent;
      translation_scale *= std::clamp(ratio * ratio, 0.5, 2.0);
    }
  }
  std::vector<Pose> odometry = Integrate(truth, errors, rotation_scale, translation_scale);
  const DriftMeasure reached = MeasureDrift(truth, odometry, stretch_m);
  if (reached.translation_percent > 1.05 * parameters.translation_percent) {
    const double shrink = parameters.translation_percent / reached.translation_percent;
    odometry = Integrate(truth, errors, shrink * rotation_scale, shrink * translation_scale);
  }
  return odometry;
}

}  // namespace incremental_segmatch::simulator
