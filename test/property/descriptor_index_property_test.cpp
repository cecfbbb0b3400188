// DescriptorIndex against brute force over random sequences of insertions, removals and queries.
#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <map>
#include <random>
#include <stdexcept>
#include <tuple>
#include <vector>

#include "incremental_segmatch/descriptor_index.hpp"

namespace incremental_segmatch {
namespace {

constexpr float kInfinity = std::numeric_limits<float>::infinity();

struct Match {
  float distance;
  std::uint64_t item;
  bool operator<(const Match& other) const { return std::tie(distance, item) < std::tie(other.distance, other.item); }
  bool operator==(const Match& other) const { return distance == other.distance && item == other.item; }
};
using Matches = std::vector<Match>;
using Oracle = std::map<std::uint64_t, Descriptor>;

constexpr std::size_t kAll = std::numeric_limits<std::size_t>::max();

// The `count` first ones by (distance, item).
Matches First(Matches matches, std::size_t count) {
  std::sort(matches.begin(), matches.end());
  if (matches.size() > count) matches.resize(count);
  return matches;
}

// With a radius that shrinks to what is still of interest.
Matches Nearest(const DescriptorIndex& index, const Descriptor& query, std::size_t count, float radius) {
  Matches matches;
  index.Search(query, radius, [&](std::uint64_t item, float distance) {
    EXPECT_LE(distance, radius) << "beyond the radius that held";
    matches.push_back({distance, item});
    if (matches.size() <= count) return radius;
    matches = First(matches, count);
    return radius = matches.empty() ? -1.f : matches.back().distance;
  });
  return First(matches, count);
}

// The same sums in the same order, so that distances are equal to the last bit.
Matches BruteForce(const Oracle& oracle, const Descriptor& query, std::size_t count, float radius) {
  Matches matches;
  for (const auto& [item, descriptor] : oracle) {
    float sum = 0.f;
    for (Eigen::Index i = 0; i < query.size(); ++i) sum += (descriptor[i] - query[i]) * (descriptor[i] - query[i]);
    if (std::sqrt(sum) <= radius) matches.push_back({std::sqrt(sum), item});
  }
  return First(matches, count);
}

// Values on a coarse lattice give many ties and many equal descriptors, continuous ones none.
Descriptor RandomDescriptor(std::mt19937& random, int dimensions, bool lattice) {
  std::normal_distribution<float> normal;
  Descriptor d(dimensions);
  for (int i = 0; i < dimensions; ++i) d[i] = lattice ? std::round(normal(random)) : normal(random);
  return d;
}

TEST(DescriptorIndexProperty, EqualsBruteForceOverRandomSequences) {
  for (unsigned seed = 0; seed < 1000; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    std::mt19937 random(seed);
    const bool lattice = seed % 2 == 1;
    const int dimensions = std::array<int, 3>{1, 7, 26}[seed % 3];
    // Growing, steady and shrinking sequences.
    const double insert_share = std::array<double, 3>{0.9, 0.55, 0.45}[seed / 2 % 3];
    DescriptorIndex index(static_cast<std::size_t>(dimensions));
    Oracle oracle;
    std::uint64_t next = 1000000;
    std::uniform_real_distribution<double> uniform(0.0, 1.0);
    const int start = seed % 5 == 0 ? 700 : 0;
    for (int step = 0; step < 1500; ++step) {
      if (oracle.empty() || step < start || uniform(random) < insert_share) {
        const std::uint64_t item = uniform(random) < 0.5 ? next++ : random() + (std::uint64_t{1} << 40);
        const Descriptor d = RandomDescriptor(random, dimensions, lattice);
        if (oracle.emplace(item, d).second) index.Insert(item, d);
      } else {
        auto it = oracle.begin();
        std::advance(it, std::uniform_int_distribution<std::size_t>(0, oracle.size() - 1)(random));
        ASSERT_TRUE(index.Remove(it->first));
        ASSERT_FALSE(index.Remove(it->first));
        oracle.erase(it);
      }
      ASSERT_EQ(index.size(), oracle.size());
      if (step % 10 != 0) continue;
      const Descriptor query = RandomDescriptor(random, dimensions, lattice);
      const std::size_t count = std::uniform_int_distribution<std::size_t>(0, 40)(random);
      // On the lattice distances equal the radius at times.
      const float far = lattice ? std::round(4.f * static_cast<float>(uniform(random))) : static_cast<float>(4.0 * uniform(random));
      const float radius = uniform(random) < 0.5 ? kInfinity : far;
      ASSERT_EQ(Nearest(index, query, count, radius), BruteForce(oracle, query, count, radius));
      if (step % 50 == 0) {
        ASSERT_EQ(Nearest(index, query, kAll, radius), BruteForce(oracle, query, kAll, radius));
      }
    }
  }
}

TEST(DescriptorIndex, RefusesWhatItCanNotHold) {
  EXPECT_THROW(DescriptorIndex(0), std::invalid_argument);
  DescriptorIndex index(2);
  index.Insert(1, Descriptor::Zero(2));
  EXPECT_THROW(index.Insert(1, Descriptor::Zero(2)), std::invalid_argument);
  EXPECT_THROW(index.Insert(2, Descriptor::Zero(3)), std::invalid_argument);
  EXPECT_THROW(index.Insert(2, Descriptor::Constant(2, kInfinity)), std::invalid_argument);
  EXPECT_THROW(Nearest(index, Descriptor::Zero(1), 1, kInfinity), std::invalid_argument);
  EXPECT_THROW(Nearest(index, Descriptor::Constant(2, std::nanf("")), 1, kInfinity), std::invalid_argument);
  EXPECT_EQ(index.size(), 1u);
  EXPECT_EQ(Nearest(index, Descriptor::Zero(2), 5, 0.f).size(), 1u);
}

TEST(DescriptorIndex, AnItemMayComeBackWithAnotherDescriptor) {
  DescriptorIndex index(1);
  for (std::uint64_t i = 0; i < 200; ++i) index.Insert(i, Descriptor::Constant(1, static_cast<float>(i)));
  for (std::uint64_t i = 0; i < 200; ++i) {
    ASSERT_TRUE(index.Remove(i));
    index.Insert(i, Descriptor::Constant(1, 1000.f + static_cast<float>(i)));
  }
  EXPECT_TRUE(Nearest(index, Descriptor::Zero(1), 300, 900.f).empty());
  EXPECT_EQ(Nearest(index, Descriptor::Zero(1), 300, kInfinity).size(), 200u);
}

TEST(DescriptorIndex, Moves) {
  DescriptorIndex a(1);
  a.Insert(7, Descriptor::Zero(1));
  DescriptorIndex b = std::move(a);
  EXPECT_EQ(Nearest(b, Descriptor::Zero(1), 1, kInfinity).at(0).item, 7u);
}

}  // namespace
}  // namespace incremental_segmatch
