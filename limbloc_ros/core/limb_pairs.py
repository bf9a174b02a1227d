# SPDX-License-Identifier: Apache-2.0
"""Which pair of limbs explains the hull best: all candidates wear the figure's own flesh and are weighed by the energy.

The candidates of `search.limb_candidates` are two bones in space. Here each becomes an arm or a leg of the figure, and
the energy of all pairs of a left and a right one is worked out exactly, for the surface term is a minimum over parts:
what body, left limb and right limb explain is found once each and then only compared.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core import _limb_pairs_kernels as kernels
from limbloc_ros.core import energy, figure
from limbloc_ros.core.energy import Evidence, Weights
from limbloc_ros.core.figure import BONE, FigureState, Placed
from limbloc_ros.core.search import ARM, LimbKind, Limbs
from limbloc_ros.core.views import Views

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

#: Two limbs of a pair keep so far apart (m) at their middles and ends; pairs that differ less are one hypothesis.
OVERLAP_M, APART_M = 0.06, 0.10
#: Points nearer than this to the body are no question of limbs.
EXPLAINED_M = 0.006
#: Of the others so many are asked, and which limb is nearest matters up to this distance: beyond, all cost the same.
MOST_POINTS, REACH_M = 120, 0.12
#: So many candidates of either side are paired.
PAIRED = 40
#: Of the silhouettes' cells that the body leaves open so many are asked, and what all of a silhouette counts, m^2.
#: (More than this, and legs spread to fill a skirt.)
MOST_CELLS, SEEN_WEIGHT = 120, 3e-3


@dataclass(frozen=True)
class _LimbTable:
    """What the kernels must know of one limb of the figure; see `limb_fits`."""

    bones: tuple[int, int, int]
    sign: float
    spheres: Ints
    sphere_bones: Ints
    parts: Ints
    samples: Array
    sample_parts: Ints
    penetration: Ints
    low: Array
    high: Array


@cache
def _limb_table(kind: LimbKind, side: str) -> _LimbTable:
    bones = tuple(BONE[f"{name}_{side}"] for name in kind.bones)
    carried = figure.proportions().point_bones[: figure.N_SPHERES]
    spheres = np.flatnonzero(np.isin(carried, bones))
    # with the seat, a part of the pelvis that rides on the thigh
    parts = np.flatnonzero(np.isin(figure.PART_SPHERES, spheres).any(axis=1))
    sampled = np.isin(energy.INCLUSION_PARTS, parts)
    other = {f"{name}_{'R' if side == 'L' else 'L'}" for name in kind.bones}
    against = [p for p, name in enumerate(figure.PART_NAMES) if name not in other]
    pairs = energy.PENETRATION_PAIRS
    kept = np.isin(pairs[:, 0], spheres) & np.isin(pairs[:, 1], against)
    dofs = [d for d in range(figure.N_DOF) if figure.DOF_BONES[d] == bones[0]]
    hinge = [d for d in range(figure.N_DOF) if figure.DOF_BONES[d] == bones[1]]
    return _LimbTable(
        bones,  # type: ignore[arg-type]
        -1.0 if kind is ARM else 1.0,
        spheres,
        np.array([bones.index(b) for b in carried[spheres]]),
        parts,
        energy.INCLUSION_SAMPLES[sampled],
        energy.INCLUSION_PARTS[sampled],
        pairs[kept],
        energy.LOW[dofs + hinge],
        energy.HIGH[dofs + hinge],
    )


def with_limb(state: FigureState, placed: Placed, kind: LimbKind, side: str, limb: Array) -> FigureState:
    """The state with one limb turned so that its joints lie at a candidate's [7] middle and end."""
    table = _limb_table(kind, side)
    first, second, third = table.bones
    upper = limb[:3] - placed.origins[first]
    lower = limb[3:6] - limb[:3]
    parent = placed.rotations[figure.PARENTS[first]]
    R, Q = np.empty((3, 3)), np.empty((3, 3))
    kernels.limb_turns(
        upper / np.linalg.norm(upper), lower / np.linalg.norm(lower), parent, _hinge_rest(kind, first), table.sign, R, Q
    )
    rotations = state.rotations.copy()
    rotations[first] = parent.T @ R
    rotations[second] = R.T @ Q
    rotations[third] = np.eye(3)
    return FigureState(state.root, rotations, state.shape)


