# SPDX-License-Identifier: Apache-2.0
"""Numba kernels of the visual hull; `hull` documents and validates, these trust their caller."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

# Rows of the packed camera table: R (9), t (3), fx fy cx cy, distortion kind, 14 coefficients, width, height.
CAMERA_COLUMNS = 33
NONE, POLYNOMIAL, FISHEYE = 0.0, 1.0, 2.0


@njit(cache=True, inline="always")  # type: ignore[misc, unused-ignore]
def project(cam: Any, x: float, y: float, z: float) -> tuple[float, float, float]:
    """World point (m) -> pixel (u, v) and depth (m) of one packed camera; depth <= 0 is behind it."""
    cz = cam[6] * x + cam[7] * y + cam[8] * z + cam[11]
    if cz <= 1e-6:
        return 0.0, 0.0, 0.0
    a = (cam[0] * x + cam[1] * y + cam[2] * z + cam[9]) / cz
    b = (cam[3] * x + cam[4] * y + cam[5] * z + cam[10]) / cz
    kind = cam[16]
    if kind == 1.0:
        k = cam[17:31]
        r2 = a * a + b * b
        radial = (1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))) / (1.0 + r2 * (k[5] + r2 * (k[6] + r2 * k[7])))
        xx = a * radial + 2.0 * k[2] * a * b + k[3] * (r2 + 2.0 * a * a) + k[8] * r2 + k[9] * r2 * r2
        yy = b * radial + k[2] * (r2 + 2.0 * b * b) + 2.0 * k[3] * a * b + k[10] * r2 + k[11] * r2 * r2
        # A polynomial that turned around would fold far points back into the image: such a point is not seen.
        if a * a + b * b > 4.0:
            return 0.0, 0.0, 0.0
        a, b = xx, yy
    elif kind == 2.0:
        k = cam[17:31]
        r = math.sqrt(a * a + b * b)
        if r > 1e-9:
            th = math.atan(r)
            t2 = th * th
            scale = th * (1.0 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3])))) / r
            a *= scale
            b *= scale
    return cam[12] * a + cam[14], cam[13] * b + cam[15], cz


@njit(cache=True, inline="always")  # type: ignore[misc, unused-ignore]
def camera_distance(cam: Any, box: Any, field: Any, far: float, x: float, y: float, z: float) -> float:
    """Signed distance (m) of a world point to one silhouette cone; -inf where the camera does not see the point.

    `box` is (x0, y0, width, height, offset) of the stored piece of the 2D signed distance; beyond it lies `far`.
    """
    u, v, depth = project(cam, x, y, z)
    if depth <= 0.0 or u < 0.0 or v < 0.0 or u > cam[31] - 1.0 or v > cam[32] - 1.0:
        return -math.inf
    px = u - box[0]
    py = v - box[1]
    if px < 0.0 or py < 0.0 or px > box[2] - 1 or py > box[3] - 1:
        return far
    ix = int(px)
    iy = int(py)
    if ix > box[2] - 2:
        ix = box[2] - 2
    if iy > box[3] - 2:
        iy = box[3] - 2
    fx = px - ix
    fy = py - iy
    at = box[4] + iy * box[2] + ix
    top = field[at] + fx * (field[at + 1] - field[at])
    at += box[2]
    bottom = field[at] + fx * (field[at + 1] - field[at])
    distance: float = (top + fy * (bottom - top)) * depth / cam[12]
    return distance


@njit(cache=True)  # type: ignore[misc, unused-ignore]
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
) -> bool:
    """Whether no voxel of a block (cube of `size` voxels, lowest lattice index `corner`) can be wanted.

    Wanted is a voxel whose largest camera distance is below `band` or, with `keep_second`, whose second largest is
    negative. The 2D distance changes by at most one pixel a pixel, and the bounding sphere's image reaches at most
    f * radius / nearest depth * sqrt(1 + a^2 + b^2) pixels (a, b: normalised image coordinates), so nothing is lost.
    """
    half = 0.5 * size * voxel
    radius = half * math.sqrt(3.0)
    x = corner[0] * voxel + half
    y = corner[1] * voxel + half
    z = corner[2] * voxel + half
    beyond_band = 0
    beyond_zero = 0
    blind = 0
    for c in range(len(cams)):
        cam = cams[c]
        cz = cam[6] * x + cam[7] * y + cam[8] * z + cam[11]
        if cz < -radius:
            blind += 1
            continue
        near = cz - radius
        if near < 0.05 + radius:
            continue  # too close for a bound
        a = (cam[0] * x + cam[1] * y + cam[2] * z + cam[9]) / cz
        b = (cam[3] * x + cam[4] * y + cam[5] * z + cam[10]) / cz
        u, v, depth = project(cam, x, y, z)
        if depth <= 0.0:
            continue
        stretch = 1.0 if cam[16] == 0.0 else 1.25  # lens distortion may locally enlarge the image
        reach = stretch * max(cam[12], cam[13]) * radius / near * math.sqrt(1.0 + a * a + b * b) + 0.5
        if u < -reach or v < -reach or u > cam[31] + reach or v > cam[32] + reach:
            blind += 1
            continue
        if u < reach or v < reach or u > cam[31] - 1.0 - reach or v > cam[32] - 1.0 - reach:
            continue  # partly out of view: some voxels have no say here
        box = boxes[c]
        px = u - box[0]
        py = v - box[1]
        gap = max(-px, px - (box[2] - 1), -py, py - (box[3] - 1))
        if gap > 0.0:
            if gap >= reach:  # all of it lies where every distance is the band
                beyond_band += 1
                beyond_zero += 1
        else:
            d = field[box[4] + int(py) * box[2] + int(px)] - 1.5 - reach
            if d > 0.0:
                beyond_zero += 1
                if d * near / cam[12] >= band:
                    beyond_band += 1
        if beyond_band > 0 and (not keep_second or beyond_zero > 1):
            return True
    return len(cams) - blind < min_seen


@njit(cache=True)  # type: ignore[misc, unused-ignore]
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
    count = 0
    h = size // 2
    for n in range(len(blocks)):
        if block_is_outside(blocks[n], size, cams, boxes, field, voxel, band, keep_second, min_seen):
            continue
        for k in range(8):
            out[count, 0] = blocks[n, 0] + (k & 1) * h
            out[count, 1] = blocks[n, 1] + ((k >> 1) & 1) * h
            out[count, 2] = blocks[n, 2] + (k >> 2) * h
            count += 1
    return out[:count]


@njit(cache=True)  # type: ignore[misc, unused-ignore]
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
    for n in range(len(blocks)):
        if block_is_outside(blocks[n], size, cams, boxes, field, voxel, band, keep_second, min_seen):
            continue
        # The camera that denied the last voxel most likely denies its neighbour: ask it first.
        ask = 0
        for i in range(size):
            bi = blocks[n, 0] + i
            if bi >= upper[0]:
                continue
            x = (bi + 0.5) * voxel
            for j in range(size):
                bj = blocks[n, 1] + j
                if bj >= upper[1]:
                    continue
                y = (bj + 0.5) * voxel
                for k in range(size):
                    bk = blocks[n, 2] + k
                    if bk >= upper[2]:
                        continue
                    z = (bk + 0.5) * voxel
                    d1 = -math.inf
                    d2 = -math.inf
                    w = -1
                    seen = 0
                    wanted = True
                    for turn in range(len(cams)):
                        c = turn
                        if turn == 0:
                            c = ask
                        elif turn <= ask:
                            c = turn - 1
                        d = camera_distance(cams[c], boxes[c], field, band, x, y, z)
                        if d == -math.inf:
                            continue
                        seen += 1
                        if d > d1 or (d == d1 and c < w):
                            d2 = d1
                            d1 = d
                            w = c
                        elif d > d2:
                            d2 = d
                        if d1 >= band and (not keep_second or d2 >= 0.0):
                            wanted = False
                            break
                    if w >= 0:
                        ask = w
                    if not wanted or seen < min_seen:
                        continue
                    index[count, 0] = bi
                    index[count, 1] = bj
                    index[count, 2] = bk
                    first[count] = min(d1, band)
                    second[count] = d2
                    who[count] = w
                    count += 1
    return index[:count], first[:count], second[:count], who[:count]


@njit(cache=True)  # type: ignore[misc, unused-ignore]
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


@njit(cache=True)  # type: ignore[misc, unused-ignore]
def cover(points: Any, reach: float, cams: Any, boxes: Any, covered: Any) -> None:
    """Mark in every camera the pixels that squares of `reach` (m) around the points cover; like `field` in layout."""
    for n in range(len(points)):
        for c in range(len(cams)):
            u, v, depth = project(cams[c], points[n, 0], points[n, 1], points[n, 2])
            if depth <= 0.0:
                continue
            box = boxes[c]
            r = reach * cams[c][12] / depth
            x0 = max(0, math.ceil(u - r) - box[0])
            x1 = min(box[2] - 1, math.floor(u + r) - box[0])
            y0 = max(0, math.ceil(v - r) - box[1])
            y1 = min(box[3] - 1, math.floor(v + r) - box[1])
            for y in range(y0, y1 + 1):
                at = box[4] + y * box[2]
                for x in range(x0, x1 + 1):
                    covered[at + x] = 1


@njit(cache=True)  # type: ignore[misc, unused-ignore]
def count_unexplained(
    points: Any, deniers: Any, cams: Any, boxes: Any, field: Any, covered: Any, inner_px: float
) -> Any:
    """In how many cameras but the denier each point falls on foreground that nothing covers; int16 [V]."""
    out = np.zeros(len(points), np.int16)
    for n in range(len(points)):
        for c in range(len(cams)):
            if c == deniers[n]:
                continue
            u, v, depth = project(cams[c], points[n, 0], points[n, 1], points[n, 2])
            if depth <= 0.0:
                continue
            box = boxes[c]
            x = int(u + 0.5) - box[0]
            y = int(v + 0.5) - box[1]
            if x < 0 or y < 0 or x >= box[2] or y >= box[3]:
                continue
            at = box[4] + y * box[2] + x
            if field[at] < -inner_px and covered[at] == 0:
                out[n] += 1
    return out


@njit(cache=True)  # type: ignore[misc, unused-ignore]
def paint_balls(points: Any, radii: Any, cam: Any, box: Any, mask: Any) -> None:
    """Set to 1 the pixels of one camera's piece (uint8 [height, width]) that the balls cover."""
    for n in range(len(points)):
        u, v, depth = project(cam, points[n, 0], points[n, 1], points[n, 2])
        if depth <= 0.0:
            continue
        r = radii[n] * cam[12] / depth
        u -= box[0]
        v -= box[1]
        y0 = max(0, math.ceil(v - r))
        y1 = min(box[3] - 1, math.floor(v + r))
        for y in range(y0, y1 + 1):
            w = math.sqrt(max(0.0, r * r - (y - v) * (y - v)))
            for x in range(max(0, math.ceil(u - w)), min(box[2] - 1, math.floor(u + w)) + 1):
                mask[y, x] = 1
