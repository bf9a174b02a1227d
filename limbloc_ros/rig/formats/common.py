# SPDX-License-Identifier: Apache-2.0
"""What every calibration format has in common: a reader that says what a file holds, as it stands, and a writer."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core.camera import Camera, Rig
from limbloc_ros.core.errors import RigError
from limbloc_ros.rig.plain_values import flattened, kind, numbers, required

Array = NDArray[np.float64]

#: What a format's pose matrix does with a point: p_camera = T p_world, or p_world = T p_camera.
WORLD_TO_CAMERA, CAMERA_TO_WORLD = "world-to-camera", "camera-to-world"


@dataclass(frozen=True)
class FoundCamera:
    """One camera as a calibration file has it.

    Attributes:
        name: its name there.
        size: width, height in px; None where the format does not say.
        K: [3, 3] px.
        distortion, model: as in `core.camera.Camera`.
        T: [4, 4] pose in the file's unit, direction and world; the camera's axes are x right, y down, z forward. None
            where the format holds none.
    """

    name: str
    size: tuple[int, int] | None
    K: Array
    distortion: Array
    model: str
    T: Array | None


@dataclass(frozen=True)
class Reading:
    """What a calibration file says, before anything is converted.

    Attributes:
        source: how messages call it.
        cameras: in the file's order.
        direction: what the format documents: WORLD_TO_CAMERA or CAMERA_TO_WORLD.
        unit_m: metres in a unit of length, None where the format leaves it open.
        world: what the format documents about the world's axes: `room` (z up, floor at 0), `any` or `first camera`.
        notes: what a person should know.
    """

    source: str
    cameras: tuple[FoundCamera, ...]
    direction: str
    unit_m: float | None
    world: str
    notes: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Format:
    """A calibration format.

    Attributes:
        name: for `--format`.
        title: the tool and its file, in words.
        recognises: whether a file (path, its first 4000 characters) is of this format.
        read: files (most formats: one) -> Reading. Raises RigError.
        write: rig, path -> notes on what the format cannot hold; None when it cannot hold a room. Raises RigError for
            a camera that it cannot hold, OutputError when the file cannot be written.
    """

    name: str
    title: str
    recognises: Callable[[Path, str], bool]
    read: Callable[[Sequence[Path]], Reading]
    write: Callable[[Rig, Path], list[str]] | None = None


def only_file(paths: Sequence[Path], what: str) -> Path:
    """The one file; raises RigError when there are more."""
    if len(paths) != 1:
        raise RigError(f"{what}: expected one file, got {len(paths)}: {', '.join(map(str, paths))}")
    return paths[0]


def polynomial_model(distortion: Array, at: str) -> tuple[Array, str]:
    """OpenCV's coefficients k1 k2 p1 p2 [k3 [k4 k5 k6 [...]]] -> those that `Camera` takes, and the model.

    Raises:
        RigError: a number of coefficients that OpenCV does not have.
    """
    if not distortion.any():
        return np.zeros(0), "none"
    if distortion.size in (1, 2, 3):  # k1, or k1 k2, or k1 k2 p1: the others are zero
        return np.concatenate([distortion, np.zeros(4 - distortion.size)]), "radtan"
    if distortion.size in (4, 5):
        return distortion, "radtan"
    if distortion.size in (8, 12, 14):
        return distortion, "rational"
    raise RigError(f"{at}: expected 4, 5, 8, 12 or 14 distortion coefficients in OpenCV's order, got {distortion.size}")


def image_size(value: Any, at: str) -> tuple[int, int]:
    """Width, height out of two numbers, which may be written 1088.0."""
    pair = numbers(value, (2,), at)
    if (pair != np.round(pair)).any() or (pair < 1).any():
        raise RigError(f"{at}: expected a width and a height in whole pixels, got {kind(value)}")
    return int(pair[0]), int(pair[1])


def pose_from_vectors(rotation: Array, translation: Array) -> Array:
    """[4, 4] of a Rodrigues vector [3] or a matrix [3, 3], and a translation [3]."""
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(rotation)[0] if rotation.size == 3 else rotation
    T[:3, 3] = translation
    return T


def pose_from_entry(entry: dict[str, Any], rotation: str, translation: str, at: str) -> Array:
    """[4, 4] out of two keys of a mapping: rotation (Rodrigues vector or matrix) and translation."""
    values = flattened(required(entry, rotation, at))
    R = numbers(values, (3,) if len(values) == 3 else (3, 3), f"{at}: key {rotation}")
    t = numbers(flattened(required(entry, translation, at)), (3,), f"{at}: key {translation}")
    return pose_from_vectors(R, t)


def five_coefficients(camera: Camera, what: str) -> Array:
    """k1 k2 p1 p2 k3 for a format that holds no more.

    Raises:
        RigError: the camera has another lens model.
    """
    if camera.distortion_model not in ("none", "radtan"):
        raise RigError(
            f"camera {camera.name}: {what} cannot hold {camera.distortion_model} distortion, only k1 k2 p1 p2 k3"
        )
    out = np.zeros(5)
    out[: camera.distortion.size] = camera.distortion
    return out


def row(values: Any) -> str:
    """Numbers as a list that YAML, JSON and TOML all read, to the last bit."""
    return f"[{', '.join(repr(float(v)) for v in np.ravel(values))}]"


def matrix(values: Array) -> str:
    """A matrix as a list of rows."""
    return f"[{', '.join(row(line) for line in values)}]"
