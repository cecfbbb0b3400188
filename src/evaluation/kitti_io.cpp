#include "kitti_io.hpp"

#include <cmath>
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <sstream>
#include <stdexcept>

namespace incremental_segmatch {
namespace {

namespace fs = std::filesystem;

std::ifstream Open(const std::string& path, const std::string& remedy) {
  std::ifstream file(path, std::ios::binary);
  if (!file) throw std::runtime_error("can't read " + path + ": " + remedy);
  return file;
}

[[noreturn]] void FailAt(const std::string& path, std::size_t line, const std::string& what) {
  throw std::runtime_error(path + ", line " + std::to_string(line) + ": " + what);
}

bool IsBlank(const std::string& line) {
  return line.find_first_not_of(" \t\r\n") == std::string::npos;
}

// All numbers of a row; false if anything else is on it.
bool ParseNumbers(const std::string& line, std::vector<double>& numbers) {
  numbers.clear();
  std::istringstream stream(line);
  for (std::string word; stream >> word;) {
    std::size_t used = 0;
    try {
      numbers.push_back(std::stod(word, &used));
    } catch (const std::exception&) {
      return false;
    }
    if (used != word.size() || !std::isfinite(numbers.back())) return false;
  }
  return true;
}

Pose PoseFromRow(const std::vector<double>& v, const std::string& path, std::size_t line) {
  if (v.size() != 12) {
    FailAt(path, line, "expected the 12 numbers of a 3x4 matrix, found " + std::to_string(v.size()));
  }
  Eigen::Matrix3d R;
  R << v[0], v[1], v[2], v[4], v[5], v[6], v[8], v[9], v[10];
  if (!(R * R.transpose()).isIdentity(1e-2) || R.determinant() < 0.0) {
    FailAt(path, line, "the left 3x3 block is no rotation");
  }
  Pose T = Pose::Identity();
  T.linear() = Eigen::Quaterniond(R).normalized().toRotationMatrix();
  T.translation() << v[3], v[7], v[11];
  return T;
}

std::string BinPath(const std::string& folder, std::size_t i) {
  char name[32];
  std::snprintf(name, sizeof name, "/velodyne/%06zu.bin", i);
  return folder + name;
}

std::size_t CountScans(const std::string& folder) {
  const std::string velodyne = folder + "/velodyne";
  if (!fs::is_directory(velodyne)) {
    throw std::runtime_error(velodyne +
                             " is no folder: --kitti takes the folder that holds sequences/ and poses/, "
                             "--sequence the name of one sequence, 00 say");
  }
  std::size_t scans = 0;
  while (fs::exists(BinPath(folder, scans))) ++scans;
  if (scans == 0)
    throw std::runtime_error("there is no scan " + BinPath(folder, 0) + ": was the data downloaded in full?");
  return scans;
}

void RequireRows(std::size_t rows, std::size_t scans, const std::string& path) {
  if (rows < scans) {
    throw std::runtime_error(path + " has " + std::to_string(rows) + " rows for " + std::to_string(scans) +
                             " scans: it must have one for each");
  }
}

std::string FindOdometry(const std::string& file, const std::string& folder) {
  if (fs::exists(file)) return file;
  if (fs::path(file).is_relative() && fs::exists(folder + "/" + file)) return folder + "/" + file;
  throw std::runtime_error("can't read " + file + ": there is no such odometry file, neither here nor in " + folder);
}

}  // namespace

KittiScan ReadKittiBin(const std::string& path) {
  std::ifstream file = Open(path, "is the drive complete?");
  file.seekg(0, std::ios::end);
  const std::streamoff bytes = file.tellg();
  file.seekg(0);
  constexpr std::streamoff kBytesPerPoint = 4 * sizeof(float);
  if (bytes % kBytesPerPoint != 0) {
    throw std::runtime_error(path + " has " + std::to_string(bytes) +
                             " bytes, no multiple of 16 (float32 x, y, z, intensity): is it cut off?");
  }
  std::vector<float> raw(static_cast<std::size_t>(bytes) / sizeof(float));
  file.read(reinterpret_cast<char*>(raw.data()), bytes);
  if (!file) throw std::runtime_error("reading " + path + " failed");
  KittiScan scan;
  scan.points_sensor.reserve(raw.size() / 4);
  scan.intensities.reserve(raw.size() / 4);
  for (std::size_t i = 0; i + 3 < raw.size(); i += 4) {
    scan.points_sensor.emplace_back(raw[i], raw[i + 1], raw[i + 2]);
    scan.intensities.push_back(raw[i + 3]);
  }
  return scan;
}

std::vector<StampNs> ReadKittiTimes(const std::string& path) {
  std::ifstream file = Open(path, "KITTI's layout has one row of seconds for each scan in it");
  std::vector<StampNs> stamps;
  std::vector<double> numbers;
  std::size_t line_number = 0;
  for (std::string line; std::getline(file, line);) {
    ++line_number;
    if (IsBlank(line)) continue;
    if (!ParseNumbers(line, numbers) || numbers.size() != 1) FailAt(path, line_number, "expected one number, seconds");
    stamps.push_back(std::llround(numbers[0] * 1e9));
    if (stamps.size() > 1 && stamps.back() <= stamps[stamps.size() - 2]) {
      FailAt(path, line_number, "the times must increase");
    }
  }
  return stamps;
}

std::vector<Pose> ReadKittiPoses(const std::string& path) {
  std::ifstream file = Open(path, "expected rows of 3x4 matrices, one for each scan");
  std::vector<Pose> poses;
  std::vector<double> numbers;
  std::size_t line_number = 0;
  for (std::string line; std::getline(file, line);) {
    ++line_number;
    if (IsBlank(line)) continue;
    if (!ParseNumbers(line, numbers)) FailAt(path, line_number, "expected finite numbers only");
    poses.push_back(PoseFromRow(numbers, path, line_number));
  }
  return poses;
}

Pose ReadKittiCalibration(const std::string& path) {
  std::ifstream file = Open(path, "its row `Tr:` relates the LiDAR to the camera in which KITTI's poses are given");
  std::size_t line_number = 0;
  for (std::string line; std::getline(file, line);) {
    ++line_number;
    if (line.rfind("Tr", 0) != 0) continue;
    const std::size_t colon = line.find(':');
    std::vector<double> numbers;
    if (colon == std::string::npos || !ParseNumbers(line.substr(colon + 1), numbers)) {
      FailAt(path, line_number, "expected `Tr:` and 12 numbers");
    }
    return PoseFromRow(numbers, path, line_number);
  }
  throw std::runtime_error(path +
                           " has no row `Tr:` (the 3x4 transform from the LiDAR to camera 0): take it from the "
                           "calibration files of the odometry data set");
}

std::vector<Pose> SensorPosesFromCameraPoses(const std::vector<Pose>& camera_poses, const Pose& T_camera_sensor) {
  std::vector<Pose> poses;
  poses.reserve(camera_poses.size());
  for (const Pose& P : camera_poses) poses.push_back(T_camera_sensor.inverse() * P * T_camera_sensor);
  return poses;
}

TrueTrajectory ReadKittiTruth(const std::string& root, const std::string& sequence) {
  const std::string folder = root + "/sequences/" + sequence, poses_file = root + "/poses/" + sequence + ".txt";
  TrueTrajectory truth;
  truth.stamps_ns = ReadKittiTimes(folder + "/times.txt");
  truth.T_world_sensor =
      SensorPosesFromCameraPoses(ReadKittiPoses(poses_file), ReadKittiCalibration(folder + "/calib.txt"));
  if (truth.T_world_sensor.size() != truth.stamps_ns.size()) {
    throw std::runtime_error(poses_file + " has " + std::to_string(truth.T_world_sensor.size()) +
                             " poses, but times.txt " + std::to_string(truth.stamps_ns.size()) +
                             " stamps: are they of one drive?");
  }
  return truth;
}

bool HasKittiOdometry(const std::string& root, const std::string& sequence) {
  return fs::exists(root + "/sequences/" + sequence + "/odometry.txt");
}

KittiDrive::KittiDrive(const KittiDriveOptions& options) : folder_(options.root + "/sequences/" + options.sequence) {
  const std::size_t scans = CountScans(folder_);
  const std::string times = folder_ + "/times.txt";
  stamps_ns_ = ReadKittiTimes(times);
  RequireRows(stamps_ns_.size(), scans, times);
  if (stamps_ns_.size() > scans) {
    notes_.push_back("only the first " + std::to_string(scans) + " of " + std::to_string(stamps_ns_.size()) +
                     " scans named by times.txt are there");
    stamps_ns_.resize(scans);
  }
  const std::string poses = options.root + "/poses/" + options.sequence + ".txt";
  if (fs::exists(poses)) {
    T_world_sensor_ = SensorPosesFromCameraPoses(ReadKittiPoses(poses), ReadKittiCalibration(folder_ + "/calib.txt"));
    RequireRows(T_world_sensor_.size(), scans, poses);
    T_world_sensor_.resize(scans);
  } else {
    notes_.push_back("there is no " + poses + ": nothing can be scored");
  }
  if (!options.odometry_file.empty()) {
    const std::string odometry = FindOdometry(options.odometry_file, folder_);
    T_odom_sensor_ = ReadKittiPoses(odometry);
    RequireRows(T_odom_sensor_.size(), scans, odometry);
    T_odom_sensor_.resize(scans);
    notes_.push_back("odometry: " + odometry);
    return;
  }
  if (T_world_sensor_.empty()) {
    throw std::runtime_error("can't read " + poses + ", and there is no odometry file: give one with --odometry FILE");
  }
  T_odom_sensor_ = T_world_sensor_;
  odometry_is_truth_ = true;
  notes_.push_back("the ground-truth poses serve as odometry: it does not drift");
  if (HasKittiOdometry(options.root, options.sequence)) {
    notes_.push_back("a drifting odometry is at hand: --odometry odometry.txt");
  }
}

std::optional<Pose> KittiDrive::T_world_sensor(std::size_t i) const {
  if (T_world_sensor_.empty()) return std::nullopt;
  return T_world_sensor_.at(i);
}

KittiScan KittiDrive::ReadScan(std::size_t i) const {
  return ReadKittiBin(BinPath(folder_, i));
}

}  // namespace incremental_segmatch
