# SPDX-License-Identifier: Apache-2.0
"""The stick and flesh figure: state -> bones, joints, flesh (paper section 2.2, Table 1; see docs/model.md).

Bones are rigid frames that turn in their parents; a person's size is a scale and ten weights of the directions in
which people differ (`proportions.npz`, made by `tools/fit_proportions.py` and `tools/fit_flesh.py`), so left and
right are the same size (constraint 2) and lengths and girths stay human (constraint 1). The flesh is a union of convex
hulls of one, two or three spheres that ride on the bones; it is fitted to visual hulls, not to skins.
"""

from __future__ import annotations

import importlib.resources
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core import _figure_kernels as kernels
from limbloc_ros.core import _part_kernels as part_kernels
from limbloc_ros.core._figure_topology import (
    BONES,
    CLOTHING,
    JOINT_BONES,
    PARTS,
    SPHERES,
)
from limbloc_ros.core.pose import JOINT_NAMES, Flesh

Array = NDArray[np.float64]

BONE_NAMES: tuple[str, ...] = tuple(name for name, _, _ in BONES)
BONE = {name: index for index, name in enumerate(BONE_NAMES)}
SPHERE_NAMES: tuple[str, ...] = tuple(row[0] for row in SPHERES)
SPHERE = {name: index for index, name in enumerate(SPHERE_NAMES)}
PART_NAMES: tuple[str, ...] = tuple(name for name, _ in PARTS)

#: The stature for which the topology gives lengths in metres.
REFERENCE_STATURE_M = 1.75

N_BONES, N_SPHERES, N_PARTS = len(BONES), len(SPHERES), len(PARTS)

#: [B] index of each bone's parent, -1 for the pelvis.
PARENTS = np.array([BONE[parent] if parent else -1 for _, parent, _ in BONES], np.int64)

#: The degrees of freedom of the joints: which bone turns, about which of its own axes.
DOF_BONES = np.array([BONE[name] for name, _, axes in BONES for _ in axes], np.int64)
DOF_AXES = np.array([np.eye(3)["xyz".index(axis)] for _, _, axes in BONES for axis in axes])
N_DOF = len(DOF_BONES)

#: [B, B] whether the second bone moves with the first.
SUBTREE = np.eye(N_BONES, dtype=np.bool_)
for _child in range(N_BONES):
    _ancestor = PARENTS[_child]
    while _ancestor >= 0:
        SUBTREE[_ancestor, _child] = True
        _ancestor = PARENTS[_ancestor]

_UNTURNED = np.tile(np.eye(3), (N_BONES, 1, 1))

#: [P, 3] the spheres of each part; the last index repeats where there are fewer.
PART_SPHERES = np.array([[SPHERE[names[min(k, len(names) - 1)]] for k in range(3)] for _, names in PARTS], np.int64)


@dataclass(frozen=True)
class Proportions:
    """How sizes follow from the shape: x = exp(shape[0]) * (mean + modes @ shape[1:]); see `proportions.npz`.

    Points are the spheres, then the 25 joints (radius 0).

    Attributes:
        bone_offsets: [B, 3, 1 + K] each bone's origin in its parent; mean, then modes; in units of the stature.
        point_bones: int64 [N] the bone that carries each point.
        point_offsets: [N, 3, 1 + K] each point in its bone, in units of the stature.
        point_radii: [N, 1 + K] in units of the stature.
        log_stature_mean, log_stature_std: of people between 1.1 m and 2.0 m (shape[0] is the log of the stature).
    """

    bone_offsets: Array
    point_bones: NDArray[np.int64]
    point_offsets: Array
    point_radii: Array
    log_stature_mean: float
    log_stature_std: float

    @property
    def n_shape(self) -> int:
        """Length of the shape vector."""
        return int(self.bone_offsets.shape[2])

    @property
    def clothing_from(self) -> int:
        """Index in the shape vector from which it is clothing, not the body."""
        return self.n_shape - len(CLOTHING)


@cache
def proportions() -> Proportions:
    """The standard proportions, read once."""
    resource = importlib.resources.files("limbloc_ros.core") / "proportions.npz"
    with resource.open("rb") as file, np.load(file, allow_pickle=False) as table:
        order = [list(table["joint_names"]).index(name) for name in JOINT_NAMES]
        bones = [BONE[row[1]] for row in SPHERES] + [BONE[JOINT_BONES[name]] for name in JOINT_NAMES]
        joints = table["joint_offsets"][order]
        offsets = np.concatenate([table["sphere_centres"], joints]).astype(np.float64)
        radii = np.concatenate([table["sphere_radii"], np.zeros((len(order), joints.shape[2]))])
        mean, std = (float(value) for value in table["log_stature"])
        clothing = np.zeros((len(radii), len(CLOTHING)))
        clothing[: len(SPHERES)] = _clothing_radii()
        return Proportions(
            _with_modes(table["bone_offsets"].astype(np.float64)),
            np.array(bones, np.int64),
            _with_modes(offsets),
            np.concatenate([radii, clothing], axis=-1),
            mean,
            std,
        )


