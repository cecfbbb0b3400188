// Of the tests with a master of their own.
#include <gtest/gtest.h>
#include <ros/ros.h>

int main(int argc, char** argv) {
  testing::InitGoogleTest(&argc, argv);
  ros::init(argc, argv, "incremental_segmatch_test");
  ros::NodeHandle nh;  // keeps the node alive between tests
  return RUN_ALL_TESTS();
}
