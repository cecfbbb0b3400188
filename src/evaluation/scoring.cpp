#include "scoring.hpp"

#include <Eigen/Cholesky>
#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <fstream>
#include <limits>
#include <stdexcept>
#include <unordered_map>

#include "incremental_segmatch/pose_graph_io.hpp"

namespace incremental_segmatch {
namespace {

constexpr double kDegreesPerRadian = 180.0 / M_PI;

double Ratio(std::size_t part, std::size_t whole) {
  return whole > 0 ? static_cast<double>(part) / static_cast<double>(whole) : std::numeric_limits<double>::quiet_NaN();
}

// The true drive: seconds, positions and path lengths per step.
class Truth {
 public:
  explicit Truth(const TrueTrajectory& drive) : poses_(drive.T_world_sensor), path_m_(PathLengths(poses_)) {
    if (drive.stamps_ns.size() != poses_.size())
      throw std::invalid_argument("scoring needs one true pose for each stamp");
    for (const StampNs stamp_ns : drive.stamps_ns) seconds_.push_back(static_cast<double>(stamp_ns) / 1e9);
    std::vector<double> periods;
    for (std::size_t i = 1; i < seconds_.size(); ++i) periods.push_back(seconds_[i] - seconds_[i - 1]);
    if (!periods.empty()) half_period_s_ = 0.5 * Percentile(periods, 0.5);
  }

  std::size_t size() const { return poses_.size(); }
  const Pose& pose(std::size_t i) const { return poses_[i]; }
  Eigen::Vector3d position(std::size_t i) const { return poses_[i].translation(); }
  double seconds(std::size_t i) const { return seconds_[i]; }
  double path_m(std::size_t i) const { return path_m_[i]; }

  // The scan nearest to a stamp, if within half a scan period.
  std::optional<std::size_t> Find(StampNs stamp_ns) const {
    if (seconds_.empty()) return std::nullopt;
    const double stamp = static_cast<double>(stamp_ns) / 1e9;
    std::size_t nearest =
        static_cast<std::size_t>(std::upper_bound(seconds_.begin(), seconds_.end(), stamp) - seconds_.begin());
    if (nearest == seconds_.size() ||
        (nearest > 0 && std::abs(seconds_[nearest - 1] - stamp) <= std::abs(seconds_[nearest] - stamp))) {
      --nearest;
    }
    if (std::abs(seconds_[nearest] - stamp) > half_period_s_) return std::nullopt;
    return nearest;
  }

 private:
  const std::vector<Pose>& poses_;
  std::vector<double> path_m_;
  std::vector<double> seconds_;
  double half_period_s_ = 0.05;
};

// What closures refer to: the older part of the drive itself, or another drive.
class Targets {
 public:
  Targets(const Truth& drive, const Truth& targets, const ScoringParameters& parameters)
      : drive_(drive), targets_(targets), is_same_drive_(&drive == &targets), parameters_(parameters) {}

  const Truth& truth() const { return targets_; }

  // True if a pose is a target of step i.
  bool IsOld(std::size_t i, std::size_t target) const {
    return !is_same_drive_ || (drive_.seconds(i) - drive_.seconds(target) > parameters_.min_age_s &&
                               drive_.path_m(i) - drive_.path_m(target) > parameters_.min_path_m);
  }

  // For each step the nearest target, if within the radius; of several at the same distance the oldest.
  std::vector<std::optional<std::size_t>> FindRevisits() const {
    std::unordered_map<std::int64_t, std::vector<std::size_t>> old_poses;
    std::vector<std::optional<std::size_t>> revisits(drive_.size());
    std::size_t next = 0;
    for (std::size_t i = 0; i < drive_.size(); ++i) {
      const auto is_old_enough = [&](std::size_t k) {
        return !is_same_drive_ || (k < i && drive_.seconds(i) - drive_.seconds(k) > parameters_.min_age_s);
      };
      for (; next < targets_.size() && is_old_enough(next); ++next)
        old_poses[Cell(targets_.position(next), 0, 0)].push_back(next);
      std::pair<double, std::size_t> nearest{std::numeric_limits<double>::infinity(), 0};
      for (int dx = -1; dx <= 1; ++dx) {
        for (int dy = -1; dy <= 1; ++dy) {
          const auto it = old_poses.find(Cell(drive_.position(i), dx, dy));
          if (it == old_poses.end()) continue;
          for (std::size_t k : it->second) {
            if (IsOld(i, k)) nearest = std::min(nearest, {(drive_.position(i) - targets_.position(k)).norm(), k});
          }
        }
      }
      if (nearest.first <= parameters_.revisit_radius_m) revisits[i] = nearest.second;
    }
    return revisits;
  }