def _hinge_rest(kind: LimbKind, first: int) -> Array:
    # a straight leg's knee points forward; a straight arm's elbow as in the middle of the shoulder's range
    return energy.REST_ROTATIONS[first] if kind is ARM else np.eye(3)


def limb_pairs(
    placed: Placed,
    left: Limbs,
    right: Limbs,
    kind: LimbKind,
    body: Ints,
    evidence: Evidence,
    weights: Weights,
    keep: int,
    views: Views | None = None,
) -> list[tuple[int, int, float]]:
    """Pairs of a left and a right limb of lowest energy together with the rest of the figure.

    Args:
        placed: the figure.
        left, right: candidates.
        kind: ARM or LEG.
        body: indices of the parts that are believed already; those that move with the limbs are left out.
        evidence, weights: the energy's.
        keep: how many pairs to return; they differ by APART_M in some limb's end.
        views: the silhouettes, which limbs explain as well; None if they are not known.

    Returns:
        (index left, index right, energy of the terms that pairs differ in, m^2), the best first.
    """
    if len(left.found) == 0 or len(right.found) == 0:
        return []
    w = weights
    question = _open_question(placed, kind, ("L", "R"), body, evidence, w, views)
    fits = [_fits(placed, limbs, kind, side, question, evidence, w) for limbs, side in ((left, "L"), (right, "R"))]
    costs, point_weight = question.costs, question.point_weight
    best = [kernels.best_alone(*fit, costs, point_weight, PAIRED) for fit in fits]
    pairs = kernels.best_pairs(
        left.found, right.found, *fits[0], *fits[1], costs, point_weight, *best,
        OVERLAP_M, w.penetration, APART_M, keep,
    )  # fmt: skip
    return [(int(a), int(b), float(cost)) for a, b, cost in pairs]


def best_limbs(
    placed: Placed,
    limbs: Limbs,
    kind: LimbKind,
    side: str,
    body: Ints,
    evidence: Evidence,
    weights: Weights,
    keep: int,
    views: Views | None = None,
) -> list[int]:
    """Candidates for one limb of lowest energy together with the rest of the figure, the other limb included.

    Args:
        placed, kind, body, evidence, weights: as in `limb_pairs`.
        limbs: candidates.
        side: `L` or `R`.
        keep: how many to return; their ends lie APART_M apart.
        views: as in `limb_pairs`.
    """
    if len(limbs.found) == 0:
        return []
    question = _open_question(placed, kind, (side,), body, evidence, weights, views)
    fit = _fits(placed, limbs, kind, side, question, evidence, weights)
    chosen: list[int] = []
    for row in kernels.best_alone(*fit, question.costs, question.point_weight, len(limbs.found)):
        ends = limbs.found[chosen, 3:6] - limbs.found[row, 3:6]
        if len(chosen) < keep and (np.linalg.norm(ends, axis=1) >= APART_M).all():
            chosen.append(int(row))
    return chosen


@dataclass(frozen=True)
class _OpenQuestion:
    """What the body leaves to the limbs.

    Attributes:
        scene, gap: surface points, with normals and rays, and how near the body is to each, m.
        surface: [3] what the kernels must know of the surface term: width, gate and weight inside.
        costs: of each point, and of each of `cells`, when no limb explains it.
        point_weight: that costs are multiplied by.
        views, drawn, cells: the silhouettes, the body in them, and the open cells that are asked.
    """

    scene: tuple[Array, Array, Array]
    surface: Array
    gap: Array
    costs: Array
    point_weight: float
    views: Views | None
    drawn: NDArray[np.int16]
    cells: Ints


