# SPDX-License-Identifier: Apache-2.0
"""A second, closer look at a rig that seems right: is one camera off by some pixels?

`rig.check` looks at images of 240 px, in which a lens that is off by a hundredth of the image is lost in the rim of the
silhouettes. Limbs in the hull are then thin on one side, and poses bad for no visible reason. Here images are larger
and voxels smaller, and a fault counts only when moving that one camera explains nearly all of the contradiction:
ragged masks contradict each other too, but no movement explains them.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping

import cv2
import numpy as np

from limbloc_ros.core.camera import Rig
from limbloc_ros.rig.check import Report, find_person, hull_voxels, spread
from limbloc_ros.rig.consistency import Grid, LowView, Mask, cover, low_view, mean_scores, score, shrink_masks
from limbloc_ros.rig.faults import Frame, Move, best_move, contradiction
from limbloc_ros.rig.geometry import where_they_look

#: Images are looked at no wider or higher than this (px), and the person's surroundings in so many voxels.
FINE_PX, FINE_VOXELS = 640, 600_000
#: Frames that are compared.
FEW = 6
#: Less contradiction than this is none.
NOTHING = 0.005
#: Without the camera so much of the contradiction must be gone; where it should stand, no more than so much be left.
#: Of true rigs with ragged masks 0.9 is left, of a lens that was off by 27 px 0.1.
GUILTY_SHARE, LEFT = 0.5, 0.35
#: Below this many pixels of the full image nothing is said.
SHIFT_PX = 5.0
#: Foreground further than this from the others' hull, px of the small image, is something else that moves there.
FAR_PX = 15


class FineFrames:
    """Keeps a few frames of a recording of unknown length, evenly."""

    def __init__(self, rig: Rig) -> None:
        self._views: tuple[LowView, ...] = tuple(low_view(camera, FINE_PX) for camera in rig.cameras)
        self._frames: list[Frame] = []
        self._step, self._count = 1, 0

    def add(self, masks: Mapping[str, Mask]) -> None:
        """One more frame: masks by camera name."""
        if self._count % self._step == 0:
            self._frames.append(shrink_masks(self._views, masks))
            if len(self._frames) > 2 * FEW:
                self._frames = self._frames[::2]
                self._step *= 2
        self._count += 1

    def few(self) -> list[Frame]:
        """At most FEW of them: those that most cameras see somebody in."""
        most = max(map(len, self._frames), default=0)
        full = [frame for frame in self._frames if len(frame) == most and most > 2]
        return [full[i] for i in spread(range(len(full)), FEW)] if full else []


def look_closely(rig: Rig, report: Report, kept: FineFrames) -> None:
    """Add to a report that found nothing severe which camera is off by a little, if one is."""
    frames = kept.few()
    if not report.good or not frames or len(rig.cameras) < 3:
        return
    look = where_they_look([camera.T_world_camera for camera in rig.cameras])
    strangers = {rig.names.index(name) for finding in report.findings for name in finding.cameras}
    grid, _ = find_person(rig, look, frames, FINE_VOXELS, FINE_PX)
    if grid is None:
        return
    frames = [_of_the_person(grid, frame, strangers) for frame in frames]
    scores = mean_scores([score(grid, frame) for frame in frames], rig.names)
    if not scores.together > NOTHING:
        return
    found: list[tuple[float, int, Move]] = []
    for camera in np.flatnonzero(scores.blame > GUILTY_SHARE * scores.together).tolist():
        move = best_move(grid, frames, camera)
        if move is None or move.shift_px < SHIFT_PX:
            continue
        rest = contradiction(grid, [{c: m for c, m in frame.items() if c != camera} for frame in frames])
        left = max(0.0, move.after - rest) / max(move.before - rest, 1e-6)
        if left < LEFT:
            found.append((left, camera, move))
    if not found:
        return
    found.sort(key=lambda one: one[0])
    left, camera, move = found[0]
    name = rig.names[camera]
    report.move[name] = move
    rivals = [rig.names[other] for _, other, _ in found[1:]]
    or_else = f" (or {' or '.join(rivals)}, nearly as likely)" if rivals else ""
    report.say(
        "place",
        f"{name}{or_else} is a little off: its image by about {move.shift_px:.0f} px, which is "
        f"{math.degrees(move.turn_rad):.1f} degrees of gaze, or its lens's principal point. So corrected, "
        f"{100 * left:.0f} % of what the silhouettes contradict each other by on a closer look "
        f"({100 * scores.together:.1f} %) is left. "
        "Limbs come out thin on one side and poses less sure: calibrate it again, or take what --fix writes",
        (name,),
        severe=False,
    )


def _of_the_person(grid: Grid, frame: Frame, cameras: Collection[int]) -> dict[int, Mask]:
    """A frame without what these cameras see far from the hull of all others."""
    out = dict(frame)
    size = 2 * FAR_PX + 1
    for camera in cameras:
        if camera in out:
            rest = hull_voxels(grid, {c: mask for c, mask in frame.items() if c != camera})
            near = cv2.dilate(cover(grid, camera, rest), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)))
            out[camera] = np.asarray(out[camera] & near, dtype=np.uint8)
    return out
