# SPDX-License-Identifier: Apache-2.0
"""TOML of aniposelib, Pose2Sim (`Calib.toml`) and caliscope (`camera_array.toml`).

`rotation` (Rodrigues) and `translation` take world points to the camera. Pose2Sim and caliscope write metres;
aniposelib writes the unit of the board's squares, mostly millimetres: the file does not tell which.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2

from limbloc_ros.core.camera import Camera, Rig
from limbloc_ros.core.errors import RigError
from limbloc_ros.files import write_text
from limbloc_ros.rig.formats.common import (
    WORLD_TO_CAMERA,
    Format,
    FoundCamera,
    Reading,
    five_coefficients,
    image_size,
    matrix,
    only_file,
    polynomial_model,
    pose_from_entry,
    row,
)
from limbloc_ros.rig.plain_values import numbers, read_text, required


def read(paths: Sequence[Path]) -> Reading:
    """Read one file of any of the three tools."""
    path = only_file(paths, "a camera TOML")
    try:
        data = tomllib.loads(read_text(path, "calibration", "the .toml in it"))
    except (ValueError, RecursionError) as error:  # ValueError also: a number of 5000 digits
        raise RigError(f"calibration {path}: not valid TOML: {error}") from None
    nested = data.get("cameras")
    entries: Mapping[str, Any] = nested if isinstance(nested, Mapping) else data
    cameras = [
        _camera(str(entry.get("name", f"cam_{key}" if entries is nested else key)), entry, f"{path}: [{key}]")
        for key, entry in entries.items()
        if isinstance(entry, Mapping) and key != "metadata"
    ]
    if not cameras:
        raise RigError(f"{path}: expected cameras with size, matrix, distortions, rotation, translation, found none")
    return Reading(str(path), tuple(cameras), WORLD_TO_CAMERA, None, "any")


def _camera(name: str, entry: Mapping[str, Any], at: str) -> FoundCamera:
    distortion = numbers(required(entry, "distortions", at), None, f"{at}: key distortions")
    if entry.get("fisheye", False):
        if distortion.size != 4:
            raise RigError(f"{at}: expected 4 coefficients of a fisheye lens, got {distortion.size}")
        lens = "fisheye"
    else:
        distortion, lens = polynomial_model(distortion, f"{at}: key distortions")
    posed = "rotation" in entry or "translation" in entry
    if "null" in (entry.get("rotation"), entry.get("translation")):
        raise RigError(f"{at}: it has no pose (null): finish the extrinsic calibration first")
    return FoundCamera(
        name,
        image_size(required(entry, "size", at), f"{at}: key size"),
        numbers(required(entry, "matrix", at), (3, 3), f"{at}: key matrix"),
        distortion,
        lens,
        pose_from_entry(dict(entry), "rotation", "translation", at) if posed else None,
    )


def _lines(camera: Camera, what: str) -> list[str]:
    fisheye = camera.distortion_model == "fisheye"
    distortion = camera.distortion if fisheye else five_coefficients(camera, what)
    T = camera.T_camera_world
    return [
        f"size = [{camera.width}, {camera.height}]",
        f"matrix = {matrix(camera.K)}",
        f"distortions = {row(distortion)}",
        f"rotation = {row(cv2.Rodrigues(T[:3, :3])[0])}",
        f"translation = {row(T[:3, 3])}",
        f"fisheye = {'true' if fisheye else 'false'}",
    ]


def write(rig: Rig, path: Path) -> list[str]:
    """Write aniposelib's and Pose2Sim's layout, in metres."""
    lines: list[str] = []
    for i, camera in enumerate(rig.cameras):
        lines += [f"[cam_{i}]", f"name = {json.dumps(camera.name)}", *_lines(camera, "aniposelib's TOML"), ""]
    write_text(path, "\n".join([*lines, "[metadata]", "adjusted = false", "error = 0.0", ""]))
    return ["the TOML holds no carve volume and no regions to ignore; lengths are metres"]


def write_caliscope(rig: Rig, path: Path) -> list[str]:
    """Write caliscope's layout; its cameras are numbers, so they are numbered in the rig's order."""
    lines: list[str] = []
    for i, camera in enumerate(rig.cameras):
        head = [f"[cameras.{i}]", f"port = {i}", "rotation_count = 0", "ignore = false", "error = 0.0"]
        lines += [*head, *_lines(camera, "caliscope"), ""]
    write_text(path, "\n".join(lines))
    names = ", ".join(f"{i} = {camera.name}" for i, camera in enumerate(rig.cameras))
    return [f"caliscope numbers its cameras: {names}; the carve volume and regions to ignore are not held"]


def _is_caliscope(path: Path, text: str) -> bool:
    return path.suffix == ".toml" and "[cameras." in text


ANIPOSE = Format(
    "anipose",
    "Calib.toml of aniposelib and Pose2Sim",
    lambda path, text: path.suffix == ".toml" and not _is_caliscope(path, text),
    read,
    write,
)
CALISCOPE = Format("caliscope", "caliscope's camera_array.toml", _is_caliscope, read, write_caliscope)
