# SPDX-License-Identifier: Apache-2.0
"""Numba kernels of `anchors.py`: exhaustive searches in the hull's grid. Positions and radii are in voxels.

A local position is (x / voxel_m - 0.5 - index_min): integers are voxel centres of the hull's array.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from limbloc_ros.core._surface_kernels import trilinear

Array = NDArray[np.float64]
Grid = NDArray[np.float32]


@njit(cache=True)
def sphere_support(sdf: Grid, centres: Array, radius: float, directions: Array, tolerance_m: float) -> Array:
    """How much of a sphere's surface lies on the hull's [N]: 1 - (sdf / tolerance)^2 averaged, not below 0 each."""
    out = np.zeros(len(centres))
    for n in range(len(centres)):
        total = 0.0
        for d in range(len(directions)):
            e = trilinear(
                sdf,
                centres[n, 0] + radius * directions[d, 0],
                centres[n, 1] + radius * directions[d, 1],
                centres[n, 2] + radius * directions[d, 2],
            )
            if abs(e) < tolerance_m:
                total += 1.0 - (e / tolerance_m) ** 2
        out[n] = total / len(directions)
    return out


@njit(cache=True)
def voxels_in_shell(sdf: Grid, centre: Array, low: float, high: float) -> Array:
    """Local positions [M, 3] of the voxels inside the hull between two spheres around `centre`."""
    nx, ny, nz = sdf.shape
    i0, i1 = max(0, math.ceil(centre[0] - high)), min(nx - 1, math.floor(centre[0] + high))
    j0, j1 = max(0, math.ceil(centre[1] - high)), min(ny - 1, math.floor(centre[1] + high))
    k0, k1 = max(0, math.ceil(centre[2] - high)), min(nz - 1, math.floor(centre[2] + high))
    out = np.empty((max(0, i1 - i0 + 1) * max(0, j1 - j0 + 1) * max(0, k1 - k0 + 1), 3))
    count = 0
    for i in range(i0, i1 + 1):
        for j in range(j0, j1 + 1):
            for k in range(k0, k1 + 1):
                if sdf[i, j, k] < 0.0:
                    d2 = (i - centre[0]) ** 2 + (j - centre[1]) ** 2 + (k - centre[2]) ** 2
                    if low * low <= d2 <= high * high:
                        out[count] = (i, j, k)
                        count += 1
    return out[:count].copy()


@njit(cache=True)
def frustum_gain(
    weight: Grid, a: Array, radius_a: float, ends: Array, radius_b: float, samples: Array, before: Array, price: float
) -> Array:
    """Sum of `weight` over the frustum from `a` to each of `ends` [M, 3], in voxels, by fixed sample points.

    Args:
        weight: what a voxel of the frustum earns: +1 hull, -1 outside, less where something else is already.
        samples: [S, 4] (t along the axis, u, v across it in radii, share of the volume), shares add up to 1.
        before: [4] (x, y, z, radius) where the bone that ends at `a` begins: what lies in that frustum costs `price`
            instead, so that a limb does not fold back onto itself. Radius 0: there is none.
    """
    nx, ny, nz = weight.shape
    px, py, pz = before[0] - a[0], before[1] - a[1], before[2] - a[2]
    before2 = px * px + py * py + pz * pz
    out = np.zeros(len(ends))
    for m in range(len(ends)):
        dx, dy, dz = ends[m, 0] - a[0], ends[m, 1] - a[1], ends[m, 2] - a[2]
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        if length < 1e-9:
            continue
        ex, ey, ez = dx / length, dy / length, dz / length
        if abs(ez) < 0.9:  # two directions across the axis
            h = math.sqrt(ex * ex + ey * ey)
            ux, uy, uz = -ey / h, ex / h, 0.0
        else:
            h = math.sqrt(ey * ey + ez * ez)
            ux, uy, uz = 0.0, -ez / h, ey / h
        vx, vy, vz = ey * uz - ez * uy, ez * ux - ex * uz, ex * uy - ey * ux
        total = 0.0
        volume = 0.0
        for s in range(len(samples)):
            t = samples[s, 0]
            r = radius_a + t * (radius_b - radius_a)
            u, v = samples[s, 1] * r, samples[s, 2] * r
            share = samples[s, 3] * r * r
            volume += share
            x, y, z = t * dx + u * ux + v * vx, t * dy + u * uy + v * vy, t * dz + u * uz + v * vz
            if before[3] > 0.0:
                q = (x * px + y * py + z * pz) / before2
                if 0.0 < q < 1.0:
                    r2 = radius_a + q * (before[3] - radius_a)
                    if (x - q * px) ** 2 + (y - q * py) ** 2 + (z - q * pz) ** 2 < r2 * r2:
                        total -= share * price
                        continue
            i = math.floor(a[0] + x + 0.5)
            j = math.floor(a[1] + y + 0.5)
            k = math.floor(a[2] + z + 0.5)
            if 0 <= i < nx and 0 <= j < ny and 0 <= k < nz:
                total += share * weight[i, j, k]
            else:
                total -= share
        out[m] = total * math.pi * length
    return out


@njit(cache=True)
def bone_outside(sdf: Grid, a: Array, ends: Array) -> Array:
    """Share [M] of each bone `a` to `ends` that lies outside the hull (constraint 3), at 12 points."""
    out = np.zeros(len(ends))
    for m in range(len(ends)):
        count = 0
        for s in range(1, 13):
            t = s / 12.0
            if (
                trilinear(
                    sdf,
                    a[0] + t * (ends[m, 0] - a[0]),
                    a[1] + t * (ends[m, 1] - a[1]),
                    a[2] + t * (ends[m, 2] - a[2]),
                )
                > 0.0
            ):
                count += 1
        out[m] = count / 12.0
    return out


@njit(cache=True)
def cover_frustum(
    covered: NDArray[np.bool_], voxels: Array, a: Array, radius_a: float, b: Array, radius_b: float
) -> None:
    """Mark the `voxels` [V, 3] that lie in the frustum with round ends from a to b."""
    dx, dy, dz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    length2 = dx * dx + dy * dy + dz * dz + 1e-12
    for n in range(len(voxels)):
        x, y, z = voxels[n, 0] - a[0], voxels[n, 1] - a[1], voxels[n, 2] - a[2]
        t = min(max((x * dx + y * dy + z * dz) / length2, 0.0), 1.0)
        r = radius_a + t * (radius_b - radius_a)
        x, y, z = x - t * dx, y - t * dy, z - t * dz
        if x * x + y * y + z * z <= r * r:
            covered[n] = True


@njit(cache=True)
def template_scores(weight: Grid, centre: Array, templates: Array, rotations: Array) -> Array:
    """[T, R] sum of `weight` over each template's points [T, S, 3] (voxels), turned by each rotation."""
    nx, ny, nz = weight.shape
    out = np.empty((templates.shape[0], rotations.shape[0]))
    for r in range(rotations.shape[0]):
        R = rotations[r]
        a, b, c, d, e, f = R[0, 0], R[0, 1], R[0, 2], R[1, 0], R[1, 1], R[1, 2]
        g, h, m = R[2, 0], R[2, 1], R[2, 2]
        for t in range(templates.shape[0]):
            total = 0.0
            for s in range(templates.shape[1]):
                x, y, z = templates[t, s, 0], templates[t, s, 1], templates[t, s, 2]
                i = int(centre[0] + a * x + b * y + c * z + 0.5)
                j = int(centre[1] + d * x + e * y + f * z + 0.5)
                k = int(centre[2] + g * x + h * y + m * z + 0.5)
                if 0 <= i < nx and 0 <= j < ny and 0 <= k < nz:
                    total += weight[i, j, k]
                else:
                    total -= 1.0
            out[t, r] = total
    return out
