# SPDX-License-Identifier: Apache-2.0
"""Surface -> anchor points of the body: head, torso, knees, ankles, feet, elbows, hands (paper sections 2.1, 2.3, 2.4).

The searches are the paper's, made exhaustive over the voxels: a head is a sphere on a stretch of curved surface; the
torso hangs from the head towards the centre of mass; a knee lies on the sphere of the femur's length around the hip,
an ankle on the sphere of the tibia's length around the knee, and so for the arms. What a found part already explains
is no longer free for the next one. Each search returns its few best answers, so that a later step can overrule it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core import _anchors_kernels as kernels
from limbloc_ros.core._figure_kernels import exp_so3
from limbloc_ros.core.directions import sphere_directions
from limbloc_ros.core.figure import (
    BONE,
    N_SPHERES,
    FigureState,
    flesh_distance,
    place,
    proportions,
)
from limbloc_ros.core.hull import Hull
from limbloc_ros.core.pose import JOINT, Flesh
from limbloc_ros.core.surface import Surface

Array = NDArray[np.float64]

#: Radius of the sphere that fits a head's hull, in units of the stature (measured on the standard proportions).
HEAD_RADIUS = 0.0565
HEAD_RADII_M = (0.08, 0.09, 0.10, 0.11, 0.12)
TORSO_PARTS = ("pelvis", "belly", "abdomen", "thorax", "chest", "neck", "girdle_L", "girdle_R", "head")


@dataclass(frozen=True)
class Head:
    """A sphere that fits a head.

    Attributes:
        centre: [3] m, world.
        radius: m.
        support: share of the sphere's surface that lies on the hull's, 0 to 1.
        explained: how much of the hull the best upright torso under it explains, against the best head's.
    """

    centre: Array
    radius: float
    support: float
    explained: float = 0.0


@dataclass(frozen=True)
class Torso:
    """The figure posed from head to pelvis; its limbs still hang.

    Attributes:
        state: the figure.
        gain: hull voxels that the torso explains less those it claims outside, per voxel of the torso (1 is perfect).
    """

    state: FigureState
    gain: float


@dataclass(frozen=True)
class Limb:
    """A leg or an arm found on spheres around its joints.

    Attributes:
        points: [3, 3] m, world: knee, ankle, toe; or elbow, wrist, fingertip.
        gain: what the flesh of its bones explains, per voxel of them, less penalties (constraints 1, 3, 4).
        fused: the limb lies in what the torso explains already: it was assumed to be in contact with it.
    """

    points: Array
    gain: float
    fused: bool = False


@dataclass(frozen=True)
class Grid:
    """The hull's voxels as the searches read them.

    Attributes:
        hull: the hull.
        earns: float32 [nx, ny, nz]: +1 well inside the hull, down to -1 outside, linear across the surface.
    """

    hull: Hull
    earns: NDArray[np.float32]

    @staticmethod
    def of(hull: Hull) -> Grid:
        """Weights of the XOR energy per voxel (eq. 2): a flesh voxel earns +1 inside the hull and -1 outside."""
        return Grid(hull, np.clip(-hull.sdf / np.float32(hull.voxel_m), -1.0, 1.0).astype(np.float32))

    def local(self, p_world: Array) -> Array:
        """World points [..., 3] m to the kernels' local positions in voxels."""
        return np.asarray(p_world / self.hull.voxel_m - 0.5 - np.asarray(self.hull.index_min))

    def world(self, p_local: Array) -> Array:
        """The inverse of `local`."""
        return np.asarray((p_local + 0.5 + np.asarray(self.hull.index_min)) * self.hull.voxel_m)

    def without(self, flesh: Flesh, price: float, contact_m: float = 0.0) -> Grid:
        """The grid once `flesh` explains its voxels: they then cost `price`, nothing down to a depth of `contact_m`."""
        inside = np.argwhere(self.hull.sdf < 0)
        distance, _ = flesh_distance(self.world(inside.astype(np.float64)), flesh)
        earns = self.earns.copy()
        for depth, worth in ((0.0, 0.0), (contact_m, -price)):
            i, j, k = inside[distance < -depth].T
            earns[i, j, k] = worth
        return Grid(self.hull, earns)


# --- head -------------------------------------------------------------------------------------------------------------


