# SPDX-License-Identifier: Apache-2.0
"""Numba kernels of the visual hull; `hull` documents and validates, these trust their caller."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from limbloc_ros.core._projection_kernels import (
    UNKNOWN,
    UNSEEN,
    WITHIN,
    project,
    project_block,
    view_of_ball,
)

#: A bilinear value is at most this far (px) below the value at the nearest pixel to a point: the point's distance to
#: that pixel (0.71), the mean distance of the four pixels to the point (0.71), and the step at the outline (0.42).
SLACK_PX = 2.0


@njit(cache=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
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


@njit(cache=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def camera_distance(
    cams: Any, c: int, boxes: Any, field: Any, far: float, start: tuple[float, float, float], z: float
) -> float:
    """Signed distance (m) of a world point to one silhouette cone; -inf where the camera does not see the point.

    `boxes[c]` is (x0, y0, width, height, offset) of the stored piece of the 2D signed distance; beyond it lies `far`.
    The definition of what `evaluate_blocks` computes for many points at once.
    """
    u, v, depth = project(cams, c, start, z)
    if depth <= 0.0 or u < 0.0 or v < 0.0 or u > cams[c, 31] - 1.0 or v > cams[c, 32] - 1.0:
        return -math.inf
    x0, y0, width, height, offset = boxes[c, 0], boxes[c, 1], boxes[c, 2], boxes[c, 3], boxes[c, 4]
    px = read_piece(field, offset, width, height, u - x0, v - y0, math.inf)
    return far if px == math.inf else px * (depth / cams[c, 12])


@njit(cache=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def block_ball(corner: Any, size: int, voxel: float) -> tuple[float, float, float, float]:
    """Centre (m) and radius of the ball around the voxel centres of a block, see `block_is_outside`."""
    half = 0.5 * size
    radius = 0.5 * (size - 1) * voxel * 1.7320508075688774 * (1.0 + 1e-9)
    return (corner[0] + half) * voxel, (corner[1] + half) * voxel, (corner[2] + half) * voxel, radius


@njit(cache=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def block_is_outside(
    corner: Any,
    size: int,
    cams: Any,
    boxes: Any,
    field: Any,
    voxel: float,
    band: float,
    keep_second: bool,
    min_seen: int,
    outward: Any,
) -> bool:
    """Whether no voxel of a block (cube of `size` voxels, lowest lattice index `corner`) can be wanted.

    Wanted is a voxel whose largest camera distance is below `band` or, with `keep_second`, whose second largest is
    negative. The 2D distance changes by at most one pixel a pixel, so nothing is lost.

    For blocks that are kept, `outward` [2, C] is filled: with how far (px) each camera sees the centre outside,
    roughly, and whether it sees all of the block within its stored piece.
    """
    x, y, z, radius = block_ball(corner, size, voxel)
    beyond_band = 0
    beyond_zero = 0
    unseen = 0
    for c in range(len(cams)):
        outward[0, c] = -math.inf
        outward[1, c] = 0.0
        how, u, v, reach, near = view_of_ball(cams, c, x, y, z, radius)
        if how == UNSEEN:
            unseen += 1
        if how != WITHIN:
            continue  # some voxels may have no say here
        px = u - boxes[c, 0]
        py = v - boxes[c, 1]
        gap = max(max(-px, px - (boxes[c, 2] - 1)), max(-py, py - (boxes[c, 3] - 1)))
        if gap > 0.0:
            outward[0, c] = math.inf
            if gap > reach:  # all of it lies where every distance is the band
                beyond_band += 1
                beyond_zero += 1
        else:
            outward[0, c] = field[boxes[c, 4] + int(py + 0.5) * boxes[c, 2] + int(px + 0.5)]
            outward[1, c] = gap < -reach
            d = outward[0, c] - SLACK_PX - reach
            if d > 0.0:
                beyond_zero += 1
                if d * near / cams[c, 12] >= band:
                    beyond_band += 1
        if beyond_band > 0 and (not keep_second or beyond_zero > 1):
            return True
    return len(cams) - unseen < min_seen


@njit(cache=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def split_blocks(
    blocks: Any,
    size: int,
    cams: Any,
    boxes: Any,
    field: Any,
    voxel: float,
    band: float,
    keep_second: bool,
    min_seen: int,
) -> Any:
    """Drop the blocks that hold no wanted voxel and split the others in eight."""
    out = np.empty((len(blocks) * 8, 3), np.int32)
    outward = np.empty((2, len(cams)))
    count = 0
    h = size // 2
    for n in range(len(blocks)):
        if block_is_outside(blocks[n], size, cams, boxes, field, voxel, band, keep_second, min_seen, outward):
            continue
        for k in range(8):
            out[count, 0] = blocks[n, 0] + (k & 1) * h
            out[count, 1] = blocks[n, 1] + ((k >> 1) & 1) * h
            out[count, 2] = blocks[n, 2] + (k >> 2) * h
            count += 1
    return out[:count]


@njit(cache=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def read_block(field: Any, boxes: Any, c: int, seen: Any, state: Any) -> None:
    """Distances (m) of points that camera c sees within its stored piece, to row 4 of `state`."""
    x0, y0 = float(boxes[c, 0]), float(boxes[c, 1])
    width = np.int32(boxes[c, 2])
    last_x = np.int32(boxes[c, 2] - 2)
    last_y = np.int32(boxes[c, 3] - 2)
    piece = field[boxes[c, 4] : boxes[c, 4] + boxes[c, 2] * boxes[c, 3]]
    for m in range(seen.shape[1]):
        px = seen[0, m] - x0
        py = seen[1, m] - y0
        # Within the piece already; clamped so that no mistake elsewhere could read other memory.
        ix = min(max(np.int32(px), np.int32(0)), last_x)
        iy = min(max(np.int32(py), np.int32(0)), last_y)
        fx = px - ix
        fy = py - iy
        at = np.uint32(iy * width + ix)
        below = at + np.uint32(width)
        top = piece[at] + fx * (piece[at + np.uint32(1)] - piece[at])
        bottom = piece[below] + fx * (piece[below + np.uint32(1)] - piece[below])
        state[4, m] = (top + fy * (bottom - top)) * seen[2, m]


@njit(cache=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def read_voxels(field: Any, boxes: Any, cams: Any, c: int, seen: Any, band: float, state: Any) -> None:
    """Distances (m) of any points to camera c's silhouette, to row 4 of `state`; see `camera_distance`."""
    x0, y0, width, height, offset = boxes[c, 0], boxes[c, 1], boxes[c, 2], boxes[c, 3], boxes[c, 4]
    right = cams[c, 31] - 1.0
    bottom = cams[c, 32] - 1.0
    for m in range(seen.shape[1]):
        u = seen[0, m]
        v = seen[1, m]
        scale = seen[2, m]
        if scale <= 0.0 or u < 0.0 or v < 0.0 or u > right or v > bottom:
            state[4, m] = -math.inf
        else:
            px = read_piece(field, offset, width, height, u - x0, v - y0, math.inf)
            state[4, m] = band if px == math.inf else px * scale


