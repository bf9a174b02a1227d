# SPDX-License-Identifier: Apache-2.0
"""Numba kernels of the limb search: two-bone limbs on spheres, and what of the hull is explained already."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from limbloc_ros.core._part_kernels import distance_to_part, lay_out
from limbloc_ros.core._search_kernels import depth_at, spread_out

#: Ragged masks eat into limbs: a bone may be thinner than expected by this fraction of its radius at no cost.
EATEN = 0.4


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def tube_score(
    sdf: Any,
    origin: Any,
    voxel: float,
    ax: float,
    ay: float,
    az: float,
    bx: float,
    by: float,
    bz: float,
    ra: float,
    rb: float,
    steps: int,
    clip: float,
    skip: float,
    most: float,
) -> float:
    """Mean clipped miss of a cone between two points, from the fraction `skip` on: phi + radius, outside doubled.

    Any value above `most` stands for a worse score.
    """
    total = 0.0
    enough = most * steps * clip * clip
    for n in range(steps):
        t = skip + (1.0 - skip) * (n + 0.5) / steps
        e = depth_at(sdf, origin, voxel, ax + t * (bx - ax), ay + t * (by - ay), az + t * (bz - az))
        if e > 0.0:
            e += clip  # the bone itself lies outside: constraint 3
        e += ra + t * (rb - ra)
        if e > 0.0:
            e = 2.0 * max(e - EATEN * (ra + t * (rb - ra)), 0.0)
        e = min(max(e, -clip), 2.0 * clip)
        total += e * e
        if total > enough:
            break
    return total / (steps * clip * clip)


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def explained_grid(sdf: Any, origin: Any, voxel: float, stride: int, parts: Any, spheres: Any, radii: Any) -> Any:
    """How far each cell of `stride` voxels lies inside the given parts: 0 outside, 1 from 5 cm depth on; float32."""
    nx = (sdf.shape[0] + stride - 1) // stride
    ny = (sdf.shape[1] + stride - 1) // stride
    nz = (sdf.shape[2] + stride - 1) // stride
    out = np.zeros((nx, ny, nz), np.float32)
    rows, bounds = lay_out(parts, spheres, radii)
    no_ray = np.zeros(3)
    for i in range(nx):
        x = origin[0] + i * stride * voxel
        for j in range(ny):
            y = origin[1] + j * stride * voxel
            for k in range(nz):
                if sdf[i * stride, j * stride, k * stride] > 0.02:
                    continue
                z = origin[2] + k * stride * voxel
                worst = 0.0
                for p in range(len(parts)):
                    bx = x - bounds[0, p]
                    by = y - bounds[1, p]
                    bz = z - bounds[2, p]
                    reach = bounds[3, p] + worst
                    if reach <= 0.0 or bx * bx + by * by + bz * bz > reach * reach:
                        continue
                    d, _, _ = distance_to_part(rows[p], x, y, z, no_ray)
                    worst = min(worst, d)
                    if worst < -0.05:
                        break
                out[i, j, k] = min(-worst / 0.05, 1.0)
    return out


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def explained_fraction(
    grid: Any, origin: Any, cell: float, ax: float, ay: float, az: float, bx: float, by: float, bz: float, skip: float
) -> float:
    """Mean of the explained grid along a bone, from the fraction `skip` on."""
    total = 0.0
    for n in range(4):
        t = skip + (1.0 - skip) * (n + 0.5) / 4
        i = int((ax + t * (bx - ax) - origin[0]) / cell + 0.5)
        j = int((ay + t * (by - ay) - origin[1]) / cell + 0.5)
        k = int((az + t * (bz - az) - origin[2]) / cell + 0.5)
        if i >= 0 and j >= 0 and k >= 0 and i < grid.shape[0] and j < grid.shape[1] and k < grid.shape[2]:
            total += grid[i, j, k]
    return total / 4


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def search_limb(
    base: Any,
    lengths: Any,
    tube_radii: Any,
    tip_length: float,
    candidates: Any,
    directions: Any,
    sdf: Any,
    origin: Any,
    voxel: float,
    explained: Any,
    stride: int,
    skip: float,
    clip: float,
    explained_weight: float,
    forbidden: Any,
    keep: int,
) -> Any:
    """Two-bone limbs from `base` [3]: middle joints on the sphere of the first bone's length, ends on the second's.

    Candidates for the middle are medial points near the sphere (pulled onto it) and uniform directions; for the end
    likewise around each good middle. `forbidden` [4] is a direction and a cosine: first bones within it are not human.

    Returns float64 [M, 7]: middle, end, score; the best first.
    """
    n1 = len(candidates) + len(directions)
    middle = np.empty((n1, 4))
    count = 0
    for n in range(n1):
        if n < len(candidates):
            dx = candidates[n, 0] - base[0]
            dy = candidates[n, 1] - base[1]
            dz = candidates[n, 2] - base[2]
            length = math.sqrt(dx * dx + dy * dy + dz * dz)
            if length < 0.85 * lengths[0] or length > 1.15 * lengths[0]:
                continue
            dx /= length
            dy /= length
            dz /= length
        else:
            dx, dy, dz = directions[n - len(candidates)]
        if dx * forbidden[0] + dy * forbidden[1] + dz * forbidden[2] > forbidden[3]:
            continue
        x = base[0] + lengths[0] * dx
        y = base[1] + lengths[0] * dy
        z = base[2] + lengths[0] * dz
        s = tube_score(
            sdf, origin, voxel, base[0], base[1], base[2], x, y, z, tube_radii[0], tube_radii[1], 6, clip, skip, 3.2
        )
        if s > 3.2:
            continue
        s += explained_weight * explained_fraction(
            explained, origin, stride * voxel, base[0], base[1], base[2], x, y, z, 0.4
        )
        middle[count, 0] = x
        middle[count, 1] = y
        middle[count, 2] = z
        middle[count, 3] = s
        count += 1
    middle = middle[:count]
    order = np.argsort(middle[:, 3])
    apart = 0.12 * lengths[0]
    chosen = spread_out(middle, order, apart, 24)
    out = np.empty((len(chosen) * n1, 7))
    total = 0
    for m in chosen:
        ex, ey, ez, s1 = middle[m]
        ux = (ex - base[0]) / lengths[0]
        uy = (ey - base[1]) / lengths[0]
        uz = (ez - base[2]) / lengths[0]
        for n in range(n1):
            if n < len(candidates):
                dx = candidates[n, 0] - ex
                dy = candidates[n, 1] - ey
                dz = candidates[n, 2] - ez
                length = math.sqrt(dx * dx + dy * dy + dz * dz)
                if length < 0.85 * lengths[1] or length > 1.15 * lengths[1]:
                    continue
                dx /= length
                dy /= length
                dz /= length
            else:
                dx, dy, dz = directions[n - len(candidates)]
            if dx * ux + dy * uy + dz * uz < -0.87:  # a limb does not fold onto itself
                continue
            x = ex + lengths[1] * dx
            y = ey + lengths[1] * dy
            z = ez + lengths[1] * dz
            s2 = tube_score(sdf, origin, voxel, ex, ey, ez, x, y, z, tube_radii[1], tube_radii[2], 6, clip, 0.0, 3.2)
            if s2 > 3.2:
                continue
            s2 += explained_weight * explained_fraction(explained, origin, stride * voxel, ex, ey, ez, x, y, z, 0.0)
            # the hand or heel goes on a little beyond the end
            tip = depth_at(
                sdf, origin, voxel, x + 0.5 * tip_length * dx, y + 0.5 * tip_length * dy, z + 0.5 * tip_length * dz
            )
            s2 += 0.3 * min(max(tip / clip, 0.0), 1.0)
            out[total, 0] = ex
            out[total, 1] = ey
            out[total, 2] = ez
            out[total, 3] = x
            out[total, 4] = y
            out[total, 5] = z
            out[total, 6] = s1 + s2
            total += 1
    out = out[:total]
    order = np.argsort(out[:, 6])
    kept = np.empty((keep, 7))
    count = 0
    apart2 = (0.22 * lengths[0]) ** 2
    for n in order:
        ok = True
        for m in range(count):
            d1 = 0.0
            d2 = 0.0
            for i in range(3):
                d1 += (out[n, i] - kept[m, i]) ** 2
                d2 += (out[n, 3 + i] - kept[m, 3 + i]) ** 2
            if d1 < apart2 and d2 < apart2:
                ok = False
                break
        if ok:
            kept[count] = out[n]
            count += 1
            if count == keep:
                break
    return kept[:count]
