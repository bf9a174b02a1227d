# SPDX-License-Identifier: Apache-2.0
"""Bone rotations -> joint angles in anatomical terms, continuous over time (paper section 1: "a set of angles
relating each limb to each other"; every angle is drawn in docs/model.md).

A joint turns about its axes one after the other, the first fixed in the parent bone, each next one carried along by
those before it. Axes are x forward, y left, z up of the bones when the person stands straight with hanging arms; all
angles are zero there, with the thumbs forward. Bending forward, abduction, turning outward and raising are positive,
so a mirrored posture has the same limb angles on the other side.

Three angles in a row have a pole: where the middle one turns the last axis onto the first, only the sum or the
difference of these two is determined, and there are always two triples for the same rotation. Given the previous
frame's angles the nearest triple is taken, and near a pole the undetermined angle stays where it was (`solve_triple`).
The orders are chosen so that no pole lies where a joint is often: the shoulder's lies at an arm held straight out to
the side, not at a hanging one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core import _joint_angles_kernels as kernels
from limbloc_ros.core._figure_kernels import exp_so3
from limbloc_ros.core.errors import NoPerson
from limbloc_ros.core.figure import BONE, BONE_NAMES, N_BONES, PARENTS, FigureState, proportions
from limbloc_ros.core.pose import Pose

Array = NDArray[np.float64]

#: How near a pole, as a sine, the undetermined native angle is held: costs at most half of this in rad, that is
#: 0.6 mm at the fingertips.
NATIVE_SLACK = 0.0015
#: How far beyond its range an angle may go before another, farther triple is preferred, rad.
_STRAY = 0.5
#: After this long without a pose the angles start anew, s: whoever comes back may have turned round and round.
GAP_S = 1.0


@dataclass(frozen=True)
class NativeAngle:
    """One joint angle.

    Attributes:
        name: in `Pose.angles`, the CSV header and the native URDF.
        bone: the bone that it turns in its parent.
        axis: signed unit axis [3]; a positive angle turns counterclockwise about it.
        description: what it measures.
        sign: what positive means.
        low, high: the usual human range, rad.
        continuous: it may pass +-pi without a jump (the pelvis in the world).
    """

    name: str
    bone: str
    axis: tuple[float, float, float]
    description: str
    sign: str
    low: float
    high: float
    continuous: bool = False


# name, signed axis on the left or in the middle, description, positive means, range in degrees; in turning order.
_Row = tuple[str, str, str, str, float, float]
_TRUNK: tuple[tuple[str, Sequence[_Row]], ...] = (
    (
        "pelvis",
        [
            ("pelvis_heading", "+z", "heading of the pelvis in the world, from world x", "turned left", -180, 180),
            ("pelvis_tilt", "+y", "tilt of the pelvis", "leaning forward", -180, 180),
            ("pelvis_list", "+x", "sideways list of the pelvis", "right side down", -180, 180),
        ],
    ),
    *(
        (
            bone,
            [
                (f"spine_{part}_flexion", "+y", f"bending of the {part} spine", "forward", -25, 45),
                (f"spine_{part}_bend", "+x", f"side bending of the {part} spine", "to the own right", -30, 30),
                (f"spine_{part}_rotation", "+z", f"twist of the {part} spine", "turned left", -35, 35),
            ],
        )
        for bone, part in (("abdomen", "lower"), ("thorax", "middle"), ("chest", "upper"))
    ),
    (
        "head",
        [
            ("neck_flexion", "+y", "nodding", "chin down", -70, 70),
            ("neck_bend", "+x", "tilting the head", "to the own right", -55, 55),
            ("neck_rotation", "+z", "turning the head", "turned left", -90, 90),
        ],
    ),
)
_LIMBS: list[tuple[str, list[_Row]]] = [
    (
        "clavicle",
        [
            ("clavicle_protraction", "-z", "shoulder girdle, forward and back", "shoulder forward", -40, 40),
            ("clavicle_elevation", "+x", "shoulder girdle, up and down", "shoulder up", -40, 45),
        ],
    ),
    (
        "upper_arm",
        [
            ("shoulder_flexion", "-y", "swing of the upper arm", "arm forward and up", -90, 195),
            ("shoulder_abduction", "+x", "spreading of the upper arm", "away from the body", -75, 195),
            ("shoulder_rotation", "+z", "twist of the upper arm", "bent forearm outward", -120, 120),
        ],
    ),
    ("forearm", [("elbow_flexion", "-y", "bending of the elbow", "bent", -10, 160)]),
    (
        "hand",
        [
            ("forearm_pronation", "-z", "twist of the forearm", "palm turned backward, thumb inward", -100, 100),
            ("wrist_deviation", "-y", "sideways bending of the wrist", "radial, towards the thumb", -60, 60),
            ("wrist_flexion", "-x", "bending of the wrist", "towards the palm", -90, 90),
        ],
    ),
    (
        "thigh",
        [
            ("hip_flexion", "-y", "swing of the thigh", "knee forward and up", -70, 150),
            ("hip_abduction", "+x", "spreading of the thigh", "away from the other leg", -60, 85),
            ("hip_rotation", "+z", "twist of the thigh", "knee turned outward", -75, 75),
        ],
    ),
    ("shin", [("knee_flexion", "+y", "bending of the knee", "bent", -10, 165)]),
    (
        "foot",
        [
            ("ankle_dorsiflexion", "-y", "raising of the foot", "toes up", -70, 50),
            ("ankle_inversion", "-x", "rolling of the foot", "sole turned inward", -45, 45),
            ("ankle_rotation", "+z", "turning of the foot", "toes outward", -45, 45),
        ],
    ),
]


def _axis(text: str, mirrored: bool) -> tuple[float, float, float]:
    """`+x` -> (1, 0, 0). The mirror image of a turn about x or z is the opposite turn."""
    sign = (1.0 if text[0] == "+" else -1.0) * (-1.0 if mirrored and text[1] in "xz" else 1.0)
    x, y, z = (sign if letter == text[1] else 0.0 for letter in "xyz")
    return (x, y, z)


def _angles() -> tuple[NativeAngle, ...]:
    joints = [(bone, "", rows) for bone, rows in _TRUNK]
    joints += [(f"{bone}_{side}", side, rows) for side in "LR" for bone, rows in _LIMBS]
    found = []
    for bone, side, rows in joints:
        for name, axis, description, sign, low, high in rows:
            joint, _, motion = name.partition("_")
            full = f"{joint}_{side}_{motion}" if side else name
            limits = (float(np.radians(low)), float(np.radians(high)))
            signed = _axis(axis, side == "R")
            found.append(NativeAngle(full, bone, signed, description, sign, *limits, bone == "pelvis"))
    return tuple(found)


#: Every native angle: the pelvis in the world, then one per degree of freedom of the figure, parents first.
NATIVE_ANGLES: tuple[NativeAngle, ...] = _angles()

#: The angles of each bone, in turning order.
ANGLES_OF: dict[str, tuple[NativeAngle, ...]] = {
    bone: tuple(angle for angle in NATIVE_ANGLES if angle.bone == bone) for bone in BONE_NAMES
}

#: Axes [N, 3], lowest and highest angle [N] of each bone.
_TABLES: dict[str, tuple[Array, Array, Array]] = {
    bone: (
        np.array([angle.axis for angle in angles]),
        np.array([-np.inf if angle.continuous else angle.low for angle in angles]),
        np.array([np.inf if angle.continuous else angle.high for angle in angles]),
    )
    for bone, angles in ANGLES_OF.items()
}


@dataclass(frozen=True)
class Range:
    """Where an angle lives: its range, rad, and whether it may go round and round."""

    low: float
    high: float
    continuous: bool = False


def native_angles(
    rotations_world: Array, previous: Mapping[str, float] | None = None, shape: Array | None = None
) -> dict[str, float]:
    """Joint angles of one frame.

    Args:
        rotations_world: T_world_bone rotations [B, 3, 3], bones in the order of `figure.BONE_NAMES`.
        previous: the angles of the frame before, for continuity; None decides by the usual human ranges alone.
        shape: `FigureState.shape` of the person, for the exact length of the clavicle; a mean person's when None, which
            misplaces the shoulder by up to 3 mm at the ends of the clavicle's range.

    Returns:
        rad, by name, in the order of NATIVE_ANGLES.

    Raises:
        ValueError: the rotations have another shape.
    """
    if rotations_world.shape != (N_BONES, 3, 3):
        raise ValueError(
            f"expected the rotations of {N_BONES} bones [{N_BONES}, 3, 3] as in Pose.rotations, "
            f"got an array {list(rotations_world.shape)}"
        )
    # The clavicle has two angles, so the frame from which the shoulder's are measured is rebuilt from them.
    world = rotations_world.copy()
    result: dict[str, float] = {}
    for b, bone in enumerate(BONE_NAMES):
        parent = PARENTS[b]
        R = world[b] if parent < 0 else world[parent].T @ world[b]
        angles, (axes, low, high) = ANGLES_OF[bone], _TABLES[bone]
        if len(angles) == 1:
            values = np.array([hinge_angle(R, axes[0])])
        elif len(angles) == 2:
            values = _clavicle_angles(R, axes, _shoulder_place(bone, shape))
            world[b] = world[parent] @ turned(axes, values)
        else:
            last = None if previous is None else np.array([previous[angle.name] for angle in angles])
            values = _solve(R, axes, low, high, last, NATIVE_SLACK)
        for angle, value in zip(angles, values, strict=True):
            result[angle.name] = float(value)
    return {angle.name: result[angle.name] for angle in NATIVE_ANGLES}


class ContinuousAngles:
    """Gives the poses of a sequence angles that do not jump, each the nearest to those of the frame before.

    The engines leave `Pose.angles` as they are for a frame alone. The live node and the offline run both pass all
    their frames through here in the order of their stamps, and so get the same angles.
    """

    def __init__(self) -> None:
        self._last: Mapping[str, float] | None = None
        self._last_ns = 0

    def follow(self, outcome: Pose | NoPerson, stamp_ns: int) -> Pose | NoPerson:
        """The same outcome, its angles continuing those of the last pose, if that was within GAP_S."""
        if isinstance(outcome, NoPerson):
            return outcome
        if abs(stamp_ns - self._last_ns) > GAP_S * 1e9:
            self._last = None
        if self._last is not None:
            shape = FigureState.from_vector(outcome.parameters).shape
            outcome = replace(outcome, angles=native_angles(outcome.rotations, self._last, shape))
        self.resume(outcome, stamp_ns)
        return outcome

    def resume(self, outcome: Pose | NoPerson, stamp_ns: int) -> None:
        """Go on after a frame that has been followed before."""
        if isinstance(outcome, Pose):
            self._last, self._last_ns = outcome.angles, stamp_ns

    def reset(self) -> None:
        """Forget the last frame."""
        self._last = None

    def snapshot(self) -> tuple[dict[str, float] | None, int]:
        """What `restore` needs to go on in another process: the last pose's angles and its stamp, ns."""
        return None if self._last is None else dict(self._last), self._last_ns

    def restore(self, angles: Mapping[str, float] | None, stamp_ns: int) -> None:
        """Go on after a snapshot."""
        self._last, self._last_ns = angles, stamp_ns


