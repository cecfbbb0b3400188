// The nearest descriptors among a map's: ours, that takes insertions and removals, and FLANN's k-d tree, that was built for them.
#include <benchmark/benchmark.h>

#include <algorithm>
#include <cstdint>
#include <flann/flann.hpp>
#include <limits>
#include <random>
#include <utility>
#include <vector>

#include "incremental_segmatch/descriptor_index.hpp"

namespace incremental_segmatch {
namespace {

constexpr Eigen::Index kDimensions = 26;
constexpr std::size_t kNearest = 50;
constexpr std::size_t kQueries = 100;

/// Descriptors as scaled ones are: values of unit variance, most of it by a few things that segments differ in.
std::vector<Descriptor> RandomDescriptors(std::size_t count, unsigned seed) {
  constexpr Eigen::Index kFactors = 8;
  constexpr float kOwnShare = 0.2f;  // of a value's variance
  std::mt19937 random(seed);
  std::normal_distribution<float> normal;
  const auto draw = [&] { return normal(random); };
  std::mt19937 same(1);
  const Eigen::MatrixXf loads =
      Eigen::MatrixXf::NullaryExpr(kDimensions, kFactors, [&] { return normal(same); }).rowwise().normalized();
  std::vector<Descriptor> descriptors;
  for (std::size_t i = 0; i < count; ++i) {
    const Eigen::VectorXf factors = Eigen::VectorXf::NullaryExpr(kFactors, draw);
    const Eigen::VectorXf own = Eigen::VectorXf::NullaryExpr(kDimensions, draw);
    descriptors.push_back(std::sqrt(1.f - kOwnShare) * loads * factors + std::sqrt(kOwnShare) * own);
  }
  return descriptors;
}

void SearchOurs(benchmark::State& state) {
  const std::vector<Descriptor> queries = RandomDescriptors(kQueries, 3);
  DescriptorIndex index(kDimensions);
  for (const Descriptor& descriptor : RandomDescriptors(static_cast<std::size_t>(state.range(0)), 2))
    index.Insert(index.size(), descriptor);
  std::size_t next = 0;
  for (auto _ : state) {
    std::vector<std::pair<float, std::uint64_t>> nearest;
    const auto keep_nearest = [&] {
      if (nearest.size() <= kNearest) return;
      std::nth_element(nearest.begin(), nearest.begin() + kNearest - 1, nearest.end());
      nearest.resize(kNearest);
    };
    float radius = std::numeric_limits<float>::infinity();
    index.Search(queries[next++ % kQueries], radius, [&](std::uint64_t item, float distance) {
      nearest.emplace_back(distance, item);
      if (nearest.size() >= 4 * kNearest) {
        keep_nearest();
        radius = nearest.back().first;
      }
      return radius;
    });
    keep_nearest();
    std::sort(nearest.begin(), nearest.end());
    benchmark::DoNotOptimize(nearest.data());
  }
}

void SearchFlann(benchmark::State& state) {
  std::vector<Descriptor> queries = RandomDescriptors(kQueries, 3);
  const std::vector<Descriptor> descriptors = RandomDescriptors(static_cast<std::size_t>(state.range(0)), 2);
  std::vector<float> values;
  for (const Descriptor& descriptor : descriptors) values.insert(values.end(), descriptor.begin(), descriptor.end());
  const flann::Matrix<float> rows(values.data(), descriptors.size(), kDimensions);
  flann::KDTreeSingleIndex<flann::L2<float>> tree(rows, flann::KDTreeSingleIndexParams(15));
  tree.buildIndex();
  std::size_t next = 0;
  std::vector<std::vector<std::size_t>> items;
  std::vector<std::vector<float>> squares;
  for (auto _ : state) {
    const flann::Matrix<float> query(queries[next++ % kQueries].data(), 1, kDimensions);
    tree.knnSearch(query, items, squares, kNearest, flann::SearchParams(flann::FLANN_CHECKS_UNLIMITED, 0.f));
    benchmark::DoNotOptimize(items.data());
  }
}

BENCHMARK(SearchOurs)->Name("nearest descriptors/ours")->RangeMultiplier(10)->Range(100, 100000)->Unit(benchmark::kMicrosecond);
BENCHMARK(SearchFlann)->Name("nearest descriptors/flann")->RangeMultiplier(10)->Range(100, 100000)->Unit(benchmark::kMicrosecond);

}  // namespace
}  // namespace incremental_segmatch

BENCHMARK_MAIN();
