# SPDX-License-Identifier: Apache-2.0
"""Masks with holes: what one or two cameras lost is given back on the evidence of all others."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core import _block_kernels as near
from limbloc_ros.core import _mending_kernels as kernels
from limbloc_ros.core.config import HullConfig
from limbloc_ros.core.silhouettes import Silhouettes, min_seen

#: Lattice indices [V, 3], largest and second largest camera distance [V] m, camera of the largest [V].
Voxels = tuple[NDArray[np.int32], NDArray[np.float32], NDArray[np.float32], NDArray[np.int16]]

#: A silhouette's rim of this width is not asked whether the hull explains it: voxels are coarser than pixels.
INNER_PX = 1.5
#: So far around the hull is looked for what two masks miss, m: a forearm and a hand.
LOST_M = 0.3
#: From so many cameras on depth says that a mask has a hole, and two cameras may be outvoted, by so many others that
#: see something unexplained there.
ENOUGH_CAMERAS, WITNESSES = 6, 2
#: Edge of the largest blocks that are looked at as a whole, in voxels; halved until they have BLOCK.
COARSEST = 16


def cover_silhouettes(silhouettes: Silhouettes, voxels: Voxels, config: HullConfig) -> NDArray[np.uint8]:
    """Which pixels the hull's voxels project to, or are to be ignored; uint8 in the layout of `silhouettes.field`."""
    indices, first, _, _ = voxels
    covered = np.zeros(silhouettes.field.size, np.uint8)
    centres = kernels.centres_inside(indices, first, config.voxel_m)
    kernels.cover(centres, 0.875 * config.voxel_m, silhouettes.cameras, silhouettes.boxes, covered)
    for (x, y, width, height, offset), ignored in zip(silhouettes.boxes, silhouettes.ignored, strict=True):
        if ignored is not None:
            covered[offset : offset + width * height] |= ignored[y : y + height, x : x + width].ravel()
    return covered


def unexplained_fraction(silhouettes: Silhouettes, covered: NDArray[np.uint8]) -> float:
    """Mean over the cameras of the fraction of foreground (but its rim) that no voxel covers: 0 if all agree."""
    counts = kernels.count_bare(silhouettes.field, covered, silhouettes.boxes, INNER_PX)
    return float(np.mean(counts[:, 1] / np.maximum(counts[:, 0], 1)))


def mend_silhouettes(
    silhouettes: Silhouettes, covered: NDArray[np.uint8], voxels: Voxels, config: HullConfig
) -> Silhouettes:
    """Give back to a silhouette what it lost, on the evidence of all other cameras.

    Where a mask misses a limb, the strict intersection loses the limb, and then the *other* masks show foreground
    that no part of the hull explains. So a voxel that exactly one camera denies is given back when at least two
    other cameras see it on unexplained foreground, or (six cameras or more) when it lies so deep inside all other
    silhouettes that only a hole in the one mask can be the reason. Consistent masks leave nothing unexplained and
    stay as they are.

    Args:
        silhouettes: as measured.
        covered: what `cover_silhouettes` found.
        voxels: what `evaluate` found.
        config: `repair_depth_m`, voxel size.

    Returns:
        silhouettes with the mended ones measured anew, or the very same object when nothing was to mend.
    """
    if len(silhouettes.names) < 3:
        return silhouettes
    half = 0.5 * config.voxel_m
    points, deniers, depths = kernels.denied_by_one(voxels, np.float32(-0.25 * half), config.voxel_m)
    if len(deniers) == 0:
        return silhouettes
    table = (silhouettes.cameras, silhouettes.boxes)
    unexplained = kernels.count_unexplained(points, deniers, *table, silhouettes.field, covered, INNER_PX)
    # Few cameras leave a hull so fat that depth says little: four of them gain 12 % phantom volume from clean masks,
    # a third from ragged ones.
    deep = depths > (config.repair_depth_m if len(silhouettes.names) >= ENOUGH_CAMERAS else np.inf)
    give_back = np.flatnonzero((unexplained >= 2) | deep)
    centres = np.ascontiguousarray(points[:, give_back].T)
    return _painted(silhouettes, centres, np.maximum(depths[give_back], half), deniers[give_back])


def mend_twice_denied(
    silhouettes: Silhouettes, covered: NDArray[np.uint8], voxels: Voxels, config: HullConfig
) -> Silhouettes:
    """The same for what two masks miss at the same place.

    Two cameras are outvoted only where two others see foreground that no part of the hull explains, and all others
    that look there see foreground.

    Args:
        silhouettes: mended where one camera alone is wrong.
        covered: what `cover_silhouettes` finds for the hull of these.
        voxels: that hull.
        config: voxel size.
    """
    indices, first, _, _ = voxels
    inside = indices[first < 0]
    if len(silhouettes.names) < ENOUGH_CAMERAS or len(inside) == 0:
        return silhouettes
    around = math.ceil(LOST_M / config.voxel_m)
    low = np.maximum(inside.min(axis=0) - around, silhouettes.lattice[0])
    high = np.minimum(inside.max(axis=0) + around + 1, silhouettes.lattice[1])
    points, deniers, depths = kernels.doubly_denied(
        _rarely_denied(low, high, silhouettes), high, config.voxel_m, silhouettes.cameras, silhouettes.boxes,
        silhouettes.field, covered, INNER_PX, min_seen(len(silhouettes.names)), WITNESSES,
    )  # fmt: skip
    radii = np.maximum(depths, 0.9 * config.voxel_m)
    return _painted(silhouettes, np.repeat(points, 2, axis=0), np.repeat(radii, 2), deniers.ravel())


def _rarely_denied(low: NDArray[np.int64], high: NDArray[np.int64], silhouettes: Silhouettes) -> NDArray[np.int32]:
    """The blocks [B, 3] in a box of the lattice (`high` exclusive) that may hold voxels that no more than two cameras
    deny: blocks of BLOCK voxels, found by halving, for three cameras deny most of a room at once."""
    size = COARSEST
    axes = [np.arange(low[a], high[a], size, dtype=np.int32) for a in range(3)]
    blocks: NDArray[np.int32] = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    counts = silhouettes.counts
    table = (silhouettes.voxel_m, silhouettes.cameras, counts.frames, counts.sums)
    while True:
        blocks = blocks[kernels.rarely_denied(blocks, size, *table, 2, min_seen(len(silhouettes.names)))]
        if size == kernels.BLOCK:
            return blocks
        blocks = near.split_blocks(blocks, size, high)
        size //= 2


def _painted(
    silhouettes: Silhouettes, points: NDArray[np.float64], radii: NDArray[np.float64], cameras: NDArray[np.int16]
) -> Silhouettes:
    """Silhouettes that hold balls [V] as well, each in one camera; the very same object when they did before."""
    changes: dict[int, tuple[NDArray[np.uint8], int, int]] = {}
    for c in map(int, np.unique(cameras)):
        mine = cameras == c
        balls = (points[mine], radii[mine], silhouettes.cameras, c)
        left, right, top, bottom = kernels.bound_balls(*balls)
        mask, left, top = silhouettes.part_of_mask(c, left, right, top, bottom)
        if kernels.paint_balls(*balls, left, top, mask):
            changes[c] = mask, left, top
    return silhouettes.with_masks(changes) if changes else silhouettes
