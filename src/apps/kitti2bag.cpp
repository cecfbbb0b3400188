#include "apps/kitti2bag.hpp"

#include <cstdio>
#include <map>
#include <memory>
#include <string>

#include "apps/no_bags.hpp"
#include "apps/progress_bar.hpp"
#include "evaluation/bag_options.hpp"
#include "evaluation/kitti_io.hpp"
#ifdef SEGMATCH_WITH_ROSBAG
#include "evaluation/bag.hpp"
#endif

namespace incremental_segmatch::apps {
namespace {

struct Kitti2BagArguments {
  KittiDriveOptions drive;
  BagWriterOptions bag;
};

#ifdef SEGMATCH_WITH_ROSBAG
void Convert(Kitti2BagArguments arguments) {
  KittiDriveOptions& options = arguments.drive;
  if (options.odometry_file.empty() && HasKittiOdometry(options.root, options.sequence)) {
    options.odometry_file = "odometry.txt";
  }
  const KittiDrive drive(options);
  for (const std::string& note : drive.notes()) std::printf("note: %s\n", note.c_str());
  std::size_t scans = 0;
  {
    ProgressBar bar("writing " + arguments.bag.path, drive.size());
    WriteBag(drive, arguments.bag, [&](std::size_t done, std::size_t) {
      scans = done;
      bar.Update(done);
    });
  }
  std::printf("%s: %zu scans\n", arguments.bag.path.c_str(), scans);
}
#else
void Convert(const Kitti2BagArguments&) {
  ThrowNoBags("segmatch kitti2bag");
}
#endif

}  // namespace

void AddKitti2BagCommand(CLI::App& app) {
  const auto arguments = std::make_shared<Kitti2BagArguments>();
  CLI::App* command = app.add_subcommand(
      "kitti2bag",
      "Turn a drive in KITTI's odometry layout, real or simulated, into a ROS bag.\n"
      "Style kitti2bag:        /kitti/velo/pointcloud in frame velo_link, tf world -> base_link -> imu_link -> "
      "velo_link\n"
      "Style velodyne_points:  /velodyne_points in frame velodyne, tf world -> velodyne\n"
      "Both: the odometry also on /odometry, the truth, if known, on /ground_truth (nav_msgs/Odometry), the epoch\n"
      "that was added to the stamps on /segmatch/epoch (std_msgs/Time).\n"
      "The odometry is the sequence's odometry.txt; without one the poses serve, and this is said.\n\n"
      "  segmatch kitti2bag --kitti data --sequence 00 --out town.bag\n"
      "  rosbag play --clock town.bag\n");
  command->add_option("--kitti", arguments->drive.root, "folder that holds sequences/ and poses/ (ROOT)")->required();
  command->add_option("--sequence", arguments->drive.sequence, "name of the sequence (SS)")->required();
  command->add_option("--odometry", arguments->drive.odometry_file,
                      "3x4 rows, poses of the LiDAR; also looked for in the sequence's folder");
  command->add_option("--out", arguments->bag.path, "bag to write")->required();
  const std::map<std::string, BagStyle> styles{{"kitti2bag", BagStyle::kKitti2Bag},
                                               {"velodyne_points", BagStyle::kVelodynePoints}};
  command->add_option("--style", arguments->bag.style, "topics and frames: kitti2bag (default) or velodyne_points")
      ->transform(CLI::CheckedTransformer(styles).description("{kitti2bag,velodyne_points}"));
  command->add_option("--epoch", arguments->bag.epoch_s, "seconds added to all stamps, since a bag refuses time 0")
      ->check(CLI::PositiveNumber)
      ->capture_default_str();
  command->add_option("--max-scans", arguments->bag.max_scans, "stop after this many scans (0: all)")
      ->capture_default_str();
  command->callback([arguments] { Convert(*arguments); });
}

}  // namespace incremental_segmatch::apps
