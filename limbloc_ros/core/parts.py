# SPDX-License-Identifier: Apache-2.0
"""The separate bodies in one frame's hull, and cutting a hull apart where several touch. Nothing here knows of time."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core._component_kernels import inside_cells
from limbloc_ros.core._nearest_kernels import nearest_distances
from limbloc_ros.core.errors import NoPerson
from limbloc_ros.core.hull import NOBODY, Hull, components, largest_component
from limbloc_ros.core.pipeline import PoseEstimator
from limbloc_ros.core.pose import Flesh, Pose

Array = NDArray[np.float64]

#: Parts of a frame beyond the number of people that are looked at: furniture.
FURTHER_PARTS = 4
#: Points by which a part of the hull is known.
POINTS = 300
#: Distances for cutting a part up are worked out at every so many voxels.
COARSE = 3


@dataclass(frozen=True)
class Part:
    """A connected part of a hull as the tracks see it.

    Attributes:
        points: [M, 3] some of the voxel centres inside, evenly picked, m.
        centre: [3] mean of all of them, m.
        volume_m3: of the voxels inside.
    """

    points: Array
    centre: Array
    volume_m3: float

    @staticmethod
    def of(hull: Hull) -> Part:
        """What is to be known of a hull in one part."""
        some, total, count = inside_cells(hull.sdf, POINTS)
        points, centre = (
            (cells + np.asarray(hull.index_min) + 0.5) * hull.voxel_m for cells in (some, total / max(count, 1))
        )
        return Part(points, centre, count * hull.voxel_m**3)

    def filling(self) -> Flesh:
        """It as balls, one around each of the points."""
        radius = (self.volume_m3 / len(self.points)) ** (1 / 3)
        rows = np.arange(len(self.points), dtype=np.int64)
        return Flesh(self.points, np.full(len(rows), radius), np.stack([rows, rows, rows], axis=1), ())


@dataclass(frozen=True)
class Sight:
    """The parts of one frame's hull, the largest first.

    Attributes:
        parts: one for each.
        hulls: gives their hulls; only called when they are needed.
        outcomes: what fits of each part alone gave, where that is known already; only for frames fitted alone.
    """

    parts: tuple[Part, ...]
    hulls: Callable[[], Sequence[Hull]]
    outcomes: tuple[Pose | NoPerson, ...] = ()

    @staticmethod
    def of(hull: Hull, max_people: int) -> Sight:
        """What there is to see in a hull as it was carved."""
        hulls = candidates(hull, max_people)
        return Sight(tuple(Part.of(part) for part in hulls), lambda: hulls)

    def fit(self, n: int, estimator: PoseEstimator) -> Pose | NoPerson:
        """The pose of part n, by itself."""
        return self.outcomes[n] if self.outcomes else estimator.estimate(self.hulls()[n], self.others(n))

    def others(self, n: int) -> list[Flesh]:
        """What the parts but n explain of the silhouettes, whoever or whatever they are."""
        return [part.filling() for m, part in enumerate(self.parts) if m != n]


def candidates(hull: Hull, max_people: int) -> list[Hull]:
    """The parts of a carved hull that are looked at, the largest first."""
    if hull.inside_count == 0:
        return []
    if max_people == 1:
        return [largest_component(hull)]
    return [part for part in components(hull) if part.inside_count][: max_people + FURTHER_PARTS]


def nearest(points: Array, query: Array) -> Array:
    """Distance [Q], m, of each of query [Q, 3] to the nearest of the points [M, 3]."""
    # A tree of scipy would be no faster for some hundred points, and takes a tenth of a second to be imported.
    # Copies, because a kernel is compiled for one kind of array only.
    found = nearest_distances(*(np.array(a, dtype=np.float64, order="C") for a in (points, query)))
    return np.asarray(found, dtype=np.float64)


@functools.cache  # once per process
def warm_up() -> None:
    """Compile or load the kernels, so that the first frame is not slow."""
    inside_cells(np.zeros((1, 1, 1), np.float32), 1)
    nearest(np.zeros((1, 3)), np.zeros((1, 3)))


def divide(hull: Hull, distances: Sequence[Callable[[Array], Array]]) -> list[Hull | None]:
    """Cut a hull that holds several bodies apart, half-way between them.

    Args:
        hull: in one part.
        distances: of each body: points [Q, 3] m -> signed distances [Q] m to where it should be.

    Returns:
        each body's hull, or None where nothing is left for it.
    """
    indices, values = hull.shell()
    away = np.stack([_at_voxels(hull, distance, indices) for distance in distances])
    inside = hull.sdf < np.float32(hull.band_m)
    cut_by = None if hull.cut_by is None else hull.cut_by[inside]
    pieces: list[Hull | None] = []
    for n in range(len(distances)):
        border = (0.5 * (away[n] - np.delete(away, n, axis=0).min(axis=0))).astype(np.float32)
        sdf: NDArray[np.float32] = np.maximum(values, border)
        near = sdf < np.float32(hull.band_m)
        if not (sdf < 0).any():
            pieces.append(None)
            continue
        who = None if cut_by is None else np.where(border > values, np.uint8(NOBODY), cut_by)[near]
        piece = Hull.from_shell(
            hull.voxel_m, hull.band_m, indices[near], sdf[near], hull.cameras, hull.rejected, who, hull.viewpoints
        )
        pieces.append(largest_component(replace(piece, views=hull.views)))
    return pieces


def _at_voxels(hull: Hull, distance: Callable[[Array], Array], indices: NDArray[np.int32]) -> Array:
    """A signed distance [V] at voxels [V, 3], interpolated from every COARSE-th: ten times as fast, to a centimetre."""
    from scipy.ndimage import map_coordinates  # takes time, for which those whom nobody touches need not wait

    axes = [np.arange(0, n + COARSE - 1, COARSE) for n in hull.sdf.shape]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    places = (nodes.reshape(-1, 3) + np.asarray(hull.index_min) + 0.5) * hull.voxel_m
    grid = distance(places).reshape(nodes.shape[:3])
    at = (indices - np.asarray(hull.index_min)).T / COARSE
    return np.asarray(map_coordinates(grid, at, order=1, mode="nearest"), dtype=np.float64)
