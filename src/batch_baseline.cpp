#include "incremental_segmatch/batch_baseline.hpp"

#include <pcl/features/normal_3d.h>
#include <pcl/filters/voxel_grid.h>
#include <pcl/point_cloud.h>
#include <pcl/point_types.h>
#include <pcl/recognition/cg/geometric_consistency.h>
#include <pcl/search/kdtree.h>
#include <pcl/segmentation/extract_clusters.h>
#include <pcl/segmentation/region_growing.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>
#include <string>
#include <utility>

#include "incremental_segmatch/segment_moments.hpp"

namespace incremental_segmatch {
namespace {

using Cloud = pcl::PointCloud<pcl::PointXYZ>;
using NormalCloud = pcl::PointCloud<pcl::Normal>;

/// PCL's stages each hand their tree the cloud, which would build it anew; this one is built once.
class SharedTree : public pcl::search::KdTree<pcl::PointXYZ> {
 public:
  explicit SharedTree(const Cloud::ConstPtr& cloud) : pcl::search::KdTree<pcl::PointXYZ>(false) {  // nobody needs it sorted
    pcl::search::KdTree<pcl::PointXYZ>::setInputCloud(cloud);
  }
  void setInputCloud(const PointCloudConstPtr& cloud, const IndicesConstPtr& indices) override {
    if (cloud != input_) throw std::logic_error("the shared tree was not built over this cloud");
    indices_ = indices;  // the stages pass all indices in order, and compare their number
  }
};

BatchClusters ToClusters(std::vector<pcl::PointIndices>* found) {
  BatchClusters clusters;
  clusters.reserve(found->size());
  for (pcl::PointIndices& cluster : *found) clusters.push_back(std::move(cluster.indices));
  return clusters;
}

void RequirePositive(const char* name, double value) {
  if (!(value > 0.0)) throw std::invalid_argument(std::string(name) + ": must be positive, is " + std::to_string(value));
}

}  // namespace

class BatchBaseline::Impl {
 public:
  explicit Impl(const BatchBaselineParameters& parameters)
      : parameters_(parameters), describer_(parameters.descriptor, parameters.resolution_m) {
    RequirePositive("batch.local_radius_m", parameters.local_radius_m);
    RequirePositive("batch.resolution_m", parameters.resolution_m);
    RequirePositive("batch.min_points_per_voxel", parameters.min_points_per_voxel);
    RequirePositive("batch.growing_radius_m", parameters.growing_radius_m);
    RequirePositive("batch.normal_radius_m", parameters.normal_radius_m);
    RequirePositive("batch.region_neighbours", parameters.region_neighbours);
    RequirePositive("batch.smoothness.max_angle_rad", parameters.smoothness.max_angle_rad);
    RequirePositive("batch.epsilon_m", parameters.epsilon_m);
    if (parameters.min_consistent < 3) throw std::invalid_argument("batch.min_consistent: must be at least 3");
  }

  void UpdateLocalCloud(const Points& obstacles_sensor, const Pose& T_odom_sensor) {
    sensor_odom_ = T_odom_sensor.translation();
    const float x = static_cast<float>(sensor_odom_.x()), y = static_cast<float>(sensor_odom_.y());
    const float radius2 = static_cast<float>(parameters_.local_radius_m * parameters_.local_radius_m);
    const auto outside = [&](const pcl::PointXYZ& p) { return (p.x - x) * (p.x - x) + (p.y - y) * (p.y - y) > radius2; };
    auto& points = cloud_->points;
    points.erase(std::remove_if(points.begin(), points.end(), outside), points.end());

    const Eigen::Isometry3f T = T_odom_sensor.cast<float>();
    points.reserve(points.size() + obstacles_sensor.size());
    for (const Eigen::Vector3f& p_sensor : obstacles_sensor) {
      const Eigen::Vector3f p = T * p_sensor;
      points.emplace_back(p.x(), p.y(), p.z());
    }
    cloud_->width = static_cast<std::uint32_t>(points.size());
    cloud_->height = 1;

    pcl::VoxelGrid<pcl::PointXYZ> filter;
    const float leaf = static_cast<float>(parameters_.resolution_m);
    filter.setLeafSize(leaf, leaf, leaf);
    filter.setMinimumPointsNumberPerVoxel(static_cast<unsigned>(parameters_.min_points_per_voxel));
    filter.setInputCloud(cloud_);
    Cloud::Ptr filtered(new Cloud);
    filter.filter(*filtered);
    SetCloud(std::move(filtered));
  }

  void SetLocalCloud(const Points& centroids_odom, const Eigen::Vector3d& sensor_odom) {
    sensor_odom_ = sensor_odom;
    Cloud::Ptr cloud(new Cloud);
    cloud->reserve(centroids_odom.size());
    for (const Eigen::Vector3f& p : centroids_odom) cloud->emplace_back(p.x(), p.y(), p.z());
    SetCloud(std::move(cloud));
  }

