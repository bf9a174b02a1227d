# SPDX-License-Identifier: Apache-2.0
"""Qualisys' `.qca.txt`: XML, millimetres, pixels in 1/64, camera axes x right, y up, z backwards.

`transform` holds the camera's position x y z in the world, and r11 ... r33 column by column of the rotation from the
camera's axes to the world's.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core.camera import Rig
from limbloc_ros.core.errors import RigError
from limbloc_ros.files import write_text
from limbloc_ros.rig.formats.common import (
    CAMERA_TO_WORLD,
    Format,
    FoundCamera,
    Reading,
    five_coefficients,
    only_file,
    polynomial_model,
)
from limbloc_ros.rig.plain_values import read_text, usable

#: Qualisys counts in 64 parts of a pixel.
SUBPIXELS = 64.0
#: From its camera axes to OpenCV's: y and z are turned round.
_AXES = np.diag([1.0, -1.0, -1.0])


def read(paths: Sequence[Path]) -> Reading:
    """Read one file; cameras without an image (marker cameras keep their fov_video too) are all taken."""
    path = only_file(paths, "a Qualisys calibration")
    text = read_text(path, "calibration", "the .qca.txt in it")
    try:
        root = ET.fromstring(text)
    except (ET.ParseError, ValueError) as error:  # ValueError: an encoding that Python does not know
        raise RigError(f"calibration {path}: not valid XML: {error}") from None
    entries = root.findall("cameras/camera")
    if not any(entry.get("active", "1") == "1" for entry in entries):
        raise RigError(f"calibration {path}: expected <cameras><camera ...>, found no active camera")
    notes = []
    inactive = [_serial(entry, i) for i, entry in enumerate(entries) if entry.get("active", "1") != "1"]
    if inactive:
        notes.append(f"inactive cameras were left out: {', '.join(inactive)}")
    cameras = tuple(
        _camera(entry, _serial(entry, i), str(path))
        for i, entry in enumerate(entries)
        if entry.get("active", "1") == "1"
    )
    return Reading(str(path), cameras, CAMERA_TO_WORLD, 0.001, "room", notes)


def _serial(entry: ET.Element, index: int) -> str:
    return entry.get("serial") or f"cam{index + 1}"


def _camera(entry: ET.Element, name: str, source: str) -> FoundCamera:
    at = f"{source}: camera {name}"
    left, top, right, bottom = _floats(entry, "fov_video", ("left", "top", "right", "bottom"), at)
    fu, fv, cu, cv = _floats(
        entry, "intrinsic", ("focalLengthU", "focalLengthV", "centerPointU", "centerPointV"), at
    ) / SUBPIXELS  # fmt: skip
    k1, k2, k3 = _floats(entry, "intrinsic", tuple(f"radialDistortion{i}" for i in (1, 2, 3)), at)
    p1, p2 = _floats(entry, "intrinsic", ("tangentalDistortion1", "tangentalDistortion2"), at)
    r = _floats(entry, "transform", tuple(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)), at).reshape(3, 3)
    T = np.eye(4)
    T[:3, :3] = r.T @ _AXES
    T[:3, 3] = _floats(entry, "transform", ("x", "y", "z"), at)
    distortion, lens = polynomial_model(np.array([k1, k2, p1, p2, k3]), at)
    K = np.array([[fu, 0.0, cu - left], [0.0, fv, cv - top], [0.0, 0.0, 1.0]])
    return FoundCamera(name, (int(right - left) + 1, int(bottom - top) + 1), K, distortion, lens, T)


def _floats(entry: ET.Element, tag: str, keys: Sequence[str], at: str) -> NDArray[np.float64]:
    element = entry.find(tag)
    if element is None:
        raise RigError(f"{at}: expected <{tag} ...>, it is missing")
    values = []
    for key in keys:
        text = element.get(key)
        try:
            values.append(float(text if text is not None else "missing"))
        except ValueError:
            raise RigError(f"{at}: <{tag}> {key}: expected a number, got {text!r}") from None
    return usable(np.array(values), f"{at}: <{tag}>")


def write(rig: Rig, path: Path) -> list[str]:
    """Write a rig; the lens must be k1 k2 p1 p2 k3."""
    root = ET.Element("calibration", {"source": "limbloc", "type": "regular"})
    cameras = ET.SubElement(root, "cameras")
    for camera in rig.cameras:
        k1, k2, p1, p2, k3 = five_coefficients(camera, "a .qca.txt")
        entry = ET.SubElement(cameras, "camera", {"active": "1", "serial": camera.name, "viewrotation": "0"})
        view = {"left": 0, "top": 0, "right": camera.width - 1, "bottom": camera.height - 1}
        for tag in ("fov_marker", "fov_marker_max", "fov_video", "fov_video_max"):
            ET.SubElement(entry, tag, {key: str(value) for key, value in view.items()})
        r = (camera.T_world_camera[:3, :3] @ _AXES).T
        transform = {f"r{i + 1}{j + 1}": r[i, j] for i in range(3) for j in range(3)}
        transform |= dict(zip("xyz", 1000 * camera.T_world_camera[:3, 3], strict=True))
        ET.SubElement(entry, "transform", {key: repr(float(value)) for key, value in transform.items()})
        K = SUBPIXELS * camera.K
        intrinsic = {
            "focalLengthU": K[0, 0],
            "focalLengthV": K[1, 1],
            "centerPointU": K[0, 2],
            "centerPointV": K[1, 2],
            "sensorMinU": 0,
            "sensorMinV": 0,
            "sensorMaxU": SUBPIXELS * camera.width,
            "sensorMaxV": SUBPIXELS * camera.height,
            "skew": 0,
            "radialDistortion1": k1,
            "radialDistortion2": k2,
            "radialDistortion3": k3,
            "tangentalDistortion1": p1,
            "tangentalDistortion2": p2,
        }
        ET.SubElement(entry, "intrinsic", {key: repr(float(value)) for key, value in intrinsic.items()})
    ET.indent(root)
    write_text(path, ET.tostring(root, encoding="unicode", xml_declaration=True) + "\n")
    return ["a .qca.txt holds no carve volume and no regions to ignore"]


FORMAT = Format(
    "qualisys",
    "Qualisys' .qca.txt",
    lambda path, text: "<calibration" in text and "<camera" in text,
    read,
    write,
)
