# SPDX-License-Identifier: Apache-2.0
"""Numba kernels of the visual hull; `hull` documents and validates, these trust their caller."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from limbloc_ros.core._block_kernels import block_balls
from limbloc_ros.core._projection_kernels import (
    UNSEEN,
    WITHIN,
    bend,
    has_plain_lens,
    project,
    row_start,
    to_pixels,
    view_of_balls,
)

#: Edge of the blocks that are evaluated, in voxels, and how many voxels they have.
LEAF, VOXELS = 4, 64
# Rows of the arrays of a leaf's voxels: flat, with lengths that the compiler knows, so that it sees that rows do not
# overlap and makes vector code. Seen by one camera: the pixel (later its fraction), m per px, and the distance, m.
U, V, SCALE, DISTANCE = (row * VOXELS for row in range(4))
# The pixels around it.
TOP, TOP_RIGHT, BELOW, BELOW_RIGHT = (row * VOXELS for row in range(4))
# Of the cameras so far: the largest and the second largest distance, and the camera of the largest.
FIRST, SECOND, WHO = (row * VOXELS for row in range(3))

#: A bilinear value differs at most so far (px) from the value at the nearest pixel to a point: the point's distance to
#: that pixel (0.71), the mean distance of the four pixels to the point (0.71), and the step at the outline (0.42).
SLACK_PX = 2.0


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def read_piece(field: Any, offset: int, width: int, height: int, px: float, py: float, far: float) -> float:
    """Bilinear value of a stored piece at its pixel (px, py); `far` beyond it."""
    if px < 0.0 or py < 0.0 or px > width - 1 or py > height - 1:
        return far
    ix = min(int(px), width - 2)
    iy = min(int(py), height - 2)
    fx = px - ix
    fy = py - iy
    at = np.uint64(offset + iy * width + ix)  # unsigned: numba need not ask whether to count from the end
    right = np.uint64(1)
    top = field[at] + fx * (field[at + right] - field[at])
    at += np.uint64(width)
    bottom = field[at] + fx * (field[at + right] - field[at])
    value: float = top + fy * (bottom - top)
    return value


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def camera_distance(
    cams: Any, c: int, boxes: Any, field: Any, far: float, start: tuple[float, float, float], z: float
) -> float:
    """Signed distance (m) of a world point to one silhouette cone; -inf where the camera does not see the point.

    `boxes[c]` is (x0, y0, width, height, offset) of the stored piece of the 2D signed distance; beyond it lies `far`.
    The definition of what `evaluate_blocks` computes for many points at once, but for the last bits.
    """
    u, v, depth = project(cams, c, start, z)
    if depth <= 0.0 or u < 0.0 or v < 0.0 or u > cams[c, 31] - 1.0 or v > cams[c, 32] - 1.0:
        return -math.inf
    x0, y0, width, height, offset = boxes[c, 0], boxes[c, 1], boxes[c, 2], boxes[c, 3], boxes[c, 4]
    px = read_piece(field, offset, width, height, u - x0, v - y0, math.inf)
    return far if px == math.inf else px * (depth / cams[c, 12])


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def look_at_blocks(
    blocks: Any,
    cams: Any,
    boxes: Any,
    field: Any,
    voxel: float,
    band: float,
    keep_second: bool,
    min_seen: int,
    outward: Any,
    most: Any,
    whole: Any,
) -> Any:
    """Which leaves may hold a wanted voxel, bool [B]; closer than `_block_kernels.near_blocks`, from the distances.

    Fills `outward` [C, B] with how far (px) each camera sees a leaf's centre outside, roughly (-inf if some voxel may
    not be seen), `most` [C, B] with what (m) no distance of its voxels exceeds, and `whole` [C, B]: whether the camera
    sees all of it.
    """
    centres, radius = block_balls(blocks, LEAF, voxel)
    views = np.empty((5, len(blocks)))
    tallies = np.zeros((3, len(blocks)), np.int64)  # cameras beyond the outline, beyond the band, that do not see
    for c in range(len(cams)):
        x0, y0, width, height, offset = boxes[c, 0], boxes[c, 1], boxes[c, 2], boxes[c, 3], boxes[c, 4]
        view_of_balls(cams, c, centres, radius, len(blocks), views)
        for n in range(len(blocks)):
            outward[c, n], most[c, n] = -math.inf, math.inf
            whole[c, n] = views[4, n] == WITHIN
            tallies[2, n] += views[4, n] == UNSEEN
            if not whole[c, n]:
                continue  # some voxels may have no say here
            px, py, near, reach = views[0, n] - x0, views[1, n] - y0, views[2, n], views[3, n]
            gap = max(max(-px, px - (width - 1)), max(-py, py - (height - 1)))
            if gap > 0.0:
                outward[c, n] = math.inf
                away = math.inf if gap > reach else 0.0  # all of it lies where every distance is the band
            else:
                outward[c, n] = field[offset + int(py + 0.5) * width + int(px + 0.5)]
                away = outward[c, n] - SLACK_PX - reach
                furthest = outward[c, n] + SLACK_PX + reach
                most[c, n] = furthest * (near if furthest < 0.0 else near + 2.0 * radius) / cams[c, 12]
            tallies[0, n] += away > 0.0
            tallies[1, n] += away > 0.0 and away * near / cams[c, 12] >= band
    outside = (tallies[1] > 0) & ((tallies[0] > 1) | (not keep_second))
    return ~outside & (len(cams) - tallies[2] >= min_seen)


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def leaf_steps(cams: Any, voxel: float) -> Any:
    """Where the voxels of a leaf lie from its first one, in camera coordinates [C, 3 * LEAF^3], m."""
    steps = np.empty((len(cams), 3 * VOXELS))
    for c in range(len(cams)):
        for m in range(VOXELS):
            i, j, k = m // (LEAF * LEAF), m // LEAF % LEAF, m % LEAF
            for row in range(3):
                along = cams[c, 3 * row] * i + cams[c, 3 * row + 1] * j + cams[c, 3 * row + 2] * k
                steps[c, row * VOXELS + m] = along * voxel
    return steps


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def project_leaf(cams: Any, c: int, x: float, y: float, z: float, steps: Any, seen: Any) -> None:
    """Pixels and m per px (0: not seen) of a leaf's voxels, the first at x, y, z, to rows U, V and SCALE of `seen`."""
    a, b, w = row_start(cams, c, x, y)
    a += cams[c, 2] * z
    b += cams[c, 5] * z
    w += cams[c, 8] * z
    scale = 1.0 / cams[c, 12]
    for m in range(VOXELS):
        depth = w + steps[2 * VOXELS + m]
        inverse = 1.0 / depth
        seen[U + m] = (a + steps[m]) * inverse
        seen[V + m] = (b + steps[VOXELS + m]) * inverse
        seen[SCALE + m] = depth * scale if depth > 1e-6 else 0.0
    if not has_plain_lens(cams, c):
        to_pixels(cams, c, seen[: 3 * VOXELS].reshape(3, VOXELS))
        return
    k1, k2, p1, p2, k3 = cams[c, 17], cams[c, 18], cams[c, 19], cams[c, 20], cams[c, 21]
    fx, fy, cx, cy = cams[c, 12], cams[c, 13], cams[c, 14], cams[c, 15]
    limit = cams[c, 33]
    for m in range(VOXELS):  # what `to_pixels` does, for as many as the compiler knows: in two thirds of the time
        scale = seen[SCALE + m]
        seen[U + m], seen[V + m], r2 = bend(seen[U + m], seen[V + m], fx, fy, cx, cy, k1, k2, p1, p2, k3)
        seen[SCALE + m] = 0.0 if r2 > limit else scale


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def read_leaf(field: Any, boxes: Any, c: int, seen: Any, at: Any, around: Any) -> None:
    """Distances (m) of a leaf's voxels to camera c's silhouette, to row DISTANCE of `seen`; the camera sees them all.

    What lies beyond the stored piece reads its border, where all that matters is further outside than the band. The
    pixels are moved without a change to `around`: one by one, for no two lie side by side, and made double together.
    """
    x0, y0, width, height, offset = boxes[c, 0], boxes[c, 1], boxes[c, 2], boxes[c, 3], boxes[c, 4]
    right, bottom = float(width - 1), float(height - 1)
    last_x, last_y, stride, first = np.int32(width - 2), np.int32(height - 2), np.int32(width), np.int32(offset)
    for m in range(VOXELS):
        px = min(max(seen[U + m] - x0, 0.0), right)
        py = min(max(seen[V + m] - y0, 0.0), bottom)
        ix = min(np.int32(px), last_x)
        iy = min(np.int32(py), last_y)
        seen[U + m] = px - ix
        seen[V + m] = py - iy
        at[m] = np.int32(iy * stride + ix) + first
    next_row = np.uint64(width)  # unsigned: numba need not ask whether to count from the end
    for m in range(VOXELS):
        top = np.uint64(at[m])
        below = top + next_row
        around[TOP + m] = field[top]
        around[TOP_RIGHT + m] = field[top + np.uint64(1)]
        around[BELOW + m] = field[below]
        around[BELOW_RIGHT + m] = field[below + np.uint64(1)]
    for m in range(VOXELS):
        left, right = np.float64(around[TOP + m]), np.float64(around[TOP_RIGHT + m])
        top = left + seen[U + m] * (right - left)
        left, right = np.float64(around[BELOW + m]), np.float64(around[BELOW_RIGHT + m])
        below = left + seen[U + m] * (right - left)
        seen[DISTANCE + m] = (top + seen[V + m] * (below - top)) * seen[SCALE + m]


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def read_voxels(field: Any, boxes: Any, cams: Any, c: int, seen: Any, band: float, unseen: Any) -> None:
    """The same for voxels of which the camera may see only some; -inf for the others, which `unseen` counts."""
    x0, y0, width, height, offset = boxes[c, 0], boxes[c, 1], boxes[c, 2], boxes[c, 3], boxes[c, 4]
    right = cams[c, 31] - 1.0
    bottom = cams[c, 32] - 1.0
    for m in range(VOXELS):
        u, v, scale = seen[U + m], seen[V + m], seen[SCALE + m]
        if scale <= 0.0 or u < 0.0 or v < 0.0 or u > right or v > bottom:
            seen[DISTANCE + m] = -math.inf
            unseen[m] += 1
        else:
            px = read_piece(field, offset, width, height, u - x0, v - y0, math.inf)
            seen[DISTANCE + m] = band if px == math.inf else px * scale


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def rank_leaf(seen: Any, c: int, state: Any) -> None:
    """Let camera c's distances take their place among the largest (rows FIRST, SECOND and WHO of `state`).

    Which camera is the largest is nearly random: selections in vector code, not branches.
    """
    for m in range(VOXELS):
        d = seen[DISTANCE + m]
        first = state[FIRST + m]
        second = state[SECOND + m]
        ahead = (d > first) | ((d == first) & (c < state[WHO + m]))
        less = first if ahead else d
        state[FIRST + m] = d if ahead else first
        state[SECOND + m] = less if less > second else second
        state[WHO + m] = c if ahead else state[WHO + m]


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def some_to_change(state: Any, band: float, second_below: float, most: float) -> bool:
    """Whether a camera whose distances do not exceed `most` may change a voxel that is still wanted: whether it may be
    among the two largest there."""
    some: Any = np.int64(0)
    for m in range(VOXELS):
        second = state[SECOND + m]
        some |= np.int64(((state[FIRST + m] < band) | (second < second_below)) & (second <= most))
    found: bool = some > 0
    return found


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def evaluate_blocks(
    blocks: Any,
    cams: Any,
    boxes: Any,
    field: Any,
    voxel: float,
    band: float,
    keep_second: bool,
    min_seen: int,
    upper: Any,
) -> Any:
    """The largest and the second largest camera distance of every wanted voxel of leaves, and who gave the largest.

    Returns indices int32 [V, 3], first float32 [V] m (at most `band`), second float32 [V] m, camera int16 [V], for
    the voxels below `upper` (lattice, exclusive).
    """
    outward = np.empty((len(cams), len(blocks)))
    most = np.empty((len(cams), len(blocks)))
    whole = np.empty((len(cams), len(blocks)), np.bool_)
    kept = look_at_blocks(blocks, cams, boxes, field, voxel, band, keep_second, min_seen, outward, most, whole)
    room = np.count_nonzero(kept) * VOXELS
    index = np.empty((room, 3), np.int32)
    first = np.empty(room, np.float32)
    second = np.empty(room, np.float32)
    who = np.empty(room, np.int16)
    count = np.uint64(0)  # unsigned: numba need not ask whether to count from the end
    end_i, end_j, end_k = upper[0], upper[1], upper[2]
    second_below = 0.0 if keep_second else -math.inf
    steps = leaf_steps(cams, voxel)
    seen = np.empty(4 * VOXELS)
    around = np.empty(4 * VOXELS, np.float32)
    state = np.empty(3 * VOXELS)
    at = np.empty(VOXELS, np.int32)
    unseen = np.empty(VOXELS, np.int64)
    wanted = np.empty(VOXELS, np.uint8)
    largest = np.empty(2 * VOXELS, np.float32)
    camera = np.empty(VOXELS, np.int16)
    order = np.empty(len(cams), np.int64)
    for n in np.flatnonzero(kept):
        bi, bj, bk = blocks[n, 0], blocks[n, 1], blocks[n, 2]
        # The cameras that see the block furthest outside most likely deny its voxels: ask them first.
        for new in range(len(cams)):
            place = new
            while place > 0 and outward[order[place - 1], n] < outward[new, n]:
                order[place] = order[place - 1]
                place -= 1
            order[place] = new
        state[:] = -math.inf
        unseen[:] = 0
        for turn in range(len(cams)):
            c = order[turn]
            if turn > 0 and whole[c, n] and not some_to_change(state, band, second_below, most[c, n]):
                continue
            project_leaf(cams, c, (bi + 0.5) * voxel, (bj + 0.5) * voxel, (bk + 0.5) * voxel, steps[c], seen)
            if whole[c, n]:
                read_leaf(field, boxes, c, seen, at, around)
            else:
                read_voxels(field, boxes, cams, c, seen, band, unseen)
            rank_leaf(seen, c, state)
        found = 0
        for m in range(VOXELS):
            i, j, k = bi + m // (LEAF * LEAF), bj + m // LEAF % LEAF, bk + m % LEAF
            some = (state[FIRST + m] < band) | (state[SECOND + m] < second_below)
            some &= (i < end_i) & (j < end_j) & (k < end_k) & (len(cams) - unseen[m] >= min_seen)
            wanted[m] = some
            found += some
            largest[FIRST + m] = min(state[FIRST + m], band)
            largest[SECOND + m] = state[SECOND + m]
            camera[m] = np.int16(state[WHO + m])
        if found == 0:
            continue
        # Which are wanted is nearly random: each is written, without a branch, and the next one over it if it is not.
        for m in range(VOXELS):
            index[count, 0] = bi + m // (LEAF * LEAF)
            index[count, 1] = bj + m // LEAF % LEAF
            index[count, 2] = bk + m % LEAF
            first[count] = largest[FIRST + m]
            second[count] = largest[SECOND + m]
            who[count] = camera[m]
            count += np.uint64(wanted[m])
    return index[:count], first[:count], second[:count], who[:count]


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def count_denied(first: Any, second: Any, who: Any, cameras: int) -> tuple[int, Any]:
    """How many voxels no camera denies, and how many each camera alone does; int64 [cameras]."""
    kept: Any = 0
    denied = np.zeros(cameras, np.int64)
    for n in range(len(first)):
        kept += first[n] < 0.0
        denied[who[n]] += (first[n] >= 0.0) & (second[n] < 0.0)
    return kept, denied


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def replace_voxels(voxels: Any, dropped: Any, new: Any) -> Any:
    """Those of the voxels (as `evaluate_blocks` gives them) that are not dropped (bool [V]), then the new ones."""
    count = len(dropped) - np.count_nonzero(dropped)
    size = count + len(new[0])
    index = np.empty((size, 3), np.int32)
    first = np.empty(size, np.float32)
    second = np.empty(size, np.float32)
    who = np.empty(size, np.int16)
    index[count:], first[count:], second[count:], who[count:] = new[0], new[1], new[2], new[3]
    at = 0
    for n in range(len(dropped)):
        if not dropped[n]:
            for axis in range(3):
                index[at, axis] = voxels[0][n, axis]
            first[at], second[at], who[at] = voxels[1][n], voxels[2][n], voxels[3][n]
            at += 1
    return index, first, second, who


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def blend_voxels(voxels: Any, doubt: Any, band: Any) -> Any:
    """Voxels whose distance is below `band`, float32: `doubt` of the way from the largest camera distance to the next.

    Returns indices int32 [V, 3], distances float32 [V] m, and the cameras of the largest uint8 [V].
    """
    indices, first, second, who = voxels
    index = np.empty(indices.shape, np.int32)
    distance = np.empty(len(first), np.float32)
    by = np.empty(len(first), np.uint8)
    count = 0
    for n in range(len(first)):
        d = first[n] + doubt * (second[n] - first[n])
        if d < band:
            for axis in range(3):
                index[count, axis] = indices[n, axis]
            distance[count] = d
            by[count] = who[n]
            count += 1
    return index[:count], distance[:count], by[:count]


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def index_range(indices: Any) -> tuple[Any, Any]:
    """Lowest and highest of indices [V, 3], int64 [3] each."""
    low = np.full(3, np.iinfo(np.int64).max)
    high = np.full(3, np.iinfo(np.int64).min)
    for n in range(len(indices)):
        for axis in range(3):
            low[axis] = min(low[axis], indices[n, axis])
            high[axis] = max(high[axis], indices[n, axis])
    return low, high


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def fill_grid(grid: Any, indices: Any, low: Any, values: Any) -> None:
    """Put values [V] into the cells `indices` [V, 3] - `low` of a grid."""
    for n in range(len(indices)):
        grid[indices[n, 0] - low[0], indices[n, 1] - low[1], indices[n, 2] - low[2]] = values[n]


