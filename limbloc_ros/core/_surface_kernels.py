# SPDX-License-Identifier: Apache-2.0
"""Numba kernels of `surface.py`; they trust their caller and touch only surface voxels where they can."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from limbloc_ros.core._union_kernels import join, root

Array = NDArray[np.float64]
Ints = NDArray[np.int32]

#: The 26 lattice neighbours of a voxel, in array order.
OFFSETS: Ints = np.array(
    [(i, j, k) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1) if (i, j, k) != (0, 0, 0)], dtype=np.int32
)

#: A point is on the surface where the field is no further from 0 than this, m.
ON_SURFACE_M = 1e-5


@njit(cache=True, nogil=True)
def list_surface(sdf: NDArray[np.float32]) -> tuple[Ints, Ints]:
    """Inside voxels with an outside face neighbour: local indices [N, 3]; grid of their numbers (-1 elsewhere)."""
    nx, ny, nz = sdf.shape
    number = np.full((nx, ny, nz), -1, dtype=np.int32)
    count = 0
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                if sdf[i, j, k] < 0.0 and (
                    i == 0
                    or j == 0
                    or k == 0
                    or i == nx - 1
                    or j == ny - 1
                    or k == nz - 1
                    or sdf[i - 1, j, k] >= 0.0
                    or sdf[i + 1, j, k] >= 0.0
                    or sdf[i, j - 1, k] >= 0.0
                    or sdf[i, j + 1, k] >= 0.0
                    or sdf[i, j, k - 1] >= 0.0
                    or sdf[i, j, k + 1] >= 0.0
                ):
                    number[i, j, k] = count
                    count += 1
    local = np.empty((count, 3), dtype=np.int32)
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                if number[i, j, k] >= 0:
                    local[number[i, j, k]] = (i, j, k)
    return local, number


@njit(cache=True, nogil=True)
def list_neighbours(indices: Ints, offsets: Ints) -> Ints:
    """[N, 26] rows of the voxels around each voxel of the list, -1 where there is none."""
    low = np.array([indices[:, a].min() - 1 for a in range(3)])
    size = np.array([indices[:, a].max() + 2 for a in range(3)]) - low
    number = np.full((size[0], size[1], size[2]), -1, dtype=np.int32)
    for n in range(len(indices)):
        number[indices[n, 0] - low[0], indices[n, 1] - low[1], indices[n, 2] - low[2]] = n
    out = np.empty((len(indices), len(offsets)), dtype=np.int32)
    for n in range(len(indices)):
        i, j, k = indices[n, 0] - low[0], indices[n, 1] - low[1], indices[n, 2] - low[2]
        for m in range(len(offsets)):
            out[n, m] = number[i + offsets[m, 0], j + offsets[m, 1], k + offsets[m, 2]]
    return out


@njit(cache=True, nogil=True)
def label_pieces(local: Ints, number: Ints, offsets: Ints) -> Ints:
    """[M] which connected piece each of the listed voxels [M, 3] belongs to, counted from 0 on."""
    _, ny, nz = number.shape
    parent = np.arange(len(local), dtype=np.int32)
    before = offsets[: len(offsets) // 2]  # the other half looks back at this one
    for n in range(len(local)):
        for m in range(len(before)):
            i, j, k = local[n, 0] + before[m, 0], local[n, 1] + before[m, 1], local[n, 2] + before[m, 2]
            if i >= 0 and 0 <= j < ny and 0 <= k < nz and number[i, j, k] >= 0:
                join(parent, number[i, j, k], n)
    label = np.empty(len(local), dtype=np.int32)
    labels = 0
    for n in range(len(local)):
        first = root(parent, n)
        if first == n:
            label[n] = labels
            labels += 1
        label[n] = label[first]
    return label


@njit(cache=True, nogil=True)
def sobel_at(volume: NDArray[np.float32], local: Ints) -> Array:
    """Gradient [N, 3] by the paper's eq. 1 (centred 3x3x3 Sobel), edges repeated; 32 times the change per voxel."""
    nx, ny, nz = volume.shape
    out = np.zeros((local.shape[0], 3))
    for n in range(local.shape[0]):
        gx = gy = gz = 0.0
        for a in range(-1, 2):
            i = min(max(local[n, 0] + a, 0), nx - 1)
            for b in range(-1, 2):
                j = min(max(local[n, 1] + b, 0), ny - 1)
                for c in range(-1, 2):
                    k = min(max(local[n, 2] + c, 0), nz - 1)
                    value = float(volume[i, j, k])
                    sa, sb, sc = 2 - abs(a), 2 - abs(b), 2 - abs(c)
                    gx += a * sb * sc * value
                    gy += sa * b * sc * value
                    gz += sa * sb * c * value
        out[n] = (gx, gy, gz)
    return out


@njit(cache=True, nogil=True)
def normalise_outward(gradient: Array, sdf: NDArray[np.float32], local: Ints) -> Array:
    """Unit normals [N, 3]; where the gradient vanishes (a sheet one voxel thick) the first open face decides."""
    nx, ny, nz = sdf.shape
    out = np.empty_like(gradient)
    for n in range(gradient.shape[0]):
        g = gradient[n]
        length = math.sqrt(g[0] * g[0] + g[1] * g[1] + g[2] * g[2])
        if length > 1e-9:
            out[n] = g / length
            continue
        i, j, k = local[n, 0], local[n, 1], local[n, 2]
        out[n] = (0.0, 0.0, 1.0)
        if k == nz - 1 or sdf[i, j, k + 1] >= 0.0:
            out[n] = (0.0, 0.0, 1.0)
        elif k == 0 or sdf[i, j, k - 1] >= 0.0:
            out[n] = (0.0, 0.0, -1.0)
        elif j == ny - 1 or sdf[i, j + 1, k] >= 0.0:
            out[n] = (0.0, 1.0, 0.0)
        elif j == 0 or sdf[i, j - 1, k] >= 0.0:
            out[n] = (0.0, -1.0, 0.0)
        elif i == nx - 1 or sdf[i + 1, j, k] >= 0.0:
            out[n] = (1.0, 0.0, 0.0)
        else:
            out[n] = (-1.0, 0.0, 0.0)
    return out