def _open_question(
    placed: Placed,
    kind: LimbKind,
    sides: tuple[str, ...],
    body: Ints,
    evidence: Evidence,
    w: Weights,
    views: Views | None,
) -> _OpenQuestion:
    stays = np.ones(figure.N_PARTS, np.bool_)
    stays[np.concatenate([_limb_table(kind, side).parts for side in sides])] = False
    body = body[stays[body]]
    surface = np.array([w.surface_width_m, w.normal_gate_m, w.surface_inside])
    scene = (evidence.points, evidence.normals, evidence.rays)
    gap, costs = kernels.body_fit(*scene, figure.PART_SPHERES[body], placed.spheres, placed.radii, surface)
    # what the body explains well no limb can explain much better
    rows = np.flatnonzero(costs > EXPLAINED_M**2)
    share = w.surface * float(evidence.point_weights[rows].sum())
    rows = rows[:: -(-len(rows) // MOST_POINTS) or 1]
    asked = scene[0][rows], scene[1][rows], scene[2][rows]
    point_weight = share / max(len(rows), 1)
    costs, drawn, cells = costs[rows], np.zeros(0, np.int16), np.zeros(0, np.int64)
    if views is not None and len(rows):
        drawn = views.drawn(figure.PART_SPHERES[body], placed.spheres, placed.radii)
        cells, weights = views.open_cells(drawn, MOST_CELLS)
        costs = np.concatenate([costs, SEEN_WEIGHT / point_weight * weights])
    return _OpenQuestion(asked, surface, np.minimum(gap[rows], REACH_M), costs, point_weight, views, drawn, cells)


def _fits(
    placed: Placed,
    limbs: Limbs,
    kind: LimbKind,
    side: str,
    question: _OpenQuestion,
    evidence: Evidence,
    w: Weights,
) -> tuple[Array, Array, Array]:
    table = _limb_table(kind, side)
    first, second, third = table.bones
    origins, rotations = placed.origins, placed.rotations
    joints = np.stack(
        [
            rotations[first].T @ (origins[second] - origins[first]),
            rotations[second].T @ (origins[third] - origins[second]),
        ]
    )
    carrier = np.array(table.bones)[table.sphere_bones]
    offsets = np.einsum("nji,nj->ni", rotations[carrier], placed.spheres[table.spheres] - origins[carrier])
    count, asked = len(limbs.found), len(question.gap)
    gaps, costs, own = np.empty((count, asked)), np.empty((count, asked)), np.empty(count)
    where = np.empty((count, len(table.spheres), 3))
    kernels.limb_fits(
        limbs.found, origins[first], rotations[figure.PARENTS[first]], _hinge_rest(kind, first), table.sign, joints,
        table.spheres, table.sphere_bones, offsets, placed.spheres.copy(), placed.radii, figure.PART_SPHERES,
        figure.PART_SPHERES[table.parts], *question.scene, question.gap, question.surface,
        table.samples, table.sample_parts, evidence.sdf, evidence.origin, evidence.voxel_m,
        np.array([w.inclusion_slack_m, w.inclusion_width_m, w.inclusion]), table.penetration,
        np.array([w.penetration_allowed, w.penetration_width_m, w.penetration]),
        energy.REST_ROTATIONS[first], table.low, table.high, w.limits,
        gaps, costs, own, where,
    )  # fmt: skip
    if question.views is not None and len(question.cells):  # a limb explains a cell that it covers, or not at all
        balls = np.column_stack([placed.radii, placed.spheres])
        covers, bare = question.views.limbs(
            figure.PART_SPHERES[table.parts], table.spheres, where, balls, question.drawn, question.cells
        )
        gaps = np.concatenate([gaps, np.where(covers, 0.0, np.inf)], axis=1)
        costs = np.concatenate([costs, np.zeros(covers.shape)], axis=1)
        own = own + SEEN_WEIGHT * bare
    return gaps, costs, own
