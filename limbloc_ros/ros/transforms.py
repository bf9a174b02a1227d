# SPDX-License-Identifier: Apache-2.0
"""TF where it is there: listening, broadcasting, and the transforms that a URDF makes of joint angles.

All that is needed is the message, tf2_msgs. It comes with an apt ROS 2; it has no wheel, but tools/build_tf2_msgs.py
builds it with the generators that the other wheels brought. tf2_ros and its C++ buffer are not needed: cameras stand
still, so the newest transforms are the right ones and only have to be chained. (3,000 random chains were within 2e-13 m
and 1e-13 degrees of tf2's. Frames that move with stamps of their own are another matter: tf2 interpolates.)
"""

from __future__ import annotations

import functools
import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from geometry_msgs.msg import TransformStamped
from numpy.typing import NDArray
from rclpy.node import Node
from std_msgs.msg import Header

from limbloc_ros.core.errors import InputError, RigError
from limbloc_ros.ros import topics
from limbloc_ros.ros.messages import message_to_transform, turn_to_message

Array = NDArray[np.float64]


def import_tf_message() -> Any | None:
    """The class tf2_msgs.msg.TFMessage, or None where there is none."""
    try:
        from tf2_msgs.msg import TFMessage
    except ImportError:
        return None
    return TFMessage


