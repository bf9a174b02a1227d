# SPDX-License-Identifier: Apache-2.0
"""Every command of the documentation and the helps that starts nodes is run, with the nodes in this process.

All goes the way it goes live, down to each node with its parameters on a real graph; then it ends. That separate
processes are started, watched and ended is in test_smart_space.py, what they do all together in test_faults.py.
"""

import os
import re
import shlex
import sys
from unittest import mock

import numpy as np
import pytest
import rclpy
from documented import NODES, ROOT, code_lines, commands_by_page
from geometry_msgs.msg import PoseArray
from ros_graph import DOMAIN

from limbloc_ros import cli
from limbloc_ros.commands._live_table import LiveTable
from limbloc_ros.core.pose import JOINT_NAMES
from limbloc_ros.nodes import composed
from limbloc_ros.nodes.replay import ReplayNode
from limbloc_ros.recordings.bags import BagReader
from limbloc_ros.rig.formats import FORMATS
from limbloc_ros.rig.importing import Wishes, settle
from limbloc_ros.rig.rig_file import load_rig, save_rig
from limbloc_ros.ros import node_main, supervisor, topics
from limbloc_ros.ros.messages import joints_to_message, make_header
from limbloc_ros.simulation.room import SimulatedRoom

WALK, BALANCE = (ROOT / "test" / "data" / name for name in ("rgb_walk", "balance"))
SIZES = {"cam01": (270, 480), "cam02": (270, 480), "cam03": (272, 480), "cam04": (272, 480)}
#: What differs in names of files only is the same.
NAME_OF_FILE = re.compile(r"(bags/|run1|my_room|lab|rig|room)[\w.]*")
COMMANDS = {
    NAME_OF_FILE.sub("FILE", command): command
    for page in commands_by_page().values()
    for command in page
    if command.split()[0] in NODES
}
FOOTAGE = [
    line.removeprefix("python tools/footage_to_bag.py ")
    for line in code_lines((ROOT / "docs" / "real_footage.md").read_text(encoding="utf-8"))
    if line.startswith("python tools/footage_to_bag.py ")
]


class Graph:
    """In the supervisor's place: makes every planned node, and while it is watched somebody is tracked."""

    environment, kinds = {}, []

    def __init__(self, plans, environment, *_):
        Graph.environment, Graph.kinds = environment, []
        self.plans = plans
        self.restarts = {}

    def run(self):
        for plan in self.plans:
            nodes = []
            description = composed.parse(plan.description)
            for entry in description["nodes"]:
                Graph.kinds.append(entry["kind"])
                if entry["kind"] == "foxglove_bridge":
                    entry["parameters"]["port"] = 0  # a free one: somebody may look at another graph
            try:
                composed.build(description, nodes)
            finally:
                for node in nodes:
                    node.destroy_node()
        return 0

    def __enter__(self):
        self.run()
        self.node = rclpy.create_node("somebody")
        self.outputs = [
            self.node.create_publisher(PoseArray, topic, topics.STREAM_QOS)
            for topic in (topics.TRUE_JOINTS, topics.JOINTS)
        ]
        return self

    def __exit__(self, *_):
        self.node.destroy_node()

    def poll(self):
        # poses that come before the true ones are heard have no error to be shown
        if all(output.get_subscription_count() for output in self.outputs):
            header = make_header(self.node.get_clock().now().nanoseconds, "room")
            for output in self.outputs:
                output.publish(joints_to_message(np.ones((len(JOINT_NAMES), 3)), header))
        return True


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """What the documentation's commands read, under its names; the recordings are made by its commands, too."""
    folder = tmp_path_factory.mktemp("lab")
    (folder / "WALK").symlink_to(WALK)
    (folder / "BALANCE").mkdir()
    for part in BALANCE.iterdir():
        (folder / "BALANCE" / part.name).symlink_to(part)
    for name in ("rig", "room", "lab"):
        save_rig(load_rig(WALK / "calib.json"), folder / f"{name}.yaml")
    balance = FORMATS["qualisys"].read([BALANCE / "calibration" / "Calib.qca.txt"])
    FORMATS["benchmark"].write(
        settle(balance, Wishes(sizes=SIZES, fit="letterbox"))[0], folder / "BALANCE" / "calib_cam03fix.json"
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "tools"))
        patch.chdir(folder)
        import footage_to_bag

        for line in FOOTAGE:
            assert footage_to_bag.main(shlex.split(line)) == 0
    for name in ("bags/monday", "run1"):
        (folder / name).symlink_to(folder / "bags" / "walk")
    return folder