@njit(cache=True, nogil=True)  # type: ignore[misc, unused-ignore]
def voxels_below(sdf: Any, limit: Any, first: Any) -> tuple[Any, Any]:
    """Lattice indices int32 [V, 3] and values [V] of the voxels below `limit`, in array order.

    Args:
        sdf: [X, Y, Z] C-contiguous.
        limit: of its type.
        first: [3] lattice index of the first voxel.
    """
    flat = sdf.ravel()
    count = 0
    for n in range(flat.size):
        count += flat[n] < limit
    indices = np.empty((count, 3), np.int32)
    values = np.empty(count, sdf.dtype)
    at = 0
    for i in range(sdf.shape[0]):
        for j in range(sdf.shape[1]):
            row = sdf[i, j]
            for k in range(sdf.shape[2]):
                if row[k] < limit:
                    indices[at, 0] = first[0] + i
                    indices[at, 1] = first[1] + j
                    indices[at, 2] = first[2] + k
                    values[at] = row[k]
                    at += 1
    return indices, values


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def cut_faces(sdf: Any, band_m: Any, on_floor: bool) -> int:
    """How many voxels of the grid's outermost layers are clamped beside one that is inside; with `on_floor` but those
    of the lowest layer."""
    nx, ny, nz = sdf.shape
    count = 0
    for first, last in ((1, 0), (nx - 2, nx - 1)):
        for j in range(ny):
            for k in range(nz):
                count += (sdf[first, j, k] < 0.0) & (sdf[last, j, k] >= band_m)
    for first, last in ((1, 0), (ny - 2, ny - 1)):
        for i in range(nx):
            for k in range(nz):
                count += (sdf[i, first, k] < 0.0) & (sdf[i, last, k] >= band_m)
    for i in range(nx):
        for j in range(ny):
            count += (sdf[i, j, nz - 2] < 0.0) & (sdf[i, j, nz - 1] >= band_m)
            if not on_floor:
                count += (sdf[i, j, 1] < 0.0) & (sdf[i, j, 0] >= band_m)
    return count