def _with_modes(lengths: Array) -> Array:
    """Lengths that clothing does not change."""
    return np.concatenate([lengths, np.zeros((*lengths.shape[:-1], len(CLOTHING)))], axis=-1)


def _clothing_radii() -> Array:
    """[S, clothes] what clothes add to the spheres' radii, in units of the stature."""
    either_side = [name.removesuffix("_L").removesuffix("_R") for name in SPHERE_NAMES]
    added = [[clothes.get(name, 0.0) for clothes in CLOTHING.values()] for name in either_side]
    return np.array(added) / REFERENCE_STATURE_M


@dataclass(frozen=True)
class FigureState:
    """Where the figure is, how its bones turn and how large it is.

    Attributes:
        root: [3] pelvis centre in the world, m.
        rotations: [B, 3, 3] of each bone in its parent (the pelvis in the world).
        shape: [1 + K] log of the stature in m, then the weights of the shape modes (standard deviations), then how
            much loose clothing of each kind is worn.
    """

    root: Array
    rotations: Array
    shape: Array

    def moved(self, delta: Array) -> FigureState:
        """The state after a step [3 + D + 1 + K]: root translation (m), turns about DOF_AXES (rad), shape."""
        rotations = kernels.turned(self.rotations, delta[3 : 3 + N_DOF], DOF_BONES, DOF_AXES)
        return FigureState(self.root + delta[:3], rotations, self.shape + delta[3 + N_DOF :])

    def to_vector(self) -> Array:
        """Flat copy [3 + 9 B + 1 + K] for `from_vector`."""
        return np.concatenate([self.root, self.rotations.ravel(), self.shape])

    @staticmethod
    def from_vector(vector: Array) -> FigureState:
        """The inverse of `to_vector`."""
        split = 3 + 9 * N_BONES
        return FigureState(vector[:3].copy(), vector[3:split].reshape(N_BONES, 3, 3).copy(), vector[split:].copy())

    @staticmethod
    def standing(root: Array, heading: float = 0.0, stature: float = 1.7) -> FigureState:
        """A person of mean proportions who stands with hanging arms and looks along `heading` (rad about z)."""
        rotations = _UNTURNED.copy()
        rotations[0] = kernels.exp_so3(np.array([0.0, 0.0, heading]))
        shape = np.zeros(proportions().n_shape)
        shape[0] = np.log(stature)
        return FigureState(np.array(root, np.float64), rotations, shape)


@dataclass(frozen=True)
class Placed:
    """A figure placed in the world.

    Attributes:
        origins: [B, 3] bone origins, m.
        rotations: [B, 3, 3] T_world_bone rotations.
        spheres: [S, 3] sphere centres, m.
        radii: [S] m.
        joints: [25, 3] m, in the order of JOINT_NAMES.
    """

    origins: Array
    rotations: Array
    spheres: Array
    radii: Array
    joints: Array

    def flesh(self) -> Flesh:
        """The flesh figure."""
        return Flesh(self.spheres, self.radii, PART_SPHERES, PART_NAMES)


def place(state: FigureState) -> Placed:
    """Forward kinematics: bones, flesh and joints of a state."""
    table = proportions()
    origins, rotations, points, radii = kernels.forward(
        state.root,
        state.rotations,
        state.shape,
        PARENTS,
        table.bone_offsets,
        table.point_bones,
        table.point_offsets,
        table.point_radii,
    )
    return Placed(origins, rotations, points[:N_SPHERES], radii[:N_SPHERES], points[N_SPHERES:])


def place_jacobian(state: FigureState) -> Array:
    """Derivatives [S + 25, 4, 3 + D + 1 + K] of all points (spheres, then joints) and radii by the step of `moved`."""
    table = proportions()
    points = (table.point_bones, table.point_offsets, table.point_radii)
    origins, world, placed, radii = kernels.forward(
        state.root, state.rotations, state.shape, PARENTS, table.bone_offsets, *points
    )
    return kernels.jacobian(  # type: ignore[no-any-return]
        origins, world, placed, radii, state.shape, PARENTS, table.bone_offsets, *points, DOF_BONES, DOF_AXES, SUBTREE
    )


def flesh_distance(query: Array, flesh: Flesh) -> tuple[Array, NDArray[np.int64]]:
    """Signed distance [Q] (m) of points [Q, 3] to the flesh, and the index of the nearest part [Q]."""
    return part_kernels.flesh_distance(query, flesh.parts, flesh.centres, flesh.radii)  # type: ignore[no-any-return]
