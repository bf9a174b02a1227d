# SPDX-License-Identifier: Apache-2.0
"""Hypotheses without any initial pose: where the torso can be, and where limbs can go from it (sections 2.3, 2.4).

The paper looks for knees and elbows on spheres of bone length around hips and shoulders; here that search is
exhaustive, over the hull's medial axis and uniform directions, for every torso that may be there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core import _limb_kernels as limb_kernels
from limbloc_ros.core import _search_kernels as kernels
from limbloc_ros.core import _torso_kernels as torso_kernels
from limbloc_ros.core import figure
from limbloc_ros.core._figure_kernels import exp_so3
from limbloc_ros.core._figure_topology import SPHERES
from limbloc_ros.core.directions import sphere_directions
from limbloc_ros.core.figure import BONE, SPHERE, FigureState, Placed
from limbloc_ros.core.hull import Hull
from limbloc_ros.core.views import Views

Array = NDArray[np.float64]

#: Torso spheres that must just fit into the hull, with their weights.
_SOLID = {
    "cranium": 1.5, "occiput": 1.5, "neck_low": 1.0, "neck_high": 1.0, "chest": 0.7, "upper_chest": 0.7, "ribs": 1.0,
    "waist": 1.0, "iliac": 1.0, "hip": 1.0, "shoulder": 1.0,
}  # fmt: skip
#: Points (bone, place in units of the stature, radius likewise) that must be empty: above the head, beside the neck.
_EMPTY = [
    ("head", (0.02, 0.0, 0.20), 0.02, 1.5),
    ("head", (0.0, 0.095, 0.06), 0.02, 1.0),
    ("head", (0.0, -0.095, 0.06), 0.02, 1.0),
    ("head", (0.12, 0.0, 0.11), 0.01, 0.7),
    ("head", (-0.09, 0.0, 0.08), 0.01, 0.7),
]
_TORSO_BONES = [name for name in figure.BONE_NAMES if not name.startswith(("forearm", "hand", "shin", "foot"))]


@dataclass(frozen=True)
class TorsoTable:
    """The mean figure's torso in the arrays that the kernels take; lengths in units of the stature.

    Attributes:
        arrays: bones' parents and offsets, spheres' bones, places and radii.
        weights: of the spheres; the first `n_solid` must just fit into the hull, the others be empty.
        bends: [N, 3] rotation vectors of the spine that are tried, rad.
        axis_base, axis_tip: [N, 3] middles of pelvis and skull for each of them.
    """

    arrays: tuple[NDArray[np.int64], Array, NDArray[np.int64], Array, Array]
    weights: Array
    n_solid: int
    bends: Array
    axis_base: Array
    axis_tip: Array


@cache
def _torso_table() -> TorsoTable:
    mean = figure.proportions()
    index = {name: i for i, name in enumerate(_TORSO_BONES)}
    parents = np.array([-1] + [index[figure.BONE_NAMES[figure.PARENTS[BONE[n]]]] for n in _TORSO_BONES[1:]], np.int64)
    bones, offsets, radii, weights = [], [], [], []
    for s, row in enumerate(SPHERES):
        base = row[0][:-2] if row[0][-2:] in ("_L", "_R") else row[0]
        if base in _SOLID:
            bones.append(index[row[1]])
            offsets.append(mean.point_offsets[s, :, 0])
            radii.append(mean.point_radii[s, 0])
            weights.append(_SOLID[base])
    n_solid = len(bones)
    for bone, at, radius, weight in _EMPTY:
        bones.append(index[bone])
        offsets.append(np.array(at))
        radii.append(radius)
        weights.append(weight)
    bone_offsets = mean.bone_offsets[[BONE[n] for n in _TORSO_BONES]][:, :, :1].copy()
    arrays = (
        parents,
        bone_offsets,
        np.array(bones, np.int64),
        np.array(offsets)[:, :, None].copy(),
        np.array(radii)[:, None].copy(),
    )
    bends = np.radians([[0.0, 0.0, 0.0], [0.0, 40.0, 0.0], [0.0, -15.0, 0.0], [25.0, 0.0, 0.0], [-25.0, 0.0, 0.0]])
    base, tip = [], []
    core = [SPHERE[n] for n in ("iliac_L", "iliac_R", "hip_L", "hip_R")]
    skull = [SPHERE[n] for n in ("cranium", "occiput")]
    for bend in bends:
        state = FigureState.standing(np.zeros(3), stature=1.0)
        for bone in ("abdomen", "thorax", "chest"):
            state.rotations[BONE[bone]] = exp_so3(bend / 3)
        spheres = figure.place(state).spheres
        base.append(spheres[core].mean(axis=0))
        tip.append(spheres[skull].mean(axis=0))
    return TorsoTable(arrays, np.array(weights), n_solid, bends, np.array(base), np.array(tip))


@dataclass(frozen=True)
class Medial:
    """The hull's medial axis.

    Attributes:
        points: [R, 4] x, y, z and depth below the surface, m; in array order.
    """

    points: Array

    @staticmethod
    def of(hull: Hull) -> Medial:
        """Medial voxels, down to thin limbs of ragged masks (0.15 voxels deep)."""
        sdf = hull.sdf
        return Medial(kernels.medial_ridge(sdf, hull.origin_m, hull.voxel_m, 0.15 * hull.voxel_m, 0.65))


@dataclass(frozen=True)
class TorsoSearch:
    """How much is searched for torsos.

    Attributes:
        headings: tried for each pair of pelvis and skull, over half a turn.
        listed: best torsos that are kept of all pairs.
        compared: so many different ones of these are compared with the silhouettes.
        climbed, steps: so many of these climb on, with so many random steps.
    """

    headings: int = 6
    listed: int = 400
    compared: int = 40
    climbed: int = 14
    steps: int = 240


def torso_hypotheses(
    hull: Hull, medial: Medial, rng: np.random.Generator, keep: int, effort: TorsoSearch | None = None
) -> list[tuple[FigureState, float]]:
    """Torsos that fit the hull, the best first, without limbs; each stands for both of its facings.

    Brute force over pairs of medial points (pelvis, skull) x bends x headings, then hill climbing of the best.

    Args:
        hull, medial: the volume.
        rng: of the hill climbing.
        keep: most torsos to return.
        effort: how much is searched.

    Returns:
        states with resting limbs and their scores (0 perfect, 1 useless).
    """
    effort = effort or TorsoSearch()
    table = _torso_table()
    points = medial.points
    if len(points) == 0:
        return []
    by_depth = np.argsort(-points[:, 3], kind="stable")
    trunk = by_depth[points[by_depth, 3] > max(0.04, 0.4 * points[:, 3].max())]
    pelvis = points[kernels.spread_out(points, trunk, 0.07, 40)]
    heads = by_depth[(points[by_depth, 3] > 0.03) & (points[by_depth, 3] < 0.16)]
    skull = points[kernels.spread_out(points, heads, 0.05, 90)]
    evidence = (hull.sdf, hull.origin_m, hull.voxel_m)
    found = torso_kernels.torso_from_pairs(
        pelvis, skull, table.axis_base, table.axis_tip, table.bends, effort.headings, 0.30, 0.95,
        *evidence, table.arrays, table.weights, table.n_solid, effort.listed,
    )  # fmt: skip
    if len(found) == 0:
        return []
    found = found[np.argsort(found[:, 13], kind="stable")]
    spread = np.array([0.02] * 3 + [0.15] * 3 + [0.15] * 3 + [0.15] * 3 + [0.04])
    starts = found[torso_kernels.distinct(found, effort.compared, 0.10, 0.4)]
    climbed = []
    for start in starts[np.argsort(_scores(starts, hull.views), kind="stable")[: effort.climbed]]:
        noise = rng.standard_normal((effort.steps, 13))
        climbed.append(
            torso_kernels.climb_torso(start, noise, *evidence, table.arrays, table.weights, table.n_solid, spread)
        )
    ranked = np.array(climbed)
    ranked = ranked[np.argsort(_scores(ranked, hull.views), kind="stable")]
    different = torso_kernels.distinct(ranked, keep, 0.08, 0.4)
    return [(_torso_state(pose), float(pose[13])) for pose in ranked[different]]


def _scores(poses: Array, views: Views | None) -> Array:
    """How badly torsos [N, 14] fit the hull, and the silhouettes, of which the trunk is the larger part."""
    if views is None:
        return poses[:, 13]
    placed = [figure.place(_torso_state(pose)) for pose in poses]
    seen = [views.mismatch(figure.PART_SPHERES[TRUNK_PARTS], torso.spheres, torso.radii) for torso in placed]
    return np.asarray(poses[:, 13] + np.array(seen))


def _torso_state(pose: Array) -> FigureState:
    state = FigureState.standing(pose[:3], stature=float(np.exp(pose[12])))
    state.rotations[0] = exp_so3(pose[3:6])
    third = exp_so3(pose[6:9] / 3)
    for bone in ("abdomen", "thorax", "chest"):
        state.rotations[BONE[bone]] = third
    state.rotations[BONE["head"]] = exp_so3(pose[9:12])
    return state


def turned_about(state: FigureState) -> FigureState:
    """The same torso looking the other way: half a turn about its long axis, bends and turns mirrored to match."""
    half = exp_so3(np.array([0.0, 0.0, math.pi]))
    rotations = state.rotations.copy()
    placed = figure.place(state)
    rotations[0] = rotations[0] @ half
    for bone in ("abdomen", "thorax", "chest", "head"):
        rotations[BONE[bone]] = half.T @ rotations[BONE[bone]] @ half
    turned = FigureState(state.root, rotations, state.shape)
    # keep the volume where it was: the mean figure's axis lies a little before its spine
    core = [SPHERE[n] for n in ("iliac_L", "iliac_R", "waist_L", "waist_R", "ribs_L", "ribs_R")]
    shift = placed.spheres[core].mean(axis=0) - figure.place(turned).spheres[core].mean(axis=0)
    return FigureState(state.root + shift, rotations, state.shape)


@dataclass(frozen=True)
class LimbKind:
    """What the search knows of arms or legs.

    Attributes:
        bones: the first two are looked for, the third goes on straight.
        spheres: their radii at the first one's begin, between them, and at the second one's end.
        tip: the sphere at the far end of the third bone.
    """

    bones: tuple[str, str, str]
    spheres: tuple[str, str, str]
    tip: str


ARM = LimbKind(("upper_arm", "forearm", "hand"), ("deltoid", "elbow", "wrist"), "tips")
LEG = LimbKind(("thigh", "shin", "foot"), ("thigh_top", "knee", "ankle"), "heel")

#: A limb's first part lies in the trunk: so much of its first bone is not looked at.
HIDDEN = 0.3
#: What running through volume that other parts explain counts beside not fitting into the hull.
EXPLAINED_WEIGHT = 1.5

#: Parts that a leg does not run through.
_UPPER_TRUNK = ("belly", "abdomen", "thorax", "chest", "head", "neck")
UPPER_TRUNK_PARTS = np.array([p for p, name in enumerate(figure.PART_NAMES) if name in _UPPER_TRUNK])
TRUNK_PARTS = np.array([p for p, name in enumerate(figure.PART_NAMES) if name in ("pelvis", *_UPPER_TRUNK)])


@dataclass(frozen=True)
class Limbs:
    """Candidates for one limb.

    Attributes:
        base: [3] its first joint, m, world.
        lengths: [2] of its bones, m.
        found: [M, 7] middle joint, end joint (m, world) and score; the best first.
    """

    base: Array
    lengths: Array
    found: Array


#: Edge of the cells in which explained volume is looked up, in voxels.
STRIDE = 2


def explained_volume(hull: Hull, placed: Placed, parts: NDArray[np.int64]) -> NDArray[np.float32]:
    """How much of the hull the figure's parts with these indices explain already, in cells of STRIDE voxels."""
    return limb_kernels.explained_grid(  # type: ignore[no-any-return]
        hull.sdf, hull.origin_m, hull.voxel_m, STRIDE, figure.PART_SPHERES[parts], placed.spheres, placed.radii
    )