class TransformTree:
    """Frames, each with its newest pose in its parent."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, Array]] = {}

    def set(self, parent: str, child: str, T_parent_child: Array) -> None:
        """Put a frame where it is, in place of where it was."""
        self._parents[_bare(child)] = _bare(parent), T_parent_child

    def find(self, parent: str, child: str) -> Array:
        """T_parent_child [4, 4], up to the frame that both descend from and down again.

        Raises:
            RigError: nobody told of one of the frames, or how they hang together.
        """
        parent, child = _bare(parent), _bare(child)
        above_child, above_parent = self._ancestors(child), self._ancestors(parent)
        for frame, T_frame_child in above_child.items():
            if frame in above_parent:
                return np.asarray(np.linalg.solve(above_parent[frame], T_frame_child))
        known = self._parents.keys() | {frame for frame, _ in self._parents.values()}
        start = f"TF has no transform from {parent} to {child!r} yet"
        for frame in (parent, child):
            if frame not in known:
                raise RigError(f"{start}: nobody publishes a frame {frame!r}; there is {_listed(known)}")
        roots = [list(above)[-1] for above in (above_parent, above_child)]
        raise RigError(
            f"{start}: {parent} hangs below {roots[0]!r}, {child} below {roots[1]!r}, and nothing joins them"
        )

    def _ancestors(self, frame: str) -> dict[str, Array]:
        """T_ancestor_frame [4, 4] of the frame itself, its parent, and so on; a circle ends where it closes."""
        found, T = {frame: np.eye(4)}, np.eye(4)
        while frame in self._parents:
            frame, T_parent_frame = self._parents[frame]
            if frame in found:
                break
            T = T_parent_frame @ T
            found[frame] = T
        return found


class TransformListener:
    """Hears all transforms of the graph.

    Attributes:
        tree: what is known.
        problems: why transforms were left out, by child frame.

    Raises:
        RigError: tf2_msgs is not installed.
    """

    def __init__(self, node: Node) -> None:
        message = import_tf_message()
        if message is None:
            raise RigError(
                "the cameras' poses should come from TF, but Python cannot import tf2_msgs: install "
                "ros-<distro>-tf2-msgs, or without an apt ROS run tools/build_tf2_msgs.py, or give the parameter "
                "rig_file"
            )
        self.tree = TransformTree()
        self.problems: dict[str, str] = {}
        node.create_subscription(message, topics.TF, self._on_message, topics.TF_QOS)
        node.create_subscription(message, topics.TF_STATIC, self._on_message, topics.TF_STATIC_SUBSCRIPTION_QOS)

    def _on_message(self, msg: Any) -> None:
        for transform in msg.transforms:
            try:
                T = message_to_transform(transform)
            except InputError as error:
                self.problems[transform.child_frame_id] = str(error)
                continue
            self.problems.pop(transform.child_frame_id, None)
            self.tree.set(transform.header.frame_id, transform.child_frame_id, T)

    def find(self, parent: str, child: str) -> Array:
        """T_parent_child [4, 4]; raises RigError as long as it is not known."""
        try:
            return self.tree.find(parent, child)
        except RigError as error:
            if child in self.problems:
                raise RigError(f"{error}; {self.problems[child]}") from None
            raise


class TransformOutput:
    """Sends transforms when tf2_msgs is installed, does nothing otherwise (`available` tells).

    Args:
        node: where the publisher lives.
        static: they never move: they are kept for those who come later.
    """

    def __init__(self, node: Node, static: bool = False) -> None:
        self._message = import_tf_message()
        self._static: dict[str, TransformStamped] | None = {} if static else None
        if self._message is not None:
            topic, qos = (topics.TF_STATIC, topics.LATCHED_QOS) if static else (topics.TF, topics.TF_QOS)
            self._publisher = node.create_publisher(self._message, topic, qos)

    @property
    def available(self) -> bool:
        """Whether there is TF."""
        return self._message is not None

    @property
    def wanted(self) -> bool:
        """Whether somebody listens; those who come later are told what never moves, and the next of what does."""
        return self._message is not None and (self._static is not None or self._publisher.get_subscription_count() > 0)

    def send(self, transforms: Sequence[TransformStamped]) -> None:
        """Broadcast some transforms; static ones together with all sent before, since only the last message is kept."""
        if self._message is None:
            return
        if self._static is not None:
            self._static |= {transform.child_frame_id: transform for transform in transforms}
            transforms = list(self._static.values())
        self._publisher.publish(self._message(transforms=list(transforms)))


def link_transforms(urdf: str, angles: Mapping[str, float], header: Header) -> list[TransformStamped]:
    """What robot_state_publisher would send: the pose of every link in its parent link.

    Args:
        urdf: a robot description with fixed, revolute and continuous joints.
        angles: rad, by the joint names in the URDF; every movable joint must be there.
        header: gives the stamp.
    """
    result = []
    for link in _links(urdf):
        half = 0.0 if link.joint is None else 0.5 * angles[link.joint]
        turn = tuple(math.sin(half) * component for component in link.axis)
        rotation = _product(link.rotation, (*turn, math.cos(half)))
        above = Header(stamp=header.stamp, frame_id=link.parent)
        result.append(turn_to_message(link.translation, rotation, link.child, above))
    return result


class _Link(NamedTuple):
    """A link of a robot description, and how it turns in its parent.

    Attributes:
        joint: which joint turns it; None: it is fixed.
        axis: about which, of length 1.
        translation, rotation: (m, and x, y, z, w) of it in its parent at angle 0.
    """

    parent: str
    child: str
    joint: str | None
    axis: tuple[float, ...]
    translation: tuple[float, ...]
    rotation: tuple[float, ...]


@functools.lru_cache(maxsize=16)  # the newest description of each person: reading one takes longer than a frame has
def _links(urdf: str) -> tuple[_Link, ...]:
    links = []
    for joint in ET.fromstring(urdf).iter("joint"):
        origin, axis = joint.find("origin"), joint.find("axis")
        attributes = {} if origin is None else origin.attrib
        rotation: tuple[float, ...] = (0.0, 0.0, 0.0, 1.0)
        for angle, k in zip(_numbers(attributes.get("rpy", "0 0 0"))[::-1], (2, 1, 0), strict=True):
            turn = [0.0, 0.0, 0.0, math.cos(angle / 2)]
            turn[k] = math.sin(angle / 2)
            rotation = _product(rotation, turn)
        direction = _numbers("1 0 0" if axis is None else axis.attrib["xyz"])
        parent, child = (joint.find(tag).attrib["link"] for tag in ("parent", "child"))  # type: ignore[union-attr]
        links.append(
            _Link(
                parent,
                child,
                None if joint.attrib["type"] == "fixed" else joint.attrib["name"],
                tuple(component / math.hypot(*direction) for component in direction),
                _numbers(attributes.get("xyz", "0 0 0")),
                rotation,
            )
        )
    return tuple(links)


def _product(p: Sequence[float], q: Sequence[float]) -> tuple[float, float, float, float]:
    """The turn q, and then p, as x, y, z, w."""
    (a, b, c, d), (x, y, z, w) = p, q
    return (
        d * x + a * w + b * z - c * y,
        d * y - a * z + b * w + c * x,
        d * z + a * y - b * x + c * w,
        d * w - a * x - b * y - c * z,
    )


def _numbers(text: str) -> tuple[float, ...]:
    return tuple(float(word) for word in text.split())


def _bare(frame: str) -> str:
    """`/camera` of programs that come from ROS 1 is `camera`, as tf2 has it."""
    return frame.lstrip("/")


def _listed(names: set[str]) -> str:
    return ", ".join(sorted(names)) or "no TF at all"
