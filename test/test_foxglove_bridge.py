# SPDX-License-Identifier: Apache-2.0
"""The Foxglove bridge over real DDS and a real websocket: what a viewer gets is what was published, byte for byte."""

import argparse
import contextlib
import json
import re
import struct
import threading
from pathlib import Path

import pytest
from geometry_msgs.msg import PoseArray
from rclpy.serialization import deserialize_message
from std_msgs.msg import String
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from limbloc_ros.core.errors import ConfigError
from limbloc_ros.core.joint_angles import NATIVE_ANGLES
from limbloc_ros.core.pose import JOINT_NAMES
from limbloc_ros.nodes import smart_space
from limbloc_ros.nodes.foxglove_bridge import FoxgloveBridge
from limbloc_ros.nodes.graph_plan import plan_graph
from limbloc_ros.recordings.bags import TYPESTORE
from limbloc_ros.ros import topics

ROOT = Path(__file__).parents[1]


class Viewer:
    """A client of Foxglove's protocol that reads in a thread of its own, while the graph spins in this one."""

    def __init__(self, port):
        self.channels = {}
        self.messages = []
        self._connected = threading.Event()
        self._thread = threading.Thread(target=self._read, args=(port,), daemon=True)
        self._thread.start()
        assert self._connected.wait(10)

    def _read(self, port):
        with connect(f"ws://127.0.0.1:{port}", subprotocols=["foxglove.sdk.v1"], open_timeout=10) as self._socket:
            self._connected.set()
            with contextlib.suppress(ConnectionClosed):  # the server hangs up without the closing frame
                for data in self._socket:
                    self._take(data)

    def _take(self, data):
        if isinstance(data, bytes):
            code, subscription, _ = struct.unpack_from("<BIQ", data)
            assert code == 1
            self.messages.append((subscription, data[13:]))
            return
        event = json.loads(data)
        if event["op"] == "advertise":
            self.channels |= {channel["topic"]: channel for channel in event["channels"]}
        elif event["op"] == "unadvertise":
            self.channels = {t: c for t, c in self.channels.items() if c["id"] not in event["channelIds"]}

    def subscribe(self, number, topic):
        wanted = {"id": number, "channelId": self.channels[topic]["id"]}
        self._socket.send(json.dumps({"op": "subscribe", "subscriptions": [wanted]}))

    def unsubscribe(self, number):
        self._socket.send(json.dumps({"op": "unsubscribe", "subscriptionIds": [number]}))

    def of(self, number):
        return [data for subscription, data in list(self.messages) if subscription == number]

    def close(self):
        self._socket.close()
        self._thread.join(5)


def test_a_viewer_gets_what_is_published(graph):
    bridge = graph.add(FoxgloveBridge, port=0)
    joints = graph.tester.create_publisher(PoseArray, topics.JOINTS, topics.STREAM_QOS)
    urdf = graph.tester.create_publisher(String, topics.body_urdf("p1"), topics.LATCHED_QOS)
    urdf.publish(String(data="<robot/>"))
    viewer = Viewer(bridge.port)
    graph.until(lambda: {"/joints", "/humans/bodies/p1/urdf"} <= set(viewer.channels))
    assert not any("rosout" in topic or "parameter_events" in topic for topic in viewer.channels)
    channel = viewer.channels["/joints"]
    assert (channel["encoding"], channel["schemaEncoding"], channel["schemaName"]) == (
        "cdr", "ros2msg", "geometry_msgs/msg/PoseArray",
    )  # fmt: skip
    assert "MSG: geometry_msgs/Quaternion" in channel["schema"]
    assert joints.get_subscription_count() == 0  # nobody looks, so nothing is sent

    viewer.subscribe(7, "/joints")
    graph.until(lambda: joints.get_subscription_count() == 1)
    sent = PoseArray()
    sent.header.frame_id = "room"
    sent.header.stamp.sec = 12
    joints.publish(sent)
    graph.until(lambda: bool(viewer.of(7)))
    got = deserialize_message(viewer.of(7)[0], PoseArray)
    assert got == sent
    assert TYPESTORE.deserialize_cdr(viewer.of(7)[0], "geometry_msgs/msg/PoseArray").header.frame_id == "room"

    viewer.subscribe(8, "/humans/bodies/p1/urdf")  # latched: published before anybody looked
    graph.until(lambda: bool(viewer.of(8)))
    late = Viewer(bridge.port)
    graph.until(lambda: "/humans/bodies/p1/urdf" in late.channels)
    late.subscribe(1, "/humans/bodies/p1/urdf")  # the bridge is subscribed by now, and still has it
    graph.until(lambda: bool(late.of(1)))
    assert deserialize_message(late.of(1)[0], String).data == "<robot/>"

    viewer.unsubscribe(7)
    graph.until(lambda: joints.get_subscription_count() == 0)
    graph.tester.destroy_publisher(joints)
    graph.until(lambda: "/joints" not in viewer.channels)
    viewer.close()
    late.close()


