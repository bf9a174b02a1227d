# SPDX-License-Identifier: Apache-2.0
"""Compiled loops of `mask_cleaning`, on masks of one bit per pixel and on the runs of set pixels in their rows.

A person's silhouette is some 20 000 pixels but only some 500 runs; which of them hang together, how large they are and
where they lie is found from the runs.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from limbloc_ros.core._bit_kernels import (
    END,
    ROW,
    START,
    WORD,
    Bits,
    Bytes,
    Runs,
    Widths,
    at_least,
    beside,
    between,
    clear_runs,
    count_in,
    dilate,
    erode,
    highest,
    inverse,
    lowest,
    mostly,
    runs_of,
    set_runs,
    spread_row,
)
from limbloc_ros.core._union_kernels import join

Labels = NDArray[np.int32]

FRACTION = 256
"""Fixed point of the outline's fraction."""


@njit(cache=True)
def parts_of(runs: Runs, diagonal: bool) -> Labels:
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
            join(parents, run, other)
            other += 1
    for run in range(len(runs)):
        parents[run] = parents[parents[run]]
    return parents


@njit(cache=True)
def keep_strong_parts(weak: Bits, strong: Bits, width: int) -> None:
    """Clear in `weak`, in place, the 8-connected parts without any pixel of `strong` (hysteresis)."""
    runs = runs_of(weak, width)
    parts = parts_of(runs, True)
    kept = np.zeros(len(runs), dtype=np.bool_)
    for k in range(len(runs)):
        if not kept[parts[k]]:
            kept[parts[k]] = count_in(strong, runs[k, ROW], runs[k, START], runs[k, END]) > 0
    clear_runs(weak, runs[~kept[parts]])


@njit(cache=True)
def erase_blobs(mask: Bits, width: int, least: float) -> None:
    """Erase the 8-connected parts of fewer than `least` pixels, in place."""
    runs = runs_of(mask, width)
    parts = parts_of(runs, True)
    size = np.zeros(len(runs), dtype=np.int64)
    for k in range(len(runs)):
        size[parts[k]] += runs[k, END] - runs[k, START]
    clear_runs(mask, runs[size[parts] < least])


@njit(cache=True)
def _at_rim(y: int, start: int, end: int, height: int, width: int) -> bool:
    return y == 0 or y == height - 1 or start == 0 or end == width


@njit(cache=True)
def box_around(mask: Bits, width: int, pad: int) -> tuple[int, int, int, int]:
    """First and last row, first and last column of `pad` pixels around a mask, within the array.

    Of an empty mask the last row is above the first.
    """
    height, number = mask.shape
    top, bottom, left, right = height, -1, width, -1
    for y in range(height):
        for k in range(number):
            if mask[y, k]:
                top, bottom = min(top, y), y
                left = min(left, WORD * k + lowest(mask[y, k]))
                right = max(right, WORD * k + highest(mask[y, k]))
    if bottom < 0:
        return height, -1, width, -1
    return max(top - pad, 0), min(bottom + pad, height - 1), max(left - pad, 0), min(right + pad, width - 1)


@njit(cache=True)
def _sum(values: Bytes, y: int, start: int, end: int) -> int:
    total = 0
    for x in range(start, end):
        total += values[y, x]
    return total


@njit(cache=True)
def add_body_parts(
    mask: Bits, changed: Bits, colour: Bytes, least_colour: float, border_ratio: float, box: tuple[int, int, int, int]
) -> None:
    """Add to `mask`, in place, the 4-connected changed parts outside it that are more body than shadow.

    A part is body when its border pixels beside `mask` are more than `border_ratio` times those beside unchanged
    background, its mean `colour` is above `least_colour`, and it does not reach to the rim of a box around the
    foreground.

    Args:
        mask, changed: [H, N] bits.
        colour: [H, W] evidence.
        box: first and last row, first and last column of the box.
    """
    height, width = colour.shape
    top, bottom, left, right = box
    by_mask, by_background = beside(mask), beside(inverse(mask | changed, width))
    runs = runs_of(changed & ~mask, width)
    parts = parts_of(runs, False)
    size = np.zeros(len(runs), dtype=np.int64)
    inner, outer, total = size.copy(), size.copy(), size.copy()
    for k in range(len(runs)):
        part, y, start, end = parts[k], runs[k, ROW], runs[k, START], runs[k, END]
        size[part] += end - start
        if y <= top or y >= bottom or start <= left or end > right:
            total[part] -= 255 * height * width  # never above `least_colour`
            continue
        total[part] += _sum(colour, y, start, end)
        inner[part] += count_in(by_mask, y, start, end)
        outer[part] += count_in(by_background, y, start, end)
    body = (inner > border_ratio * outer) & (total > least_colour * size)
    set_runs(mask, runs[body[parts]])


