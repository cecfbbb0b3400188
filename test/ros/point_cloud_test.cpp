#include "point_cloud.hpp"

#include <gtest/gtest.h>
#include <sensor_msgs/PointField.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <random>
#include <set>
#include <stdexcept>

namespace incremental_segmatch {
namespace {

using sensor_msgs::PointCloud2;
using sensor_msgs::PointField;

template <class Scalar>
void Put(std::vector<std::uint8_t>& data, std::size_t offset, Scalar value, bool swap) {
  std::uint8_t bytes[sizeof(Scalar)];
  std::memcpy(bytes, &value, sizeof(Scalar));
  if (swap) std::reverse(bytes, bytes + sizeof(Scalar));
  std::memcpy(data.data() + offset, bytes, sizeof(Scalar));
}

PointField Field(const std::string& name, std::size_t offset, std::uint8_t type) {
  PointField field;
  field.name = name;
  field.offset = static_cast<std::uint32_t>(offset);
  field.datatype = type;
  field.count = 1;
  return field;
}

/// A cloud of these points in a random layout.
PointCloud2 RandomLayout(const std::vector<Eigen::Vector3d>& points, std::size_t height, bool is_double, bool swap,
                         std::mt19937& random) {
  PointCloud2 cloud;
  std::vector<std::string> names{"intensity", "x", "ring", "y", "time", "z"};
  std::shuffle(names.begin(), names.end(), random);
  std::size_t offset = random() % 7;
  for (const std::string& name : names) {
    const bool is_coordinate = name.size() == 1;
    const std::uint8_t type = !is_coordinate ? PointField::UINT16
                              : is_double    ? PointField::FLOAT64
                                             : PointField::FLOAT32;
    cloud.fields.push_back(Field(name, offset, type));
    offset += (is_coordinate ? (is_double ? 8 : 4) : 2) + random() % 5;
  }
  cloud.is_bigendian = swap;
  cloud.height = static_cast<std::uint32_t>(height);
  cloud.width = static_cast<std::uint32_t>(points.size() / height);
  cloud.point_step = static_cast<std::uint32_t>(offset);
  cloud.row_step = static_cast<std::uint32_t>(offset * cloud.width + random() % 9);
  cloud.data.assign(cloud.row_step * height, 0xab);
  for (std::size_t i = 0; i < points.size(); ++i) {
    const std::size_t base = (i / cloud.width) * cloud.row_step + (i % cloud.width) * cloud.point_step;
    for (const PointField& field : cloud.fields) {
      if (field.name.size() != 1) continue;
      const double value = points[i][field.name[0] - 'x'];
      if (is_double)
        Put(cloud.data, base + field.offset, value, swap);
      else
        Put(cloud.data, base + field.offset, static_cast<float>(value), swap);
    }
  }
  return cloud;
}

TEST(ReadPoints, AnyLayoutGivesThePoints) {
  for (unsigned seed = 0; seed < 64; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    std::mt19937 random(seed);
    std::normal_distribution<double> normal(0.0, 30.0);
    const std::size_t height = 1 + random() % 4;
    std::vector<Eigen::Vector3d> points(height * (1 + random() % 20));
    for (Eigen::Vector3d& p : points) p << normal(random), normal(random), normal(random);
    points[0].y() = std::nan("");
    const Points read = ReadPoints(RandomLayout(points, height, seed % 2 == 1, (seed / 2) % 2 == 1, random));
    ASSERT_EQ(read.size(), points.size());
    EXPECT_TRUE(std::isnan(read[0].y()));
    for (std::size_t i = 1; i < points.size(); ++i) EXPECT_EQ(read[i], points[i].cast<float>()) << i;
  }
}

TEST(ReadPoints, DoublesStayExactFarAway) {
  std::mt19937 random(1);
  Pose T_world_sensor = Pose::Identity();
  T_world_sensor.translation() << 4.5e6, -3.2e6, 100.0;
  const std::vector<Eigen::Vector3d> points{T_world_sensor * Eigen::Vector3d(1.234, 5.678, -0.321)};
  const Points read = ReadPoints(RandomLayout(points, 1, true, false, random), T_world_sensor.inverse());
  EXPECT_LT((read[0] - Eigen::Vector3f(1.234f, 5.678f, -0.321f)).norm(), 1e-6f);
}

std::string Refusal(const PointCloud2& cloud) {
  try {
    ReadPoints(cloud);
  } catch (const std::invalid_argument& error) {
    return error.what();
  }
  return "accepted";
}

TEST(ReadPoints, SaysWhatIsWrong) {
  std::mt19937 random(2);
  const PointCloud2 good =
      RandomLayout(std::vector<Eigen::Vector3d>(6, Eigen::Vector3d::Ones()), 2, false, false, random);
  ASSERT_EQ(Refusal(good), "accepted");

  PointCloud2 cloud = good;
  for (PointField& field : cloud.fields)
    if (field.name == "y") field.name = "azimuth";
  EXPECT_NE(Refusal(cloud).find("no field y"), std::string::npos) << Refusal(cloud);
  EXPECT_NE(Refusal(cloud).find("azimuth (FLOAT32)"), std::string::npos) << Refusal(cloud);

  cloud.fields.clear();
  EXPECT_NE(Refusal(cloud).find("none"), std::string::npos) << Refusal(cloud);

  cloud = good;
  for (PointField& field : cloud.fields)
    if (field.name == "z") field.datatype = PointField::INT32;
  EXPECT_NE(Refusal(cloud).find("neither FLOAT32 nor FLOAT64"), std::string::npos) << Refusal(cloud);

  cloud = good;
  cloud.data.resize(cloud.data.size() - cloud.row_step);
  EXPECT_NE(Refusal(cloud).find("too few"), std::string::npos) << Refusal(cloud);

  cloud = good;
  cloud.point_step = 3;
  EXPECT_NE(Refusal(cloud).find("point_step"), std::string::npos) << Refusal(cloud);
}

TEST(ToPointCloud2, IsReadBack) {
  const std::vector<ColouredPoint> points{{{1.f, 2.f, 3.f}, 0x102030}, {{-1.f, 0.f, 8.f}, 0xffffff}};
  const PointCloud2 cloud = ToPointCloud2(points, std_msgs::Header());
  const Points read = ReadPoints(cloud);
  ASSERT_EQ(read.size(), 2u);
  EXPECT_EQ(read[0], points[0].position);
  EXPECT_EQ(read[1], points[1].position);
  std::uint32_t rgb = 0;
  std::memcpy(&rgb, cloud.data.data() + 12, sizeof(rgb));
  EXPECT_EQ(rgb, 0x102030u);
}

TEST(SegmentColour, IsStableAndNeighboursDiffer) {
  std::set<std::uint32_t> colours;
  for (SegmentId id = 1; id <= 30; ++id) {
    EXPECT_EQ(SegmentColour({0, id}), SegmentColour({0, id}));
    colours.insert(SegmentColour({0, id}));
  }
  EXPECT_EQ(colours.size(), 30u);
  EXPECT_EQ(SegmentColour({0, kNoSegment}), SegmentColour({4, kNoSegment}));
}

}  // namespace
}  // namespace incremental_segmatch
