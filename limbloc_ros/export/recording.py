# SPDX-License-Identifier: Apache-2.0
"""The recording that a run was made from, opened again: for its images, and for its hulls."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

from limbloc_ros.core.camera import Rig
from limbloc_ros.core.config import BackgroundConfig, FitConfig, HullConfig, SyncConfig, from_mapping
from limbloc_ros.core.errors import InputError
from limbloc_ros.recordings.bags import is_bag
from limbloc_ros.recordings.offline import OfflineConfig
from limbloc_ros.recordings.open_source import open_source
from limbloc_ros.recordings.results import Run
from limbloc_ros.recordings.sources import MaskSet, Source
from limbloc_ros.rig.rig_file import load_rig


def rig_of(folder: Path) -> Rig:
    """The rig that a run was made with; raises InputError when the folder does not hold it."""
    if not (folder / "rig.yaml").is_file():
        raise InputError(f"{folder} holds no rig.yaml; expected the folder that `limbloc process` wrote")
    return load_rig(folder / "rig.yaml")


def config_of(run: Run) -> OfflineConfig:
    """The parameters that a run was made with; defaults where it does not say."""
    values: dict[str, Any] = run.about.get("config", {})
    kinds = {"background": BackgroundConfig, "sync": SyncConfig, "hull": HullConfig, "fit": FitConfig}
    found: dict[str, Any] = {
        name: from_mapping(kind, _known(kind, values[name])) for name, kind in kinds.items() if name in values
    }
    each = {
        camera: from_mapping(BackgroundConfig, _known(BackgroundConfig, section))
        for camera, section in values.get("background_of", {}).items()
    }
    return OfflineConfig(**found, background_of=each)


def open_recording(run: Run, folder: Path, recording: Path | None = None, background: str | None = None) -> Source:
    """The source that the run was made from.

    Args:
        run: the results.
        folder: where they are.
        recording: where the recording is now, if it is not where it was.
        background: as `limbloc process --background`, if it is not where it was.

    Raises:
        InputError: the recording is gone, or cannot be read.
    """
    path = recording or Path(str(run.about.get("input", "")))
    if recording is None and not (run.about.get("input") and path.exists()):
        raise InputError(
            f"the run's recording {path} is not there; say where it is now with --recording (bag, folder or case)"
        )
    kind, now_a_bag = run.about.get("kind", ""), path.exists() and is_bag(path)
    if background is None and now_a_bag == (kind == "bag"):  # a bag of masks may stand for the videos it was made of
        background = run.about.get("background_from")
    return open_source(
        path,
        rig_of(folder),
        config_of(run),
        background=background,
        masks=kind == "silhouettes" and not now_a_bag,
        fps=float(run.about["fps"]) if "fps" in run.about and not now_a_bag else None,
    )


def recorded_frames(source: Source, run: Run) -> Iterator[tuple[int, MaskSet]]:
    """Number of the run's frame, and its masks and images, in order; found by their stamps.

    Raises:
        InputError: not one frame of the recording has a stamp of the run.
    """
    numbers = {frame.stamp_ns: number for number, frame in enumerate(run.frames)}
    found = 0
    for masks in source.mask_sets():
        number = numbers.get(masks.stamp_ns)
        if number is not None:
            found += 1
            yield number, masks
    if not found:
        raise InputError(f"{source.about['input']} has no frame with a stamp of this run; is it another recording?")


def _known(kind: type[Any], section: dict[str, Any]) -> dict[str, Any]:
    """Without parameters that another version had."""
    names = {f.name for f in fields(kind)}
    return {name: value for name, value in section.items() if name in names}
