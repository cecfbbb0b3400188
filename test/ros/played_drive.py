#!/usr/bin/python3
"""A small simulated drive played as a bag through the launch files: the closures are those of `segmatch evaluate`.

played_drive.py prepare PROGRAM FOLDER           simulates, makes a bag of either style
played_drive.py compare PROGRAM FOLDER STYLE CONFIG   kitti.launch without pose graph, against evaluate --no-optimization
played_drive.py demo PROGRAM FOLDER STYLE CONFIG      demo.launch with everything: loops, files, and it ends by itself
played_drive.py overload PROGRAM FOLDER STYLE CONFIG  played as `rosbag play -r 20` plays scans at 10 Hz: the newest are kept
"""
import csv
import math
import os
import pathlib
import shutil
import signal
import socket
import subprocess
import sys
import time

STYLES = ("kitti2bag", "velodyne_points")
# One lap and a third, at 0.8 s a scan.
DRIVE = ["--sequence", "00", "--route", "lap", "--stride", "8", "--seed", "5", "--max-scans", "145"]
EPOCH_S = 1317000000
TIMEOUT_S = 200


def run(*command):
    subprocess.run([str(part) for part in command], check=True, stdout=subprocess.DEVNULL)


def prepare(program, folder):
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    run(program, "simulate", "--out", folder / "drive", *DRIVE)
    for style in STYLES:
        run(program, "kitti2bag", "--kitti", folder / "drive", "--sequence", "00", "--style", style, "--out",
            folder / (style + ".bag"))
    shutil.rmtree(folder / "drive/sequences/00/velodyne")


