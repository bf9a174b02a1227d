# SPDX-License-Identifier: Apache-2.0
"""Numba kernels of the hull's cloud; `cloud_messages` documents the layout and validates, these trust their caller."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def somebody_cut(sdf: Any, band: Any, cut_by: Any, cameras: int) -> bool:
    """Whether of some voxel below the band it is known which camera cut it; the arguments are those of `write_rows`."""
    if cut_by.size > 0:
        for i in range(sdf.shape[0]):
            for j in range(sdf.shape[1]):
                for k in range(sdf.shape[2]):
                    if sdf[i, j, k] < band and cut_by[i, j, k] < cameras:
                        return True
    return False


@njit(cache=True, nogil=True)
def write_rows(
    words: Any,
    numbers: Any,
    sdf: Any,
    band: Any,
    first: Any,
    cut_by: Any,
    cameras: int,
    nobody: int,
    voxel_m: float,
    extra: Any,
) -> None:
    """Fill the rows of a hull's cloud, in one pass.

    Args:
        words, numbers: the same rows as uint32 [R, 6] and float32 [R, 6]. The last voxel stands in all that are left.
        sdf: float32 [X, Y, Z] m, of which R or fewer are below `band`.
        band: float32, m.
        first: int64 [3] lattice indices of the first voxel.
        cut_by: uint8 [X, Y, Z] numbers of cameras, of which there are so many; others are not known, and `nobody` is
            written; [0, 0, 0] if none is known.
        voxel_m: edge of a voxel.
        extra: uint32 [E] the last column, E <= R.
    """
    n = 0
    for i in range(sdf.shape[0]):
        x = np.float32((first[0] + i + 0.5) * voxel_m)
        for j in range(sdf.shape[1]):
            y = np.float32((first[1] + j + 0.5) * voxel_m)
            row = sdf[i, j]
            for k in range(len(row)):
                if not row[k] < band:
                    continue
                number = numbers[n]
                number[0], number[1], number[2] = x, y, np.float32((first[2] + k + 0.5) * voxel_m)
                number[3] = row[k]
                camera = np.int64(cut_by[i, j, k]) if cut_by.size > 0 else nobody
                words[n, 4] = camera if camera < cameras else nobody
                words[n, 5] = extra[n] if n < len(extra) else 0
                n += 1
    for m in range(n, len(words)):
        words[m, :5] = words[n - 1, :5]
        words[m, 5] = extra[m]


@njit(cache=True, nogil=True)
def read_rows(words: Any, numbers: Any, voxel_m: float) -> Any:
    """What `write_rows` wrote.

    Args:
        words, numbers: the rows, as there.
        voxel_m: edge of a voxel.

    Returns:
        indices int32 [R, 3], sdf float32 [R], camera uint8 [R]; the largest |sdf| (infinite if some is not a number),
        the largest sdf, the largest number of a camera, and how far from the centre of its voxel a point is at most, in
        voxels (infinite if its index has more than 16 bits).
    """
    count = len(words)
    indices = np.zeros((count, 3), np.int32)
    sdf = np.empty(count, np.float32)
    camera = np.empty(count, np.uint8)
    largest: Any = 0
    widest: Any = 0.0
    highest: Any = -np.inf
    astray: Any = 0.0
    for n in range(count):
        for axis in range(3):
            place = np.float64(numbers[n, axis]) / voxel_m - 0.5
            if -32768.5 < place < 32767.5:  # NaN is not
                index = np.int64(np.floor(place + 0.5))
                indices[n, axis] = index
                astray = max(astray, abs(place - index))
            else:
                astray = np.inf
        value = np.float64(numbers[n, 3])
        sdf[n] = numbers[n, 3]
        widest = max(widest, abs(value)) if np.isfinite(value) else np.inf
        highest = max(highest, value)
        who = np.int64(words[n, 4] & np.uint32(0xFFFF))
        largest = max(largest, who)
        camera[n] = who & 0xFF
    return indices, sdf, camera, widest, highest, largest, astray
