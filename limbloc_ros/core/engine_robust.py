# SPDX-License-Identifier: Apache-2.0
"""The robust engine: hypotheses by exhaustive search, refined by least squares, judged by the energy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core import energy, figure, lm, search
from limbloc_ros.core._figure_kernels import flesh_distance
from limbloc_ros.core.energy import Evidence, Weights
from limbloc_ros.core.figure import FigureState
from limbloc_ros.core.hull import Hull
from limbloc_ros.core.search import ARM, LEG, Medial
from limbloc_ros.core.surface import Surface

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Effort:
    """How much is searched; the defaults are for one frame alone."""

    torsos: int = 8
    arm_pairs: int = 4
    repairs: int = 12
    quick_points: int = 350
    quick_iterations: int = 8
    finalists: int = 5
    points: int = 1200
    iterations: int = 20


def gather_evidence(hull: Hull, surface: Surface, points: int, rng: np.random.Generator) -> Evidence:
    """A random but even sample of the surface, and the signed distance grid."""
    rows = np.sort(rng.permutation(len(surface))[:points])
    weights = np.full(len(rows), 1.0 / len(rows))
    return Evidence(surface.points[rows], surface.normals[rows], weights, hull.sdf, hull.origin_m, hull.voxel_m)


def refine(state: FigureState, evidence: Evidence, weights: Weights, iterations: int) -> lm.LmResult[FigureState]:
    """Levenberg-Marquardt on all parameters at once."""
    step = np.full(3 + figure.N_DOF + len(state.shape), 0.5)
    step[:3] = 0.1
    step[3 + figure.N_DOF] = 0.1
    step[4 + figure.N_DOF :] = 1.0
    return lm.minimise(
        lambda s: energy.system(s, evidence, weights),
        lambda s, delta: s.moved(delta),
        state,
        iterations=iterations,
        largest_step=step,
    )


#: A surface point this near to the flesh counts as explained.
EXPLAINED_M = 0.04

_LIMB_BASES = ("upper_arm", "forearm", "hand")
BODY_PARTS = np.array([p for p, name in enumerate(figure.PART_NAMES) if not name.startswith(_LIMB_BASES)])


def with_legs(state: FigureState, hull: Hull, medial: Medial, samples: Array, pairs: int) -> list[FigureState]:
    """The figure with each of the best pairs of legs: those that explain most of the hull beside the trunk."""
    return _with_pairs(state, hull, medial, samples, LEG, search.TRUNK_PARTS, search.UPPER_TRUNK_PARTS, pairs)


def with_arms(state: FigureState, hull: Hull, medial: Medial, samples: Array, pairs: int) -> list[FigureState]:
    """The figure, which has legs, with each of the best pairs of arms."""
    return _with_pairs(state, hull, medial, samples, ARM, BODY_PARTS, BODY_PARTS, pairs)


def _with_pairs(
    state: FigureState,
    hull: Hull,
    medial: Medial,
    samples: Array,
    kind: search.LimbKind,
    explaining: NDArray[np.int64],
    solid: NDArray[np.int64],
    pairs: int,
) -> list[FigureState]:
    placed = figure.place(state)
    distance, _ = flesh_distance(samples, figure.PART_SPHERES[explaining], placed.spheres, placed.radii)
    taken = search.explained_volume(hull, placed, solid)
    left, right = (search.limb_candidates(hull, medial, placed, kind, side, taken, 40) for side in "LR")
    out = []
    for a, b, _ in search.limb_pairs(left, right, samples, distance < EXPLAINED_M, 0.02, pairs):
        limbed = search.with_limb(state, placed, kind, "L", left.found[a])
        out.append(search.with_limb(limbed, placed, kind, "R", right.found[b]))
    return out or [state]


def by_cost(states: list[FigureState], evidence: Evidence, weights: Weights, keep: int) -> list[FigureState]:
    """The states of lowest energy as they are, before any refinement."""
    costs = [energy.system(state, evidence, weights).cost for state in states]
    return [states[i] for i in np.argsort(costs, kind="stable")[:keep]]


@dataclass(frozen=True)
class Fit:
    """A fitted figure and how it came about."""

    state: FigureState
    system: lm.System
    runner_up: float


def fit_from_scratch(
    hull: Hull, surface: Surface, seed: int, weights: Weights | None = None, effort: Effort | None = None
) -> Fit | None:
    """Fit one frame alone: torso hypotheses, both facings, limbs, refinement, arm repair."""
    weights, effort = weights or Weights(), effort or Effort()
    rng = np.random.default_rng(seed)
    medial = Medial.of(hull)
    quick = gather_evidence(hull, surface, effort.quick_points, rng)
    full = gather_evidence(hull, surface, effort.points, rng)
    torsos = search.torso_hypotheses(hull, medial, rng, effort.torsos)
    starts: list[FigureState] = []
    for torso, _ in torsos:
        for facing in (torso, search.turned_about(torso)):
            for standing in with_legs(facing, hull, medial, quick.points, 1):
                starts += by_cost(with_arms(standing, hull, medial, quick.points, effort.arm_pairs), quick, weights, 1)
    if not starts:
        return None
    candidates = [refine(state, quick, weights, effort.quick_iterations) for state in starts]
    candidates.sort(key=lambda r: r.system.cost)
    finalists = candidates[: effort.finalists]
    for candidate in candidates[: effort.finalists]:
        repaired = with_arms(candidate.state, hull, medial, quick.points, effort.repairs)
        for standing in with_legs(candidate.state, hull, medial, quick.points, 2):
            repaired += with_arms(standing, hull, medial, quick.points, effort.repairs // 2)
        for state in by_cost(repaired, quick, weights, 2):
            finalists.append(refine(state, quick, weights, effort.quick_iterations))
    finalists.sort(key=lambda r: r.system.cost)
    best = [refine(r.state, full, weights, effort.iterations) for r in finalists[:2]]
    best.sort(key=lambda r: r.system.cost)
    return Fit(best[0].state, best[0].system, best[-1].system.cost)


class Tracker:
    """Fits frame after frame, each from the last; starts anew when there is no last one or the fit went wrong."""

    #: A cost this much above the usual one, or above this many m^2, is no longer believed ...
    DOUBT, DOUBTFUL_COST = 1.35, 4.5e-4
    #: ... but starting anew, which takes as long as many followed frames, is tried only every so many frames: in a
    #: live room a slow fit makes the next step longer. Arms are checked as often.
    PATIENCE = 8
    #: What is searched when starting anew: less than for a frame alone, for the next frames can mend it.
    SEARCH = Effort(torsos=4, finalists=2)

    def __init__(self, seed: int, weights: Weights | None = None, effort: Effort | None = None) -> None:
        self._seed, self._weights, self._effort = seed, weights or Weights(), effort or self.SEARCH
        self.reset()

    def reset(self) -> None:
        """Forget the last frame."""
        self._last: FigureState | None = None
        self._usual_cost = 0.0
        self._frame = 0
        self._last_scratch = -self.PATIENCE
        self._centre = np.zeros(3)

    def follow(self, hull: Hull, surface: Surface) -> Fit | None:
        """Fit the next frame."""
        self._frame += 1
        fit: Fit | None = None
        centre = surface.points.mean(axis=0)
        moved, self._centre = centre - self._centre, centre
        if self._last is not None:
            evidence = gather_evidence(hull, surface, 600, np.random.default_rng(self._seed))
            carried = FigureState(self._last.root + moved, self._last.rotations, self._last.shape)
            result = refine(carried, evidence, self._weights, 10 if np.abs(moved).max() < 0.1 else 20)
            if self._frame % self.PATIENCE == 0:
                result = self._check_arms(result, hull, evidence)
            fit = Fit(result.state, result.system, np.inf)
        if fit is None or self._doubts(fit.system.cost):
            self._last_scratch = self._frame
            scratch = fit_from_scratch(hull, surface, self._seed, self._weights, self._effort)
            if scratch is not None and (fit is None or scratch.system.cost < 0.95 * fit.system.cost):
                fit = scratch
        if fit is None:
            self._last = None
            return None
        # the usual cost follows slowly, so one odd frame is judged by the calm ones before it
        fresh = self._last is None or self._usual_cost == 0.0
        self._usual_cost = fit.system.cost if fresh else 0.9 * self._usual_cost + 0.1 * fit.system.cost
        self._last = fit.state
        return fit

    def _doubts(self, cost: float) -> bool:
        waited = self._frame - self._last_scratch >= self.PATIENCE
        return waited and (cost > self.DOUBT * self._usual_cost or cost > self.DOUBTFUL_COST)

    def _check_arms(self, result: lm.LmResult[FigureState], hull: Hull, evidence: Evidence) -> lm.LmResult[FigureState]:
        """An arm that has slipped into the trunk stays there, for its flesh is explained: look for it elsewhere."""
        samples = evidence.points[:: max(1, len(evidence.points) // 300)]
        others = with_arms(result.state, hull, Medial.of(hull), samples, self._effort.repairs)
        best = refine(by_cost(others, evidence, self._weights, 1)[0], evidence, self._weights, 10)
        return best if best.system.cost < 0.97 * result.system.cost else result