@njit(cache=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def rank_block(state: Any, c: int, band: float, second_below: float) -> Any:
    """Let camera c's distances (row 4 of `state`) take their place among the largest.

    Returns how many voxels may still be wanted. Rows 0 to 3: largest, second largest, camera of the largest, number of
    cameras that see the point. Which camera is the largest is nearly random: selections in vector code, not branches.
    """
    wanted: Any = 0
    for m in range(state.shape[1]):
        d = state[4, m]
        d1 = state[0, m]
        d2 = state[1, m]
        ahead = (d > d1) | ((d == d1) & (c < state[2, m]))
        less = d1 if ahead else d
        more = d if ahead else d1
        less = less if less > d2 else d2
        state[0, m] = more
        state[1, m] = less
        state[2, m] = c if ahead else state[2, m]
        state[3, m] += 0.0 if d == -math.inf else 1.0
        wanted += np.int64((more < band) | (less < second_below))
    return wanted


@njit(cache=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def evaluate_blocks(
    blocks: Any,
    size: int,
    cams: Any,
    boxes: Any,
    field: Any,
    voxel: float,
    band: float,
    keep_second: bool,
    min_seen: int,
    upper: Any,
) -> Any:
    """The largest and the second largest camera distance of every wanted voxel, and who gave the largest.

    Returns indices int32 [V, 3], first float32 [V] m (at most `band`), second float32 [V] m, camera int16 [V], for
    the voxels below `upper` (lattice, exclusive).
    """
    per = size * size * size
    room = len(blocks) * per
    index = np.empty((room, 3), np.int32)
    first = np.empty(room, np.float32)
    second = np.empty(room, np.float32)
    who = np.empty(room, np.int16)
    count = 0
    second_below = 0.0 if keep_second else -math.inf
    outward = np.empty((2, len(cams)))
    points = np.empty((3, per))
    seen = np.empty((3, per))
    state = np.empty((5, per))
    step = np.empty((per, 3), np.int64)
    order = np.empty(len(cams), np.int64)
    for m in range(per):
        step[m, 0] = m // (size * size)
        step[m, 1] = m // size % size
        step[m, 2] = m % size
    for n in range(len(blocks)):
        bi, bj, bk = blocks[n]
        if block_is_outside(blocks[n], size, cams, boxes, field, voxel, band, keep_second, min_seen, outward):
            continue
        for m in range(per):
            points[0, m] = (bi + step[m, 0] + 0.5) * voxel
            points[1, m] = (bj + step[m, 1] + 0.5) * voxel
            points[2, m] = (bk + step[m, 2] + 0.5) * voxel
        state[0:2] = -math.inf
        state[2] = -1.0
        state[3] = 0.0
        # The cameras that see the block furthest outside most likely deny its voxels: ask them first.
        wanted = per
        for new in range(len(cams)):
            at = new
            while at > 0 and outward[0, order[at - 1]] < outward[0, new]:
                order[at] = order[at - 1]
                at -= 1
            order[at] = new
        for c in order:
            project_block(cams, c, points, seen)
            if outward[1, c] > 0.0:
                read_block(field, boxes, c, seen, state)
            else:
                read_voxels(field, boxes, cams, c, seen, band, state)
            wanted = rank_block(state, c, band, second_below)
            if wanted == 0:
                break
        if wanted == 0:
            continue
        for m in range(per):
            i, j, k = bi + step[m, 0], bj + step[m, 1], bk + step[m, 2]
            if state[3, m] < min_seen or not (state[0, m] < band or state[1, m] < second_below):
                continue
            if i >= upper[0] or j >= upper[1] or k >= upper[2]:
                continue
            index[count, 0] = i
            index[count, 1] = j
            index[count, 2] = k
            first[count] = min(state[0, m], band)
            second[count] = state[1, m]
            who[count] = state[2, m]
            count += 1
    return index[:count], first[:count], second[:count], who[:count]


@njit(cache=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def block_in_changes(corner: Any, size: int, voxel: float, cams: Any, changed: Any) -> bool:
    """Whether some voxel of a block may be seen in a camera's changed rectangle.

    `changed` is float64 [C, 4]: x0, y0, x1, y1 px of each camera, empty where x1 < x0.
    """
    x, y, z, radius = block_ball(corner, size, voxel)
    for c in range(len(cams)):
        if changed[c, 2] < changed[c, 0]:
            continue
        how, u, v, reach, _ = view_of_ball(cams, c, x, y, z, radius)
        if how == UNKNOWN or (
            how != UNSEEN
            and changed[c, 0] - reach <= u <= changed[c, 2] + reach
            and changed[c, 1] - reach <= v <= changed[c, 3] + reach
        ):
            return True
    return False


@njit(cache=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def blocks_in_changes(blocks: Any, size: int, voxel: float, cams: Any, changed: Any) -> Any:
    """Those of the blocks that `block_in_changes` finds changed."""
    keep = np.zeros(len(blocks), np.bool_)
    for n in range(len(blocks)):
        keep[n] = block_in_changes(blocks[n], size, voxel, cams, changed)
    return blocks[keep]


@njit(cache=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def voxels_in_changes(indices: Any, lower: Any, root: int, leaf: int, voxel: float, cams: Any, changed: Any) -> Any:
    """Which voxels lie in leaf blocks that `blocks_in_changes` leaves when it halves blocks of `root`; bool [V].

    Fast for voxels in the order in which `evaluate_blocks` gives them: leaf by leaf.
    """
    out = np.zeros(len(indices), np.bool_)
    corner = np.empty(3, np.int64)
    last = np.full(3, -(2**40))
    inside = False
    for n in range(len(indices)):
        same = True
        for axis in range(3):
            at = (indices[n, axis] - lower[axis]) // leaf
            same &= at == last[axis]
            last[axis] = at
        if not same:
            inside = True
            size = root
            while inside and size >= leaf:
                for axis in range(3):
                    corner[axis] = lower[axis] + last[axis] * leaf // size * size
                inside = block_in_changes(corner, size, voxel, cams, changed)
                size //= 2
        out[n] = inside
    return out


@njit(cache=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def label_components(solid: Any) -> Any:
    """6-connected components of a boolean grid: int32 labels (0 = empty) and the voxel count of each label."""
    nx, ny, nz = solid.shape
    labels = np.zeros(solid.shape, np.int32)
    stack = np.empty(solid.size, np.int64)
    sizes = [0]
    current = 0
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                if not solid[i, j, k] or labels[i, j, k] != 0:
                    continue
                current += 1
                labels[i, j, k] = current
                stack[0] = (i * ny + j) * nz + k
                top = 1
                size = 0
                while top > 0:
                    top -= 1
                    at = stack[top]
                    size += 1
                    c = at % nz
                    b = (at // nz) % ny
                    a = at // (nz * ny)
                    for s in range(6):
                        p = a + (s == 0) - (s == 1)
                        q = b + (s == 2) - (s == 3)
                        r = c + (s == 4) - (s == 5)
                        if p < 0 or q < 0 or r < 0 or p >= nx or q >= ny or r >= nz:
                            continue
                        if solid[p, q, r] and labels[p, q, r] == 0:
                            labels[p, q, r] = current
                            stack[top] = (p * ny + q) * nz + r
                            top += 1
                sizes.append(size)
    return labels, np.array(sizes)
