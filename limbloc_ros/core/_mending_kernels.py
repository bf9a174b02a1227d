# SPDX-License-Identifier: Apache-2.0
"""Numba kernels that compare a hull with its silhouettes; `hull` documents and validates, these trust their caller."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from limbloc_ros.core._projection_kernels import project, project_block, row_start


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def cover(points: Any, reach: float, cams: Any, boxes: Any, covered: Any) -> None:
    """Mark the pixels, laid out like `field`, that squares of `reach` (m) around the points [3, P] cover."""
    run = np.zeros(len(covered), np.int16)  # longest run of covered pixels that begins at a pixel
    seen = np.empty((3, points.shape[1]))
    for c in range(len(cams)):
        x_first = boxes[c, 0]
        y_first = boxes[c, 1]
        width = boxes[c, 2]
        height = boxes[c, 3]
        offset = boxes[c, 4]
        top = height
        bottom = -1
        project_block(cams, c, points, seen)
        for n in range(points.shape[1]):
            if seen[2, n] <= 0.0:
                continue
            u = seen[0, n]
            v = seen[1, n]
            r = reach / seen[2, n]
            x0 = max(0, math.ceil(u - r) - x_first)
            x1 = min(width - 1, math.floor(u + r) - x_first)
            y0 = max(0, math.ceil(v - r) - y_first)
            y1 = min(height - 1, math.floor(v + r) - y_first)
            length = x1 - x0 + 1
            if length <= 0 or y0 > y1:
                continue
            top = min(top, y0)
            bottom = max(bottom, y1)
            at = offset + y0 * width + x0
            for _ in range(y0, y1 + 1):
                if run[at] < length:
                    run[at] = length
                at += width
        for y in range(top, bottom + 1):
            at = offset + y * width
            left = 0
            for _ in range(width):
                left = max(left - 1, run[at])
                covered[at] = left > 0
                at += 1


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
def count_unexplained(
    points: Any, deniers: Any, cams: Any, boxes: Any, field: Any, covered: Any, inner_px: float
) -> Any:
    """In how many cameras but the denier each point falls on foreground that nothing covers; int16 [V]."""
    out = np.zeros(len(points), np.int16)
    for n in range(len(points)):
        for c in range(len(cams)):
            if c == deniers[n]:
                continue
            u, v, depth = project(cams, c, row_start(cams, c, points[n, 0], points[n, 1]), points[n, 2])
            if depth <= 0.0:
                continue
            x = math.floor(u + 0.5) - boxes[c, 0]
            y = math.floor(v + 0.5) - boxes[c, 1]
            if x < 0 or y < 0 or x >= boxes[c, 2] or y >= boxes[c, 3]:
                continue
            at = boxes[c, 4] + y * boxes[c, 2] + x
            if field[at] < -inner_px and covered[at] == 0:
                out[n] += 1
    return out


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def paint_balls(points: Any, radii: Any, cams: Any, c: int, mask: Any) -> None:
    """Set to 1 the pixels of one camera's mask (uint8 [height, width]) that the balls cover."""
    height, width = mask.shape
    for n in range(len(points)):
        u, v, depth = project(cams, c, row_start(cams, c, points[n, 0], points[n, 1]), points[n, 2])
        if depth <= 0.0:
            continue
        r = radii[n] * cams[c, 12] / depth
        y0 = max(0, math.ceil(v - r))
        y1 = min(height - 1, math.floor(v + r))
        for y in range(y0, y1 + 1):
            w = math.sqrt(max(0.0, r * r - (y - v) * (y - v)))
            for x in range(max(0, math.ceil(u - w)), min(width - 1, math.floor(u + w)) + 1):
                mask[y, x] = 1
