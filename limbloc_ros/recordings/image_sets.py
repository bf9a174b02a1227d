# SPDX-License-Identifier: Apache-2.0
"""Images of all cameras out of a folder of videos or pictures, or a bag: synchronous sets, one after the other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core.errors import InputError
from limbloc_ros.recordings.bag_frames import IMAGE_ENDINGS, camera_streams, frame_sets
from limbloc_ros.recordings.bags import BagReader, is_bag
from limbloc_ros.recordings.videos import VIDEO_SUFFIXES, StreamReader, find_streams, frame_numbers, pictures_in

Pixels = NDArray[np.uint8]


def find_cameras(path: Path) -> list[str]:
    """The cameras of a recording, by the names of its videos, folders of pictures, or image topics.

    Raises:
        InputError: there are none.
    """
    if not path.exists():
        raise InputError(f"{path} does not exist; expected a bag, or a folder with a video or pictures of each camera")
    if is_bag(path):
        with BagReader(path) as bag:
            names = {
                topic.removesuffix(f"/{ending}").rpartition("/")[2]
                for topic, entry in bag.topics.items()
                for ending, kind in IMAGE_ENDINGS.items()
                if topic.endswith(f"/{ending}") and entry.type == kind
            }
    elif path.is_dir():
        names = {c.stem for c in path.iterdir() if c.suffix.lower() in VIDEO_SUFFIXES}
        names |= {c.name for c in path.iterdir() if c.is_dir() and pictures_in(c)}
    else:
        raise InputError(f"{path}: expected a bag, or the folder that holds all cameras' videos or pictures")
    if not names:
        raise InputError(f"{path}: found no video, folder of pictures or image topic; expected one of each camera")
    return sorted(names)


def image_sets(path: Path, names: Sequence[str], every: int = 1) -> Iterator[tuple[int, dict[str, Pixels]]]:
    """Every n-th synchronous set of images: its number, and the images by camera; cameras may be missing in one.

    Raises:
        InputError: the recording cannot be read.
    """
    if is_bag(path):
        with BagReader(path) as bag:
            streams = camera_streams(bag, names, prefer="images")
            for number, frames in enumerate(frame_sets(bag, streams)):
                if number % every == 0:
                    yield number, {name: frame.pixels() for name, frame in frames.items.items()}
        return
    streams_of = find_streams(path, names)
    numbers = frame_numbers(streams_of)[::every]
    readers = {name: StreamReader(stream, numbers) for name, stream in streams_of.items()}
    for number in numbers:
        taken = ((name, reader.take(number)) for name, reader in readers.items())
        yield number, {name: pixels for name, pixels in taken if pixels is not None}


def count_sets(path: Path, names: Sequence[str]) -> int | None:
    """How many sets a folder has; None for a bag, where only reading tells."""
    if is_bag(path):
        return None
    return len(frame_numbers(find_streams(path, names)))
