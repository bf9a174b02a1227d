# SPDX-License-Identifier: Apache-2.0
"""A pose as the 20 joints of ROS4HRI (REP-155): the chain with the person's own lengths, and its angles.

The chain has one bending joint for the whole spine and no clavicles, so it cannot follow everything that the figure
does (docs/model.md, "What the projection drops"). What it can follow is kept exactly: pelvis, legs, the direction of
the head, and the bend of the elbows. The waist then brings neck and shoulders as near as it can, and the arms bring
elbows and wrists as near as the misplaced shoulders allow.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core.figure import BONE, N_BONES, FigureState, Placed, place, proportions
from limbloc_ros.core.joint_angles import Range, hinge_angle, solve_triple
from limbloc_ros.core.pose import JOINT, Pose

Array = NDArray[np.float64]

#: How near the pole of a shoulder (an arm hanging straight down), as a sine, its undetermined angle is held; the arm's
#: direction is then off by at most half of this, rad.
SHOULDER_SLACK = 0.06

#: What the elbow's hinge weighs against the places of elbow and wrist, as a length.
HINGE_M = 0.1
_ARM = (("elbow", "shoulder"), ("wrist", "elbow"))


@dataclass(frozen=True)
class Ros4hriJoint:
    """One revolute joint of REP-155.

    Attributes:
        name: without the person's id.
        parent, child: links, without the id.
        axis: [3] in the parent link, which at zero has x forward, y left, z up.
        stock: lowest and highest angle in REP-155's own URDF, rad.
        low, high: what our URDF allows, rad: the stock range, widened to what people do (the stock hips cannot sit).
        sign: what positive means.
    """

    name: str
    parent: str
    child: str
    axis: tuple[float, float, float]
    stock: tuple[float, float]
    low: float
    high: float
    sign: str


def _joints() -> tuple[Ros4hriJoint, ...]:
    x, y, z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
    minus_x, minus_y, minus_z = (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0)
    found = [
        Ros4hriJoint("waist", "body", "waist", y, (-0.2, 1.0), -1.2, 2.0, "bend forward"),
        Ros4hriJoint("r_head", "torso", "r_head", x, (-1.0, 1.0), -1.6, 1.6, "tilt to the own right"),
        Ros4hriJoint("y_head", "r_head", "y_head", z, (-1.4, 1.4), -2.6, 2.6, "turn left"),
        Ros4hriJoint("p_head", "y_head", "p_head", minus_y, (-1.5, 1.5), -2.2, 2.2, "look up"),
    ]
    for s in "lr":
        outward, inward, abduct = (z, minus_z, x) if s == "l" else (minus_z, z, minus_x)
        arm, leg = f"{s}_shoulder", f"{s}_hip"
        rows = [
            (f"{s}_y_shoulder", "torso", f"{s}_y_shoulder", inward, (-1.1, 1.9), -3.2, 3.8, "raised arm goes forward"),
            (f"{s}_p_shoulder", f"{s}_y_shoulder", f"{s}_p_shoulder", abduct, (-0.4, 3.3), -2.0, 3.7, "abduction"),
            (f"{s}_r_shoulder", f"{s}_p_shoulder", arm, outward, (-1.7, 1.5), -4.0, 4.0, "bent forearm turns outward"),
            (f"{s}_elbow", arm, f"{s}_elbow", minus_y, (0.0, 2.5), -0.3, 2.9, "flexion"),
            (f"{s}_y_hip", "body", f"{s}_y_hip", minus_z, (-0.1, 0.6), -1.8, 1.8, "turn right, both sides"),
            (f"{s}_p_hip", f"{s}_y_hip", f"{s}_p_hip", abduct, (-0.4, 3.3), -1.6, 3.3, "abduction"),
            (f"{s}_r_hip", f"{s}_p_hip", leg, minus_y, (-0.4, 0.7), -1.6, 3.2, "flexion"),
            (f"{s}_knee", leg, f"{s}_knee", minus_y, (-2.5, 0.0), -3.0, 0.3, "extension (flexion is negative)"),
        ]
        found += [Ros4hriJoint(*row) for row in rows]
    return tuple(found)


#: The 20 revolute joints of REP-155.
ROS4HRI_JOINTS: tuple[Ros4hriJoint, ...] = _joints()
_BY_NAME = {joint.name: joint for joint in ROS4HRI_JOINTS}
#: Where the solver expects each angle when no earlier frame tells: the stock range, and sitting hips.
_EXPECTED = {j.name: Range(*j.stock) for j in ROS4HRI_JOINTS} | {f"{s}_r_hip": Range(-0.7, 2.4) for s in "lr"}


def state_of(pose: Pose) -> FigureState:
    """The figure's state in a pose.

    Raises:
        ValueError: the pose's parameters are not those of the figure.
    """
    expected = 3 + 9 * N_BONES + proportions().n_shape
    if pose.parameters.shape != (expected,):
        raise ValueError(
            f"expected Pose.parameters from FigureState.to_vector, {expected} numbers, "
            f"got an array {list(pose.parameters.shape)}: use a pose that this version of the pipeline has fitted"
        )
    return FigureState.from_vector(pose.parameters)


def neutral(shape: Array) -> Placed:
    """A person of that shape who stands straight, with hanging arms, origin between the hips, looking along x."""
    placed = place(FigureState(np.zeros(3), np.tile(np.eye(3), (N_BONES, 1, 1)), shape))
    middle = 0.5 * (placed.joints[JOINT["hip_L"]] + placed.joints[JOINT["hip_R"]])
    return Placed(
        placed.origins - middle, placed.rotations, placed.spheres - middle, placed.radii, placed.joints - middle
    )


def link_origins(figure: Placed) -> dict[str, Array]:
    """Where the links of REP-155 begin in a neutral figure, [3] m by link, names without the id.

    The waist turns about the middle of the spine's three joints: that is where a spine which bends evenly turns.
    """
    at = {name: figure.joints[index] for name, index in JOINT.items()}
    origins = {
        "body": np.zeros(3),
        "waist": np.mean([figure.origins[BONE[bone]] for bone in ("abdomen", "thorax", "chest")], axis=0),
        "torso": at["torso_centre"],
        **dict.fromkeys(("r_head", "y_head", "p_head"), at["neck_base"]),
        "head": at["head_centre"],
    }
    for s in "lr":
        side = s.upper()
        origins |= dict.fromkeys((f"{s}_y_shoulder", f"{s}_p_shoulder", f"{s}_shoulder"), at[f"shoulder_{side}"])
        origins |= {f"{s}_elbow": at[f"elbow_{side}"], f"{s}_wrist": at[f"wrist_{side}"]}
        origins |= dict.fromkeys((f"{s}_y_hip", f"{s}_p_hip", f"{s}_hip"), at[f"hip_{side}"])
        origins |= {f"{s}_knee": at[f"knee_{side}"], f"{s}_ankle": at[f"ankle_{side}"]}
    return origins


def ros4hri(pose: Pose, previous: Mapping[str, float] | None = None) -> dict[str, float]:
    """The 20 angles of REP-155.

    Args:
        pose: of a fitted person.
        previous: the angles of the frame before, for continuity through the shoulders' pole.

    Returns:
        rad, by name without the person's id, in the order of ROS4HRI_JOINTS. They are the true angles also where they
        exceed the stock limits.

    Raises:
        ValueError: the pose's parameters are not those of the figure.
    """
    origins = link_origins(neutral(state_of(pose).shape))
    world = {name: pose.rotations[pose.bone_names.index(name)] for name in BONE}
    R_world_body = world["pelvis"]
    middle = 0.5 * (pose.joint("hip_L") + pose.joint("hip_R"))

    def in_body(joint: str) -> Array:
        return np.asarray(R_world_body.T @ (pose.joint(joint) - middle))

    result = {"waist": _waist(origins, {name: in_body(name) for name in ("neck_base", "shoulder_L", "shoulder_R")})}
    R_body_torso = _rotation_y(result["waist"])
    R_world_torso = R_world_body @ R_body_torso
    result |= _triple(R_world_torso.T @ world["head"], ("r_head", "y_head", "p_head"), previous, 0.0)
    for s, side in (("l", "L"), ("r", "R")):
        flexion = hinge_angle(
            world[f"upper_arm_{side}"].T @ world[f"forearm_{side}"], np.array(_BY_NAME[f"{s}_elbow"].axis)
        )
        names = (f"{s}_y_shoulder", f"{s}_p_shoulder", f"{s}_r_shoulder")
        shoulder = R_body_torso @ (origins[f"{s}_shoulder"] - origins["waist"]) + origins["waist"]
        reach = [R_body_torso.T @ (in_body(f"{joint}_{side}") - shoulder) for joint in ("elbow", "wrist")]
        lengths = [float(np.linalg.norm(origins[f"{s}_{a}"] - origins[f"{s}_{b}"])) for a, b in _ARM]
        hinge = R_world_torso.T @ world[f"upper_arm_{side}"][:, 1]
        result |= _triple(_upper_arm(reach, hinge, lengths, flexion), names, previous, SHOULDER_SLACK)
        result[f"{s}_elbow"] = flexion
        names = (f"{s}_y_hip", f"{s}_p_hip", f"{s}_r_hip")
        result |= _triple(R_world_body.T @ world[f"thigh_{side}"], names, previous, 0.0)
        result[f"{s}_knee"] = hinge_angle(
            world[f"thigh_{side}"].T @ world[f"shin_{side}"], np.array(_BY_NAME[f"{s}_knee"].axis)
        )
    return {joint.name: result[joint.name] for joint in ROS4HRI_JOINTS}


def _waist(origins: Mapping[str, Array], targets: Mapping[str, Array]) -> float:
    """The angle that brings neck and shoulders nearest to where they are, in the body's frame."""
    start = np.array([origins["r_head"], origins["l_shoulder"], origins["r_shoulder"]]) - origins["waist"]
    end = np.array([targets["neck_base"], targets["shoulder_L"], targets["shoulder_R"]]) - origins["waist"]
    across = (start[:, 2] * end[:, 0] - start[:, 0] * end[:, 2]).sum()
    return float(np.arctan2(across, (start[:, 0] * end[:, 0] + start[:, 2] * end[:, 2]).sum()))


def _upper_arm(reach: list[Array], hinge: Array, lengths: list[float], flexion: float) -> Array:
    """The rotation of the upper arm in the torso that brings elbow and wrist nearest to `reach`, m from the shoulder.

    The elbow keeps its bend. Its hinge counts a little, for it alone tells the twist of a straight arm.
    """
    elbow = np.array([0.0, 0.0, -lengths[0]])
    wrist = elbow + lengths[1] * np.array([np.sin(flexion), 0.0, -np.cos(flexion)])
    A = np.outer(reach[0], elbow) + np.outer(reach[1], wrist) + HINGE_M**2 * np.outer(hinge, [0.0, 1.0, 0.0])
    U, _, Vt = np.linalg.svd(A)
    return np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)


def _rotation_y(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def _triple(
    R: Array, names: tuple[str, str, str], previous: Mapping[str, float] | None, slack: float
) -> dict[str, float]:
    axes = np.array([_BY_NAME[name].axis for name in names])
    last = None if previous is None else np.array([previous[name] for name in names])
    values = solve_triple(R, axes, [_EXPECTED[name] for name in names], last, slack)
    return dict(zip(names, map(float, values), strict=True))
