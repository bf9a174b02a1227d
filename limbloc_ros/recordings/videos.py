# SPDX-License-Identifier: Apache-2.0
"""Videos and image folders, one per camera, as one stream of frames."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core.errors import InputError
from limbloc_ros.core.images import decode_picture

Pixels = NDArray[np.uint8]

VIDEO_SUFFIXES = (".mp4", ".avi", ".mkv", ".mov", ".m4v", ".webm", ".mpg", ".mpeg")
PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")


class Stream(Protocol):
    """The frames of one camera.

    Attributes:
        path: video file or image folder.
        files: all files that it is made of.
        fps: frames per second, None where the files do not say.
        numbers: frame numbers that it promises to have, in order.
        notes: what went wrong while reading, in words.
    """

    path: Path
    files: list[Path]
    fps: float | None
    numbers: Sequence[int]
    notes: list[str]

    def read(self, wanted: Sequence[int]) -> Iterator[tuple[int, Pixels]]:
        """The wanted frames, (number, pixels), in order; damaged ones are left out and noted."""
        ...


class Video:
    """A video file; its frames are numbered from 0."""

    def __init__(self, path: Path) -> None:
        self.path, self.files, self.notes = path, [path], list[str]()
        capture = self._open()
        fps, count = capture.get(cv2.CAP_PROP_FPS), int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        capture.release()
        if not 0 < fps < 10_000 or count < 1:
            raise InputError(f"{path}: expected a video with frames and a frame rate, got {count} frames at {fps:g} Hz")
        self.fps: float | None = fps
        self.numbers: Sequence[int] = range(count)

    def _open(self) -> cv2.VideoCapture:
        capture = cv2.VideoCapture(str(self.path))
        if not capture.isOpened():
            raise InputError(f"{self.path} cannot be opened as a video; is it complete, and its codec known to OpenCV?")
        return capture

    def read(self, wanted: Sequence[int]) -> Iterator[tuple[int, Pixels]]:
        """Decodes from the beginning: seeking is not exact in most formats."""
        left, number = list(wanted), 0
        capture = self._open()
        try:
            while left and capture.grab():
                if number == left[0]:
                    left.pop(0)
                    good, pixels = capture.retrieve()
                    if good:
                        yield number, np.asarray(pixels, dtype=np.uint8)
                    else:
                        self.notes.append(f"{self.path}: frame {number} cannot be decoded")
                number += 1
        finally:
            capture.release()
        if left:
            self.notes.append(f"{self.path} ends after {number} of {len(self.numbers)} frames: it is truncated")


class ImageFolder:
    """A folder of pictures. Numbered names (0007.jpg, frame_0007.png) keep their numbers, so that a lost picture
    leaves a gap; other names are numbered by their order."""

    def __init__(self, path: Path) -> None:
        self.path, self.notes = path, list[str]()
        self.fps: float | None = None
        self.files = pictures_in(path)
        if not self.files:
            raise InputError(f"{path}: expected pictures ({', '.join(PICTURE_SUFFIXES)}), found none")
        digits = ["".join(c if c.isdigit() else " " for c in f.stem).split() for f in self.files]
        found = [int(d[-1]) for d in digits if d]
        named = len(found) == len(set(found)) == len(self.files)
        by_number = sorted(zip(found, self.files, strict=True)) if named else list(enumerate(self.files))
        self._by_number = dict(by_number)
        self.numbers: Sequence[int] = list(self._by_number)

    def file(self, number: int) -> Path | None:
        """The picture with this number, None if there is none."""
        return self._by_number.get(number)

    def read(self, wanted: Sequence[int]) -> Iterator[tuple[int, Pixels]]:
        """Reads only what is wanted."""
        for number in wanted:
            file = self._by_number.get(number)
            if file is None:
                continue
            try:
                pixels = read_picture(file)
            except InputError as error:
                self.notes.append(str(error))
                continue
            yield number, pixels


class StreamReader:
    """Takes frames out of a stream by number, none twice and none out of order."""

    def __init__(self, stream: Stream, numbers: Sequence[int]) -> None:
        self._frames = stream.read(numbers)
        self._next = next(self._frames, None)

    def take(self, number: int) -> Pixels | None:
        """Frame number `number`, None if the stream lacks it."""
        if self._next is None or self._next[0] != number:
            return None
        pixels = self._next[1]
        self._next = next(self._frames, None)
        return pixels


def frame_numbers(streams: Mapping[str, Stream]) -> list[int]:
    """The numbers of all frames that any of the streams has, in order."""
    return sorted(set().union(*(stream.numbers for stream in streams.values())))


def pictures_in(folder: Path) -> list[Path]:
    """The pictures in a folder, by name."""
    return sorted(f for f in folder.iterdir() if f.suffix.lower() in PICTURE_SUFFIXES)


def read_picture(path: Path) -> Pixels:
    """A picture as uint8 [height, width] (grey) or [height, width, 3] (bgr).

    Raises:
        InputError: it cannot be read, is truncated or damaged.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from None
    if path.suffix.lower() in (".png", ".jpg", ".jpeg"):
        try:
            return decode_picture(data, path.suffix)
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if data else None
    if pixels is None:
        raise InputError(f"{path} is damaged or no picture")
    return np.asarray(pixels, dtype=np.uint8)


@dataclass(frozen=True)
class _Found:
    folder: Path
    streams: dict[str, Path]


def find_streams(folder: Path, cameras: Sequence[str]) -> dict[str, Stream]:
    """The video or image folder of every camera.

    Args:
        folder: holds `<camera>.mp4` (or another video) or `<camera>/` with pictures; or one folder that does.
        cameras: names in the rig file.

    Raises:
        InputError: a camera has none or several, or more than one folder below would do.
    """
    here = _look(folder, cameras)
    if not here.streams:
        below = [_look(child, cameras) for child in sorted(folder.iterdir()) if child.is_dir()]
        complete = [found for found in below if len(found.streams) == len(cameras)]
        if len(complete) > 1:
            names = ", ".join(str(found.folder) for found in complete)
            raise InputError(f"{folder} holds several recordings: give one of {names} as INPUT")
        if complete:
            here = complete[0]
    missing = [name for name in cameras if name not in here.streams]
    if missing:
        names = ", ".join(sorted(child.name for child in here.folder.iterdir())[:20])
        raise InputError(
            f"{here.folder} has no video or image folder of camera {', '.join(missing)}; expected {missing[0]}.mp4 or "
            f"{missing[0]}/ (name the files like the cameras in the rig file), found {names or 'nothing'}"
        )
    return {n: ImageFolder(p) if p.is_dir() else Video(p) for n, p in here.streams.items()}


def _look(folder: Path, cameras: Sequence[str]) -> _Found:
    streams = {}
    children = sorted(folder.iterdir())
    for name in cameras:
        fits = [c for c in children if c.stem == name and c.suffix.lower() in VIDEO_SUFFIXES]
        fits += [c for c in children if c.name == name and c.is_dir() and pictures_in(c)]
        if len(fits) > 1:
            raise InputError(f"camera {name} is there more than once: {', '.join(map(str, fits))}; keep one of them")
        if fits:
            streams[name] = fits[0]
    return _Found(folder, streams)
