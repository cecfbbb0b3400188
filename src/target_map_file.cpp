// The file of a target map. Little-endian throughout:
//   magic (8 bytes), version (u32), CRC-32 of the content (u32), size of the content in bytes (u64), content.
// The content is a list of robots with their trajectories, key frames and sightings, then a list of segments with their views, bit for bit as
// they are in memory, so that a loaded map recognises exactly as before.

#include <fcntl.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <cstdio>
#include <cstring>
#include <set>
#include <stdexcept>
#include <type_traits>
#include <utility>

#include "incremental_segmatch/target_map.hpp"

namespace incremental_segmatch {
namespace {

constexpr char kMagic[8] = {'S', 'E', 'G', 'M', 'A', 'P', '\r', '\n'};
constexpr std::uint32_t kVersion = 3;
constexpr std::size_t kHeaderSize = 24;
constexpr std::size_t kBufferSize = 1 << 20;

std::string Reason() {
  return std::strerror(errno);
}

// ---- Values to bytes and back ---------------------------------------------------------------------------------------

template <class T>
using BitsOf =
    std::conditional_t<sizeof(T) == 1, std::uint8_t, std::conditional_t<sizeof(T) == 4, std::uint32_t, std::uint64_t>>;

template <class T>
void PutLittleEndian(T value, unsigned char* to) {
  BitsOf<T> bits;
  static_assert(sizeof bits == sizeof value, "a value of 1, 4 or 8 bytes");
  std::memcpy(&bits, &value, sizeof bits);
  for (std::size_t i = 0; i < sizeof bits; ++i) to[i] = static_cast<unsigned char>(bits >> (8 * i));
}

template <class T>
T GetLittleEndian(const unsigned char* from) {
  BitsOf<T> bits = 0;
  static_assert(sizeof bits == sizeof(T), "a value of 1, 4 or 8 bytes");
  for (std::size_t i = 0; i < sizeof bits; ++i) bits = static_cast<BitsOf<T>>(bits | BitsOf<T>{from[i]} << (8 * i));
  T value;
  std::memcpy(&value, &bits, sizeof bits);
  return value;
}

// ---- CRC-32 (IEEE 802.3), four bytes at a time ----------------------------------------------------------------------

using CrcTables = std::array<std::array<std::uint32_t, 256>, 4>;

const CrcTables& Tables() {
  static const CrcTables tables = [] {
    CrcTables t{};
    for (std::uint32_t i = 0; i < 256; ++i) {
      std::uint32_t crc = i;
      for (int bit = 0; bit < 8; ++bit) crc = (crc >> 1) ^ ((crc & 1) != 0 ? 0xedb88320u : 0u);
      t[0][i] = crc;
    }
    for (std::size_t k = 1; k < 4; ++k)
      for (std::size_t i = 0; i < 256; ++i) t[k][i] = (t[k - 1][i] >> 8) ^ t[0][t[k - 1][i] & 0xff];
    return t;
  }();
  return tables;
}

/// CRC of a block that follows blocks with this CRC (0 at first).
std::uint32_t Crc32(std::uint32_t crc, const unsigned char* data, std::size_t size) {
  const CrcTables& t = Tables();
  crc = ~crc;
  for (; size >= 4; size -= 4, data += 4) {
    crc ^= GetLittleEndian<std::uint32_t>(data);
    crc = t[3][crc & 0xff] ^ t[2][(crc >> 8) & 0xff] ^ t[1][(crc >> 16) & 0xff] ^ t[0][crc >> 24];
  }
  for (; size > 0; --size) crc = (crc >> 8) ^ t[0][(crc ^ *data++) & 0xff];
  return ~crc;
}

// ---- Writing --------------------------------------------------------------------------------------------------------

/// A file beside `path` that takes its place when it is complete, and goes if it is given up.
class AtomicFile {
 public:
  explicit AtomicFile(const std::string& path) : path_(path), unfinished_(path + ".part"), buffer_(kHeaderSize, 0) {
    buffer_.reserve(2 * kBufferSize);
    descriptor_ = ::open(unfinished_.c_str(), O_WRONLY | O_CREAT | O_TRUNC | O_CLOEXEC, 0666);
    if (descriptor_ < 0)
      throw std::runtime_error("can't write " + path_ + ": " + Reason() +
                               "; does its folder exist, and may it be written?");
  }
  ~AtomicFile() {
    if (descriptor_ < 0) return;
    ::close(descriptor_);
    ::unlink(unfinished_.c_str());
  }
  AtomicFile(const AtomicFile&) = delete;
  AtomicFile& operator=(const AtomicFile&) = delete;

