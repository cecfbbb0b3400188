#include "simulator/kitti_writer.hpp"

#include <cstdio>
#include <filesystem>
#include <fstream>
#include <iomanip>
#include <sstream>
#include <stdexcept>

namespace incremental_segmatch::simulator {
namespace {

namespace fs = std::filesystem;

// An output file that throws, with its name, if it can't be opened or written.
class OutputFile {
 public:
  explicit OutputFile(const fs::path& path) : path_(path), stream_(path, std::ios::binary) { Check(); }
  std::ofstream& stream() { return stream_; }
  void Close() {
    stream_.close();
    Check();
  }

 private:
  void Check() const {
    if (!stream_) throw std::runtime_error("cannot write " + path_.string());
  }

  fs::path path_;
  std::ofstream stream_;
};

std::string Row(const Pose& pose) {
  std::ostringstream row;
  row << std::setprecision(12);
  for (int i = 0; i < 12; ++i) row << (i == 0 ? "" : " ") << pose.matrix()(i / 4, i % 4);
  return row.str();
}

void WriteCalibration(const fs::path& path) {
  OutputFile file(path);
  // Cameras are not simulated; readers expect the four projections all the same.
  for (int i = 0; i < 4; ++i) file.stream() << "P" << i << ": 1 0 0 0 0 1 0 0 0 0 1 0\n";
  file.stream() << "Tr: " << Row(KittiCalibration()) << "\n";
  file.Close();
}

std::string ScanName(std::size_t i) {
  char name[32];
  std::snprintf(name, sizeof(name), "%06zu.bin", i);
  return name;
}

void WriteScan(const fs::path& path, const SimulatedScan& scan) {
  std::vector<float> values;
  values.reserve(4 * scan.points_sensor.size());
  for (std::size_t k = 0; k < scan.points_sensor.size(); ++k) {
    const Eigen::Vector3f& p = scan.points_sensor[k];
    values.insert(values.end(), {p.x(), p.y(), p.z(), scan.intensities[k]});
  }
  OutputFile file(path);
  file.stream().write(reinterpret_cast<const char*>(values.data()),
                      static_cast<std::streamsize>(values.size() * sizeof(float)));
  file.Close();
}

}  // namespace

Pose KittiCalibration() {
  Pose T_camera_sensor = Pose::Identity();
  T_camera_sensor.linear() << 0, -1, 0, 0, 0, -1, 1, 0, 0;
  T_camera_sensor.translation() << 0.0, -0.08, -0.27;
  return T_camera_sensor;
}

void WriteKitti(Simulation& simulation, const std::string& root, const std::string& sequence,
                const std::function<void(std::size_t)>& progress) {
  const fs::path folder = fs::path(root) / "sequences" / sequence;
  std::error_code error;
  fs::create_directories(folder / "velodyne", error);
  fs::create_directories(fs::path(root) / "poses", error);
  if (!fs::is_directory(folder / "velodyne") || !fs::is_directory(fs::path(root) / "poses")) {
    throw std::runtime_error("cannot create the folders of sequence " + sequence + " in " + root);
  }
  WriteCalibration(folder / "calib.txt");
  OutputFile times(folder / "times.txt"), odometry(folder / "odometry.txt"),
      poses(fs::path(root) / "poses" / (sequence + ".txt"));
  const Pose Tr = KittiCalibration();
  const Pose T_start_world = simulation.T_world_start().inverse();
  for (std::size_t i = 0; i < simulation.size(); ++i) {
    times.stream() << std::fixed << std::setprecision(9) << 1e-9 * static_cast<double>(simulation.stamp_ns(i)) << "\n";
    odometry.stream() << Row(simulation.T_odom_sensor(i)) << "\n";
    poses.stream() << Row(Tr * T_start_world * simulation.T_world_sensor(i) * Tr.inverse()) << "\n";
  }
  times.Close();
  odometry.Close();
  poses.Close();
  for (std::size_t i = 0; i < simulation.size(); ++i) {
    WriteScan(folder / "velodyne" / ScanName(i), simulation.ScanWithIntensities(i));
    if (progress) progress(i + 1);
  }
  for (std::size_t i = simulation.size(); fs::remove(folder / "velodyne" / ScanName(i), error); ++i) {
  }
}

}  // namespace incremental_segmatch::simulator
