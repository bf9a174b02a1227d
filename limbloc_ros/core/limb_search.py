# SPDX-License-Identifier: Apache-2.0
"""Legs and arms by exhaustive search on spheres around hips and shoulders (paper sections 2.3 and 2.4).

A limb is two bones and an end (foot or hand). The middle joint lies on a sphere of the first bone's length around the
torso's joint, the next on a sphere of the second bone's length around that: every voxel of the hull near those
spheres is tried. A candidate earns what its flesh explains of the hull (eq. 2, locally), and what the paper looks
for: high curvature and maxima of the geodesic distance near by; it pays for bones outside the hull (constraint 3),
for lengths off the proportions (1) and for angles that no joint reaches (4).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from limbloc_ros.core import _anchors_kernels as kernels
from limbloc_ros.core._figure_kernels import exp_so3
from limbloc_ros.core.anchors import Grid, Limb
from limbloc_ros.core.directions import sphere_directions
from limbloc_ros.core.figure import BONE, N_SPHERES, PARENTS, SPHERE, FigureState, Placed, place, proportions
from limbloc_ros.core.geodesic import Maxima
from limbloc_ros.core.pose import JOINT
from limbloc_ros.core.surface import Surface

Array = NDArray[np.float64]

#: How much each consideration weighs against the gain of a bone's flesh (which is at most 1).
OUTSIDE, LENGTH, CURVATURE, GEODESIC, LIMIT = 1.0, 0.10, 0.10, 0.10, 0.5
#: Lengths within this fraction of the proportions cost next to nothing.
LENGTH_SPREAD = 0.08
#: A voxel that is explained already costs this much to claim again (constraint 5).
PRICE = 0.3
SHELL = (0.86, 1.14)
KEPT_MIDDLES, KEPT_ENDS, KEPT_LIMBS = 24, 3, 24
#: A limb whose flesh explains less than this of its own volume is taken to be fused with the torso (section 2.4).
FUSED_BELOW = 0.35


@dataclass(frozen=True)
class Cues:
    """Per voxel of the hull, what the surface around it suggests (float32 [nx, ny, nz], 0 to 1).

    Attributes:
        curvature: how strongly the surface near by is curved.
        maximum: nearness to a wide maximum of the geodesic distance.
    """

    curvature: NDArray[np.float32]
    maximum: NDArray[np.float32]


@dataclass(frozen=True)
class _Bones:
    """Sizes of one limb, m: lengths and radii at begin, middle and end; direction of the end when relaxed."""

    lengths: Array  # [3] first bone, second bone, foot or hand
    radii: Array  # [4] at the torso's joint, the middle joint, the next one and the tip


def cues_of(grid: Grid, surface: Surface, patch_curvature: Array, maxima: Maxima) -> Cues:
    """Spread what is known of the surface over the voxels inside: each takes it from the nearest surface voxel."""
    inside = np.argwhere(grid.hull.sdf < 0)
    _, row = cKDTree(surface.points).query(grid.world(inside.astype(np.float64)))
    low, high = np.percentile(patch_curvature, (50, 95))
    level = np.clip((patch_curvature - low) / max(high - low, 1e-9), 0, 1)
    gap, _ = cKDTree(surface.points[maxima.rows]).query(surface.points)
    near = np.exp(-((gap / 0.06) ** 2))
    out = []
    for values in (level, near):
        volume = np.zeros(grid.hull.sdf.shape, dtype=np.float32)
        volume[tuple(inside.T)] = values[row]
        out.append(volume)
    return Cues(*out)


def find_limbs(grid: Grid, state: FigureState, kind: str, side: str, cues: Cues) -> list[Limb]:
    """The best legs (`kind` "leg") or arms ("arm") of one side, best first.

    Args:
        grid: the hull, less what is explained already.
        state: the figure with its torso placed.
        kind: `leg` or `arm`.
        side: `L` or `R`.
        cues: curvature and geodesic maxima.
    """
    placed = place(state)
    bones = _bones(placed, kind, side)
    frame = placed.rotations[BONE["pelvis" if kind == "leg" else "chest"]]
    start = placed.joints[JOINT[("hip_" if kind == "leg" else "shoulder_") + side]]
    sign = 1.0 if side == "L" else -1.0

    middles, middle_score = _on_sphere(grid, start, bones, 0, cues, _NOTHING)
    if len(middles) == 0:
        return []
    directions = _unit(middles - start)
    middle_score = middle_score - LIMIT * _root_limits(directions @ frame, kind, sign)
    kept = _spread(middles, middle_score, KEPT_MIDDLES, 0.035)

    limbs: list[Limb] = []
    for m in kept:
        forward = frame @ _forward_of(frame.T @ directions[m])
        ends, end_score = _on_sphere(
            grid, middles[m], bones, 1, cues, np.array([*grid.local(start), bones.radii[0] / grid.hull.voxel_m])
        )
        if len(ends) == 0:
            continue
        end_score = end_score - LIMIT * _hinge_limits(directions[m], forward, _unit(ends - middles[m]), kind)
        for e in _spread(ends, end_score, KEPT_ENDS, 0.05):
            tip, tip_gain = _find_tip(grid, middles[m], ends[e], forward, bones, kind)
            total = 0.45 * middle_score[m] + 0.45 * end_score[e] + 0.10 * tip_gain
            limbs.append(Limb(np.stack([middles[m], ends[e], tip]), float(total)))
    limbs.sort(key=lambda limb: -limb.gain)
    return limbs[:KEPT_LIMBS]


def best_pairs(
    grid: Grid, left: list[Limb], right: list[Limb], state: FigureState, kind: str, count: int
) -> list[tuple[Limb, Limb]]:
    """The left and right limbs that together explain most of the hull, each voxel counted once; best first."""
    if not left or not right:
        return []
    placed = place(state)
    voxels = np.argwhere(grid.earns > 0.0).astype(np.float64)
    worth = grid.earns[grid.earns > 0.0].astype(np.float64)
    masks = {}
    for side, limbs in (("L", left), ("R", right)):
        bones = _bones(placed, kind, side)
        start = grid.local(placed.joints[JOINT[("hip_" if kind == "leg" else "shoulder_") + side]])
        radii = bones.radii / grid.hull.voxel_m
        rows = np.zeros((len(limbs), len(voxels)), dtype=np.bool_)
        for n, limb in enumerate(limbs):
            chain = [start, *grid.local(limb.points)]
            for s in range(3):
                kernels.cover_frustum(rows[n], voxels, chain[s], radii[s], chain[s + 1], radii[s + 1])
        masks[side] = rows
    shared = (masks["L"] * worth) @ masks["R"].T.astype(np.float64)
    size = float(min((masks["L"] @ worth).max(), (masks["R"] @ worth).max())) + 1e-9
    gain = np.array([x.gain for x in left])[:, None] + np.array([x.gain for x in right])[None] - 1.5 * shared / size
    order = np.argsort(-gain, axis=None, kind="stable")[:count]
    return [(left[n // len(right)], right[n % len(right)]) for n in order.tolist()]


def bend_to(state: FigureState, kind: str, side: str, points: Array) -> FigureState:
    """Turn the bones of one limb so that its joints come to lie in the direction of `points` [3, 3] m.

    The hinge is perpendicular to the plane of the two bones; where they are almost straight it keeps the turn that
    the limb has after swinging from hanging the shortest way.
    """
    upper, lower, end = ("thigh", "shin", "foot") if kind == "leg" else ("upper_arm", "forearm", "hand")
    upper, lower, end = (f"{name}_{side}" for name in (upper, lower, end))
    placed = place(state)
    parent = placed.rotations[PARENTS[BONE[upper]]]
    start = placed.joints[JOINT[("hip_" if kind == "leg" else "shoulder_") + side]]
    first, second, third = _unit(np.diff(np.vstack([start, points]), axis=0))
    bend = second - (second @ first) * first
    if kind == "leg":
        bend = -bend
    forward = bend + 0.2 * parent @ _forward_of(parent.T @ first)
    x = _unit(forward - (forward @ first) * first)
    R_upper = np.stack([x, np.cross(-first, x), -first], axis=1)
    flexion = np.arctan2(float(second @ x), float(second @ first))  # towards the limb's front
    hinge = exp_so3(np.array([0.0, -flexion, 0.0]))
    R_lower = R_upper @ hinge
    rotations = state.rotations.copy()
    rotations[BONE[upper]] = parent.T @ R_upper
    rotations[BONE[lower]] = hinge
    tip = proportions().point_offsets[N_SPHERES + JOINT[("toe_" if kind == "leg" else "hand_") + side], :, 0]
    rotations[BONE[end]] = _shortest_turn(_unit(tip), R_lower.T @ third)
    return FigureState(state.root, rotations, state.shape)


def _shortest_turn(a: Array, b: Array) -> Array:
    """[3, 3] the rotation that takes unit vector a to unit vector b the shortest way."""
    axis = np.cross(a, b)
    sine = float(np.linalg.norm(axis))
    angle = np.arctan2(sine, float(a @ b))
    return np.asarray(exp_so3(axis / max(sine, 1e-9) * angle))


def _bones(placed: Placed, kind: str, side: str) -> _Bones:
    names = ("hip", "knee", "ankle", "toe") if kind == "leg" else ("shoulder", "elbow", "wrist", "fingertip")
    joints = np.array([placed.joints[JOINT[f"{name}_{side}"]] for name in names])
    spheres = ("thigh_top", "knee", "ankle", "toe") if kind == "leg" else ("deltoid", "elbow", "wrist", "tips")
    radii = np.array([placed.radii[SPHERE[f"{name}_{side}"]] for name in spheres])
    return _Bones(np.linalg.norm(np.diff(joints, axis=0), axis=1), radii)


def _on_sphere(grid: Grid, start: Array, bones: _Bones, bone: int, cues: Cues, before: Array) -> tuple[Array, Array]:
    """Candidates [M, 3] m for the far joint of a bone that begins at `start`, and their scores [M]."""
    voxel = grid.hull.voxel_m
    length, near, far = bones.lengths[bone] / voxel, bones.radii[bone] / voxel, bones.radii[bone + 1] / voxel
    a = grid.local(start)
    ends = kernels.voxels_in_shell(grid.hull.sdf, a, SHELL[0] * length, SHELL[1] * length)
    if len(ends) == 0:
        return ends, np.zeros(0)
    found = np.linalg.norm(ends - a, axis=1)
    volume = np.pi * found * (near * near + near * far + far * far) / 3
    score = kernels.frustum_gain(grid.earns, a, near, ends, far, FRUSTUM, before, PRICE) / volume
    score = score - OUTSIDE * kernels.bone_outside(grid.hull.sdf, a, ends)
    score = score - LENGTH * ((found / length - 1.0) / LENGTH_SPREAD) ** 2
    i, j, k = ends.astype(np.int64).T
    score = score + CURVATURE * cues.curvature[i, j, k] + GEODESIC * cues.maximum[i, j, k]
    # A joint lies as deep in its limb as the limb is thick: not on the surface, where the shell meets it too.
    shallow = np.maximum(0.0, grid.hull.sdf[i, j, k] / voxel + 0.7 * far) / far
    return grid.world(ends), score - 0.3 * shallow


def _find_tip(grid: Grid, middle: Array, end: Array, forward: Array, bones: _Bones, kind: str) -> tuple[Array, float]:
    """Toe or fingertip: the direction from ankle or wrist that explains most, and what it gains per volume."""
    voxel = grid.hull.voxel_m
    length, near, far = bones.lengths[2] / voxel, bones.radii[2] / voxel, bones.radii[3] / voxel
    a = grid.local(end)
    along = _unit(end - middle)
    ends = a + length * _FAN
    before = np.array([*grid.local(middle), bones.radii[1] / voxel])
    score = kernels.frustum_gain(grid.earns, a, near, ends, far, FRUSTUM, before, PRICE)
    score = score / (np.pi * length * (near * near + near * far + far * far) / 3)
    bend = _FAN @ along  # 1 goes straight on
    if kind == "leg":
        relaxed = _unit(forward - (forward @ along) * along)
        score = score - LIMIT * np.maximum(0.0, np.abs(bend - 0.25) - 0.45) - 0.4 * (1.0 - _FAN @ relaxed)
    else:
        score = score - LIMIT * np.maximum(0.0, 0.4 - bend) + 0.1 * bend
    best = int(np.argmax(score))
    return grid.world(ends[best]), float(score[best])


def _root_limits(directions: Array, kind: str, sign: float) -> Array:
    """How far thighs or upper arms [M, 3], seen from pelvis or chest (x forward, y left, z up), are out of reach."""
    x, y, z = directions[:, 0], sign * directions[:, 1], directions[:, 2]
    if kind == "leg":  # backwards, across the other leg, or up beyond what a kick reaches
        return np.maximum(0, -x - 0.5) + np.maximum(0, -y - 0.35) + np.maximum(0, z - 0.6)
    return np.maximum(0, -x - 0.75) + np.maximum(0, -y - 0.5) + np.maximum(0, -x - y - 0.6)


def _hinge_limits(first: Array, forward: Array, seconds: Array, kind: str) -> Array:
    """How wrongly knees or elbows bend: second bones [M, 3] after `first`, whose front is about `forward`."""
    bend = seconds - (seconds @ first)[:, None] * first
    size = np.linalg.norm(bend, axis=1)
    toward = bend @ forward / np.maximum(size, 1e-9)
    overbent = np.maximum(0.0, -(seconds @ first) - 0.85) * 4
    if kind == "leg":
        return np.asarray(size * np.maximum(0.0, toward + 0.5) + overbent)
    return np.asarray(0.5 * size * np.maximum(0.0, -toward - 0.3) + overbent)


def _forward_of(direction: Array) -> Array:
    """[3] where the front of a bone points once it swung from hanging to `direction` the shortest way."""
    down = np.array([0.0, 0.0, -1.0])
    axis = np.cross(down, direction)
    cosine = float(down @ direction)
    x = np.array([1.0, 0.0, 0.0])
    if cosine < -0.999:
        return -x
    return np.asarray(x * cosine + np.cross(axis, x) + axis * (axis @ x) / (1.0 + cosine))


def _spread(points: Array, score: Array, count: int, apart_m: float) -> list[int]:
    """Indices of the best candidates that lie apart, best first."""
    free = np.ones(len(points), dtype=np.bool_)
    kept: list[int] = []
    order = np.argsort(-score, kind="stable")
    for i in order:
        if free[i]:
            kept.append(int(i))
            if len(kept) == count:
                break
            free &= np.linalg.norm(points - points[i], axis=1) >= apart_m
    return kept


def _unit(v: Array) -> Array:
    return np.asarray(v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12))


def _frustum_samples() -> Array:
    """[S, 4] points through a frustum: along it, across it in radii, share of its cross-section."""
    rows = []
    for t in (np.arange(8) + 0.5) / 8:
        rows.append((t, 0.0, 0.0, 0.12 / 8))
        for n, (radius, share) in product(range(6), ((0.55, 0.38), (0.88, 0.50))):
            angle = 2 * np.pi * (n + (0.5 if radius > 0.6 else 0.0)) / 6
            rows.append((t, radius * np.cos(angle), radius * np.sin(angle), share / 6 / 8))
    return np.array(rows)


_NOTHING = np.zeros(4)
FRUSTUM = _frustum_samples()
_FAN = sphere_directions(200)
