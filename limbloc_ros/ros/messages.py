# SPDX-License-Identifier: Apache-2.0
"""Stamps, joints, angles, markers, transforms and diagnostics as messages.

Images and masks are in `image_messages`, point clouds in `cloud_messages`; nothing else converts messages.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from builtin_interfaces.msg import Duration, Time
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point, PoseArray, Quaternion, TransformStamped, Vector3
from geometry_msgs.msg import Pose as PoseMsg
from numpy.typing import ArrayLike, NDArray
from sensor_msgs.msg import JointState
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from limbloc_ros.core.errors import InputError
from limbloc_ros.core.flesh_mesh import flesh_mesh
from limbloc_ros.core.pose import JOINT, JOINT_NAMES, STICK_BONES, Pose
from limbloc_ros.core.synchroniser import NANOSECONDS as NANOSECONDS
from limbloc_ros.rig.geometry import rotation_of

Array = NDArray[np.float64]

#: The flesh figure's triangles: 80 per part, round enough at arm's length and quick to send.
FLESH_SUBDIVISIONS = 1
STICK_WIDTH_M = 0.02
JOINT_SIZE_M = 0.045
#: A figure that is not renewed disappears, so that a dead pose node does not leave a person standing in RViz.
MARKER_LIFETIME_S = 1

_STICK = ColorRGBA(r=1.0, g=0.85, b=0.1, a=1.0)
_LEFT = ColorRGBA(r=0.2, g=0.5, b=1.0, a=1.0)
_RIGHT = ColorRGBA(r=1.0, g=0.3, b=0.2, a=1.0)
_MIDDLE = ColorRGBA(r=0.95, g=0.95, b=0.95, a=1.0)
_FLESH = ColorRGBA(r=0.85, g=0.65, b=0.5, a=0.5)
_DOUBTFUL = ColorRGBA(r=0.6, g=0.6, b=0.6, a=0.3)


def stamp_ns(header: Header) -> int:
    """The acquisition stamp, ns."""
    return int(header.stamp.sec) * NANOSECONDS + int(header.stamp.nanosec)


def make_header(stamp: int, frame_id: str) -> Header:
    """A header with `stamp` in ns."""
    return Header(stamp=Time(sec=stamp // NANOSECONDS, nanosec=stamp % NANOSECONDS), frame_id=frame_id)


# --- joints and angles ---


def joints_to_message(joints: Array | None, header: Header) -> PoseArray:
    """Joint positions [25, 3] m in the order of JOINT_NAMES, without rotation; None gives an empty array (nobody)."""
    msg = PoseArray(header=header)
    if joints is not None:
        if joints.shape != (len(JOINT_NAMES), 3):
            raise InputError(f"expected joints of shape ({len(JOINT_NAMES)}, 3), got {joints.shape}")
        msg.poses = [
            PoseMsg(position=Point(x=x, y=y, z=z), orientation=Quaternion(w=1.0)) for x, y, z in joints.tolist()
        ]
    return msg


def message_to_joints(msg: PoseArray) -> Array | None:
    """The inverse of `joints_to_message`.

    Raises:
        InputError: neither empty nor 25 joints.
    """
    if not msg.poses:
        return None
    if len(msg.poses) != len(JOINT_NAMES):
        raise InputError(f"expected {len(JOINT_NAMES)} joints in the order of JOINT_NAMES, got {len(msg.poses)}")
    return np.array([(p.position.x, p.position.y, p.position.z) for p in msg.poses])


def angles_to_message(angles: Mapping[str, float], header: Header, suffix: str = "") -> JointState:
    """Joint angles by name, rad; `suffix` is appended to each name (ROS4HRI wants `_<id>`)."""
    return JointState(
        header=header, name=[name + suffix for name in angles], position=[float(value) for value in angles.values()]
    )


def message_to_angles(msg: JointState) -> dict[str, float]:
    """Joint angles by name, rad.

    Raises:
        InputError: not one position per name.
    """
    if len(msg.name) != len(msg.position):
        raise InputError(
            f"expected one position per joint, got {len(msg.name)} names and {len(msg.position)} positions"
        )
    return dict(zip(msg.name, msg.position, strict=True))


# --- pictures for RViz ---


def figure_to_markers(pose: Pose, header: Header, prefix: str = "") -> MarkerArray:
    """Stick figure (lines and joints, own left blue, own right red) and flesh figure (grey when not reliable).

    `prefix` stands before the namespaces: several people are told apart by it.
    """
    bones = [pose.joint(name) for bone in STICK_BONES for name in bone]
    stick = _marker(header, f"{prefix}stick", Marker.LINE_LIST, STICK_WIDTH_M, _STICK if pose.reliable else _DOUBTFUL)
    stick.points = _points(np.array(bones))
    joints = _marker(header, f"{prefix}joints", Marker.SPHERE_LIST, JOINT_SIZE_M, _MIDDLE)
    joints.points = _points(pose.joints)
    joints.colors = [_LEFT if n.endswith("_L") else _RIGHT if n.endswith("_R") else _MIDDLE for n in JOINT]
    flesh = _marker(header, f"{prefix}flesh", Marker.TRIANGLE_LIST, 1.0, _FLESH if pose.reliable else _DOUBTFUL)
    flesh.points = _points(
        np.concatenate(
            [vertices[faces].reshape(-1, 3) for vertices, faces in flesh_mesh(pose.flesh, FLESH_SUBDIVISIONS)]
        )
    )
    return MarkerArray(markers=[stick, joints, flesh])


def no_figure(header: Header, prefix: str) -> MarkerArray:
    """Take one of several figures away."""
    names = ("stick", "joints", "flesh")
    return MarkerArray(markers=[Marker(header=header, ns=prefix + name, action=Marker.DELETE) for name in names])


def no_markers(header: Header) -> MarkerArray:
    """Take the last figure away."""
    return MarkerArray(markers=[Marker(header=header, action=Marker.DELETEALL)])


def _marker(header: Header, namespace: str, kind: int, scale: float, color: ColorRGBA) -> Marker:
    marker = Marker(header=header, ns=namespace, type=kind, action=Marker.ADD, color=color)
    marker.pose.orientation.w = 1.0
    marker.scale = Vector3(x=scale, y=scale, z=scale)
    marker.lifetime = Duration(sec=MARKER_LIFETIME_S)
    return marker


def _points(points: Array) -> list[Point]:
    return [Point(x=x, y=y, z=z) for x, y, z in points.tolist()]


# --- transforms ---


def transform_to_message(T_parent_child: ArrayLike, child: str, header: Header) -> TransformStamped:
    """[4, 4] pose of `child` in the header's frame."""
    T = np.asarray(T_parent_child, dtype=np.float64)
    return turn_to_message(T[:3, 3].tolist(), quaternion(T[:3, :3]), child, header)


