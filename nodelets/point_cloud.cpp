#include "point_cloud.hpp"

#include <sensor_msgs/PointField.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <stdexcept>

namespace incremental_segmatch {
namespace {

using sensor_msgs::PointCloud2;
using sensor_msgs::PointField;

constexpr std::uint32_t kUnsegmentedRgb = 0x606060;

std::string TypeName(std::uint8_t datatype) {
  static constexpr std::array<const char*, 9> kNames{"?",     "INT8",   "UINT8",   "INT16",  "UINT16",
                                                     "INT32", "UINT32", "FLOAT32", "FLOAT64"};
  return datatype < kNames.size() ? kNames[datatype] : "type " + std::to_string(datatype);
}

std::string FieldList(const PointCloud2& cloud) {
  if (cloud.fields.empty()) return "none";
  std::string list;
  for (const PointField& field : cloud.fields)
    list += (list.empty() ? "" : ", ") + field.name + " (" + TypeName(field.datatype) + ")";
  return list;
}

/// Where x, y and z are, all of one type.
struct Layout {
  std::array<std::size_t, 3> offsets{};
  bool is_double = false;
};

Layout FindLayout(const PointCloud2& cloud) {
  Layout layout;
  std::array<std::uint8_t, 3> types{};
  for (std::size_t axis = 0; axis < 3; ++axis) {
    const std::string name(1, "xyz"[axis]);
    const auto field =
        std::find_if(cloud.fields.begin(), cloud.fields.end(), [&name](const PointField& f) { return f.name == name; });
    if (field == cloud.fields.end())
      throw std::invalid_argument("the cloud has no field " + name + "; its fields are: " + FieldList(cloud));
    if (field->datatype != PointField::FLOAT32 && field->datatype != PointField::FLOAT64)
      throw std::invalid_argument("the cloud's field " + name +
                                  " is neither FLOAT32 nor FLOAT64; its fields are: " + FieldList(cloud));
    layout.offsets[axis] = field->offset;
    types[axis] = field->datatype;
  }
  if (types[0] != types[1] || types[0] != types[2])
    throw std::invalid_argument("the cloud's x, y and z are of different types; its fields are: " + FieldList(cloud));
  layout.is_double = types[0] == PointField::FLOAT64;
  return layout;
}

void CheckSize(const PointCloud2& cloud, const Layout& layout) {
  const std::size_t width = cloud.width;
  const std::size_t scalar = layout.is_double ? sizeof(double) : sizeof(float);
  for (const std::size_t offset : layout.offsets)
    if (offset + scalar > cloud.point_step)
      throw std::invalid_argument("the cloud's fields reach beyond its point_step of " +
                                  std::to_string(cloud.point_step) + " bytes; its fields are: " + FieldList(cloud));
  const std::size_t row = width * cloud.point_step;
  const std::size_t needed =
      cloud.height == 0 || width == 0 ? 0 : (cloud.height - 1) * std::size_t{cloud.row_step} + row;
  if ((cloud.height > 1 && cloud.row_step < row) || cloud.data.size() < needed)
    throw std::invalid_argument("the cloud's data has " + std::to_string(cloud.data.size()) + " bytes, too few for " +
                                std::to_string(cloud.height) + " rows of " + std::to_string(width) + " points");
}

template <class Scalar>
Scalar ReadScalar(const std::uint8_t* data, bool swap) {
  std::array<std::uint8_t, sizeof(Scalar)> bytes;
  std::memcpy(bytes.data(), data, sizeof(Scalar));
  if (swap) std::reverse(bytes.begin(), bytes.end());
  Scalar value;
  std::memcpy(&value, bytes.data(), sizeof(Scalar));
  return value;
}

bool IsForeignByteOrder(const PointCloud2& cloud) {
  const std::uint16_t one = 1;
  const bool machine_is_bigendian = *reinterpret_cast<const std::uint8_t*>(&one) == 0;
  return static_cast<bool>(cloud.is_bigendian) != machine_is_bigendian;
}

template <class Scalar, class Convert>
Points ReadAll(const PointCloud2& cloud, const Layout& layout, const Convert& convert) {
  const bool swap = IsForeignByteOrder(cloud);
  Points points;
  points.reserve(std::size_t{cloud.height} * cloud.width);
  for (std::size_t row = 0; row < cloud.height; ++row) {
    const std::uint8_t* data = cloud.data.data() + row * cloud.row_step;
    for (std::size_t column = 0; column < cloud.width; ++column, data += cloud.point_step)
      points.push_back(convert(Eigen::Matrix<Scalar, 3, 1>(ReadScalar<Scalar>(data + layout.offsets[0], swap),
                                                           ReadScalar<Scalar>(data + layout.offsets[1], swap),
                                                           ReadScalar<Scalar>(data + layout.offsets[2], swap))));
  }
  return points;
}

template <class Convert>
Points ReadAny(const PointCloud2& cloud, const Convert& convert) {
  const Layout layout = FindLayout(cloud);
  CheckSize(cloud, layout);
  return layout.is_double ? ReadAll<double>(cloud, layout, convert) : ReadAll<float>(cloud, layout, convert);
}

PointField MakeField(const char* name, std::uint32_t offset) {
  PointField field;
  field.name = name;
  field.offset = offset;
  field.datatype = PointField::FLOAT32;
  field.count = 1;
  return field;
}

}  // namespace

Points ReadPoints(const PointCloud2& cloud) {
  return ReadAny(cloud, [](const auto& point) -> Eigen::Vector3f { return point.template cast<float>(); });
}

Points ReadPoints(const PointCloud2& cloud, const Pose& T_a_cloud) {
  return ReadAny(cloud, [&T_a_cloud](const auto& point) -> Eigen::Vector3f {
    return (T_a_cloud * Eigen::Vector3d(point.template cast<double>())).template cast<float>();
  });
}

PointCloud2 ToPointCloud2(const std::vector<ColouredPoint>& points, const std_msgs::Header& header) {
  struct Packed {
    float x, y, z;
    std::uint32_t rgb;
  };
  PointCloud2 cloud;
  cloud.header = header;
  cloud.height = 1;
  cloud.width = static_cast<std::uint32_t>(points.size());
  cloud.fields = {MakeField("x", 0), MakeField("y", 4), MakeField("z", 8), MakeField("rgb", 12)};
  cloud.is_bigendian = false;
  cloud.point_step = sizeof(Packed);
  cloud.row_step = cloud.point_step * cloud.width;
  cloud.is_dense = true;
  cloud.data.resize(points.size() * sizeof(Packed));
  std::uint8_t* out = cloud.data.data();
  for (const ColouredPoint& point : points) {
    const Packed packed{point.position.x(), point.position.y(), point.position.z(), point.rgb};
    std::memcpy(out, &packed, sizeof(Packed));
    out += sizeof(Packed);
  }
  return cloud;
}

std::uint32_t SegmentColour(const SegmentKey& segment) {
  if (segment.id == kNoSegment) return kUnsegmentedRgb;
  // Steps of the golden ratio spread hues evenly, however many IDs there are; lightness alternates on top.
  constexpr double kGoldenRatio = 0.618033988749895;
  const double index = static_cast<double>(segment.id) + 101.0 * segment.robot;
  const double hue = 6.0 * std::fmod(index * kGoldenRatio, 1.0);
  const double value = 0.75 + 0.125 * static_cast<double>(segment.id % 3);
  const double saturation = 0.65 + 0.2 * static_cast<double>(segment.id % 2);
  std::uint32_t rgb = 0;
  for (const double shift : {5.0, 3.0, 1.0}) {  // red, green, blue of a hue in sixths of the circle
    const double k = std::fmod(shift + hue, 6.0);
    const double channel = value - value * saturation * std::clamp(std::min(k, 4.0 - k), 0.0, 1.0);
    rgb = (rgb << 8) | static_cast<std::uint32_t>(std::lround(255.0 * channel));
  }
  return rgb;
}

}  // namespace incremental_segmatch
