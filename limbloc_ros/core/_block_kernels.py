# SPDX-License-Identifier: Apache-2.0
"""Numba kernels that find the blocks of voxels near the hull; `silhouettes` documents, these trust their caller.

All they know of a mask is how many foreground pixels a rectangle holds, from four sums (`sums`, laid out like
`cv2.integral` does): enough to say that a block lies further than the band outside, and much less work than distances.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from limbloc_ros.core._projection_kernels import UNKNOWN, UNSEEN, WITHIN, view_of_balls

#: Where no foreground lies within r px of a point, its bilinear distance is larger than r less this: the four pixels
#: around the point may lie 1.42 nearer (0.71 on average), and it is half a pixel from the outline to the foreground.
NEARER_PX = 1.5


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def block_balls(blocks: Any, size: int, voxel: float) -> tuple[Any, float]:
    """Centres [3, B] m and radius of the balls around the voxel centres of blocks (lowest lattice indices [B, 3])."""
    centres = np.empty((3, len(blocks)))
    for n in range(len(blocks)):
        for axis in range(3):
            centres[axis, n] = (blocks[n, axis] + 0.5 * size) * voxel
    return centres, 0.5 * (size - 1) * voxel * 1.7320508075688774 * (1.0 + 1e-9)


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def counts_any(frames: Any, sums: Any, c: int, u: float, v: float, r: float) -> bool:
    """Whether a pixel within r of (u, v), along both axes, was counted.

    `frames[c]` is (x0, y0, width, height, offset) of the counted rectangle; none was outside it.
    """
    left, above, width, height, offset = frames[c, 0], frames[c, 1], frames[c, 2], frames[c, 3], frames[c, 4]
    x0 = max(math.ceil(u - r) - left, 0)
    y0 = max(math.ceil(v - r) - above, 0)
    x1 = min(math.floor(u + r) + 1 - left, width)
    y1 = min(math.floor(v + r) + 1 - above, height)
    if x0 >= x1 or y0 >= y1:
        return False
    top = offset + y0 * (width + 1)
    bottom = offset + y1 * (width + 1)
    found: bool = sums[bottom + x1] - sums[bottom + x0] != sums[top + x1] - sums[top + x0]
    return found


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def near_blocks(
    blocks: Any, size: int, voxel: float, cams: Any, frames: Any, sums: Any, band: float, min_seen: int
) -> Any:
    """Which blocks (cubes of `size` voxels) may hold a wanted voxel, bool [B].

    Wanted is a voxel whose largest camera distance is below `band` or whose second largest is negative. The 2D distance
    changes by at most one pixel a pixel, so nothing is lost. The cameras are asked one after the other, each only
    about the blocks that are left.
    """
    centres, radius = block_balls(blocks, size, voxel)
    views = np.empty((5, len(blocks)))
    left = np.arange(len(blocks))
    tallies = np.zeros((3, len(blocks)), np.int64)  # cameras beyond the outline, beyond the band, that do not see
    count = len(blocks)
    for c in range(len(cams)):
        view_of_balls(cams, c, centres, radius, count, views)
        kept = 0
        for n in range(count):
            outside, beyond, unseen = tallies[0, n], tallies[1, n], tallies[2, n]
            u, v, near, reach = views[0, n], views[1, n], views[2, n], views[3, n] + NEARER_PX
            if views[4, n] == UNSEEN:
                unseen += 1
            elif views[4, n] == WITHIN and not counts_any(frames, sums, c, u, v, reach):
                outside += 1
                beyond += not counts_any(frames, sums, c, u, v, reach + band * cams[c, 12] / near)
            if (beyond > 0 and outside > 1) or len(cams) - unseen < min_seen:
                continue
            centres[0, kept], centres[1, kept], centres[2, kept] = centres[0, n], centres[1, n], centres[2, n]
            tallies[0, kept], tallies[1, kept], tallies[2, kept] = outside, beyond, unseen
            left[kept] = left[n]
            kept += 1
        count = kept
    out = np.zeros(len(blocks), np.bool_)
    out[left[:count]] = True
    return out


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def split_blocks(blocks: Any, size: int, upper: Any) -> Any:
    """The eight halves of blocks of `size` voxels that begin below `upper` (lattice, exclusive)."""
    out = np.empty((len(blocks) * 8, 3), np.int32)
    count = 0
    half = size // 2
    for n in range(len(blocks)):
        for eighth in range(8):
            i = blocks[n, 0] + (eighth & 1) * half
            j = blocks[n, 1] + ((eighth >> 1) & 1) * half
            k = blocks[n, 2] + (eighth >> 2) * half
            if i < upper[0] and j < upper[1] and k < upper[2]:
                out[count, 0], out[count, 1], out[count, 2] = i, j, k
                count += 1
    return out[:count]


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def root_blocks(lower: Any, upper: Any, size: int) -> Any:
    """Blocks of `size` voxels that fill a box of the lattice (`upper` exclusive), int32 [B, 3]."""
    ni, nj, nk = (upper - lower + size - 1) // size
    out = np.empty((ni * nj * nk, 3), np.int32)
    for n in range(len(out)):
        out[n, 0] = lower[0] + n // (nj * nk) * size
        out[n, 1] = lower[1] + n // nk % nj * size
        out[n, 2] = lower[2] + n % nk * size
    return out


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def pick_blocks(blocks: Any, kept: Any) -> Any:
    """Those of the blocks [B, 3] that are kept, bool [B]."""
    out = np.empty((np.count_nonzero(kept), 3), np.int32)
    count = 0
    for n in range(len(blocks)):
        if kept[n]:
            out[count, 0], out[count, 1], out[count, 2] = blocks[n, 0], blocks[n, 1], blocks[n, 2]
            count += 1
    return out


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def not_among(blocks: Any, known: Any, lower: Any, upper: Any, size: int) -> Any:
    """Which blocks [B, 3] of `size` voxels of a box of the lattice are none of the known ones [K, 3]; bool [B]."""
    ni, nj, nk = (upper - lower + size - 1) // size
    new = np.ones((ni, nj, nk), np.bool_)
    for n in range(len(known)):
        i, j, k = known[n, 0] - lower[0], known[n, 1] - lower[1], known[n, 2] - lower[2]
        new[i // size, j // size, k // size] = False
    out = np.empty(len(blocks), np.bool_)
    for n in range(len(blocks)):
        i, j, k = blocks[n, 0] - lower[0], blocks[n, 1] - lower[1], blocks[n, 2] - lower[2]
        out[n] = new[i // size, j // size, k // size]
    return out


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def find_blocks(
    lower: Any, upper: Any, root: int, leaf: int, voxel: float, cams: Any, frames: Any, sums: Any, band: float,
    min_seen: int, gained: Any, known: Any,
) -> Any:  # fmt: skip
    """The blocks of `leaf` voxels [B, 3] in a box of the lattice (`upper` exclusive) that may hold a wanted voxel (see
    `near_blocks`), found by halving blocks of `root` voxels; but for those that are known already [K, 3].

    `gained` is `frames` and `sums` of other pixels: only blocks that may lie within the band of these are wanted. If it
    has no frames, all are.
    """
    blocks = root_blocks(lower, upper, root)
    size = root
    while True:
        if len(gained[0]) > 0:
            blocks = pick_blocks(blocks, blocks_beside(blocks, size, voxel, cams, gained[0], gained[1], band))
        if size == leaf and len(known) > 0:
            blocks = pick_blocks(blocks, not_among(blocks, known, lower, upper, size))
        blocks = pick_blocks(blocks, near_blocks(blocks, size, voxel, cams, frames, sums, band, min_seen))
        if size == leaf:
            return blocks
        blocks = split_blocks(blocks, size, upper)
        size //= 2


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def nearest_depths(blocks: Any, size: int, voxel: float, cams: Any) -> Any:
    """The least depth (m) at which each camera may see a voxel of the blocks; inf if it sees none."""
    centres, radius = block_balls(blocks, size, voxel)
    views = np.empty((5, len(blocks)))
    nearest = np.full(len(cams), np.inf)
    for c in range(len(cams)):
        view_of_balls(cams, c, centres, radius, len(blocks), views)
        for n in range(len(blocks)):
            if views[4, n] != UNSEEN:
                nearest[c] = min(nearest[c], views[2, n])
    return nearest


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def blocks_beside(blocks: Any, size: int, voxel: float, cams: Any, frames: Any, sums: Any, distance: float) -> Any:
    """Which blocks have a voxel that may lie within `distance` (m) of a counted pixel in some camera, bool [B]."""
    centres, radius = block_balls(blocks, size, voxel)
    views = np.empty((5, len(blocks)))
    out = np.zeros(len(blocks), np.bool_)
    for c in range(len(cams)):
        if frames[c, 2] == 0:
            continue
        view_of_balls(cams, c, centres, radius, len(blocks), views)
        for n in range(len(blocks)):
            u, v, near, reach, how = views[0, n], views[1, n], views[2, n], views[3, n] + NEARER_PX, views[4, n]
            if how == UNKNOWN:
                out[n] = True
            elif how != UNSEEN and not out[n]:
                out[n] = counts_any(frames, sums, c, u, v, reach + distance * cams[c, 12] / near)
    return out


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def blocks_of_voxels(indices: Any, lower: Any, size: int) -> tuple[Any, Any]:
    """The blocks [B, 3] in which voxels [V, 3] lie, from `lower` on, and the block of each, int64 [V].

    The voxels come in the order in which `evaluate_blocks` gives them: block by block.
    """
    blocks = np.empty((len(indices), 3), np.int32)
    of = np.empty(len(indices), np.int64)
    count = 0
    for n in range(len(indices)):
        same = count > 0
        for axis in range(3):
            same = same and 0 <= indices[n, axis] - blocks[count - 1, axis] < size
        if not same:
            for axis in range(3):
                blocks[count, axis] = lower[axis] + (indices[n, axis] - lower[axis]) // size * size
            count += 1
        of[n] = count - 1
    return blocks[:count], of
