# SPDX-License-Identifier: Apache-2.0
"""Transforms of a small robot description and chains of them against positions worked by hand."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from limbloc_ros.core.errors import RigError
from limbloc_ros.ros import transforms
from limbloc_ros.ros.messages import make_header, message_to_transform, stamp_ns
from limbloc_ros.ros.transforms import TransformOutput, TransformTree, link_transforms

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


def test_turns_about_any_axis() -> None:
    """Roll, pitch and yaw in the order of URDF, then a turn about an axis of any length."""
    urdf = """<robot name="r"><link name="a"/><link name="b"/><joint name="j" type="continuous">
      <parent link="a"/><child link="b"/><origin xyz="1 2 3" rpy="0.3 -0.5 2.0"/><axis xyz="1 -2 2"/></joint></robot>"""
    (msg,) = link_transforms(urdf, {"j": 0.7}, make_header(7, "room"))
    expected = Rotation.from_euler("xyz", [0.3, -0.5, 2.0]) * Rotation.from_rotvec(0.7 * np.array([1, -2, 2]) / 3)
    T = message_to_transform(msg)
    np.testing.assert_allclose(T[:3, :3], expected.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(T[:3, 3], [1, 2, 3])


def test_a_missing_angle_is_an_error_not_a_zero() -> None:
    with pytest.raises(KeyError, match="elbow"):
        chain({"shoulder": 0.0})


def shift(x: float, y: float = 0.0, z: float = 0.0) -> np.ndarray:
    T = np.eye(4)
    T[:3, 3] = x, y, z
    return T


#: x to y, y to z, z to x.
ROUND = np.array([[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]])


@pytest.fixture
def tree() -> TransformTree:
    """room -> ceiling -> cam0 and cam1, and room -> table; elsewhere base -> arm."""
    tree = TransformTree()
    tree.set("ceiling", "cam0", shift(1.0) @ ROUND)  # children may come before their parents
    tree.set("ceiling", "cam1", shift(-1.0))
    tree.set("room", "ceiling", shift(0.0, 0.0, 3.0))
    tree.set("room", "table", shift(0.0, 2.0, 1.0))
    tree.set("base", "arm", shift(0.5))
    return tree


def test_transforms_are_chained_up_and_down(tree: TransformTree) -> None:
    np.testing.assert_allclose(tree.find("room", "cam1"), shift(-1.0, 0.0, 3.0))
    np.testing.assert_allclose(tree.find("cam1", "room"), shift(1.0, 0.0, -3.0))
    np.testing.assert_allclose(tree.find("table", "cam1"), shift(-1.0, -2.0, 2.0))
    np.testing.assert_allclose(tree.find("cam1", "cam1"), np.eye(4))
    # What is 1 m ahead (z) of cam0 is 1 m further along x in the room.
    np.testing.assert_allclose(tree.find("room", "cam0") @ [0, 0, 1, 1], [2, 0, 3, 1])
    # cam1 is 2 m behind cam0 in the ceiling's x, which is cam0's z.
    np.testing.assert_allclose(tree.find("cam0", "cam1")[:3, 3], [0, 0, -2], atol=1e-12)


def test_the_newest_place_counts(tree: TransformTree) -> None:
    tree.set("ceiling", "cam1", shift(-4.0))
    np.testing.assert_allclose(tree.find("room", "cam1"), shift(-4.0, 0.0, 3.0))
    tree.set("table", "cam1", shift(0.0, 0.0, 0.1))
    np.testing.assert_allclose(tree.find("room", "cam1"), shift(0.0, 2.0, 1.1))


def test_a_slash_before_a_name_means_nothing(tree: TransformTree) -> None:
    """Programs that come from ROS 1 write it; tf2 strips it, too."""
    tree.set("/room", "/cam7", np.eye(4))
    for parent, child in (("room", "cam7"), ("/room", "/cam7")):
        np.testing.assert_array_equal(tree.find(parent, child), np.eye(4))


def test_what_is_not_known_is_explained(tree: TransformTree) -> None:
    with pytest.raises(RigError, match="nobody publishes a frame 'cam7'; there is arm, base, cam0, cam1, ceiling"):
        tree.find("room", "cam7")
    with pytest.raises(RigError, match="cam0 hangs below 'room', arm below 'base', and nothing joins them"):
        tree.find("cam0", "arm")
    with pytest.raises(RigError, match="nobody publishes a frame 'room'; there is no TF at all"):
        TransformTree().find("room", "cam0")
    tree.set("cam0", "room", shift(1.0))  # a circle must not hang it
    with pytest.raises(RigError, match="nothing joins them"):
        tree.find("room", "arm")


def test_without_the_message_nothing_is_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transforms, "import_tf_message", lambda: None)
    node: Any = None  # is not even asked for a publisher
    output = TransformOutput(node)
    output.send(link_transforms(ARM, {"shoulder": 0.0, "elbow": 0.0}, make_header(7, "room")))
    assert not output.available