  template <class T>
  void Put(T value) {
    unsigned char bytes[sizeof value];
    PutLittleEndian(value, bytes);
    PutBytes(bytes, sizeof value);
  }

  void PutBytes(const void* data, std::size_t size) {
    const auto* bytes = static_cast<const unsigned char*>(data);
    crc_ = Crc32(crc_, bytes, size);
    content_size_ += size;
    buffer_.insert(buffer_.end(), bytes, bytes + size);
    if (buffer_.size() >= kBufferSize) Flush();
  }

  /// Writes the header, brings everything to the disk and takes the place of the previous file.
  void Commit() {
    Flush();
    unsigned char header[kHeaderSize];
    std::memcpy(header, kMagic, sizeof kMagic);
    PutLittleEndian(kVersion, header + 8);
    PutLittleEndian(crc_, header + 12);
    PutLittleEndian(content_size_, header + 16);
    if (::lseek(descriptor_, 0, SEEK_SET) != 0) Fail();
    WriteAll(header, sizeof header);
    if (::fsync(descriptor_) != 0) Fail();
    if (::close(std::exchange(descriptor_, -1)) != 0 || std::rename(unfinished_.c_str(), path_.c_str()) != 0) {
      const std::string reason = Reason();
      ::unlink(unfinished_.c_str());
      throw std::runtime_error("can't write " + path_ + ": " + reason);
    }
    SyncFolder();
  }

 private:
  [[noreturn]] void Fail() const {
    throw std::runtime_error("writing " + path_ + " failed: " + Reason() + "; the previous file is left as it was");
  }

  void Flush() {
    WriteAll(buffer_.data(), buffer_.size());
    buffer_.clear();
  }

  void WriteAll(const unsigned char* data, std::size_t size) {
    while (size > 0) {
      const ::ssize_t written = ::write(descriptor_, data, size);
      if (written < 0 && errno == EINTR) continue;
      if (written < 0) Fail();
      data += written;
      size -= static_cast<std::size_t>(written);
    }
  }

  /// Makes the renaming itself durable. Not every file system can; the file is whole either way.
  void SyncFolder() const {
    const std::size_t slash = path_.rfind('/');
    const std::string folder = slash == std::string::npos ? "." : path_.substr(0, slash + 1);
    const int descriptor = ::open(folder.c_str(), O_RDONLY | O_DIRECTORY | O_CLOEXEC);
    if (descriptor < 0) return;
    ::fsync(descriptor);
    ::close(descriptor);
  }

