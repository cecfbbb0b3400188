#include <gtest/gtest.h>
#include <sys/resource.h>
#include <unistd.h>

#include <algorithm>
#include <csignal>
#include <cstdlib>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <limits>
#include <memory>
#include <random>
#include <stdexcept>
#include <string>

#include "incremental_segmatch/target_map.hpp"
#include "support/temporary_directory.hpp"

namespace incremental_segmatch {
namespace {

using Bytes = std::string;

constexpr std::size_t kHeaderSize = 24;

Pose RandomPose(std::mt19937& random) {
  std::normal_distribution<double> normal;
  Pose T = Pose::Identity();
  T.linear() = Eigen::Quaterniond(normal(random), normal(random), normal(random), normal(random))
                   .normalized()
                   .toRotationMatrix();
  T.translation() << 1e4 * normal(random), 1e4 * normal(random), normal(random);
  return T;
}

// Robots with trajectories, corrected ones too, and segments with views of all kinds.
TargetMap RandomMap(unsigned seed, int robots, int poses, int segments) {
  std::mt19937 random(seed);
  std::normal_distribution<float> normal;
  TargetMap map{TargetMapParameters()};
  for (int r = 0; r < robots; ++r) {
    const RobotIndex robot = map.RobotByName(r == 1 ? std::string("r\0\n\xc3\xa4", 5) : std::string(r, 'r'));
    std::vector<StampedPose> corrected;
    StampNs stamp_ns = r == 0 ? std::numeric_limits<StampNs>::min() : static_cast<StampNs>(random()) * 1000000000;
    for (int i = 0; i < poses; ++i) {
      map.AddPose(robot, stamp_ns, RandomPose(random));
      if (i % 3 == 1) {
        auto scan = std::make_shared<Points>(random() % 50);
        for (Eigen::Vector3f& p : *scan) p << normal(random), normal(random), normal(random);
        map.AddKeyframe(robot, i % 2 == 0 ? nullptr : scan);
      } else if (i % 3 == 2) {
        const auto other = static_cast<RobotIndex>(random() % (robot + 1));
        map.AddSighting(robot, {other, static_cast<std::uint32_t>(random() % map.Keyframes(other).size())});
      }
      if (i % 7 == 3) corrected.push_back({stamp_ns, RandomPose(random)});
      stamp_ns += 1 + static_cast<StampNs>(random() % 1000000);
    }
    if (r % 2 == 0) map.CorrectTrajectory(robot, corrected);
  }
  for (int s = 0; s < segments; ++s) {
    const SegmentKey key{static_cast<RobotIndex>(random() % robots), static_cast<SegmentId>(random())};
    for (int v = 0; v < 1 + s % 4; ++v) {
      SegmentView view;
      view.robot = key.robot;
      view.pose = static_cast<std::uint32_t>(random() % poses);
      view.size = static_cast<std::uint32_t>(random());
      view.centroid_sensor << normal(random), -0.0, 1e300;
      view.descriptor = Descriptor(static_cast<Eigen::Index>(random() % 15));
      for (float& value : view.descriptor) value = normal(random);
      if (v % 3 != 1) {
        auto points = std::make_shared<Points>(random() % 50);
        for (Eigen::Vector3f& p : *points) p << normal(random), normal(random), normal(random);
        view.points_centroid = points;
      }
      map.UpdateSegment(key, view, true, static_cast<StampNs>(random()) - 1000000000);
    }
    map.Find(key)->missed_visits = static_cast<std::uint32_t>(random());
  }
  return map;
}

void ExpectSameTrajectory(const TargetMap& a, const TargetMap& b, RobotIndex robot) {
  EXPECT_EQ(a.RobotName(robot), b.RobotName(robot));
  EXPECT_EQ(a.T_map_odom(robot).matrix(), b.T_map_odom(robot).matrix());
  ASSERT_EQ(a.Trajectory(robot).size(), b.Trajectory(robot).size());
  for (std::size_t i = 0; i < a.Trajectory(robot).size(); ++i) {
    EXPECT_EQ(a.Trajectory(robot)[i].stamp_ns, b.Trajectory(robot)[i].stamp_ns);
    EXPECT_EQ(a.Trajectory(robot)[i].T_odom_sensor.matrix(), b.Trajectory(robot)[i].T_odom_sensor.matrix());
    EXPECT_EQ(a.Trajectory(robot)[i].T_map_sensor.matrix(), b.Trajectory(robot)[i].T_map_sensor.matrix());
  }
}

void ExpectSameKeyframes(const TargetMap& a, const TargetMap& b, RobotIndex robot) {
  ASSERT_EQ(a.Keyframes(robot).size(), b.Keyframes(robot).size());
  for (std::size_t i = 0; i < a.Keyframes(robot).size(); ++i) {
    const Keyframe &was = a.Keyframes(robot)[i], &is = b.Keyframes(robot)[i];
    EXPECT_EQ(was.pose, is.pose);
    ASSERT_EQ(was.scan_sensor == nullptr, is.scan_sensor == nullptr);
    if (was.scan_sensor) {
      EXPECT_EQ(*was.scan_sensor, *is.scan_sensor);
    }
  }
}

void ExpectSameSightings(const TargetMap& a, const TargetMap& b, RobotIndex robot) {
  ASSERT_EQ(a.Sightings(robot).size(), b.Sightings(robot).size());
  for (std::size_t i = 0; i < a.Sightings(robot).size(); ++i) {
    const Sighting &was = a.Sightings(robot)[i], &is = b.Sightings(robot)[i];
    EXPECT_EQ(was.pose, is.pose);
    EXPECT_EQ(was.keyframe.robot, is.keyframe.robot);
    EXPECT_EQ(was.keyframe.index, is.keyframe.index);
  }
}

void ExpectSameView(const SegmentView& a, const SegmentView& b) {
  EXPECT_EQ(a.robot, b.robot);
  EXPECT_EQ(a.pose, b.pose);
  EXPECT_EQ(a.size, b.size);
  EXPECT_EQ(std::memcmp(a.centroid_sensor.data(), b.centroid_sensor.data(), 3 * sizeof(double)), 0);
  ASSERT_EQ(a.descriptor.size(), b.descriptor.size());
  EXPECT_TRUE((a.descriptor.array() == b.descriptor.array()).all());
  ASSERT_EQ(a.points_centroid == nullptr, b.points_centroid == nullptr);
  if (a.points_centroid) {
    EXPECT_EQ(*a.points_centroid, *b.points_centroid);
  }
}

// Equal but for `tracked`, which a file does not hold.
void ExpectSame(const TargetMap& a, const TargetMap& b) {
  ASSERT_EQ(a.robots(), b.robots());
  for (RobotIndex robot = 0; robot < a.robots(); ++robot) {
    ExpectSameTrajectory(a, b, robot);
    ExpectSameKeyframes(a, b, robot);
    ExpectSameSightings(a, b, robot);
  }
  ASSERT_EQ(a.segments().size(), b.segments().size());
  for (auto at = a.segments().begin(), bt = b.segments().begin(); at != a.segments().end(); ++at, ++bt) {
    EXPECT_EQ(at->first, bt->first);
    EXPECT_EQ(at->second.last_seen_ns, bt->second.last_seen_ns);
    EXPECT_EQ(at->second.missed_visits, bt->second.missed_visits);
    ASSERT_EQ(at->second.views.size(), bt->second.views.size());
    for (std::size_t i = 0; i < at->second.views.size(); ++i) ExpectSameView(at->second.views[i], bt->second.views[i]);
  }
}

// A folder with a map in it.
class TargetMapFile : public ::testing::Test {
 protected:
  Bytes Saved(const TargetMap& map) const {
    map.Save(path_);
    std::ifstream file(path_, std::ios::binary);
    return {std::istreambuf_iterator<char>(file), std::istreambuf_iterator<char>()};
  }
  TargetMap Load() const { return TargetMap::Load(path_, {}); }

