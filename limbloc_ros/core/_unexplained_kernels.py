# SPDX-License-Identifier: Apache-2.0
"""Kernels of `unexplained`: the ray that passes a figure at the largest distance."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from limbloc_ros.core._part_kernels import SLACK, distance_to_part, lay_out

#: Points that are looked at together, and where in a buffer their numbers begin: place, ray, the nearest part's number
#: and how near it seems.
POINTS = 64
PLACE, RAY, PART, SEEMS = 0, 3 * POINTS, 6 * POINTS, 7 * POINTS
BUFFER = 8 * POINTS
#: So many points that seem to be the farthest are measured first.
FIRST = 4


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def _seem_nearest(buffer: Any, bounds: Any) -> None:
    """Write to PART which part seems the nearest to each ray, by the spheres around the parts (`lay_out`)."""
    for i in range(POINTS):
        buffer[SEEMS + i] = 1e9
    for p in range(bounds.shape[1]):
        x, y, z, r2 = bounds[0, p], bounds[1, p], bounds[2, p], bounds[3, p] * bounds[3, p]
        number = float(p)
        for i in range(POINTS):
            bx, by, bz = x - buffer[PLACE + i], y - buffer[PLACE + POINTS + i], z - buffer[PLACE + 2 * POINTS + i]
            along = bx * buffer[RAY + i] + by * buffer[RAY + POINTS + i] + bz * buffer[RAY + 2 * POINTS + i]
            seems = bx * bx + by * by + bz * bz - along * along - r2
            nearer = seems < buffer[SEEMS + i]
            buffer[SEEMS + i] = seems if nearer else buffer[SEEMS + i]
            buffer[PART + i] = number if nearer else buffer[PART + i]


@njit(cache=True, inline="always", error_model="numpy")  # type: ignore[misc, unused-ignore]
def _may_be_as_near(bounds: Any, p: int, x: float, y: float, z: float, ray: Any, nearest: float) -> bool:
    """Whether the sphere around part p lets it be as near to a ray as `nearest`."""
    bx, by, bz = bounds[0, p] - x, bounds[1, p] - y, bounds[2, p] - z
    along = bx * ray[0] + by * ray[1] + bz * ray[2]
    reach = nearest + bounds[3, p] + SLACK
    return bx * bx + by * by + bz * bz - along * along <= reach * reach  # type: ignore[no-any-return]


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def _farthest_in_turn(points: Any, rays: Any, rows: Any, bounds: Any, counts: Any) -> float:
    """`farthest`, point by point: of two parts that are as near, what explained the point before goes on to."""
    most = 0.0
    hint = 0
    for q in range(len(points)):
        x, y, z = points[q]
        ray = rays[q]
        nearest, _, _ = distance_to_part(rows[hint], x, y, z, ray)
        p = 0
        while nearest > most and p < len(rows):
            if _may_be_as_near(bounds, p, x, y, z, ray, nearest):
                d, _, _ = distance_to_part(rows[p], x, y, z, ray)
                if d < nearest:
                    nearest, hint = d, p
            p += 1
        if counts[hint]:
            most = max(most, nearest)
    return most


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def farthest(points: Any, rays: Any, parts: Any, spheres: Any, radii: Any, counts: Any) -> float:
    """Largest distance of a ray [Q, 3] through a point [Q, 3] to the nearest of the parts [P, 3], at least 0.

    Only of those rays whose nearest part `counts` [P]. The part that seems the nearest mostly is, and none is further:
    so most rays are known to pass nearer than one that was measured before, if the farthest come first.
    """
    rows, bounds = lay_out(parts, spheres, radii)
    count = len(points)
    hints = np.zeros(count, np.int64)
    within = np.empty(count)
    buffer = np.zeros(BUFFER)
    for begin in range(0, count, POINTS):
        here = min(POINTS, count - begin)
        for i in range(here):
            for a in range(3):
                buffer[PLACE + a * POINTS + i] = points[begin + i, a]
                buffer[RAY + a * POINTS + i] = rays[begin + i, a]
        _seem_nearest(buffer, bounds)
        for i in range(here):
            q = begin + i
            hints[q] = int(buffer[PART + i])
            within[q], _, _ = distance_to_part(rows[hints[q]], points[q, 0], points[q, 1], points[q, 2], rays[q])
    most, tied = 0.0, 0.0
    for turn in range(FIRST + count if count > 0 else 0):
        q = int(within.argmax()) if turn < FIRST else turn - FIRST
        if not within[q] > most:
            continue
        x, y, z = points[q]
        ray = rays[q]
        nearest, hint, as_near = within[q], hints[q], False
        for p in range(len(rows)):
            if _may_be_as_near(bounds, p, x, y, z, ray, nearest):
                d, _, _ = distance_to_part(rows[p], x, y, z, ray)
                if d < nearest:
                    nearest, hint, as_near = d, p, False
                    if nearest <= most:
                        break
                elif d == nearest and counts[p] != counts[hint]:
                    as_near = True
        if as_near:
            tied = max(tied, nearest)
        elif counts[hint]:
            most = max(most, nearest)
        within[q] = -1.0  # done
    return most if tied <= most else _farthest_in_turn(points, rays, rows, bounds, counts)
