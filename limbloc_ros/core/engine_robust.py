# SPDX-License-Identifier: Apache-2.0
"""The robust engine: hypotheses by exhaustive search, refined by least squares, judged by the energy."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core import energy, figure, lm, search
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
    quick_points: int = 350
    quick_iterations: int = 8
    finalists: int = 5
    points: int = 1200
    iterations: int = 20


def gather_evidence(hull: Hull, surface: Surface, points: int, rng: np.random.Generator) -> Evidence:
    """A random but even sample of the surface, and the signed distance grid."""
    rows = np.sort(rng.permutation(len(surface))[:points])
    weights = np.full(len(rows), 1.0 / len(rows))
    return Evidence(
        surface.points[rows], surface.normals[rows], weights, hull.sdf, hull.origin_m, hull.voxel_m
    )


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


_LIMB_BASES = ("upper_arm", "forearm", "hand")
BODY_PARTS = np.array([p for p, name in enumerate(figure.PART_NAMES) if not name.startswith(_LIMB_BASES)])


def complete_limbs(state: FigureState, hull: Hull, medial: Medial, samples: Array, pairs: int) -> list[FigureState]:
    """Give a torso the legs and arms that together explain most of the hull."""
    placed = figure.place(state)
    explained = figure.kernels.flesh_distance(
        samples, figure.PART_SPHERES[search.TRUNK_PARTS], placed.spheres, placed.radii
    )[0] < 0.04
    taken = search.explained_volume(hull, placed, search.UPPER_TRUNK_PARTS)
    legs = [search.limb_candidates(hull, medial, placed, LEG, s, taken, 40) for s in "LR"]
    leg_pairs = search.limb_pairs(legs[0], legs[1], samples, explained, 0.02, 1)
    if leg_pairs:
        a, b, _ = leg_pairs[0]
        state = search.with_limb(state, placed, LEG, "L", legs[0].found[a])
        state = search.with_limb(state, placed, LEG, "R", legs[1].found[b])
    return complete_arms(state, hull, medial, samples, pairs)


def complete_arms(state: FigureState, hull: Hull, medial: Medial, samples: Array, pairs: int) -> list[FigureState]:
    """Give a figure with legs the best pairs of arms."""
    placed = figure.place(state)
    explained = figure.kernels.flesh_distance(
        samples, figure.PART_SPHERES[BODY_PARTS], placed.spheres, placed.radii
    )[0] < 0.035
    taken = search.explained_volume(hull, placed, BODY_PARTS)
    arms = [search.limb_candidates(hull, medial, placed, ARM, s, taken, 40) for s in "LR"]
    out = []
    for a, b, _ in search.limb_pairs(arms[0], arms[1], samples, explained, 0.02, pairs):
        armed = search.with_limb(state, placed, ARM, "L", arms[0].found[a])
        out.append(search.with_limb(armed, placed, ARM, "R", arms[1].found[b]))
    return out or [state]


@dataclass(frozen=True)
class Fit:
    """A fitted figure and how it came about."""

    state: FigureState
    system: lm.System
    runner_up: float


def fit_from_scratch(
    hull: Hull, surface: Surface, seed: int, weights: Weights = Weights(), effort: Effort = Effort()
) -> Fit | None:
    """Fit one frame alone: torso hypotheses, both facings, limbs, refinement, arm repair."""
    rng = np.random.default_rng(seed)
    medial = Medial.of(hull)
    quick = gather_evidence(hull, surface, effort.quick_points, rng)
    full = gather_evidence(hull, surface, effort.points, rng)
    torsos = search.torso_hypotheses(hull, medial, rng, effort.torsos)
    candidates: list[lm.LmResult[FigureState]] = []
    for torso, _ in torsos:
        for facing in (torso, search.turned_about(torso)):
            for state in complete_limbs(facing, hull, medial, quick.points, 1):
                candidates.append(refine(state, quick, weights, effort.quick_iterations))
    if not candidates:
        return None
    candidates.sort(key=lambda r: r.system.cost)
    finalists = []
    for candidate in candidates[: effort.finalists]:
        for state in (candidate.state, *complete_arms(candidate.state, hull, medial, quick.points, 2)):
            finalists.append(refine(state, quick, weights, effort.quick_iterations))
    finalists.sort(key=lambda r: r.system.cost)
    best = [refine(r.state, full, weights, effort.iterations) for r in finalists[:2]]
    best.sort(key=lambda r: r.system.cost)
    return Fit(best[0].state, best[0].system, best[-1].system.cost)


class Tracker:
    """Fits frame after frame, each from the last; starts anew when there is no last one or the fit went wrong."""

    #: A cost this much above the usual one is no longer believed.
    DOUBT = 1.35

    def __init__(self, seed: int, weights: Weights = Weights(), effort: Effort = Effort()) -> None:
        self._seed, self._weights, self._effort = seed, weights, effort
        self._last: FigureState | None = None
        self._usual_cost = 0.0

    def reset(self) -> None:
        """Forget the last frame."""
        self._last = None

    def follow(self, hull: Hull, surface: Surface) -> Fit | None:
        """Fit the next frame."""
        fit: Fit | None = None
        if self._last is not None:
            evidence = gather_evidence(hull, surface, 600, np.random.default_rng(self._seed))
            result = refine(self._last, evidence, self._weights, 10)
            fit = Fit(result.state, result.system, np.inf)
        if fit is None or fit.system.cost > self.DOUBT * self._usual_cost:
            scratch = fit_from_scratch(hull, surface, self._seed, self._weights, self._effort)
            if scratch is not None and (fit is None or scratch.system.cost < 0.9 * fit.system.cost):
                fit = scratch
        if fit is None:
            self._last = None
            return None
        # the usual cost follows slowly, so one odd frame is judged by the calm ones before it
        fresh = self._last is None or self._usual_cost == 0.0
        self._usual_cost = fit.system.cost if fresh else 0.9 * self._usual_cost + 0.1 * fit.system.cost
        self._last = fit.state
        return fit
