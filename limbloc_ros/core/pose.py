# SPDX-License-Identifier: Apache-2.0
"""What the method returns for one frame: joints, frames, angles, flesh, energy, confidence."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SIDED = ("shoulder", "elbow", "wrist", "hand", "fingertip", "hip", "knee", "ankle", "toe", "heel")

#: The joints of every result, in this order; `_L` and `_R` are the person's own sides.
JOINT_NAMES: tuple[str, ...] = (
    "head_centre",
    "head_top",
    "neck_base",
    "torso_centre",
    "pelvis_centre",
    *(f"{joint}_{side}" for joint in SIDED for side in "LR"),
)

#: Index of a joint by its name.
JOINT = {name: index for index, name in enumerate(JOINT_NAMES)}

#: The joints that the benchmark scores: the head and the limbs.
LIMB_JOINTS = (
    "head_centre",
    *(f"{joint}_{side}" for joint in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle") for side in "LR"),
)

#: The stick figure: the bones as pairs of joints.
STICK_BONES: tuple[tuple[str, str], ...] = (
    ("pelvis_centre", "torso_centre"),
    ("torso_centre", "neck_base"),
    ("neck_base", "head_centre"),
    ("head_centre", "head_top"),
    *(
        (f"{a}_{s}" if a in SIDED else a, f"{b}_{s}")
        for s in "LR"
        for a, b in (
            ("neck_base", "shoulder"),
            ("shoulder", "elbow"),
            ("elbow", "wrist"),
            ("wrist", "hand"),
            ("hand", "fingertip"),
            ("pelvis_centre", "hip"),
            ("hip", "knee"),
            ("knee", "ankle"),
            ("ankle", "heel"),
            ("ankle", "toe"),
        )
    ),
)


@dataclass(frozen=True)
class Flesh:
    """The flesh figure of one pose: a union of convex hulls of one, two or three spheres.

    One sphere is the paper's sphere, two are its frustum (with round ends), three its flat elliptical cylinder.

    Attributes:
        centres: [S, 3] sphere centres in the world, m.
        radii: [S] m.
        parts: [P, 3] int indices of each part's spheres; an index repeats where a part has fewer than three.
        part_names: P names such as `head`, `chest`, `thigh_L`.
    """

    centres: Array
    radii: Array
    parts: NDArray[np.int64]
    part_names: tuple[str, ...]


@dataclass(frozen=True)
class Pose:
    """A person in one frame, in world axes (z up, metres, radians).

    Attributes:
        joints: [25, 3] m, in the order of JOINT_NAMES.
        rotations: T_world_bone rotations [B, 3, 3] by `bone_names`; a bone's axes are x forward, y left, z up when the
            person stands straight with hanging arms.
        bone_names: B names (`pelvis`, `abdomen`, `chest`, `neck`, `head`, `clavicle_L`, `upper_arm_L`, ...).
        angles: the native joint angles by name, rad.
        sizes: the fitted lengths and radii by name, m.
        flesh: the flesh figure.
        parameters: the engine's own parameter vector, to start the next frame from.
        energy: the XOR energy (eq. 2), 0 is a perfect overlap, 1 as bad as no figure.
        sigma: [25] expected error of each joint, m.
        reliable: False when the pose should not be acted on.
        stage_ms: process time of each stage, ms.
        risk: the chance, 0 to 1, that a joint of its limbs is 15 cm off, as far as the frame alone tells.
        doubt: why it is not reliable, in a few words; empty when it is, or when that is not known.
    """

    joints: Array
    rotations: Array
    bone_names: tuple[str, ...]
    angles: dict[str, float]
    sizes: dict[str, float]
    flesh: Flesh
    parameters: Array
    energy: float
    sigma: Array
    reliable: bool = True
    stage_ms: dict[str, float] = field(default_factory=dict)
    risk: float = 0.0
    doubt: str = ""

    def joint(self, name: str) -> Array:
        """[3] position of the joint `name`, m."""
        return np.asarray(self.joints[JOINT[name]])
