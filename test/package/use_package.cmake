# Builds the program of program/ against an installed or built package, and runs it on a simulated drive.
#   cmake -DSOURCE=... -DBUILD=... -DPREFIX=... -DSEGMATCH=... -P use_package.cmake
# SOURCE: folder of the program. BUILD: scratch folder. PREFIX: install prefix or devel space.
# SEGMATCH: the program segmatch.
cmake_minimum_required(VERSION 3.16)

function(run)
  execute_process(COMMAND ${ARGN} RESULT_VARIABLE result)
  if(NOT result EQUAL 0)
    message(FATAL_ERROR "failed (${result}): ${ARGN}")
  endif()
endfunction()

file(REMOVE_RECURSE ${BUILD})
run(${CMAKE_COMMAND} -S ${SOURCE} -B ${BUILD} -DCMAKE_BUILD_TYPE=Debug -DCMAKE_CXX_FLAGS_DEBUG=-O0 -DCMAKE_PREFIX_PATH=${PREFIX}
    -DPYTHON_EXECUTABLE=/usr/bin/python3 -DPython3_EXECUTABLE=/usr/bin/python3)
run(${CMAKE_COMMAND} --build ${BUILD})
run(${SEGMATCH} simulate --out ${BUILD}/drive --sensor VLP-16 --max-scans 3)
execute_process(COMMAND ${BUILD}/close_loops ${BUILD}/drive/sequences/00
  RESULT_VARIABLE result OUTPUT_VARIABLE output)
if(NOT result EQUAL 0 OR NOT output MATCHES "scan 2: [1-9][0-9]* segments")
  message(FATAL_ERROR "close_loops ended with ${result} and said:\n${output}")
endif()
message(STATUS "close_loops said:\n${output}")
