# Messages, services and what catkin tells other packages. Included before src/, so that targets land in the devel space.
add_message_files(DIRECTORY msg FILES
  LoopClosure.msg
  MatchedSegments.msg
  Segment.msg
  SegmentArray.msg
  SegmentRenaming.msg
  SegmentRetirement.msg
  StepReport.msg
)
add_service_files(DIRECTORY srv FILES
  LoadMap.srv
  RequestFullState.srv
  SaveMap.srv
)
generate_messages(DEPENDENCIES geometry_msgs std_msgs)
generate_dynamic_reconfigure_options(cfg/BackEnd.cfg cfg/FrontEnd.cfg)

catkin_package(
  INCLUDE_DIRS include
  LIBRARIES incremental_segmatch incremental_segmatch_pose_graph incremental_segmatch_nodelets
  CATKIN_DEPENDS diagnostic_msgs diagnostic_updater dynamic_reconfigure geometry_msgs message_runtime nav_msgs nodelet pluginlib roscpp sensor_msgs
                 std_msgs std_srvs tf2 tf2_eigen tf2_msgs tf2_ros visualization_msgs
  DEPENDS EIGEN3
  CFG_EXTRAS incremental_segmatchLibraries.cmake
)
