#!/bin/sh
# rviz.sh FRAME CONFIG ARGUMENTS...
# rviz with a configuration in which the camera follows a frame. It reads a copy: what is saved there goes when it ends.
frame=$1 config=$2
shift 2
copy=$(mktemp --suffix=.rviz) || exit
trap 'rm -f "$copy"' EXIT
sed "s|Target Frame: .*|Target Frame: $frame|" "$config" > "$copy"
rviz -d "$copy" "$@"
