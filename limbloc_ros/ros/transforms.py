# SPDX-License-Identifier: Apache-2.0
"""TF where it is there: looking up, broadcasting, and the transforms that a URDF makes of joint angles.

tf2_ros comes with an apt ROS 2 but has no wheel, so it is imported only when somebody wants TF.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from geometry_msgs.msg import TransformStamped
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.time import Time
from std_msgs.msg import Header

from limbloc_ros.core.errors import RigError
from limbloc_ros.ros.messages import message_to_transform, transform_to_message

Array = NDArray[np.float64]


def import_tf2() -> Any | None:
    """The module tf2_ros, or None where there is none."""
    try:
        import tf2_ros
    except ImportError:
        return None
    return tf2_ros


class TransformLookup:
    """Poses of camera frames from TF.

    Raises:
        RigError: tf2_ros is not installed.
    """

    def __init__(self, node: Node) -> None:
        tf2 = import_tf2()
        if tf2 is None:
            raise RigError(
                "the cameras' poses should come from TF, but Python cannot import tf2_ros: "
                "install ros-<distro>-tf2-ros-py, or give the parameter rig_file"
            )
        self._unknown: type[Exception] = tf2.TransformException
        self._buffer = tf2.Buffer()
        self._listener = tf2.TransformListener(self._buffer, node)

    def find(self, parent: str, child: str) -> Array | None:
        """The newest T_parent_child [4, 4], or None while TF does not know it."""
        try:
            return message_to_transform(self._buffer.lookup_transform(parent, child, Time()))
        except self._unknown:
            return None


class TransformOutput:
    """Sends transforms when tf2_ros is installed, does nothing otherwise (`available` tells)."""

    def __init__(self, node: Node, static: bool = False) -> None:
        tf2 = import_tf2()
        self.available = tf2 is not None
        if tf2 is not None:
            self._broadcaster = tf2.StaticTransformBroadcaster(node) if static else tf2.TransformBroadcaster(node)

    def send(self, transforms: Sequence[TransformStamped]) -> None:
        """Broadcast some transforms."""
        if self.available:
            self._broadcaster.sendTransform(list(transforms))


def link_transforms(urdf: str, angles: Mapping[str, float], header: Header) -> list[TransformStamped]:
    """What robot_state_publisher would send: the pose of every link in its parent link.

    Args:
        urdf: a robot description with fixed, revolute and continuous joints.
        angles: rad, by the joint names in the URDF; every movable joint must be there.
        header: gives the stamp.
    """
    result = []
    for joint in ET.fromstring(urdf).iter("joint"):
        origin = joint.find("origin")
        attributes = {} if origin is None else origin.attrib
        T = np.eye(4)
        T[:3, 3] = _numbers(attributes.get("xyz", "0 0 0"))
        roll, pitch, yaw = _numbers(attributes.get("rpy", "0 0 0"))
        R = _turn(_Z * yaw) @ _turn(_Y * pitch) @ _turn(_X * roll)
        if joint.attrib["type"] != "fixed":
            axis = joint.find("axis")
            direction = _numbers("1 0 0" if axis is None else axis.attrib["xyz"])
            R = R @ _turn(angles[joint.attrib["name"]] * direction)
        T[:3, :3] = R
        parent, child = (joint.find(tag).attrib["link"] for tag in ("parent", "child"))  # type: ignore[union-attr]
        result.append(transform_to_message(T, child, Header(stamp=header.stamp, frame_id=parent)))
    return result


_X, _Y, _Z = np.eye(3)


def _turn(vector: Array) -> Array:
    """Rotation vector [3], rad -> rotation matrix [3, 3]."""
    return np.asarray(cv2.Rodrigues(vector)[0])


def _numbers(text: str) -> Array:
    return np.array([float(word) for word in text.split()])
