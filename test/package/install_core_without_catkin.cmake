# Configures the package as where catkin is absent, builds the core alone and installs it.
#   cmake -DSOURCE=... -DBUILD=... -DPREFIX=... -P install_core_without_catkin.cmake
cmake_minimum_required(VERSION 3.16)

function(run)
  execute_process(COMMAND ${ARGN} RESULT_VARIABLE result)
  if(NOT result EQUAL 0)
    message(FATAL_ERROR "failed (${result}): ${ARGN}")
  endif()
endfunction()

file(REMOVE_RECURSE ${PREFIX})
run(${CMAKE_COMMAND} -S ${SOURCE} -B ${BUILD} -DCMAKE_BUILD_TYPE=Debug -DCMAKE_CXX_FLAGS_DEBUG=-O0 -DCMAKE_INSTALL_PREFIX=${PREFIX}
    -DSEGMATCH_WITH_ROS=OFF -DSEGMATCH_BUILD_TESTS=OFF -DSEGMATCH_BUILD_BENCHMARKS=OFF)
run(${CMAKE_COMMAND} --build ${BUILD} --target incremental_segmatch)
run(${CMAKE_COMMAND} --install ${BUILD} --component core)
