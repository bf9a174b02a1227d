# SPDX-License-Identifier: Apache-2.0
"""Surface -> centre of mass, geodesic distances and their maxima (paper section 2.1, figs. 1 and 4).

The graph is the paper's: one vertex per surface voxel, an edge to each of its 26 neighbours on the surface, and the
Euclidean distance of the voxel centres as an edge's cost.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from limbloc_ros.core import _geodesic_kernels as kernels
from limbloc_ros.core._surface_kernels import OFFSETS
from limbloc_ros.core.errors import InputError
from limbloc_ros.core.hull import Hull
from limbloc_ros.core.surface import Surface

Array = NDArray[np.float64]

_EDGE_VOXELS = np.sqrt((OFFSETS.astype(np.float64) ** 2).sum(axis=1))


@dataclass(frozen=True)
class Maxima:
    """Local maxima of a distance over the surface, the farthest first.

    Attributes:
        rows: int64 [M] rows of the surface.
        distance: [M] m, value of the distance at each maximum.
        drop: [M] m, how far the mean over the patch around it lies below; small at a wide, smooth maximum.
    """

    rows: NDArray[np.int64]
    distance: Array
    drop: Array


def centre_of_mass(hull: Hull) -> Array:
    """[3] m, world: mean of the centres of the voxels inside the hull (paper section 2.1).

    Raises:
        InputError: the hull has no voxel inside.
    """
    inside = hull.sdf < 0
    total = int(np.count_nonzero(inside))
    if total == 0:
        raise InputError("expected a hull with voxels inside (sdf < 0), got an empty one; check the masks and the rig")
    mean = [
        np.count_nonzero(inside, axis=tuple(a for a in range(3) if a != axis)) @ np.arange(inside.shape[axis]) / total
        for axis in range(3)
    ]
    return np.asarray((np.array(mean) + np.asarray(hull.index_min) + 0.5) * hull.voxel_m)


def nearest_row(surface: Surface, p_world: ArrayLike) -> int:
    """Row of the surface point nearest to the world point `p_world` [3], m."""
    return int(np.argmin(((surface.points - np.asarray(p_world)) ** 2).sum(axis=1)))


def geodesic_distances(surface: Surface, seeds: ArrayLike, start_m: ArrayLike | None = None) -> Array:
    """Geodesic distance of every surface voxel from the nearest seed (paper section 2.1).

    Args:
        surface: the surface.
        seeds: [S] rows of the surface to start from, at least one.
        start_m: [S] distance already travelled at each seed, m, not negative; none means 0.

    Returns:
        [N] m; inf where no seed can be reached.

    Raises:
        InputError: no seed, a seed that is no row of the surface, or a negative start.
    """
    rows = np.atleast_1d(np.asarray(seeds, dtype=np.int64))
    start = np.zeros(len(rows)) if start_m is None else np.atleast_1d(np.asarray(start_m, dtype=np.float64))
    if rows.size == 0 or rows.min() < 0 or rows.max() >= len(surface):
        raise InputError(
            f"seeds must be rows 0 to {len(surface) - 1} of the surface, at least one; got {rows.tolist()}"
        )
    if start.shape != rows.shape or not np.isfinite(start).all() or (start < 0).any():
        raise InputError(f"start_m must hold one distance >= 0 per seed ({len(rows)}), got {start.tolist()}")
    distance = kernels.bucket_dijkstra(surface.neighbours, _EDGE_VOXELS, rows, start / surface.voxel_m)
    return np.asarray(distance * surface.voxel_m)


def geodesic_map(hull: Hull, surface: Surface) -> Array:
    """[N] m: distance over the surface from its point nearest the centre of mass (the map of fig. 1).

    Where the surface is in several pieces, as of a body that masks have cut in two, the way leads through the air where
    they are nearest each other.
    """
    seeds, starts = [nearest_row(surface, centre_of_mass(hull))], [0.0]
    distance = geodesic_distances(surface, seeds)
    while not np.isfinite(distance).all():
        from scipy.spatial import cKDTree  # takes time, for which those of one piece need not wait

        reached, rest = np.flatnonzero(np.isfinite(distance)), np.flatnonzero(~np.isfinite(distance))
        gaps, nearest = map(np.asarray, cKDTree(surface.points[reached]).query(surface.points[rest]))
        n = int(gaps.argmin())
        seeds.append(int(rest[n]))
        starts.append(float(distance[reached[nearest[n]]] + gaps[n]))
        distance = geodesic_distances(surface, seeds, starts)
    return distance


def extremities(surface: Surface, distance: Array, count: int) -> Maxima:
    """The `count` points that lie farthest out, each farthest from all before it (head, hands, feet).

    The first is the farthest of `distance`; then each found point becomes a further source of distance 0, so the next
    lies on another limb. Unlike `wide_maxima` this always finds `count` points.

    Args:
        surface: the surface.
        distance: [N] m, geodesic distance from where the search starts, e.g. `geodesic_map`.
        count: how many, at least 1.
    """
    remaining = np.where(np.isfinite(distance), distance, -1.0)
    rows = np.zeros(count, dtype=np.int64)
    for n in range(count):
        rows[n] = np.argmax(remaining)
        remaining = np.minimum(remaining, geodesic_distances(surface, [rows[n]]))
    order = np.argsort(-distance[rows], kind="stable")
    rows = rows[order]
    return Maxima(rows, distance[rows], np.zeros(count))


def wide_maxima(surface: Surface, distance: Array, radius_m: float) -> Maxima:
    """Local maxima of `distance` that hold over a patch of radius `radius_m` (knees, ankles, elbows, hands).

    The paper's "wide maximum region": a wrinkle of the clothing is the greatest of its neighbours, but not of a patch
    of a limb's size. `drop` then tells how slowly the distance falls around each.
    """
    is_maximum, drop = kernels.maxima_in_ball(distance, surface.points, surface.neighbours, float(radius_m))
    rows = np.flatnonzero(is_maximum)
    rows = rows[np.argsort(-distance[rows], kind="stable")]
    return Maxima(rows, distance[rows], drop[rows])
