// Closes the loops of a drive in KITTI's layout: close_loops ROOT/sequences/SS
#include <cstdio>
#include <fstream>
#include <incremental_segmatch/back_end.hpp>
#include <incremental_segmatch/front_end.hpp>

namespace segmatch = incremental_segmatch;

int main(int, char** arguments) {
  const std::string folder = arguments[1];
  std::ifstream times(folder + "/times.txt"), odometry(folder + "/odometry.txt");
  segmatch::FrontEnd front_end(segmatch::FrontEndParameters{}, "my_robot");
  segmatch::BackEnd back_end(segmatch::BackEndParameters{});
  segmatch::Scan scan;
  double seconds = 0.0;
  for (int i = 0; times >> seconds; ++i) {
    scan.stamp_ns = static_cast<segmatch::StampNs>(seconds * 1e9);
    for (int k = 0; k < 12; ++k) odometry >> scan.T_odom_sensor(k / 4, k % 4);
    char name[16];
    std::snprintf(name, sizeof name, "%06d.bin", i);
    std::ifstream points(folder + "/velodyne/" + name, std::ios::binary);
    scan.points_sensor.clear();
    for (float p[4]; points.read(reinterpret_cast<char*>(p), sizeof p);)
      scan.points_sensor.emplace_back(p[0], p[1], p[2]);
    const segmatch::FrontEndStep seen = front_end.Process(scan);
    const segmatch::BackEndStep recognized = back_end.Process(seen.delta);
    std::printf("scan %d: %zu segments", i, seen.counts.clusters.segments);
    if (recognized.closure) std::printf(", seen at %.1f s before", 1e-9 * recognized.closure->stamp_target_ns);
    std::printf("\n");
  }
}