def turn_to_message(
    translation: Sequence[float], turn: Sequence[float], child: str, header: Header
) -> TransformStamped:
    """The pose of `child` in the header's frame: m, and a quaternion x, y, z, w."""
    msg = TransformStamped(header=header, child_frame_id=child)
    msg.transform.translation = Vector3(**dict(zip("xyz", translation, strict=True)))
    msg.transform.rotation = Quaternion(**dict(zip("xyzw", turn, strict=True)))
    return msg


def message_to_transform(msg: TransformStamped) -> Array:
    """T_parent_child [4, 4].

    Raises:
        InputError: a quaternion that is not of length 1, or a number that is not finite.
    """
    t, q = msg.transform.translation, msg.transform.rotation
    numbers = np.array([t.x, t.y, t.z, q.x, q.y, q.z, q.w])
    length = float(np.linalg.norm(numbers[3:]))
    if not np.isfinite(numbers).all() or abs(length - 1.0) > 1e-3:
        raise InputError(
            f"transform {msg.header.frame_id} <- {msg.child_frame_id}: expected finite numbers and a quaternion of "
            f"length 1, got {numbers.tolist()}"
        )
    T = np.eye(4)
    T[:3, :3] = rotation_of(numbers[3:] / length)
    T[:3, 3] = numbers[:3]
    return T


def quaternion(R: Array) -> tuple[float, float, float, float]:
    """Rotation matrix [3, 3] -> x, y, z, w of length 1 (Shepperd 1978).

    SciPy has it too, but importing `scipy.spatial` takes a quarter of a second in the start of every process.
    """
    trace = float(np.trace(R))
    # The largest of the four comes from a sum without cancellation, the others from it.
    i = int(np.argmax([R[0, 0], R[1, 1], R[2, 2], trace]))
    q = np.empty(4)
    if i == 3:
        q[:] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], 1 + trace
    else:
        j, k = (i + 1) % 3, (i + 2) % 3
        q[i], q[j], q[k] = 1 + 2 * R[i, i] - trace, R[j, i] + R[i, j], R[k, i] + R[i, k]
        q[3] = R[k, j] - R[j, k]
    x, y, z, w = (q / np.linalg.norm(q)).tolist()
    return x, y, z, w


# --- diagnostics ---

OK, WARN, ERROR, STALE = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR, DiagnosticStatus.STALE


def make_status(
    name: str, level: bytes, message: str, values: Mapping[str, Any], hardware: str = ""
) -> DiagnosticStatus:
    """One entry of `/diagnostics`; floats are given with four significant digits."""
    pairs = [KeyValue(key=k, value=f"{v:.4g}" if isinstance(v, float) else str(v)) for k, v in values.items()]
    return DiagnosticStatus(name=name, level=level, message=message, values=pairs, hardware_id=hardware)


def status_values(status: DiagnosticStatus) -> dict[str, str]:
    """The values of a diagnostics entry by key."""
    return {pair.key: pair.value for pair in status.values}


def worst(levels: Sequence[bytes]) -> bytes:
    """The most serious of some diagnostics levels; OK when there is none."""
    return max(levels, default=OK)