  void BuildTree() {
    if (!cloud_->empty()) tree_.reset(new SharedTree(cloud_));
  }

  void EstimateNormals() {
    normals_->clear();
    if (cloud_->empty()) return;
    pcl::NormalEstimation<pcl::PointXYZ, pcl::Normal> estimation;
    estimation.setInputCloud(cloud_);
    estimation.setSearchMethod(Tree());
    estimation.setRadiusSearch(parameters_.normal_radius_m);
    estimation.setViewPoint(static_cast<float>(sensor_odom_.x()), static_cast<float>(sensor_odom_.y()),
                            static_cast<float>(sensor_odom_.z()));
    estimation.compute(*normals_);
  }

  BatchClusters ClusterEuclidean() {
    if (cloud_->empty()) return {};
    pcl::EuclideanClusterExtraction<pcl::PointXYZ> extraction;
    extraction.setClusterTolerance(parameters_.growing_radius_m);
    extraction.setMinClusterSize(static_cast<int>(parameters_.min_cluster_size));
    extraction.setMaxClusterSize(static_cast<int>(parameters_.max_cluster_size));
    extraction.setSearchMethod(Tree());
    extraction.setInputCloud(cloud_);
    std::vector<pcl::PointIndices> found;
    extraction.extract(found);
    return ToClusters(&found);
  }

  BatchClusters GrowSmoothRegions() {
    if (normals_->size() != cloud_->size()) throw std::logic_error("normals are needed before regions can be grown");
    if (cloud_->empty()) return {};
    // pcl::RegionGrowing takes a NaN for a perfect fit, and can't sort by it: points without a normal stay alone.
    const NormalCloud::Ptr normals(new NormalCloud(*normals_));
    for (pcl::Normal& normal : *normals)
      if (!(normal.curvature >= 0.f)) normal = pcl::Normal(0.f, 0.f, 0.f, std::numeric_limits<float>::max());
    pcl::RegionGrowing<pcl::PointXYZ, pcl::Normal> growing;
    growing.setMinClusterSize(static_cast<int>(parameters_.min_cluster_size));
    growing.setMaxClusterSize(static_cast<int>(parameters_.max_cluster_size));
    growing.setSearchMethod(Tree());
    growing.setNumberOfNeighbours(static_cast<unsigned>(parameters_.region_neighbours));
    growing.setInputCloud(cloud_);
    growing.setInputNormals(normals);
    const SmoothnessParameters& smoothness = parameters_.smoothness;
    growing.setSmoothnessThreshold(static_cast<float>(smoothness.max_angle_rad));
    growing.setCurvatureTestFlag(smoothness.measure == RoughnessMeasure::kCurvature);
    growing.setCurvatureThreshold(static_cast<float>(smoothness.max_curvature));
    growing.setResidualTestFlag(smoothness.measure == RoughnessMeasure::kPlaneResidual);
    growing.setResidualThreshold(static_cast<float>(smoothness.max_residual_m));
    std::vector<pcl::PointIndices> found;
    growing.extract(found);
    return ToClusters(&found);
  }

  std::optional<BatchRecognition> Recognize(const Correspondences& correspondences) const {
    if (correspondences.size() < parameters_.min_consistent) return std::nullopt;
    const Cloud::Ptr local(new Cloud);
    const Cloud::Ptr target(new Cloud);
    const pcl::CorrespondencesPtr pairs(new pcl::Correspondences);
    for (const Correspondence& c : correspondences) {
      const int index = static_cast<int>(pairs->size());
      const Eigen::Vector3f l = c.centroid_local.cast<float>(), t = c.centroid_target.cast<float>();
      local->emplace_back(l.x(), l.y(), l.z());
      target->emplace_back(t.x(), t.y(), t.z());
      pairs->emplace_back(index, index, c.descriptor_distance);
    }
    pcl::GeometricConsistencyGrouping<pcl::PointXYZ, pcl::PointXYZ> grouping;
    grouping.setGCSize(parameters_.epsilon_m);
    grouping.setGCThreshold(static_cast<int>(parameters_.min_consistent) - 1);  // it wants more than that
    grouping.setInputCloud(local);
    grouping.setSceneCloud(target);
    grouping.setModelSceneCorrespondences(pairs);
    std::vector<Eigen::Matrix4f, Eigen::aligned_allocator<Eigen::Matrix4f>> transforms;
    std::vector<pcl::Correspondences> groups;
    grouping.recognize(transforms, groups);

    const auto largest = std::max_element(groups.begin(), groups.end(),
                                          [](const auto& a, const auto& b) { return a.size() < b.size(); });
    if (largest == groups.end() || largest->size() < parameters_.min_consistent) return std::nullopt;
    BatchRecognition recognition;
    recognition.T_target_local.matrix() = transforms[static_cast<std::size_t>(largest - groups.begin())].cast<double>();
    for (const pcl::Correspondence& pair : *largest)
      recognition.inliers.push_back(correspondences[static_cast<std::size_t>(pair.index_query)]);
    return recognition;
  }