@pytest.fixture(autouse=True)
def here(folder, monkeypatch, tmp_path):
    """A new folder with that in it; nodes of this process on a domain of their own, that spin until they did a bit."""

    def spin(nodes, context=None, until=None, timeout_s=None):
        (node,) = nodes
        published = (lambda: node.published > 0) if hasattr(node, "published") else (lambda: True)
        return real_spin(nodes, context, published, 20.0)

    real_spin = node_main.spin
    monkeypatch.setattr(node_main, "spin", spin)
    monkeypatch.setattr(SimulatedRoom, "warm_up", lambda _: None)
    monkeypatch.setattr(ReplayNode, "_wait_for_subscribers", lambda _: None)
    monkeypatch.setattr(supervisor, "Supervisor", Graph)
    monkeypatch.setattr(sys, "argv", ["limbloc"])
    monkeypatch.chdir(tmp_path)
    for part in folder.iterdir():
        (tmp_path / part.name).symlink_to(part)
    (tmp_path / "bags").unlink()
    (tmp_path / "bags").mkdir()
    for part in (folder / "bags").iterdir():
        (tmp_path / "bags" / part.name).symlink_to(part)
    with mock.patch.dict(os.environ, ROS_DOMAIN_ID=str(DOMAIN)):
        yield
    rclpy.try_shutdown()


def config_file(words):
    """The smart space file that a `run` names, if it does."""
    return next((word for word in words[1:] if word.endswith(".yaml") and words[words.index(word) - 1] != "--rig"), "")


@pytest.mark.parametrize("command", COMMANDS.values())
def test_a_documented_command_that_starts_nodes(command, tmp_path, monkeypatch, capfd):
    words = shlex.split(command)
    name = words[0]
    if config := config_file(words):
        (tmp_path / config).unlink(missing_ok=True)
        (tmp_path / config).write_bytes((ROOT / "config" / "smart_space.yaml").read_bytes())
    if name == "record":
        (tmp_path / words[1]).unlink(missing_ok=True)
    if name in ("replay", "record"):  # they are nodes themselves
        if "--start" in words:  # of the 0.6 s of the recording
            words[words.index("--start") + 1] = "0.12"
        assert cli.main(words) == 0, capfd.readouterr().err
        if name == "record":
            with BagReader(tmp_path / words[1]) as bag:
                assert bag.damage == ""
        return
    rclpy.init(domain_id=DOMAIN)
    main, processed = cli.main, []
    if name == "demo":
        words = [str(DOMAIN) if word == "42" else word for word in words] + ["--seconds", "1"]
        monkeypatch.setattr(LiveTable, "seconds", property(lambda table: float(len(table.rows) > 3)))
        monkeypatch.setattr(cli, "main", lambda arguments: processed.append(arguments) or 0)
    code = main(words)
    said = capfd.readouterr()
    assert code == 0, said.err
    expected = {"segmentation", "carving", "pose"}
    expected |= {"foxglove_bridge"} if "--foxglove" in words else set()
    expected |= {"record"} if "--record" in words or name == "demo" else set()
    source = words[words.index("--source") + 1] if "--source" in words else "simulated"
    expected |= {"simulated": {"simulated_cameras"}, "bag": {"replay"}, "cameras": set()}[source]
    assert set(Graph.kinds) == expected
    if "domain_id=" in command:
        assert Graph.environment["ROS_DOMAIN_ID"] == "42"
    if name == "demo":
        assert re.search(r"\d+ poses in 1 s, .* error of 13 joints: median 0 mm", said.out)
        (out,) = (tmp_path / "out").iterdir()
        assert (out / "live.csv").read_text().startswith("stamp_s,latency_ms")
        assert [words[0] for words in processed] == ["process"]
