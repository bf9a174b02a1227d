# SPDX-License-Identifier: Apache-2.0
"""A fitted person as URDF: the 20 joints of ROS4HRI (REP-155), and the native figure with all its joints.

REP-155's stock description knows only a height, which puts wrists and ankles centimetres off; ours has its names, axes
and zero with the fitted lengths. Both depend on the person's sizes alone, not on the posture, and are rooted in
`body_<id>`: between the hips, x forward, z up along the pelvis.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from limbloc_ros.core._figure_topology import JOINT_BONES, PARTS, SPHERES
from limbloc_ros.core.figure import BONE_NAMES, PARENTS, SPHERE, Placed
from limbloc_ros.core.joint_angles import ANGLES_OF
from limbloc_ros.core.pose import JOINT_NAMES, Pose
from limbloc_ros.core.ros4hri import ROS4HRI_JOINTS, link_origins, neutral, state_of

Array = NDArray[np.float64]

#: parent, child: joints of REP-155 that do not move.
_FIXED = (
    ("waist", "torso"),
    ("p_head", "head"),
    *((f"{s}_{a}", f"{s}_{b}") for s in "lr" for a, b in (("elbow", "wrist"), ("knee", "ankle"))),
)
#: The link of REP-155 that carries the flesh of each bone.
_LINK_OF_BONE = {"pelvis": "body", "abdomen": "waist", "thorax": "torso", "chest": "torso", "head": "head"} | {
    f"{bone}_{side}": link if bone == "clavicle" else f"{side.lower()}_{link}"
    for side in "LR"
    for bone, link in (
        ("clavicle", "torso"),
        ("upper_arm", "shoulder"),
        ("forearm", "elbow"),
        ("hand", "wrist"),
        ("thigh", "hip"),
        ("shin", "knee"),
        ("foot", "ankle"),
    )
}
_COLOURS = {"middle": "0.72 0.74 0.78 1", "left": "0.25 0.50 0.80 1", "right": "0.88 0.50 0.22 1"}
#: URDF demands them; nothing here has motors.
_EFFORT_NM, _VELOCITY_RAD_S = "200", "30"


def body_urdf(pose: Pose, body_id: str) -> str:
    """The person as REP-155 wants it; its joint angles are those of `core.ros4hri.ros4hri`.

    Args:
        pose: a fitted pose; only the person's sizes are used.
        body_id: letters, digits and underscores, a letter first.

    Returns:
        URDF text. Links are `body_<id>`, `waist_<id>`, ..., joints `waist_<id>`, `l_elbow_<id>`, ...

    Raises:
        ValueError: the id cannot be part of a name, or the pose's parameters are not those of the figure.
    """
    figure = neutral(state_of(pose).shape)
    origins = link_origins(figure)
    robot = _Robot(body_id, origins)
    robot.links(origins, figure, _LINK_OF_BONE)
    for joint in ROS4HRI_JOINTS:
        robot.joint(joint.name, joint.parent, joint.child, joint.axis, (joint.low, joint.high))
    for parent, child in _FIXED:
        robot.joint(child, parent, child)
    return robot.text()


def native_urdf(pose: Pose, body_id: str) -> str:
    """The whole figure: every degree of freedom a revolute joint; its angles are those of `Pose.angles`.

    Forward kinematics with them gives the published joints, which are links here (`shoulder_L_<id>`, `toe_R_<id>`),
    hung on the bones (`bone_<name>_<id>`). No link but the root shares its name with `body_urdf`, so that both may be
    in TF at once.

    Args:
        pose: a fitted pose; only the person's sizes are used.
        body_id: letters, digits and underscores, a letter first.

    Raises:
        ValueError: the id cannot be part of a name, or the pose's parameters are not those of the figure.
    """
    figure = neutral(state_of(pose).shape)
    bones = {bone: f"bone_{bone}" for bone in BONE_NAMES}
    origins = {"body": np.zeros(3)}
    joints: list[tuple[str, str, str, Sequence[float], tuple[float, float]]] = []
    for b, bone in enumerate(BONE_NAMES):
        angles = ANGLES_OF[bone] if PARENTS[b] >= 0 else ()
        parent = bones[BONE_NAMES[PARENTS[b]]] if angles else "body"
        for angle in angles:
            child = bones[bone] if angle is angles[-1] else f"turn_{angle.name}"
            # A quarter turn of room: angles stay continuous rather than inside the usual range.
            joints.append((angle.name, parent, child, angle.axis, (angle.low - np.pi / 2, angle.high + np.pi / 2)))
            origins[child] = figure.origins[b]
            parent = child
        origins[bones[bone]] = figure.origins[b]
    origins |= dict(zip(JOINT_NAMES, figure.joints, strict=True))
    robot = _Robot(body_id, origins)
    robot.links(origins, figure, bones)
    robot.joint("to_pelvis", "body", bones["pelvis"])
    for row in joints:
        robot.joint(*row)
    for name in JOINT_NAMES:
        robot.joint(f"to_{name}", bones[JOINT_BONES[name]], name)
    return robot.text()


class _Robot:
    """Builds the XML. At zero all links have the same axes, so a joint's origin is a difference of places."""

    def __init__(self, body_id: str, origins: Mapping[str, Array]) -> None:
        if not re.fullmatch("[A-Za-z][A-Za-z0-9_]*", body_id):
            raise ValueError(f"expected a body id of letters, digits and _, a letter first, got {body_id!r}")
        self._id = body_id
        self._origins = origins
        self._root = ET.Element("robot", name=f"human_{body_id}")
        for name, rgba in _COLOURS.items():
            ET.SubElement(ET.SubElement(self._root, "material", name=name), "color", rgba=rgba)

    def links(self, names: Iterable[str], figure: Placed, link_of_bone: Mapping[str, str]) -> None:
        """All links, with the flesh of the bones that each one carries."""
        link_of_sphere = {row[0]: link_of_bone[row[1]] for row in SPHERES}
        sides = {link: _side(bone) for bone, link in link_of_bone.items()}
        sticks = {
            tuple(sorted((a, b)))
            for _, part in PARTS
            for a in part
            for b in part
            if a != b and link_of_sphere[a] == link_of_sphere[b]
        }
        for name in names:
            link = ET.SubElement(self._root, "link", name=f"{name}_{self._id}")
            for sphere, carrier in link_of_sphere.items():
                if carrier == name:
                    centre, radius = figure.spheres[SPHERE[sphere]], figure.radii[SPHERE[sphere]]
                    at = centre - self._origins[name]
                    self._visual(link, sides[name], "sphere", at, radius=_number(radius))
            for a, b in sorted(sticks):
                if link_of_sphere[a] == name:
                    self._cylinder(link, sides[name], figure, (a, b), self._origins[name])

    def _cylinder(self, link: ET.Element, side: str, figure: Placed, ends: tuple[str, str], origin: Array) -> None:
        rows = [SPHERE[sphere] for sphere in ends]
        start, end = figure.spheres[rows]
        x, y, z = end - start
        # URDF has no cones; a thicker cylinder would stick out at the thin end.
        size = {"radius": _number(figure.radii[rows].min()), "length": _number(float(np.linalg.norm(end - start)))}
        turn = (0.0, float(np.arctan2(np.hypot(x, y), z)), float(np.arctan2(y, x)))
        self._visual(link, side, "cylinder", 0.5 * (start + end) - origin, turn, **size)

    @staticmethod
    def _visual(
        link: ET.Element,
        side: str,
        shape: str,
        centre: Array,
        turn: Sequence[float] = (0.0, 0.0, 0.0),
        **size: str,
    ) -> None:
        visual = ET.SubElement(link, "visual")
        ET.SubElement(visual, "origin", xyz=_numbers(centre), rpy=_numbers(turn))
        ET.SubElement(ET.SubElement(visual, "geometry"), shape, size)
        ET.SubElement(visual, "material", name=side)

    def joint(
        self,
        name: str,
        parent: str,
        child: str,
        axis: Sequence[float] | None = None,
        limits: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        """A revolute joint about `axis`, or a fixed one without."""
        kind = "fixed" if axis is None else "revolute"
        joint = ET.SubElement(self._root, "joint", name=f"{name}_{self._id}", type=kind)
        ET.SubElement(joint, "origin", xyz=_numbers(self._origins[child] - self._origins[parent]), rpy="0 0 0")
        ET.SubElement(joint, "parent", link=f"{parent}_{self._id}")
        ET.SubElement(joint, "child", link=f"{child}_{self._id}")
        if axis is not None:
            low, high = (_number(limit) for limit in limits)
            ET.SubElement(joint, "axis", xyz=_numbers(axis))
            ET.SubElement(joint, "limit", lower=low, upper=high, effort=_EFFORT_NM, velocity=_VELOCITY_RAD_S)

    def text(self) -> str:
        """The document."""
        ET.indent(self._root)
        return '<?xml version="1.0"?>\n' + ET.tostring(self._root, encoding="unicode") + "\n"


def _side(bone: str) -> str:
    """The colour of a bone's flesh; the shoulder girdle is part of the trunk."""
    if bone.startswith("clavicle"):
        return "middle"
    return {"_L": "left", "_R": "right"}.get(bone[-2:], "middle")


def _number(value: float) -> str:
    return f"{round(value, 6) + 0.0:.6g}"  # + 0.0: no minus zero


def _numbers(values: ArrayLike) -> str:
    return " ".join(_number(float(value)) for value in np.asarray(values))
