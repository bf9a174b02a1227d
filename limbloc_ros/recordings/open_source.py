# SPDX-License-Identifier: Apache-2.0
"""A path on disk -> the source that can read it: benchmark case, bag, or videos and pictures of each camera."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core.camera import Rig
from limbloc_ros.core.errors import InputError
from limbloc_ros.recordings.bags import is_bag
from limbloc_ros.recordings.cases import is_case, load_case
from limbloc_ros.recordings.folder_source import ESTIMATE, FolderSource
from limbloc_ros.recordings.offline import OfflineConfig
from limbloc_ros.recordings.sources import BagSource, CaseSource, Source, check_size
from limbloc_ros.recordings.videos import pictures_in, read_picture

Pixels = NDArray[np.uint8]


def open_source(
    path: Path,
    rig: Rig | None,
    config: OfflineConfig,
    *,
    background: str | None = None,
    masks: bool = False,
    fps: float | None = None,
) -> Source:
    """Open a recording, whatever it is.

    Args:
        path: bag (folder or file), folder of videos or image folders, or benchmark case.
        rig: the cameras; only a benchmark case can do without.
        config: all parameters.
        background: folder with a picture of the empty room per camera, `estimate`, or None: learn it first.
        masks: the videos or images are silhouettes already.
        fps: frame rate of image folders, Hz.

    Raises:
        InputError: there is nothing, or nothing that can be read; or an option that this kind of input cannot use.
        RigError: a case's calib.json is malformed.
    """
    source = _open(path, rig, config, background, masks, fps)
    # What it takes to open it again from elsewhere; parameters and rig are kept beside it.
    source.about["input"] = str(path.absolute())
    if background is not None:
        source.about["background_from"] = background if background == ESTIMATE else str(Path(background).absolute())
    return source


def _open(
    path: Path, rig: Rig | None, config: OfflineConfig, background: str | None, masks: bool, fps: float | None
) -> Source:
    if not path.exists():
        raise InputError(f"{path} does not exist; expected a bag, a folder of videos or images, or a benchmark case")
    if path.is_dir() and is_case(path):
        if background or masks or fps:
            raise InputError(
                f"{path} is a benchmark case, whose masks.npz is read as it is: leave --background, --masks and --fps "
                "away (or give the folder of its images as INPUT)"
            )
        return CaseSource(load_case(path, rig))
    if rig is None:
        raise InputError(f"{path} needs --rig: a rig YAML or calib.json with the calibrated cameras")
    for name in config.background_of:
        rig.camera(name)
    backgrounds = {name: config.background_of.get(name, config.background) for name in rig.names}
    pictures: dict[str, Pixels] = {}
    if background is not None and background != ESTIMATE:
        pictures = background_pictures(Path(background), rig)
    if is_bag(path):
        if masks or fps or background == ESTIMATE:
            raise InputError(
                f"{path} is a bag, which says itself what it holds: leave --masks, --fps and estimate away"
            )
        return BagSource(path, rig, backgrounds, config.sync, config.hull.min_cameras, pictures)
    if path.is_file():
        raise InputError(
            f"{path}: expected a bag (.mcap, .db3) or a folder; give the folder that holds all cameras' videos"
        )
    if masks and background:
        raise InputError("--masks: silhouettes need no --background; leave one of them away")
    return FolderSource(path, rig, backgrounds, pictures, estimate=background == ESTIMATE, are_masks=masks, fps=fps)


def background_pictures(folder: Path, rig: Rig) -> dict[str, Pixels]:
    """Camera name -> picture of the empty room, bgr, for every camera of the rig.

    Raises:
        InputError: no such folder, a camera without a picture, or a picture of the wrong size.
    """
    if not folder.is_dir():
        raise InputError(f"--background {folder}: expected a folder with a picture per camera, or the word {ESTIMATE}")
    found = {picture.stem: picture for picture in pictures_in(folder)}
    missing = [name for name in rig.names if name not in found]
    if missing:
        raise InputError(
            f"--background {folder}: no picture of camera {', '.join(missing)}; expected files such as "
            f"{missing[0]}.png, found {', '.join(p.name for p in found.values()) or 'none'}"
        )
    pictures = {}
    for name in rig.names:
        pictures[name] = read_picture(found[name])
        check_size(pictures[name], rig, name, str(found[name]))
    return pictures
