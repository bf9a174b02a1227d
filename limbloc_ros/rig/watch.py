# SPDX-License-Identifier: Apache-2.0
"""Live: has a camera been bumped? Looks at a set of masks now and then and says which camera contradicts the others."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

import numpy as np

from limbloc_ros.core.camera import Camera, Rig
from limbloc_ros.rig.consistency import Mask, Scores, make_grid, mean_scores, score, shrink_masks

#: Voxels of the carve volume; one look at 8 cameras takes about 2 ms.
VOXELS = 50_000
#: So many looks are averaged, and so many are needed before anything is said.
LOOKS, FEWEST = 10, 4
#: A camera is suspected when without it so much less of the foreground is unexplained, and this share of all of it.
#: Ragged masks reach 0.02, a camera that looks 1.5 degrees aside 0.1.
SUSPECT, SUSPECT_SHARE = 0.06, 0.5


def _a_dot(camera: Camera) -> Mask:
    mask = np.zeros((camera.height, camera.width), np.uint8)
    mask[camera.height // 3 : camera.height // 2, camera.width // 3 : camera.width // 2] = 1
    return mask


class ConsistencyWatch:
    """Averages how the cameras agree over the last looks.

    Args:
        rig: the cameras and the carve volume.
    """

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self._grid = make_grid(rig, most=VOXELS)
        self._scores: deque[Scores] = deque(maxlen=LOOKS)
        self.look({camera.name: _a_dot(camera) for camera in rig.cameras})  # compiles or loads the kernels
        self._scores.clear()

    def look(self, masks: Mapping[str, Mask]) -> None:
        """Take one set of masks of the same instant into account; sets of fewer than three usable masks say nothing."""
        small = shrink_masks(self._grid.views, masks)
        if len(small) >= 3:
            self._scores.append(score(self._grid, small))

    @property
    def scores(self) -> Scores | None:
        """The mean over the last looks; None before there are enough."""
        return mean_scores(self._scores, self.rig.names) if len(self._scores) >= FEWEST else None

    def suspect(self) -> tuple[str, str] | None:
        """The camera that contradicts the others, and what to tell people; None when all is well."""
        scores = self.scores
        if scores is None or not np.isfinite(scores.blame).any():
            return None
        blame = np.where(np.isfinite(scores.blame), scores.blame, -1.0)
        worst = int(blame.argmax())
        if blame[worst] < max(SUSPECT, SUSPECT_SHARE * scores.together):
            return None
        return scores.names[worst], (
            f"contradicts the other cameras: {100 * scores.together:.0f} % of the foreground is not explained, "
            f"{100 * scores.without[worst]:.0f} % without it: was it bumped? (limbloc rig check tells more)"
        )
