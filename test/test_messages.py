# SPDX-License-Identifier: Apache-2.0
"""Stamps, joints, angles, markers, transforms and diagnostics as messages, against values worked by hand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from std_msgs.msg import Header
from visualization_msgs.msg import Marker

from limbloc_ros.core.errors import InputError
from limbloc_ros.core.pose import JOINT, JOINT_NAMES, STICK_BONES, Flesh, Pose
from limbloc_ros.ros import messages

HEADER = messages.make_header(1_700_000_000_123_456_789, "room")


def standing(reliable: bool = True) -> Pose:
    joints = np.random.default_rng(1).random((25, 3))
    flesh = Flesh(
        np.array([[0.0, 0, 1], [0, 0, 2]]), np.array([0.1, 0.2]), np.array([[0, 0, 0], [0, 1, 1]]), ("a", "b")
    )
    return Pose(
        joints, np.eye(3)[None], ("pelvis",), {"knee": 0.5}, {}, flesh, np.zeros(1), 0.2, np.zeros(25), reliable
    )


def test_joints_round_trip_and_nobody() -> None:
    joints = standing().joints
    msg = messages.joints_to_message(joints, HEADER)
    assert len(msg.poses) == len(JOINT_NAMES) == 25
    assert all(pose.orientation.w == 1.0 for pose in msg.poses)
    np.testing.assert_array_equal(messages.message_to_joints(msg), joints)
    assert messages.message_to_joints(messages.joints_to_message(None, HEADER)) is None
    msg.poses.pop()
    with pytest.raises(InputError, match="got 24"):
        messages.message_to_joints(msg)


def test_angles_round_trip_with_suffix() -> None:
    msg = messages.angles_to_message({"waist": 0.25, "l_knee": -1.5}, HEADER, "_p1")
    assert list(msg.name) == ["waist_p1", "l_knee_p1"]
    assert messages.message_to_angles(msg) == {"waist_p1": 0.25, "l_knee_p1": -1.5}
    msg.position.pop()
    with pytest.raises(InputError, match="2 names and 1 positions"):
        messages.message_to_angles(msg)


def test_markers_hold_stick_joints_and_flesh() -> None:
    pose = standing()
    stick, joints, flesh = messages.figure_to_markers(pose, HEADER).markers
    assert (stick.type, joints.type, flesh.type) == (Marker.LINE_LIST, Marker.SPHERE_LIST, Marker.TRIANGLE_LIST)
    assert len(stick.points) == 2 * len(STICK_BONES)
    first = stick.points[0]
    np.testing.assert_array_equal([first.x, first.y, first.z], pose.joint(STICK_BONES[0][0]))
    assert len(joints.points) == len(joints.colors) == 25
    assert joints.colors[JOINT["knee_L"]].b > joints.colors[JOINT["knee_L"]].r
    assert joints.colors[JOINT["knee_R"]].r > joints.colors[JOINT["knee_R"]].b
    corners = np.array([(p.x, p.y, p.z) for p in flesh.points]).reshape(2, 80, 3, 3)
    np.testing.assert_allclose(np.linalg.norm(corners[0] - [0, 0, 1], axis=-1), 0.1)
    assert corners[1, ..., 2].max() == pytest.approx(2.2, abs=0.02)
    doubtful = messages.figure_to_markers(standing(reliable=False), HEADER).markers[2]
    assert doubtful.color.a < flesh.color.a
    assert messages.no_markers(HEADER).markers[0].action == Marker.DELETEALL


def test_transform_of_a_quarter_turn() -> None:
    T = np.array([[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
    msg = messages.transform_to_message(T, "child", HEADER)
    rotation, translation = msg.transform.rotation, msg.transform.translation
    half = 0.5**0.5
    np.testing.assert_allclose([rotation.x, rotation.y, rotation.z, rotation.w], [0, 0, half, half], atol=1e-12)
    assert (translation.x, translation.y, translation.z) == (1.0, 2.0, 3.0)
    np.testing.assert_allclose(messages.message_to_transform(msg), T, atol=1e-12)
    msg.transform.rotation.w = 0.0
    with pytest.raises(InputError, match="quaternion of length 1"):
        messages.message_to_transform(msg)


def test_quaternions_are_scipys() -> None:
    turns = Rotation.random(50, random_state=0)
    half_turns = Rotation.from_rotvec(np.pi * np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, 0, -0.8], [0, 0, 0]]))
    for rotation in (*turns, *half_turns):
        q = np.array(messages.quaternion(rotation.as_matrix()))
        theirs = rotation.as_quat()
        assert min(np.abs(q - theirs).max(), np.abs(q + theirs).max()) < 1e-12
        T = np.eye(4)
        T[:3, :3] = rotation.as_matrix()
        back = messages.message_to_transform(messages.transform_to_message(T, "a", HEADER))
        assert np.abs(back - T).max() < 1e-12


def test_status_values_and_worst_level() -> None:
    status = messages.make_status("node: x", messages.WARN, "hm", {"rate_hz": 29.97123, "n": 3, "on": True}, "cam0")
    assert messages.status_values(status) == {"rate_hz": "29.97", "n": "3", "on": "True"}
    assert messages.worst([messages.OK, messages.ERROR, messages.WARN]) == messages.ERROR
    assert messages.worst([]) == messages.OK


def test_header_keeps_nanoseconds() -> None:
    header: Header = messages.make_header(12_345_678_901_234_567, "f")
    assert (header.stamp.sec, header.stamp.nanosec) == (12_345_678, 901_234_567)
    assert messages.stamp_ns(header) == 12_345_678_901_234_567


def test_transforms_of_read_only_arrays() -> None:
    """Cameras hand out read-only matrices, which the SciPy of Ubuntu 24.04 refuses."""
    T = np.eye(4)
    T.setflags(write=False)
    assert messages.transform_to_message(T, "cam0", messages.make_header(0, "room")).transform.rotation.w == 1.0
