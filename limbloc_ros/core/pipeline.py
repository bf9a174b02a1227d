# SPDX-License-Identifier: Apache-2.0
"""Masks -> hull -> surface -> skeleton -> joint angles: the one chain that live, replay and offline all call."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core.camera import Rig
from limbloc_ros.core.config import FitConfig, HullConfig
from limbloc_ros.core.errors import NoPerson
from limbloc_ros.core.hull import Hull
from limbloc_ros.core.pose import Pose


class Carver:
    """The carving half: masks of one instant -> hull. Holds what only depends on the rig."""

    def __init__(self, rig: Rig, config: HullConfig | None = None) -> None:
        raise NotImplementedError

    def carve(self, masks: Mapping[str, NDArray[np.uint8]]) -> Hull | NoPerson:
        """Carve one frame; masks by camera name, uint8 [height, width], non-zero = foreground."""
        raise NotImplementedError


class PoseEstimator:
    """The fitting half: hull -> pose. Frame-independent unless `config.temporal`, then it keeps the last pose."""

    def __init__(self, config: FitConfig | None = None) -> None:
        raise NotImplementedError

    def estimate(self, hull: Hull) -> Pose | NoPerson:
        """Fit the figure to one hull."""
        raise NotImplementedError

    def reset(self) -> None:
        """Forget the last frame (a new recording, a jump back in time)."""
        raise NotImplementedError

    @staticmethod
    def warm_up() -> None:
        """Compile or load every kernel, so that the first frame is not slow."""
        raise NotImplementedError
