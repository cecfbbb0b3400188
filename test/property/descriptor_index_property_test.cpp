// DescriptorIndex against brute force over random sequences of insertions, removals and queries.
#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <map>
#include <random>
#include <stdexcept>

#include "incremental_segmatch/descriptor_index.hpp"

namespace incremental_segmatch {
namespace {

constexpr float kInfinity = std::numeric_limits<float>::infinity();

using Oracle = std::map<std::uint64_t, Descriptor>;

double TrueDistance(const Descriptor& a, const Descriptor& b) {
  return (a - b).cast<double>().norm();
}

std::vector<double> BruteForce(const Oracle& oracle, const Descriptor& query, std::size_t count, double radius) {
  std::vector<double> distances;
  for (const auto& entry : oracle) {
    const double distance = TrueDistance(query, entry.second);
    if (distance <= radius) distances.push_back(distance);
  }
  std::sort(distances.begin(), distances.end());
  if (distances.size() > count) distances.resize(count);
  return distances;
}

void ExpectExact(const std::vector<DescriptorMatch>& matches, const Oracle& oracle, const Descriptor& query,
                 std::size_t count, float radius) {
  const std::vector<double> expected = BruteForce(oracle, query, count, radius);
  ASSERT_EQ(matches.size(), expected.size());
  for (std::size_t i = 0; i < matches.size(); ++i) {
    ASSERT_NEAR(matches[i].distance, expected[i], 1e-5 * (1.0 + expected[i]));
    const auto it = oracle.find(matches[i].item);
    ASSERT_NE(it, oracle.end()) << "a removed item was found";
    ASSERT_NEAR(matches[i].distance, TrueDistance(query, it->second), 1e-5 * (1.0 + expected[i]));
    if (i > 0) {
      ASSERT_TRUE(matches[i - 1].distance < matches[i].distance ||
                  (matches[i - 1].distance == matches[i].distance && matches[i - 1].item < matches[i].item));
    }
  }
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
    const int dimensions = 1 + static_cast<int>(seed % 3) * 6;
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
      // Not on the lattice, so that no distance equals the radius up to rounding.
      const float radius = uniform(random) < 0.5 ? kInfinity : static_cast<float>(0.0123 + 4.0 * uniform(random));
      ExpectExact(index.Nearest(query, count, radius), oracle, query, count, radius);
      if (step % 50 == 0) {
        const std::size_t all = std::numeric_limits<std::size_t>::max();
        ExpectExact(index.Nearest(query, all, radius), oracle, query, all, radius);
      }
    }
  }
}

TEST(DescriptorIndexProperty, TiesAreBrokenByItemWhateverTheHistory) {
  for (unsigned seed = 0; seed < 1000; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    std::mt19937 random(seed);
    std::vector<std::uint64_t> items(500);
    for (std::size_t i = 0; i < items.size(); ++i) items[i] = i;
    std::shuffle(items.begin(), items.end(), random);
    DescriptorIndex index(3);
    for (const std::uint64_t item : items) index.Insert(item, Descriptor::Constant(3, item % 2 == 0 ? 0.f : 1.f));
    for (std::uint64_t item = 0; item < 20; ++item) index.Remove(item);
    const auto matches = index.Nearest(Descriptor::Zero(3), 10, kInfinity);
    ASSERT_EQ(matches.size(), 10u);
    for (std::size_t i = 0; i < 10; ++i) EXPECT_EQ(matches[i].item, 20 + 2 * i);
  }
}

TEST(DescriptorIndexProperty, ResultsDoNotDependOnTheOrderOfInsertion) {
  std::mt19937 random(5);
  std::vector<Descriptor> descriptors;
  for (int i = 0; i < 1000; ++i) descriptors.push_back(RandomDescriptor(random, 14, false));
  DescriptorIndex forward(14), backward(14);
  for (std::size_t i = 0; i < 1000; ++i) {
    forward.Insert(i, descriptors[i]);
    backward.Insert(999 - i, descriptors[999 - i]);
  }
  for (int q = 0; q < 200; ++q) {
    const Descriptor query = RandomDescriptor(random, 14, false);
    const auto a = forward.Nearest(query, 25, kInfinity), b = backward.Nearest(query, 25, kInfinity);
    ASSERT_EQ(a.size(), b.size());
    for (std::size_t i = 0; i < a.size(); ++i) {
      ASSERT_EQ(a[i].item, b[i].item);
      ASSERT_EQ(a[i].distance, b[i].distance);
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
  EXPECT_THROW(index.Nearest(Descriptor::Zero(1), 1, kInfinity), std::invalid_argument);
  EXPECT_EQ(index.size(), 1u);
  EXPECT_TRUE(index.Nearest(Descriptor::Zero(2), 0, kInfinity).empty());
  EXPECT_EQ(index.Nearest(Descriptor::Zero(2), 5, 0.f).size(), 1u);
}

TEST(DescriptorIndex, AnItemMayComeBackWithAnotherDescriptor) {
  DescriptorIndex index(1);
  for (std::uint64_t i = 0; i < 200; ++i) index.Insert(i, Descriptor::Constant(1, static_cast<float>(i)));
  for (std::uint64_t i = 0; i < 200; ++i) {
    ASSERT_TRUE(index.Remove(i));
    index.Insert(i, Descriptor::Constant(1, 1000.f + static_cast<float>(i)));
  }
  EXPECT_TRUE(index.Nearest(Descriptor::Zero(1), 300, 900.f).empty());
  EXPECT_EQ(index.Nearest(Descriptor::Zero(1), 300, kInfinity).size(), 200u);
}

TEST(DescriptorIndex, Moves) {
  DescriptorIndex a(1);
  a.Insert(7, Descriptor::Zero(1));
  DescriptorIndex b = std::move(a);
  EXPECT_EQ(b.Nearest(Descriptor::Zero(1), 1, kInfinity).at(0).item, 7u);
}

}  // namespace
}  // namespace incremental_segmatch
