# Install and export rules. One find_package(incremental_segmatch) serves catkin and plain CMake, from the devel space and
# from an install prefix; the targets that it gives are described in incremental_segmatchLibraries.cmake.in.
include(CMakePackageConfigHelpers)
include(GNUInstallDirs)

set(SEGMATCH_CMAKE_DESTINATION share/${PROJECT_NAME}/cmake)
if(SEGMATCH_ROS)
  set(SEGMATCH_LIBRARY_DESTINATION ${CATKIN_PACKAGE_LIB_DESTINATION})
  set(SEGMATCH_PROGRAM_DESTINATION ${CATKIN_PACKAGE_BIN_DESTINATION})
  if(CMAKE_INSTALL_PREFIX STREQUAL "/usr")
    set(SEGMATCH_CMAKE_DESTINATION ${CATKIN_GLOBAL_LIB_DESTINATION}/cmake/${PROJECT_NAME})  # where catkin puts its part then
  endif()
else()
  set(SEGMATCH_LIBRARY_DESTINATION ${CMAKE_INSTALL_LIBDIR})
  set(SEGMATCH_PROGRAM_DESTINATION ${CMAKE_INSTALL_BINDIR})
  # The program lies where catkin would put it.
  set(CATKIN_DEVEL_PREFIX ${PROJECT_BINARY_DIR}/devel CACHE PATH "Folder of the devel space")
  set_target_properties(segmatch PROPERTIES
    RUNTIME_OUTPUT_DIRECTORY ${CATKIN_DEVEL_PREFIX}/lib/${PROJECT_NAME})
endif()

add_library(${PROJECT_NAME}::incremental_segmatch ALIAS incremental_segmatch)
add_library(${PROJECT_NAME}::pose_graph ALIAS incremental_segmatch_pose_graph)
set_target_properties(incremental_segmatch_pose_graph PROPERTIES EXPORT_NAME pose_graph)

# The core apart from the pose graph: `cmake --install BUILD --component core` asks for nothing else to be built.
install(TARGETS incremental_segmatch EXPORT incremental_segmatchCore
  ARCHIVE DESTINATION ${SEGMATCH_LIBRARY_DESTINATION} COMPONENT core
  LIBRARY DESTINATION ${SEGMATCH_LIBRARY_DESTINATION} COMPONENT core)
install(EXPORT incremental_segmatchCore NAMESPACE ${PROJECT_NAME}::
  DESTINATION ${SEGMATCH_CMAKE_DESTINATION} COMPONENT core)
install(DIRECTORY include/${PROJECT_NAME} DESTINATION ${CMAKE_INSTALL_INCLUDEDIR} COMPONENT core
  FILES_MATCHING PATTERN "*.hpp"
  PATTERN "batch_baseline.hpp" EXCLUDE)  # a baseline to compare with, not for users

install(TARGETS incremental_segmatch_pose_graph EXPORT incremental_segmatchPoseGraph
  ARCHIVE DESTINATION ${SEGMATCH_LIBRARY_DESTINATION} COMPONENT pose_graph
  LIBRARY DESTINATION ${SEGMATCH_LIBRARY_DESTINATION} COMPONENT pose_graph)
install(EXPORT incremental_segmatchPoseGraph NAMESPACE ${PROJECT_NAME}::
  DESTINATION ${SEGMATCH_CMAKE_DESTINATION} COMPONENT pose_graph)

file(RELATIVE_PATH SEGMATCH_LIBRARIES_FROM_PROGRAM
  /prefix/${SEGMATCH_PROGRAM_DESTINATION} /prefix/${SEGMATCH_LIBRARY_DESTINATION})
set_target_properties(incremental_segmatch_pose_graph PROPERTIES INSTALL_RPATH $ORIGIN)
set_target_properties(segmatch PROPERTIES INSTALL_RPATH $ORIGIN/${SEGMATCH_LIBRARIES_FROM_PROGRAM})
install(TARGETS segmatch RUNTIME DESTINATION ${SEGMATCH_PROGRAM_DESTINATION} COMPONENT program)
if(SEGMATCH_ROS)
  install(PROGRAMS launch/play_bag.sh launch/rviz.sh DESTINATION ${SEGMATCH_PROGRAM_DESTINATION} COMPONENT program)
endif()

# Build tree.
set(SEGMATCH_DEVEL_CMAKE ${CATKIN_DEVEL_PREFIX}/share/${PROJECT_NAME}/cmake)
export(EXPORT incremental_segmatchCore NAMESPACE ${PROJECT_NAME}::
  FILE ${SEGMATCH_DEVEL_CMAKE}/incremental_segmatchCore.cmake)
export(EXPORT incremental_segmatchPoseGraph NAMESPACE ${PROJECT_NAME}::
  FILE ${SEGMATCH_DEVEL_CMAKE}/incremental_segmatchPoseGraph.cmake)

# Without catkin, which writes its own, the package's config is ours.
if(NOT SEGMATCH_ROS)
  configure_file(cmake/incremental_segmatchLibraries.cmake.in
    ${SEGMATCH_DEVEL_CMAKE}/incremental_segmatchLibraries.cmake @ONLY)
  file(WRITE ${SEGMATCH_DEVEL_CMAKE}/incremental_segmatchConfig.cmake
    "include(\${CMAKE_CURRENT_LIST_DIR}/incremental_segmatchLibraries.cmake)\n")
  write_basic_package_version_file(${SEGMATCH_DEVEL_CMAKE}/incremental_segmatchConfigVersion.cmake
    COMPATIBILITY SameMinorVersion)
  install(FILES
    ${SEGMATCH_DEVEL_CMAKE}/incremental_segmatchLibraries.cmake
    ${SEGMATCH_DEVEL_CMAKE}/incremental_segmatchConfig.cmake
    ${SEGMATCH_DEVEL_CMAKE}/incremental_segmatchConfigVersion.cmake
    DESTINATION ${SEGMATCH_CMAKE_DESTINATION} COMPONENT core)
endif()
