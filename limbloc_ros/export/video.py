# SPDX-License-Identifier: Apache-2.0
"""A run and its recording -> a video: all cameras' images in a grid, the stick figure over each."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path

import cv2
import numpy as np

from limbloc_ros.core.camera import Camera, Rig
from limbloc_ros.core.errors import InputError
from limbloc_ros.core.pose import Array
from limbloc_ros.export.clip import Clip
from limbloc_ros.export.recording import recorded_frames
from limbloc_ros.export.stick_drawing import Image, as_bgr, draw_stick, label
from limbloc_ros.recordings.sources import Source

CODECS = {".mp4": "mp4v", ".avi": "MJPG", ".webm": "VP80"}
GAP_PX = 4
GROUND = 24


def write_video(
    clip: Clip,
    source: Source,
    path: Path,
    *,
    panel_width_px: int = 480,
    columns: int = 0,
    progress: Callable[[], object] = lambda: None,
) -> int:
    """Write the overlay video.

    Args:
        clip: which frames, at which rate; rows without an image repeat nothing and are left dark.
        source: the recording that the run was made from; masks are drawn where it has no images.
        path: the file itself (.mp4, .avi or .webm); the caller renames it when it is complete.
        panel_width_px: width of one camera's panel.
        columns: panels in a row; 0 chooses.
        progress: called after each frame.

    Returns:
        how many frames were written.

    Raises:
        InputError: an unknown suffix, no frame of the recording belongs to the run, or OpenCV cannot write the video.
    """
    codec = CODECS.get(path.suffix.lower())
    if codec is None:
        raise InputError(f"{path.name}: expected a video named {', '.join(CODECS)}, got {path.suffix or 'no suffix'!r}")
    grid = _Grid(source.rig, panel_width_px, columns)
    row_of = {int(number): row for row, number in enumerate(clip.rows) if number >= 0}
    joints = clip.run.joints
    wanted = set(row_of)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), clip.rate_hz, grid.size)
    if not writer.isOpened():
        raise InputError(f"OpenCV cannot write {path.suffix} videos of {grid.size[0]}x{grid.size[1]} px here; try .avi")
    next_row, picture = 0, grid.empty()
    try:
        for number, frame in recorded_frames(source, clip.run):
            if number not in wanted:
                continue
            while next_row < row_of[number]:  # rows without a frame hold the picture before them
                writer.write(picture)
                next_row += 1
                progress()
            reliable = bool(clip.run.reliable[number])
            text = f"{clip.seconds[next_row]:.2f} s" + ("" if reliable else "  not reliable")
            picture = grid.draw(frame.images or frame.masks, joints[number], text)
            writer.write(picture)
            next_row += 1
            progress()
            wanted.discard(number)
            if not wanted:
                break
    finally:
        writer.release()
    if not path.exists() or path.stat().st_size == 0:
        raise InputError(f"OpenCV wrote nothing to {path}; is the disk full?")
    return next_row


class _Grid:
    """Where each camera's panel lies."""

    def __init__(self, rig: Rig, panel_width_px: int, columns: int) -> None:
        count = len(rig.cameras)
        self._columns = columns or min(count, 4 if count > 4 else 2)
        self._panels = {camera.name: _scaled(camera, panel_width_px) for camera in rig.cameras}
        tallest = max(camera.height for camera in self._panels.values())
        self._step = (panel_width_px + GAP_PX, tallest + GAP_PX)
        rows = -(-count // self._columns)
        width, height = self._columns * self._step[0] - GAP_PX, rows * self._step[1] - GAP_PX
        self.size = (width + width % 2, height + height % 2)  # codecs want even sizes

    def empty(self) -> Image:
        """A picture without any panel."""
        return np.full((self.size[1], self.size[0], 3), GROUND, dtype=np.uint8)

    def draw(self, images: Mapping[str, Image], joints: Array, text: str) -> Image:
        """All panels; the first one carries the text."""
        sheet = self.empty()
        for k, (name, camera) in enumerate(self._panels.items()):
            if name not in images:
                continue
            image = cv2.resize(as_bgr(images[name]), (camera.width, camera.height), interpolation=cv2.INTER_AREA)
            panel = draw_stick(np.asarray(image, dtype=np.uint8), camera, joints)
            panel = label(panel, f"{name}  {text}" if k == 0 else name)
            x, y = (k % self._columns) * self._step[0], (k // self._columns) * self._step[1]
            sheet[y : y + camera.height, x : x + camera.width] = panel
        return sheet


def _scaled(camera: Camera, width_px: int) -> Camera:
    """The camera that would take the scaled image; pixel u becomes scale * (u + 0.5) - 0.5."""
    scale = width_px / camera.width
    height = max(1, round(camera.height * scale))
    tall = height / camera.height
    M = np.array([[scale, 0, (scale - 1) / 2], [0, tall, (tall - 1) / 2], [0, 0, 1]])
    return dataclasses.replace(camera, width=width_px, height=height, K=M @ camera.K)
