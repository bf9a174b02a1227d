# SPDX-License-Identifier: Apache-2.0
"""Numba kernels of the silhouettes; `silhouettes` documents and validates, these trust their caller."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from limbloc_ros.core._hull_kernels import SLACK_PX
from limbloc_ros.core._projection_kernels import UNSEEN, WITHIN, view_of_ball


@njit(cache=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def signed_distance(mask: Any) -> Any:
    """Distance of pixel centres to the nearest one of the other kind, less half a pixel; negative where mask is 1.

    Two passes of exact integer arithmetic after Meijster, Roerdink and Hesselink (2000), for both kinds at once: along
    a row, a run of pixels of one kind is closed by pixels of the other, behind which nothing can be nearer.
    """
    height, width = mask.shape
    out = np.empty((height, width), np.float32)
    far = height + width
    column = np.empty((height, width), np.int32)  # distance to the nearest pixel of the other kind in the column
    for x in range(width):
        column[0, x] = far
    for y in range(1, height):
        for x in range(width):
            column[y, x] = column[y - 1, x] + 1 if mask[y, x] == mask[y - 1, x] else 1
    for y in range(height - 2, -1, -1):
        for x in range(width):
            below = column[y + 1, x] + 1 if mask[y, x] == mask[y + 1, x] else 1
            column[y, x] = min(column[y, x], below)
    inverse = np.empty(width + 2)
    for n in range(1, width + 2):
        inverse[n] = 0.5 / n
    site = np.empty(width + 2, np.int64)  # columns whose parabolas are the lowest somewhere, from left to right,
    height_2 = np.empty(width + 2, np.int64)  # the parabolas' lowest values
    begin = np.empty(width + 2, np.int64)  # and where they begin to be
    square = np.empty(width, np.float32)
    for y in range(height):
        left = 0
        while left < width:
            kind = mask[y, left]
            right = left
            while right + 1 < width and mask[y, right + 1] == kind:
                right += 1
            top = -1
            for x in range(max(left - 1, 0), min(right + 1, width - 1) + 1):
                g = 0 if x < left or x > right else column[y, x]
                if g >= far:
                    continue
                g *= g
                while top >= 0:
                    at = begin[top]
                    if (at - site[top]) * (at - site[top]) + height_2[top] <= (at - x) * (at - x) + g:
                        break
                    top -= 1
                start = left
                if top >= 0:
                    i = site[top]
                    start = 1 + int((x * x - i * i + g - height_2[top]) * inverse[x - i])
                if start <= right:
                    top += 1
                    site[top] = x
                    height_2[top] = g
                    begin[top] = start
            end = right
            if top < 0:
                for x in range(left, right + 1):
                    square[x] = np.float32(far * far)
            while top >= 0:
                i = site[top]
                g = height_2[top]
                for x in range(begin[top], end + 1):
                    square[x] = np.float32((x - i) * (x - i) + g)
                end = begin[top] - 1
                top -= 1
            left = right + 1
        for x in range(width):
            d = np.sqrt(square[x]) - np.float32(0.5)
            out[y, x] = -d if mask[y, x] != 0 else d
    return out


@njit(cache=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def nearest_depths(
    centres: Any, radius: float, cams: Any, outlines: Any, band: float, min_seen: int
) -> tuple[Any, Any]:
    """Which balls of space can hold a wanted voxel, and the nearest depth (m) of one in every camera.

    A ball (`centres` [B, 3], m) cannot that lies `band` away from the rectangles around the masks (`outlines` [C, 4]:
    first column and row, last column and row) of two cameras, or that too few cameras see. Returns bool [B] and
    float64 [C], inf where there is none.
    """
    kept = np.zeros(len(centres), np.bool_)
    nearest = np.full(len(cams), np.inf)
    near = np.empty(len(cams))
    for n in range(len(centres)):
        beyond = 0
        unseen = 0
        for c in range(len(cams)):
            how, u, v, reach, near[c] = view_of_ball(cams, c, centres[n, 0], centres[n, 1], centres[n, 2], radius)
            if how == UNSEEN:
                unseen += 1
                near[c] = np.inf
            elif how == WITHIN:
                gap = max(max(outlines[c, 0] - u, u - outlines[c, 2]), max(outlines[c, 1] - v, v - outlines[c, 3]))
                if (gap - reach - SLACK_PX) * near[c] / cams[c, 12] >= band:
                    beyond += 1
                    if beyond > 1:
                        break
        if beyond > 1 or len(cams) - unseen < min_seen:
            continue
        kept[n] = True
        for c in range(len(cams)):
            nearest[c] = min(nearest[c], near[c])
    return kept, nearest
