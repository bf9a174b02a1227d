# SPDX-License-Identifier: Apache-2.0
"""The cameras that film the simulated room unless others are given."""

from __future__ import annotations

import math

import numpy as np

from limbloc_ros.core.camera import Camera, Rig
from limbloc_ros.core.errors import RigError
from limbloc_ros.rig.geometry import looking_at

# The cameras stand on this ring, between the door's sides; their heights repeat.
_RING_M = 2.75
_HEIGHTS_M = (2.4, 1.3, 2.8, 1.7, 2.1, 1.2, 2.6, 1.9)


def default_rig(n_cameras: int = 8, width: int = 640, height: int = 480) -> Rig:
    """A ring of cameras at heights of 1.2 to 2.8 m around a space of 3 x 3 m in a room of 6 x 6 m.

    They look at the centre from 2.75 m with a horizontal angle of view of 78 degrees and a slight barrel distortion;
    every camera differs a little from the others. The origin is the middle of the floor.

    Args:
        n_cameras: 2 to 16.
        width, height: image size in px.

    Raises:
        RigError: a number of cameras or an image size that is out of range.
    """
    if not 2 <= n_cameras <= 16:
        raise RigError(f"number of cameras: expected 2 to 16, got {n_cameras}")
    if not (64 <= width <= 8192 and 64 <= height <= 8192):
        raise RigError(f"image size: expected 64 to 8192 px on a side, got {width}x{height}")
    cameras = []
    for k in range(n_cameras):
        # The door is at angle pi: the first and the last camera stand on either side of it. Two cameras that face each
        # other would see one silhouette: put a pair at right angles.
        angle = math.pi + (2 * math.pi * (k + 0.5) / n_cameras if n_cameras > 2 else math.pi * (0.75 + 0.5 * k))
        shift = (k // len(_HEIGHTS_M)) * 3
        centre = np.array(
            [_RING_M * math.cos(angle), _RING_M * math.sin(angle), _HEIGHTS_M[(k + shift) % len(_HEIGHTS_M)]]
        )
        T = looking_at(centre, np.array([0.0, 0.0, 0.95]))
        focal = 0.62 * max(width, height * 4 / 3) * (1 + 0.012 * math.sin(2.3 * k))
        K = np.array(
            [
                [focal, 0.0, (width - 1) / 2 + 3 * math.sin(1.7 * k + 1)],
                [0.0, focal, (height - 1) / 2 + 3 * math.cos(2.9 * k)],
                [0.0, 0.0, 1.0],
            ]
        )
        distortion = np.array([-0.07 - 0.02 * math.sin(k + 0.5), 0.02 + 0.005 * math.cos(k), 0.0, 0.0])
        cameras.append(Camera(f"cam{k}", width, height, K, T, distortion, "radtan"))
    return Rig(tuple(cameras), np.array([-1.5, -1.5, 0.0]), np.array([1.5, 1.5, 2.4]))