@njit(cache=True)
def fill_holes(mask: Bits, changed: Bits, colour: Bytes, least_colour: float, least: float) -> None:
    """Fill the holes (4-connected, not at the rim) of `mask` that are small or no real holes, in place.

    A true hole, seen between arm and trunk, shows the background itself. A hole that is mostly changed and merely has
    nearly the background's colour under less light is cloth.

    Args:
        mask, changed: [H, N] bits.
        colour: [H, W] evidence.
        least_colour: mean colour from which on a changed hole is cloth.
        least: holes of fewer pixels are filled in any case.
    """
    height, width = colour.shape
    runs = runs_of(inverse(mask, width), width)
    parts = parts_of(runs, False)
    size = np.zeros(len(runs), dtype=np.int64)
    outside = height * width  # larger than any hole, so that no sum of runs with it is taken for one
    least = min(least, outside)
    for k in range(len(runs)):
        y, start, end = runs[k, ROW], runs[k, START], runs[k, END]
        size[parts[k]] += outside if _at_rim(y, start, end, height, width) else end - start
    altered, total = np.zeros_like(size), np.zeros_like(size)
    for k in range(len(runs)):
        part, y, start, end = parts[k], runs[k, ROW], runs[k, START], runs[k, END]
        if least <= size[part] < outside:
            altered[part] += count_in(changed, y, start, end)
            total[part] += _sum(colour, y, start, end)
    cloth = (2 * altered > size) & (total > least_colour * size)
    set_runs(mask, runs[((size < least) | cloth)[parts]])


# One loop to a function: together in one they are too much for the compiler to put on vectors.


@njit(cache=True)
def _both(values: Bytes, flags: Bytes, out: Bytes) -> None:
    for x in range(values.size):
        out[x] = values[x] & flags[x]


@njit(cache=True)
def _tallest(rows: Bytes, out: Bytes) -> None:
    """The largest in each column of five rows."""
    a, b, c, d, e = rows[0], rows[1], rows[2], rows[3], rows[4]
    for x in range(out.size):
        out[x] = max(max(max(a[x], b[x]), max(c[x], d[x])), e[x])


