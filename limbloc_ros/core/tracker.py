# SPDX-License-Identifier: Apache-2.0
"""From frame to frame: the last figure is the first guess (`temporal: true`); when it is lost, the fit starts anew."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core import lm
from limbloc_ros.core.energy import Evidence, Weights
from limbloc_ros.core.engine_robust import (
    QUICK,
    Effort,
    Fit,
    KnownSize,
    firm,
    fit_from_scratch,
    gather_evidence,
    make_scene,
    refine,
    with_arms,
)
from limbloc_ros.core.figure import FigureState
from limbloc_ros.core.hull import Hull
from limbloc_ros.core.search import Medial
from limbloc_ros.core.surface import Surface

Array = NDArray[np.float64]


class Tracker:
    """Fits frame after frame, each from the last; starts anew when there is no last one or the fit went wrong."""

    #: A cost this much above the usual one, or above this many m^2, is no longer believed ...
    DOUBT, DOUBTFUL_COST = 1.35, 4.5e-4
    #: ... but starting anew, which takes as long as many followed frames, is tried only every so many frames: in a
    #: live room a slow fit makes the next step longer. Arms are checked as often. Each time that starting anew finds
    #: nothing better, the wait doubles, up to this: some hulls are just bad.
    PATIENCE, LONGEST_WAIT = 8, 32
    #: What is searched when starting anew: less than for a frame alone, for the next frames can mend it.
    SEARCHES = (
        QUICK,
        Effort(
            leg_pairs=2, starts=6, survivors=3, arm_repairs=2, strict=2, finalists=1, single_arms=2, single_legs=0,
            rounds=1,
        ),
    )  # fmt: skip
    #: Other pairs of arms that are tried when arms are checked.
    ARM_PAIRS = 2
    #: The figure is carried along with the firm weights of the search, which lead from further off; so many more steps
    #: with the final ones put its joints in their places.
    FINAL_STEPS = 4
    #: People do not change their size, and one hull says little of it: what a squared deviation from the mean shape so
    #: far costs (m^2) per frame in that mean, and how many frames count.
    SIZE_WEIGHT, REMEMBERED = 2e-4, 20
    #: Surface points that a figure is carried along on.
    POINTS = 450

    def __init__(self, seed: int, weights: Weights | None = None, searches: Sequence[Effort] = SEARCHES) -> None:
        self._seed, self._weights, self._searches = seed, weights or Weights(), searches
        self._firm = firm(self._weights)
        self.reset()

    def reset(self) -> None:
        """Forget the last frame."""
        self._last: FigureState | None = None
        self._usual_cost = 0.0
        self._frame = 0
        self._last_scratch = -self.PATIENCE
        self._wait = self.PATIENCE
        self._centre = np.zeros(3)
        self._size, self._sized = np.zeros(0), 0

    def follow(self, hull: Hull, surface: Surface) -> Fit | None:
        """Fit the next frame."""
        self._frame += 1
        fit: Fit | None = None
        centre = surface.points.mean(axis=0)
        moved, self._centre = centre - self._centre, centre
        if self._last is not None:
            evidence = gather_evidence(hull, surface, self.POINTS, np.random.default_rng(self._seed))
            carried = FigureState(self._last.root + moved, self._last.rotations, self._last.shape)
            result = refine(carried, evidence, self._firm, 8 if np.abs(moved).max() < 0.1 else 20)
            if self._frame % self.PATIENCE == 0:
                result = self._check_arms(result, hull, surface, evidence)
            size = KnownSize(self._size, self.SIZE_WEIGHT * min(self._sized, self.REMEMBERED))
            final = refine(result.state, evidence, self._weights, self.FINAL_STEPS, size)
            self._remember(final.state.shape)
            fit = Fit(final.state, final.system, judged=result.system.cost)
        if fit is None or self._doubts(fit.judged):
            self._last_scratch = self._frame
            scratch = fit_from_scratch(hull, surface, self._seed, self._weights, self._searches)
            if scratch is not None and (fit is None or scratch.judged < 0.95 * fit.judged):
                fit, self._wait = scratch, self.PATIENCE
                self._size, self._sized = scratch.state.shape, 1
            else:
                self._wait = min(2 * self._wait, self.LONGEST_WAIT)
        if fit is None:
            self._last = None
            return None
        # the usual cost follows slowly, so one odd frame is judged by the calm ones before it
        fresh = self._last is None or self._usual_cost == 0.0
        self._usual_cost = fit.judged if fresh else 0.9 * self._usual_cost + 0.1 * fit.judged
        self._last = fit.state
        return fit

    def _remember(self, shape: Array) -> None:
        """The mean shape of the last frames."""
        self._sized = min(self._sized + 1, 2 * self.REMEMBERED)
        self._size = self._size + (shape - self._size) / self._sized

    def _doubts(self, cost: float) -> bool:
        waited = self._frame - self._last_scratch >= self._wait
        return waited and (cost > self.DOUBT * self._usual_cost or cost > self.DOUBTFUL_COST)

    def _check_arms(
        self, result: lm.LmResult[FigureState], hull: Hull, surface: Surface, evidence: Evidence
    ) -> lm.LmResult[FigureState]:
        """An arm that has slipped into the trunk stays there, for its flesh is explained: look for it elsewhere."""
        scene = make_scene(hull, Medial.of(hull), surface, self._seed, self._weights, QUICK)
        best = result
        for state in with_arms(result.state, scene, self.ARM_PAIRS, QUICK.candidates):
            settled = refine(state, scene.quick, scene.lenient, 5).state
            other = refine(settled, evidence, self._firm, 8)
            if other.system.cost < 0.94 * best.system.cost:
                best = other
        return best
