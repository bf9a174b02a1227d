# SPDX-License-Identifier: Apache-2.0
"""A run's hulls -> PLY meshes, carved anew from the masks that were kept, or from the whole recording."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from limbloc_ros import __version__
from limbloc_ros.core.camera import Rig
from limbloc_ros.core.config import HullConfig
from limbloc_ros.core.hull import Hull
from limbloc_ros.core.pipeline import Carver
from limbloc_ros.export.hull_surface import hull_surface, ply_bytes
from limbloc_ros.export.recording import recorded_frames
from limbloc_ros.files import replaced
from limbloc_ros.recordings.kept_frames import KeptFrames, Pixels
from limbloc_ros.recordings.results import Run
from limbloc_ros.recordings.sources import Source

Masks = dict[str, Pixels]


def kept_masks(kept: KeptFrames) -> Iterator[tuple[int, Masks]]:
    """Number and masks of the frames that the run kept."""
    for number in kept.numbers:
        yield number, kept.masks(number)


def recorded_masks(source: Source, run: Run) -> Iterator[tuple[int, Masks]]:
    """Number and masks of every frame of the recording that the run has."""
    for number, frame in recorded_frames(source, run):
        if frame.masks and not frame.reason:
            yield number, frame.masks


def write_hulls(
    frames: Iterable[tuple[int, Masks]],
    rig: Rig,
    config: HullConfig,
    folder: Path,
    progress: Callable[[], object] = lambda: None,
) -> int:
    """Write `hull_<frame>.ply` for each frame, m, world axes (z up).

    Args:
        frames: number and masks by camera name.
        rig: the cameras.
        config: as the run was made with.
        folder: is made if need be.
        progress: called after each frame.

    Returns:
        how many files were written; frames without a person have none.
    """
    carver = Carver(rig, config)
    written = 0
    for number, masks in frames:
        hull = carver.carve(masks)
        if isinstance(hull, Hull):
            data = ply_bytes(*hull_surface(hull), comment=f"limbloc_ros {__version__} visual hull of frame {number}, m")
            with replaced(folder / f"hull_{number:06d}.ply") as path:
                path.write_bytes(data)
            written += 1
        progress()
    return written
