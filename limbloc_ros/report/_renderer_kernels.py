# SPDX-License-Identifier: Apache-2.0
"""The triangle loop of `renderer.py`."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray


@njit(cache=True)
def rasterise(
    uv: NDArray[np.float64],
    depth: NDArray[np.float64],
    faces: NDArray[np.int64],
    attributes: NDArray[np.float32],
    z_buffer: NDArray[np.float32],
    values: NDArray[np.float32],
) -> None:
    """Draw triangles into a depth buffer and a buffer of interpolated attributes, nearest wins.

    Args:
        uv: [V, 2] px, pixel centres at integers; a vertex that is not finite drops its triangles.
        depth: [V] m along the optical axis; triangles that reach behind the camera are dropped.
        faces: [T, 3].
        attributes: [V, A], interpolated with perspective.
        z_buffer: [H, W] m, changed in place; inf = nothing drawn.
        values: [H, W, A], changed in place.
    """
    height, width = z_buffer.shape
    for face in range(faces.shape[0]):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        if not (depth[a] > 1e-6 and depth[b] > 1e-6 and depth[c] > 1e-6):
            continue
        ax, ay, bx, by, cx, cy = uv[a, 0], uv[a, 1], uv[b, 0], uv[b, 1], uv[c, 0], uv[c, 1]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if not abs(area) > 1e-12:  # also drops NaN
            continue
        left, right = max(0, int(np.ceil(min(ax, bx, cx)))), min(width - 1, int(np.floor(max(ax, bx, cx))))
        top, bottom = max(0, int(np.ceil(min(ay, by, cy)))), min(height - 1, int(np.floor(max(ay, by, cy))))
        for y in range(top, bottom + 1):
            for x in range(left, right + 1):
                wa = ((bx - x) * (cy - y) - (by - y) * (cx - x)) / area
                wb = ((cx - x) * (ay - y) - (cy - y) * (ax - x)) / area
                wc = 1.0 - wa - wb
                if wa < 0.0 or wb < 0.0 or wc < 0.0:
                    continue
                wa, wb, wc = wa / depth[a], wb / depth[b], wc / depth[c]
                z = 1.0 / (wa + wb + wc)
                if z < z_buffer[y, x]:
                    z_buffer[y, x] = z
                    for k in range(attributes.shape[1]):
                        values[y, x, k] = z * (wa * attributes[a, k] + wb * attributes[b, k] + wc * attributes[c, k])
