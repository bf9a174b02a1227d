# SPDX-License-Identifier: Apache-2.0
"""Numba kernels that torso and limb search share: depth in the hull, medial axis, points spread out."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit


@njit(cache=True, inline="always", error_model="numpy")  # type: ignore[misc, unused-ignore]
def depth_at(sdf: Any, origin: Any, voxel: float, x: float, y: float, z: float) -> float:
    """Trilinear signed distance (m); beyond the grid its border's value."""
    gx = min(max((x - origin[0]) / voxel, 0.0), sdf.shape[0] - 1.001)
    gy = min(max((y - origin[1]) / voxel, 0.0), sdf.shape[1] - 1.001)
    gz = min(max((z - origin[2]) / voxel, 0.0), sdf.shape[2] - 1.001)
    i = int(gx)
    j = int(gy)
    k = int(gz)
    a = gx - i
    b = gy - j
    c = gz - k
    v00 = sdf[i, j, k] + c * (sdf[i, j, k + 1] - sdf[i, j, k])
    v01 = sdf[i, j + 1, k] + c * (sdf[i, j + 1, k + 1] - sdf[i, j + 1, k])
    v10 = sdf[i + 1, j, k] + c * (sdf[i + 1, j, k + 1] - sdf[i + 1, j, k])
    v11 = sdf[i + 1, j + 1, k] + c * (sdf[i + 1, j + 1, k + 1] - sdf[i + 1, j + 1, k])
    v0 = v00 + b * (v01 - v00)
    v1 = v10 + b * (v11 - v10)
    return v0 + a * (v1 - v0)  # type: ignore[no-any-return]


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def medial_ridge(sdf: Any, origin: Any, voxel: float, least_depth: float, flat: float) -> Any:
    """Voxels of the medial axis: inside, and the signed distance has no clear slope (|gradient| < flat).

    Returns float64 [R, 4]: x, y, z and depth, m.
    """
    nx, ny, nz = sdf.shape
    out = np.empty((sdf.size // 8 + 64, 4))
    count = 0
    limit = flat * flat * 4.0 * voxel * voxel
    for i in range(1, nx - 1):
        for j in range(1, ny - 1):
            for k in range(1, nz - 1):
                v = sdf[i, j, k]
                if v > -least_depth:
                    continue
                gx = sdf[i + 1, j, k] - sdf[i - 1, j, k]
                gy = sdf[i, j + 1, k] - sdf[i, j - 1, k]
                gz = sdf[i, j, k + 1] - sdf[i, j, k - 1]
                if gx * gx + gy * gy + gz * gz < limit and count < len(out):
                    out[count, 0] = origin[0] + i * voxel
                    out[count, 1] = origin[1] + j * voxel
                    out[count, 2] = origin[2] + k * voxel
                    out[count, 3] = -v
                    count += 1
    return out[:count]


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def spread_out(points: Any, order: Any, apart: float, most: int) -> Any:
    """Indices of points taken in `order`, each at least `apart` (m) from those before, `most` of them."""
    out = np.empty(most, np.int64)
    count = 0
    for n in order:
        ok = True
        for m in range(count):
            x = points[n, 0] - points[out[m], 0]
            y = points[n, 1] - points[out[m], 1]
            z = points[n, 2] - points[out[m], 2]
            if x * x + y * y + z * z < apart * apart:
                ok = False
                break
        if ok:
            out[count] = n
            count += 1
            if count == most:
                break
    return out[:count]