@njit(cache=True)
def _reaches(values: Bytes, tallest: Bytes, fraction: np.uint16, out: Bytes) -> None:
    """1 where a value is at least a fraction of the largest within two columns: `tallest` begins two to the left."""
    half = np.uint16(FRACTION // 2)
    for x in range(values.size):
        most = max(max(max(tallest[x], tallest[x + 1]), max(tallest[x + 3], tallest[x + 4])), tallest[x + 2])
        out[x] = np.uint8(np.uint16(values[x]) >= np.uint16((np.uint16(most) * fraction + half) >> np.uint16(8)))


@njit(cache=True)
def trim(mask: Bits, core: Bits, change: Bytes, fraction: int) -> None:
    """Clear the pixels outside `core` whose change is below a fraction of the largest in the mask within two pixels.

    Args:
        mask, core: [H, N] bits; the mask is changed in place.
        change: [H, W] evidence.
        fraction: in units of 1 / FRACTION.
    """
    height, width = change.shape
    # Five rows of the change inside the mask, each with two empty pixels at both ends.
    inside = np.zeros((5, width + 4), dtype=np.uint8)
    tallest = np.zeros(width + 4, dtype=np.uint8)
    flags = np.zeros((height, width), dtype=np.uint8)
    for y in range(height + 2):
        row = inside[y % 5, 2 : width + 2]
        if y < height:
            spread_row(mask, y, flags, y, width)
            _both(change[y], flags[y], row)
        else:
            row[:] = 0
        if y >= 2:
            _tallest(inside, tallest)
            _reaches(change[y - 2], tallest, np.uint16(fraction), flags[y - 2])
    mask &= core | at_least(flags, 1)


@njit(cache=True)
def foreground(
    change: Bytes, colour: Bytes, changed_level: int, weak_level: int, strong_level: int
) -> tuple[Bits, Bits]:
    """What is changed, and what of it is foreground by its colour, with hysteresis; single noisy pixels are neither.

    Args:
        change, colour: [H, W] evidence.
        changed_level: level of `change` from which on a pixel is changed.
        weak_level, strong_level: levels of `colour`.

    Returns:
        two masks [H, N], bits.
    """
    width = change.shape[1]
    changed = mostly(at_least(change, changed_level), width)
    mask = changed & mostly(at_least(colour, weak_level), width)
    strong = mask & mostly(at_least(colour, strong_level), width)
    keep_strong_parts(mask, strong, width)
    return changed, mask


@njit(cache=True)
def silhouette(
    mask: Bits,
    changed: Bits,
    change: Bytes,
    colour: Bytes,
    opening: Widths,
    closing: Widths,
    cloth: float,
    border_ratio: float,
    box: tuple[int, int, int, int],
    hole: float,
    fraction: int,
    least: float,
) -> Bits:
    """From foreground to a silhouette, in one call.

    Args:
        mask, changed: [H, N] bits, as `foreground` gives them.
        change, colour: [H, W] evidence.
        opening, closing: windows, as for `dilate`.
        cloth, border_ratio, box: for `add_body_parts`.
        hole, least: smaller holes are filled, smaller blobs erased, px.
        fraction: as for `trim`; 0 for no trimming.

    Returns:
        [H, N] bits.
    """
    width = change.shape[1]
    if len(opening) > 1:
        mask = dilate(erode(mask, width, opening), width, opening)
    mask = erode(dilate(mask, width, closing), width, closing)
    # Skin or cloth in nearly the background's colour leaves bites in the outline and holes. A cast shadow touches the
    # body only at the feet; the shadow seen between two legs is enclosed by them but has the floor's very colour.
    add_body_parts(mask, changed, colour, cloth, border_ratio, box)
    fill_holes(mask, changed, colour, cloth, hole)
    if fraction > 0:
        # Blur spreads a person by a pixel or two; the true outline is where the change has half its inner value. A
        # wider window would also drop the halo that video codecs draw, but with it faint limbs beside something of
        # high contrast.
        trim(mask, erode(mask, width, np.full(5, 2, dtype=np.int32)), change, fraction)
        cross = np.array([0, 1, 0], dtype=np.int32)
        mask = erode(dilate(mask, width, cross), width, cross)
        fill_holes(mask, changed, colour, cloth, hole)
    erase_blobs(mask, width, least)
    return mask


@njit(cache=True)
def place(part: Bits, top: int, left: int, rim: Widths, mask: Bytes, busy: Bits) -> int:
    """Put the mask of a part of an image where it belongs.

    The outermost pixels of the image, which cannot be judged by their neighbours, follow the next ones.

    Args:
        part: [h, n] bits.
        top, left: where in the image it begins; `left` is a multiple of WORD.
        rim: window, as for `dilate`.
        mask: [H, W] out, 255 where the part is set; 0 before.
        busy: [H, N] bits, out: that, and `rim` around it; 0 before.

    Returns:
        how many pixels are set.
    """
    height, width = mask.shape
    first, rows = left // WORD, len(part)
    wide = min(WORD * part.shape[1], width - left)
    last = wide - 1
    for y in range(rows):
        if left == 0:
            part[y, 0] = (part[y, 0] & ~between(0, 1, 0)) | ((part[y, 0] >> np.uint64(1)) & between(0, 1, 0))
        if left + wide == width:
            edge = between(last, wide, last // WORD)
            part[y, -1] = (part[y, -1] & ~edge) | (edge if count_in(part, y, last - 1, last) else np.uint64(0))
    if top == 0:
        part[0] = part[1]
    if top + rows == height:
        part[-1] = part[-2]
    around = dilate(part, wide, rim)
    total = 0
    for y in range(rows):
        busy[top + y, first : first + part.shape[1]] = around[y]
        spread_row(part, y, mask[:, left:], top + y, wide)
        total += count_in(part, y, 0, wide)
    return total
