# SPDX-License-Identifier: Apache-2.0
"""From frame to frame: the last figure is the first guess (`temporal: true`); when it is lost, the fit starts anew."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core import energy, figure
from limbloc_ros.core.energy import Evidence, Weights
from limbloc_ros.core.engine_robust import (
    HARDER,
    QUICK,
    SAME_PLACE_M,
    SETTLED_M,
    Effort,
    Fit,
    Refined,
    RiskOf,
    apart_m,
    firm,
    fit_from_scratch,
    gather_evidence,
    make_scene,
    refine,
    unseen,
    with_one_limb,
)
from limbloc_ros.core.figure import BONE, FigureState
from limbloc_ros.core.hull import Hull
from limbloc_ros.core.priors import Inertia, KnownSize, SizeMemory
from limbloc_ros.core.search import ARM, LEG, LimbKind, Medial
from limbloc_ros.core.surface import Surface

Array = NDArray[np.float64]

LIMBS = [(kind, side) for kind in (ARM, LEG) for side in "LR"]

#: Bones whose turn goes on from frame to frame; how hands and feet turn is seen too badly to go by.
SWINGING = np.array(
    [BONE["pelvis"]] + [BONE[f"{name}_{side}"] for name in ("upper_arm", "forearm", "thigh", "shin") for side in "LR"]
)


class Tracker:
    """Fits frame after frame, each from the last; starts anew when there is no last one or the fit went wrong."""

    #: A cost this much above the usual one, or above this many m^2, is no longer believed ...
    DOUBT, DOUBTFUL_COST = 1.35, 4.5e-4
    #: ... but starting anew, which takes as long as many followed frames, is tried only every so many frames: in a
    #: live room a slow fit makes the next step longer. Each time that starting anew finds nothing better, the wait
    #: doubles, up to this: some hulls are just bad. Only after a hopeless start the next frame is tried.
    PATIENCE, LONGEST_WAIT = 8, 32
    #: By how much of the followed figure's energy the one found anew must be better, or it does not replace it: where
    #: several figures explain a ragged hull nearly equally well, each search ends with another one.
    BETTER = 0.3
    #: A hull that the walls of the carve volume cut by so much, m^2 (an arm is a hundredth), is half a person in the
    #: doorway: whoever comes into an empty room is searched when wholly there, or after so many frames; both quickly.
    HALF_M2, DOORWAY = 0.10, 10
    #: What is searched when starting anew: less than for a frame alone, for the next frames can mend it. All that there
    #: is only for somebody who was neither followed yet nor seen coming in, and whose figure is doubtful.
    SEARCHES = (
        QUICK,
        Effort(
            leg_pairs=2, starts=6, survivors=3, arm_repairs=2, strict=2, finalists=1, single_arms=2, single_legs=0,
            rounds=1, shown=False, enough=1.0,
        ),
        HARDER,
    )  # fmt: skip
    #: Every so many frames one of the limbs has its turn to be looked for elsewhere, in so many places, and in so many
    #: when all are; by how much of the energy it and what the silhouettes add must be lower there. As much again is
    #: asked for each 5 cm beyond the first that a joint jumps, and all of it as many times as the energy is a doubtful
    #: one: ragged hulls tell little, and what jumps there is mostly wrong.
    TURN, PLACES, HASTY_PLACES, LIMB_GAIN, JUMP_M = 2, 1, 2, 0.03, 0.05
    #: When the cost is so much above the usual one, the figure is first carried on by so many steps, and then all limbs
    #: are checked at once; each time in vain, the wait doubles, up to this, unless the cost rises as much once more.
    #: Then a limb that settles where it was counts as well: it may have come back along a better way.
    LIMB_DOUBT, MORE_STEPS, LONGEST_DOUBT = 1.25, 10, 8
    #: The figure is carried along by so many steps, or by more when it has moved by 10 cm, with the firm weights of
    #: the search, which lead from further off; so many more with the final ones put its joints in their places. (With 4
    #: of these a wrist was 10 to 18 cm off in 8 of 1320 frames, with 6 in none; with limbs checked in every third frame
    #: wrists of raised arms stay as far behind in rough hulls.)
    STEPS, FAR_STEPS, FINAL_STEPS = 5, 20, 6
    #: A limb that settled elsewhere is first carried on by so many steps, and given up when the energy is then so many
    #: times what it was: of those that win in the end, 1.18 times at most.
    FIRST_STEPS, GIVEN_UP = 2, 1.3
    #: When the energy is so many times a doubtful one and a search is due, it is the figure that is wrong, no limb.
    HOPELESS = 2.0
    #: Joints go on moving by this share of their last step; what it costs in the final refinement that they do not, and
    #: from which distance on that says that they move otherwise. (All of the step would be less jitter still, but
    #: carries limbs beyond their places when they stop; three times the weight leaves turning people behind.)
    PACE, INERTIA, INERTIA_WIDTH_M = 0.5, 0.03, 0.03
    #: Surface points that a figure is carried along on, and those of the final refinement: with 700 for both, joints
    #: are 4 % further off and shake a third more.
    POINTS, FINAL_POINTS = 500, 1400

    def __init__(self, seed: int, weights: Weights | None = None, searches: Sequence[Effort] = SEARCHES) -> None:
        self._seed, self._weights, self._searches = seed, weights or Weights(), searches
        self._firm = firm(self._weights)
        self.reset()

    def reset(self) -> None:
        """Forget the last frame."""
        self._last: FigureState | None = None
        self._before: FigureState | None = None
        self._next_check, self._turn = self.TURN, 0
        self._next_doubt, self._doubt_wait, self._vain_cost = 0, 1, 0.0
        self._usual_cost = 0.0
        self._frame = 0
        self._last_scratch = -self.PATIENCE
        self._wait, self._vain, self._last_cut = self.PATIENCE, False, False
        self._in_doorway = 0
        self._centre = np.zeros(3)
        self._sizes = SizeMemory.nothing()

    def follow(self, hull: Hull, surface: Surface, risk_of: RiskOf | None = None) -> Fit | None:
        """Fit the next frame.

        Args:
            hull, surface: of one person.
            risk_of: of `fit_from_scratch`.

        Returns:
            the fit, or None when there is no figure yet, and no torso fits into the hull or half a person came in.
        """
        self._frame += 1
        cut = hull.cut_area_m2 >= self.HALF_M2
        came_in = self._last is None and self._in_doorway > 0 and not cut
        self._in_doorway = self._in_doorway + 1 if cut else 0
        if self._last is None and 0 < self._in_doorway <= self.DOORWAY:
            return None
        fit: Fit | None = None
        before = self._last
        centre = surface.points.mean(axis=0)
        moved, self._centre = centre - self._centre, centre
        if self._last is not None:
            evidence = gather_evidence(hull, surface, self.POINTS, np.random.default_rng(self._seed))
            guesses = self._guesses(self._last, moved)
            systems = [energy.system(guess, evidence, self._firm) for guess in guesses]
            best = min(range(len(guesses)), key=lambda n: systems[n].cost)
            size = self._sizes.known(self._weights.proportions)
            steps = self.STEPS if np.abs(moved).max() < 0.1 else self.FAR_STEPS
            result = refine(guesses[best], evidence, self._firm, steps, (size,), systems[best])
            if not cut and not (self._hopeless(result.energy.cost) and self._search_is_due(cut)):
                result = self._with_limbs_checked(result, hull, surface, evidence, size)
            judged = result.energy.cost
            inertia = Inertia(self._expected_joints(self._last, moved), self.INERTIA, self.INERTIA_WIDTH_M)
            closer = gather_evidence(hull, surface, self.FINAL_POINTS, np.random.default_rng(self._seed))
            final = refine(result.state, closer, self._weights, self.FINAL_STEPS, (size, inertia))
            self._sizes = self._sizes.after(size, final.state, final.energy)
            fit = Fit(final.state, final.system, judged=judged)
        if fit is None or self._doubts(fit.judged, cut):
            self._last_scratch, self._last_cut = self._frame, cut
            if fit is not None:
                fit = replace(fit, unseen=unseen(fit.state, hull))
            searches = self._searches
            if cut or came_in or (fit is not None and not self._vain):
                searches = searches[:1]
            elif fit is not None:  # what the quick search missed is searched harder the next time
                searches = searches[:2]
            scratch = fit_from_scratch(hull, surface, self._seed, self._weights, searches, risk_of)
            self._vain = scratch is None or (
                fit is not None and scratch.verdict >= fit.verdict - self.BETTER * fit.judged
            )
            if scratch is not None and not self._vain:
                fit, self._wait = scratch, self.PATIENCE if cut or scratch.judged < self.DOUBTFUL_COST else 1
                before = None  # how the figure has turned until now was wrong
                self._sizes = SizeMemory.nothing().with_frame(scratch.state, scratch.system)
            else:
                self._wait = min(2 * self._wait, self.LONGEST_WAIT)
        if fit is None:
            self._before = self._last = None
            return None
        # the usual cost follows slowly, so one odd frame is judged by the calm ones before it
        fresh = self._last is None or self._usual_cost == 0.0
        self._usual_cost = fit.judged if fresh else 0.9 * self._usual_cost + 0.1 * fit.judged
        self._before, self._last = before, fit.state
        return fit

    def _guesses(self, last: FigureState, moved: Array) -> list[FigureState]:
        """Where the figure may be now: carried along as it is, and turning on as it turned between the last frames."""
        root = last.root + moved
        guesses = [FigureState(root, last.rotations, last.shape)]
        if self._before is not None:
            rotations = last.rotations.copy()
            turn = self._before.rotations[SWINGING].transpose(0, 2, 1) @ last.rotations[SWINGING]
            rotations[SWINGING] = _orthonormal(last.rotations[SWINGING] @ turn)
            guesses.append(FigureState(root, rotations, last.shape))
        return guesses

    def _expected_joints(self, last: FigureState, moved: Array) -> Array:
        """[25, 3] where the joints should be now, m."""
        joints = figure.place(last).joints
        if self._before is None:
            return joints + moved
        return joints + self.PACE * (joints - figure.place(self._before).joints)

    def _search_is_due(self, cut: bool) -> bool:
        whole_now = self._last_cut and not cut
        return self._frame - self._last_scratch >= (1 if whole_now else self._wait)

    def _doubts(self, cost: float, cut: bool) -> bool:
        doubtful = cost > self.DOUBT * self._usual_cost or cost > self.DOUBTFUL_COST
        return doubtful and self._search_is_due(cut)

    def _hopeless(self, cost: float) -> bool:
        return cost > self.HOPELESS * self.DOUBTFUL_COST

    def _with_limbs_checked(
        self, result: Refined, hull: Hull, surface: Surface, evidence: Evidence, size: KnownSize
    ) -> Refined:
        """A limb that moved too fast, or has slipped into the trunk, stays behind: look for it elsewhere."""
        bearable = min(self.LIMB_DOUBT * self._usual_cost, self.DOUBTFUL_COST)
        if self._frame < self._next_doubt:
            bearable = max(bearable, self.LIMB_DOUBT * self._vain_cost)
        cost = result.energy.cost
        hasty = cost > bearable
        if hasty:
            if result.stop == "iterations":
                result = refine(result.state, evidence, self._firm, self.MORE_STEPS, (size,))
            limbs = LIMBS
        elif self._frame >= self._next_check:
            limbs = LIMBS[self._turn : self._turn + 1]
            self._turn = (self._turn + 1) % len(LIMBS)
        else:
            return result
        places, settled_m = (self.HASTY_PLACES, 0.0) if hasty else (self.PLACES, SETTLED_M)
        checked = self._check_limbs(limbs, places, result, hull, surface, evidence, size, settled_m, bearable)
        self._next_check = self._frame + self.TURN
        if checked is not result:
            self._doubt_wait, self._next_doubt = 1, self._frame + 1
        elif hasty:
            self._vain_cost, self._doubt_wait = cost, min(2 * self._doubt_wait, self.LONGEST_DOUBT)
            self._next_doubt = self._frame + self._doubt_wait
        return checked

    def _check_limbs(
        self,
        limbs: Sequence[tuple[LimbKind, str]],
        places: int,
        result: Refined,
        hull: Hull,
        surface: Surface,
        evidence: Evidence,
        size: KnownSize,
        settled_m: float,
        bearable: float,
    ) -> Refined:
        """The figure, or it with one of these limbs after the other elsewhere, but for those that settle near it.

        No further limb is looked for once one elsewhere has made the energy bearable.
        """
        scene = make_scene(hull, Medial.of(hull), surface, self._seed, self._weights, QUICK)
        missed: float | None = None  # what the figure leaves unseen: mostly no limb settles elsewhere, and nobody asks
        for kind, side in limbs:
            for state in with_one_limb(result.state, scene, kind, side, places, QUICK.candidates):
                if apart_m(state, result.state) < SAME_PLACE_M:
                    continue
                settled = refine(state, scene.quick, scene.lenient, 5, (size,)).state
                if apart_m(settled, result.state) < settled_m:
                    continue
                other = refine(settled, evidence, self._firm, self.FIRST_STEPS, (size,))
                if other.system.cost > self.GIVEN_UP * result.system.cost:
                    continue
                other = refine(other.state, evidence, self._firm, self.STEPS, (size,), other.energy)
                missed = unseen(result.state, hull) if missed is None else missed
                other_missed = unseen(other.state, hull)
                gain = result.system.cost + missed - other.system.cost - other_missed
                jumps = max(1.0, apart_m(other.state, result.state) / self.JUMP_M)
                ragged = max(1.0, result.system.cost / self.DOUBTFUL_COST)
                if gain > self.LIMB_GAIN * jumps * ragged * result.system.cost:
                    result, missed = other, other_missed
                    if result.energy.cost <= bearable:
                        return result
        return result


def _orthonormal(rotations: Array) -> Array:
    """[N, 3, 3] matrices that are nearly rotations, made such: one Newton step towards the nearest ones.

    A product of three rotations triples what rounding has left of their lengths, and the next one triples that: within
    some forty frames of turning on, bones would visibly shrink.
    """
    return np.asarray(rotations @ (1.5 * np.eye(3) - 0.5 * rotations.transpose(0, 2, 1) @ rotations))