def find_heads(
    grid: Grid, surface: Surface, patch_curvature: Array, centre_of_mass: Array, count: int = 8
) -> list[Head]:
    """Spheres of a head's size that the surface wraps on most sides (sections 2.1 and 2.3).

    Hands, feet and crossed legs wrap spheres too, so an upright torso is hung from each candidate, and the heads are
    ranked by how much of the hull it explains (eq. 2, locally).

    Args:
        grid: the hull.
        surface: its surface.
        patch_curvature: [N] rad, mean curvature over patches (`curvature_variability`): heads lie in its upper half.
        centre_of_mass: [3] m.
        count: how many to return at most.

    Returns:
        best first; none where no torso fits below any sphere.
    """
    curved = patch_curvature >= np.median(patch_curvature)
    points, normals = surface.points[curved], surface.normals[curved]
    voxel = grid.hull.voxel_m
    centres = np.concatenate([points - r * normals for r in HEAD_RADII_M])
    support = np.concatenate(
        [
            kernels.sphere_support(
                grid.hull.sdf, grid.local(points - r * normals), r / voxel, sphere_directions(96), 1.1 * voxel
            )
            for r in HEAD_RADII_M
        ]
    )
    radii = np.repeat(HEAD_RADII_M, len(points))
    found: list[Head] = []
    for i in np.argsort(-support, kind="stable"):
        if all(np.linalg.norm(centres[i] - head.centre) > 0.12 for head in found):
            found.append(Head(centres[i], float(radii[i]), float(support[i])))
            if len(found) == count:
                break
    explained = np.array(
        [_torso_scores(grid, head, centre_of_mass, _PLAIN)[0].max() * head.radius**3 for head in found]
    )
    if len(found) == 0 or explained.max() <= 0.0:
        return []
    order = np.argsort(-explained, kind="stable")
    return [replace(found[n], explained=float(explained[n] / explained.max())) for n in order]


# --- torso ------------------------------------------------------------------------------------------------------------

_NODS, _TILTS = (-0.3, 0.25, 0.8), (-0.45, 0.0, 0.45)
_BENDS = (
    (0.0, 0.0),
    (0.9, 0.0),
    (-0.4, 0.0),
    (0.0, 0.6),
    (0.0, -0.6),
)  # forward, to the right; rad from pelvis to chest
_SCALES = (0.9, 1.0, 1.1)


@dataclass(frozen=True)
class _Choice:
    """Which torsos are tried: rows of the templates, sizes against the head's, number of headings."""

    postures: tuple[int, ...]
    scales: tuple[float, ...]
    headings: int


_ALL = _Choice(tuple(range(len(_NODS) * len(_TILTS) * len(_BENDS))), _SCALES, 16)
_PLAIN = _Choice(tuple(range(len(_TILTS) * len(_BENDS), 2 * len(_TILTS) * len(_BENDS))), (1.0,), 8)  # the middle nod


@dataclass(frozen=True)
class _Templates:
    """Torsos of stature 1 in a few postures, seen from the head: the chest's axes, the head's centre as origin."""

    rotations: Array  # [T, B, 3, 3] of each bone in its parent, pelvis upright
    samples: Array  # [T, S, 3] points spread evenly through the torso
    joints: Array  # [T, 6, 3] of _TORSO_JOINTS
    chest_from_pelvis: Array  # [T, 3, 3]
    pelvis: Array  # [T, 3] the pelvis's origin
    discomfort: Array  # [T] the further from upright, the more


_TORSO_JOINTS = ("shoulder_L", "shoulder_R", "hip_L", "hip_R", "neck_base", "pelvis_centre")
_MIRRORED = [1, 0, 3, 2, 4, 5]


def find_torsos(grid: Grid, head: Head, centre_of_mass: Array, count: int = 4) -> list[Torso]:
    """Hang torsos from a head towards the centre of mass and keep those that the hull fills best (section 2.3).

    The paper starts "coaxial with the segment joining the center of the head with the VH barycenter"; here every
    direction within 70 degrees of it is tried, with every heading, some bends of spine and neck and some sizes.

    Returns:
        up to `count` different placements, best first, each followed by the same place facing the other way.
    """
    table = _templates()
    stature = head.radius / HEAD_RADIUS
    score, turns = _torso_scores(grid, head, centre_of_mass, _ALL)
    order = np.argsort(-score, axis=None, kind="stable")[:5000]
    s, t, r = np.unravel_index(order, score.shape)
    size = np.asarray(_SCALES)[s] * stature
    joints = head.centre + size[:, None, None] * np.einsum("nij,nkj->nki", turns[r], table.joints[t])
    free = np.ones(len(order), dtype=np.bool_)
    torsos: list[Torso] = []
    while free.any() and len(torsos) < 2 * count:
        first = int(np.argmax(free))
        same = np.linalg.norm(joints - joints[first], axis=2).max(axis=1) < 0.12
        turned = np.linalg.norm(joints[:, _MIRRORED] - joints[first], axis=2).max(axis=1) < 0.15
        for n in (first, *np.flatnonzero(turned & free)[:1]):
            state = _hang(head, table, int(t[n]), float(size[n]), turns[r[n]])
            torsos.append(Torso(state, float(score.ravel()[order[n]])))
        free &= ~(same | turned)
    return torsos