@njit(cache=True, nogil=True)
def trilinear(volume: NDArray[np.float32], x: float, y: float, z: float) -> float:
    """Value at the local grid position (x, y, z), where integers are voxel centres; clamped to the grid."""
    nx, ny, nz = volume.shape
    x = min(max(x, 0.0), nx - 1.0)
    y = min(max(y, 0.0), ny - 1.0)
    z = min(max(z, 0.0), nz - 1.0)
    i, j, k = min(int(x), max(nx - 2, 0)), min(int(y), max(ny - 2, 0)), min(int(z), max(nz - 2, 0))
    i1, j1, k1 = min(i + 1, nx - 1), min(j + 1, ny - 1), min(k + 1, nz - 1)
    a, b, c = x - i, y - j, z - k
    low = (1 - a) * ((1 - b) * volume[i, j, k] + b * volume[i, j1, k]) + a * (
        (1 - b) * volume[i1, j, k] + b * volume[i1, j1, k]
    )
    high = (1 - a) * ((1 - b) * volume[i, j, k1] + b * volume[i, j1, k1]) + a * (
        (1 - b) * volume[i1, j, k1] + b * volume[i1, j1, k1]
    )
    return float((1 - c) * low + c * high)


@njit(cache=True, nogil=True)
def crossing_along_normal(sdf: NDArray[np.float32], local: Ints, normals: Array, reach: float) -> Array:
    """Steps [N] in voxels from each voxel centre along its normal to sdf = 0.

    A surface voxel is inside and has an outside face neighbour, so the crossing lies within `reach` voxels; it is
    bracketed by half-voxel steps and then bisected, which no wrinkle of the field can upset. Without a crossing
    (a normal that grazes the surface) the voxel stays at its centre.
    """
    out = np.zeros(local.shape[0])
    for n in range(local.shape[0]):
        x, y, z = float(local[n, 0]), float(local[n, 1]), float(local[n, 2])
        u, v, w = normals[n]
        inner = outer = 0.0
        f_inner = f_outer = float(sdf[local[n, 0], local[n, 1], local[n, 2]])
        while outer < reach and f_outer < 0.0:
            inner, f_inner = outer, f_outer
            outer += 0.5
            f_outer = trilinear(sdf, x + outer * u, y + outer * v, z + outer * w)
        if f_outer < 0.0:
            continue
        for _ in range(4):
            step = inner + (outer - inner) * min(max(f_inner / (f_inner - f_outer), 0.05), 0.95)
            f = trilinear(sdf, x + step * u, y + step * v, z + step * w)
            if f < 0.0:
                inner, f_inner = step, f
            else:
                outer, f_outer = step, f
            if abs(f) < ON_SURFACE_M:
                break
        out[n] = inner + (outer - inner) * (f_inner / (f_inner - f_outer))
    return out


@njit(cache=True, nogil=True)
def mean_neighbour_angle(normals: Array, neighbours: Ints) -> Array:
    """Mean angle [N] rad between a voxel's normal and those of its surface neighbours; 0 where there are none."""
    out = np.zeros(normals.shape[0])
    for n in range(normals.shape[0]):
        total = 0.0
        count = 0
        for m in neighbours[n]:
            if m >= 0:
                dot = normals[n, 0] * normals[m, 0] + normals[n, 1] * normals[m, 1] + normals[n, 2] * normals[m, 2]
                total += math.acos(min(max(dot, -1.0), 1.0))
                count += 1
        if count > 0:
            out[n] = total / count
    return out


@njit(cache=True, nogil=True)
def spread_in_ball(values: Array, points: Array, neighbours: Ints, radius: float) -> tuple[Array, Array]:
    """Mean and standard deviation [N] of `values` over the surface patch within `radius` of each point.

    The patch is what can be reached over neighbours without leaving the ball, so that it never jumps from an arm to
    the torso behind it.
    """
    count = values.shape[0]
    mean, deviation = np.empty(count), np.empty(count)
    seen = np.full(count, -1, dtype=np.int32)
    stack = np.empty(count, dtype=np.int32)
    limit = radius * radius
    for n in range(count):
        seen[n] = n
        stack[0] = n
        top = 1
        total = squares = 0.0
        members = 0
        while top > 0:
            top -= 1
            q = stack[top]
            total += values[q]
            squares += values[q] * values[q]
            members += 1
            for m in neighbours[q]:
                if m >= 0 and seen[m] != n:
                    seen[m] = n
                    dx, dy, dz = points[m, 0] - points[n, 0], points[m, 1] - points[n, 1], points[m, 2] - points[n, 2]
                    if dx * dx + dy * dy + dz * dz <= limit:
                        stack[top] = m
                        top += 1
        mean[n] = total / members
        deviation[n] = math.sqrt(max(squares / members - mean[n] * mean[n], 0.0))
    return mean, deviation
