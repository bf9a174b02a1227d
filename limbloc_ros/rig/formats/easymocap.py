# SPDX-License-Identifier: Apache-2.0
"""EasyMocap's `intri.yml` and `extri.yml` (OpenCV's FileStorage): x_cam = R X + T, mostly metres."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core.camera import Rig
from limbloc_ros.core.errors import OutputError, RigError
from limbloc_ros.rig.formats.common import (
    WORLD_TO_CAMERA,
    Format,
    FoundCamera,
    Reading,
    five_coefficients,
    polynomial_model,
    pose_from_vectors,
)

_FILES = ("intri.yml", "extri.yml")


def read(paths: Sequence[Path]) -> Reading:
    """Read both files: of a folder that holds them, or given one by one."""
    intri, extri = _both(paths)
    notes = []
    with _Storage(intri) as inner, _Storage(extri) as outer:
        posed, cameras = outer.names(), []
        for name in inner.names():
            if name not in posed:
                notes.append(f"camera {name} is in {intri.name} only and was left out: it has no pose")
                continue
            at = f"{intri}: camera {name}"
            distortion, lens = polynomial_model(inner.matrix(f"dist_{name}").ravel(), at)
            rotation = outer.matrix(f"Rot_{name}" if outer.has(f"Rot_{name}") else f"R_{name}")
            T = pose_from_vectors(rotation, outer.matrix(f"T_{name}").ravel())
            size = None
            if inner.has(f"H_{name}") and inner.has(f"W_{name}"):
                size = (int(inner.number(f"W_{name}")), int(inner.number(f"H_{name}")))
            cameras.append(FoundCamera(name, size, inner.matrix(f"K_{name}"), distortion, lens, T))
    if not cameras:
        raise RigError(f"{intri} and {extri} have no camera in common: {', '.join(posed) or 'none'} are posed")
    return Reading(str(intri.parent), tuple(cameras), WORLD_TO_CAMERA, None, "any", notes)


def _both(paths: Sequence[Path]) -> tuple[Path, Path]:
    found = []
    for path in paths:
        found += [path / name for name in _FILES] if path.is_dir() else [path]
    if len(found) == 1:  # the other lies beside it
        found = [found[0].with_name(name) for name in _FILES]
    missing = [path for path in found if not path.is_file()]
    if len(found) != 2 or missing:
        raise RigError(
            f"EasyMocap: expected intri.yml and extri.yml, or the folder that holds both; "
            f"missing: {', '.join(map(str, missing)) or 'one of them'}"
        )
    first, second = sorted(found, key=lambda path: path.name, reverse=True)
    return first, second


class _Storage:
    """An OpenCV FileStorage with messages."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __enter__(self) -> _Storage:
        try:
            self._file = cv2.FileStorage(str(self._path), cv2.FILE_STORAGE_READ)
        except (cv2.error, SystemError) as error:
            raise RigError(f"{self._path}: not a YAML file of OpenCV's FileStorage: {error}") from None
        if not self._file.isOpened():
            raise RigError(f"{self._path}: not a YAML file of OpenCV's FileStorage")
        return self

    def __exit__(self, *_: object) -> None:
        self._file.release()

    def names(self) -> list[str]:
        node = self._file.getNode("names")
        if node.empty():
            raise RigError(f"{self._path}: expected the list names, it is missing")
        return [node.at(i).string() for i in range(node.size())]

    def has(self, key: str) -> bool:
        return not self._file.getNode(key).empty()

    def number(self, key: str) -> float:
        return float(self._file.getNode(key).real())

    def matrix(self, key: str) -> NDArray[np.float64]:
        value = None if not self.has(key) else self._file.getNode(key).mat()
        if value is None:
            raise RigError(f"{self._path}: expected the matrix {key}, it is missing")
        return np.asarray(value, dtype=np.float64)


def write(rig: Rig, path: Path) -> list[str]:
    """Write both files into the folder `path`."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{path} cannot be made: {error.strerror}; EasyMocap's two files need a folder") from None
    inner, outer = (cv2.FileStorage(str(path / name), cv2.FILE_STORAGE_WRITE) for name in _FILES)
    if not (inner.isOpened() and outer.isOpened()):
        raise OutputError(f"{path}: {' and '.join(_FILES)} cannot be written")
    for file in (inner, outer):
        file.startWriteStruct("names", cv2.FileNode_SEQ)
        for camera in rig.cameras:
            file.write("", camera.name)
        file.endWriteStruct()
    for camera in rig.cameras:
        T = camera.T_camera_world
        inner.write(f"K_{camera.name}", camera.K)
        inner.write(f"dist_{camera.name}", five_coefficients(camera, "EasyMocap").reshape(1, 5))
        inner.write(f"H_{camera.name}", camera.height)
        inner.write(f"W_{camera.name}", camera.width)
        outer.write(f"R_{camera.name}", cv2.Rodrigues(T[:3, :3])[0])
        outer.write(f"Rot_{camera.name}", np.ascontiguousarray(T[:3, :3]))
        outer.write(f"T_{camera.name}", np.ascontiguousarray(T[:3, 3:]))
    inner.release()
    outer.release()
    return ["EasyMocap's files hold no carve volume and no regions to ignore; lengths are metres"]


FORMAT = Format(
    "easymocap",
    "EasyMocap's intri.yml and extri.yml, or their folder",
    lambda path, text: path.name in _FILES or (path.is_dir() and all((path / name).is_file() for name in _FILES)),
    read,
    write,
)
