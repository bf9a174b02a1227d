# SPDX-License-Identifier: Apache-2.0
"""`calib.json` of the benchmark: a list of cameras with K, dist, R and t, x_cam = R X + t, metres, z up."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from limbloc_ros.core.camera import Rig
from limbloc_ros.core.errors import RigError
from limbloc_ros.files import write_text
from limbloc_ros.rig.formats.common import WORLD_TO_CAMERA, Format, FoundCamera, Reading, only_file
from limbloc_ros.rig.rig_file import load_rig


def read(paths: Sequence[Path]) -> Reading:
    """Read one file; it is also what `load_rig` reads directly."""
    path = only_file(paths, "calib.json")
    cameras = tuple(
        FoundCamera(c.name, (c.width, c.height), c.K, c.distortion, c.distortion_model, c.T_camera_world)
        for c in load_rig(path).cameras
    )
    return Reading(str(path), cameras, WORLD_TO_CAMERA, 1.0, "room")


def write(rig: Rig, path: Path) -> list[str]:
    """Write a rig; the lens must be OpenCV's polynomial."""
    cameras = []
    for camera in rig.cameras:
        if camera.distortion_model == "fisheye":
            raise RigError(f"camera {camera.name}: calib.json cannot hold fisheye distortion")
        cameras.append(
            {
                "name": camera.name,
                "width": camera.width,
                "height": camera.height,
                "K": camera.K.tolist(),
                "dist": camera.distortion.tolist(),
                "R": camera.T_camera_world[:3, :3].tolist(),
                "t": camera.T_camera_world[:3, 3].tolist(),
            }
        )
    write_text(path, json.dumps({"cameras": cameras}, indent=1) + "\n")
    return ["calib.json holds no carve volume and no regions to ignore"]


FORMAT = Format(
    "benchmark",
    "the benchmark's calib.json",
    lambda path, text: path.suffix == ".json" and '"R"' in text and '"t"' in text and '"camera_poses"' not in text,
    read,
    write,
)
