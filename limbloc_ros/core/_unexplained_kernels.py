# SPDX-License-Identifier: Apache-2.0
"""Kernel of `unexplained`: the ray that passes a figure at the largest distance."""

from __future__ import annotations

from typing import Any

from numba import njit

from limbloc_ros.core._part_kernels import SLACK, distance_to_part, lay_out


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def farthest(points: Any, rays: Any, parts: Any, spheres: Any, radii: Any, counts: Any) -> float:
    """Largest distance of a ray [Q, 3] through a point [Q, 3] to the nearest of the parts [P, 3], at least 0.

    Only of those rays whose nearest part `counts` [P].
    """
    rows, bounds = lay_out(parts, spheres, radii)
    most = 0.0
    hint = 0  # what explained the point before mostly explains this one
    for q in range(len(points)):
        x, y, z = points[q]
        ray = rays[q]
        nearest, _, _ = distance_to_part(rows[hint], x, y, z, ray)
        p = 0
        while nearest > most and p < len(rows):
            bx, by, bz = bounds[0, p] - x, bounds[1, p] - y, bounds[2, p] - z
            along = bx * ray[0] + by * ray[1] + bz * ray[2]
            reach = nearest + bounds[3, p] + SLACK
            if bx * bx + by * by + bz * bz - along * along <= reach * reach:
                d, _, _ = distance_to_part(rows[p], x, y, z, ray)
                if d < nearest:
                    nearest, hint = d, p
            p += 1
        if counts[hint]:
            most = max(most, nearest)
    return most
