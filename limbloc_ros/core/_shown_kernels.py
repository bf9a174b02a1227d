# SPDX-License-Identifier: Apache-2.0
"""Kernels of `shown`: the silhouettes of a hull and of a figure, as the cameras see both, in coarse cells."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

#: Balls nearer to a camera than this, m, are not drawn, nor points seen.
CLOSEST_M = 0.1


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def looking_at(viewpoint: Any, middle: Any) -> Any:
    """[3, 3] rows: right, down and forward of a camera at `viewpoint` [3] that looks at `middle` [3]."""
    axes = np.empty((3, 3))
    axes[2] = (middle - viewpoint) / np.linalg.norm(middle - viewpoint)
    up = np.array([0.0, 0.0, 1.0]) if abs(axes[2, 2]) < 0.99 else np.array([1.0, 0.0, 0.0])
    right = np.cross(axes[2], up)
    axes[0] = right / np.linalg.norm(right)
    axes[1] = np.cross(axes[2], axes[0])
    return axes


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def see(points: Any, viewpoint: Any, axes: Any, scale: float) -> Any:
    """[P, 3] column and row (cells, from the image's middle) and cells a metre there of points; 0: too near."""
    out = np.zeros((len(points), 3))
    for n in range(len(points)):
        x, y, z = points[n, 0] - viewpoint[0], points[n, 1] - viewpoint[1], points[n, 2] - viewpoint[2]
        depth = axes[2, 0] * x + axes[2, 1] * y + axes[2, 2] * z
        if depth > CLOSEST_M:
            out[n, 2] = scale / depth
            out[n, 0] = (axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z) * out[n, 2]
            out[n, 1] = (axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z) * out[n, 2]
    return out


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def closed(marks: Any) -> Any:
    """Marks [H, W] with the gaps of up to two cells between them filled: grown by a cell on all sides, then shrunk."""
    height, width = marks.shape
    grown, out = np.zeros_like(marks), np.zeros_like(marks)
    for j in range(1, height - 1):
        for i in range(1, width - 1):
            if marks[j, i]:
                grown[j - 1 : j + 2, i - 1 : i + 2] = 1
    for j in range(1, height - 1):
        for i in range(1, width - 1):
            if grown[j, i]:
                held = 1
                for k in range(-1, 2):
                    held &= grown[j + k, i - 1] & grown[j + k, i] & grown[j + k, i + 1]
                out[j, i] = held
    return out


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def draw_part(part: Any, discs: Any, bit: int, left: int, top: int, span: Any, image: Any) -> None:
    """Set a bit in the cells of `image` [H, W], from column `left` and row `top` on, whose centres a part covers.

    A part is the convex hull of up to three balls, and looks like that of their discs [S, 3] (column, row, radius).
    Each row of it reaches from the outermost left to the outermost right of the discs along its three sides.
    `span` [H, 2] is scratch.
    """
    height, width = image.shape
    low, high = np.inf, -np.inf
    for s in part:
        if discs[s, 2] <= 0.0:
            return
        low, high = min(low, discs[s, 1] - discs[s, 2]), max(high, discs[s, 1] + discs[s, 2])
    first, last = max(math.ceil(low) - top, 0), min(math.floor(high) - top, height - 1)
    for row in range(first, last + 1):
        span[row, 0], span[row, 1] = np.inf, -np.inf
    for side in range(3):
        a, b = part[side], part[(side + 1) % 3]
        if a == b and side > 0:
            continue
        dx, dy, dr = discs[b, 0] - discs[a, 0], discs[b, 1] - discs[a, 1], discs[b, 2] - discs[a, 2]
        steps = math.ceil(max(abs(dx), abs(dy)))
        for step in range(steps + 1):
            t = step / max(steps, 1)
            x, y, r = discs[a, 0] + t * dx - left, discs[a, 1] + t * dy - top, discs[a, 2] + t * dr
            for row in range(max(math.ceil(y - r), first), min(math.floor(y + r), last) + 1):
                half = math.sqrt(max(r * r - (row - y) * (row - y), 0.0))
                span[row, 0] = min(span[row, 0], x - half)
                span[row, 1] = max(span[row, 1], x + half)
    for row in range(first, last + 1):
        if span[row, 0] > span[row, 1]:
            continue
        for column in range(max(math.ceil(span[row, 0]), 0), min(math.floor(span[row, 1]), width - 1) + 1):
            image[row, column] |= bit


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def compare_silhouettes(
    points: Any,
    viewpoints: Any,
    parts: Any,
    groups: Any,
    spheres: Any,
    radii: Any,
    count: int,
    cell: float,
    margin: int,
) -> Any:
    """What cameras see of a hull and of a figure, in cells of so many metres at the hull's middle.

    Args:
        points: [Q, 3] of the hull's surface, m, two cells apart at most.
        viewpoints: [C, 3] of the cameras, m.
        parts, spheres, radii: the flesh.
        groups: [P] the group of each part, 0 to count - 1 (at most 8).
        count: how many groups.
        cell: m.
        margin: cells around the hull's silhouette that are looked at.

    Returns:
        [count + 1] cells of all cameras: those of the hull's silhouettes that no group but that one covers, and last
        those that either the hull or the figure covers, but not both.
    """
    cells = np.zeros(count + 1, np.int64)
    middle = np.array([points[:, 0].mean(), points[:, 1].mean(), points[:, 2].mean()])
    for c in range(len(viewpoints)):
        viewpoint = viewpoints[c]
        away = np.linalg.norm(middle - viewpoint)
        if away <= CLOSEST_M:
            continue
        axes = looking_at(viewpoint, middle)
        seen = see(points, viewpoint, axes, away / cell)
        low_x, low_y, high_x, high_y = np.inf, np.inf, -np.inf, -np.inf
        for n in range(len(seen)):
            if seen[n, 2] > 0.0:
                low_x, high_x = min(low_x, seen[n, 0]), max(high_x, seen[n, 0])
                low_y, high_y = min(low_y, seen[n, 1]), max(high_y, seen[n, 1])
        if low_x > high_x or max(high_x - low_x, high_y - low_y) * cell > 20.0:  # who stands at the lens is no outline
            continue
        left, top = math.floor(low_x) - margin, math.floor(low_y) - margin
        height, width = math.ceil(high_y) + margin - top + 1, math.ceil(high_x) + margin - left + 1
        marks = np.zeros((height, width), np.uint8)
        for n in range(len(seen)):
            if seen[n, 2] > 0.0:
                marks[round(seen[n, 1]) - top, round(seen[n, 0]) - left] = 1
        marks = closed(marks)
        discs = see(spheres, viewpoint, axes, away / cell)
        for s in range(len(discs)):
            discs[s, 2] *= radii[s]
        image, span = np.zeros((height, width), np.uint8), np.empty((height, 2))
        for p in range(len(parts)):
            draw_part(parts[p], discs, np.uint8(1 << groups[p]), left, top, span, image)
        for j in range(height):
            for i in range(width):
                bits = image[j, i]
                if (bits != 0) != (marks[j, i] != 0):
                    cells[count] += 1
                elif bits != 0:
                    for g in range(count):
                        cells[g] += bits == 1 << g
    return cells