def native_rotations(angles: Mapping[str, float]) -> Array:
    """The inverse of `native_angles`: each bone's rotation [B, 3, 3] in its parent (the pelvis in the world)."""
    joints = [ANGLES_OF[bone] for bone in BONE_NAMES]
    return np.array([turned(np.array([a.axis for a in joint]), [angles[a.name] for a in joint]) for joint in joints])


def turned(axes: Array, angles: Sequence[float] | Array) -> Array:
    """[3, 3] rotation by `angles` (rad) about `axes` [N, 3], the first fixed, each next one carried along."""
    R = np.eye(3)
    for axis, angle in zip(axes, angles, strict=True):
        R = R @ exp_so3(axis * angle)
    return R


def hinge_angle(R: Array, axis: Array) -> float:
    """The angle (rad) about `axis` that comes nearest to the rotation `R`."""
    skew = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    return float(np.arctan2(skew @ axis, R[0, 0] + R[1, 1] + R[2, 2] - axis @ R @ axis))


def solve_triple(
    R: Array, axes: Array, ranges: Sequence[Range], previous: Array | None = None, slack: float = 0.0
) -> Array:
    """The angles [3] (rad) with `turned(axes, angles)` = R.

    Args:
        R: [3, 3] rotation.
        axes: [3, 3] three signed coordinate axes in rows, neighbours at right angles.
        ranges: the usual range of each angle.
        previous: [3] angles of the frame before. The nearest solution is taken, and close to the pole the first angle
            moves less than R asks for, as in a damped least-squares solution.
        slack: how close, as the sine of the angle between the first and the last axis. The result's last axis is then
            off by at most half of this (rad); far from the pole, and when nothing moves, the result is exact.

    Returns:
        Angles that pass +-pi without a jump while they stay within half a turn of their range's middle and a bit.
    """
    low = np.array([-np.inf if r.continuous else r.low for r in ranges])
    high = np.array([np.inf if r.continuous else r.high for r in ranges])
    return _solve(R, axes, low, high, previous, slack)


