# SPDX-License-Identifier: Apache-2.0
"""People as ROS4HRI wants them (REP-155): joint_states, a URDF with the fitted lengths, postures, ids, and TF.

`roi`, `cropped` and `skeleton2d` belong to one camera's image and have no meaning for many: they are left out.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseArray
from numpy.typing import NDArray
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Header, String

from limbloc_ros.core.pose import Pose
from limbloc_ros.core.posture import POSTURES, posture_of
from limbloc_ros.core.ros4hri import ros4hri
from limbloc_ros.ros import topics
from limbloc_ros.ros.cdr import joints_cdr
from limbloc_ros.ros.messages import (
    NANOSECONDS,
    angles_to_message,
    stamp_ns,
    transform_to_message,
)
from limbloc_ros.ros.transforms import TransformOutput, link_transforms
from limbloc_ros.ros.urdf import body_urdf, native_urdf


def body_id(first: str, number: int) -> str:
    """The id of person `number` when the first is called `first`: p1, p2, ... or anna, anna2, ..."""
    if number == 1:
        return first
    name = first.rstrip("0123456789")
    return f"{name}{int(first[len(name) :] or 1) + number - 1}"


class BodiesOutput:
    """Publishes what belongs to `/humans/bodies`.

    Args:
        node: where the publishers live.
        first_id: the first person's id; those of the others follow from it (`body_id`).
        publish_tf: `all` links (then no robot_state_publisher is needed), only the `root`, or `none`.
    """

    def __init__(self, node: Node, first_id: str, publish_tf: str) -> None:
        self._node, self._first_id, self._publish_tf = node, first_id, publish_tf
        self._transforms = TransformOutput(node) if publish_tf != "none" else None
        self._ids_list = hri_message("IdsList")
        if self._ids_list is not None:
            self._tracked = node.create_publisher(self._ids_list, topics.BODIES_TRACKED, topics.STREAM_QOS)
        self._outputs: dict[int, BodyOutput] = {}
        self._of(1)  # there from the start, for whoever looks what there is

    @property
    def tf_state(self) -> str:
        """For the diagnostics."""
        if self._transforms is None:
            return "off"
        return self._publish_tf if self._transforms.available else "off: tf2_msgs is not installed"

    def id_of(self, number: int) -> str:
        """What person `number` is called."""
        return body_id(self._first_id, number)

    def reset(self) -> None:
        """Forget the last frame (a jump back in time)."""
        for output in self._outputs.values():
            output.reset()

    def publish(self, poses: Mapping[int, Pose], header: Header, urdf_tolerance_m: float, urdf_period_s: float) -> None:
        """Everything about those who are tracked at this instant, by number; {} for nobody."""
        if self._ids_list is not None:
            self._tracked.publish(self._ids_list(header=header, ids=[self.id_of(number) for number in poses]))
        for number, pose in poses.items():
            self._of(number).publish(pose, header, urdf_tolerance_m, urdf_period_s)

    def _of(self, number: int) -> BodyOutput:
        if number not in self._outputs:  # numbers are used again, so that there are never more than max_people
            self._outputs[number] = BodyOutput(self._node, self.id_of(number), self._publish_tf, self._transforms)
        return self._outputs[number]


class BodyOutput:
    """Publishes what belongs to `/humans/bodies/<id>`.

    Args:
        node: where the publishers live.
        body_id: the person's id.
        publish_tf: `all` links, only the `root`, or `none`.
        transforms: where they are sent; None: nowhere.
    """

    def __init__(self, node: Node, body_id: str, publish_tf: str, transforms: TransformOutput | None) -> None:
        self._id = body_id
        self._publish_tf = publish_tf
        self._transforms = transforms
        self._joints = node.create_publisher(PoseArray, topics.body_joints(body_id), topics.STREAM_QOS)
        self._native = node.create_publisher(JointState, topics.body_joint_angles(body_id), topics.STREAM_QOS)
        self._states = node.create_publisher(JointState, topics.body_joint_states(body_id), topics.STREAM_QOS)
        self._urdf = node.create_publisher(String, topics.body_urdf(body_id), topics.LATCHED_QOS)
        self._native_urdf = node.create_publisher(String, topics.body_native_urdf(body_id), topics.LATCHED_QOS)
        self._body_posture = hri_message("BodyPosture")
        if self._body_posture is not None:
            self._posture = node.create_publisher(self._body_posture, topics.body_posture(body_id), topics.STREAM_QOS)
        self._description = ""
        self._sizes: Mapping[str, float] = {}
        self._described_ns = 0
        self._angles: dict[str, float] | None = None

    def reset(self) -> None:
        """Forget the last frame (a jump back in time)."""
        self._angles, self._described_ns = None, 0

    def publish(self, pose: Pose, header: Header, urdf_tolerance_m: float, urdf_period_s: float) -> None:
        """Joints, joint states and transforms of one frame, and the URDF when the sizes have changed notably."""
        stamp = stamp_ns(header)
        changed = max((abs(pose.sizes[k] - self._sizes.get(k, np.inf)) for k in pose.sizes), default=0.0)
        waited = stamp - self._described_ns >= urdf_period_s * NANOSECONDS
        if not self._description or (changed > urdf_tolerance_m and waited):
            self._description, self._sizes, self._described_ns = body_urdf(pose, self._id), dict(pose.sizes), stamp
            self._urdf.publish(String(data=self._description))
            self._native_urdf.publish(String(data=native_urdf(pose, self._id)))
        if self._joints.get_subscription_count():
            self._joints.publish(joints_cdr(pose.joints, stamp, header.frame_id))
        if self._native.get_subscription_count():
            self._native.publish(angles_to_message(pose.angles, header))
        self._angles = ros4hri(pose, self._angles)
        states = angles_to_message(self._angles, header, f"_{self._id}")
        self._states.publish(states)
        if self._body_posture is not None:
            self._posture.publish(self._body_posture(header=header, posture=POSTURES.index(posture_of(pose.joints))))
        if self._transforms is not None and self._transforms.wanted:
            frames = [transform_to_message(body_pose(pose), topics.body_frame(self._id), header)]
            if self._publish_tf == "all":
                frames += link_transforms(
                    self._description, dict(zip(states.name, states.position, strict=True)), header
                )
            self._transforms.send(frames)


def hri_message(name: str) -> Any | None:
    """A message of hri_msgs, or None where there is none: it comes with an apt ROS 2 only."""
    try:
        import hri_msgs.msg
    except ImportError:
        return None
    return getattr(hri_msgs.msg, name, None)


def body_pose(pose: Pose) -> NDArray[np.float64]:
    """T_world_body [4, 4] of REP-155's `body_<id>`: mid-hips, x forward, z to the head."""
    T = np.eye(4)
    T[:3, :3] = pose.rotations[pose.bone_names.index("pelvis")]
    T[:3, 3] = (pose.joint("hip_L") + pose.joint("hip_R")) / 2
    return T
