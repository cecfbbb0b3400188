#!/usr/bin/env bash
# Installs what is missing, builds, simulates a drive through a town, plays it as a bag through the nodelets, and says
# which loops were found and what became of the drift.
set -euo pipefail
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)

usage() {
  cat <<'USAGE'
Usage: demo.sh [--headless] [--again] [--rate R] [--out FOLDER]

Installs what is missing, builds, simulates a drive through a town, plays it as a bag through the nodelets, and says which loops
were found, how many of them are false, and what became of the drift. Needs 5 GB of disk while it simulates, and keeps 2.3 GB in
build/demo. Ends non-zero if no loop was found.

  --headless    no rviz; without a display there is none anyway
  --again       play the drive even if nothing has changed since the last time
  --rate R      play R times as fast as real time (default: 2)
  --out FOLDER  where the results go (default: build/demo/results)
USAGE
}

headless=false again=false rate=2 cache=$root/build/demo out=
while [[ $# -gt 0 ]]; do
  case "$1" in
    --headless) headless=true ;;
    --again) again=true ;;
    --rate | --out)
      if [[ $# -lt 2 ]]; then echo "demo.sh: $1 needs a value" >&2; exit 2; fi
      if [[ $1 == --rate ]]; then rate=$2; else out=$2; fi
      shift
      ;;
    --help | -h) usage; exit 0 ;;
    *) echo "demo.sh: unknown option $1" >&2; usage >&2; exit 2 ;;
  esac
  shift
done
out=$(realpath -m "${out:-$cache/results}")
rviz=true
if $headless || [[ -z ${DISPLAY:-} ]]; then rviz=false; fi

"$root/scripts/install_dependencies.sh"
"$root/scripts/build.sh"
program=$root/devel/lib/incremental_segmatch/segmatch
if [[ ! -f $root/devel/setup.bash ]]; then
  echo "demo.sh: catkin was not found, so nothing was built that could play a bag." >&2
  exit 1
fi

# The drive and its bag, as long as the program is the same.
bag=$cache/drive.bag
drive=$cache/drive
if [[ ! -f $bag || $program -nt $bag ]]; then
  rm -rf "$drive" "$bag" "$cache/unfinished.bag"
  mkdir -p "$cache"
  echo "Simulating a drive through a town ..."
  "$program" simulate --out "$drive" --sequence 00 --route loops --stride 2
  "$program" kitti2bag --kitti "$drive" --sequence 00 --out "$cache/unfinished.bag"
  rm -rf "$drive/sequences/00/velodyne"  # the bag has the scans
  mv "$cache/unfinished.bag" "$bag"
fi

# The results, as long as bag, nodelets, launch files and presets are the same.
is_up_to_date() {
  [[ -f $out/played && $out/played -nt $bag ]] || return 1
  [[ -z $(find "$root"/devel/lib/*.so "$root/launch" "$root/config" -type f -newer "$out/played" -print -quit) ]]
}
if ! $again && is_up_to_date; then
  echo "Nothing has changed since the drive was played last; --again plays it again."
else
  set +u
  source "$root/devel/setup.bash"
  set -u
  # A master of its own, so that nothing else that runs here is disturbed.
  port=$(python3 -c 'import socket; s = socket.socket(); s.bind(("localhost", 0)); print(s.getsockname()[1])')
  export ROS_MASTER_URI=http://localhost:$port ROS_HOSTNAME=localhost ROS_LOG_DIR=$cache/log
  rm -rf "$ROS_LOG_DIR"
  mkdir -p "$out" "$ROS_LOG_DIR"
  rm -f "$out"/{played,closures.csv,trajectory_odometry.tum,trajectory_optimized.tum,pose_graph.g2o}
  seconds=$(awk -v rate="$rate" 'END {printf "%.0f", $1 / rate}' "$drive/sequences/00/times.txt")
  echo "Playing the drive, which takes $seconds s (ROS_MASTER_URI=$ROS_MASTER_URI). At the bag's end roslaunch calls the player a"
  echo "required process that has died, and ends with it: so it is meant."
  roslaunch -p "$port" incremental_segmatch demo.launch bag:="$bag" out:="$out" rate:="$rate" rviz:="$rviz"
  touch "$out/played"
fi

echo
echo "What was found, judged against the simulation's truth:"
"$program" score --kitti "$drive" --sequence 00 --results "$out"
cat <<NEXT

In $out:
  closures.csv       every accepted recognition, with its relative pose
  trajectory_*.tum   the path as odometry had it, and corrected
  pose_graph.g2o     odometry and closures, for g2o and GTSAM
The same drive without ROS, with maps, times and the stage that ended each step on a page, report.html:
  $program evaluate --bag $bag --out $cache/page
With your own robot or bag (README.md, "With your own robot"; docs/troubleshooting.md if nothing comes out):
  source $root/devel/setup.bash
  roslaunch incremental_segmatch segmatch.launch cloud_topic:=/points odom_frame:=odom base_frame:=base_link
  and for a bag, before: roscore, rosparam set use_sim_time true; after: rosbag play --clock BAG
NEXT
