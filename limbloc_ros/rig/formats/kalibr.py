# SPDX-License-Identifier: Apache-2.0
"""Kalibr's camchain: pinhole cameras chained one to the next, with no world.

`T_cn_cnm1` takes coordinates in the camera before to this camera, metres. The first camera is the world.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from limbloc_ros.core.camera import Rig
from limbloc_ros.core.errors import RigError
from limbloc_ros.files import write_text
from limbloc_ros.rig.formats.common import (
    WORLD_TO_CAMERA,
    Format,
    FoundCamera,
    Reading,
    image_size,
    matrix,
    only_file,
    row,
)
from limbloc_ros.rig.plain_values import kind, numbers, read_values, required

_MODELS = {"radtan": "radtan", "equidistant": "fisheye", "none": "none"}


def read(paths: Sequence[Path]) -> Reading:
    """Read one camchain."""
    path = only_file(paths, "a Kalibr camchain")
    data = read_values(path, "camchain", "the camchain YAML in it")
    if not isinstance(data, Mapping):
        raise RigError(f"camchain {path}: expected cam0, cam1, ..., got {kind(data)}")
    names = sorted((name for name in data if str(name).startswith("cam")), key=_number)
    cameras: list[FoundCamera] = []
    T = np.eye(4)
    for name in names:
        at = f"{path}: {name}"
        entry = data[name]
        if not isinstance(entry, Mapping):
            raise RigError(f"{at}: expected camera_model, intrinsics, ..., got {kind(entry)}")
        if cameras:
            if "T_cn_cnm1" not in entry and "baseline_last_to_this_cam" in entry:  # before 2014
                entry = {**entry, "T_cn_cnm1": entry["baseline_last_to_this_cam"]}
            T = numbers(required(entry, "T_cn_cnm1", at), (4, 4), f"{at}: key T_cn_cnm1") @ T
        cameras.append(_camera(str(name), entry, T, at))
    if not cameras:
        raise RigError(f"camchain {path}: expected cam0, cam1, ..., found {', '.join(map(str, data)) or 'nothing'}")
    return Reading(str(path), tuple(cameras), WORLD_TO_CAMERA, 1.0, "first camera")


def _number(name: Any) -> tuple[int, str]:
    digits = "".join(c for c in str(name) if c.isdigit())
    return int(digits) if digits else -1, str(name)


def _camera(name: str, entry: Mapping[str, Any], T: np.ndarray[Any, Any], at: str) -> FoundCamera:
    model = required(entry, "camera_model", at)
    if model != "pinhole":
        raise RigError(f"{at}: expected camera_model pinhole, got {kind(model)}; use pinhole-radtan or -equi")
    lens = entry.get("distortion_model", "none")
    if not isinstance(lens, str) or lens not in _MODELS:
        raise RigError(f"{at}: expected distortion_model {', '.join(_MODELS)}, got {kind(lens)}")
    fu, fv, pu, pv = numbers(required(entry, "intrinsics", at), (4,), f"{at}: key intrinsics")
    coefficients = numbers(entry.get("distortion_coeffs", []), None, f"{at}: key distortion_coeffs")
    return FoundCamera(
        name,
        image_size(required(entry, "resolution", at), f"{at}: key resolution"),
        np.array([[fu, 0, pu], [0, fv, pv], [0, 0, 1.0]]),
        coefficients if lens != "none" else np.zeros(0),
        _MODELS[lens],
        T,
    )


def write(rig: Rig, path: Path) -> list[str]:
    """Write a chain cam0, cam1, ...; the rig's camera names become the topics."""
    lines: list[str] = []
    before = np.eye(4)
    for i, camera in enumerate(rig.cameras):
        lens = {"none": "none", "radtan": "radtan", "fisheye": "equidistant"}.get(camera.distortion_model)
        if lens is None or (lens == "radtan" and camera.distortion[4:].any()):
            raise RigError(
                f"camera {camera.name}: Kalibr holds k1 k2 p1 p2 or equidistant, not {camera.distortion_model} with "
                f"{camera.distortion.size} coefficients"
            )
        lines.append(f"cam{i}:")
        if i:
            lines.append(f"  T_cn_cnm1: {matrix(camera.T_camera_world @ before)}")
        before = camera.T_world_camera
        K = camera.K
        lines += [
            "  camera_model: pinhole",
            f"  distortion_coeffs: {row(camera.distortion[:4])}",
            f"  distortion_model: {lens}",
            f"  intrinsics: {row([K[0, 0], K[1, 1], K[0, 2], K[1, 2]])}",
            f"  resolution: [{camera.width}, {camera.height}]",
            f"  rostopic: {json.dumps(f'/{camera.name}/image_raw')}",
        ]
    write_text(path, "\n".join(lines) + "\n")
    return ["a camchain holds no world: where the floor is and what is up are lost, and so is the carve volume"]


FORMAT = Format(
    "kalibr",
    "Kalibr's camchain.yaml",
    lambda path, text: path.suffix in (".yaml", ".yml") and "camera_model:" in text and "intrinsics:" in text,
    read,
    write,
)
