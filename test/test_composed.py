# SPDX-License-Identifier: Apache-2.0
"""Several nodes in one process: what a description may say, how numbers are read, and when the process ends."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import rclpy
from rclpy.node import Node
from rclpy.serialization import serialize_message
from ros_graph import DOMAIN
from sensor_msgs.msg import Image

from limbloc_ros.core.errors import ConfigError
from limbloc_ros.nodes import composed
from limbloc_ros.recordings.bags import BagWriter
from limbloc_ros.ros.exit_codes import ENDED


@pytest.fixture
def nodes() -> Iterator[list[Node]]:
    made: list[Node] = []
    rclpy.init(domain_id=DOMAIN)
    yield made
    for node in made:
        node.destroy_node()
    rclpy.shutdown()


def test_whole_numbers_are_taken_where_floats_are_wanted(nodes: list[Node]) -> None:
    values = {"number_of_cameras": 2, "width": 64, "height": 64, "empty_s": 1, "chair": [1, -1]}
    composed.build({"nodes": [{"kind": "simulated_cameras", "parameters": values}]}, nodes)
    settings = nodes[0].settings
    assert (settings.empty_s, settings.chair) == (1.0, (1.0, -1.0))
    assert isinstance(settings.empty_s, float)


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ("pose", "expected a mapping with the node's kind, got 'pose'"),
        ({"kind": "depth"}, "expected one of segmentation, carving"),
        ({"kind": ["pose"]}, "expected one of segmentation, carving"),
        ({"kind": "pose", "parameters": ["body_id"]}, r"parameters: expected a mapping, got \['body_id'\]"),
    ],
)
def test_what_is_no_description_of_a_node_is_named(entry: object, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        composed.build({"nodes": [entry]}, [])


def test_the_process_ends_with_the_recording_also_when_a_file_describes_it(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "walk") as bag:
        bag.add_topic("/cam0/image_raw", "sensor_msgs/msg/Image")
        bag.write("/cam0/image_raw", 1, serialize_message(Image(width=1, height=1, encoding="mono8", step=1, data=[7])))
    description = tmp_path / "graph.yaml"
    description.write_text(
        f"nodes: [{{kind: replay, parameters: {{bag: {tmp_path / 'walk'}, wait_for_subscribers_s: 0}}}}]"
    )
    ended = subprocess.run(
        [sys.executable, "-m", "limbloc_ros.nodes.composed", str(description)],
        env={**os.environ, "ROS_DOMAIN_ID": str(DOMAIN)},
        capture_output=True,
        text=True,
        timeout=30,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    assert "replayed 1 messages" in ended.stdout


def test_a_recorder_that_fails_does_not_ask_for_the_end_of_all(
    nodes: list[Node], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A full disk is no reason to stop a live room; a recording that cannot be replayed is."""

    def main(make: Callable[[], list[Node]], *_: object) -> int:
        nodes.extend(make())
        nodes[-1].error = "only 63 MB of disk are left"
        return 0

    monkeypatch.setattr(composed.node_main, "main", main)
    entry = {"kind": "record", "parameters": {"bag": str(tmp_path / "bag")}}
    assert composed.run(["composed", json.dumps({"nodes": [entry]})]) == ENDED


def test_what_cannot_be_run_is_said_in_one_line(tmp_path: Path) -> None:
    ended = subprocess.run(
        [sys.executable, "-m", "limbloc_ros.nodes.composed", str(tmp_path / "none.yaml")],
        capture_output=True,
        text=True,
        timeout=30,
        check=False,
    )
    assert ended.returncode == composed.REFUSED
    assert "expected a description of nodes or a file with one" in ended.stderr
    assert "Traceback" not in ended.stderr
