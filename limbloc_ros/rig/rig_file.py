# SPDX-License-Identifier: Apache-2.0
"""The rig file: the calibrated cameras of a room and the box of space that is carved.

Our own format is YAML (see `docs/rig_file.md` for a commented example)::

    version: 1
    units: m                       # nothing else is accepted: a rig in millimetres is a common accident
    volume:                        # optional; without it the box is derived from what the cameras see
      min: [-1.5, -1.5, 0.0]       # world axes: z up, the floor at z = 0
      max: [1.5, 1.5, 2.5]
    cameras:
      - name: cam0                 # also the prefix of its topics: cam0/image_raw
        width: 640
        height: 480
        K: [[518.4, 0, 319.5], [0, 518.4, 239.5], [0, 0, 1]]     # px, pixel centres at integers
        distortion_model: radtan   # none, radtan (plumb_bob), rational (rational_polynomial), fisheye (equidistant)
        distortion: [0.1, -0.05, 0, 0, 0]                        # OpenCV's order
        T_world_camera:            # pose of the optical frame (x right, y down, z forward); or a 4x4 matrix
          translation: [2.0, 0.0, 1.5]
          quaternion: [0.5, 0.5, -0.5, -0.5]                     # x y z w
        ignore:                    # optional: polygons of pixels where foreground means nothing (a screen, a window)
          - [[10, 20], [110, 20], [110, 90], [10, 90]]
        ignore_mask: masks/cam0.png   # or a picture of the camera's size beside this file; not black = ignore

A benchmark's `calib.json` (`R`, `t` with x_cam = R X + t, and `dist`) is read by the same function.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core.camera import DISTORTION_COEFFICIENTS, Camera, Rig
from limbloc_ros.core.errors import RigError
from limbloc_ros.files import write_text
from limbloc_ros.rig.geometry import rotation_of
from limbloc_ros.rig.plain_values import kind, known_keys, numbers, parse, read_text, required
from limbloc_ros.rig.volume import derive_volume

Array = NDArray[np.float64]

VERSION = 1

#: Other people's names of the distortion models.
MODEL_ALIASES = {
    "plumb_bob": "radtan",
    "rational_polynomial": "rational",
    "equidistant": "fisheye",
    "pinhole": "none",
    "": "none",
}

_RIG_KEYS = ("version", "units", "volume", "cameras")
_CAMERA_KEYS = (
    "name",
    "width",
    "height",
    "K",
    "distortion_model",
    "distortion",
    "T_world_camera",
    "ignore",
    "ignore_mask",
)


def load_rig(path: str | Path) -> Rig:
    """Read a rig file: our YAML, or a benchmark's `calib.json`.

    Raises:
        RigError: the file is missing or unreadable, its syntax is wrong (with the line), or a key is missing, unknown
            or of the wrong kind (which key, what was expected, what came).
    """
    path = Path(path)
    text = read_text(path, "rig file", "the .yaml or calib.json in it")
    return rig_from_mapping(parse(text, path, "rig file"), str(path), path.parent)


def rig_from_mapping(data: Any, source: str = "rig", folder: Path | None = None) -> Rig:
    """Build the rig from the plain values of a rig file.

    Args:
        data: what YAML or JSON made of the file.
        source: how messages call the file.
        folder: where the pictures of regions to ignore are looked for; the working folder if None.

    Raises:
        RigError: which key, what was expected, what came.
    """
    if not isinstance(data, Mapping):
        raise RigError(f"{source}: expected keys {', '.join(_RIG_KEYS)}, got {kind(data)}")
    entries = data.get("cameras")
    if not isinstance(entries, Sequence) or isinstance(entries, str) or not entries:
        raise RigError(f"{source}: key cameras: expected a list of at least one camera, got {kind(entries)}")
    where = [f"{source}: cameras[{i}]" for i in range(len(entries))]
    for entry, at in zip(entries, where, strict=True):
        if not isinstance(entry, Mapping):
            raise RigError(f"{at}: expected a camera with name, width, height, K, T_world_camera, got {kind(entry)}")
    benchmark = all("R" in entry and "t" in entry and "T_world_camera" not in entry for entry in entries)
    if not benchmark:
        known_keys(data, _RIG_KEYS, source)
        version = data.get("version")
        if version != VERSION or isinstance(version, bool):
            raise RigError(f"{source}: key version: expected {VERSION}, got {kind(version)}")
        if data.get("units", "m") != "m":
            raise RigError(
                f"{source}: key units: expected m (metres), got {data['units']!r}; convert the file to metres"
            )
    try:
        cameras = tuple(
            _benchmark_camera(entry, at) if benchmark else _our_camera(entry, at, folder or Path())
            for entry, at in zip(entries, where, strict=True)
        )
        low, high = _volume(data["volume"], source) if "volume" in data else derive_volume(cameras)
        return Rig(cameras, low, high)
    except RigError as error:
        message = str(error)
        raise RigError(message if message.startswith(source) else f"{source}: {message}") from None


def save_rig(rig: Rig, path: str | Path) -> None:
    """Write `rig` as our YAML; `load_rig` gives back the same numbers, bit for bit.

    Raises:
        OutputError: the file cannot be written.
    """
    lines = [
        "# Cameras of a room for limbloc_ros. World: z up, floor at z = 0, metres.",
        "# T_world_camera: pose of the optical frame (x right, y down, z forward). Pixel centres at integers.",
        f"version: {VERSION}",
        "units: m",
        f"volume: {{min: {_row(rig.volume_min)}, max: {_row(rig.volume_max)}}}",
        "cameras:",
    ]
    for camera in rig.cameras:
        lines += [
            f"  - name: {json.dumps(camera.name)}",
            f"    width: {camera.width}",
            f"    height: {camera.height}",
            "    K:",
            *(f"      - {_row(row)}" for row in camera.K),
            f"    distortion_model: {camera.distortion_model}",
            f"    distortion: {_row(camera.distortion)}",
            "    T_world_camera:",
            *(f"      - {_row(row)}" for row in camera.T_world_camera),
            *(["    ignore:"] if camera.ignore else []),
            *(f"      - [{', '.join(_row(point) for point in polygon)}]" for polygon in camera.ignore),
        ]
    write_text(Path(path), "\n".join(lines) + "\n")


def _our_camera(entry: Mapping[str, Any], at: str, folder: Path) -> Camera:
    name = _name(entry, at)
    at = f"{at} ({name})"
    known_keys(entry, _CAMERA_KEYS, at)
    coefficients = numbers(entry.get("distortion", []), None, f"{at}: key distortion")
    model = entry.get("distortion_model", "radtan" if coefficients.size else "none")
    if not isinstance(model, str) or MODEL_ALIASES.get(model, model) not in DISTORTION_COEFFICIENTS:
        names = ", ".join([*DISTORTION_COEFFICIENTS, *(alias for alias in MODEL_ALIASES if alias)])
        raise RigError(f"{at}: key distortion_model: expected one of {names}, got {kind(model)}")
    width, height = _pixels(entry, "width", at), _pixels(entry, "height", at)
    ignore = _polygons(entry.get("ignore", []), f"{at}: key ignore")
    if "ignore_mask" in entry:
        ignore += _mask_polygons(entry["ignore_mask"], folder, (width, height), f"{at}: key ignore_mask")
    return Camera(
        name,
        width,
        height,
        _intrinsics(entry, at),
        _camera_pose(required(entry, "T_world_camera", at), at),
        coefficients,
        MODEL_ALIASES.get(model, model),
        tuple(ignore),
    )


def _polygons(value: Any, at: str) -> list[Array]:
    """Polygons of pixels, [N, 2] each."""
    if not isinstance(value, Sequence) or isinstance(value, str):
        raise RigError(f"{at}: expected a list of polygons [[x, y], [x, y], [x, y], ...], got {kind(value)}")
    polygons = [numbers(polygon, None, f"{at}[{i}]", pairs=True) for i, polygon in enumerate(value)]
    for i, polygon in enumerate(polygons):
        if len(polygon) < 3:
            raise RigError(f"{at}[{i}]: expected three or more points [x, y] in px, got {polygon.tolist()}")
    return polygons


def _mask_polygons(value: Any, folder: Path, size: tuple[int, int], at: str) -> list[Array]:
    """The outlines of what is not black in a picture: filled, they give the same pixels again."""
    if not isinstance(value, str) or not value:
        raise RigError(f"{at}: expected the path of a picture, got {kind(value)}")
    path = folder / value
    picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) if path.is_file() else None
    if picture is None:
        raise RigError(
            f"{at}: {path} is missing or no picture; expected a PNG, white where the camera is to be ignored"
        )
    if picture.shape != size[::-1]:
        raise RigError(
            f"{at}: {path}: expected {size[0]}x{size[1]} px like the camera's images, got "
            f"{picture.shape[1]}x{picture.shape[0]}"
        )
    outlines, _ = cv2.findContours((picture > 0).astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    # An outline of one or two pixels is closed by repeating them.
    return [np.resize(o[:, 0].astype(np.float64), (max(len(o), 3), 2)) for o in outlines]


def _benchmark_camera(entry: Mapping[str, Any], at: str) -> Camera:
    name = _name(entry, at)
    at = f"{at} ({name})"
    R = numbers(entry["R"], (3, 3), f"{at}: key R")
    t = numbers(entry["t"], (3,), f"{at}: key t")
    dist = numbers(entry.get("dist", []), None, f"{at}: key dist")
    T = np.eye(4)
    T[:3, :3] = R.T
    T[:3, 3] = -R.T @ t
    model = "none" if not dist.any() else "radtan" if dist.size <= 5 else "rational"
    return Camera(
        name,
        _pixels(entry, "width", at),
        _pixels(entry, "height", at),
        _intrinsics(entry, at),
        T,
        np.zeros(0) if model == "none" else dist,
        model,
    )


def _name(entry: Mapping[str, Any], at: str) -> str:
    name = required(entry, "name", at)
    if not isinstance(name, str) or not name:
        raise RigError(f"{at}: key name: expected text such as cam0, got {kind(name)}")
    return name


def _pixels(entry: Mapping[str, Any], key: str, at: str) -> int:
    value = required(entry, key, at)
    if isinstance(value, bool) or not isinstance(value, int):
        raise RigError(f"{at}: key {key}: expected a whole number of pixels, got {kind(value)}")
    return value


def _intrinsics(entry: Mapping[str, Any], at: str) -> Array:
    """K as three rows, or as ROS writes it: nine numbers in a row."""
    K = numbers(required(entry, "K", at), (3, 3), f"{at}: key K")
    if K[2].tolist() != [0.0, 0.0, 1.0] and K.any():  # an all-zero K gets the message of Camera, which explains it
        raise RigError(f"{at}: key K: expected the last row 0 0 1, got {K[2].tolist()}")
    return K


def _camera_pose(value: Any, at: str) -> Array:
    """T_world_camera from a 4x4 matrix (nested or flat) or from translation and quaternion."""
    at = f"{at}: key T_world_camera"
    if not isinstance(value, Mapping):
        T = numbers(value, (4, 4), at)
        if np.abs(T[3] - [0.0, 0.0, 0.0, 1.0]).max() > 1e-9:
            raise RigError(f"{at}: expected the last row 0 0 0 1, got {T[3].tolist()}; is the matrix transposed?")
        return T
    known_keys(value, ("translation", "quaternion"), at)
    quaternion = numbers(required(value, "quaternion", at), (4,), f"{at}.quaternion")
    length = float(np.linalg.norm(quaternion))
    if abs(length - 1.0) > 1e-3:
        raise RigError(
            f"{at}.quaternion: expected x y z w of length 1, got {quaternion.tolist()} of length {length:.4g}"
        )
    T = np.eye(4)
    T[:3, :3] = rotation_of(quaternion / length)
    T[:3, 3] = numbers(required(value, "translation", at), (3,), f"{at}.translation")
    return T


def _volume(value: Any, source: str) -> tuple[Array, Array]:
    at = f"{source}: key volume"
    if not isinstance(value, Mapping):
        raise RigError(f"{at}: expected min and max corners, got {kind(value)}")
    known_keys(value, ("min", "max"), at)
    low, high = (numbers(required(value, key, at), (3,), f"{at}.{key}") for key in ("min", "max"))
    return low, high


def _row(values: Array) -> str:
    return f"[{', '.join(repr(float(v)) for v in values)}]"
