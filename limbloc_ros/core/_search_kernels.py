# SPDX-License-Identifier: Apache-2.0
"""Numba kernels that torso and limb search share: depth in the hull, medial axis, points spread out, heaps."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

#: So many points are looked up at once by `depths_at`.
CHUNK = 64
_ONE = np.uint32(1)


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
def chunk_scratch() -> tuple[Any, Any, Any]:
    """`work`, `cells` and `corners` of `depths_at`."""
    return np.zeros(7 * CHUNK), np.zeros(3 * CHUNK, np.int32), np.zeros(8 * CHUNK, np.float32)


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def depths_at(sdf: Any, origin: Any, voxel: float, work: Any, cells: Any, corners: Any) -> None:
    """`depth_at` of CHUNK points, whose x, y, z stand in `work` one after the other; depths go behind these.

    All but the reading of the corners becomes vector code, for which each loop reads and writes plain runs.
    """
    x0, y0, z0 = origin[0], origin[1], origin[2]
    last_x, last_y, last_z = sdf.shape[0] - 1.001, sdf.shape[1] - 1.001, sdf.shape[2] - 1.001
    for n in range(CHUNK):
        gx = min(max((work[n] - x0) / voxel, 0.0), last_x)
        gy = min(max((work[CHUNK + n] - y0) / voxel, 0.0), last_y)
        gz = min(max((work[2 * CHUNK + n] - z0) / voxel, 0.0), last_z)
        i = np.int32(gx)
        j = np.int32(gy)
        k = np.int32(gz)
        cells[n] = i
        cells[CHUNK + n] = j
        cells[2 * CHUNK + n] = k
        work[4 * CHUNK + n] = gx - i
        work[5 * CHUNK + n] = gy - j
        work[6 * CHUNK + n] = gz - k
    for n in range(CHUNK):  # unsigned: no index counts from the end
        x = np.uint32(cells[n])
        y = np.uint32(cells[CHUNK + n])
        z = np.uint32(cells[2 * CHUNK + n])
        corners[n] = sdf[x, y, z]
        corners[CHUNK + n] = sdf[x, y, z + _ONE]
        corners[2 * CHUNK + n] = sdf[x, y + _ONE, z]
        corners[3 * CHUNK + n] = sdf[x, y + _ONE, z + _ONE]
        corners[4 * CHUNK + n] = sdf[x + _ONE, y, z]
        corners[5 * CHUNK + n] = sdf[x + _ONE, y, z + _ONE]
        corners[6 * CHUNK + n] = sdf[x + _ONE, y + _ONE, z]
        corners[7 * CHUNK + n] = sdf[x + _ONE, y + _ONE, z + _ONE]
    for n in range(CHUNK):
        a = work[4 * CHUNK + n]
        b = work[5 * CHUNK + n]
        c = work[6 * CHUNK + n]
        v00 = corners[n] + c * (corners[CHUNK + n] - corners[n])
        v01 = corners[2 * CHUNK + n] + c * (corners[3 * CHUNK + n] - corners[2 * CHUNK + n])
        v10 = corners[4 * CHUNK + n] + c * (corners[5 * CHUNK + n] - corners[4 * CHUNK + n])
        v11 = corners[6 * CHUNK + n] + c * (corners[7 * CHUNK + n] - corners[6 * CHUNK + n])
        v0 = v00 + b * (v01 - v00)
        v1 = v10 + b * (v11 - v10)
        work[3 * CHUNK + n] = v0 + a * (v1 - v0)


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
def points_near(points: Any, base: Any, reach: float) -> Any:
    """Of points [N, 4] those within `reach` of `base` [3]."""
    out = np.empty((len(points), 4))
    count = 0
    for n in range(len(points)):
        x, y, z = points[n, 0] - base[0], points[n, 1] - base[1], points[n, 2] - base[2]
        for i in range(4):
            out[count, i] = points[n, i]
        count += x * x + y * y + z * z < reach * reach
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


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def push(heap: Any, count: int, scores: Any, new: int) -> None:
    """Add a row to a heap of `count` rows: parents score less than their two children, or the same and come before."""
    at = count
    while at > 0:
        up = (at - 1) // 2
        if scores[heap[up]] < scores[new] or (scores[heap[up]] == scores[new] and heap[up] < new):
            break
        heap[at] = heap[up]
        at = up
    heap[at] = new


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def pop(heap: Any, count: int, scores: Any) -> int:
    """Take the row of the least score from a heap of `count` rows; of equals the first."""
    least = heap[0]
    last = heap[count - 1]
    at = 0
    while 2 * at + 1 < count:
        down = 2 * at + 1
        if down + 1 < count:
            a, b = heap[down], heap[down + 1]
            if scores[b] < scores[a] or (scores[b] == scores[a] and b < a):
                down += 1
        if scores[last] < scores[heap[down]] or (scores[last] == scores[heap[down]] and last < heap[down]):
            break
        heap[at] = heap[down]
        at = down
    heap[at] = last
    return least  # type: ignore[no-any-return]
