#!/usr/bin/env bash
# Builds into build/ and devel/ at the repository's root; the program is devel/lib/incremental_segmatch/segmatch.
# Arguments go to cmake: scripts/build.sh -DSEGMATCH_BUILD_BENCHMARKS=OFF
set -euo pipefail
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)

# Ubuntu keeps ROS in a place of its own, Debian with everything else.
if [[ -z ${ROS_DISTRO:-} && -f /opt/ros/noetic/setup.bash ]]; then
  set +u
  source /opt/ros/noetic/setup.bash
  set -u
fi

# A compiler may take 2 GB.
cores=$(nproc)
memory_jobs=$(awk '/^MemTotal:/ {print int($2 / 2000000)}' /proc/meminfo)
jobs=$((memory_jobs < cores ? memory_jobs : cores))
jobs=$((jobs < 1 ? 1 : jobs))

# Make configures anew by itself when a CMake file has changed.
if [[ $# -gt 0 || ! -f $root/build/Makefile ]]; then
  cmake -S "$root" -B "$root/build" -G "Unix Makefiles" -DCATKIN_DEVEL_PREFIX="$root/devel" "$@"
fi
cmake --build "$root/build" --parallel "$jobs"
# The ROS tests' programs are no part of catkin's target `all`.
if make -C "$root/build" -q tests >/dev/null 2>&1 || [[ $? -eq 1 ]]; then
  cmake --build "$root/build" --parallel "$jobs" --target tests
fi