def limb_candidates(
    hull: Hull, medial: Medial, placed: Placed, kind: LimbKind, side: str, explained: NDArray[np.float32], keep: int
) -> Limbs:
    """Where one limb may go from its root joint.

    Args:
        hull, medial: the volume.
        placed: the figure whose torso (and legs) are believed.
        kind: ARM or LEG.
        side: `L` or `R`.
        explained: `explained_volume` of the parts that a limb does not run through.
        keep: most candidates.
    """
    first, second, third = (BONE[f"{name}_{side}"] for name in kind.bones)
    base = placed.origins[first]
    lengths = np.array(
        [
            np.linalg.norm(placed.origins[second] - base),
            np.linalg.norm(placed.origins[third] - placed.origins[second]),
        ]
    )
    radii = placed.radii[[SPHERE[f"{name}_{side}"] for name in kind.spheres]]
    tip_m = float(np.linalg.norm(placed.spheres[SPHERE[f"{kind.tip}_{side}"]] - placed.origins[third])) * 0.8
    pelvis = placed.rotations[BONE["pelvis"]]
    outward = pelvis[:, 1] if side == "L" else -pelvis[:, 1]
    # thighs do not point up the back or far across the other side
    no_go = -outward if kind is ARM else (-pelvis[:, 0] + 0.6 * pelvis[:, 2] - 0.4 * outward)
    forbidden = np.append(no_go / np.linalg.norm(no_go), 0.97 if kind is ARM else 0.6)
    near = kernels.points_near(medial.points, base, 1.2 * lengths.sum())
    if len(near) > 500:
        near = np.ascontiguousarray(near[:: len(near) // 500 + 1])  # of another layout kernels are compiled anew
    found = limb_kernels.search_limb(
        base, lengths, radii, tip_m, near, sphere_directions(100), hull.sdf, hull.origin_m, hull.voxel_m,
        explained, STRIDE, HIDDEN, 0.04, EXPLAINED_WEIGHT, forbidden, keep,
    )  # fmt: skip
    return Limbs(base, lengths, found)
