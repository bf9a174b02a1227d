# SPDX-License-Identifier: Apache-2.0
"""Numba kernels that draw a figure into coarse silhouettes; `views` documents them, they trust their caller."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from limbloc_ros.core._bit_kernels import WORD, between, word_at_least, words
from limbloc_ros.core._bit_kernels import count as count_bits
from limbloc_ros.core._projection_kernels import project, project_block, row_start
from limbloc_ros.core._union_kernels import join, root

#: In cells: background, foreground, and what nobody is asked about.
BARE, SEEN, UNASKED = 0, 1, 2
#: Where a figure was drawn that covers whatever is drawn later.
BODY = -1
#: What this is near to a camera (m) is not drawn.
CLOSEST = 0.1
#: Nor what is seen so many cells off.
FAR = 1e6
_ONE, _LAST = np.uint64(1), np.uint64(WORD - 1)


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def sample_cells(field: Any, boxes: Any, frames: Any, cells: Any) -> None:
    """Set to SEEN the cells (uint8, laid out as `frames` [C, 6] says) at whose centres the distance field is negative;
    what lies beyond a camera's piece of the field is background, and stays as it is."""
    for c in range(len(frames)):
        left, top, width, height, step, offset = frames[c]
        x0, y0, columns, rows, begin = boxes[c]
        left, top = left + step // 2 - x0, top + step // 2 - y0  # the first cell's centre, in the piece
        first = max(0, -(left // step))
        last = min(width, (columns - 1 - left) // step + 1)
        for j in range(height):
            y = top + j * step
            if y < 0 or y >= rows:
                continue
            row = field[begin + y * columns : begin + (y + 1) * columns]
            marks = cells[offset + j * width : offset + (j + 1) * width]
            for i in range(first, last):
                marks[i] = SEEN if row[left + i * step] < 0.0 else BARE


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def mark_points(points: Any, cams: Any, frames: Any, marks: Any) -> None:
    """Set to 1 the cells in which points [3, P] m are seen."""
    seen = np.empty((3, points.shape[1]))
    for c in range(len(frames)):
        left, top, width, height, step, offset = frames[c]
        project_block(cams, c, points, seen)
        for n in range(points.shape[1]):
            i = math.floor((seen[0, n] + 0.5 - left) / step)
            j = math.floor((seen[1, n] + 0.5 - top) / step)
            if seen[2, n] > 0.0 and i >= 0 and j >= 0 and i < width and j < height:
                marks[offset + j * width + i] = 1


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def keep_held(image: Any, marks: Any) -> tuple[int, int, int, int]:
    """Of the blobs (8-connected) of SEEN cells of an image [height, width] only those stay that hold a marked cell.

    Returns the first and the last (exclusive) column and row of what stays; four times 0 of nothing.

    Blobs are put together from runs of cells in a row, each of which knows an earlier one of its blob.
    """
    height, width = image.shape
    room = height * (width + 1) // 2
    runs = np.empty((room, 3), np.int32)  # row, first and last (exclusive) column
    parent = np.empty(room, np.int32)
    held = np.zeros(room, np.bool_)
    count, before = 0, 0  # `before`: the first run of the row above
    for y in range(height):
        row, above = count, before
        x = 0
        while x < width:
            if image[y, x] != SEEN:
                x += 1
                continue
            runs[count, 0], runs[count, 1] = y, x
            parent[count] = count
            while x < width and image[y, x] == SEEN:
                held[count] |= marks[y, x] != 0
                x += 1
            runs[count, 2] = x
            while above < row and runs[above, 2] < runs[count, 1]:
                above += 1
            touching = above
            while touching < row and runs[touching, 1] <= x:
                join(parent, touching, count)
                touching += 1
            count += 1
        before = row
    left, right, top, bottom = width, 0, height, 0
    for n in range(count):
        if held[n]:
            held[root(parent, n)] = True
    for n in range(count):
        y, first, last = runs[n]
        if held[root(parent, n)]:
            left, right, top, bottom = min(left, first), max(right, last), min(top, y), max(bottom, y + 1)
        else:
            image[y, first:last] = BARE
    return (left, right, top, bottom) if right > 0 else (0, 0, 0, 0)


# Rows are counted without a sign in these loops: an index that cannot count from the end leaves vector code.


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def _widen_by_disc(x: float, y: float, r: float, height: int, left: Any, right: Any) -> None:
    first = max(0, math.ceil(y - r))
    last = max(first - 1, min(height - 1, math.floor(y + r)))
    for row in range(np.uint64(first), np.uint64(last + 1)):
        away = np.float64(np.int64(row)) - y
        half = math.sqrt(max(0.0, r * r - away * away))
        left[row] = min(left[row], x - half)
        right[row] = max(right[row], x + half)


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def _widen_by_segment(x0: float, y0: float, x1: float, y1: float, height: int, left: Any, right: Any) -> None:
    if y0 > y1:
        x0, y0, x1, y1 = x1, y1, x0, y0
    slope = (x1 - x0) / (y1 - y0) if y1 - y0 > 1e-9 else 0.0  # of less it need not be a number
    first = max(0, math.ceil(y0))
    last = max(first - 1, min(height - 1, math.floor(y1)))
    for row in range(np.uint64(first), np.uint64(last + 1)):
        x = x0 + slope * (np.float64(np.int64(row)) - y0)
        left[row] = min(left[row], x)
        right[row] = max(right[row], x)


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def _widen_by_tangents(
    x0: float, y0: float, r0: float, x1: float, y1: float, r1: float, height: int, left: Any, right: Any
) -> None:
    """The two outer tangents of two discs; none if one lies in the other."""
    dx, dy = x1 - x0, y1 - y0
    square = dx * dx + dy * dy
    if square <= (r1 - r0) * (r1 - r0) or square < 1e-12:
        return
    along = (r0 - r1) / square
    across = math.sqrt(max(0.0, square - (r1 - r0) * (r1 - r0))) / square
    for sign in (-1.0, 1.0):
        nx = along * dx - sign * across * dy
        ny = along * dy + sign * across * dx
        _widen_by_segment(x0 + r0 * nx, y0 + r0 * ny, x1 + r1 * nx, y1 + r1 * ny, height, left, right)


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def see_balls(centres: Any, radii: Any, cams: Any, c: int, frame: Any, discs: Any) -> None:
    """Place and radius in one camera's cells, whose centres are whole numbers, to discs [S, 3]; radius -1: not seen."""
    left, top, _, _, step, _ = frame
    focal = math.sqrt(cams[c, 12] * cams[c, 13])
    for n in range(len(centres)):
        u, v, depth = project(cams, c, row_start(cams, c, centres[n, 0], centres[n, 1]), centres[n, 2])
        discs[n, 0] = (u - left - step // 2) / step
        discs[n, 1] = (v - top - step // 2) / step
        discs[n, 2] = radii[n] * focal / (depth * step) if depth > CLOSEST else -1.0
        if not (abs(discs[n, 0]) < FAR and abs(discs[n, 1]) < FAR and discs[n, 2] < FAR):
            discs[n, 2] = -1.0


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def _outline(parts: Any, p: int, discs: Any, height: int, left: Any, right: Any) -> tuple[int, int]:
    """First and last row in which part `p` is seen; its outermost columns in each, not yet whole, to left and right.

    A part is the convex hull of three balls; here that of the three discs that the balls are seen as: in each row its
    outermost points lie on a disc or on an outer tangent of two.
    """
    a, b, d = parts[p, 0], parts[p, 1], parts[p, 2]
    if min(discs[a, 2], discs[b, 2], discs[d, 2]) < 0.0:
        return 0, -1
    low, high = math.inf, -math.inf
    for n in (a, b, d):
        low = min(low, discs[n, 1] - discs[n, 2])
        high = max(high, discs[n, 1] + discs[n, 2])
    first = max(0, math.ceil(min(low, float(height))))
    last = min(height - 1, math.floor(max(high, -1.0)))
    for row in range(first, last + 1):
        left[row] = math.inf
        right[row] = -math.inf
    for m, n in ((a, b), (b, d), (d, a)):
        if m == n:
            continue
        _widen_by_disc(discs[m, 0], discs[m, 1], discs[m, 2], height, left, right)
        _widen_by_tangents(
            discs[m, 0], discs[m, 1], discs[m, 2], discs[n, 0], discs[n, 1], discs[n, 2], height, left, right
        )  # fmt: skip
    if a == b and b == d:
        _widen_by_disc(discs[a, 0], discs[a, 1], discs[a, 2], height, left, right)
    return first, last


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def draw_parts(parts: Any, discs: Any, frame: Any, span: Any, cells: Any, drawn: Any, mark: int) -> tuple[int, int]:
    """Write `mark` to the cells of one camera whose centres the parts cover, but where `drawn` is BODY.

    Another mark that is there already is replaced. `span` is scratch, [2, rows].

    Returns how many of the cells that get this mark are foreground, and background.
    """
    _, _, width, height, _, offset = frame
    left, right = span
    seen, bare = 0, 0
    for p in range(len(parts)):
        first, last = _outline(parts, p, discs, height, left, right)
        for row in range(first, last + 1):
            if not left[row] <= right[row]:
                continue  # between two discs that are hardly points; infinity is no column
            begin = math.ceil(max(left[row], 0.0))
            end = math.floor(min(right[row], width - 1.0))
            for at in range(offset + row * width + begin, offset + row * width + end + 1):
                if drawn[at] != mark and drawn[at] != BODY:
                    drawn[at] = mark
                    if cells[at] == BARE:
                        bare += 1
                    elif cells[at] == SEEN:
                        seen += 1
    return seen, bare


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def draw(parts: Any, centres: Any, radii: Any, cams: Any, frames: Any, cells: Any, drawn: Any) -> Any:
    """Write BODY (int16) to the cells whose centres a figure covers.

    Returns how many of these are foreground, and background, in every camera; int64 [C, 2].
    """
    discs = np.empty((len(centres), 3))
    span = np.empty((2, max(1, frames[:, 3].max())))
    counts = np.empty((len(frames), 2), np.int64)
    for c in range(len(frames)):
        see_balls(centres, radii, cams, c, frames[c], discs)
        counts[c, 0], counts[c, 1] = draw_parts(parts, discs, frames[c], span, cells, drawn, BODY)
    return counts


@njit(cache=True, inline="always", error_model="numpy")  # type: ignore[misc, unused-ignore]
def _fill(drawn: Any, first: int, last: int, width: int, offset: int, left: Any, right: Any) -> None:
    """Set the bits of the cells that a part covers, of which `_outline` tells; `left` and `right` are scratch then."""
    for row in range(np.uint64(first), np.uint64(last + 1)):  # first column, and how many: none if they cross
        begin = math.ceil(min(max(left[row], 0.0), float(width)))
        end = math.floor(min(max(right[row], -1.0), width - 1.0)) + 1
        left[row], right[row] = begin, max(end - begin, 0)
    for row in range(first, last + 1):
        begin, columns = offset + row * width + int(left[row]), int(right[row])
        k, shift = begin // WORD, np.uint64(begin % WORD)
        if columns < WORD:  # mostly, and without a branch for the word in which they end
            some = (_ONE << np.uint64(columns)) - _ONE
            drawn[k] |= some << shift
            drawn[k + 1] |= (some >> _ONE) >> (_LAST - shift)
        else:
            for k in range(begin // WORD, (begin + columns + WORD - 1) // WORD):
                drawn[k] |= between(begin, begin + columns, k)


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def covered(parts: Any, centres: Any, radii: Any, cams: Any, frames: Any, seen: Any, bare: Any) -> Any:
    """How many cells of foreground, and of background, a figure covers in every camera: int64 [C, 2]; see `draw`.

    Cells are bits here, from the lowest one of the first word on, in all words of `seen` and of `bare`: what is drawn
    over and over is ored, and all is counted in the end.
    """
    drawn = np.zeros(len(seen) + 2, np.uint64)  # a part beside an image is drawn with no bits, behind its last cell
    # only the balls of these parts
    place = np.full(len(centres), -1)
    balls = np.empty((len(centres), 4))
    used = 0
    own = np.empty_like(parts)
    for p in range(len(parts)):
        for k in range(3):
            s = parts[p, k]
            if place[s] < 0:
                place[s] = used
                balls[used, :3], balls[used, 3] = centres[s], radii[s]
                used += 1
            own[p, k] = place[s]
    discs = np.empty((used, 3))
    left, right = np.empty((2, max(1, frames[:, 3].max())))
    counts = np.zeros((len(frames), 2), np.int64)
    for c in range(len(frames)):
        _, _, width, height, _, offset = frames[c]
        see_balls(balls[:used, :3], balls[:used, 3], cams, c, frames[c], discs)
        for p in range(len(parts)):
            first, last = _outline(own, p, discs, height, left, right)
            _fill(drawn, first, last, width, offset, left, right)
        end = offset + width * height
        for k in range(offset // WORD, (end + WORD - 1) // WORD):
            word = drawn[k] & between(offset, end, k)
            counts[c, 0] += count_bits(word & seen[k])
            counts[c, 1] += count_bits(word & bare[k])
    return counts


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def draw_groups(
    parts: Any, groups: Any, count: int, centres: Any, radii: Any, cams: Any, frames: Any, cells: Any
) -> Any:
    """Foreground cells that no group of parts but one covers, in every camera, then those that any covers, and cells of
    background that any covers: int64 [C, count + 2].

    `groups` [P] says to which each part belongs, 0 to count - 1.
    """
    discs = np.empty((len(centres), 3))
    left, right = np.empty((2, max(1, frames[:, 3].max())))
    drawn = np.zeros((count, words(len(cells)) + 2), np.uint64)  # as in `covered`
    marks = cells.reshape(1, len(cells))
    counts = np.zeros((len(frames), count + 2), np.int64)
    for c in range(len(frames)):
        _, _, width, height, _, offset = frames[c]
        see_balls(centres, radii, cams, c, frames[c], discs)
        for p in range(len(parts)):
            first, last = _outline(parts, p, discs, height, left, right)
            _fill(drawn[groups[p]], first, last, width, offset, left, right)
        end = offset + width * height
        for k in range(offset // WORD, words(end)):
            some, several = np.uint64(0), np.uint64(0)
            for g in range(count):
                several |= some & drawn[g, k]
                some |= drawn[g, k]
            some &= between(offset, end, k)
            if some == np.uint64(0):
                continue
            number = min(WORD, len(cells) - WORD * k)
            not_bare = word_at_least(marks, 0, WORD * k, number, np.uint8(SEEN))
            seen = not_bare & ~word_at_least(marks, 0, WORD * k, number, np.uint8(UNASKED)) & some
            counts[c, count] += count_bits(seen)
            counts[c, count + 1] += count_bits(some & ~not_bare)
            for g in range(count):
                counts[c, g] += count_bits(drawn[g, k] & seen & ~several)
    return counts


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def draw_limbs(
    parts: Any, limbs: Any, centres: Any, radii: Any, cams: Any, frames: Any, cells: Any, drawn: Any, asked: Any,
    covers: Any, bare: Any,
) -> None:  # fmt: skip
    """What each of many places of a limb covers beside the body.

    Args:
        parts: [P, 3] the limb's, which may share balls with the body.
        limbs: [S] which of the balls move with the limb.
        centres: [M, S, 3] where these are in each place, m.
        radii: [S_all, 4] radius and place of every ball of the figure, m.
        cams, frames, cells: see `views.Views`.
        drawn: int16, BODY where the rest of the figure is, 0 elsewhere; is written to.
        asked: [Q] indices of cells.
        covers: bool [M, Q] out: whether the limb covers them.
        bare: int64 [C, M] out: how many cells of background.
    """
    discs = np.empty((len(radii), 3))
    moved = np.empty((len(limbs), 3))
    limb_radii = radii[limbs, 0].copy()
    span = np.empty((2, max(1, frames[:, 3].max())))
    q = 0
    for c in range(len(frames)):
        see_balls(radii[:, 1:], radii[:, 0], cams, c, frames[c], discs)
        begin = q
        end = frames[c, 5] + frames[c, 2] * frames[c, 3]
        while q < len(asked) and asked[q] < end:
            q += 1
        for m in range(len(centres)):
            see_balls(centres[m], limb_radii, cams, c, frames[c], moved)
            for n in range(len(limbs)):
                for i in range(3):
                    discs[limbs[n], i] = moved[n, i]
            _, bare[c, m] = draw_parts(parts, discs, frames[c], span, cells, drawn, m + 1)
            for n in range(begin, q):
                covers[m, n] = drawn[asked[n]] == m + 1
