#include "incremental_segmatch/recognizer.hpp"

#include <Eigen/Eigenvalues>
#include <Eigen/LU>
#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <string>
#include <tuple>
#include <utility>

#include "incremental_segmatch/stage_times.hpp"
#include "incremental_segmatch/twist.hpp"

namespace incremental_segmatch {
namespace {

using Vertices = std::vector<std::uint32_t>;

/// The order of correspondences: by the keys of local and target segment; by their values where somebody gives the
/// same pair twice.
bool Precedes(const Correspondence& a, const Correspondence& b) {
  const auto values = [](const Correspondence& c) {
    return std::make_tuple(c.centroid_local.x(), c.centroid_local.y(), c.centroid_local.z(), c.centroid_target.x(),
                           c.centroid_target.y(), c.centroid_target.z(), c.descriptor_distance);
  };
  const auto keys = [](const Correspondence& c) { return std::tie(c.local, c.target); };
  return keys(a) < keys(b) || (keys(a) == keys(b) && values(a) < values(b));
}

/// The correspondences that are in some pairs, in their order, and the graph that the pairs make.
struct Candidates {
  Correspondences correspondences;
  ConsistencyGraph graph;
};

Candidates CandidatesOf(const Correspondences& all, std::vector<ConsistencyGraph::Edge> pairs) {
  Vertices vertex(all.size(), 0), index;  // of a correspondence in the graph and back
  for (const auto& [a, b] : pairs) vertex[a] = vertex[b] = 1;
  for (std::uint32_t i = 0; i < all.size(); ++i) {
    if (vertex[i] == 1) index.push_back(i);
  }
  std::sort(index.begin(), index.end(), [&](std::uint32_t a, std::uint32_t b) { return Precedes(all[a], all[b]); });
  Candidates candidates;
  candidates.correspondences.reserve(index.size());
  for (const std::uint32_t i : index) {
    vertex[i] = static_cast<std::uint32_t>(candidates.correspondences.size());
    candidates.correspondences.push_back(all[i]);
  }
  for (auto& [a, b] : pairs) {
    a = vertex[a];
    b = vertex[b];
  }
  candidates.graph = ConsistencyGraph::FromEdges(index.size(), pairs);
  return candidates;
}

/// Centroids of some correspondences, 3 x n, metres.
struct PointPairs {
  Eigen::Matrix3Xd local;
  Eigen::Matrix3Xd target;
};

PointPairs PointPairsOf(const Correspondences& correspondences, const Vertices& vertices) {
  PointPairs pairs{Eigen::Matrix3Xd(3, vertices.size()), Eigen::Matrix3Xd(3, vertices.size())};
  for (std::size_t i = 0; i < vertices.size(); ++i) {
    pairs.local.col(i) = correspondences[vertices[i]].centroid_local;
    pairs.target.col(i) = correspondences[vertices[i]].centroid_target;
  }
  return pairs;
}

/// Least-squares T_target_local (Umeyama, no scale).
Pose FitTransform(const PointPairs& pairs) {
  return Pose(Eigen::umeyama(pairs.local, pairs.target, false));
}

double RootMeanSquareResidual(const PointPairs& pairs, const Pose& T_target_local) {
  const Eigen::Matrix3Xd moved = (T_target_local.linear() * pairs.local).colwise() + T_target_local.translation();
  return std::sqrt((moved - pairs.target).squaredNorm() / static_cast<double>(pairs.local.cols()));
}

/// Second largest standard deviation of the points along their principal axes: 0 for points on a line.
double SecondSpread(const Eigen::Matrix3Xd& points) {
  const Eigen::Matrix3Xd centred = points.colwise() - points.rowwise().mean();
  const Eigen::Matrix3d covariance = centred * centred.transpose() / static_cast<double>(points.cols());
  return std::sqrt(std::max(Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d>(covariance).eigenvalues()[1], 0.0));
}

/// Angle between the z axis and the transformed z axis.
double TiltOf(const Pose& T) {
  const Eigen::Vector3d up = T.linear().col(2);
  return std::atan2(up.head<2>().norm(), up.z());
}

/// Prefers the clique with the smaller residual, then the smaller list of vertices, which are sorted by key. Residuals
/// are compared to the micrometre: exact ties must not be decided by rounding, or a turned map would turn the choice.
class SmallerResidual {
 public:
  explicit SmallerResidual(const Correspondences& correspondences) : correspondences_(correspondences) {}

  bool operator()(const Vertices& a, const Vertices& b) {
    if (b != last_) {
      last_ = b;
      last_residual_ = Residual_um(b);
    }
    const double residual = Residual_um(a);
    if (std::tie(residual, a) >= std::tie(last_residual_, b)) return false;
    last_ = a;  // becomes the incumbent, which the next call compares with
    last_residual_ = residual;
    return true;
  }

