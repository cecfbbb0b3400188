#!/bin/sh
# play_bag.sh SETTLE_S ARGUMENTS OF rosbag play...
# Plays a bag and then stays for a while: a launch file that ends with its player so leaves the nodes time for what is queued.
settle_s=$1
shift
for argument in "$@"; do # roslaunch adds __name:=... and __log:=..., which rosbag play would take for files
  shift
  case $argument in
    __*) ;;
    *) set -- "$@" "$argument" ;;
  esac
done
rosbag play "$@" || exit
sleep "$settle_s"
