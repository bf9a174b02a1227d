# SPDX-License-Identifier: Apache-2.0
"""Masks -> hull -> surface -> skeleton -> joint angles: the one chain that live, replay and offline all call."""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core import engine_robust
from limbloc_ros.core.camera import Camera, Rig
from limbloc_ros.core.confidence import Judge, Wariness, describe_pose
from limbloc_ros.core.config import FitConfig, HullConfig, validated
from limbloc_ros.core.errors import NoPerson
from limbloc_ros.core.hull import Hull, carve_silhouettes, largest_component
from limbloc_ros.core.pose import Flesh, Pose
from limbloc_ros.core.shown import forearm_depths_m
from limbloc_ros.core.silhouettes import measure_silhouettes, pack_cameras
from limbloc_ros.core.surface import extract_surface
from limbloc_ros.core.tracker import Tracker

#: Calls every kernel of a search once.
_LEAST_EFFORT = engine_robust.Effort(
    torsos=1, leg_pairs=1, starts=1, survivors=1, arm_repairs=1, strict=1, single_arms=1, single_legs=1, rounds=1,
    finalists=1, candidates=8, quick_points=50, points=50, iterations=(1, 1, 1, 1, 1),
)  # fmt: skip


class _Trusting(Tracker):
    """Takes single steps, and does not search again for what it found: more only calls the same kernels once more."""

    STEPS = FAR_STEPS = MORE_STEPS = FINAL_STEPS = 1
    DOUBTFUL_COST = LIMB_DOUBT = float("inf")  # one limb is looked for, not all

    def _doubts(self, cost: float, cut: bool) -> bool:
        return False


class Carver:
    """The carving half: masks of one instant -> hull. Holds what only depends on the rig."""

    def __init__(self, rig: Rig, config: HullConfig | None = None) -> None:
        self.rig = rig
        self.config = validated(config or HullConfig())
        self._packed = pack_cameras(rig)

    def carve(self, masks: Mapping[str, NDArray[np.uint8]]) -> Hull | NoPerson:
        """Carve one frame.

        Args:
            masks: camera name -> uint8 [height, width], non-zero = foreground; cameras may be missing.

        Raises:
            InputError: a mask has not its camera's size.
            RigError: the rig has no camera of a mask's name.
        """
        silhouettes = measure_silhouettes(masks, self.rig, self._packed, self.config)
        return carve_silhouettes(silhouettes, self.rig, self.config)

    @staticmethod
    @functools.cache  # once per process
    def warm_up() -> None:
        """Compile or load the carving kernels, so that the first frame is not slow."""
        Carver(*_warm_up_room()).carve(_warm_up_masks())


