#include "incremental_segmatch/parameters.hpp"

#include <yaml-cpp/yaml.h>

#include <algorithm>
#include <array>
#include <charconv>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <functional>
#include <limits>
#include <numeric>
#include <set>
#include <sstream>
#include <stdexcept>
#include <type_traits>
#include <utility>

namespace incremental_segmatch {
namespace {

// ---- Values: text, numbers and names --------------------------------------------------------------------------------

constexpr double kInfinity = std::numeric_limits<double>::infinity();
constexpr double kPi = 3.14159265358979323846;

template <class Enum>
using EnumNames = std::vector<std::pair<Enum, const char*>>;

const EnumNames<GroundModel>& NamesOf(GroundModel) {
  static const EnumNames<GroundModel> names{{GroundModel::kNone, "none"},
                                            {GroundModel::kHeightThreshold, "height_threshold"},
                                            {GroundModel::kElevation, "elevation"}};
  return names;
}

const EnumNames<Segmentation>& NamesOf(Segmentation) {
  static const EnumNames<Segmentation> names{{Segmentation::kEuclidean, "euclidean"},
                                             {Segmentation::kSmoothness, "smoothness"}};
  return names;
}

const EnumNames<RoughnessMeasure>& NamesOf(RoughnessMeasure) {
  static const EnumNames<RoughnessMeasure> names{{RoughnessMeasure::kCurvature, "curvature"},
                                                 {RoughnessMeasure::kPlaneResidual, "plane_residual"}};
  return names;
}

const EnumNames<BoundaryPolicy>& NamesOf(BoundaryPolicy) {
  static const EnumNames<BoundaryPolicy> names{{BoundaryPolicy::kInvalidate, "invalidate"},
                                               {BoundaryPolicy::kKeep, "keep"}};
  return names;
}

const EnumNames<Mode>& NamesOf(Mode) {
  static const EnumNames<Mode> names{{Mode::kLoopClosure, "loop_closure"}, {Mode::kLocalization, "localization"}};
  return names;
}

const EnumNames<ConsistencyMethod>& NamesOf(ConsistencyMethod) {
  static const EnumNames<ConsistencyMethod> names{{ConsistencyMethod::kAllPairs, "all_pairs"},
                                                  {ConsistencyMethod::kPartitioned2D, "partitioned_2d"},
                                                  {ConsistencyMethod::kPartitioned3D, "partitioned_3d"},
                                                  {ConsistencyMethod::kCached, "cached"},
                                                  {ConsistencyMethod::kAuto, "auto"}};
  return names;
}

const EnumNames<Instructions>& NamesOf(Instructions) {
  static const EnumNames<Instructions> names{{Instructions::kPortable, "portable"},
                                             {Instructions::kAvx2, "avx2"},
                                             {Instructions::kAvx512, "avx512"}};
  return names;
}

template <class T>
struct IsArray : std::false_type {};
template <class T, std::size_t N>
struct IsArray<std::array<T, N>> : std::true_type {};

/// A short text that reads back as the same number.
std::string Format(double value) {
  if (std::isnan(value)) return ".nan";
  if (std::isinf(value)) return value > 0.0 ? ".inf" : "-.inf";
  char text[40];
  for (int digits = 6; digits <= 17; ++digits) {
    std::snprintf(text, sizeof text, "%.*g", digits, value);
    if (std::strtod(text, nullptr) == value) break;
  }
  return text;
}

template <class T>
std::string FormatValue(const T& value) {
  if constexpr (std::is_same_v<T, bool>) {
    return value ? "true" : "false";
  } else if constexpr (std::is_enum_v<T>) {
    for (const auto& [known, name] : NamesOf(T{}))
      if (known == value) return name;
    return "unknown";
  } else if constexpr (std::is_floating_point_v<T>) {
    return Format(value);
  } else if constexpr (std::is_integral_v<T>) {
    return std::to_string(value);
  } else if constexpr (IsArray<T>::value) {
    std::string text;
    for (const auto& element : value) text += (text.empty() ? "" : ", ") + FormatValue(element);
    return "[" + text + "]";
  } else {
    return std::to_string(value.count());
  }
}

[[noreturn]] void RefuseType(const std::string& wanted) {
  throw std::invalid_argument("must be " + wanted);
}

std::string ScalarOf(const YAML::Node& node, const char* wanted) {
  // yaml-cpp tags quoted scalars with "!": a quoted number is a word.
  if (!node.IsScalar() || node.Tag() == "!") RefuseType(wanted);
  return node.Scalar();
}

template <class Integer>
Integer ParseInteger(const YAML::Node& node) {
  const std::string text = ScalarOf(node, "a whole number");
  Integer value = 0;
  const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), value);
  if (error == std::errc::result_out_of_range || (std::is_unsigned_v<Integer> && text.front() == '-'))
    throw std::invalid_argument("is beyond the range of its type: " + text);
  if (error != std::errc() || end != text.data() + text.size()) RefuseType("a whole number");
  return value;
}

