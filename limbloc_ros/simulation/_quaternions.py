# SPDX-License-Identifier: Apache-2.0
"""Unit quaternions (w x y z) as plain arrays [..., 4]; all functions broadcast over the leading axes."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def about(axis: int, angle: ArrayLike) -> Array:
    """The rotation by `angle` rad about the axis 0 (x), 1 (y) or 2 (z)."""
    half = np.asarray(angle, dtype=np.float64) / 2
    q = np.zeros((*half.shape, 4))
    q[..., 0], q[..., 1 + axis] = np.cos(half), np.sin(half)
    return q


def multiply(a: Array, b: Array) -> Array:
    """First b, then a."""
    aw, ax, ay, az = np.moveaxis(a, -1, 0)
    bw, bx, by, bz = np.moveaxis(b, -1, 0)
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def inverse(q: Array) -> Array:
    """The inverse rotation."""
    return np.asarray(q * np.array([1.0, -1.0, -1.0, -1.0]))


def power(q: Array, share: ArrayLike) -> Array:
    """The fraction `share` of the rotation q along its shorter arc."""
    q = np.where(q[..., :1] < 0, -q, q)
    share = np.asarray(share, dtype=np.float64)
    n = np.linalg.norm(q[..., 1:], axis=-1)
    half = np.arctan2(n, q[..., 0]) * share
    out = np.empty(np.broadcast_shapes(q.shape, (*half.shape, 4)))
    out[..., 0] = np.cos(half)
    out[..., 1:] = q[..., 1:] * (np.sin(half) / np.maximum(n, 1e-12))[..., None]
    return out


def mix(a: Array, b: Array, share: ArrayLike) -> Array:
    """Normalised linear mix of neighbouring rotations: a at share 0, b at 1."""
    share = np.asarray(share, dtype=np.float64)[..., None]
    b = np.where((a * b).sum(-1, keepdims=True) < 0, -b, b)
    q = a * (1 - share) + b * share
    return np.asarray(q / np.linalg.norm(q, axis=-1, keepdims=True))


def heading(q: Array) -> Array:
    """Where the rotated x axis points in the floor plane, rad from x towards y."""
    w, x, y, z = np.moveaxis(q, -1, 0)
    return np.asarray(np.arctan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z)))