def own_master(folder):
    """Environment with a master and logs of this test alone, and the master's port."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    os.environ.update(ROS_MASTER_URI="http://localhost:%d" % port, ROS_HOSTNAME="localhost",
                      ROS_LOG_DIR=str(folder / "log"))
    return port


def rows(path):
    """Closures by the milliseconds of both stamps, without the epoch that a bag adds to them."""
    with open(path) as file:
        return {tuple(round(1e3 * (float(row[key]) % EPOCH_S)) for key in ("stamp_query", "stamp_target")): row
                for row in csv.DictReader(file) if row["rms_m"]}


def distance(a, b):
    """Between the poses of two rows: metres, radians."""
    metres = math.dist([float(a[key]) for key in ("x", "y", "z")], [float(b[key]) for key in ("x", "y", "z")])
    dot = abs(sum(float(a[key]) * float(b[key]) for key in ("qx", "qy", "qz", "qw")))
    return metres, 2.0 * math.acos(min(1.0, dot))


def compare(program, folder, style, config):
    bag = folder / (style + ".bag")
    run(program, "evaluate", "--bag", bag, "--config", config, "--no-optimization", "--out", folder / "evaluated")
    expected = rows(folder / "evaluated/closures.csv")
    played = folder / ("played_" + style)
    shutil.rmtree(played, ignore_errors=True)
    played.mkdir()
    port = own_master(played)
    launch = subprocess.Popen(["roslaunch", "-p", str(port), "incremental_segmatch", "kitti.launch", "bag:=%s" % bag,
                               "style:=" + style, "config:=%s" % config, "output_dir:=%s" % played, "rate:=15",
                               "pose_graph:=false", "queue_size:=1000", "rviz:=false"])
    found = {}
    deadline = time.time() + TIMEOUT_S
    while time.time() < deadline and (not found or max(found) < max(expected)):
        time.sleep(0.5)
        if launch.poll() is not None:
            sys.exit("roslaunch ended early with %d" % launch.returncode)
        if (played / "closures.csv").exists():
            found = rows(played / "closures.csv")
    time.sleep(3)
    launch.send_signal(signal.SIGINT)
    launch.wait()
    found = rows(played / "closures.csv")
    if not found:
        sys.exit("no closure was found in %d s" % TIMEOUT_S)
    common = expected.keys() & found.keys()
    metres, radians = map(sorted, zip(*(distance(expected[key], found[key]) for key in common)))
    middle = len(common) // 2
    print("%d closures by evaluate, %d played, %d the same; they differ by %.4f m and %.5f rad in the median, by up to "
          "%.4f m and %.5f rad" % (len(expected), len(found), len(common), metres[middle], radians[middle], metres[-1],
                                   radians[-1]))
    # Points cross ROS quantised to a fiftieth of a voxel, which a refinement with few points may answer by centimetres; and
    # a closure at a limit of acceptance may go either way.
    if (len(expected) < 15 or len(common) < 0.95 * max(len(expected), len(found)) or metres[middle] > 0.01 or
            radians[middle] > 0.002 or metres[-1] > 0.3 or radians[-1] > 0.02):
        sys.exit("the closures through ROS are not those of evaluate: %s" % sorted(expected.keys() ^ found.keys()))


def demo(program, folder, style, config):
    results = folder / ("demo_" + style)
    shutil.rmtree(results, ignore_errors=True)
    results.mkdir()
    port = own_master(results)
    run("roslaunch", "-p", port, "incremental_segmatch", "demo.launch", "bag:=%s" % (folder / (style + ".bag")),
        "style:=" + style, "config:=%s" % config, "out:=%s" % results, "rate:=10", "rviz:=false")
    for name in ("closures.csv", "trajectory_odometry.tum", "trajectory_optimized.tum", "pose_graph.g2o"):
        if not (results / name).stat().st_size:
            sys.exit("%s is empty" % name)
    subprocess.run([program, "score", "--kitti", folder / "drive", "--sequence", "00", "--results", results], check=True)


def overload(program, folder, style, config):
    import rosgraph
    import rospy
    from diagnostic_msgs.msg import DiagnosticArray

    results = folder / ("overload_" + style)
    shutil.rmtree(results, ignore_errors=True)
    results.mkdir()
    port = own_master(results)
    launch = subprocess.Popen(["roslaunch", "-p", str(port), "incremental_segmatch", "kitti.launch",
                               "bag:=%s" % (folder / (style + ".bag")), "style:=" + style, "config:=%s" % config,
                               "rate:=160", "queue_size:=3", "pose_graph:=false", "rviz:=false"])  # 0.8 s from scan to scan
    seen = []  # the front end's diagnostics, one a second

    def on_diagnostics(message):
        for status in message.status:
            # "Node starting up", which diagnostic_updater publishes by itself, has no values.
            if status.name == "front_end: front end" and status.values:
                seen.append({value.key: float(value.value) for value in status.values})
    deadline = time.time() + TIMEOUT_S
    while not rosgraph.is_master_online() and time.time() < deadline:
        time.sleep(0.2)
    rospy.init_node("overload", disable_signals=True)
    rospy.Subscriber("/diagnostics", DiagnosticArray, on_diagnostics)
    # The bag is through when nothing has come for some seconds.
    while time.time() < deadline and not (
            len(seen) > 4 and seen[-1]["scans received"] > 0 and seen[-1]["scans received"] == seen[-4]["scans received"]):
        time.sleep(0.5)
    launch.send_signal(signal.SIGINT)
    launch.wait()
    if not seen or not seen[-1]["scans received"]:
        sys.exit("no scan was received in %d s" % TIMEOUT_S)
    last = seen[-1]
    received, processed = last["scans received"], last["scans processed"]
    dropped = last["scans dropped by the full queue"]
    skipped = sum(count for key, count in last.items() if key.startswith("scans skipped"))
    latency_ms = max(status["arrival to segments [ms]"] for status in seen)
    print("%d scans received, %d processed, %d dropped, %d skipped; up to %.0f ms from arrival to segments" % (
        received, processed, dropped, skipped, latency_ms))
    if received < 100 or processed < 4 or dropped < 1 or processed + dropped + skipped != received:
        sys.exit("these counts are wrong, or nothing was dropped")
    # Three wait and one is processed; a pose may be waited for besides, half a second at most.
    step_ms = sum(value for key, value in last.items() if key.endswith("[ms]") and not key.startswith("arrival"))
    if latency_ms > 1000.0 + 20.0 * step_ms:
        sys.exit("latency is not bounded")


if __name__ == "__main__":
    action, program, folder = sys.argv[1], sys.argv[2], pathlib.Path(sys.argv[3])
    {"prepare": prepare, "compare": compare, "demo": demo, "overload": overload}[action](program, folder, *sys.argv[4:])
