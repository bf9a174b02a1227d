# SPDX-License-Identifier: Apache-2.0
"""Hull -> its surface: points, normals, curvature (paper section 2.1, eq. 1)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core import _surface_kernels as kernels
from limbloc_ros.core.errors import InputError
from limbloc_ros.core.hull import Hull

Array = NDArray[np.float64]

#: A surface voxel is inside with an outside face neighbour, so along any direction that leaves the hull the surface
#: is at most a voxel diagonal away.
REACH_VOXELS = 2.0
#: A piece of the surface with a smaller share of the largest one's voxels than this is a speck. (What ragged masks
#: leave beside people has 1 % at most; a belt that masks take for the wall leaves two pieces of nearly the same size.)
PIECE_SHARE = 0.03


@dataclass(frozen=True)
class Surface:
    """The outer surface of a hull, one point per surface voxel, but for specks beside it.

    Attributes:
        voxel_m: edge length of a voxel, m.
        indices: int32 [N, 3] lattice indices of the surface voxels, in array order.
        points: [N, 3] m, world; the voxel centre pushed along its normal onto sdf = 0.
        normals: [N, 3] unit normals, outward.
    """

    voxel_m: float
    indices: NDArray[np.int32]
    points: Array
    normals: Array

    def __len__(self) -> int:
        return len(self.points)

    @property
    def centres(self) -> Array:
        """[N, 3] voxel centres, m, world."""
        return np.asarray((self.indices + 0.5) * self.voxel_m, dtype=np.float64)

    @cached_property
    def neighbours(self) -> NDArray[np.int32]:
        """[N, 26] rows of the neighbouring surface voxels, -1 where there is none; worked out when first asked for."""
        return np.asarray(kernels.list_neighbours(self.indices, kernels.OFFSETS))

    @cached_property
    def curvature(self) -> Array:
        """[N] rad; mean angle between a voxel's normal and its neighbours' (0 on a plane; paper section 2.1)."""
        return np.asarray(kernels.mean_neighbour_angle(self.normals, self.neighbours))


def extract_surface(hull: Hull, *, volume: Literal["sdf", "occupancy"] = "sdf") -> Surface:
    """The surface of `hull` with its normals (paper section 2.1).

    Args:
        hull: the visual hull.
        volume: what the Sobel filter of eq. 1 reads. `occupancy` is the paper's (1 inside, 0 outside); `sdf`, the
            default, gives the same normals without the staircase of a binary volume.

    Raises:
        InputError: the hull has no voxel inside.
    """
    sdf = np.ascontiguousarray(hull.sdf, dtype=np.float32)
    local, number = kernels.list_surface(sdf)
    if len(local) == 0:
        raise InputError("expected a hull with voxels inside (sdf < 0), got an empty one; check the masks and the rig")
    piece = kernels.label_pieces(local, number, kernels.OFFSETS)
    if piece.any():
        local = local[np.isin(piece, _outer_pieces(sdf, local, piece))]

    filtered = sdf if volume == "sdf" else (sdf >= 0).astype(np.float32)
    normals = kernels.normalise_outward(kernels.sobel_at(filtered, local), sdf, local)
    steps = kernels.crossing_along_normal(sdf, local, normals, REACH_VOXELS)
    indices = local + np.asarray(hull.index_min, dtype=np.int32)
    return Surface(
        voxel_m=hull.voxel_m,
        indices=indices,
        points=(indices + 0.5 + steps[:, None] * normals) * hull.voxel_m,
        normals=normals,
    )


def _outer_pieces(sdf: NDArray[np.float32], local: NDArray[np.int32], piece: NDArray[np.int32]) -> NDArray[np.int64]:
    """The pieces of a surface that matter: no specks, no inner walls of cavities."""
    sizes = np.bincount(piece)
    large = np.flatnonzero(sizes >= PIECE_SHARE * sizes.max())
    normals = kernels.normalise_outward(kernels.sobel_at(sdf, local), sdf, local)
    # of a closed surface the flux of the position through it is three times the volume that it holds
    middles = np.stack([np.bincount(piece, weights=axis) / sizes for axis in local.T], axis=1)
    flux = np.bincount(piece, weights=((local - middles[piece]) * normals).sum(axis=1))
    return np.asarray(large[(flux[large] > 0) | (large == sizes.argmax())], np.int64)


def curvature_variability(surface: Surface, radius_m: float) -> tuple[Array, Array]:
    """Mean and standard deviation of the curvature over the patch around each point (paper section 2.1, fig. 4).

    The face "shows a high variability of the curvature": a large deviation over a patch of a head's size.

    Args:
        surface: the surface.
        radius_m: radius of the patch, m; a patch never jumps over a gap.

    Returns:
        mean [N] and standard deviation [N], rad.
    """
    mean, deviation = kernels.spread_in_ball(surface.curvature, surface.points, surface.neighbours, float(radius_m))
    return mean, deviation
