#include <CLI/CLI.hpp>
#include <cstdio>
#include <exception>

#include "apps/evaluate.hpp"
#include "apps/experiment.hpp"
#include "apps/kitti2bag.hpp"
#include "apps/score.hpp"
#include "apps/simulate.hpp"

int main(int argc, char** argv) {
  using namespace incremental_segmatch::apps;
  CLI::App app(
      "Place recognition and loop closure for 3-D LiDAR on segments.\n\n"
      "A first round trip:\n"
      "  segmatch simulate --out data                                                        make a drive\n"
      "  segmatch evaluate --kitti data --sequence 00 --odometry odometry.txt --out result   close its loops\n"
      "  segmatch kitti2bag --kitti data --sequence 00 --out drive.bag                       or play it in ROS\n\n"
      "`segmatch SUBCOMMAND --help` explains each.\n",
      "segmatch");
  app.set_version_flag("--version", SEGMATCH_VERSION
#ifdef SEGMATCH_WITH_ROSBAG
                       ", with ROS bags"
#else
                       ", without ROS bags"
#endif
  );
  app.require_subcommand(1);
  AddSimulateCommand(app);
  AddKitti2BagCommand(app);
  AddEvaluateCommand(app);
  AddScoreCommand(app);
  AddExperimentCommand(app);
  try {
    app.parse(argc, argv);
  } catch (const CLI::ParseError& error) {
    return app.exit(error);
  } catch (const std::exception& error) {
    std::fprintf(stderr, "segmatch: %s\n", error.what());
    return 1;
  }
  return 0;
}