  // What is said of a file with these bytes, empty if it is accepted.
  std::string Refusal(const Bytes& bytes) const {
    folder_.Write("town.map", bytes);
    try {
      Load();
    } catch (const std::runtime_error& error) {
      EXPECT_NE(std::string(error.what()).find(path_), std::string::npos) << error.what();
      return error.what();
    }
    return "";
  }
  void ExpectRefused(const Bytes& bytes, const std::string& part) const {
    const std::string refusal = Refusal(bytes);
    EXPECT_NE(refusal.find(part), std::string::npos) << (refusal.empty() ? "accepted" : refusal);
  }
  std::ptrdiff_t FilesInFolder() const {
    return std::distance(std::filesystem::directory_iterator(folder_.path()), std::filesystem::directory_iterator());
  }

  const test::TemporaryDirectory folder_;
  const std::string path_ = folder_.path() + "/town.map";
};

TEST_F(TargetMapFile, RoundTripsExactly) {
  for (unsigned seed = 0; seed < 20; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    const TargetMap map = RandomMap(seed, 1 + static_cast<int>(seed % 4), 30, 60);
    map.Save(path_);
    const TargetMap loaded = Load();
    ExpectSame(map, loaded);
    for (const auto& entry : loaded.segments()) EXPECT_FALSE(entry.second.tracked);
  }
}

TEST_F(TargetMapFile, AnEmptyMapRoundTrips) {
  TargetMap{TargetMapParameters()}.Save(path_);
  EXPECT_EQ(Load().robots(), 0u);
}

TEST_F(TargetMapFile, SavingTwiceGivesTheSameBytes) {
  const Bytes first = Saved(RandomMap(1, 3, 20, 30));
  EXPECT_EQ(Saved(Load()), first);
}

TEST_F(TargetMapFile, ALoadedMapGoesOn) {
  TargetMap map{TargetMapParameters()};
  const RobotIndex robot = map.RobotByName("a");
  map.AddPose(robot, 0, Pose::Identity());
  map.CorrectTrajectory(robot, {{0, Pose(Eigen::Translation3d(5, 0, 0))}});
  map.Save(path_);
  TargetMap loaded = Load();
  EXPECT_EQ(loaded.RobotByName("a"), robot);
  EXPECT_THROW(loaded.AddPose(robot, 0, Pose::Identity()), std::invalid_argument);
  loaded.AddPose(robot, 1, Pose(Eigen::Translation3d(1, 0, 0)));
  EXPECT_TRUE(loaded.Trajectory(robot).back().T_map_sensor.translation().isApprox(Eigen::Vector3d(6, 0, 0)));
}

TEST_F(TargetMapFile, FewerViewsAreKeptWhereParametersSaySo) {
  TargetMap map{TargetMapParameters()};
  map.RobotByName("a");
  for (std::uint32_t i = 0; i < 4; ++i) {
    map.AddPose(0, i, Pose::Identity());
    SegmentView view;
    view.pose = i;
    view.size = i == 1 ? 100 : 10 + i;
    map.UpdateSegment({0, 1}, view, true, i);
  }
  map.Save(path_);
  const TargetMap loaded = TargetMap::Load(path_, {2});
  const std::vector<SegmentView>& views = loaded.Find({0, 1})->views;
  ASSERT_EQ(views.size(), 2u);
  EXPECT_EQ(views[0].size, 100u);
  EXPECT_EQ(views[1].size, 13u);
}

TEST_F(TargetMapFile, AnyFlippedBitIsNoticed) {
  const Bytes whole = Saved(RandomMap(1, 2, 3, 4));
  for (std::size_t at = 0; at < whole.size(); at += at < kHeaderSize ? 1 : 11) {
    for (int bit = 0; bit < 8; ++bit) {
      if (at >= kHeaderSize && bit != static_cast<int>(at % 8)) continue;  // of the content one bit of a byte
      Bytes damaged = whole;
      damaged[at] = static_cast<char>(damaged[at] ^ (1 << bit));
      ASSERT_NE(Refusal(damaged), "") << "byte " << at << ", bit " << bit;
    }
  }
}

TEST_F(TargetMapFile, RandomDamageIsNoticed) {
  const Bytes whole = Saved(RandomMap(2, 3, 20, 30));
  for (unsigned seed = 0; seed < 200; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    std::mt19937 random(seed);
    Bytes damaged = whole;
    const std::size_t from = random() % damaged.size();
    const std::size_t length = std::min<std::size_t>(damaged.size() - from, 1 + random() % 64);
    for (std::size_t i = from; i < from + length; ++i) damaged[i] = static_cast<char>(random());
    if (damaged == whole) continue;
    ASSERT_NE(Refusal(damaged), "");
  }
}

TEST_F(TargetMapFile, TruncationIsNoticedAsSuch) {
  const Bytes whole = Saved(RandomMap(3, 2, 3, 4));
  for (std::size_t size = 1; size < whole.size(); size += size < 64 ? 1 : 17)
    ExpectRefused(whole.substr(0, size), "is truncated");
  ExpectRefused("", "is empty");
}

TEST_F(TargetMapFile, WhatIsNoWholeMapOfThisVersionIsRefused) {
  const Bytes whole = Saved(RandomMap(4, 1, 3, 4));
  ExpectRefused(whole + "x", "is damaged");
  ExpectRefused(std::string(100, 'x'), "is not a segment map");
  Bytes newer = whole;
  newer[8] = 4;
  ExpectRefused(newer, "is of version 4");
  Bytes older = whole;
  older[8] = 2;
  ExpectRefused(older, "is of version 2");
}

TEST_F(TargetMapFile, WhatIsNotThereOrNoFileIsRefused) {
  const auto refusal = [](const std::string& path) {
    try {
      TargetMap::Load(path, {});
    } catch (const std::runtime_error& error) {
      return std::string(error.what());
    }
    return std::string("accepted");
  };
  EXPECT_NE(refusal(path_).find("can't read " + path_), std::string::npos) << refusal(path_);
  EXPECT_NE(refusal(folder_.path()).find("it is no file"), std::string::npos) << refusal(folder_.path());
}

// By its definition, bit by bit.
std::uint32_t PlainCrc32(const Bytes& content) {
  std::uint32_t crc = 0xffffffffu;
  for (const char c : content) {
    crc ^= static_cast<unsigned char>(c);
    for (int bit = 0; bit < 8; ++bit) crc = (crc & 1) != 0 ? (crc >> 1) ^ 0xedb88320u : crc >> 1;
  }
  return ~crc;
}

// With the checksum that its content should have.
Bytes Forge(Bytes bytes) {
  const std::uint32_t crc = PlainCrc32(bytes.substr(kHeaderSize));
  for (int i = 0; i < 4; ++i) bytes[12 + static_cast<std::size_t>(i)] = static_cast<char>(crc >> (8 * i));
  return bytes;
}

TEST_F(TargetMapFile, TheChecksumIsACrc32) {
  for (unsigned seed = 0; seed < 8; ++seed) {  // contents of all lengths modulo 4
    TargetMap map{TargetMapParameters()};
    map.RobotByName(std::string(seed, 'x'));
    const Bytes whole = Saved(map);
    EXPECT_EQ(Forge(whole), whole);
  }
}

// A checksum proves nothing about who wrote the file: counts and indices are checked all the same.
TEST_F(TargetMapFile, ForgedContentIsRefusedOrReadWithoutHarm) {
  const Bytes whole = Saved(RandomMap(6, 2, 5, 6));
  std::size_t refused = 0;
  for (unsigned seed = 0; seed < 600; ++seed) {
    SCOPED_TRACE("seed " + std::to_string(seed));
    std::mt19937 random(seed);
    Bytes forged = whole;
    for (unsigned changes = 1 + random() % 3; changes > 0; --changes) {
      const std::size_t at = kHeaderSize + random() % (forged.size() - kHeaderSize);
      forged[at] = static_cast<char>(random() % 3 == 0 ? 0xff : random());
    }
    refused += !Refusal(Forge(forged)).empty();
  }
  EXPECT_GT(refused, 10u);
}

TEST_F(TargetMapFile, TwoRobotsOfOneNameAreRefused) {
  TargetMap map{TargetMapParameters()};
  map.RobotByName("xyz1");
  map.RobotByName("xyz2");
  Bytes forged = Saved(map);
  forged[forged.find("xyz2") + 3] = '1';
  ExpectRefused(Forge(forged), "two robots have the same name");
}

TEST_F(TargetMapFile, SavingReplacesTheFileAndLeavesNothingElse) {
  RandomMap(7, 1, 3, 4).Save(path_);
  const TargetMap second = RandomMap(8, 2, 4, 5);
  second.Save(path_);
  ExpectSame(second, Load());
  EXPECT_EQ(FilesInFolder(), 1);
}

TEST_F(TargetMapFile, SavingWhereNothingCanBeWrittenIsRefused) {
  const TargetMap map = RandomMap(9, 1, 3, 4);
  EXPECT_THROW(map.Save(folder_.path() + "/missing/town.map"), std::runtime_error);
  folder_.MakeFolder("town.map/with/something");  // a folder where the file should be
  EXPECT_THROW(map.Save(path_), std::runtime_error);
  EXPECT_EQ(FilesInFolder(), 1);
}

// A disk that is full in the middle of a save: the size limit of files stands in for it.
[[noreturn]] void SaveOnAFullDisk(const TargetMap& map, const std::string& path) {
  std::signal(SIGXFSZ, SIG_IGN);
  const struct rlimit limit { 4096, 4096 };
  ::setrlimit(RLIMIT_FSIZE, &limit);
  try {
    map.Save(path);
  } catch (const std::runtime_error&) {
    std::_Exit(7);
  }
  std::_Exit(0);
}

TEST_F(TargetMapFile, AFullDiskLeavesThePreviousFileWhole) {
  const TargetMap first = RandomMap(12, 1, 3, 4);
  first.Save(path_);
  EXPECT_EXIT(SaveOnAFullDisk(RandomMap(13, 2, 100, 200), path_), ::testing::ExitedWithCode(7), "");
  ExpectSame(first, Load());
  EXPECT_EQ(FilesInFolder(), 1);
}

// Killed in the middle of a save: what was written so far lies beside the map.
TEST_F(TargetMapFile, ACrashLeavesThePreviousFileWholeAndTheNextSaveClearsUp) {
  const TargetMap first = RandomMap(14, 1, 3, 4);
  const Bytes whole = Saved(first);
  folder_.Write("town.map.part", whole.substr(0, whole.size() / 2));
  ExpectSame(first, Load());
  first.Save(path_);
  ExpectSame(first, Load());
  EXPECT_EQ(FilesInFolder(), 1);
}

}  // namespace
}  // namespace incremental_segmatch
