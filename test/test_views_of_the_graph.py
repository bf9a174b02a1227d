# SPDX-License-Identifier: Apache-2.0
"""The RViz file and the Foxglove layout against the running default graph: topics, types, QoS, and the fields shown."""

import json
import math
import re
from functools import reduce
from importlib import import_module
from pathlib import Path

import pytest
import yaml
from rclpy.parameter import Parameter
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    QoSCompatibility,
    QoSProfile,
    ReliabilityPolicy,
    qos_check_compatible,
)
from sensor_msgs.msg import PointCloud2

from limbloc_ros.core.hull import Hull
from limbloc_ros.core.pipeline import Carver
from limbloc_ros.nodes.composed import KINDS, flatten
from limbloc_ros.nodes.graph_plan import config_from_mapping, plan_graph
from limbloc_ros.ros import topics
from limbloc_ros.ros.cloud_messages import hull_to_cloud
from limbloc_ros.ros.messages import make_header
from limbloc_ros.ros.raw_messages import message_class
from limbloc_ros.simulation.room import SimulatedRoom, default_rig

ROOT = Path(__file__).parents[1]
DISPLAYS = yaml.safe_load((ROOT / "config" / "limbloc.rviz").read_text())["Visualization Manager"]["Displays"]
PANELS = json.loads((ROOT / "config" / "limbloc.foxglove.json").read_text())["configById"]
#: What a display of RViz shows; a camera also has its CameraInfo.
SHOWN = {
    "PointCloud2": "sensor_msgs/msg/PointCloud2",
    "MarkerArray": "visualization_msgs/msg/MarkerArray",
    "PoseArray": "geometry_msgs/msg/PoseArray",
    "RobotModel": "std_msgs/msg/String",
    "Image": "sensor_msgs/msg/Image",
    "Camera": "sensor_msgs/msg/Image",
}
#: What Foxglove's 3D panel shows.
IN_3D = {SHOWN[name] for name in ("PointCloud2", "MarkerArray", "PoseArray")}
IMAGES = {"sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"}


@pytest.fixture
def running(graph, tmp_path):
    """The default graph with two small cameras, in this process, and everything that it publishes of one hull."""
    cameras = {"number_of_cameras": 2, "width": 64, "height": 64, "wait_for_viewers_s": 0.0}
    plans = plan_graph(config_from_mapping({"simulated_cameras": cameras}), tmp_path)
    for node in (node for plan in plans for node in plan.nodes):
        make = getattr(import_module(f"limbloc_ros.nodes.{node['kind']}"), KINDS[node["kind"]])
        overrides = [Parameter(name, value=value) for name, value in flatten(node["parameters"]).items()]

        def build(make=make, name=node["name"], overrides=overrides, **options):
            return make(name, **{**options, "parameter_overrides": overrides})

        graph.add(build)
    graph.until(lambda: graph.tester.count_publishers("/joints") > 0)
    return graph


@pytest.fixture(scope="module")
def hull():
    room = SimulatedRoom(default_rig(8, 320, 240), empty_s=0.0)
    hull = Carver(room.rig).carve(room.frame(2.0).masks)
    assert isinstance(hull, Hull)
    return hull


def publishers_of(graph, topic):
    """Who publishes a topic; there must be somebody."""
    graph.until(lambda: graph.tester.count_publishers(topic) > 0)
    return graph.tester.get_publishers_info_by_topic(topic)


def messages_of_a_person(graph, hull, wanted):
    """A message of each topic that tells of a person, whose hull is sent."""
    found = {name: graph.collect(message_class(publishers_of(graph, name)[0].topic_type), name) for name in wanted}
    publisher = graph.publisher(PointCloud2, topics.HULL)
    for n in range(60):  # the surface is worked out only once the subscription has been seen
        publisher.publish(hull_to_cloud(hull, make_header((10 + n) * 10**11, "room")))
        graph.spin(0.3)
        if all(any(map(complete, messages)) for messages in found.values()):
            break
    return {name: next(filter(complete, messages)) for name, messages in found.items()}


def complete(msg):
    """Not the answer to an empty room."""
    return bool(len(getattr(msg, "data", getattr(msg, "poses", getattr(msg, "position", getattr(msg, "markers", ()))))))


def test_what_rviz_shows_is_there(running, hull):
    clouds = {}
    for display in DISPLAYS:
        kind = display["Class"].rpartition("/")[2]
        asked = display.get("Topic") or display.get("Description Topic")
        if asked is None:
            continue
        wanted = QoSProfile(
            depth=asked["Depth"],
            history=HistoryPolicy.KEEP_LAST,
            reliability=ReliabilityPolicy[asked["Reliability Policy"].upper().replace(" ", "_")],
            durability=DurabilityPolicy[asked["Durability Policy"].upper().replace(" ", "_")],
        )
        for info in publishers_of(running, asked["Value"]):
            assert info.topic_type == SHOWN[kind], display["Name"]
            compatible, why = qos_check_compatible(info.qos_profile, wanted)
            assert compatible != QoSCompatibility.ERROR, f"{display['Name']}: {why}"
        if kind == "Camera":
            assert publishers_of(running, asked["Value"].replace("image_raw", "camera_info"))
        if kind == "PointCloud2":
            clouds[asked["Value"]] = display.get("Channel Name", "z")
    for topic, msg in messages_of_a_person(running, hull, clouds).items():
        assert clouds[topic] in {field.name for field in msg.fields}
        assert msg.header.frame_id == "room"


def test_what_foxglove_shows_is_there(running, hull):
    shown = PANELS["3D!limbloc"]["topics"]
    for topic in shown:
        assert publishers_of(running, topic)[0].topic_type in IN_3D
    assert publishers_of(running, PANELS["3D!limbloc"]["layers"]["urdf"]["topic"])[0].topic_type == SHOWN["RobotModel"]
    images = [panel["imageMode"]["imageTopic"] for name, panel in PANELS.items() if name.startswith("Image!")]
    assert len(images) == 3
    for topic in images:
        assert publishers_of(running, topic)[0].topic_type in IMAGES
    diagnostics = PANELS["DiagnosticSummary!all"]["topicToRender"]
    assert publishers_of(running, diagnostics)[0].topic_type == "diagnostic_msgs/msg/DiagnosticArray"
    paths = [path["value"] for name, panel in PANELS.items() if name.startswith("Plot!") for path in panel["paths"]]
    assert len(paths) == 7
    clouds = {topic: settings["colorField"] for topic, settings in shown.items() if "colorField" in settings}
    plotted = {path.partition(".")[0] for path in paths}
    found = messages_of_a_person(running, hull, {*clouds, *plotted})
    for topic, field in clouds.items():
        assert field in {f.name for f in found[topic].fields}
    for path in paths:
        topic, _, fields = path.partition(".")
        assert math.isfinite(reduce(step_into, re.findall(r"\w+", fields), found[topic]))


def step_into(value, part):
    """A field, or an element by its number."""
    return value[int(part)] if part.isdigit() else getattr(value, part)