template <class T>
T ParseValue(const YAML::Node& node) {
  if constexpr (std::is_same_v<T, bool>) {
    const std::string text = ScalarOf(node, "true or false");
    if (text != "true" && text != "false") RefuseType("true or false");
    return text == "true";
  } else if constexpr (std::is_enum_v<T>) {
    std::string known;
    for (const auto& [value, name] : NamesOf(T{})) {
      if (node.IsScalar() && node.Scalar() == name) return value;
      known += (known.empty() ? "" : ", ") + std::string(name);
    }
    RefuseType("one of " + known);
  } else if constexpr (std::is_floating_point_v<T>) {
    double value = 0.0;
    ScalarOf(node, "a number");
    if (!YAML::convert<double>::decode(node, value)) RefuseType("a number");
    return value;
  } else if constexpr (std::is_integral_v<T>) {
    return ParseInteger<T>(node);
  } else if constexpr (IsArray<T>::value) {
    T values{};
    if (!node.IsSequence() || node.size() != values.size())
      RefuseType("a list of " + std::to_string(values.size()) + " numbers");
    for (std::size_t i = 0; i < values.size(); ++i) values[i] = ParseValue<typename T::value_type>(node[i]);
    return values;
  } else {
    return T(ParseInteger<typename T::rep>(node));
  }
}

// ---- Ranges ---------------------------------------------------------------------------------------------------------

/// The values that are allowed. Infinity counts only where it is an end itself; NaN never.
struct Interval {
  double low = -kInfinity;
  bool low_included = false;
  double high = kInfinity;
  bool high_included = false;

  bool Contains(double value) const {
    return (value > low || (low_included && value == low)) && (value < high || (high_included && value == high));
  }
  std::string Text() const {
    if (low == -kInfinity && high == kInfinity) return high_included ? "finite or .inf" : "finite";
    const std::string above = (low_included ? ">= " : "> ") + Format(low);
    if (high == kInfinity) return above + (high_included ? ", may be .inf" : "");
    const std::string below = (high_included ? "<= " : "< ") + Format(high);
    return low == -kInfinity ? below : above + ", " + below;
  }
};

Interval Finite() {
  return {};
}
Interval Above(double low) {
  return {low, false, kInfinity, false};
}
Interval AtLeast(double low) {
  return {low, true, kInfinity, false};
}
Interval Between(double low, double high) {
  return {low, true, high, true};
}
Interval Inside(double low, double high) {
  return {low, false, high, false};
}
Interval AboveUpTo(double low, double high) {
  return {low, false, high, true};
}
Interval OrInfinite(Interval interval) {
  interval.high_included = true;
  return interval;
}

template <class T>
bool IsInside(const Interval& interval, const T& value) {
  if constexpr (IsArray<T>::value) {
    return std::all_of(value.begin(), value.end(), [&](const auto& element) { return IsInside(interval, element); });
  } else if constexpr (std::is_arithmetic_v<T>) {
    return interval.Contains(static_cast<double>(value));
  } else {
    return interval.Contains(static_cast<double>(value.count()));
  }
}

// ---- The table ------------------------------------------------------------------------------------------------------

/// One parameter: its key, what to say of it, and how to get at its member.
struct Parameter {
  std::string key;
  std::string meaning;
  std::string range;
  std::function<void(const YAML::Node&, Parameters&)> read;  ///< throws std::invalid_argument with the reason alone
  std::function<std::string(const Parameters&)> write;
  std::function<bool(const Parameters&)> is_in_range;
};

/// A parameter of two choices or of names: its range is its type.
template <class Access>
Parameter Choice(const char* key, Access access, const char* meaning) {
  using T = std::decay_t<decltype(access(std::declval<Parameters&>()))>;
  std::string range;
  if constexpr (std::is_enum_v<T>) {
    for (const auto& [value, name] : NamesOf(T{})) range += (range.empty() ? "`" : ", `") + std::string(name) + "`";
  } else {
    range = "`true`, `false`";
  }
  return {key,
          meaning,
          range,
          [access](const YAML::Node& node, Parameters& p) { access(p) = ParseValue<T>(node); },
          [access](const Parameters& p) { return FormatValue(access(p)); },
          [](const Parameters&) { return true; }};
}