  std::string path_;
  std::string unfinished_;
  std::vector<unsigned char> buffer_;
  int descriptor_ = -1;
  std::uint32_t crc_ = 0;
  std::uint64_t content_size_ = 0;
};

void PutPose(const Pose& pose, AtomicFile* file) {
  for (int row = 0; row < 3; ++row)
    for (int column = 0; column < 4; ++column) file->Put(pose(row, column));
}

/// Points that may be missing.
void PutPoints(const Points* points, AtomicFile* file) {
  file->Put(static_cast<std::uint8_t>(points != nullptr));
  if (points == nullptr) return;
  file->Put(static_cast<std::uint64_t>(points->size()));
  std::vector<unsigned char> bytes(3 * sizeof(float) * points->size());
  unsigned char* at = bytes.data();
  for (const Eigen::Vector3f& point : *points)
    for (int axis = 0; axis < 3; ++axis, at += sizeof(float)) PutLittleEndian(point[axis], at);
  file->PutBytes(bytes.data(), bytes.size());
}

void PutView(const SegmentView& view, AtomicFile* file) {
  file->Put(view.robot);
  file->Put(view.pose);
  file->Put(view.size);
  for (int axis = 0; axis < 3; ++axis) file->Put(view.centroid_sensor[axis]);
  file->Put(static_cast<std::uint64_t>(view.descriptor.size()));
  for (const float value : view.descriptor) file->Put(value);
  PutPoints(view.points_centroid.get(), file);
}

// ---- Reading --------------------------------------------------------------------------------------------------------

std::vector<unsigned char> ReadFile(const std::string& path) {
  const auto fail = [&](const std::string& reason) { throw std::runtime_error("can't read " + path + ": " + reason); };
  struct File {
    int descriptor;
    ~File() {
      if (descriptor >= 0) ::close(descriptor);
    }
  };
  const File file{::open(path.c_str(), O_RDONLY | O_CLOEXEC)};
  struct ::stat status;
  if (file.descriptor < 0 || ::fstat(file.descriptor, &status) != 0) fail(Reason());
  if (!S_ISREG(status.st_mode)) fail("it is no file");
  std::vector<unsigned char> bytes(static_cast<std::size_t>(status.st_size));
  for (std::size_t done = 0; done < bytes.size();) {
    const ::ssize_t got = ::read(file.descriptor, bytes.data() + done, bytes.size() - done);
    if (got < 0 && errno == EINTR) continue;
    if (got < 0) fail(Reason());
    if (got == 0) fail("it became shorter while it was read");
    done += static_cast<std::size_t>(got);
  }
  return bytes;
}

/// Checks header and checksum.
void RequireWhole(const std::vector<unsigned char>& bytes, const std::string& path) {
  const auto fail = [&](const std::string& reason) { throw std::runtime_error("the map " + path + reason); };
  if (bytes.empty()) fail(" is empty");
  const std::size_t compared = std::min(bytes.size(), sizeof kMagic);
  if (std::memcmp(bytes.data(), kMagic, compared) != 0) throw std::runtime_error(path + " is not a segment map");
  if (bytes.size() < kHeaderSize) fail(" is truncated: its header is incomplete");
  const auto version = GetLittleEndian<std::uint32_t>(bytes.data() + 8);
  if (version > kVersion)
    fail(" is of version " + std::to_string(version) + ", and this program knows none newer than version " +
         std::to_string(kVersion) + ": load it with a newer program, or save it with one as old as this");
  if (version == 0) fail(" is damaged: there is no version 0");
  if (version < kVersion)
    fail(" is of version " + std::to_string(version) + ", whose maps lack what this one needs: make it anew");
  const auto content_size = GetLittleEndian<std::uint64_t>(bytes.data() + 16);
  const std::uint64_t present = bytes.size() - kHeaderSize;
  if (present != content_size)
    fail(std::string(present < content_size ? " is truncated: " : " is damaged: ") + std::to_string(present) +
         " bytes of content instead of " + std::to_string(content_size));
  if (Crc32(0, bytes.data() + kHeaderSize, present) != GetLittleEndian<std::uint32_t>(bytes.data() + 12))
    fail(" is damaged: its checksum does not match");
}

/// Takes values from a content whose checksum holds, and still trusts none of its counts.
class Reader {
 public:
  Reader(const std::vector<unsigned char>& bytes, const std::string& path)
      : at_(bytes.data() + kHeaderSize), end_(bytes.data() + bytes.size()), path_(path) {}

  template <class T>
  T Get() {
    return GetLittleEndian<T>(Take(1, sizeof(T)));
  }

  /// The bytes of so many elements.
  const unsigned char* Take(std::uint64_t count, std::size_t element_size) {
    RequireRoom(count, element_size);
    return std::exchange(at_, at_ + count * element_size);
  }

  /// A count of elements, each of which takes at least so many bytes.
  std::size_t GetCount(std::size_t least_element_size) {
    const auto count = Get<std::uint64_t>();
    RequireRoom(count, least_element_size);
    return static_cast<std::size_t>(count);
  }

