# SPDX-License-Identifier: Apache-2.0
"""Videos or image folders of each camera as a source of masks."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core.background_estimate import estimate_background
from limbloc_ros.core.camera import Rig
from limbloc_ros.core.errors import InputError
from limbloc_ros.recordings.sources import (
    Backgrounds,
    MaskSet,
    Segmenter,
    background_story,
    check_size,
    file_identity,
    rig_identity,
)
from limbloc_ros.recordings.videos import Stream, StreamReader, find_streams, frame_numbers

Pixels = NDArray[np.uint8]

#: The word that asks for a background guessed from the recording itself, and from how many of its frames.
ESTIMATE, ESTIMATE_FRAMES = "estimate", 40

DEFAULT_FPS = 25.0


class FolderSource:
    """A folder with a video or an image folder per camera, all started at the same instant.

    Args:
        folder: see `videos.find_streams`.
        rig: the cameras.
        config: segmentation of each camera.
        pictures: camera name -> picture of the empty room; without, the first frames must show it.
        estimate: guess the empty room from the recording.
        are_masks: the frames are silhouettes already.
        fps: frame rate of image folders, Hz.

    Raises:
        InputError: a camera has no video or pictures, or frame rates differ.
    """

    def __init__(
        self,
        folder: Path,
        rig: Rig,
        config: Backgrounds,
        pictures: Mapping[str, Pixels] | None = None,
        *,
        estimate: bool = False,
        are_masks: bool = False,
        fps: float | None = None,
    ) -> None:
        self.rig = rig
        self._config, self._pictures, self._estimate, self._are_masks = config, pictures or {}, estimate, are_masks
        self._streams = find_streams(folder, rig.names)
        self._fps = _common_fps(self._streams, fps)
        self._numbers = frame_numbers(self._streams)
        self.frames: int | None = len(self._numbers)
        self.about: dict[str, Any] = {
            "input": str(folder),
            "kind": "silhouettes" if are_masks else "images",
            "fps": self._fps,
            "consecutive": True,
        }
        if not are_masks:
            self.about["background"] = background_story(config, rig, self._pictures, estimate)
        self.identity = [
            "folder",
            {name: [file_identity(f) for f in stream.files] for name, stream in self._streams.items()},
            {name: int(picture.astype(np.int64).sum()) for name, picture in self._pictures.items()},
            [estimate, are_masks, self._fps],
            rig_identity(rig),
        ]
        self.notes: list[str] = []

    def mask_sets(self) -> Iterator[MaskSet]:
        """All frames in order; a camera that lacks one is left out of it."""
        for stream in self._streams.values():
            stream.notes.clear()
        self.notes.clear()
        segmenter = None if self._are_masks else self._segmenter()
        readers = {name: StreamReader(stream, self._numbers) for name, stream in self._streams.items()}
        for number in self._numbers:
            start = time.process_time()
            read = ((name, reader.take(number)) for name, reader in readers.items())
            images = {name: pixels for name, pixels in read if pixels is not None}
            stamp_ns = round((number - self._numbers[0]) * 1e9 / self._fps)
            masks: dict[str, Pixels] = {}
            reason = "" if images else "no camera has this frame"
            if segmenter is not None and images:
                masks, reason = segmenter.masks(images)
            elif segmenter is None:
                masks, images = {name: silhouette(image) for name, image in images.items()}, {}
                for name, mask in masks.items():
                    check_size(mask, self.rig, name, str(self._streams[name].path))
            yield MaskSet(stamp_ns, masks, reason, {"mask": 1e3 * (time.process_time() - start)}, images)
        self.notes += [note for stream in self._streams.values() for note in stream.notes]
        counts = {name: len(stream.numbers) for name, stream in self._streams.items()}
        if len(set(counts.values())) > 1:
            self.notes.append(f"the cameras have different numbers of frames: {counts}; missing ones were left out")

    def _segmenter(self) -> Segmenter:
        segmenter = Segmenter(self.rig, self._config, self._pictures)
        segmenter.notes = self.notes
        if self._estimate:
            step = max(1, len(self._numbers) // ESTIMATE_FRAMES)
            for name, stream in self._streams.items():
                sample = [pixels for _, pixels in stream.read(self._numbers[::step])]
                segmenter.models[name].seed_estimate(estimate_background(sample))
        return segmenter


def silhouette(image: Pixels) -> Pixels:
    """A picture of a silhouette -> mask of 0 and 255; bright is foreground (any non-zero value if it holds 0 and 1)."""
    grey = image if image.ndim == 2 else image.max(axis=2)
    return np.where(grey > (127 if grey.max(initial=0) > 1 else 0), np.uint8(255), np.uint8(0))


def _common_fps(streams: Mapping[str, Stream], fps: float | None) -> float:
    if fps is not None and not 0 < fps < 10_000:
        raise InputError(f"--fps: expected a positive frame rate in Hz, got {fps:g}")
    rates = {name: stream.fps for name, stream in streams.items() if stream.fps is not None}
    if rates and max(rates.values()) - min(rates.values()) > 0.01 * max(rates.values()):
        found = ", ".join(f"{name} {rate:g} Hz" for name, rate in rates.items())
        raise InputError(f"the videos have different frame rates ({found}); expected synchronised cameras")
    return fps or (float(np.median(list(rates.values()))) if rates else DEFAULT_FPS)
