# SPDX-License-Identifier: Apache-2.0
"""A fitted figure -> the published pose, with what is known about its errors."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core import figure
from limbloc_ros.core.energy import xor_energy
from limbloc_ros.core.figure import FigureState
from limbloc_ros.core.hull import Hull
from limbloc_ros.core.joint_angles import native_angles
from limbloc_ros.core.lm import System
from limbloc_ros.core.pose import JOINT, JOINT_NAMES, STICK_BONES, Flesh, Pose
from limbloc_ros.core.shown import SIDES, forearm_depths_m, limbs_shown
from limbloc_ros.core.surface import Surface
from limbloc_ros.core.unexplained import unexplained_m

Array = NDArray[np.float64]
Rivals = Sequence[tuple[FigureState, float]]

#: A hull that the carve volume's walls cut by more than this, m^2, is no whole person; an arm is thinner.
CUT_M2 = 0.02
#: A figure of this XOR energy is none of that hull.
NO_MATCH_XOR = 0.62
#: What lies so far, m, beside a figure is no cloth: an arm that it has elsewhere, or something in its hands.
BESIDE_M = 0.16
#: Where nobody knows what the cameras saw, one of this smooth energy (m^2) is none either.
NO_MATCH_COST = 2.1e-4
#: The chance that some joint of the limbs is 15 cm off from which on a pose is not to be acted on. Its log-odds are
#: those of a figure without any sign of that, and what is added for each sign (`risk_of`):
#: - the less an arm shows: the logarithms of what only the upper arm and only the forearm explain of the silhouettes
#:   (`shown.limbs_shown`), of the arm that shows less;
#: - the less a shin shows, likewise;
#: - per m by which an outline passes the figure: the silhouettes show something that it has not;
#: - per m that a forearm lies in other flesh: the further it is away from the rest of the body, the less is in doubt.
#: By logistic regression from 670 frames of other people, poses and cameras than the public suites have, noisy masks,
#: loose clothes and simulated rooms among them; rounded, for what they are fitted to goes on changing.
DOUBTFUL = 0.10
#: What was wrong a moment ago mostly still is: for so many frames after a followed figure was doubted, only one that is
#: that unlikely wrong is to be acted on. (Of 120 figures with a forearm in a box that was carried, 16 were called
#: reliable, now none; of 120 right ones all are, as before.)
WARY_FRAMES, SURE = 15, 0.02
USUAL_LOG_ODDS = -8.4
PER_LOG_ARM, PER_LOG_SHIN, PER_M_PASSED, PER_M_DEEP = 2.0, 1.5, 32.0, 6.0
#: What these signs are when nothing is wrong; the one that is furthest above that is named.
USUAL_LOG_ARM, USUAL_LOG_SHIN, USUAL_PASSED_M, USUAL_DEPTH_M = -3.36, -0.43, 0.055, -0.17
#: What shows less than this does not show.
LEAST_SHOWN = 0.003
#: Error that remains where nothing is in doubt, m; how far the energy's curvature is believed; by how much the energy
#: of a rival (as a fraction of the least) may be above that before it hardly counts.
FLOOR_M, BELIEF, RIVAL_WIDTH = 0.008, 0.015, 0.08
_STICKS = np.array([(JOINT[a], JOINT[b]) for a, b in STICK_BONES])
_STICK_NAMES = [f"{a}-{b}" for a, b in STICK_BONES]


def joint_sigma(state: FigureState, system: System, rivals: Rivals = ()) -> Array:
    """Expected error of each joint [25], m.

    Three parts, squared and added: a floor, for the figure is no person; the inverse of the energy's curvature, scaled
    by the energy itself and carried to the joints; and how far the joints of rival figures are, which explain the
    hull nearly as well: an arm that may as well be elsewhere.
    """
    n = len(system.gradient)
    information = system.matrix + 1e-9 * np.trace(system.matrix) / n * np.eye(n)
    J = figure.place_jacobian(state)[figure.N_SPHERES :, :3].reshape(-1, n)
    variances = (J * np.linalg.solve(information, J.T).T).sum(axis=1)
    curved = np.maximum(variances.reshape(-1, 3).sum(axis=1), 0.0)
    joints = figure.place(state).joints
    weight, apart = 1.0, np.zeros(len(joints))
    for rival, ratio in rivals:
        w = float(np.exp(-(ratio - 1.0) / RIVAL_WIDTH))
        weight += w
        apart += w * ((figure.place(rival).joints - joints) ** 2).sum(axis=1)
    return np.asarray(np.sqrt(FLOOR_M**2 + BELIEF * system.cost * curved + apart / weight))


def risk_of(hull: Hull, flesh: Flesh, energy: float, shown: Array | None, passed_m: float) -> tuple[float, str]:
    """How likely a figure is wrong, and what says so.

    Args:
        hull: what it was fitted to.
        flesh: of the figure.
        energy: its XOR energy.
        shown: [2, 3] how much its limbs show (`shown.limbs_shown`), if that is known.
        passed_m: how far the silhouettes' outlines pass it (`unexplained.unexplained_m`).

    Returns:
        the chance, 0 to 1, that a joint of its limbs is 15 cm off, and the strongest sign of that in a few words.
    """
    if hull.cut_area_m2 >= CUT_M2:
        return 1.0, "the person reaches out of the carve volume"
    if energy >= NO_MATCH_XOR:
        return 1.0, f"the figure does not match the hull: XOR energy {energy:.2f}"
    beside = f"the silhouettes show something {100 * passed_m:.0f} cm beside the figure"
    if passed_m >= BESIDE_M:
        return 1.0, beside
    if shown is None:
        return 0.0, ""
    log_shown = np.log(np.maximum(shown, LEAST_SHOWN))
    arms, shins, depths = log_shown[:, :2].sum(axis=1), log_shown[:, 2], forearm_depths_m(flesh)
    arm, leg, deep = int(arms.argmin()), int(shins.argmin()), int(depths.argmax())
    signs = {
        f"the {SIDES[arm]} arm hardly shows in the silhouettes": PER_LOG_ARM * (USUAL_LOG_ARM - float(arms[arm])),
        f"the {SIDES[leg]} leg hardly shows in the silhouettes": PER_LOG_SHIN * (USUAL_LOG_SHIN - float(shins[leg])),
        beside: PER_M_PASSED * (passed_m - USUAL_PASSED_M),
        f"the {SIDES[deep]} forearm lies close to other parts": PER_M_DEEP * (float(depths[deep]) - USUAL_DEPTH_M),
    }
    risk = 1.0 / (1.0 + math.exp(-USUAL_LOG_ODDS - sum(signs.values())))
    return risk, max(signs, key=signs.__getitem__)


@dataclass(frozen=True)
class Judgement:
    """What hull and silhouettes say of a figure.

    Attributes:
        placed, flesh: the figure.
        energy: its XOR energy.
        risk, sign: of `risk_of`.
    """

    placed: figure.Placed
    flesh: Flesh
    energy: float
    risk: float
    sign: str


class Judge:
    """Tells how likely figures of one hull are wrong.

    Args:
        hull: what they are fitted to.
        surface: the hull's; without it the silhouettes are not asked.
        others: where other people are; what they explain of the outlines, a figure need not.
    """

    def __init__(self, hull: Hull, surface: Surface | None = None, others: Sequence[Flesh] = ()) -> None:
        self._hull, self._surface, self._others = hull, surface, others
        self._last: tuple[FigureState, Judgement] | None = None  # who is asked while searching is published mostly

    def judge(self, state: FigureState) -> Judgement:
        """What is known of a figure."""
        if self._last is None or self._last[0] is not state:
            placed = figure.place(state)
            flesh = placed.flesh()
            energy = xor_energy(self._hull, placed)
            self._last = state, Judgement(placed, flesh, energy, *risk_of(self._hull, flesh, energy, *self._say(flesh)))
        return self._last[1]

    def risk_worth_a_search(self, state: FigureState) -> float:
        """How likely a figure is wrong although there may be a better one; 0 where nobody would find one."""
        return 0.0 if self._hull.cut_area_m2 >= CUT_M2 else self.judge(state).risk

    def _say(self, flesh: Flesh) -> tuple[Array | None, float]:
        """How much the limbs show, if that is known, and how far outlines pass the figure, m."""
        if self._surface is None:
            return None, 0.0
        shown = None if self._hull.views is None else limbs_shown(self._hull.views, flesh)
        return shown, unexplained_m(self._hull, self._surface, flesh, self._others)


class Wariness:
    """Of a followed figure: for some frames after it was doubted, it must be less likely wrong than otherwise."""

    def __init__(self) -> None:
        self._left = 0

    def judge(self, pose: Pose) -> Pose:
        """The next frame's pose, or the same but not reliable."""
        if not pose.reliable:
            self._left = WARY_FRAMES
        elif self._left > 0:
            self._left -= 1
            if pose.risk >= SURE:
                return replace(pose, reliable=False, doubt="it was in doubt just before, and nothing clears that up")
        return pose


