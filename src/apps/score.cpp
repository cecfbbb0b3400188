#include "apps/score.hpp"

#include <cstdint>
#include <cstdio>
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

#include "evaluation/bag_options.hpp"
#include "evaluation/kitti_io.hpp"
#include "evaluation/recorded_run.hpp"
#include "evaluation/scoring.hpp"

namespace incremental_segmatch::apps {
namespace {

struct ScoreArguments {
  std::string root;
  std::string sequence;
  std::string results;
  std::int64_t epoch_s = BagWriterOptions().epoch_s;
};

void PrintScore(const Score& score, const RunErrors& errors) {
  std::printf("loops found         %zu true closures at %zu places, %zu of these driven in the opposite direction\n",
              score.true_closures, score.places, score.places_opposite);
  std::printf("false closures      %zu\n", score.false_closures);
  if (score.trivial_closures + score.unmatched_closures > 0) {
    std::printf("not counted         %zu to a place just left, %zu with stamps of no scan\n", score.trivial_closures,
                score.unmatched_closures);
  }
  if (score.true_closures > 0) {
    std::printf("their relative pose off by %.2f m and %.2f degrees in the median, %.2f m and %.2f degrees for 95 %%\n",
                score.translation_error_median_m, score.rotation_error_median_deg, score.translation_error_95_m,
                score.rotation_error_95_deg);
  }
  std::printf("trajectory error    %.2f m before, %.2f m after (RMSE after alignment, %zu poses)\n", errors.odometry_m,
              errors.optimized_m, errors.poses);
  std::printf("at best             %.2f m, which the same pose graph reaches with the true relative poses at the same places\n",
              errors.bound_same_places_m);
}

void PrintFalseClosures(const RecordedRun& run, const Score& score) {
  for (std::size_t i = 0; i < run.closures.size(); ++i) {
    const JudgedClosure& judged = score.judged[i];
    if (judged.verdict != ClosureVerdict::kFalse) continue;
    std::printf("  scan %zu to scan %zu, %zu inliers of %zu candidates: off by %.2f m and %.2f degrees\n",
                judged.query_step, judged.target_step, run.closures[i].inliers, run.closures[i].candidates,
                judged.translation_error_m, judged.rotation_error_deg);
  }
}

// The scans themselves are not needed, and may be gone.
void ScoreRun(const ScoreArguments& arguments) {
  TrueTrajectory truth = ReadKittiTruth(arguments.root, arguments.sequence);
  for (StampNs& stamp_ns : truth.stamps_ns) stamp_ns += arguments.epoch_s * 1'000'000'000;
  const RecordedRun run = ReadRecordedRun(arguments.results);
  const Score score = ScoreClosures(truth, run.closures, {});
  PrintScore(score, MeasureRun(run, truth.stamps_ns, truth.T_world_sensor));
  if (score.false_closures > 0) std::printf("the false closures:\n");
  PrintFalseClosures(run, score);
  if (score.true_closures == 0) throw std::runtime_error("no loop was found");
}

}  // namespace

void AddScoreCommand(CLI::App& app) {
  const auto arguments = std::make_shared<ScoreArguments>();
  CLI::App* command = app.add_subcommand(
      "score",
      "Judge what the nodelets recorded in their output_dir (closures.csv, trajectory_*.tum, pose_graph.g2o) while a\n"
      "bag of segmatch kitti2bag was played, against the truth of the drive that the bag was made of. By the same\n"
      "definitions as segmatch evaluate. Fails if no loop was found.\n\n"
      "  segmatch score --kitti data --sequence 00 --results demo_results\n");
  command->add_option("--kitti", arguments->root, "folder that holds sequences/ and poses/ (ROOT)")->required();
  command->add_option("--sequence", arguments->sequence, "name of the sequence (SS)")->required();
  command->add_option("--results", arguments->results, "folder that the run wrote into")
      ->required()
      ->check(CLI::ExistingDirectory);
  command->add_option("--epoch", arguments->epoch_s, "seconds that kitti2bag added to the stamps")
      ->check(CLI::NonNegativeNumber)
      ->capture_default_str();
  command->callback([arguments] { ScoreRun(*arguments); });
}

}  // namespace incremental_segmatch::apps