  void Require(bool holds, const char* fault) const {
    if (!holds) throw std::runtime_error("the map " + path_ + " is damaged: " + fault);
  }
  bool IsAtEnd() const { return at_ == end_; }

 private:
  void RequireRoom(std::uint64_t count, std::size_t element_size) const {
    Require(count <= static_cast<std::size_t>(end_ - at_) / element_size, "it ends within a list");
  }

  const unsigned char* at_;
  const unsigned char* end_;
  const std::string& path_;
};

Pose GetPose(Reader* reader) {
  Pose pose = Pose::Identity();
  for (int row = 0; row < 3; ++row)
    for (int column = 0; column < 4; ++column) pose(row, column) = reader->Get<double>();
  return pose;
}

std::shared_ptr<const Points> GetPoints(Reader* reader) {
  const auto has_points = reader->Get<std::uint8_t>();
  reader->Require(has_points <= 1, "a flag is neither 0 nor 1");
  if (has_points == 0) return nullptr;
  Points points(reader->GetCount(3 * sizeof(float)));
  const unsigned char* at = reader->Take(points.size(), 3 * sizeof(float));
  for (Eigen::Vector3f& point : points)
    for (int axis = 0; axis < 3; ++axis, at += sizeof(float)) point[axis] = GetLittleEndian<float>(at);
  return std::make_shared<const Points>(std::move(points));
}

SegmentView GetView(Reader* reader) {
  SegmentView view;
  view.robot = reader->Get<std::uint32_t>();
  view.pose = reader->Get<std::uint32_t>();
  view.size = reader->Get<std::uint32_t>();
  for (int axis = 0; axis < 3; ++axis) view.centroid_sensor[axis] = reader->Get<double>();
  view.descriptor.resize(static_cast<Eigen::Index>(reader->GetCount(sizeof(float))));
  for (float& value : view.descriptor) value = reader->Get<float>();
  view.points_centroid = GetPoints(reader);
  return view;
}

}  // namespace

void TargetMap::Save(const std::string& path) const {
  AtomicFile file(path);
  file.Put(static_cast<std::uint64_t>(robots_.size()));
  for (const Robot& robot : robots_) {
    file.Put(static_cast<std::uint64_t>(robot.name.size()));
    file.PutBytes(robot.name.data(), robot.name.size());
    PutPose(robot.T_map_odom, &file);
    file.Put(static_cast<std::uint64_t>(robot.trajectory.size()));
    for (const TrajectoryPose& pose : robot.trajectory) {
      file.Put(pose.stamp_ns);
      PutPose(pose.T_odom_sensor, &file);
      PutPose(pose.T_map_sensor, &file);
    }
    file.Put(static_cast<std::uint64_t>(robot.keyframes.size()));
    for (const Keyframe& keyframe : robot.keyframes) {
      file.Put(keyframe.pose);
      PutPoints(keyframe.scan_sensor.get(), &file);
    }
    file.Put(static_cast<std::uint64_t>(robot.sightings.size()));
    for (const Sighting& sighting : robot.sightings) {
      file.Put(sighting.pose);
      file.Put(sighting.keyframe.robot);
      file.Put(sighting.keyframe.index);
    }
  }
  file.Put(static_cast<std::uint64_t>(segments_.size()));
  for (const auto& [key, segment] : segments_) {
    file.Put(key.robot);
    file.Put(key.id);
    file.Put(segment.last_seen_ns);
    file.Put(segment.missed_visits);
    file.Put(static_cast<std::uint64_t>(segment.views.size()));
    for (const SegmentView& view : segment.views) PutView(view, &file);
  }
  file.Commit();
}

TargetMap TargetMap::Load(const std::string& path, const TargetMapParameters& parameters) {
  // Least bytes of an element of each list: what is refused here can't make a damaged count allocate more than the
  // file's size.
  constexpr std::size_t kPose = 12 * 8, kRobot = 8 + kPose + 8 + 8 + 8, kKeyframe = 4 + 1, kSighting = 3 * 4, kSegment = 4 + 4 + 8 + 4 + 8, kView = 3 * 4 + 3 * 8 + 8 + 1;
  TargetMap map(parameters);
  const std::vector<unsigned char> bytes = ReadFile(path);
  RequireWhole(bytes, path);
  Reader reader(bytes, path);

  std::set<std::string> names;
  map.robots_.resize(reader.GetCount(kRobot));
  for (Robot& robot : map.robots_) {
    const std::size_t length = reader.GetCount(1);
    robot.name.assign(reinterpret_cast<const char*>(reader.Take(length, 1)), length);
    reader.Require(names.insert(robot.name).second, "two robots have the same name");
    robot.T_map_odom = GetPose(&reader);
    robot.trajectory.resize(reader.GetCount(8 + 2 * kPose));
    const TrajectoryPose* previous = nullptr;
    for (TrajectoryPose& pose : robot.trajectory) {
      pose.stamp_ns = reader.Get<std::int64_t>();
      pose.T_odom_sensor = GetPose(&reader);
      pose.T_map_sensor = GetPose(&reader);
      reader.Require(previous == nullptr || previous->stamp_ns < pose.stamp_ns,
                     "stamps of a trajectory do not increase");
      if (previous != nullptr) pose.path_m = PathAfter(*previous, pose.T_odom_sensor);
      previous = &pose;
    }
    robot.keyframes.resize(reader.GetCount(kKeyframe));
    std::uint64_t next_pose = 0;
    for (Keyframe& keyframe : robot.keyframes) {
      keyframe.pose = reader.Get<std::uint32_t>();
      reader.Require(keyframe.pose >= next_pose && keyframe.pose < robot.trajectory.size(),
                     "a key frame is no later pose of its trajectory");
      next_pose = std::uint64_t{keyframe.pose} + 1;
      keyframe.scan_sensor = GetPoints(&reader);
    }
    robot.sightings.resize(reader.GetCount(kSighting));
    next_pose = 0;
    for (Sighting& sighting : robot.sightings) {
      sighting.pose = reader.Get<std::uint32_t>();
      reader.Require(sighting.pose >= next_pose && sighting.pose < robot.trajectory.size(),
                     "a sighting is no later pose of its trajectory");
      next_pose = std::uint64_t{sighting.pose} + 1;
      sighting.keyframe.robot = reader.Get<std::uint32_t>();
      sighting.keyframe.index = reader.Get<std::uint32_t>();
    }
  }
  for (const Robot& robot : map.robots_)
    for (const Sighting& sighting : robot.sightings)
      reader.Require(sighting.keyframe.robot < map.robots_.size() &&
                         sighting.keyframe.index < map.robots_[sighting.keyframe.robot].keyframes.size(),
                     "a sighting is of no key frame");

  for (std::size_t segments = reader.GetCount(kSegment); segments > 0; --segments) {
    SegmentKey key;
    key.robot = reader.Get<std::uint32_t>();
    key.id = reader.Get<std::uint32_t>();
    reader.Require(key.robot < map.robots_.size(), "a segment belongs to no robot");
    reader.Require(map.segments_.empty() || map.segments_.rbegin()->first < key, "its segments are out of order");
    TargetSegment& segment = map.segments_.emplace_hint(map.segments_.end(), key, TargetSegment())->second;
    segment.last_seen_ns = reader.Get<std::int64_t>();
    segment.missed_visits = reader.Get<std::uint32_t>();
    const std::size_t views = reader.GetCount(kView);
    reader.Require(views > 0, "a segment has no view");
    for (std::size_t i = 0; i < views; ++i) {
      segment.views.push_back(GetView(&reader));
      const SegmentView& view = segment.views.back();
      reader.Require(view.robot < map.robots_.size() && view.pose < map.robots_[view.robot].trajectory.size(),
                     "a view hangs on no pose of a trajectory");
    }
    if (views > parameters.max_views) map.TidyViews(&segment.views);
  }
  reader.Require(reader.IsAtEnd(), "it goes on after its last segment");
  return map;
}

}  // namespace incremental_segmatch
