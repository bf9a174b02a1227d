# SPDX-License-Identifier: Apache-2.0
"""Where an offline run's masks come from: a benchmark case, a bag, or videos and pictures of each camera.

Every source gives one `MaskSet` per frame, in the order of the stamps. Segmentation remembers the frames before, so it
happens here, in order; whatever comes after it is independent from frame to frame.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core.background import UNREST, BackgroundModel
from limbloc_ros.core.camera import Rig
from limbloc_ros.core.config import BackgroundConfig, SyncConfig
from limbloc_ros.core.errors import InputError
from limbloc_ros.core.synchroniser import StampSynchroniser
from limbloc_ros.recordings.bag_frames import BagFrame, camera_streams, frame_sets
from limbloc_ros.recordings.bags import SUFFIXES, BagReader
from limbloc_ros.recordings.cases import Case

Pixels = NDArray[np.uint8]

#: Segmentation parameters of every camera by name.
Backgrounds = Mapping[str, BackgroundConfig]


@dataclass(frozen=True)
class MaskSet:
    """The masks of one frame.

    Attributes:
        stamp_ns: acquisition stamp, ns.
        masks: camera name -> uint8 [height, width] of the rig's size, non-zero = foreground.
        reason: why there is nothing to carve, empty when there is.
        stage_ms: process time of the stages so far, ms.
        images: camera name -> the image (grey or bgr) that the mask was made from, where there is one.
    """

    stamp_ns: int
    masks: dict[str, Pixels]
    reason: str = ""
    stage_ms: dict[str, float] = field(default_factory=dict)
    images: dict[str, Pixels] = field(default_factory=dict)


class Source(Protocol):
    """A recording as a stream of masks.

    Attributes:
        rig: its cameras.
        frames: how many there are, None where only reading tells.
        about: what it is, in plain values, for `run.json`.
        identity: plain values that change when the recording does.
        notes: what a person should know about it; complete after the last frame.
    """

    rig: Rig
    frames: int | None
    about: dict[str, Any]
    identity: Any
    notes: list[str]

    def mask_sets(self) -> Iterator[MaskSet]:
        """All frames from the first on; each call starts anew."""
        ...


class CaseSource:
    """The masks of a benchmark case."""

    def __init__(self, case: Case) -> None:
        self.case = case
        self.rig = case.rig
        self.frames: int | None = len(case)
        self.about: dict[str, Any] = {
            "input": str(case.folder),
            "kind": "benchmark case",
            "consecutive": case.meta.get("kind", "sequence") == "sequence",
        }
        self.identity = ["case", file_identity(case.folder / "masks.npz"), rig_identity(case.rig)]
        self.notes: list[str] = []

    def mask_sets(self) -> Iterator[MaskSet]:
        """The frames in the order of the archive."""
        for i, stamp in enumerate(self.case.stamps):
            yield MaskSet(round(stamp * 1e9), self.case.masks(i))


class BagSource:
    """Masks or camera images in a rosbag2 recording."""

    def __init__(
        self, path: Path, rig: Rig, background: Backgrounds, sync: SyncConfig, min_cameras: int,
        pictures: Mapping[str, Pixels] | None = None,
    ) -> None:  # fmt: skip
        self.rig = rig
        self._path, self._background, self._sync, self._min_cameras = path, background, sync, min_cameras
        self._pictures = pictures or {}
        with BagReader(path) as bag:
            self._streams = camera_streams(bag, rig.names)
            counts = [bag.topics[stream.topic].count for stream in self._streams.values()]
        self.frames: int | None = None  # sets are only known once their stamps are read
        self.about: dict[str, Any] = {
            "input": str(path),
            "kind": "bag",
            "topics": {name: stream.topic for name, stream in self._streams.items()},
            "messages": sum(counts),
            "consecutive": True,
        }
        if any(not stream.is_mask for stream in self._streams.values()):
            self.about["background"] = background_story(background, rig, self._pictures)
        files = sorted(path.iterdir()) if path.is_dir() else [path]
        self.identity = ["bag", [file_identity(f) for f in files if f.suffix in SUFFIXES], rig_identity(rig)]
        self.notes: list[str] = []

    def mask_sets(self) -> Iterator[MaskSet]:
        """The frames in the order of their stamps; images are segmented."""
        self.notes.clear()
        segmenter = Segmenter(self.rig, self._background, self._pictures)
        segmenter.notes = self.notes
        synchroniser: StampSynchroniser[BagFrame] = StampSynchroniser.from_config(
            self.rig.names, self._sync, self._min_cameras
        )
        damaged: dict[str, int] = {}
        with BagReader(self._path) as bag:
            for frames in frame_sets(bag, self._streams, synchroniser=synchroniser, damaged=damaged):
                start = time.process_time()
                masks: dict[str, Pixels] = {}
                images: dict[str, Pixels] = {}
                for name, frame in frames.items.items():
                    try:
                        pixels = frame.pixels()
                    except InputError:  # one damaged picture costs this camera this frame, as it does live
                        damaged[name] = damaged.get(name, 0) + 1
                        continue
                    (masks if frame.stream.is_mask else images)[name] = pixels
                for name, mask in masks.items():
                    check_size(mask, self.rig, name, frames.items[name].stream.topic)
                reason = ""
                if images:
                    masks, reason = segmenter.masks(images)
                yield MaskSet(frames.stamp_ns, masks, reason, {"mask": 1e3 * (time.process_time() - start)}, images)
            if bag.damage:
                self.notes.append(f"{self._path}: {bag.damage}")
        self.notes += [f"camera {name}: {count} damaged pictures were left out" for name, count in damaged.items()]
        counters = synchroniser.counters
        for what, by_camera in (("late", counters.late), ("duplicate", counters.duplicate)):
            self.notes += [f"camera {name}: {count} {what} frames" for name, count in by_camera.items() if count]
        if counters.dropped:
            self.notes.append(f"{counters.dropped} sets of fewer than {self._min_cameras} cameras were dropped")


class Segmenter:
    """The background models of all cameras.

    Args:
        rig: the cameras.
        config: segmentation of each camera.
        pictures: camera name -> picture of the empty room; cameras without one learn from their first frames.

    Attributes:
        models: camera name -> its background model.
        notes: what a person should know about the backgrounds.
    """

    def __init__(self, rig: Rig, config: Backgrounds, pictures: Mapping[str, Pixels]) -> None:
        self._rig = rig
        self.notes: list[str] = []
        self.models = {name: BackgroundModel(config[name]) for name in rig.names}
        for name, picture in pictures.items():
            check_size(picture, rig, name, "its background picture")
            self.models[name].seed(picture)

    def masks(self, images: Mapping[str, Pixels]) -> tuple[dict[str, Pixels], str]:
        """Segment the next image of each camera.

        Returns:
            masks by camera name, and why they say nothing (empty when they do).
        """
        results = {}
        for name, image in images.items():
            check_size(image, self._rig, name, "its image")
            model = self.models[name]
            learned_before = not model.learning
            results[name] = model.segment(image)
            if not learned_before and not model.learning and model.unrest > UNREST:
                share = f"{100 * model.unrest:.0f} %"
                if any(note.startswith("WARNING") for note in self.notes):
                    self.notes.append(f"WARNING: camera {name}: {share} of its picture moved as well")
                else:
                    self.notes.append(
                        f"WARNING: camera {name}: {share} of the picture moved while its background was learned from "
                        f"the first {model.config.learning_frames} frames, which must show the empty room; its masks "
                        "will have holes and ghosts. Give --background FOLDER, pictures of the empty room, or "
                        "--background estimate for videos of somebody who moves about"
                    )
        reason = ""
        if all(result.learning for result in results.values()):
            name, least = min(results.items(), key=lambda item: item[1].frames_learned)
            wanted = self.models[name].config.learning_frames
            reason = f"learning the background ({least.frames_learned} of {wanted} frames)"
        return {name: result.mask for name, result in results.items()}, reason


def background_story(config: Backgrounds, rig: Rig, pictures: Mapping[str, Pixels], estimate: bool = False) -> str:
    """Where the backgrounds of images come from, in words."""
    if estimate:
        return "guessed from all frames"
    if pictures:
        return "pictures of the empty room"
    wanted = sorted({config[name].learning_frames for name in rig.names})
    return f"learned from the first {' to '.join(str(n) for n in (wanted[0], wanted[-1])[: len(wanted)])} frames"


def check_size(pixels: Pixels, rig: Rig, name: str, what: str) -> None:
    """Raise InputError when an image or mask is not of its camera's size."""
    camera = rig.camera(name)
    if pixels.shape[:2] != (camera.height, camera.width):
        raise InputError(
            f"camera {name}, {what}: expected {camera.width}x{camera.height} px as in the rig file, got "
            f"{pixels.shape[1]}x{pixels.shape[0]}; is the stream scaled, or the rig file another camera's?"
        )


def file_identity(path: Path) -> list[Any]:
    """Plain values that change when a file does, without reading all of it."""
    status = path.stat()
    return [path.name, status.st_size, status.st_mtime_ns]


def rig_identity(rig: Rig) -> list[Any]:
    """Plain values that change when a rig does."""
    cameras = [
        [
            *(c.name, c.width, c.height, c.K.tolist(), c.distortion_model, c.distortion.tolist()),
            *(c.T_world_camera.tolist(), [polygon.tolist() for polygon in c.ignore]),
        ]
        for c in rig.cameras
    ]
    return [cameras, rig.volume_min.tolist(), rig.volume_max.tolist()]