 private:
  double Residual_um(const Vertices& vertices) const {
    const PointPairs pairs = PointPairsOf(correspondences_, vertices);
    return std::round(1e6 * RootMeanSquareResidual(pairs, FitTransform(pairs)));
  }

  const Correspondences& correspondences_;
  Vertices last_;
  double last_residual_ = 0.0;
};

/// Whether each correspondence is neither an inlier of a recognition nor fits its transform: a further sighting of an
/// inlier's object is no rival of it.
std::vector<std::uint8_t> RivalsOf(const Recognition& winner, const Correspondences& correspondences,
                                   double same_place_m) {
  std::vector<std::uint8_t> is_rival;
  is_rival.reserve(correspondences.size());
  for (const Correspondence& c : correspondences) {
    is_rival.push_back((winner.T_target_local * c.centroid_local - c.centroid_target).norm() > same_place_m &&
                       !std::binary_search(winner.inliers.begin(), winner.inliers.end(), c, Precedes));
  }
  return is_rival;
}

/// A graph without some of its vertices, which keep their numbers but lose their edges.
ConsistencyGraph Among(const std::vector<std::uint8_t>& stays, const ConsistencyGraph& graph) {
  ConsistencyGraph rest;
  rest.offsets.reserve(graph.offsets.size());
  rest.neighbours.resize(graph.neighbours.size());
  std::size_t count = 0;
  for (std::uint32_t v = 0; v < graph.vertices(); ++v) {
    if (stays[v]) {
      for (const std::uint32_t u : graph.Neighbours(v)) {
        rest.neighbours[count] = u;
        count += stays[u];
      }
    }
    rest.offsets.push_back(count);
  }
  rest.neighbours.resize(count);
  rest.edges = count / 2;
  return rest;
}

/// The largest clique beside the winner, if it has so many vertices; empty without one.
Vertices FindRunnerUp(const Candidates& candidates, const Recognition& winner, std::size_t size, double same_place_m,
                      MaxCliqueParameters parameters) {
  parameters.min_size = size;
  parameters.max_ties = 1;
  const std::vector<std::uint8_t> is_rival = RivalsOf(winner, candidates.correspondences, same_place_m);
  return FindMaxClique(Among(is_rival, candidates.graph), parameters).vertices;
}

void Validate(const RecognizerParameters& parameters) {
  constexpr double kPi = 3.14159265358979323846;
  const auto require = [](bool good, const char* message) {
    if (!good) throw std::invalid_argument(std::string("RecognizerParameters: ") + message);
  };
  require(parameters.clique.min_size >= 3, "clique.min_size must be at least 3");
  require(parameters.clique.max_work > 0, "clique.max_work must be positive");
  require(parameters.clique.deadline.count() > 0, "clique.deadline must be positive");
  require(parameters.clique.max_ties >= 1, "clique.max_ties must be at least 1");
  require(parameters.max_tilt_rad >= 0.0 && parameters.max_tilt_rad <= kPi, "max_tilt_rad must be in [0, pi]");
  require(parameters.consistency.max_vertical_slope >= parameters.max_tilt_rad,
          "consistency.max_vertical_slope must be at least max_tilt_rad, or pairs of allowed tilts are dropped");
  require(parameters.max_rms_m > 0.0, "max_rms_m must be positive");
  require(parameters.min_spread_m > 0.0, "min_spread_m must be positive");
  require(parameters.min_sigma_m > 0.0, "min_sigma_m must be positive");
  require(parameters.same_place_m >= 0.0, "same_place_m must not be negative");
}

}  // namespace

Covariance6 TransformCovariance(const std::vector<Eigen::Vector3d>& points_target, double sigma_m) {
  Eigen::Vector3d centroid = Eigen::Vector3d::Zero();
  for (const Eigen::Vector3d& p : points_target) centroid += p / static_cast<double>(points_target.size());
  // A perturbation moves point p by tau + omega x (p - c), c the centroid: J^T J is block diagonal.
  Eigen::Matrix3d rotation_information = Eigen::Matrix3d::Zero();
  for (const Eigen::Vector3d& p : points_target) {
    const Eigen::Vector3d arm = p - centroid;
    rotation_information += arm.squaredNorm() * Eigen::Matrix3d::Identity() - arm * arm.transpose();
  }
  Covariance6 about_centroid = Covariance6::Zero();
  about_centroid.topLeftCorner<3, 3>() = Eigen::Matrix3d::Identity() / static_cast<double>(points_target.size());
  about_centroid.bottomRightCorner<3, 3>() = rotation_information.inverse();
  // The translation of the origin: rho = tau - omega x c = tau + [c]x omega.
  const Covariance6 to_origin = Adjoint(Pose(Eigen::Translation3d(centroid)));
  const Covariance6 covariance = sigma_m * sigma_m * to_origin * about_centroid * to_origin.transpose();
  return 0.5 * (covariance + covariance.transpose());
}

double CentroidSigma(double rms_m, std::size_t inliers, double min_sigma_m) {
  const double count = static_cast<double>(inliers);
  const double degrees_of_freedom = std::max(3.0 * count - 6.0, 1.0);
  return std::max(min_sigma_m, rms_m * std::sqrt(count / degrees_of_freedom));
}

Recognizer::Recognizer(const RecognizerParameters& parameters)
    : parameters_((Validate(parameters), parameters)), graph_builder_(parameters.consistency) {}

RecognizerResult Recognizer::Recognize(const Correspondences& correspondences) {
  RecognizerResult result;
  result.candidates = correspondences.size();

  const double graph_start_ms = ThreadCpuMs();
  // Also of few ones: the cache follows them.
  ConsistentPairs found = graph_builder_.FindPairs(correspondences, parameters_.clique.min_size);
  result.edges = found.pairs.size();
  result.tested_pairs = found.tested_pairs;
  Candidates candidates = CandidatesOf(correspondences, std::move(found.pairs));
  result.graph_ms = ThreadCpuMs() - graph_start_ms;
  if (correspondences.size() < parameters_.clique.min_size) return result;

  const double clique_start_ms = ThreadCpuMs();
  const MaxCliqueResult clique =
      FindMaxClique(candidates.graph, parameters_.clique, SmallerResidual(candidates.correspondences));
  result.clique_size = clique.vertices.size();
  result.clique_ms = ThreadCpuMs() - clique_start_ms;
  result.outcome = RecognitionOutcome::kCliqueTooSmall;
  if (clique.vertices.empty()) return result;

  const double transform_start_ms = ThreadCpuMs();
  Recognition recognition;
  result.outcome = FitAndTest(candidates.correspondences, clique.vertices, &recognition);
  recognition.proven_maximum = clique.proven_maximum;
  recognition.max_inliers = clique.upper_bound;
  result.transform_ms = ThreadCpuMs() - transform_start_ms;
  if (result.outcome != RecognitionOutcome::kAccepted) return result;

  if (parameters_.find_runner_up) {
    const double runner_up_start_ms = ThreadCpuMs();
    const std::size_t size = std::max<std::size_t>(3, (clique.vertices.size() + 1) / 2);
    // A smaller set may be among what was no candidate for the winner.
    if (size < parameters_.clique.min_size)
      candidates = CandidatesOf(correspondences, graph_builder_.FindPairs(correspondences, 2).pairs);
    const Vertices runner_up =
        FindRunnerUp(candidates, recognition, size, parameters_.same_place_m, parameters_.clique);
    recognition.runner_up_size = runner_up.size();
    Recognition other;
    if (!runner_up.empty() &&
        FitAndTest(candidates.correspondences, runner_up, &other) == RecognitionOutcome::kAccepted) {
      other.runner_up_size = clique.vertices.size();
      result.runner_up = std::move(other);
    }
    result.clique_ms += ThreadCpuMs() - runner_up_start_ms;
  }
  result.recognition = std::move(recognition);
  return result;
}

/// Fits the transform of a clique, and says whether the fit is good enough for a place.
RecognitionOutcome Recognizer::FitAndTest(const Correspondences& sorted, const std::vector<std::uint32_t>& clique,
                                          Recognition* recognition) const {
  const PointPairs pairs = PointPairsOf(sorted, clique);
  recognition->T_target_local = FitTransform(pairs);
  recognition->rms_m = RootMeanSquareResidual(pairs, recognition->T_target_local);
  recognition->tilt_rad = TiltOf(recognition->T_target_local);
  if (std::min(SecondSpread(pairs.local), SecondSpread(pairs.target)) < parameters_.min_spread_m)
    return RecognitionOutcome::kDegenerate;
  if (recognition->tilt_rad > parameters_.max_tilt_rad) return RecognitionOutcome::kTilted;
  if (recognition->rms_m > parameters_.max_rms_m) return RecognitionOutcome::kLargeResidual;

  std::vector<Eigen::Vector3d> moved;
  for (const std::uint32_t v : clique) {
    recognition->inliers.push_back(sorted[v]);
    moved.push_back(recognition->T_target_local * sorted[v].centroid_local);
  }
  recognition->covariance =
      TransformCovariance(moved, CentroidSigma(recognition->rms_m, moved.size(), parameters_.min_sigma_m));
  return RecognitionOutcome::kAccepted;
}

}  // namespace incremental_segmatch