class PoseEstimator:
    """The fitting half: hull -> pose of one person; `people.People` has one for each.

    Every frame is fitted alone (paper section 4) unless `config.temporal`: then the last frame's figure is the first
    guess, and a fit that is clearly worse than the last ones is done again from scratch.
    """

    def __init__(self, config: FitConfig | None = None) -> None:
        self.config = validated(config or FitConfig())
        self._tracker, self._wariness = Tracker(self.config.seed), Wariness()

    def estimate(self, hull: Hull, others: Sequence[Flesh] = ()) -> Pose | NoPerson:
        """Fit the figure to one hull; of a hull in several parts to the largest.

        Args:
            hull: the frame's, or one person's part of it.
            others: where other people are now; what they explain of the silhouettes, this figure need not.
        """
        if hull.inside_count == 0:
            return NoPerson("the hull holds no voxel: is anybody in the carve volume?")
        hull = largest_component(hull)
        clock = _Stopwatch()
        if self.config.engine == "paper":
            from limbloc_ros.core import engine_paper  # brings a tree of scipy along, for which others need not wait

            found = engine_paper.fit_state(hull)
            clock.lap("fit")
            if isinstance(found, NoPerson):
                return found
            return describe_pose(found[0].state, Judge(hull), None, clock.stage_ms)
        if hull.views is not None and others:
            hull = dataclasses.replace(hull, views=hull.views.without(others))
        surface = extract_surface(hull)
        clock.lap("surface")

        judge = Judge(hull, surface, others)
        if self.config.temporal:
            fit = self._tracker.follow(hull, surface, judge.risk_worth_a_search)
        else:
            risk_of = judge.risk_worth_a_search
            fit = engine_robust.fit_from_scratch(hull, surface, self.config.seed, risk_of=risk_of)
        clock.lap("fit")
        if fit is None:
            if hull.cut_area_m2 >= Tracker.HALF_M2:
                return NoPerson("somebody is half outside of the carve volume")
            return NoPerson("the hull holds nothing that a torso fits into")
        pose = describe_pose(fit.state, judge, fit.system, clock.stage_ms, fit.rivals)
        return self._wariness.judge(pose) if self.config.temporal else pose

    def reset(self) -> None:
        """Forget the last frame (a new recording, a jump back in time)."""
        self._tracker.reset()
        self._wariness = Wariness()

    @staticmethod
    @functools.cache
    def warm_up() -> None:
        """Compile or load every kernel, so that the first frame is not slow."""
        hull = Carver(*_warm_up_room()).carve(_warm_up_masks())
        assert isinstance(hull, Hull)
        # The first frame is searched from scratch, with the kernels of every frame alone; the second follows.
        estimator = PoseEstimator(FitConfig(temporal=True))
        estimator._tracker = _Trusting(0, searches=(_LEAST_EFFORT,))
        estimator.estimate(hull)
        pose = estimator.estimate(hull)
        assert isinstance(pose, Pose)
        forearm_depths_m(pose.flesh)  # only asked of figures that match their hulls


class _Stopwatch:
    """Process time of the stages, of this thread alone, ms: several people are fitted side by side."""

    def __init__(self) -> None:
        self.stage_ms: dict[str, float] = {}
        self._last = time.thread_time()

    def lap(self, stage: str) -> None:
        now = time.thread_time()
        self.stage_ms[stage] = 1e3 * (now - self._last)
        self._last = now


def _warm_up_room() -> tuple[Rig, HullConfig]:
    K = np.array([[120.0, 0.0, 79.5], [0.0, 120.0, 79.5], [0.0, 0.0, 1.0]])
    cameras = []
    for i, (x, y) in enumerate(((3.0, 0.0), (0.0, 3.0), (-2.1, -2.1), (-3.0, 0.0), (0.0, -3.0), (2.1, 2.1))):
        forward = -np.array([x, y, 0.0]) / np.hypot(x, y)
        down = np.array([0.0, 0.0, -1.0])
        T = np.eye(4)
        T[:3, :3] = np.stack([np.cross(down, forward), down, forward], axis=1)
        T[:3, 3] = x, y, 1.0
        cameras.append(Camera(f"warm{i}", 160, 160, K, T))
    return Rig(tuple(cameras), np.array([-1.0, -1.0, 0.0]), np.array([1.0, 1.0, 2.0])), HullConfig(voxel_m=0.03)


def _warm_up_masks() -> dict[str, NDArray[np.uint8]]:
    mask = np.zeros((160, 160), np.uint8)
    mask[50:66, 73:87] = mask[66:110, 66:94] = mask[110:150, 68:78] = mask[110:150, 82:92] = 255
    mask[41:46, 76:84] = 255  # a hat in the air, so that taking a hull's parts apart is compiled
    one_legged = mask.copy()  # so that mending is compiled as well, of what one mask misses and of what two miss
    one_legged[110:150, 82:92] = 0
    armless = mask.copy()
    armless[66:110, 66:73] = 0
    return {"warm0": one_legged, "warm1": armless, "warm2": mask, "warm3": armless, "warm4": mask, "warm5": mask}
