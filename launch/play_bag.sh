#!/bin/sh
# play_bag.sh SETTLE_S BAG CLOUD_TOPIC ARGUMENTS OF rosbag play...
# Plays a bag, if it has the clouds, and then stays for a while: a launch file that ends with its player so leaves the nodes
# time for what is queued.
settle_s=$1 bag=$2 cloud_topic=$3
shift 3
for argument in "$@"; do # roslaunch adds __name:=... and __log:=..., which rosbag play would take for files
  shift
  case $argument in
    __*) ;;
    *) set -- "$@" "$argument" ;;
  esac
done
if [ ! -f "$bag" ]; then
  echo "There is no bag $bag. Give its whole path, as bag:=\$PWD/drive.bag: roslaunch starts programs in $(pwd)." >&2
  exit 1
fi
topics=$(rosbag info --yaml --key=topics "$bag") || exit
case "$topics " in
  *"topic: $cloud_topic
"*) ;;
  *)
    echo "$bag has no $cloud_topic, which the argument style of kitti.launch stands for; PointCloud2 is on:" \
      "$(echo "$topics" | awk '/topic:/ {topic = $3} /type: sensor_msgs\/PointCloud2/ {print topic}' | paste -sd ' ')." >&2
    exit 1
    ;;
esac
rosbag play "$bag" "$@" || exit
sleep "$settle_s"
