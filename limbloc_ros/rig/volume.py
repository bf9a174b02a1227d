# SPDX-License-Identifier: Apache-2.0
"""Where people can stand: the carve volume of a rig that does not name one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core.camera import Camera

Array = NDArray[np.float64]

#: Heights of the derived volume above the floor, m: room for raised arms of a tall person.
FLOOR_M, CEILING_M = 0.0, 2.6

#: The height at which a standing person must be seen, m, and the room left around such places, m.
WAIST_M, MARGIN_M = 1.0, 0.3

#: Nobody is carved further than this from the point that the cameras look at, m.
REACH_M = 6.0


def derive_volume(cameras: Sequence[Camera]) -> tuple[Array, Array]:
    """The box around all places whose waist height at least three of four cameras (rounded up) see.

    Searched around the point where the optical axes meet, as far as the furthest camera stands from it.

    Args:
        cameras: at least one camera, world z up and floor at z = 0.

    Returns:
        corners low [3] and high [3], m.
    """
    centre = _meeting_point(cameras)
    positions = np.array([camera.T_world_camera[:2, 3] for camera in cameras])
    reach = float(np.clip(np.linalg.norm(positions - centre, axis=1).max(), 1.0, REACH_M))
    steps = np.arange(-reach, reach + 0.05, 0.1)
    x, y = np.meshgrid(centre[0] + steps, centre[1] + steps, indexing="ij")
    places = np.stack([x, y, np.full_like(x, WAIST_M)], axis=-1).reshape(-1, 3)
    seen = np.sum([_sees(camera, places) for camera in cameras], axis=0)
    enough = seen >= -(-3 * len(cameras) // 4)
    standing = places[enough, :2] if enough.any() else centre[None] + [[-1.2, -1.2], [1.2, 1.2]]
    low = np.array([*(standing.min(axis=0) - MARGIN_M), FLOOR_M])
    high = np.array([*(standing.max(axis=0) + MARGIN_M), CEILING_M])
    return low, high


def _meeting_point(cameras: Sequence[Camera]) -> Array:
    """[2] the place nearest to all optical axes seen from above, m; a weak pull 3 m ahead settles parallel axes."""
    A, b = np.zeros((2, 2)), np.zeros(2)
    for camera in cameras:
        origin, axis = camera.T_world_camera[:2, 3], camera.T_world_camera[:2, 2]
        length = float(np.linalg.norm(axis))
        across = np.eye(2) - np.outer(axis, axis) / length**2 if length > 1e-6 else np.eye(2)
        ahead = origin + 3.0 * axis
        A += across + 0.01 * np.eye(2)
        b += across @ origin + 0.01 * ahead
    return np.asarray(np.linalg.solve(A, b))


def _sees(camera: Camera, p_world: Array) -> NDArray[np.bool_]:
    """[N] points inside the image of the pinhole; without distortion, which folds far points back into the image."""
    T = camera.T_camera_world
    p = p_world @ T[:3, :3].T + T[:3, 3]
    depth = np.where(p[:, 2] > 0.3, p[:, 2], np.nan)
    u = camera.K[0, 0] * p[:, 0] / depth + camera.K[0, 2]
    v = camera.K[1, 1] * p[:, 1] / depth + camera.K[1, 2]
    return np.asarray((u >= 0) & (u <= camera.width - 1) & (v >= 0) & (v <= camera.height - 1))
