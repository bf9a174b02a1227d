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
    spread,
    spread_row,
    words,
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
    by_mask, by_background = beside(mask, width), beside(inverse(mask | changed, width), width)
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
def _most_of_five(a: Bytes, b: Bytes, c: Bytes, d: Bytes, e: Bytes, out: Bytes) -> None:
    for x in range(out.size):
        out[x] = max(max(max(a[x], b[x]), max(c[x], d[x])), e[x])


@njit(cache=True)
def _reaches(values: Bytes, most: Bytes, fraction: np.uint16, out: Bytes) -> None:
    """1 where a value is at least a fraction of another one."""
    half = np.uint16(FRACTION // 2)
    for x in range(out.size):
        out[x] = np.uint8(np.uint16(values[x]) >= np.uint16((np.uint16(most[x]) * fraction + half) >> np.uint16(8)))


@njit(cache=True)
def trim(mask: Bits, core: Bits, change: Bytes, fraction: int) -> None:
    """Clear the pixels outside `core` whose change is below a fraction of the largest in the mask within two pixels.

    Args:
        mask, core: [H, N] bits; the mask is changed in place.
        change: [H, W] evidence.
        fraction: in units of 1 / FRACTION.
    """
    height, width = change.shape
    pitch, fraction_of = width + 4, np.uint16(fraction)
    # The change inside the mask, with two empty pixels on all sides; as one long line, which costs less than many short
    # ones.
    flags, inside = spread(mask, width), np.zeros((height + 4, pitch), dtype=np.uint8)
    for y in range(height):
        _both(change[y], flags[y], inside[y + 2, 2:-2])
    line, size = inside.reshape(-1), height * pitch
    tallest, most = np.empty(size, dtype=np.uint8), np.empty((height, pitch), dtype=np.uint8)
    _most_of_five(line, line[pitch:], line[2 * pitch :], line[3 * pitch :], line[4 * pitch :], tallest)
    out = most.reshape(-1)[: size - 4]
    _most_of_five(tallest, tallest[1:], tallest[2:], tallest[3:], tallest[4:], out)
    for y in range(height):
        _reaches(change[y], most[y], fraction_of, flags[y])
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
def _cut_out(values: Bytes, top: int, bottom: int, left: int, right: int) -> Bytes:
    """The rows `top` to before `bottom` of the columns `left` to before `right`."""
    out = np.empty((bottom - top, right - left), dtype=np.uint8)
    for y in range(len(out)):
        row = values[top + y, left:right]
        for x in range(out.shape[1]):
            out[y, x] = row[x]
    return out


@njit(cache=True)
def _least_of(a: Bytes, b: Bytes, c: Bytes, out: Bytes) -> None:
    for x in range(out.size):
        out[x] = min(min(a[x], b[x]), c[x])


@njit(cache=True)
def _most_of(a: Bytes, b: Bytes, c: Bytes, out: Bytes) -> None:
    for x in range(out.size):
        out[x] = max(max(a[x], b[x]), c[x])


@njit(cache=True)
def _middle_of(a: Bytes, b: Bytes, c: Bytes, out: Bytes) -> None:
    for x in range(out.size):
        out[x] = max(min(a[x], b[x]), min(max(a[x], b[x]), c[x]))


@njit(cache=True)
def median_of_nine(values: Bytes) -> Bytes:
    """The median of each pixel's neighbourhood; the outermost pixels count as their neighbours outside as well."""
    height, width = values.shape
    pitch = width + 2
    padded = np.empty((height + 2, pitch), dtype=np.uint8)
    for y in range(height + 2):
        row, out = values[min(max(y - 1, 0), height - 1)], padded[y]
        out[0], out[-1] = row[0], row[-1]
        for x in range(width):
            out[x + 1] = row[x]
    # Across the ends of rows as well: one long loop costs less than many short ones.
    line, size = padded.reshape(-1), height * pitch
    above, here, below = line[:size], line[pitch:], line[2 * pitch :]
    some = np.empty((6, size), dtype=np.uint8)
    low, middle, high, low3, middle3, high3 = some[0], some[1], some[2], some[3], some[4], some[5]
    _least_of(above, here, below, low)
    _middle_of(above, here, below, middle)
    _most_of(above, here, below, high)
    _most_of(low, low[1:], low[2:], low3[:-2])
    _middle_of(middle, middle[1:], middle[2:], middle3[:-2])
    _least_of(high, high[1:], high[2:], high3[:-2])
    _middle_of(low3, middle3, high3, line[: size - 2])
    return _cut_out(padded, 0, height, 0, width)  # type: ignore[no-any-return]


@njit(cache=True)
def clean(
    change: Bytes,
    colour: Bytes,
    changed_level: int,
    weak_level: int,
    strong_level: int,
    reach: int,
    opening: Widths,
    closing: Widths,
    cloth: float,
    border_ratio: float,
    hole: float,
    fraction: int,
    least: float,
) -> Bits:
    """From evidence to a silhouette, in one call: `foreground` and `silhouette`, with their arguments.

    Args:
        change, colour: [H, W] evidence; may be empty.
        reach: `silhouette` looks at the foreground and this many pixels around it.
    """
    width = change.shape[1]
    if change.size == 0:
        return np.zeros((0, 0), dtype=np.uint64)
    changed, mask = foreground(change, colour, changed_level, weak_level, strong_level)
    top, bottom, left, right = box_around(mask, width, reach)
    if bottom < top:
        return mask  # type: ignore[no-any-return]
    bottom += 1
    first, last = left // WORD, right // WORD + 1
    begin, end = WORD * first, min(WORD * last, width)
    cleaned = silhouette(
        mask[top:bottom, first:last].copy(),
        changed[top:bottom, first:last].copy(),
        _cut_out(change, top, bottom, begin, end),
        median_of_nine(_cut_out(colour, top, bottom, begin, end)),
        opening,
        closing,
        cloth,
        border_ratio,
        (0, bottom - 1 - top, left - begin, right - begin),
        hole,
        fraction,
        least,
    )
    mask[:] = np.uint64(0)
    mask[top:bottom, first:last] = cleaned
    return mask  # type: ignore[no-any-return]


@njit(cache=True)
def place(part: Bits, top: int, left: int, rim: Widths, height: int, width: int) -> tuple[Bytes, Bits, int]:
    """Put the mask of a part of an image where it belongs.

    The outermost pixels of the image, which cannot be judged by their neighbours, follow the next ones.

    Args:
        part: [h, n] bits; may be empty. Its pixels at the rim of the image are changed in place.
        top, left: where in the image it begins; `left` is a multiple of WORD.
        rim: window, as for `dilate`.
        height, width: H and W of the image.

    Returns:
        [H, W] the image's mask, 255 where the part is set; [H, N] bits, the same and `rim` around it; and how many
        pixels are set.
    """
    mask, busy = np.zeros((height, width), dtype=np.uint8), np.zeros((height, words(width)), dtype=np.uint64)
    if part.size == 0:
        return mask, busy, 0
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
    columns = mask[:, left:]
    total = 0
    for y in range(rows):
        busy[top + y, first : first + part.shape[1]] = around[y]
        spread_row(part, y, columns, top + y, wide)
        total += count_in(part, y, 0, wide)
    return mask, busy, total
