# SPDX-License-Identifier: Apache-2.0
"""Kernel of `unexplained`: what the rays along the silhouettes' outlines meet of a figure."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from limbloc_ros.core._part_kernels import SLACK, distance_to_part, lay_out
from limbloc_ros.core._surface_fit_kernels import robust_weight


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def meet(
    points: Any, rays: Any, parts: Any, groups: Any, spheres: Any, radii: Any, count: int, width: float, reach: float
) -> tuple[Any, float, Any]:
    """The figure's distances to rays [Q, 3] through points [Q, 3], by groups of parts.

    Args:
        points, rays: m, and unit directions.
        parts, spheres, radii: the flesh.
        groups: [P] the group of each part, 0 to count - 1.
        count: how many groups.
        width: of the robust cost of a distance (`robust_weight`).
        reach: distances are worked out up to this, m, and are no larger.

    Returns:
        [count] the largest distance, at least 0, of the rays that pass nearest to each group;
        the mean cost of all rays; [count] by how much it would rise if a group were not there.
    """
    rows, bounds = lay_out(parts, spheres, radii)
    nearest = np.empty(count)
    farthest, gains = np.zeros(count), np.zeros(count)
    total = 0.0
    for q in range(len(points)):
        x, y, z = points[q]
        ray = rays[q]
        nearest[:] = reach
        for p in range(len(rows)):
            g = groups[p]
            bx, by, bz = bounds[0, p] - x, bounds[1, p] - y, bounds[2, p] - z
            along = bx * ray[0] + by * ray[1] + bz * ray[2]
            within = max(nearest[g] + bounds[3, p] + SLACK, 0.0)
            if bx * bx + by * by + bz * bz - along * along < within * within:
                d, _, _ = distance_to_part(rows[p], x, y, z, ray)
                nearest[g] = min(nearest[g], d)
        first = 0
        for g in range(1, count):
            if nearest[g] < nearest[first]:
                first = g
        without = reach
        for g in range(count):
            if g != first:
                without = min(without, nearest[g])
        farthest[first] = max(farthest[first], nearest[first])
        cost, _ = robust_weight(nearest[first], width)
        total += cost
        # who stands deep inside of another's outline explains it no better than who touches it
        with_it, _ = robust_weight(max(nearest[first], 0.0), width)
        without_it, _ = robust_weight(max(without, 0.0), width)
        gains[first] += without_it - with_it
    rays_met = max(len(points), 1)
    return farthest, total / rays_met, gains / rays_met
