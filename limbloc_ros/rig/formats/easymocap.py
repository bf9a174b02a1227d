# SPDX-License-Identifier: Apache-2.0
"""EasyMocap's `intri.yml` and `extri.yml` (OpenCV's FileStorage): x_cam = R X + T, mostly metres."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
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
    image_size,
    polynomial_model,
    pose_from_vectors,
)
from limbloc_ros.rig.plain_values import kind, numbers, read_text, required, yaml_values

_FILES = ("intri.yml", "extri.yml")


def read(paths: Sequence[Path]) -> Reading:
    """Read both files: of a folder that holds them, or given one by one."""
    intri, extri = _both(paths)
    notes = []
    inner, outer = _Storage(intri), _Storage(extri)
    posed, cameras = outer.names(), []
    for name in inner.names():
        if name not in posed:
            notes.append(f"camera {name} is in {intri.name} only and was left out: it has no pose")
            continue
        distortion, lens = polynomial_model(inner.matrix(f"dist_{name}"), f"{intri}: camera {name}")
        rotation = outer.matrix(f"Rot_{name}" if outer.has(f"Rot_{name}") else f"R_{name}", (3, 3), (3,))
        T = pose_from_vectors(rotation, outer.matrix(f"T_{name}", (3,)))
        size = inner.size(name) if inner.has(f"H_{name}") and inner.has(f"W_{name}") else None
        cameras.append(FoundCamera(name, size, inner.matrix(f"K_{name}", (3, 3)), distortion, lens, T))
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
    """A YAML file of OpenCV's FileStorage. Not read by OpenCV, whose parser crashes on damaged files."""

    def __init__(self, path: Path) -> None:
        self._path = path
        text = read_text(path, "calibration", "intri.yml and extri.yml in it")
        # OpenCV 3 and 4 begin with `%YAML:1.0`, which is no YAML.
        head, _, rest = text.partition("\n")
        try:
            values = yaml_values(rest if head.startswith("%YAML:") else text)
        except ValueError as error:
            raise RigError(f"{path}{error}") from None
        if not isinstance(values, Mapping):
            raise RigError(f"{path}: not a YAML file of OpenCV's FileStorage: expected names, ..., got {kind(values)}")
        self._values = values

    def names(self) -> list[str]:
        names = self._values.get("names")
        if not isinstance(names, list):
            raise RigError(f"{self._path}: expected the list names, got {kind(names)}")
        return [str(name) for name in names]

    def has(self, key: str) -> bool:
        return key in self._values

    def size(self, name: str) -> tuple[int, int]:
        """Width and height of a camera's images, px."""
        return image_size([self._values[f"W_{name}"], self._values[f"H_{name}"]], f"{self._path}: W_{name}, H_{name}")

    def matrix(self, key: str, *shapes: tuple[int, ...]) -> NDArray[np.float64]:
        """A matrix; of any size, or of one of the sizes `shapes`, each of another number of elements."""
        entry, at = self._values.get(key), f"{self._path}: matrix {key}"
        if not isinstance(entry, Mapping):
            raise RigError(f"{at}: expected rows, cols, dt and data, got {kind(entry)}")
        values = numbers(required(entry, "data", at), None, at)
        for shape in shapes:
            if values.size == math.prod(shape):
                return values.reshape(shape)
        if shapes:
            wanted = " or ".join("x".join(map(str, shape)) for shape in shapes)
            raise RigError(f"{at}: expected {wanted} numbers, got {values.size}")
        return values


def write(rig: Rig, path: Path) -> list[str]:
    """Write both files into the folder `path`."""
    if wrong := [camera.name for camera in rig.cameras if not re.fullmatch(r"[\w -]+", camera.name, re.ASCII)]:
        raise RigError(
            f"camera {', '.join(wrong)}: EasyMocap's files hold only names of letters, digits, `-`, `_` and spaces"
        )
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
