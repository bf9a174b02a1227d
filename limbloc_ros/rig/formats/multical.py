# SPDX-License-Identifier: Apache-2.0
"""multical's calibration.json: `cameras` and `camera_poses`, which take points of the reference frame to the camera.

A pose is called `cam2`, or `cam2_to_cam1` when cam1 is the reference; in spite of that name it is cam2's extrinsic
matrix, x_cam2 = R x_cam1 + T, as OpenCV's stereoCalibrate gives it. Lengths are in the unit of the board's file.
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
    only_file,
    polynomial_model,
    pose_from_entry,
)
from limbloc_ros.rig.plain_values import flattened, kind, numbers, read_values, required


def read(paths: Sequence[Path]) -> Reading:
    """Read one file."""
    path = only_file(paths, "multical's calibration.json")
    data = read_values(path, "multical file", "the calibration.json in it")
    entries = required(data, "cameras", str(path)) if isinstance(data, Mapping) else None
    if not isinstance(entries, Mapping) or not entries:
        raise RigError(f"{path}: key cameras: expected cameras by name, got {kind(entries)}")
    poses = _poses(data.get("camera_poses", {}), list(entries), str(path))
    cameras = []
    for name, entry in entries.items():
        at = f"{path}: cameras.{name}"
        if not isinstance(entry, Mapping):
            raise RigError(f"{at}: expected image_size, K, dist, got {kind(entry)}")
        model = entry.get("model", "standard")
        if model not in ("standard", "rational", "thin_prism", "tilted"):
            raise RigError(f"{at}: key model: expected standard, rational, thin_prism or tilted, got {kind(model)}")
        dist = numbers(flattened(required(entry, "dist", at)), None, f"{at}: key dist")
        coefficients, lens = polynomial_model(dist, f"{at}: key dist")
        cameras.append(
            FoundCamera(
                str(name),
                image_size(required(entry, "image_size", at), f"{at}: key image_size"),
                numbers(required(entry, "K", at), (3, 3), f"{at}: key K"),
                coefficients,
                lens,
                poses.get(str(name)),
            )
        )
    return Reading(str(path), tuple(cameras), WORLD_TO_CAMERA, None, "any")


def _poses(entries: Any, names: list[str], source: str) -> dict[str, Any]:
    """Camera -> [4, 4]; chains such as cam3_to_cam2, cam2_to_cam1 are followed."""
    if not isinstance(entries, Mapping):
        raise RigError(f"{source}: key camera_poses: expected poses by camera, got {kind(entries)}")
    links = {}
    for key, entry in entries.items():
        if not isinstance(entry, Mapping):
            raise RigError(f"{source}: camera_poses.{key}: expected R and T, got {kind(entry)}")
        T = pose_from_entry(dict(entry), "R", "T", f"{source}: camera_poses.{key}")
        pairs = [(a, b) for a in names for b in names if key == f"{a}_to_{b}"]
        if key not in names and len(pairs) != 1:
            raise RigError(f"{source}: camera_poses.{key}: expected CAMERA or CAMERA_to_CAMERA of {', '.join(names)}")
        links[key if key in names else pairs[0][0]] = (None if key in names else pairs[0][1], T)
    poses = {}
    for name in links:
        T, at, seen = np.eye(4), name, set()
        while at is not None:
            if at not in links or at in seen:
                raise RigError(f"{source}: camera_poses: {name} hangs on {at}, which has no pose")
            seen.add(at)
            at, link = links[at]
            T = T @ link
        poses[name] = T
    return poses


def write(rig: Rig, path: Path) -> list[str]:
    """Write a rig; the lens must be OpenCV's polynomial."""
    cameras, poses = {}, {}
    for camera in rig.cameras:
        if camera.distortion_model == "fisheye":
            raise RigError(f"camera {camera.name}: multical cannot hold fisheye distortion")
        long = camera.distortion_model == "rational"
        cameras[camera.name] = {
            "model": ("tilted" if camera.distortion.size == 14 else "thin_prism" if camera.distortion.size == 12 else
                      "rational") if long else "standard",
            "image_size": [camera.width, camera.height],
            "K": camera.K.tolist(),
            "dist": [(camera.distortion if camera.distortion.size else np.zeros(5)).tolist()],
        }  # fmt: skip
        T = camera.T_camera_world
        poses[camera.name] = {"R": T[:3, :3].tolist(), "T": T[:3, 3].tolist()}
    write_text(path, json.dumps({"cameras": cameras, "camera_poses": poses}, indent=2) + "\n")
    return ["multical's file holds no carve volume and no regions to ignore"]


FORMAT = Format(
    "multical",
    "multical's calibration.json",
    lambda path, text: path.suffix == ".json" and ('"image_size"' in text or '"camera_poses"' in text),
    read,
    write,
)
