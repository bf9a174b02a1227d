# SPDX-License-Identifier: Apache-2.0
"""Link rotations of a simple motion skeleton -> bone rotations of a person.

The motion skeleton is DeepMimic's: 13 links that turn about their joint, relative to their parent. All rotations zero
is a straight body with hanging arms, palms to the thighs, looking along +x; axes are x forward, y left, z up.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.simulation import _person_kernels as kernels
from limbloc_ros.simulation.person import Person

Array = NDArray[np.float64]

#: The links, parents before children.
LINKS: tuple[str, ...] = (
    "root", "chest", "neck",
    "hip_L", "knee_L", "ankle_L", "hip_R", "knee_R", "ankle_R",
    "shoulder_L", "elbow_L", "shoulder_R", "elbow_R",
)  # fmt: skip
LINK = {name: index for index, name in enumerate(LINKS)}
LINK_PARENTS = np.array([-1, 0, 1, 0, 3, 4, 0, 6, 7, 1, 9, 1, 11], dtype=np.int64)

# bone -> (link, mode, share). The spine bends evenly, the clavicle follows a fifth of the arm's swing (scapulohumeral
# rhythm), and a limb's upper half takes half of its axial twist, so that the skin does not wring.
_SHARES: dict[str, tuple[str, int, float]] = {
    "root": ("root", kernels.SHARE, 1.0),
    **{f"spine0{k}": ("chest", kernels.SHARE, (6 - k) / 5) for k in (5, 4, 3, 2, 1)},
    **{f"neck0{k}": ("neck", kernels.SHARE, k / 4) for k in (1, 2, 3)},
    "head": ("neck", kernels.SHARE, 1.0),
}
_LIMB_SHARES: dict[str, tuple[str, int, float]] = {
    "clavicle": ("shoulder", kernels.SWING_SHARE, 0.15),
    "shoulder01": ("shoulder", kernels.SWING_SHARE, 0.25),
    "upperarm01": ("shoulder", kernels.HALF_TWIST, 0.5),
    "upperarm02": ("shoulder", kernels.SHARE, 1.0),
    "lowerarm01": ("elbow", kernels.SHARE, 1.0),
    "lowerarm02": ("elbow", kernels.SHARE, 1.0),
    "wrist": ("elbow", kernels.SHARE, 1.0),
    "upperleg01": ("hip", kernels.HALF_TWIST, 0.5),
    "upperleg02": ("hip", kernels.SHARE, 1.0),
    "lowerleg01": ("knee", kernels.SHARE, 1.0),
    "lowerleg02": ("knee", kernels.SHARE, 1.0),
    "foot": ("ankle", kernels.SHARE, 1.0),
}


def _unit(v: Array) -> Array:
    return np.asarray(v / np.linalg.norm(v))


def _shortest(a: Array, b: Array) -> Array:
    """[3, 3] the shortest rotation that takes the direction a to b (not opposite)."""
    a, b = _unit(a), _unit(b)
    v, c = np.cross(a, b), float(a @ b)
    skew = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.asarray(np.eye(3) + skew + skew @ skew / (1 + c))


def _limb_to_down(direction: Array, bend_axis: Array, down: Array) -> Array:
    """[3, 3] takes a limb's direction to `down` and the axis of its joint's flexion to the body's right (-y)."""

    def frame(d: Array, n: Array) -> Array:
        d = _unit(d)
        n = _unit(n - d * (d @ n))
        return np.stack([d, n, np.cross(d, n)], axis=1)

    return np.asarray(frame(down, np.array([0.0, -1.0, 0.0])) @ frame(direction, bend_axis).T)


class Retarget:
    """Maps link rotations to the bones of one person.

    Args:
        person: whose bones.
        arm_gap_rad: hanging arms are this far from vertical, so that they do not sink into wide hips.
    """

    def __init__(self, person: Person, arm_gap_rad: float = 0.12) -> None:
        self.person = person
        names = person.bone_names
        self._to_neutral = np.tile(np.eye(3), (len(names), 1, 1))
        links, modes, shares = [], [], []
        for name in names:
            bone, _, side = name.partition(".")
            link, mode, share = _LIMB_SHARES[bone] if side else _SHARES[bone]
            links.append(LINK[f"{link}_{side}" if side else link])
            modes.append(mode)
            shares.append(share)
        self._links, self._modes = np.array(links, dtype=np.int64), np.array(modes, dtype=np.int64)
        self._shares = np.array(shares)
        for side, left in (("L", 1.0), ("R", -1.0)):
            shoulder, elbow, wrist = (person.rest_joint(f"{j}_{side}") for j in ("shoulder", "elbow", "wrist"))
            hip, knee, ankle = (person.rest_joint(f"{j}_{side}") for j in ("hip", "knee", "ankle"))
            # At rest the elbow is already bent a little: that plane tells the axis of its flexion.
            flexion = np.cross(elbow - shoulder, wrist - elbow)
            down = np.array([0.0, left * np.sin(arm_gap_rad), -np.cos(arm_gap_rad)])
            self._set(f"upperarm01.{side}", _limb_to_down(elbow - shoulder, flexion, down))
            self._set(f"upperarm02.{side}", _limb_to_down(elbow - shoulder, flexion, down))
            for bone in ("lowerarm01", "lowerarm02", "wrist"):
                self._set(f"{bone}.{side}", _limb_to_down(wrist - elbow, flexion, down))
            for bone in ("upperleg01", "upperleg02"):
                self._set(f"{bone}.{side}", _shortest(knee - hip, np.array([0.0, 0.0, -1.0])))
            for bone in ("lowerleg01", "lowerleg02"):
                self._set(f"{bone}.{side}", _shortest(ankle - knee, np.array([0.0, 0.0, -1.0])))

    def _set(self, bone: str, rotation: Array) -> None:
        self._to_neutral[self.person.bone(bone)] = rotation

    def bone_rotations(self, link_rotations: Array) -> Array:
        """Bone rotations rest -> world [B, 3, 3] from link rotations relative to their parents, quaternions [13, 4].

        Quaternions are w x y z and of unit length; the root's is its rotation in the world.
        """
        out = np.empty((len(self._links), 3, 3))
        kernels.bones_of_links(
            np.ascontiguousarray(link_rotations, dtype=np.float64),
            LINK_PARENTS,
            self._links,
            self._modes,
            self._shares,
            self._to_neutral,
            out,
        )
        return out
