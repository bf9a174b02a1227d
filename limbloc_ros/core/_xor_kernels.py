# SPDX-License-Identifier: Apache-2.0
"""Numba kernels of eq. 2: the voxels that only one of hull and flesh has, column by column of the grid.

A part is convex, so a column of voxels goes in once and out once. Where is known in closed form: at the uppermost and
the lowest point of its spheres, of the cones around two of them, and of the two planes on all three. All columns above
a part are worked out together, in lanes of a flat buffer and without a branch; the runs are bits of a word.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from limbloc_ros.core._bit_kernels import WORD, between, count, word_at_least, words
from limbloc_ros.core._part_kernels import distance_to_part, lay_out_part

#: Columns that are worked out together, and where in the buffer their x, y, highest and lowest point begin.
COLUMNS = 32
X, Y, TOP, BOTTOM = 0, COLUMNS, 2 * COLUMNS, 3 * COLUMNS
BUFFER = 4 * COLUMNS
#: A column that misses a sphere by less than this (m^2, of squares) touches it.
_TOUCH = 1e-13
#: So near to where a column goes in or out, in voxels, a voxel's own distance decides.
_DOUBT = 1e-3


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def _meet_sphere(buffer: Any, x: float, y: float, z: float, r: float) -> None:
    for i in range(COLUMNS):
        ux, uy = buffer[X + i] - x, buffer[Y + i] - y
        square = r * r - ux * ux - uy * uy
        half = math.sqrt(max(square, 0.0))
        met = square > -_TOUCH
        buffer[TOP + i] = max(buffer[TOP + i], z + half if met else -1e9)
        buffer[BOTTOM + i] = min(buffer[BOTTOM + i], z - half if met else 1e9)


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def _meet_cone(buffer: Any, x: float, y: float, z: float, r: float, dx: float, dy: float, dz: float, dr: float) -> None:
    """The cone around two spheres, of which the second lies dx, dy, dz from the first and is dr larger.

    Of the spheres between them, one at the share t of the way, the column leaves that one last with which
    t dz + sqrt(a t^2 + 2 b t + c) is largest, and enters the one first with which t dz - sqrt(...) is least. If it is
    not between them, their own ends are what counts.
    """
    a = dr * dr - dx * dx - dy * dy
    e = dz * dz - a
    if e <= 1e-12:  # one sphere swallows the other
        return
    for i in range(COLUMNS):
        ux, uy = buffer[X + i] - x, buffer[Y + i] - y
        c = r * r - ux * ux - uy * uy
        b = r * dr + ux * dx + uy * dy
        square = b * b - a * c
        half = math.sqrt(max(square, 0.0) / e)
        rising = b * dz >= 0.0
        # the two solutions of one equation, each from what does not cancel
        good = b + (dz if rising else -dz) * half
        one, other = -good / a, (b * b - dz * dz * c) / (e * good)
        up, down = one if rising else other, other if rising else one
        take = (square >= 0.0) & (up >= 0.0) & (up <= 1.0)
        buffer[TOP + i] = max(buffer[TOP + i], z + up * dz + half if take else -1e9)
        take = (square >= 0.0) & (down >= 0.0) & (down <= 1.0)
        buffer[BOTTOM + i] = min(buffer[BOTTOM + i], z + down * dz - half if take else 1e9)


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def _meet_plane(
    buffer: Any, x: float, y: float, z: float, u: tuple[float, float, float], v: tuple[float, float, float], above: bool
) -> None:
    """The triangle of the points where a plane touches three spheres: the first, and the ways to the others."""
    det = u[0] * v[1] - u[1] * v[0]
    for i in range(COLUMNS):
        ux, uy = buffer[X + i] - x, buffer[Y + i] - y
        s, t = (ux * v[1] - uy * v[0]) / det, (u[0] * uy - u[1] * ux) / det
        height = z + s * u[2] + t * v[2]
        take = (s >= 0.0) & (t >= 0.0) & (s + t <= 1.0)
        buffer[TOP + i] = max(buffer[TOP + i], height if take & above else -1e9)
        buffer[BOTTOM + i] = min(buffer[BOTTOM + i], height if take & (not above) else 1e9)


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def _meet_planes(buffer: Any, row: Any) -> None:
    """The two planes that touch all three spheres of a part of `lay_out`, if there are any."""
    x, y, z, ux, uy, uz, vx, vy, vz, r, rb, rc = row[1:13]
    uu, uv, vv = ux * ux + uy * uy + uz * uz, ux * vx + uy * vy + uz * vz, vx * vx + vy * vy + vz * vz
    det = uu * vv - uv * uv
    if det <= 1e-10:
        return
    gs, gt = (vv * rb - uv * rc) / det, (uu * rc - uv * rb) / det
    g2 = gs * rb + gt * rc
    if g2 >= 0.999:  # as in `distance_to_part`
        return
    up = math.sqrt((1.0 - g2) / det)
    for side in (-up, up):
        nx = side * (uy * vz - uz * vy) - gs * ux - gt * vx
        ny = side * (uz * vx - ux * vz) - gs * uy - gt * vy
        nz = side * (ux * vy - uy * vx) - gs * uz - gt * vz
        if nz != 0.0:
            u = (ux + rb * nx, uy + rb * ny, uz + rb * nz)
            v = (vx + rc * nx, vy + rc * ny, vz + rc * nz)
            _meet_plane(buffer, x + r * nx, y + r * ny, z + r * nz, u, v, nz > 0.0)


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def meet_part(buffer: Any, row: Any) -> None:
    """Write where columns at X, Y (m) leave and enter a part of `lay_out` to TOP and BOTTOM; -1e9, 1e9: nowhere."""
    for i in range(COLUMNS):
        buffer[TOP + i] = -1e9
        buffer[BOTTOM + i] = 1e9
    x, y, z, ux, uy, uz, vx, vy, vz, r, rb, rc = row[1:13]
    _meet_sphere(buffer, x, y, z, r)
    if row[0] == 1.0:
        return
    _meet_sphere(buffer, x + ux, y + uy, z + uz, r + rb)
    _meet_cone(buffer, x, y, z, r, ux, uy, uz, rb)
    if row[0] == 2.0:
        return
    _meet_sphere(buffer, x + vx, y + vy, z + vz, r + rc)
    _meet_cone(buffer, x, y, z, r, vx, vy, vz, rc)
    _meet_cone(buffer, x + ux, y + uy, z + uz, r + rb, vx - ux, vy - uy, vz - uz, rc - rb)
    _meet_planes(buffer, row)


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def _holds(row: Any, origin: Any, voxel: float, x: float, y: float, k: int, no_ray: Any) -> bool:
    return distance_to_part(row, x, y, origin[2] + k * voxel, no_ray)[0] < 0.0  # type: ignore[no-any-return]


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def xor_counts(sdf: Any, origin: Any, voxel: float, parts: Any, spheres: Any, radii: Any) -> tuple[int, int, int]:
    """Voxels inside the hull only, inside the flesh only (anywhere in the world), and inside the hull (eq. 2)."""
    # what the flesh reaches, and the hull's own grid
    boxes = np.empty((len(parts), 2, 3), np.int64)
    low = np.zeros(3, np.int64)
    high = np.array(sdf.shape)
    for p in range(len(parts)):
        for a in range(3):
            first, last = 1e9, -1e9
            for k in range(3):
                s = parts[p, k]
                first = min(first, spheres[s, a] - radii[s])
                last = max(last, spheres[s, a] + radii[s])
            boxes[p, 0, a] = math.ceil((first - origin[a]) / voxel)
            boxes[p, 1, a] = math.floor((last - origin[a]) / voxel)
            low[a] = min(low[a], boxes[p, 0, a])
            high[a] = max(high[a], boxes[p, 1, a] + 1)
    below = words(-low[2])  # words before those of the hull's own voxels
    wide = high[1] - low[1]
    filled = np.zeros(((high[0] - low[0]) * wide, below + words(high[2])), np.uint64)
    buffer = np.zeros(BUFFER)
    row = np.empty(13)
    no_ray = np.zeros(3)
    where = np.empty(COLUMNS, np.int64)
    for p in range(len(parts)):
        lay_out_part(parts[p], spheres, radii, row)
        i, j = boxes[p, 0, 0], boxes[p, 0, 1]
        while i <= boxes[p, 1, 0] and boxes[p, 0, 1] <= boxes[p, 1, 1]:
            used = 0
            while used < COLUMNS and i <= boxes[p, 1, 0]:
                buffer[X + used] = origin[0] + i * voxel
                buffer[Y + used] = origin[1] + j * voxel
                where[used] = (i - low[0]) * wide + j - low[1]
                used += 1
                j += 1
                if j > boxes[p, 1, 1]:
                    i, j = i + 1, boxes[p, 0, 1]
            meet_part(buffer, row)
            for n in range(used):
                begin, end = (buffer[BOTTOM + n] - origin[2]) / voxel, (buffer[TOP + n] - origin[2]) / voxel
                if begin > end:
                    continue
                first, last = math.ceil(begin - _DOUBT), math.floor(end + _DOUBT)
                x, y = buffer[X + n], buffer[Y + n]
                if first <= last and first < begin + _DOUBT and not _holds(row, origin, voxel, x, y, first, no_ray):
                    first += 1
                if first <= last and last > end - _DOUBT and not _holds(row, origin, voxel, x, y, last, no_ray):
                    last -= 1
                first, last = first + WORD * below, last + WORD * below + 1
                if first < last:
                    for k in range(first // WORD, words(last)):
                        filled[where[n], k] |= between(first, last, k)
    flesh = 0
    for n in range(len(filled)):
        for k in range(filled.shape[1]):
            flesh += count(filled[n, k])
    hull, both = 0, 0
    columns = sdf.reshape(sdf.shape[0] * sdf.shape[1], sdf.shape[2])
    for n in range(len(columns)):
        i, j = n // sdf.shape[1], n % sdf.shape[1]
        own = (i - low[0]) * wide + j - low[1]
        for k in range(words(sdf.shape[2])):
            inside = _inside(columns, n, WORD * k)
            hull += count(inside)
            both += count(inside & filled[own, below + k])
    return hull - both, flesh - both, hull


@njit(cache=True, inline="always", error_model="numpy")  # type: ignore[misc, unused-ignore]
def _inside(columns: Any, n: int, first: int) -> np.uint64:
    """A word of the voxels of column n from `first` on that are inside."""
    rest = columns.shape[1] - first
    zero = np.float32(0.0)
    if rest >= WORD:
        word = ~word_at_least(columns, n, first, WORD, zero)
    elif first > 0:  # a whole word that ends where the column does is faster to get than each bit
        word = ~word_at_least(columns, n, first + rest - WORD, WORD, zero) >> np.uint64(WORD - rest)
    else:
        word = ~word_at_least(columns, n, first, rest, zero) & between(0, rest, 0)
    return np.uint64(word)
