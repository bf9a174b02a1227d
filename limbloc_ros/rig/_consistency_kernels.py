# SPDX-License-Identifier: Apache-2.0
"""Numba kernels of `consistency`: small masks, which voxels cameras deny, and what of the foreground voxels explain."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def shrink(
    mask: Any, box: Any, columns: Any, column_shares: Any, rows: Any, row_shares: Any, whole: Any, out: Any
) -> None:
    """Set `out` to 1 where the mask (0 or 1; all 0 beside `box`: left, top, width, height) has no less than half of 1.

    The pixels of one of the small columns are `columns` [w, 2], first and how many, and count `column_shares` [w, K]
    each; the same of rows. If all count the same, `whole` is that share (else 0). The sums are those of OpenCV's
    INTER_AREA, number by number, but only where a small pixel has some of both.
    """
    left, top, width, height = box
    first, last = 0, len(columns)
    while first < last and columns[first, 0] + columns[first, 1] <= left:
        first += 1
    while last > first and columns[last - 1, 0] >= left + width:
        last -= 1
    if first == last:
        return
    begin, end = columns[first, 0], columns[last - 1, 0] + columns[last - 1, 1]
    some = np.empty(end - begin, np.uint8)
    every = np.empty(end - begin, np.uint8)
    for j in range(len(rows)):
        y0, y1 = rows[j, 0], rows[j, 0] + rows[j, 1]
        if y1 <= top or y0 >= top + height:
            continue
        some[:] = mask[y0, begin:end]
        every[:] = some
        for y in range(y0 + 1, y1):
            line = mask[y, begin:end]
            for x in range(len(line)):
                some[x] |= line[x]
                every[x] &= line[x]
        for i in range(first, last):
            x0, n = columns[i]
            any_one, all_one = np.uint8(0), np.uint8(1)
            for x in range(x0 - begin, x0 - begin + n):
                any_one |= some[x]
                all_one &= every[x]
            if all_one:
                out[j, i] = 1
            elif any_one:
                out[j, i] = _share(mask, x0, n, column_shares[i], y0, y1, row_shares[j], whole) >= np.float32(0.5)


@njit(cache=True, nogil=True, error_model="numpy")
def _share(mask: Any, x0: int, n: int, column_shares: Any, y0: int, y1: int, row_shares: Any, whole: Any) -> np.float32:
    if whole > 0.0:
        count = 0
        for y in range(y0, y1):
            for x in range(x0, x0 + n):
                count += mask[y, x]
        return np.float32(count) * whole  # type: ignore[no-any-return]
    total = np.float32(0.0)
    for y in range(y0, y1):
        line = np.float32(0.0)
        for k in range(n):
            line += np.float32(mask[y, x0 + k]) * column_shares[k]
        total += row_shares[y - y0] * line
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def sole_deniers(pixels: Any, cameras: Any, open_masks: Any, offsets: Any) -> tuple[Any, Any]:
    """The voxels that no more than one of the cameras [N] denies and more than half see: which [n], and who [n] denies
    each, an index into the cameras or N.

    `pixels` [C, V]: index into each camera's mask, of which camera n's begins at `offsets[n]` in `open_masks`; -1: it
    does not see the voxel.
    """
    count, nobody = pixels.shape[1], len(cameras)
    voxels = np.arange(count)
    who = np.full(count, nobody, np.int16)
    seen = np.zeros(count, np.int16)
    for c in range(nobody):
        line, offset = pixels[cameras[c]], offsets[c]
        kept = 0
        for n in range(count):  # without a branch: whoever denies voxels is as good as random
            v, by = voxels[n], who[n]
            sees = line[v] >= 0
            denied = sees & (open_masks[offset + max(line[v], 0)] == 0)
            voxels[kept] = v
            who[kept] = c if denied else by
            seen[kept] = seen[n] + sees
            kept += not (denied & (by < nobody))
        count = kept
    kept = 0
    for n in range(count):
        voxels[kept], who[kept] = voxels[n], who[n]
        kept += seen[n] > max(1, nobody // 2)
    return voxels[:kept].copy(), who[:kept].copy()


@njit(cache=True, nogil=True, error_model="numpy")
def explained(pixels: Any, cameras: Any, voxels: Any, begins: Any, cores: Any, frames: Any, halves: Any) -> Any:
    """How many pixels of each camera's core [N] voxels cover: int64 [N + 1, N], in row i those that nobody but camera i
    denies, in the last those that nobody denies.

    Args:
        pixels, cameras: as in `sole_deniers`.
        voxels: by who denies them; those of i are from `begins[i]` to before `begins[i + 1]`.
        cores: uint8, 1 in a core, each camera's image as `frames` [N, 3] tells: first element, width, height.
        halves: [N, 2 R + 1] what a voxel covers: half the width of each row, less a half; -1: nothing.
    """
    nobody = len(cameras)
    counts = np.zeros((nobody + 1, nobody), np.int64)
    reach = halves.shape[1] // 2
    for k in range(nobody):
        offset, width, height = frames[k]
        open_yet = cores[offset : offset + width * height].astype(np.int16)  # 1, or who covered it last and 2
        line = pixels[cameras[k]]
        for turn in range(nobody + 1):
            who = nobody if turn == 0 else turn - 1  # what nobody denies is there for all others
            mark = np.int16(0 if turn == 0 else turn + 1)
            found = 0
            for n in range(begins[who], begins[who + 1]):
                at = line[voxels[n]]
                if at < 0:
                    continue
                y, x = at // width, at % width
                for row in range(max(0, y - reach), min(height, y + reach + 1)):
                    half = halves[k, row - y + reach]
                    begin = row * width + max(0, x - half)
                    for m in range(begin, row * width + min(width, x + half + 1)):
                        new = (open_yet[m] != 0) & (open_yet[m] != mark)
                        found += new
                        open_yet[m] = mark if new else open_yet[m]
            counts[who, k] = found + (0 if turn == 0 else counts[nobody, k])
    return counts