  std::vector<BatchSegment> Describe(BatchClusters clusters) const {
    std::vector<SegmentMoments> moments(clusters.size());
    Surroundings surroundings;
    for (std::size_t i = 0; i < clusters.size(); ++i) {
      for (const std::int32_t index : clusters[i]) moments[i].Add((*cloud_)[index].getVector3fMap().cast<double>());
      surroundings.push_back(&moments[i]);
    }
    std::vector<BatchSegment> segments;
    segments.reserve(clusters.size());
    for (std::size_t i = 0; i < clusters.size(); ++i) {
      Descriptor descriptor = describer_.Describe(moments[i], Eigen::Vector3d::UnitZ(), surroundings);
      segments.push_back({std::move(clusters[i]), moments[i].Centroid(), std::move(descriptor)});
    }
    return segments;
  }

  const BatchBaselineParameters& parameters() const { return parameters_; }
  const Cloud& cloud() const { return *cloud_; }
  const NormalCloud& normals() const { return *normals_; }

 private:
  void SetCloud(Cloud::Ptr cloud) {
    cloud_ = std::move(cloud);
    normals_->clear();
    tree_.reset();
  }
  const pcl::search::KdTree<pcl::PointXYZ>::Ptr& Tree() {
    if (!tree_) BuildTree();
    return tree_;
  }

  BatchBaselineParameters parameters_;
  Describer describer_;
  Eigen::Vector3d sensor_odom_ = Eigen::Vector3d::Zero();
  Cloud::Ptr cloud_{new Cloud};
  NormalCloud::Ptr normals_{new NormalCloud};
  pcl::search::KdTree<pcl::PointXYZ>::Ptr tree_;  // of cloud_, if it was built
};

BatchBaseline::BatchBaseline(const BatchBaselineParameters& parameters) : impl_(std::make_unique<Impl>(parameters)) {}
BatchBaseline::~BatchBaseline() = default;
BatchBaseline::BatchBaseline(BatchBaseline&&) noexcept = default;
BatchBaseline& BatchBaseline::operator=(BatchBaseline&&) noexcept = default;

const BatchBaselineParameters& BatchBaseline::parameters() const { return impl_->parameters(); }

BatchStep BatchBaseline::Process(const Points& obstacles_sensor, const Pose& T_odom_sensor) {
  BatchStep step;
  StageTimer timer;
  UpdateLocalCloud(obstacles_sensor, T_odom_sensor);
  timer.Lap("voxel_grid");
  BuildTree();
  timer.Lap("tree");
  BatchClusters clusters;
  if (impl_->parameters().segmentation == Segmentation::kSmoothness) {
    EstimateNormals();
    timer.Lap("normals");
    clusters = GrowSmoothRegions();
  } else {
    clusters = ClusterEuclidean();
  }
  timer.Lap("segmentation");
  step.segments = impl_->Describe(std::move(clusters));
  timer.Lap("description");
  step.voxels = size();
  step.times = timer.Take();
  return step;
}

void BatchBaseline::UpdateLocalCloud(const Points& obstacles_sensor, const Pose& T_odom_sensor) {
  impl_->UpdateLocalCloud(obstacles_sensor, T_odom_sensor);
}
void BatchBaseline::BuildTree() { impl_->BuildTree(); }
void BatchBaseline::EstimateNormals() { impl_->EstimateNormals(); }
BatchClusters BatchBaseline::ClusterEuclidean() { return impl_->ClusterEuclidean(); }
BatchClusters BatchBaseline::GrowSmoothRegions() { return impl_->GrowSmoothRegions(); }
std::optional<BatchRecognition> BatchBaseline::Recognize(const Correspondences& correspondences) const {
  return impl_->Recognize(correspondences);
}
void BatchBaseline::SetLocalCloud(const Points& centroids_odom, const Eigen::Vector3d& sensor_odom) {
  impl_->SetLocalCloud(centroids_odom, sensor_odom);
}
std::size_t BatchBaseline::size() const { return impl_->cloud().size(); }

Points BatchBaseline::LocalCloud() const {
  Points points;
  points.reserve(size());
  for (const pcl::PointXYZ& p : impl_->cloud()) points.push_back(p.getVector3fMap());
  return points;
}

std::vector<BatchNormal> BatchBaseline::Normals() const {
  std::vector<BatchNormal> normals;
  normals.reserve(impl_->normals().size());
  for (const pcl::Normal& n : impl_->normals()) normals.push_back({n.getNormalVector3fMap(), n.curvature});
  return normals;
}

}  // namespace incremental_segmatch
