# SPDX-License-Identifier: Apache-2.0
"""What the cameras of a room tell about themselves: where they look, how far away, and which way is up."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Optical axes that differ by less than this are parallel: they meet nowhere in particular.
PARALLEL_RAD = np.radians(15.0)


@dataclass(frozen=True)
class Look:
    """Where cameras look.

    Attributes:
        point: [3] the place nearest to all optical axes.
        distances: [C] from each camera to it.
        depths: [C] along each optical axis; negative behind the camera.
        miss: how far the axes pass from it (root mean square), over the mean distance.
        parallel: the axes are so nearly parallel that the point means nothing.
    """

    point: Array
    distances: Array
    depths: Array
    miss: float
    parallel: bool

    @property
    def common(self) -> bool:
        """Whether all cameras look at one place."""
        return not self.parallel and bool((self.depths > 0).all()) and self.miss < 0.45


def inverse(T: Array) -> Array:
    """The inverse of a rigid transform [4, 4]."""
    out = np.eye(4)
    out[:3, :3] = T[:3, :3].T
    out[:3, 3] = -T[:3, :3].T @ T[:3, 3]
    return out


def rotation_of(quaternion: Array) -> Array:
    """Rotation matrix [3, 3] of a quaternion x y z w of length 1."""
    x, y, z, w = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def looking_at(centre: Array, target: Array) -> Array:
    """T_world_camera [4, 4] of an upright camera at `centre` [3] that looks at `target` [3]."""
    forward = target - centre
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    T[:3, 3] = centre
    return T


def where_they_look(poses: Sequence[Array]) -> Look:
    """Where cameras look, of their poses T_world_camera [4, 4]; in the poses' unit."""
    origins = np.array([T[:3, 3] for T in poses])
    axes = np.array([T[:3, 2] for T in poses])
    widest = np.arccos(np.clip((axes @ axes.T).min(), -1, 1))
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    # A pull towards the cameras, so weak that only parallel axes feel it.
    A = across.sum(axis=0) + 1e-9 * np.eye(3)
    b = np.einsum("cij,cj->i", across, origins) + 1e-9 * origins.mean(axis=0)
    point = np.linalg.solve(A, b)
    offsets = point - origins
    misses = np.linalg.norm(np.einsum("cij,cj->ci", across, offsets), axis=1)
    distances = np.linalg.norm(offsets, axis=1)
    mean = max(float(distances.mean()), 1e-12)
    return Look(
        point,
        distances,
        np.einsum("ci,ci->c", axes, offsets),
        float(np.sqrt((misses**2).mean())) / mean,
        bool(widest < PARALLEL_RAD),
    )


def cameras_up(poses: Sequence[Array]) -> tuple[Array, float]:
    """The mean up direction of the images, a unit vector [3], and how much they agree (1: all the same, 0: not)."""
    mean = -np.array([T[:3, 1] for T in poses]).mean(axis=0)
    length = float(np.linalg.norm(mean))
    return mean / max(length, 1e-12), length


def rotation_between(a: Array, b: Array) -> Array:
    """The smallest rotation [3, 3] that turns unit vector a to b."""
    axis, cosine = np.cross(a, b), float(a @ b)
    if cosine < -1 + 1e-12:
        side = np.eye(3)[int(np.abs(a).argmin())]
        axis = np.cross(a, side) / np.linalg.norm(np.cross(a, side))
        return np.asarray(2 * np.outer(axis, axis) - np.eye(3))
    skew = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.asarray(np.eye(3) + skew + skew @ skew / (1 + cosine))
