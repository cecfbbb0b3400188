#!/usr/bin/python3
"""What users start, started: every preset with every nodelet, and rviz with its configuration.

started.py presets SOURCE FOLDER   each config/*.yaml with segmatch.launch: all nodelets answer
started.py rviz SOURCE FOLDER      each display of segmatch.rviz has a publisher of its type, and rviz, on a display
                                   without a screen, loads and subscribes them. Ends with 77 where there is no Xvfb
"""
import contextlib
import os
import pathlib
import shutil
import signal
import subprocess
import sys
import time
import xml.etree.ElementTree as ElementTree

import rosgraph
import rospy
import std_srvs.srv
import yaml

from played_drive import own_master

TIMEOUT_S = 60
MESSAGES = {"rviz/PointCloud2": "sensor_msgs/PointCloud2", "rviz/Marker": "visualization_msgs/Marker",
            "rviz/MarkerArray": "visualization_msgs/MarkerArray", "rviz/Path": "nav_msgs/Path",
            "rviz/PoseWithCovariance": "geometry_msgs/PoseWithCovarianceStamped"}
SKIPPED = 77


def wait_until(condition, what):
    deadline = time.time() + TIMEOUT_S
    while not condition():
        if time.time() > deadline:
            sys.exit("not within %d s: %s" % (TIMEOUT_S, what() if callable(what) else what))
        time.sleep(0.2)


@contextlib.contextmanager
def running(command, log, **options):
    """A program whose output goes to a file, and which is ended in the end."""
    with open(log, "w") as file:
        program = subprocess.Popen([str(part) for part in command], stdout=file, stderr=subprocess.STDOUT, **options)
    try:
        yield program
    finally:
        program.send_signal(signal.SIGINT)
        try:
            program.wait(20)
        except subprocess.TimeoutExpired:
            program.kill()


def launch_file(path, groups):
    """A launch file that includes segmatch.launch once a namespace, with arguments and parameters of the back end."""
    root = ElementTree.Element("launch")
    for namespace, (arguments, back_end) in groups.items():
        group = ElementTree.SubElement(root, "group", ns=namespace)
        include = ElementTree.SubElement(group, "include", file="$(find incremental_segmatch)/launch/segmatch.launch")
        for name, value in arguments.items():
            ElementTree.SubElement(include, "arg", name=name, value=str(value))
        for name, value in back_end.items():
            ElementTree.SubElement(group, "param", name="back_end/" + name, value=value)
    ElementTree.ElementTree(root).write(path)
    return path


def expect_answers(namespace, preset):
    """All three nodelets under a namespace have started: they say so themselves."""
    for service in ("segments/request_full_state", "trigger", "write_trajectories"):
        try:
            rospy.wait_for_service(namespace + "/" + service, TIMEOUT_S)
        except rospy.ROSException:
            sys.exit("%s: nobody serves %s/%s" % (preset, namespace, service))
    answer = rospy.ServiceProxy(namespace + "/trigger", std_srvs.srv.Trigger)().message
    if answer != "no segments have come from any robot yet":
        sys.exit("%s: the back end says: %s" % (preset, answer))


def presets(source, folder):
    files = sorted((source / "config").glob("*.yaml"))
    if len(files) < 2:
        sys.exit("there are no presets in %s" % (source / "config"))
    groups = {"/" + file.stem: ({"config": file}, {}) for file in files}
    port = own_master(folder)
    with running(["roslaunch", "-p", port, launch_file(folder / "presets.launch", groups)], folder / "launch.txt"):
        wait_until(rosgraph.is_master_online, "a master")
        rospy.init_node("started", disable_signals=True)
        for file in files:
            expect_answers("/" + file.stem, file.name)
            print("%s: front end, back end and pose graph have started" % file.name)
    said = (folder / "launch.txt").read_text()
    if "FATAL" in said or "terminate called" in said:
        sys.exit(said)


def rviz(source, folder):
    if not shutil.which("Xvfb"):
        print("Xvfb is not installed: rviz is not started")
        sys.exit(SKIPPED)
    manager = yaml.safe_load((source / "config/segmatch.rviz").read_text())["Visualization Manager"]
    displays = {display["Name"]: (display["Class"], display.get("Topic", display.get("Marker Topic")), display["Enabled"])
                for display in manager["Displays"]}
    port = own_master(folder)
    with contextlib.ExitStack() as stack:
        stack.enter_context(running(["roslaunch", "-p", port, "incremental_segmatch", "segmatch.launch"], folder / "launch.txt"))
        wait_until(rosgraph.is_master_online, "a master")
        rospy.init_node("started", disable_signals=True)
        expect_answers("", "segmatch.launch")
        # The localization comes from a back end of its own, in a saved map.
        town = folder / "empty.map"
        subprocess.run(["rosservice", "call", "/save_map", str(town)], check=True, stdout=subprocess.DEVNULL)
        localizing = {"/localizing": ({"map_file": town, "localization_topic": "/localization", "publish_tf": "false"},
                                      {"back_end/mode": "localization"})}
        stack.enter_context(running(["roslaunch", launch_file(folder / "localizing.launch", localizing)],
                                    folder / "localizing.txt"))
        expect_answers("/localizing", "localization")

        master = rosgraph.Master("/started")
        published = dict(master.getTopicTypes())
        for name, (display, topic, _) in displays.items():
            if published.get(topic) != MESSAGES[display]:
                sys.exit("display %s shows %s, which is %s" % (name, topic, published.get(topic, "published by nobody")))
        clicked = [tool["Topic"] for tool in manager["Tools"] if tool["Class"] == "rviz/PublishPoint"]
        subscribed = dict(master.getSystemState()[1])
        if len(clicked) != 1 or not subscribed.get(clicked[0]):
            sys.exit("nobody hears the points that are clicked: %s" % clicked)

        read_end, write_end = os.pipe()
        stack.enter_context(running(["Xvfb", "-displayfd", write_end, "-screen", "0", "1280x900x24", "+extension", "GLX"],
                                    folder / "xvfb.txt", pass_fds=[write_end]))
        os.close(write_end)
        with os.fdopen(read_end) as pipe:
            display = ":" + pipe.readline().strip()
        environment = dict(os.environ, DISPLAY=display, LIBGL_ALWAYS_SOFTWARE="1", QT_X11_NO_MITSHM="1")
        stack.enter_context(running(["rviz", "-d", source / "config/segmatch.rviz", "__name:=rviz"], folder / "rviz.txt",
                                    env=environment))
        wanted = {topic for _, topic, is_enabled in displays.values() if is_enabled}

        def missing():
            return {topic for topic in wanted if "/rviz" not in dict(master.getSystemState()[1]).get(topic, [])}
        wait_until(lambda: not missing(), lambda: "rviz subscribes %s; it says:\n%s" % (
            ", ".join(sorted(missing())), (folder / "rviz.txt").read_text()))
    said = (folder / "rviz.txt").read_text()
    # A busy master is asked once more by roscpp itself; that all topics are subscribed was seen above.
    errors = [line for line in said.splitlines() if "ERROR" in line and "Retrying..." not in line]
    if errors or "could not be loaded" in said:
        sys.exit("rviz says:\n" + said)
    print("%d displays have publishers of their types; rviz subscribes the %d that are on" % (len(displays), len(wanted)))


if __name__ == "__main__":
    results = pathlib.Path(sys.argv[3]) / sys.argv[1]
    shutil.rmtree(results, ignore_errors=True)
    results.mkdir(parents=True)
    {"presets": presets, "rviz": rviz}[sys.argv[1]](pathlib.Path(sys.argv[2]), results)