def _solve(R: Array, axes: Array, low: Array, high: Array, previous: Array | None, slack: float) -> Array:
    follow = previous is not None
    start = previous if previous is not None else np.zeros(3)
    return kernels.triple(R, axes, low, high, start, follow, slack, _STRAY)  # type: ignore[no-any-return]


def _shoulder_place(clavicle: str, shape: Array | None) -> Array:
    """[3] the shoulder in the clavicle, m for a stature of 1 m."""
    offsets = proportions().bone_offsets[BONE[f"upper_arm_{clavicle[-1]}"]]
    return np.asarray(offsets[:, 0] if shape is None else offsets[:, 0] + offsets[:, 1:] @ shape[1:])


def _clavicle_angles(R: Array, axes: Array, shoulder: Array) -> Array:
    """The two angles of a clavicle that put the shoulder where the rotation R puts it.

    A turn about the clavicle's own length, which small turns about two axes add up to, does not move the shoulder.
    """
    x, y, z = R @ shoulder
    reach = np.sign(shoulder[1]) * np.sqrt(max(x * x + y * y - shoulder[0] ** 2, 0.0))  # y after the turn about x
    about_z = np.arctan2(y, x) - np.arctan2(reach, shoulder[0])
    about_x = np.arctan2(z, reach) - np.arctan2(shoulder[2], shoulder[1])
    about_z = np.remainder(about_z + np.pi, 2 * np.pi) - np.pi
    about_x = np.remainder(about_x + np.pi, 2 * np.pi) - np.pi
    return np.array([about_z * axes[0, 2], about_x * axes[1, 0]])