def describe_pose(
    state: FigureState, judge: Judge, system: System | None, stage_ms: Mapping[str, float], rivals: Rivals = ()
) -> Pose:
    """Everything that is published about a fitted figure.

    Args:
        state: the figure.
        judge: of the hull that it was fitted to.
        system: the smooth energy around the fit, if the engine has one.
        stage_ms: process time of the stages so far, ms.
        rivals: figures that explain the hull nearly as well, with their energy over the least.
    """
    known = judge.judge(state)
    joints, risk, sign = known.placed.joints, known.risk, known.sign
    sigma = joint_sigma(state, system, rivals) if system is not None else np.full(len(JOINT_NAMES), 0.05)
    sticks = joints[_STICKS[:, 0]] - joints[_STICKS[:, 1]]
    sizes = dict(zip(_STICK_NAMES, np.linalg.norm(sticks, axis=1).tolist(), strict=True))
    sizes["stature"] = float(np.exp(state.shape[0]))
    if risk == 0.0 and system is not None and system.cost >= NO_MATCH_COST:
        risk, sign = 1.0, "the figure does not match the hull's surface, and what the cameras saw is not known"
    return Pose(
        joints=joints,
        rotations=known.placed.rotations,
        bone_names=figure.BONE_NAMES,
        angles=native_angles(known.placed.rotations, shape=state.shape),
        sizes=sizes,
        flesh=known.flesh,
        parameters=state.to_vector(),
        energy=known.energy,
        sigma=sigma,
        reliable=risk < DOUBTFUL,
        stage_ms=dict(stage_ms),
        risk=risk,
        doubt=sign if risk >= DOUBTFUL else "",
    )