def _torso_scores(grid: Grid, head: Head, centre_of_mass: Array, choice: _Choice) -> tuple[Array, Array]:
    """[scale, template, turn] what torsos under a head earn per voxel of their mean size, and the turns [R, 3, 3]."""
    table = _templates()
    axis = head.centre - centre_of_mass
    turns = _orientations(axis / max(float(np.linalg.norm(axis)), 1e-9), choice.headings)
    centre = grid.local(head.centre)
    samples = table.samples[list(choice.postures)] * (head.radius / HEAD_RADIUS / grid.hull.voxel_m)
    cost = table.discomfort[list(choice.postures), None]
    scores = [
        scale**3 * kernels.template_scores(grid.earns, centre, samples * scale, turns) / samples.shape[1] - cost
        for scale in choice.scales
    ]
    return np.stack(scores), turns


def _hang(head: Head, table: _Templates, posture: int, stature: float, turn: Array) -> FigureState:
    rotations = table.rotations[posture].copy()
    rotations[0] = turn @ table.chest_from_pelvis[posture]
    shape = np.zeros(proportions().n_shape)
    shape[0] = np.log(stature)
    return FigureState(head.centre + stature * turn @ table.pelvis[posture], rotations, shape)


@cache
def _templates() -> _Templates:
    straight = FigureState.standing(np.zeros(3), stature=1.0)
    samples, bones = _torso_samples(0.033)
    offsets = samples - place(straight).origins[bones]
    rows: list[tuple[Array, ...]] = []
    for nod in _NODS:
        for tilt in _TILTS:
            for forward, right in _BENDS:
                rotations = straight.rotations.copy()
                for bone in ("abdomen", "thorax", "chest"):
                    rotations[BONE[bone]] = exp_so3(np.array([right, forward, 0.0]) / 3)
                rotations[BONE["head"]] = exp_so3(np.array([tilt, nod, 0.0]))
                placed = place(FigureState(straight.root, rotations, straight.shape))
                chest = placed.rotations[BONE["chest"]]
                origin = placed.joints[JOINT["head_centre"]]
                moved = placed.origins[bones] + np.einsum("nij,nj->ni", placed.rotations[bones], offsets)
                joints = placed.joints[[JOINT[name] for name in _TORSO_JOINTS]]
                discomfort = 0.02 * abs(nod - 0.25) + 0.02 * abs(tilt) + 0.03 * float(np.hypot(forward, right))
                rows.append(
                    (
                        rotations,
                        (moved - origin) @ chest,
                        (joints - origin) @ chest,
                        chest.T,
                        chest.T @ (placed.origins[0] - origin),
                        np.asarray(discomfort),
                    )
                )
    return _Templates(*(np.stack(column) for column in zip(*rows, strict=True)))


def _torso_samples(step: float) -> tuple[Array, NDArray[np.int64]]:
    """Points on a lattice through the torso of a standing figure of stature 1 [S, 3], and the bone of each [S]."""
    placed = place(FigureState.standing(np.zeros(3), stature=1.0))
    flesh = part_of(placed.flesh(), TORSO_PARTS)
    used = flesh.centres[np.unique(flesh.parts)]
    axes = [np.arange(a, b, step) for a, b in zip(used.min(axis=0) - 0.06, used.max(axis=0) + 0.06, strict=True)]
    lattice = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    distance, part = flesh_distance(lattice, flesh)
    inside = distance < 0
    bones = proportions().point_bones[:N_SPHERES]
    return lattice[inside], bones[flesh.parts].min(axis=1)[part[inside]]


def part_of(flesh: Flesh, names: tuple[str, ...]) -> Flesh:
    """The flesh figure reduced to the parts called `names`."""
    keep = [n for n, name in enumerate(flesh.part_names) if name in names]
    return Flesh(flesh.centres, flesh.radii, flesh.parts[keep], tuple(flesh.part_names[n] for n in keep))


def _orientations(axis: Array, headings: int, cone_rad: float = 1.22) -> Array:
    """[R, 3, 3] rotations whose z axis lies within a cone around `axis`, each with evenly spread headings."""
    directions = sphere_directions(400)
    z = directions[directions @ axis > np.cos(cone_rad)]
    other = np.where(np.abs(z[:, :1]) < 0.8, np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]))
    u = np.cross(z, other)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(z, u)
    angle = np.arange(headings) * 2 * np.pi / headings
    y = np.cos(angle)[None, :, None] * u[:, None] + np.sin(angle)[None, :, None] * v[:, None]
    z = np.broadcast_to(z[:, None], y.shape)
    return np.stack([np.cross(y, z), y, z], axis=-1).reshape(-1, 3, 3)
