#!/usr/bin/env bash
# Installs what building, testing and running incremental_segmatch needs, as far as it is missing.
set -euo pipefail

usage() {
  cat <<'USAGE'
Usage: install_dependencies.sh [--benchmark] [--docs] [--pictures] [--tools] [--all] [--list]

Installs the packages that are missing for building, the tests, the demo and rviz. Needs root or sudo only where
something is missing. Recommended packages are not installed.

  --benchmark  also for the benchmarks (google-benchmark, FLANN)
  --docs       also for the target `docs` (Doxygen)
  --pictures   also for pictures of rviz without a display (ImageMagick)
  --tools      also clang-format and clang-tidy
  --all        all of these
  --list       print the names of the packages, and install nothing
USAGE
}

benchmark=false docs=false pictures=false tools=false list=false
for argument in "$@"; do
  case "$argument" in
    --benchmark) benchmark=true ;;
    --docs) docs=true ;;
    --pictures) pictures=true ;;
    --tools) tools=true ;;
    --all) benchmark=true docs=true pictures=true tools=true ;;
    --list) list=true ;;
    --help | -h) usage; exit 0 ;;
    *) echo "install_dependencies.sh: unknown option $argument" >&2; usage >&2; exit 2 ;;
  esac
done

system="unknown"
if [[ -r /etc/os-release ]]; then
  system=$(. /etc/os-release && echo "${ID:-unknown}-${VERSION_ID:-}")
fi

packages=(
  build-essential cmake pkg-config python3
  libceres-dev libcli11-dev libeigen3-dev libgtest-dev libpcl-dev libyaml-cpp-dev nlohmann-json3-dev
  libgl1-mesa-dri xvfb  # a test starts rviz
)
case "$system" in
  debian-12)
    # Debian's own ROS 1, one package per interface and library.
    packages+=(
      catkin ros-message-generation ros-message-runtime
      ros-diagnostic-msgs ros-geometry-msgs ros-nav-msgs ros-sensor-msgs ros-std-msgs ros-std-srvs ros-tf2-msgs
      ros-visualization-msgs
      libdiagnostic-msgs-dev libdiagnostic-updater-dev libdynamic-reconfigure-config-init-mutex-dev libgeometry-msgs-dev
      libnav-msgs-dev libnodeletlib-dev libros-rosgraph-msgs-dev librosbag-dev libroscpp-dev librostest-dev
      libsensor-msgs-dev libstd-msgs-dev libstd-srvs-dev libtf2-dev libtf2-eigen-dev libtf2-msgs-dev libtf2-ros-dev
      libtopic-tools-dev libvisualization-msgs-dev pluginlib-dev
      libnodeletlib-tools python3-dynamic-reconfigure python3-rosbag python3-roslaunch python3-rosnode
      python3-rosparam python3-rosservice python3-rospy python3-rostest python3-rostopic rosout rospack-tools rviz
      # for rostopic echo and rosservice call
      python3-diagnostic-msgs python3-geometry-msgs python3-nav-msgs python3-std-srvs
    )
    ;;
  ubuntu-20.04)
    names=(
      catkin message-generation message-runtime
      diagnostic-msgs diagnostic-updater dynamic-reconfigure geometry-msgs nav-msgs nodelet pluginlib rosbag rosbash
      roscpp rosgraph-msgs roslaunch rosnode rosout rosparam rosservice rostest rostopic rviz sensor-msgs std-msgs
      std-srvs tf2 tf2-eigen tf2-msgs tf2-ros topic-tools visualization-msgs
    )
    packages+=("${names[@]/#/ros-noetic-}")
    ;;
  *)
    cat >&2 <<MESSAGE
install_dependencies.sh: this system ($system) is none that the script knows (Debian 12; Ubuntu 20.04, untried).
Install these yourself, then run cmake:
  a C++17 compiler, CMake 3.16, pkg-config, Python 3
  Eigen 3.3, yaml-cpp, PCL 1.10, Ceres Solver 2.1, CLI11, nlohmann-json, GoogleTest
  for the nodelets and bags, ROS 1: catkin, roscpp, nodelet, pluginlib, rosbag, tf2, tf2_ros, tf2_eigen, tf2_msgs,
  diagnostic_updater, dynamic_reconfigure, message_generation, std_msgs, std_srvs, geometry_msgs, nav_msgs,
  sensor_msgs, visualization_msgs, diagnostic_msgs, rostest, roslaunch, rviz
MESSAGE
    exit 1
    ;;
esac
if $benchmark; then packages+=(libbenchmark-dev libflann-dev); fi
if $docs; then packages+=(doxygen graphviz); fi
if $pictures; then packages+=(imagemagick); fi
if $tools; then packages+=(clang-format clang-tidy); fi

if $list; then
  printf '%s\n' "${packages[@]}"
  exit 0
fi

installed=$(dpkg-query -W -f='${db:Status-Status} ${Package}\n' "${packages[@]}" 2>/dev/null || true)
missing=()
for package in "${packages[@]}"; do
  if ! grep -qx "installed $package" <<<"$installed"; then missing+=("$package"); fi
done
if [[ ${#missing[@]} -eq 0 ]]; then
  echo "Dependencies: all ${#packages[@]} packages are installed."
  exit 0
fi
echo "Dependencies: ${#missing[@]} of ${#packages[@]} packages are missing: ${missing[*]}"

as_root=()
if [[ $EUID -ne 0 ]]; then
  if ! command -v sudo >/dev/null; then
    echo "install_dependencies.sh: neither root nor sudo. As root, run: apt-get install ${missing[*]}" >&2
    exit 1
  fi
  as_root=(sudo)
fi
"${as_root[@]}" apt-get update -q

available=$(apt-cache show --no-all-versions "${missing[@]}" 2>/dev/null | sed -n 's/^Package: //p')
unavailable=()
for package in "${missing[@]}"; do
  if ! grep -qx "$package" <<<"$available"; then unavailable+=("$package"); fi
done
if [[ ${#unavailable[@]} -gt 0 ]]; then
  echo "install_dependencies.sh: no configured package source has: ${unavailable[*]}" >&2
  if [[ $system == ubuntu-20.04 && "${unavailable[*]}" == *ros-noetic-* ]]; then
    cat >&2 <<'MESSAGE'
ROS's own package source is missing: set it up as http://wiki.ros.org/noetic/Installation/Ubuntu says (sections 1.2
and 1.3), then run this again. Ubuntu 20.04 is untried.
MESSAGE
  elif [[ $system == ubuntu-20.04 ]]; then
    echo "Install these from their sources, then run cmake. Ubuntu 20.04 is untried." >&2
  else
    echo "Enable Debian's component main in /etc/apt/sources.list, then run this again." >&2
  fi
  exit 1
fi
"${as_root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get install -y -q --no-install-recommends "${missing[@]}"