 private:
  std::int64_t Cell(const Eigen::Vector3d& position, int dx, int dy) const {
    const auto column = static_cast<std::int64_t>(std::floor(position.x() / parameters_.revisit_radius_m)) + dx;
    const auto row = static_cast<std::int64_t>(std::floor(position.y() / parameters_.revisit_radius_m)) + dy;
    return column * (std::int64_t{1} << 32) + row;
  }

  const Truth& drive_;
  const Truth& targets_;
  bool is_same_drive_;
  const ScoringParameters& parameters_;
};

bool IsOpposite(const Pose& T_world_a, const Pose& T_world_b) {
  return T_world_a.linear().col(0).dot(T_world_b.linear().col(0)) < 0.0;
}

constexpr double kChiSquared95OfSix = 12.59;

JudgedClosure Judge(const Truth& drive, const Targets& targets, const ClosureRow& closure,
                    const ScoringParameters& parameters) {
  JudgedClosure judged;
  const std::optional<std::size_t> query = drive.Find(closure.stamp_query_ns);
  const std::optional<std::size_t> target = targets.truth().Find(closure.stamp_target_ns);
  if (!query || !target) return judged;
  judged.query_step = *query;
  judged.target_step = *target;
  if (!targets.IsOld(*query, *target)) {
    judged.verdict = ClosureVerdict::kTrivial;
    return judged;
  }
  const Pose error = (targets.truth().pose(*target).inverse() * drive.pose(*query)).inverse() * closure.T_target_query;
  judged.translation_error_m = error.translation().norm();
  const double cosine = std::clamp((error.linear().trace() - 1.0) / 2.0, -1.0, 1.0);
  judged.rotation_error_deg = std::acos(cosine) * kDegreesPerRadian;
  const bool is_true = judged.translation_error_m < parameters.max_translation_m &&
                       judged.rotation_error_deg < parameters.max_rotation_deg;
  if (closure.covariance) {
    const Eigen::AngleAxisd turn(error.linear());
    Eigen::Matrix<double, 6, 1> xi;
    xi << error.translation(), turn.angle() * turn.axis();
    judged.normalized_error2 = xi.dot(closure.covariance->ldlt().solve(xi));
  }
  judged.verdict = is_true ? ClosureVerdict::kTrue : ClosureVerdict::kFalse;
  return judged;
}

Score ScoreAgainst(const Truth& truth, const Targets& old, const std::vector<ClosureRow>& closures,
                   const ScoringParameters& parameters) {
  Score score;
  score.steps = truth.size();
  score.revisit_targets = old.FindRevisits();
  score.found.assign(truth.size(), false);
  score.opposite.assign(truth.size(), false);

  std::vector<double> translation_errors, rotation_errors, normalized_errors2;
  for (const ClosureRow& closure : closures) {
    const JudgedClosure judged = Judge(truth, old, closure, parameters);
    score.judged.push_back(judged);
    score.unmatched_closures += judged.verdict == ClosureVerdict::kUnmatched;
    score.trivial_closures += judged.verdict == ClosureVerdict::kTrivial;
    score.false_closures += judged.verdict == ClosureVerdict::kFalse;
    if (judged.verdict != ClosureVerdict::kTrue) continue;
    ++score.true_closures;
    score.found[judged.query_step] = true;
    translation_errors.push_back(judged.translation_error_m);
    rotation_errors.push_back(judged.rotation_error_deg);
    if (judged.normalized_error2) normalized_errors2.push_back(*judged.normalized_error2);
  }
  score.closures = score.true_closures + score.false_closures;
  score.precision = Ratio(score.true_closures, score.closures);

  std::size_t found_same = 0, found_opposite = 0;
  std::vector<double>& gaps = score.gaps_m;
  const auto& targets = score.revisit_targets;
  for (std::size_t i = 0; i < truth.size();) {
    if (!targets[i]) {
      ++i;
      continue;
    }
    double mark_m = truth.path_m(i);
    bool is_place = false, is_opposite_place = false;
    for (; i < truth.size() && targets[i]; ++i) {
      const bool opposite = IsOpposite(truth.pose(i), old.truth().pose(*targets[i]));
      score.opposite[i] = opposite;
      ++score.revisits;
      score.revisits_opposite += opposite;
      if (!score.found[i]) continue;
      ++(opposite ? found_opposite : found_same);
      is_place = true;
      is_opposite_place = is_opposite_place || opposite;
      gaps.push_back(truth.path_m(i) - mark_m);
      mark_m = truth.path_m(i);
    }
    gaps.push_back(truth.path_m(i - 1) - mark_m);
    score.places += is_place;
    score.places_opposite += is_opposite_place;
  }
  score.recall = Ratio(found_same + found_opposite, score.revisits);
  score.recall_same_direction = Ratio(found_same, score.revisits - score.revisits_opposite);
  score.recall_opposite_direction = Ratio(found_opposite, score.revisits_opposite);
  score.translation_error_median_m = Percentile(translation_errors, 0.5);
  score.translation_error_95_m = Percentile(translation_errors, 0.95);
  score.rotation_error_median_deg = Percentile(rotation_errors, 0.5);
  score.rotation_error_95_deg = Percentile(rotation_errors, 0.95);
  score.normalized_error2_median = Percentile(normalized_errors2, 0.5);
  score.normalized_error2_within_95 = ShareWithin(normalized_errors2, kChiSquared95OfSix);
  score.gap_50_m = Percentile(gaps, 0.5);
  score.gap_90_m = Percentile(gaps, 0.9);
  score.gap_99_m = Percentile(gaps, 0.99);
  score.gap_max_m = Percentile(gaps, 1.0);
  return score;
}

}  // namespace

double Percentile(std::vector<double> values, double share) {
  if (values.empty()) return std::numeric_limits<double>::quiet_NaN();
  std::sort(values.begin(), values.end());
  const auto index = static_cast<std::size_t>(share * static_cast<double>(values.size()));
  return values[std::min(index, values.size() - 1)];
}

double ShareWithin(const std::vector<double>& values, double limit) {
  const auto within = std::count_if(values.begin(), values.end(), [&](double value) { return value <= limit; });
  return Ratio(static_cast<std::size_t>(within), values.size());
}

Score ScoreClosures(const TrueTrajectory& drive, const std::vector<ClosureRow>& closures,
                    const ScoringParameters& parameters) {
  const Truth truth(drive);
  return ScoreAgainst(truth, Targets(truth, truth, parameters), closures, parameters);
}

Score ScoreLocalizations(const TrueTrajectory& drive, const TrueTrajectory& map_drive,
                         const std::vector<ClosureRow>& closures, const ScoringParameters& parameters) {
  const Truth truth(drive), map_truth(map_drive);
  return ScoreAgainst(truth, Targets(truth, map_truth, parameters), closures, parameters);
}

std::vector<double> PathLengths(const std::vector<Pose>& poses) {
  std::vector<double> path_m(poses.size(), 0.0);
  for (std::size_t i = 1; i < poses.size(); ++i)
    path_m[i] = path_m[i - 1] + (poses[i].translation() - poses[i - 1].translation()).norm();
  return path_m;
}

void WriteClosuresCsv(const std::vector<ClosureRow>& closures, const std::string& path) {
  std::ofstream file(path);
  if (!file) throw std::runtime_error("can't write " + path);
  file.precision(9);
  file << "stamp_query,stamp_target,robot_query,robot_target,x,y,z,qx,qy,qz,qw,inliers,candidates,rms_m\n";
  for (const ClosureRow& row : closures) {
    const Eigen::Vector3d t = row.T_target_query.translation();
    const Eigen::Quaterniond q = Eigen::Quaterniond(row.T_target_query.linear()).normalized();
    file << FormatSeconds(row.stamp_query_ns) << ',' << FormatSeconds(row.stamp_target_ns) << ',' << row.robot_query
         << ',' << row.robot_target << ',' << t.x() << ',' << t.y() << ',' << t.z() << ',' << q.x() << ',' << q.y()
         << ',' << q.z() << ',' << q.w() << ',' << row.inliers << ',' << row.candidates << ',' << row.rms_m << '\n';
  }
  file.close();
  if (!file) throw std::runtime_error("writing " + path + " failed: is the disk full?");
}

}  // namespace incremental_segmatch
