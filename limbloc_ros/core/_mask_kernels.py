# SPDX-License-Identifier: Apache-2.0
"""Compiled loops of `mask_cleaning`, on the runs of set pixels that a silhouette's rows consist of.

A person's silhouette is some 20 000 pixels but only some 500 runs; which of them hang together, how large they are and
where they lie is found from the runs.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]
Labels = NDArray[np.int32]

ROW, START, END = 0, 1, 2
"""Columns of an array of runs: the row, the first column, and the one behind the last."""


@njit(cache=True)
def mostly_at_least(change: Bytes, change_level: int, colour: Bytes, colour_level: int, out: Bytes) -> None:
    """Set `out` where at least 5 of the 9 pixels around have this change, and as many this colour.

    That is where the medians of both reach their levels. The outermost pixels are cleared.

    Args:
        change, colour: [H, W] evidence.
        change_level, colour_level: the levels.
        out: [H, W] 0 or 255.
    """
    height, width = out.shape
    # Both counts share a byte, four bits each, so that one addition counts both for 32 pixels on a vector.
    one, sixteen = np.uint8(1), np.uint8(16)
    far, coloured = np.uint8(change_level), np.uint8(colour_level)
    codes = np.zeros((3, width), dtype=np.uint8)
    column = np.zeros(width, dtype=np.uint8)
    out[0] = 0
    out[height - 1] = 0
    for y in range(height):
        code, change_row, colour_row = codes[y % 3], change[y], colour[y]
        for x in range(width):
            code[x] = (one if change_row[x] >= far else np.uint8(0)) | (
                sixteen if colour_row[x] >= coloured else np.uint8(0)
            )
        if y < 2:
            continue
        above, here, below, row = codes[0], codes[1], codes[2], out[y - 1]
        for x in range(width):
            column[x] = np.uint8(above[x] + here[x] + below[x])
        row[0] = 0
        row[width - 1] = 0
        for x in range(1, width - 1):
            count = np.uint8(column[x - 1] + column[x] + column[x + 1])
            enough = ((count & np.uint8(15)) >= np.uint8(5)) & (count >= np.uint8(80))
            row[x] = np.uint8(255) if enough else np.uint8(0)


@njit(cache=True)
def runs_of(mask: Bytes, wanted: int) -> Labels:
    """The runs of pixels that are set (`wanted` 255) or not (`wanted` 0), row by row.

    Args:
        mask: [H, W] C-contiguous, 0 or 255.

    Returns:
        [R, 3] ROW, START, END.
    """
    height, width = mask.shape
    flat = mask.ravel()
    size = flat.size
    # Most of an image is the same for long: eight pixels at a time are skipped.
    words = flat[: size - size % 8].view(np.uint64)
    full = np.uint64(0xFFFFFFFFFFFFFFFF) if wanted == 255 else np.uint64(0)
    empty = ~full
    runs = np.empty((4 * height, 3), dtype=np.int32)
    found = 0
    at = 0
    while at < size:
        if at & 7 == 0:
            word = at >> 3
            while word < words.size and words[word] == empty:
                word += 1
            at = word << 3
        while at < size and flat[at] != wanted:
            at += 1
            if at & 7 == 0:
                break
        if at == size or flat[at] != wanted:
            continue
        row = at // width
        start = row * width
        end = start + width
        if found == len(runs):
            runs = np.concatenate((runs, np.empty_like(runs)))
        runs[found, ROW] = row
        runs[found, START] = at - start
        while at < end and flat[at] == wanted:
            at += 1
            if at & 7 == 0:
                word = at >> 3
                while word << 3 <= end - 8 and words[word] == full:
                    word += 1
                at = word << 3
        runs[found, END] = at - start
        found += 1
    return runs[:found]


@njit(cache=True)
def _root(parents: Labels, run: int) -> int:
    while parents[run] != run:
        parents[run] = parents[parents[run]]
        run = parents[run]
    return run


@njit(cache=True)
def parts_of(runs: Labels, diagonal: bool) -> Labels:
    """Which runs hang together: [R] the first run of the part that each belongs to.

    Args:
        runs: as `runs_of` gives them.
        diagonal: whether pixels that touch at a corner hang together.
    """
    parents = np.arange(len(runs)).astype(np.int32)
    reach = 1 if diagonal else 0
    above = 0
    for run in range(len(runs)):
        row, start, end = runs[run, ROW], runs[run, START], runs[run, END]
        while runs[above, ROW] < row - 1 or (runs[above, ROW] == row - 1 and runs[above, END] + reach <= start):
            above += 1
        other = above
        while runs[other, ROW] == row - 1 and runs[other, START] < end + reach:
            a, b = _root(parents, run), _root(parents, other)
            parents[max(a, b)] = min(a, b)
            other += 1
    for run in range(len(runs)):
        parents[run] = parents[parents[run]]
    return parents


@njit(cache=True)
def paint(mask: Bytes, runs: Labels) -> None:
    """Set the pixels of these runs [R, 3] to 255, in place."""
    for k in range(len(runs)):
        mask[runs[k, ROW], runs[k, START] : runs[k, END]] = 255


@njit(cache=True)
def strong_parts(weak: Bytes, colour: Bytes, level: int) -> Labels:
    """The runs [R, 3] of those parts (8-connected) of `weak` that somewhere are mostly of this colour (hysteresis).

    Args:
        weak: [H, W] 0 or 255; the outermost pixels are 0.
        colour: [H, W] evidence.
        level: at least 5 of 9 pixels around some pixel of the part must have it.
    """
    runs = runs_of(weak, 255)
    parts = parts_of(runs, True)
    strong = np.zeros(len(runs), dtype=np.bool_)
    for k in range(len(runs)):
        y = runs[k, ROW]
        x = runs[k, START]
        while not strong[parts[k]] and x < runs[k, END]:
            count = 0
            for row in range(y - 1, y + 2):
                for column in range(x - 1, x + 2):
                    count += colour[row, column] >= level
            strong[parts[k]] = count >= 5
            x += 1
    return runs[strong[parts]]  # type: ignore[no-any-return]


@njit(cache=True)
def add_body_parts(
    mask: Bytes, changed: Bytes, colour: Bytes, threshold: int, least_colour: float, border_ratio: float
) -> None:
    """Add to `mask`, in place, the 4-connected changed parts outside it that are more body than shadow.

    A part is body when its border pixels beside `mask` are more than `border_ratio` times those beside unchanged
    background, its mean `colour` is above `least_colour`, and it does not touch the rim of the arrays.

    Args:
        mask: [H, W] C-contiguous, 0 or 255.
        changed, colour: [H, W] evidence; a pixel is changed at `threshold`.
    """
    height, width = mask.shape
    # 1: background, 2: foreground, 4: changed, but not foreground
    kinds = np.empty((height, width), dtype=np.uint8)
    for y in range(height):
        for x in range(width):
            kind = np.uint8(4) if changed[y, x] >= threshold else np.uint8(1)
            kinds[y, x] = np.uint8(2) if mask[y, x] != 0 else kind
    runs = runs_of((kinds == 4) * np.uint8(255), 255)
    parts = parts_of(runs, False)
    size = np.zeros(len(runs), dtype=np.int64)
    inner, outer, total = size.copy(), size.copy(), size.copy()
    for k in range(len(runs)):
        part, y = parts[k], runs[k, ROW]
        size[part] += runs[k, END] - runs[k, START]
        if y == 0 or y == height - 1 or runs[k, START] == 0 or runs[k, END] == width:
            total[part] -= 255 * height * width  # it touches the rim: never above `least_colour`
            continue
        for x in range(runs[k, START], runs[k, END]):
            total[part] += colour[y, x]
            beside = kinds[y - 1, x] | kinds[y + 1, x] | kinds[y, x - 1] | kinds[y, x + 1]
            inner[part] += (beside & 2) != 0
            outer[part] += beside & 1
    body = (inner > border_ratio * outer) & (total > least_colour * size)
    paint(mask, runs[body[parts]])


@njit(cache=True)
def erase_blobs(mask: Bytes, least: float) -> None:
    """Erase the 8-connected parts of `mask` of fewer than `least` pixels, in place."""
    runs = runs_of(mask, 255)
    parts = parts_of(runs, True)
    size = np.zeros(len(runs), dtype=np.int64)
    for k in range(len(runs)):
        size[parts[k]] += runs[k, END] - runs[k, START]
    for k in range(len(runs)):
        if size[parts[k]] < least:
            mask[runs[k, ROW], runs[k, START] : runs[k, END]] = 0


@njit(cache=True)
def fill_holes(mask: Bytes, changed: Bytes, colour: Bytes, threshold: int, least_colour: float, least: float) -> None:
    """Fill the holes (4-connected, not at the rim) of `mask` that are small or no real holes, in place.

    A true hole, seen between arm and trunk, shows the background itself. A hole that is mostly changed and merely has
    nearly the background's colour under less light is cloth.

    Args:
        mask: [H, W] C-contiguous, 0 or 255.
        changed, colour: [H, W] evidence; a pixel is changed at `threshold`.
        least_colour: mean colour from which on a changed hole is cloth.
        least: holes of fewer pixels are filled in any case.
    """
    height, width = mask.shape
    runs = runs_of(mask, 0)
    parts = parts_of(runs, False)
    size = np.zeros(len(runs), dtype=np.int64)
    for k in range(len(runs)):
        at_rim = runs[k, ROW] == 0 or runs[k, ROW] == height - 1 or runs[k, START] == 0 or runs[k, END] == width
        # The outside is larger than the array by this, so that no sum of runs is taken for a hole.
        size[parts[k]] += height * width if at_rim else runs[k, END] - runs[k, START]
    altered, total = np.zeros_like(size), np.zeros_like(size)
    for k in range(len(runs)):
        part, y = parts[k], runs[k, ROW]
        if size[part] < height * width:
            for x in range(runs[k, START], runs[k, END]):
                altered[part] += changed[y, x] >= threshold
                total[part] += colour[y, x]
    cloth = (2 * altered > size) & (total > least_colour * size)
    paint(mask, runs[((size < least) | cloth)[parts]])
