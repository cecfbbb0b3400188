#include "evaluation/kitti_io.hpp"

#include <gtest/gtest.h>

#include <filesystem>

#include "support/kitti_layout.hpp"
#include "support/temporary_directory.hpp"

namespace incremental_segmatch {
namespace {

using test::MessageOf;

class KittiIo : public testing::Test {
 protected:
  KittiIo() { test::WriteKittiLayout(drive_, directory_, "07"); }

  std::string ErrorOf(const std::string& odometry = "") const {
    return MessageOf([&] { KittiDrive({directory_.path(), "07", odometry}); });
  }
  // Opening the drive must fail, naming these words.
  void ExpectError(const std::vector<std::string>& words, const std::string& odometry = "") const {
    const std::string error = ErrorOf(odometry);
    for (const std::string& word : words) {
      EXPECT_NE(error.find(word), std::string::npos) << "`" << word << "` is not in: " << error;
    }
  }

  test::TinyDrive drive_ = test::MakeTinyDrive(5);
  test::TemporaryDirectory directory_;
};

TEST_F(KittiIo, ReadsWhatWasWritten) {
  KittiDrive drive({directory_.path(), "07", "odometry.txt"});
  ASSERT_EQ(drive.size(), 5u);
  EXPECT_FALSE(drive.odometry_is_truth());
  for (std::size_t i = 0; i < 5; ++i) {
    EXPECT_EQ(drive.stamp_ns(i), static_cast<StampNs>(i) * 100000000);
    EXPECT_TRUE(drive.T_world_sensor(i)->isApprox(drive_.T_world_sensor[i], 1e-9)) << "LiDAR frame, not camera frame";
    EXPECT_TRUE(drive.T_odom_sensor(i).isApprox(drive_.T_odom_sensor[i], 1e-9));
    const Points points = drive.ReadPoints(i);
    ASSERT_EQ(points.size(), 4u);
    EXPECT_EQ(points[0], Eigen::Vector3f(1.f + static_cast<float>(i), 2.f, 3.f));
    EXPECT_EQ(points[1], Eigen::Vector3f(-4.f, 5.5f, -1.f));
    EXPECT_TRUE(std::isnan(points[3].x()));
  }
  EXPECT_EQ(drive.ReadScan(0).intensities[1], 0.5f);
}

TEST_F(KittiIo, WithoutOdometryThePosesServeAndThisIsSaid) {
  const KittiDrive drive({directory_.path(), "07", ""});
  EXPECT_TRUE(drive.odometry_is_truth());
  EXPECT_TRUE(drive.T_odom_sensor(3).isApprox(drive_.T_world_sensor[3], 1e-9));
  EXPECT_NE(drive.notes().front().find("does not drift"), std::string::npos) << drive.notes().front();
}

TEST_F(KittiIo, WithoutPosesThereIsNoTruth) {
  std::filesystem::remove(directory_.path() + "/poses/07.txt");
  const KittiDrive drive({directory_.path(), "07", "odometry.txt"});
  EXPECT_FALSE(drive.T_world_sensor(0).has_value());
  ExpectError({"poses/07.txt", "--odometry"});
}

TEST_F(KittiIo, ErrorsNameFileAndRemedy) {
  EXPECT_NE(MessageOf([&] {
              KittiDrive({directory_.path(), "99", ""});
            }).find("99/velodyne is no folder"),
            std::string::npos);
  ExpectError({"nowhere.txt", "no such odometry"}, "nowhere.txt");
  const auto spoil = [&](const std::string& file, const std::string& content, const std::vector<std::string>& words) {
    SCOPED_TRACE(file + ": " + content.substr(0, 40));
    directory_.Write(file, content);
    ExpectError(words);
    test::WriteKittiLayout(drive_, directory_, "07");
  };
  spoil("sequences/07/times.txt", "0.0\n0.1\n", {"times.txt", "2 rows for 5 scans"});
  spoil("sequences/07/times.txt", "0.0\n0.1\n0.1\n0.3\n0.4\n", {"times.txt, line 3", "increase"});
  spoil("sequences/07/times.txt", "0.0\nbla\n", {"times.txt, line 2", "seconds"});
  spoil("poses/07.txt", "1 0 0 0 0 1 0 0 0 0 1\n", {"07.txt, line 1", "12 numbers", "found 11"});
  spoil("poses/07.txt", "1 0 0 0 0 2 0 0 0 0 1 0\n", {"07.txt, line 1", "no rotation"});
  spoil("poses/07.txt", "1 0 0 nan 0 1 0 0 0 0 1 0\n", {"07.txt, line 1", "finite"});
  spoil("poses/07.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n", {"07.txt", "1 rows for 5 scans"});
  spoil("sequences/07/calib.txt", "P0: 1 0 0 0 0 1 0 0 0 0 1 0\n", {"calib.txt", "no row `Tr:`"});
  EXPECT_EQ(ErrorOf(), "") << "the unspoilt drive opens";
}

TEST_F(KittiIo, CutOffScanIsRefused) {
  directory_.Write("sequences/07/velodyne/000002.bin", "12345678901234567");
  KittiDrive drive({directory_.path(), "07", ""});
  const std::string error = MessageOf([&] { drive.ReadPoints(2); });
  EXPECT_NE(error.find("000002.bin has 17 bytes"), std::string::npos) << error;
}

TEST_F(KittiIo, APartOfADriveIsRead) {
  std::filesystem::remove(directory_.path() + "/sequences/07/velodyne/000003.bin");
  const KittiDrive drive({directory_.path(), "07", ""});
  EXPECT_EQ(drive.size(), 3u);
  EXPECT_NE(drive.notes().front().find("only the first 3 of 5"), std::string::npos);
}

TEST_F(KittiIo, EmptyScanIsAScan) {
  directory_.Write("sequences/07/velodyne/000001.bin", "");
  KittiDrive drive({directory_.path(), "07", ""});
  EXPECT_EQ(drive.size(), 5u);
  EXPECT_TRUE(drive.ReadPoints(1).empty());
}

}  // namespace
}  // namespace incremental_segmatch
