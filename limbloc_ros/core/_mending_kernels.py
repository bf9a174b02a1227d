# SPDX-License-Identifier: Apache-2.0
"""Numba kernels that compare a hull with its silhouettes; `hull` documents and validates, these trust their caller."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from limbloc_ros.core._block_kernels import NEARER_PX, block_balls, counts_any
from limbloc_ros.core._projection_kernels import UNSEEN, WITHIN, project, project_block, row_start, view_of_balls

#: Edge of the smallest blocks of voxels that are looked at as a whole.
BLOCK = 2


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def cover(points: Any, reach: float, cams: Any, boxes: Any, covered: Any) -> None:
    """Mark the pixels, laid out like `field`, that squares of `reach` (m) around the points [3, P] cover.

    Every square adds one at two of its corners and takes one at the others; summed over both axes that is how many
    squares cover each pixel.
    """
    seen = np.empty((3, points.shape[1]))
    square = np.empty((4, points.shape[1]), np.int32)
    steps = np.empty(np.max((boxes[:, 2] + 1) * (boxes[:, 3] + 1)), np.int32)
    for c in range(len(cams)):
        width, height, offset = boxes[c, 2], boxes[c, 3], boxes[c, 4]
        project_block(cams, c, points, seen)
        bound_squares(seen, reach, boxes[c, 0], boxes[c, 1], width, height, square)
        stride = width + 1
        steps[: (height + 1) * stride] = 0
        top, bottom = height, 0
        for n in range(points.shape[1]):
            x0, x1, y0, y1 = square[0, n], square[1, n], square[2, n], square[3, n]
            if seen[2, n] <= 0.0 or x0 >= x1 or y0 >= y1:
                continue
            top, bottom = min(top, y0), max(bottom, y1)
            first, last = y0 * stride, y1 * stride
            steps[first + x0] += 1
            steps[first + x1] -= 1
            steps[last + x0] -= 1
            steps[last + x1] += 1
        above = np.zeros(stride, np.int32)
        for y in range(top, bottom):
            row = steps[y * stride : (y + 1) * stride]
            for x in range(stride):
                above[x] += row[x]
            squares = 0
            marks = covered[offset + y * width : offset + (y + 1) * width]
            for x in range(width):
                squares += above[x]
                marks[x] = squares > 0


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def bound_squares(seen: Any, reach: float, left: int, top: int, width: int, height: int, square: Any) -> None:
    """First and last (exclusive) column and row of squares of `reach` (m) around pixels, in a piece; int32 [4, P]."""
    for n in range(seen.shape[1]):
        u, v = seen[0, n] - left, seen[1, n] - top
        r = reach / seen[2, n]
        # What is out of sight may be anywhere, but a number that int32 can hold.
        square[0, n] = np.int32(math.ceil(min(max(u - r, 0.0), float(width))))
        square[1, n] = np.int32(math.floor(min(max(u + r, -1.0), width - 1.0))) + np.int32(1)
        square[2, n] = np.int32(math.ceil(min(max(v - r, 0.0), float(height))))
        square[3, n] = np.int32(math.floor(min(max(v + r, -1.0), height - 1.0))) + np.int32(1)


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def count_bare(field: Any, covered: Any, boxes: Any, inner_px: float) -> Any:
    """Foreground pixels of every camera that lie deeper than its rim: all, and those not covered; int64 [C, 2]."""
    out = np.zeros((len(boxes), 2), np.int64)
    for c in range(len(boxes)):
        begin, end = boxes[c, 4], boxes[c, 4] + boxes[c, 2] * boxes[c, 3]
        distance, marks = field[begin:end], covered[begin:end]
        solid: Any = 0
        bare: Any = 0
        for at in range(len(distance)):
            solid += np.int64(distance[at] < -inner_px)
            bare += np.int64((distance[at] < -inner_px) & (marks[at] == 0))
        out[c, 0] = solid
        out[c, 1] = bare
    return out


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def centres_inside(indices: Any, first: Any, voxel: float) -> Any:
    """Centres [3, P] m of the voxels (`indices` [V, 3]) whose largest distance `first` [V] is negative."""
    count = 0
    for n in range(len(first)):
        count += first[n] < 0.0
    centres = np.empty((3, count))
    at = 0
    for n in range(len(first)):
        if first[n] < 0.0:
            for axis in range(3):
                centres[axis, at] = (indices[n, axis] + 0.5) * voxel
            at += 1
    return centres


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def denied_by_one(voxels: Any, limit: Any, voxel: float) -> tuple[Any, Any, Any]:
    """Of the voxels (as `evaluate_blocks` gives them) that one camera alone denies and that lie further than `limit`
    (negative) inside for the next: centres [3, P] m, that camera int16 [P], and how deep they lie there float32 [P] m.
    """
    indices, first, second, who = voxels
    chosen = np.empty(len(first), np.int64)
    count = 0
    for n in range(len(first)):
        chosen[count] = n
        count += (first[n] >= 0.0) & (second[n] < limit)
    centres, deniers, depths = np.empty((3, count)), np.empty(count, np.int16), np.empty(count, np.float32)
    for at in range(count):
        n = chosen[at]
        for axis in range(3):
            centres[axis, at] = (indices[n, axis] + 0.5) * voxel
        deniers[at], depths[at] = who[n], -second[n]
    return centres, deniers, depths


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def count_unexplained(
    points: Any, deniers: Any, cams: Any, boxes: Any, field: Any, covered: Any, inner_px: float
) -> Any:
    """In how many cameras but the denier each point [3, P] falls on foreground that nothing covers; int16 [P]."""
    out = np.zeros(points.shape[1], np.int16)
    seen = np.empty((3, points.shape[1]))
    for c in range(len(cams)):
        left, top, width, height, offset = boxes[c]
        project_block(cams, c, points, seen)
        for n in range(points.shape[1]):
            x = math.floor(seen[0, n] + 0.5) - left
            y = math.floor(seen[1, n] + 0.5) - top
            if seen[2, n] <= 0.0 or c == deniers[n] or x < 0 or y < 0 or x >= width or y >= height:
                continue
            at = offset + y * width + x
            out[n] += (field[at] < -inner_px) & (covered[at] == 0)
    return out


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def rarely_denied(
    blocks: Any, size: int, voxel: float, cams: Any, frames: Any, sums: Any, most: int, least_seen: int
) -> Any:
    """Which blocks (cubes of `size` voxels) may hold a voxel that `most` cameras at most deny and enough see; bool [B].

    `frames` and `sums` count the foreground (see `silhouettes.PixelCounts`).
    """
    centres, radius = block_balls(blocks, size, voxel)
    views = np.empty((5, len(blocks)))
    denied = np.zeros(len(blocks), np.int64)
    unseen = np.zeros(len(blocks), np.int64)
    for c in range(len(cams)):
        view_of_balls(cams, c, centres, radius, len(blocks), views)
        for n in range(len(blocks)):
            if views[4, n] == UNSEEN:
                unseen[n] += 1
            elif views[4, n] == WITHIN and denied[n] <= most:
                denied[n] += not counts_any(frames, sums, c, views[0, n], views[1, n], views[3, n] + NEARER_PX)
    return (denied <= most) & (len(cams) - unseen >= least_seen)


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def doubly_denied(
    blocks: Any, high: Any, voxel: float, cams: Any, boxes: Any, field: Any, covered: Any, inner_px: float,
    least_seen: int, least_unexplained: int,
) -> Any:  # fmt: skip
    """Voxels that exactly two cameras deny and of which others see the contrary, on foreground that nothing covers.

    Looks at blocks [B, 3] of BLOCK voxels (their lowest lattice indices), as far as they lie below `high`.

    Returns centres float64 [V, 3] m, the two cameras int16 [V, 2], and depth float64 [V] m in all other silhouettes.
    """
    found = [(0.0, 0.0, 0.0, 0, 0, 0.0) for _ in range(0)]  # an empty list whose type numba knows
    first, second = 0, 0
    for n in range(len(blocks)):
        for m in range(BLOCK * BLOCK * BLOCK):
            i, j, k = blocks[n, 0] + m // (BLOCK * BLOCK), blocks[n, 1] + m // BLOCK % BLOCK, blocks[n, 2] + m % BLOCK
            if i >= high[0] or j >= high[1] or k >= high[2]:
                continue
            x, y, z = (i + 0.5) * voxel, (j + 0.5) * voxel, (k + 0.5) * voxel
            denied, seen, unexplained, shallow = 0, 0, 0, math.inf
            for c in range(len(cams)):
                u, v, depth = project(cams, c, row_start(cams, c, x, y), z)
                if depth <= 0.0 or u < 0.0 or v < 0.0 or u > cams[c, 31] - 1.0 or v > cams[c, 32] - 1.0:
                    continue
                seen += 1
                a = math.floor(u + 0.5) - boxes[c, 0]
                b = math.floor(v + 0.5) - boxes[c, 1]
                beyond = a < 0 or b < 0 or a >= boxes[c, 2] or b >= boxes[c, 3]
                at = 0 if beyond else boxes[c, 4] + b * boxes[c, 2] + a
                if beyond or field[at] >= 0.0:
                    first, second = (c, second) if denied == 0 else (first, c)
                    denied += 1
                    if denied > 2:
                        break
                    continue
                if field[at] < -inner_px and covered[at] == 0:
                    unexplained += 1
                shallow = min(shallow, -field[at] * depth / cams[c, 12])
            if denied == 2 and seen >= least_seen and unexplained >= least_unexplained:
                found.append((x, y, z, first, second, shallow))
    points = np.empty((len(found), 3))
    deniers = np.empty((len(found), 2), np.int16)
    depths = np.empty(len(found))
    for n in range(len(found)):
        points[n, 0], points[n, 1], points[n, 2] = found[n][0], found[n][1], found[n][2]
        deniers[n, 0], deniers[n, 1] = found[n][3], found[n][4]
        depths[n] = found[n][5]
    return points, deniers, depths


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def bound_balls(points: Any, radii: Any, cams: Any, c: int) -> tuple[int, int, int, int]:
    """First and last (exclusive) column and row of one camera's image in which the balls can be seen."""
    left, top, right, bottom = math.inf, math.inf, -math.inf, -math.inf
    for n in range(len(points)):
        u, v, depth = project(cams, c, row_start(cams, c, points[n, 0], points[n, 1]), points[n, 2])
        if depth > 0.0:
            r = radii[n] * cams[c, 12] / depth
            left, right = min(left, u - r), max(right, u + r)
            top, bottom = min(top, v - r), max(bottom, v + r)
    width, height = cams[c, 31], cams[c, 32]
    return (
        math.ceil(min(max(left, 0.0), width)),
        math.floor(min(max(right, -1.0), width - 1.0)) + 1,
        math.ceil(min(max(top, 0.0), height)),
        math.floor(min(max(bottom, -1.0), height - 1.0)) + 1,
    )


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def paint_balls(points: Any, radii: Any, cams: Any, c: int, left: int, top: int, mask: Any) -> int:
    """Set to 1 the pixels of a part of one camera's mask (uint8 [height, width], the first pixel is left, top) that the
    balls cover; how many were 0 before."""
    height, width = mask.shape
    painted = 0
    for n in range(len(points)):
        u, v, depth = project(cams, c, row_start(cams, c, points[n, 0], points[n, 1]), points[n, 2])
        if depth <= 0.0:
            continue
        r = radii[n] * cams[c, 12] / depth
        u -= left
        v -= top
        y0 = max(0, math.ceil(v - r))
        y1 = min(height - 1, math.floor(v + r))
        for y in range(y0, y1 + 1):
            w = math.sqrt(max(0.0, r * r - (y - v) * (y - v)))
            for x in range(max(0, math.ceil(u - w)), min(width - 1, math.floor(u + w)) + 1):
                painted += mask[y, x] == 0
                mask[y, x] = 1
    return painted
