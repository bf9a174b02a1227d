# SPDX-License-Identifier: Apache-2.0
"""From frame to frame: the last figure is the first guess (`temporal: true`); when it is lost, the fit starts anew."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core import energy, lm
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
    unseen,
    with_one_limb,
)
from limbloc_ros.core.figure import BONE, FigureState, place
from limbloc_ros.core.hull import Hull
from limbloc_ros.core.search import ARM, LEG, Medial
from limbloc_ros.core.surface import Surface

Array = NDArray[np.float64]


#: Bones whose turn goes on from frame to frame; how hands and feet turn is seen too badly to go by.
SWINGING = np.array(
    [BONE["pelvis"]] + [BONE[f"{name}_{side}"] for name in ("upper_arm", "forearm", "thigh", "shin") for side in "LR"]
)


class Tracker:
    """Fits frame after frame, each from the last; starts anew when there is no last one or the fit went wrong."""

    #: A cost this much above the usual one, or above this many m^2, is no longer believed ...
    DOUBT, DOUBTFUL_COST = 1.35, 4.5e-4
    #: ... but starting anew, which takes as long as many followed frames, is tried only every so many frames: in a
    #: live room a slow fit makes the next step longer. Limbs are checked as often. Each time that starting anew finds
    #: nothing better, the wait doubles, up to this: some hulls are just bad. Only after a hopeless start the next
    #: frame is tried.
    PATIENCE, LONGEST_WAIT = 8, 32
    #: What is searched when starting anew: less than for a frame alone, for the next frames can mend it.
    SEARCHES = (
        QUICK,
        Effort(
            leg_pairs=2, starts=6, survivors=3, arm_repairs=2, strict=2, finalists=1, single_arms=2, single_legs=0,
            rounds=1, shown=False,
        ),
    )  # fmt: skip
    #: Limbs are checked at once when the cost is so much above the usual one (in vain, the wait doubles); other places
    #: that are tried for each; by how much of the energy it and what the
    #: silhouettes add must be lower there.
    LIMB_DOUBT, ARM_PLACES, LEG_PLACES, LIMB_GAIN = 1.25, 1, 1, 0.03
    #: A limb that all its joints have so near to where it is stays there.
    SAME_PLACE_M = 0.05
    #: The figure is carried along with the firm weights of the search, which lead from further off; so many more steps
    #: with the final ones put its joints in their places.
    FINAL_STEPS = 6
    #: People do not change their size, and one hull says little of it: what a squared deviation from the mean shape so
    #: far costs (m^2) per frame in that mean, and how many frames count.
    SIZE_WEIGHT, REMEMBERED = 1e-4, 20
    #: Surface points that a figure is carried along on.
    POINTS = 700

    def __init__(self, seed: int, weights: Weights | None = None, searches: Sequence[Effort] = SEARCHES) -> None:
        self._seed, self._weights, self._searches = seed, weights or Weights(), searches
        self._firm = firm(self._weights)
        self.reset()

    def reset(self) -> None:
        """Forget the last frame."""
        self._last: FigureState | None = None
        self._before: FigureState | None = None
        self._next_check, self._next_doubt, self._doubt_wait = self.PATIENCE, 0, 1
        self._usual_cost = 0.0
        self._frame = 0
        self._last_scratch = -self.PATIENCE
        self._wait, self._vain = self.PATIENCE, False
        self._centre = np.zeros(3)
        self._size, self._sized = np.zeros(0), 0

    def follow(self, hull: Hull, surface: Surface) -> Fit | None:
        """Fit the next frame.

        Args:
            hull, surface: of one person.

        Returns:
            the fit, or None when there is no figure yet and no torso fits into the hull.
        """
        self._frame += 1
        fit: Fit | None = None
        centre = surface.points.mean(axis=0)
        moved, self._centre = centre - self._centre, centre
        if self._last is not None:
            evidence = gather_evidence(hull, surface, self.POINTS, np.random.default_rng(self._seed))
            guesses = self._guesses(self._last, moved)
            costs = [energy.system(guess, evidence, self._firm).cost for guess in guesses]
            start = guesses[int(np.argmin(costs))]
            size = KnownSize(self._size, self.SIZE_WEIGHT * min(self._sized, self.REMEMBERED))
            result = refine(start, evidence, self._firm, 8 if np.abs(moved).max() < 0.1 else 20, size)
            if self._limbs_are_due(result.system.cost):
                checked = self._check_limbs(result, hull, surface, evidence, size)
                self._doubt_wait = 1 if checked is not result else min(2 * self._doubt_wait, self.PATIENCE)
                self._next_doubt, self._next_check = self._frame + self._doubt_wait, self._frame + self.PATIENCE
                result = checked
            judged = energy.system(result.state, evidence, self._firm).cost
            final = refine(result.state, evidence, self._weights, self.FINAL_STEPS, size)
            self._remember(final.state.shape)
            fit = Fit(final.state, final.system, judged=judged)
        if fit is None or self._doubts(fit.judged):
            self._last_scratch = self._frame
            if fit is not None:
                fit = replace(fit, unseen=unseen(fit.state, hull))
            # while there is a figure, a quick search first: what it misses is searched harder the next time
            searches = self._searches if fit is None or self._vain else self._searches[:1]
            scratch = fit_from_scratch(hull, surface, self._seed, self._weights, searches)
            self._vain = scratch is None or (fit is not None and scratch.verdict >= fit.verdict - 0.05 * fit.judged)
            if scratch is not None and not self._vain:
                fit, self._wait = scratch, self.PATIENCE if scratch.judged < self.DOUBTFUL_COST else 1
                self._size, self._sized = scratch.state.shape, 1
            else:
                self._wait = min(2 * self._wait, self.LONGEST_WAIT)
        if fit is None:
            self._before = self._last = None
            return None
        # the usual cost follows slowly, so one odd frame is judged by the calm ones before it
        fresh = self._last is None or self._usual_cost == 0.0
        self._usual_cost = fit.judged if fresh else 0.9 * self._usual_cost + 0.1 * fit.judged
        self._before, self._last = self._last, fit.state
        return fit

    def _guesses(self, last: FigureState, moved: Array) -> list[FigureState]:
        """Where the figure may be now: carried along as it is, and turning on as it turned between the last frames."""
        root = last.root + moved
        guesses = [FigureState(root, last.rotations, last.shape)]
        if self._before is not None:
            rotations = last.rotations.copy()
            turn = self._before.rotations[SWINGING].transpose(0, 2, 1) @ last.rotations[SWINGING]
            rotations[SWINGING] = last.rotations[SWINGING] @ turn
            guesses.append(FigureState(root, rotations, last.shape))
        return guesses

    def _remember(self, shape: Array) -> None:
        """The mean shape of the last frames."""
        self._sized = min(self._sized + 1, 2 * self.REMEMBERED)
        self._size = self._size + (shape - self._size) / self._sized

    def _doubts(self, cost: float) -> bool:
        waited = self._frame - self._last_scratch >= self._wait
        return waited and (cost > self.DOUBT * self._usual_cost or cost > self.DOUBTFUL_COST)

    def _limbs_are_due(self, cost: float) -> bool:
        if self._frame >= self._next_check:
            return True
        return self._frame >= self._next_doubt and cost > self.LIMB_DOUBT * self._usual_cost

    def _check_limbs(
        self, result: lm.LmResult[FigureState], hull: Hull, surface: Surface, evidence: Evidence, size: KnownSize
    ) -> lm.LmResult[FigureState]:
        """A limb that moved too fast, or has slipped into the trunk, stays behind: look for each elsewhere."""
        scene = make_scene(hull, Medial.of(hull), surface, self._seed, self._weights, QUICK)
        for kind, places in ((ARM, self.ARM_PLACES), (LEG, self.LEG_PLACES)):
            for side in "LR":
                for state in with_one_limb(result.state, scene, kind, side, places, QUICK.candidates):
                    away = place(state).joints - place(result.state).joints
                    if np.linalg.norm(away, axis=1).max() < self.SAME_PLACE_M:
                        continue
                    settled = refine(state, scene.quick, scene.lenient, 5, size).state
                    other = refine(settled, evidence, self._firm, 8, size)
                    gain = result.system.cost - other.system.cost
                    gain += unseen(result.state, hull) - unseen(other.state, hull)
                    if gain > self.LIMB_GAIN * result.system.cost:
                        result = other
        return result
