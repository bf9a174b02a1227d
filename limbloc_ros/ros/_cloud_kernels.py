# SPDX-License-Identifier: Apache-2.0
"""Numba kernels of the hull's cloud; `cloud_messages` documents the layout and validates, these trust their caller."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def write_rows(
    words: Any,
    numbers: Any,
    halves: Any,
    sdf: Any,
    band: Any,
    first: Any,
    cut_by: Any,
    viewpoints: Any,
    nobody: int,
    voxel_m: float,
    voxel_um: int,
    band_um: int,
) -> None:
    """Fill the rows of a hull's cloud but for the views, in one pass.

    Args:
        words, numbers, halves: the same rows as uint32 [V, 12], float32 [V, 12] and int16 [V, 24].
        sdf: float32 [X, Y, Z] m, of which V are below `band`.
        band: float32, m.
        first: int64 [3] lattice indices of the first voxel.
        cut_by: uint8 [X, Y, Z] rows of `viewpoints`, or other numbers: nobody is known there; [0, 0, 0] if nowhere.
        viewpoints: float32 [C, 3] m.
        nobody: what is written for those.
        voxel_m: edge of a voxel; voxel_um, band_um: it and the band in micrometres.
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
                point, number, half = words[n], numbers[n], halves[n]
                number[0], number[1], number[2] = x, y, np.float32((first[2] + k + 0.5) * voxel_m)
                number[3] = row[k]
                half[8], half[9], half[10] = first[0] + i, first[1] + j, first[2] + k
                camera = np.int64(cut_by[i, j, k]) if cut_by.size > 0 else nobody
                known = camera < len(viewpoints)
                half[11] = camera if known else nobody
                point[6], point[7] = voxel_um, band_um
                for axis in range(3):
                    number[8 + axis] = viewpoints[camera, axis] if known else np.float32(0.0)
                point[11] = 0
                n += 1


@njit(cache=True, nogil=True)
def read_rows(words: Any, numbers: Any, halves: Any, nobody: int) -> Any:
    """What `write_rows` wrote.

    Args:
        words, numbers, halves: the rows, as there.

    Returns:
        indices int32 [V, 3], sdf float32 [V], camera uint8 [V], viewpoints float32 [C, 3] up to the last known camera;
        the largest |sdf| (infinite if some is not a number), the largest sdf, the largest number of a camera, and
        whether all rows have the first one's sizes.
    """
    count = len(words)
    indices = np.empty((count, 3), np.int32)
    sdf = np.empty(count, np.float32)
    camera = np.empty(count, np.uint8)
    viewpoints = np.zeros((nobody, 3), np.float32)
    cameras: Any = 0
    largest: Any = 0
    widest: Any = 0.0
    highest: Any = -np.inf
    same: Any = True
    for n in range(count):
        for axis in range(3):
            indices[n, axis] = halves[n, 8 + axis]
        value = np.float64(numbers[n, 3])
        sdf[n] = numbers[n, 3]
        widest = max(widest, abs(value)) if np.isfinite(value) else np.inf
        highest = max(highest, value)
        who = np.int64(np.uint16(halves[n, 11]))
        largest = max(largest, who)
        camera[n] = who if who < nobody else nobody
        if who < nobody:
            cameras = max(cameras, who + 1)
            for axis in range(3):
                viewpoints[who, axis] = numbers[n, 8 + axis]
        same = same and words[n, 6] == words[0, 6] and words[n, 7] == words[0, 7]
    return indices, sdf, camera, viewpoints[:cameras].copy(), widest, highest, largest, same