def test_a_viewer_who_leaves_is_forgotten(graph):
    bridge = graph.add(FoxgloveBridge, port=0, topics=["/joints"])
    joints = graph.tester.create_publisher(PoseArray, topics.JOINTS, topics.STREAM_QOS)
    graph.tester.create_publisher(String, "other", 1)
    viewer = Viewer(bridge.port)
    graph.until(lambda: "/joints" in viewer.channels)
    graph.spin(0.3)
    assert set(viewer.channels) == {"/joints"}
    viewer.subscribe(1, "/joints")
    graph.until(lambda: joints.get_subscription_count() == 1)
    viewer.close()
    graph.until(lambda: joints.get_subscription_count() == 0)


def test_wrong_settings_are_refused(graph):
    bridge = graph.add(FoxgloveBridge, port=0)
    with pytest.raises(ConfigError, match="choose another port"):
        graph.add(FoxgloveBridge, "second", port=bridge.port)
    with pytest.raises(ConfigError, match="parameter topics: '\\(' is no regular expression"):
        graph.add(FoxgloveBridge, "third", port=0, topics=["("])


def test_the_layout_shows_what_its_labels_say():
    layout = json.loads((ROOT / "config" / "limbloc.foxglove.json").read_text())
    panels, shown = layout["configById"], set()

    def visit(node):
        if isinstance(node, str):
            shown.add(node)
        else:
            visit(node["first"])
            visit(node["second"])

    visit(layout["layout"])
    assert shown == set(panels)
    ours = {topics.HULL, topics.SURFACE, topics.JOINTS, topics.MARKERS, topics.TRUE_JOINTS, topics.JOINT_ANGLES}
    scene = panels["3D!limbloc"]
    assert {name.lstrip("/") for name in scene["topics"]} < ours
    assert scene["layers"]["urdf"]["topic"] == "/" + topics.body_urdf("p1")
    assert panels["Image!cam0"]["imageMode"]["imageTopic"] == "/" + topics.image("cam0")
    assert panels["DiagnosticSummary!all"]["topicToRender"] == topics.DIAGNOSTICS
    sides = {"left": "L", "right": "R"}
    for path in panels["Plot!angles"]["paths"]:
        side, joint = path["label"].split()
        index = int(re.fullmatch(r"/joint_angles\.position\[(\d+)\]", path["value"])[1])
        assert NATIVE_ANGLES[index].name == f"{joint}_{sides[side]}_flexion"
    for path in panels["Plot!heights"]["paths"]:
        index = int(re.fullmatch(r"/joints\.poses\[(\d+)\]\.position\.z", path["value"])[1])
        side, _, joint = path["label"].rpartition(" ")
        assert JOINT_NAMES[index] == (f"{joint}_{sides[side]}" if side else "head_centre")


def test_the_plan_has_the_bridge_when_asked_for(tmp_path):
    parser = argparse.ArgumentParser()
    smart_space.add_arguments(parser)

    def bridges(*words):
        plans = plan_graph(smart_space.config_from_arguments(parser.parse_args(words)), tmp_path)
        return [dict(node) for plan in plans for node in plan.nodes if node["kind"] == "foxglove_bridge"]

    assert bridges() == []
    assert bridges("--foxglove")[0]["parameters"]["port"] == 8765
    assert bridges("--foxglove", "9000")[0]["parameters"]["port"] == 9000
    assert (
        bridges("--set", "foxglove=true", "--set", "foxglove_bridge.host=0.0.0.0")[0]["parameters"]["host"] == "0.0.0.0"
    )