template <class Access>
Parameter Number(const char* key, Access access, const Interval& interval, const char* meaning) {
  using T = std::decay_t<decltype(access(std::declval<Parameters&>()))>;
  return {key,
          meaning,
          interval.Text(),
          [access](const YAML::Node& node, Parameters& p) { access(p) = ParseValue<T>(node); },
          [access](const Parameters& p) { return FormatValue(access(p)); },
          [access, interval](const Parameters& p) { return IsInside(interval, access(p)); }};
}

// The key of a parameter is the path to its member, so that it is written once. Where a type says the unit and a key
// must say it too, the key is given.
#define CHOICE(member, ...) \
  Choice(                   \
      #member, [](auto& p) -> auto& { return p.member; }, __VA_ARGS__)
#define NUMBER(member, ...) \
  Number(                   \
      #member, [](auto& p) -> auto& { return p.member; }, __VA_ARGS__)

const std::vector<Parameter>& Table() {
  static const std::vector<Parameter> table{
      NUMBER(front_end.local_radius_m, Above(0), "radius of the local map around the sensor, horizontally"),
      NUMBER(front_end.local_path_m, OrInfinite(Above(0)),
             "what was not seen for so much of path leaves the local map too: for small areas that the robot never gets out of"),
      CHOICE(front_end.segmentation,
             "how voxels are grouped: whatever hangs together, or smooth surfaces, for which normals are kept"),

      CHOICE(front_end.ground.model,
             "what goes as ground: nothing; what lies below a height in the sensor's frame; what lies less than a "
             "clearance "
             "above a ground surface that is estimated from the scan"),
      NUMBER(front_end.ground.min_height_m, Finite(), "`height_threshold`: lower points go; in the sensor's frame"),
      NUMBER(front_end.ground.sensor_height_m, Above(0), "`elevation`: height of the sensor over the ground below it"),
      NUMBER(front_end.ground.clearance_m, Above(0),
             "`elevation`: points lower than this above the ground go; must exceed `max_slope` * `cell_size_m`"),
      NUMBER(front_end.ground.cell_size_m, Above(0),
             "`elevation`: side of a cell of the elevation map; at least a thousandth of `max_range_m`"),
      NUMBER(front_end.ground.max_slope, Above(0), "`elevation`: rise over run that still is ground"),
      NUMBER(front_end.ground.min_range_m, AtLeast(0), "points nearer than this horizontally go: the robot itself"),
      NUMBER(front_end.ground.max_range_m, Above(0), "points farther away horizontally go; more than `min_range_m`"),
      NUMBER(front_end.ground.max_height_m, OrInfinite(Finite()), "points higher above the sensor go"),

      NUMBER(front_end.grid.resolution_m, Above(0), "side of a voxel"),
      NUMBER(front_end.grid.min_points_per_voxel, AtLeast(1), "a voxel goes downstream from this many points on"),
      NUMBER(front_end.grid.bits, Between(3, 23),
             "bits of the voxel index in x, y, z: the covered volume has 2^bits voxels along an axis"),
      NUMBER(front_end.grid.center_m, Finite(), "centre of the covered volume: x, y, z in the odometry frame"),

      NUMBER(front_end.segmenter.growing_radius_m, Above(0),
             "voxels whose centroids are this near belong together; at most 16 voxels"),
      NUMBER(front_end.segmenter.min_cluster_size, AtLeast(1), "in voxels; smaller clusters are no segments"),
      NUMBER(front_end.segmenter.max_cluster_size, AtLeast(1),
             "in voxels; larger clusters are no segments; at least `min_cluster_size`"),
      CHOICE(front_end.segmenter.boundary,
             "what becomes of a segment that the boundary of the local map cuts: it is none any more, or it stays one "
             "until it has "
             "left entirely"),

      NUMBER(front_end.normals.radius_m, Above(0), "`smoothness`: of a normal's neighbourhood; at most 8 voxels"),
      NUMBER(front_end.normals.renewal_tolerance_voxels, AtLeast(0),
             "`smoothness`: a voxel's contribution to normals is renewed once its centroid moved so far, in voxels"),

      NUMBER(front_end.smoothness.max_angle_rad, Inside(0, 0.5 * kPi),
             "`smoothness`: between the normals of neighbours in a segment"),
      CHOICE(front_end.smoothness.measure,
             "`smoothness`: what makes a voxel too rough to grow from: the thickness of its neighbourhood for its "
             "width, or its distance from a plane"),
      NUMBER(front_end.smoothness.max_curvature, Above(0), "`curvature`: rougher voxels do not seed"),
      NUMBER(front_end.smoothness.max_residual_m, Above(0), "`plane_residual`: rougher voxels do not seed"),

      CHOICE(front_end.descriptor.eigenvalues, "the seven eigenvalue features: linearity, planarity, scattering, ..."),
      CHOICE(front_end.descriptor.sizes,
             "logarithms of the sizes along the principal axes and gravity, and of the count"),
      CHOICE(front_end.descriptor.orientation, "how upright the principal axes are"),
      CHOICE(front_end.descriptor.context, "what stands around the segment: heights of the others, by distance"),
      NUMBER(front_end.descriptor.context_radius_m, Above(0), "`context`: of these surroundings"),

      NUMBER(front_end.view.growth_factor, Above(1),
             "a segment gets a new view once it has grown by this factor since its last"),
      NUMBER(front_end.view.baseline_m, Above(0),
             "or once it changed and the sensor is this far from where its last view was taken"),
      NUMBER(front_end.view.shown_points, AtLeast(0),
             "points of a view that are kept, for people to look at (recognitions are refined on scans); 0: none"),

      NUMBER(front_end.thinning.cell_size_m, Above(0),
             "of each scan one point of every cubic cell of this side goes along, for refinement"),
      NUMBER(front_end.thinning.min_range_m, AtLeast(0), "points nearer than this horizontally don't"),
      NUMBER(front_end.thinning.max_range_m, Above(0), "nor those farther away; more than `min_range_m`"),
      NUMBER(front_end.thinning.max_points, AtLeast(1), "so many points of a scan are looked at"),

      CHOICE(front_end.trails.enabled, "segments that are trails of moving objects are dropped"),
      NUMBER(front_end.trails.interval_s, Above(0),
             "a voxel is looked at once more, so long after it came, or up to twice as long"),
      NUMBER(front_end.trails.min_range_m, AtLeast(0), "nearer voxels wait: a thinned scan has gaps there"),
      NUMBER(front_end.trails.tolerance_m, Above(0),
             "a return so near to a voxel confirms it; one farther by twice as much sees through it"),
      NUMBER(front_end.trails.min_voxels, AtLeast(1), "a segment is judged by at least so many of its voxels"),
      NUMBER(front_end.trails.min_share, AboveUpTo(0, 1),
             "of them seen through, from which on a segment is a trail"),

      CHOICE(back_end.mode,
             "the target map is what the robots of this run have seen so far; or it is loaded and fixed"),

      NUMBER(back_end.matching.nearest, AtLeast(0),
             "candidates of a local segment: this many targets with the most similar descriptors; 0: no limit"),
      NUMBER(back_end.matching.max_distance, AtLeast(0),
             "and within this distance of scaled descriptors; 0: no limit; one of both limits is needed"),
      NUMBER(back_end.matching.time_window_s, AtLeast(0),
             "views of segments that a robot took more recently are no targets of its own (loop closure)"),
      NUMBER(back_end.matching.min_path_m, AtLeast(0), "nor are those taken less than this much of path ago"),
      NUMBER(back_end.matching.requery_distance, AtLeast(0),
             "a segment is matched anew once its scaled descriptor moved so far"),

      NUMBER(back_end.recognizer.max_tilt_rad, Between(0, kPi),
             "between the two gravity-aligned maps; refuses mirrored fits"),
      NUMBER(back_end.recognizer.max_rms_m, Above(0), "residual of the fit over all inliers"),
      NUMBER(back_end.recognizer.min_spread_m, Above(0),
             "second largest standard deviation of the inlier centroids; refuses lines"),
      NUMBER(back_end.recognizer.min_sigma_m, Above(0),
             "floor of a centroid's standard deviation per axis in the covariance"),
      CHOICE(back_end.recognizer.find_runner_up,
             "also look for the best clique beside the winner: evidence against ambiguity"),
      NUMBER(back_end.recognizer.same_place_m, AtLeast(0),
             "correspondences that fit the recognised transform so well are no rivals of it"),

      NUMBER(back_end.recognizer.consistency.epsilon_m, Above(0),
             "by how much the distance of two segments may differ between the maps"),
      CHOICE(back_end.recognizer.consistency.method,
             "how the pairs to be tested are found; all give the same edges, `auto` takes what measured fastest"),
      NUMBER(
          back_end.recognizer.consistency.cache_theta_m, Above(0),
          "`cached`, `auto`: candidates are sought this much farther out, and kept until a centroid moved half of it"),
      NUMBER(back_end.recognizer.consistency.max_vertical_slope, OrInfinite(AtLeast(0)),
             "by how much the height difference of two segments may differ, over their distance and beyond epsilon; at "
             "least "
             "`max_tilt_rad`"),
      CHOICE(back_end.recognizer.consistency.instructions,
             "the best ones used, on processors that have them; the edges are the same with all"),

      NUMBER(back_end.recognizer.clique.min_size, AtLeast(3), "fewer consistent pairs of segments are no recognition"),
      NUMBER(back_end.recognizer.clique.max_work, AtLeast(1),
             "effort of a search, in 64-bit words and neighbours looked at, after which the largest set found so far is taken: a "
             "count, so that results repeat"),
      Number(
          "back_end.recognizer.clique.deadline_us",
          [](auto& p) -> auto& { return p.back_end.recognizer.clique.deadline; }, AtLeast(1),
          "the same as a time, for machines on which that effort takes longer"),
      NUMBER(back_end.recognizer.clique.max_ties, AtLeast(1), "how many maximum sets are compared at most"),
      NUMBER(back_end.recognizer.clique.max_tie_work, AtLeast(0),
             "effort of looking for further maximum sets, counted likewise"),

      NUMBER(back_end.keyframes.spacing_m, Above(0), "path between key frames, whose scans are kept"),
      NUMBER(back_end.keyframes.submap_radius_m, AtLeast(0),
             "a recognition is refined on the scans of the key frame nearest to it and of those so near to that one"),

      NUMBER(back_end.keyframes.reach_m, Above(0),
             "path between the key frame of a closure and the poses that matched segments were seen from, at most"),

      NUMBER(back_end.merging.distance_m, AtLeast(0),
             "after a correction, segments of different visits whose centroids are this near become one; 0: none do"),
      NUMBER(back_end.merging.descriptor_distance, AtLeast(0), "if their scaled descriptors differ by at most so much"),

      NUMBER(back_end.forgetting.missed_visits, AtLeast(0),
             "a segment that was not seen on so many visits in a row leaves the map; 0: none do"),
      NUMBER(back_end.forgetting.min_views, AtLeast(0),
             "what a visit adds to a known place leaves the map after it, if fewer views of it were kept than these, and than "
             "max_views; 0 or 1: nothing does"),

      NUMBER(back_end.history.length_m, AtLeast(0), "so much of path behind the robot speaks for or against a place"),
      NUMBER(back_end.history.spacing_m, Above(0), "path between the scans of it that are kept"),
      NUMBER(back_end.history.max_distance_m, Above(0), "they are held against key frames this near"),
      NUMBER(back_end.history.drift, AtLeast(0), "metres by which odometry may have drifted per metre of path"),

      NUMBER(back_end.free_space.min_height_m, Finite(),
             "lower points are not held against scans: cars come and go; in the sensor's frame"),
      NUMBER(back_end.free_space.max_range_m, Above(0), "nor are those farther from the sensor"),
      NUMBER(back_end.free_space.tolerance_m, Above(0),
             "a return this near to a point confirms it; where all are farther by twice as much, it is seen through"),

      CHOICE(back_end.refinement.enabled,
             "refine a recognition on the scans of both visits, and refuse it if that fails"),
      NUMBER(back_end.refinement.max_distance_m, Above(0),
             "of a point to its partner, in the first iteration; at least `min_distance_m`"),
      NUMBER(back_end.refinement.min_distance_m, Above(0), "the same in the last iteration"),
      NUMBER(back_end.refinement.search_m, AtLeast(0),
             "so far around, along x and y, a better place to begin is looked for; 0: nowhere"),
      NUMBER(back_end.refinement.search_overlap, Between(0, 1), "where the first attempt ends with less overlap than this"),
      NUMBER(back_end.refinement.max_iterations, AtLeast(1), "then the refinement ends as it is"),
      NUMBER(back_end.refinement.min_overlap, Between(0, 1),
             "share of the local points with a partner at the end; less refuses the recognition"),
      NUMBER(back_end.refinement.normal_radius_m, Above(0),
             "of the neighbourhood that tells which way a target point's surface faces"),
      NUMBER(back_end.refinement.max_points, AtLeast(30), "local points that are used"),
      NUMBER(back_end.refinement.min_stiffness, Inside(0, 1),
             "information of a direction over that of the best one, below which the points leave it open"),
      NUMBER(back_end.refinement.floor_m, AtLeast(0), "standard deviation of what the points don't tell, along each axis"),
      NUMBER(back_end.refinement.floor_rad, AtLeast(0), "and about each axis"),
      NUMBER(back_end.refinement.max_open_directions, Between(0, 5),
             "of six; more refuses the recognition; walls and poles alone leave the height open"),

      NUMBER(back_end.acceptance.support_distance_m, Above(0),
             "a local segment is supported by a target segment this near, under the recognised transform"),
      NUMBER(back_end.acceptance.neighbourhood_m, Above(0),
             "and is expected to be, where any target segment is this near; at least `support_distance_m`"),
      NUMBER(back_end.acceptance.min_coverage, Between(0, 1),
             "least share of the expected local segments that are supported"),
      NUMBER(back_end.acceptance.min_ratio, AtLeast(0),
             "the best clique that speaks for another place must be so many times smaller"),
      NUMBER(back_end.acceptance.twin_size, AtLeast(1),
             "a rival so large shows that there are twins"),
      NUMBER(back_end.acceptance.twin_memory_m, AtLeast(0),
             "for so much of path after twins, and where there is a rival now, the next three are demanded as well"),
      NUMBER(back_end.acceptance.min_track_m, AtLeast(0),
             "near twins: path over which recognitions agree with each other by odometry"),
      NUMBER(back_end.acceptance.min_track_fit, Between(0, 1),
             "near twins: mean overlap of scans with the map's along that path, over that of the map's with each other"),
      NUMBER(back_end.acceptance.min_distinction, Between(0, 1),
             "beside a rival: of the scan's points that fit only one of the two places, share that fits the recognised one"),
      NUMBER(back_end.acceptance.max_distance_m, Above(0),
             "of the query from the pose its target was seen from: odometry drifts in between"),
      NUMBER(back_end.acceptance.max_contradiction, Between(0, 1),
             "share of what the map has along the way to the place that the robot's scans see through"),
      NUMBER(back_end.acceptance.max_contradiction_once, Between(0, 1), "the same of any single scan"),
      NUMBER(back_end.acceptance.max_sigma_m, Above(0), "largest standard deviation of the query's position"),
      NUMBER(back_end.acceptance.max_sigma_rad, Above(0), "the same of its orientation"),

      NUMBER(back_end.target_map.max_views, AtLeast(1),
             "views kept of a segment: the newest, and the largest of the others"),
  };
  return table;
}

#undef CHOICE
#undef NUMBER

/// What must hold between parameters.
struct Relation {
  const char* key;
  const char* demand;
  bool (*holds)(const Parameters&);
};

const std::vector<Relation>& Relations() {
  static const std::vector<Relation> relations{
      {"front_end.ground.max_range_m", "must be more than min_range_m",
       [](const Parameters& p) { return p.front_end.ground.max_range_m > p.front_end.ground.min_range_m; }},
      {"front_end.ground.clearance_m", "must exceed max_slope * cell_size_m, or slopes pass for obstacles",
       [](const Parameters& p) {
         const GroundFilterParameters& ground = p.front_end.ground;
         return ground.model != GroundModel::kElevation || ground.clearance_m > ground.max_slope * ground.cell_size_m;
       }},
      {"front_end.ground.cell_size_m", "must be at least a thousandth of max_range_m",
       [](const Parameters& p) {
         const GroundFilterParameters& ground = p.front_end.ground;
         return ground.model != GroundModel::kElevation || std::ceil(ground.max_range_m / ground.cell_size_m) <= 1000.0;
       }},
      {"front_end.thinning.max_range_m", "must be more than min_range_m",
       [](const Parameters& p) { return p.front_end.thinning.max_range_m > p.front_end.thinning.min_range_m; }},
      {"front_end.segmenter.growing_radius_m", "must be at most 16 * grid.resolution_m",
       [](const Parameters& p) {
         return p.front_end.segmenter.growing_radius_m <= 16.0 * p.front_end.grid.resolution_m;
       }},
      {"front_end.normals.radius_m", "must be at most 8 * grid.resolution_m",
       [](const Parameters& p) { return p.front_end.normals.radius_m <= 8.0 * p.front_end.grid.resolution_m; }},
      {"front_end.segmenter.max_cluster_size", "must be at least min_cluster_size",
       [](const Parameters& p) {
         return p.front_end.segmenter.max_cluster_size >= p.front_end.segmenter.min_cluster_size;
       }},
      {"front_end.descriptor", "must have one of eigenvalues, sizes, orientation and context switched on",
       [](const Parameters& p) {
         const DescriptorParameters& descriptor = p.front_end.descriptor;
         return descriptor.eigenvalues || descriptor.sizes || descriptor.orientation || descriptor.context;
       }},
      {"back_end.matching", "must limit nearest, max_distance or both; without either every segment matches all",
       [](const Parameters& p) { return p.back_end.matching.nearest > 0 || p.back_end.matching.max_distance > 0.0; }},
      {"back_end.recognizer.consistency.max_vertical_slope",
       "must be at least recognizer.max_tilt_rad, or pairs of allowed tilts are dropped",
       [](const Parameters& p) {
         return p.back_end.recognizer.consistency.max_vertical_slope >= p.back_end.recognizer.max_tilt_rad;
       }},
      {"back_end.refinement.max_distance_m", "must be at least min_distance_m",
       [](const Parameters& p) {
         return p.back_end.refinement.max_distance_m >= p.back_end.refinement.min_distance_m;
       }},
      {"back_end.acceptance.neighbourhood_m", "must be at least support_distance_m",
       [](const Parameters& p) {
         return p.back_end.acceptance.neighbourhood_m >= p.back_end.acceptance.support_distance_m;
       }},
  };
  return relations;
}

// ---- Keys -----------------------------------------------------------------------------------------------------------

std::string SectionOf(const std::string& key) {
  return key.substr(0, key.rfind('.'));
}
std::string LeafOf(const std::string& key) {
  return key.substr(key.rfind('.') + 1);
}

bool IsSection(const std::string& path) {
  return std::any_of(Table().begin(), Table().end(),
                     [&](const Parameter& parameter) { return parameter.key.rfind(path + '.', 0) == 0; });
}

const Parameter* FindParameter(const std::string& key) {
  const auto it =
      std::find_if(Table().begin(), Table().end(), [&](const Parameter& parameter) { return parameter.key == key; });
  return it == Table().end() ? nullptr : &*it;
}

/// Insertions, deletions and substitutions of letters that make one word of the other.
std::size_t EditDistance(const std::string& a, const std::string& b) {
  std::vector<std::size_t> row(b.size() + 1);
  std::iota(row.begin(), row.end(), std::size_t{0});
  for (std::size_t i = 1; i <= a.size(); ++i) {
    std::size_t diagonal = row[0];
    row[0] = i;
    for (std::size_t j = 1; j <= b.size(); ++j) {
      const std::size_t substitution = diagonal + (a[i - 1] == b[j - 1] ? 0 : 1);
      diagonal = row[j];
      row[j] = std::min({row[j] + 1, row[j - 1] + 1, substitution});
    }
  }
  return row.back();
}

/// The known key that was most likely meant: spelled alike, or with the same last word in another section.
std::string Suggest(const std::string& unknown) {
  std::set<std::string> known;
  for (const Parameter& parameter : Table()) {
    known.insert(parameter.key);
    for (std::string section = SectionOf(parameter.key);
         known.insert(section).second && section.find('.') != std::string::npos;)
      section = SectionOf(section);
  }
  std::string best;
  std::pair<std::size_t, std::size_t> best_distance{std::numeric_limits<std::size_t>::max(), 0};
  for (const std::string& key : known) {
    const std::size_t whole = EditDistance(unknown, key);
    const std::size_t leaf = 1 + EditDistance(LeafOf(unknown), LeafOf(key));
    const std::pair<std::size_t, std::size_t> distance{std::min(whole, leaf), whole};
    if (distance >= best_distance) continue;
    best_distance = distance;
    best = key;
  }
  return best;
}

// ---- Reading --------------------------------------------------------------------------------------------------------

[[noreturn]] void RefuseNode(const std::string& origin, const YAML::Node& node, const std::string& key,
                             const std::string& reason) {
  const int line = node.Mark().line + 1;
  throw std::invalid_argument(origin + (line > 0 ? ":" + std::to_string(line) : "") + ": " + key + ": " + reason);
}

void ReadSection(const YAML::Node& section, const std::string& path, const std::string& origin,
                 Parameters* parameters) {
  std::set<std::string> seen;
  for (const auto& entry : section) {
    const std::string name = entry.first.IsScalar() ? entry.first.Scalar() : "(not a word)";
    const std::string key = path.empty() ? name : path + '.' + name;
    if (!seen.insert(name).second) RefuseNode(origin, entry.first, key, "is given twice");
    if (IsSection(key)) {
      // An empty section is one whose values are all commented out.
      if (!entry.second.IsMap() && !entry.second.IsNull())
        RefuseNode(origin, entry.second, key, "must hold keys and values");
      ReadSection(entry.second, key, origin, parameters);
      continue;
    }
    const Parameter* parameter = FindParameter(key);
    if (parameter == nullptr)
      RefuseNode(origin, entry.first, key, "is no parameter; did you mean " + Suggest(key) + "?");
    try {
      parameter->read(entry.second, *parameters);
    } catch (const std::invalid_argument& error) {
      RefuseNode(origin, entry.second, key, error.what());
    }
    if (!parameter->is_in_range(*parameters))
      RefuseNode(origin, entry.second, key, "must be " + parameter->range + ", is " + parameter->write(*parameters));
  }
}

}  // namespace

void Validate(const Parameters& parameters) {
  for (const Parameter& parameter : Table()) {
    if (parameter.is_in_range(parameters)) continue;
    throw std::invalid_argument(parameter.key + ": must be " + parameter.range + ", is " + parameter.write(parameters));
  }
  for (const Relation& relation : Relations())
    if (!relation.holds(parameters)) throw std::invalid_argument(std::string(relation.key) + ": " + relation.demand);
}

Parameters ParseParameters(const std::string& yaml, const std::string& origin) {
  std::vector<YAML::Node> documents;
  try {
    documents = YAML::LoadAll(yaml);
  } catch (const YAML::Exception& error) {
    throw std::runtime_error(origin + ":" + std::to_string(error.mark.line + 1) + ": is not YAML: " + error.msg);
  }
  Parameters parameters;
  if (documents.size() > 1) throw std::runtime_error(origin + ": holds several YAML documents; one is expected");
  if (!documents.empty() && !documents[0].IsNull()) {
    if (!documents[0].IsMap()) throw std::invalid_argument(origin + ": must hold keys and values");
    ReadSection(documents[0], "", origin, &parameters);
  }
  try {
    Validate(parameters);
  } catch (const std::invalid_argument& error) {
    throw std::invalid_argument(origin + ": " + error.what());
  }
  return parameters;
}

Parameters LoadParameters(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  std::stringstream text;
  // A folder opens, but can't be read.
  if (!file || (file.peek() != std::ifstream::traits_type::eof() && !(text << file.rdbuf())) || file.bad())
    throw std::runtime_error("can't read " + path + ": is it there, a file, and readable?");
  return ParseParameters(text.str(), path);
}

std::string ToYaml(const Parameters& parameters) {
  std::string text;
  std::set<std::string> opened;
  for (const Parameter& parameter : Table()) {
    std::size_t depth = 0;
    for (std::size_t dot = parameter.key.find('.'); dot != std::string::npos; dot = parameter.key.find('.', dot + 1)) {
      const std::string section = parameter.key.substr(0, dot);
      if (opened.insert(section).second) text += std::string(2 * depth, ' ') + LeafOf(section) + ":\n";
      ++depth;
    }
    text += std::string(2 * depth, ' ') + LeafOf(parameter.key) + ": " + parameter.write(parameters) + "\n";
  }
  return text;
}

std::string ParametersAsMarkdown() {
  const Parameters defaults;
  std::string text =
      "# Parameters\n"
      "\n"
      "Written from the table in `src/parameters.cpp`: `SEGMATCH_WRITE_DOCS=1 parameters_test` renews it, and the test "
      "fails where it\n"
      "is out of date. A YAML file holds any of these keys, nested by section; what it leaves out has its default. An "
      "unknown or\n"
      "repeated key, a wrong type and a value out of range are refused by name. Suffixes tell units: `_m` metres, "
      "`_rad` radians,\n"
      "`_s` seconds, `_us` microseconds.\n";
  std::string section;
  for (const Parameter& parameter : Table()) {
    if (SectionOf(parameter.key) != section) {
      section = SectionOf(parameter.key);
      text += "\n## `" + section + "`\n\n| key | default | range | meaning |\n|---|---|---|---|\n";
    }
    text += "| `" + LeafOf(parameter.key) + "` | `" + parameter.write(defaults) + "` | " + parameter.range + " | " +
            parameter.meaning + " |\n";
  }
  return text;
}

std::vector<std::string> ParameterKeys() {
  std::vector<std::string> keys;
  for (const Parameter& parameter : Table()) keys.push_back(parameter.key);
  return keys;
}

}  // namespace incremental_segmatch
