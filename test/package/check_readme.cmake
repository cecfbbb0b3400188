# The program in the README is the one that the tests compile.
#   cmake -DREADME=... -DPROGRAM=... -P check_readme.cmake
cmake_minimum_required(VERSION 3.16)
file(READ ${README} readme)
file(READ ${PROGRAM} program)
string(FIND "${readme}" "```cpp\n${program}```" position)
if(position EQUAL -1)
  message(FATAL_ERROR "${README} does not quote ${PROGRAM} as it is")
endif()
