#!/usr/bin/env bash
# Installs what is missing, builds, and runs all tests: unit, property, regression, package and ROS tests.
# Ends with ctest's summary, and non-zero if anything failed. Arguments go to ctest: scripts/test.sh -R grid
set -euo pipefail
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
if [[ ${1:-} == --help || ${1:-} == -h ]]; then
  sed -n '2,3s/^# //p' "${BASH_SOURCE[0]}"
  exit 0
fi

"$root/scripts/install_dependencies.sh"
"$root/scripts/build.sh"

# The ROS tests find nodelets and messages through the devel space.
if [[ -f $root/devel/setup.bash ]]; then
  set +u
  source "$root/devel/setup.bash"
  set -u
else
  echo "test.sh: built without ROS (catkin was not found): no nodelet is tested." >&2
fi
cd "$root/build"
ctest --output-on-failure --no-tests=error --parallel "$(nproc)" "$@"
