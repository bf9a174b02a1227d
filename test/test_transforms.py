# SPDX-License-Identifier: Apache-2.0
"""Transforms of a small robot description against positions worked by hand, and TF that is not there."""

from __future__ import annotations

import math
import sys
import types
from typing import Any

import numpy as np
import pytest
from ros_graph import Graph

from limbloc_ros.ros.messages import make_header, message_to_transform, stamp_ns
from limbloc_ros.ros.transforms import TransformOutput, link_transforms

ARM = """
<robot name="arm">
  <link name="body"/><link name="upper"/><link name="lower"/><link name="tip"/>
  <joint name="shoulder" type="revolute">
    <parent link="body"/><child link="upper"/><origin xyz="0 0.2 1.4"/><axis xyz="0 -1 0"/>
  </joint>
  <joint name="elbow" type="revolute">
    <parent link="upper"/><child link="lower"/><origin xyz="0 0 -0.3" rpy="0 0 1.5707963267948966"/><axis xyz="0 0 1"/>
  </joint>
  <joint name="end" type="fixed"><parent link="lower"/><child link="tip"/><origin xyz="0 0 -0.25"/></joint>
</robot>
"""


def chain(angles: dict[str, float]) -> np.ndarray:
    T = np.eye(4)
    for msg in link_transforms(ARM, angles, make_header(7, "room")):
        assert stamp_ns(msg.header) == 7
        T = T @ message_to_transform(msg)
    return T


def test_parents_children_and_a_hanging_arm() -> None:
    links = link_transforms(ARM, {"shoulder": 0.0, "elbow": 0.0}, make_header(7, "room"))
    assert [(m.header.frame_id, m.child_frame_id) for m in links] == [
        ("body", "upper"),
        ("upper", "lower"),
        ("lower", "tip"),
    ]
    np.testing.assert_allclose(chain({"shoulder": 0.0, "elbow": 0.0})[:3, 3], [0, 0.2, 0.85], atol=1e-12)


def test_flexion_swings_the_arm_forward() -> None:
    """About -y a positive quarter turn takes -z (hanging) to +x (forward)."""
    T = chain({"shoulder": math.pi / 2, "elbow": 0.0})
    np.testing.assert_allclose(T[:3, 3], [0.55, 0.2, 1.4], atol=1e-12)


def test_the_origin_turns_before_the_joint() -> None:
    T = chain({"shoulder": 0.0, "elbow": math.pi / 2})
    np.testing.assert_allclose(T[:3, :3], np.diag([-1.0, -1.0, 1.0]), atol=1e-12)


def test_a_missing_angle_is_an_error_not_a_zero() -> None:
    with pytest.raises(KeyError, match="elbow"):
        chain({"shoulder": 0.0})


def test_tf_is_sent_when_it_is_there_and_left_out_when_not(monkeypatch: pytest.MonkeyPatch) -> None:
    sent: list[Any] = []
    module: Any = types.ModuleType("tf2_ros")
    module.TransformBroadcaster = lambda node: types.SimpleNamespace(sendTransform=sent.extend)
    graph = Graph()
    links = link_transforms(ARM, {"shoulder": 0.0, "elbow": 0.0}, make_header(7, "room"))
    monkeypatch.setitem(sys.modules, "tf2_ros", module)
    output = TransformOutput(graph.tester)
    output.send(links)
    assert output.available
    assert sent == links
    monkeypatch.setitem(sys.modules, "tf2_ros", None)
    output = TransformOutput(graph.tester)
    output.send(links)
    assert not output.available
    assert len(sent) == 3
    graph.close()
