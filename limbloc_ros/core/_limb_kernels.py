# SPDX-License-Identifier: Apache-2.0
"""Numba kernels of the limb search: two-bone limbs on spheres, and what of the hull is explained already."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from limbloc_ros.core._many_parts_kernels import (
    BUFFER,
    LANES,
    PLAIN,
    Q,
    R,
    U,
    V,
    measure_pairs_of_three,
    measure_pairs_of_two,
)
from limbloc_ros.core._part_kernels import lay_out
from limbloc_ros.core._search_kernels import CHUNK, chunk_scratch, depths_at, pop, push, spread_out

#: Ragged masks eat into limbs: where a bone is thinner than expected, up to this fraction of its radius counts little.
#: It must count something: of bones that fit, the one that fills the hull best is to come first.
EATEN, EATEN_WEIGHT = 0.4, 0.3
#: A bone is looked at in so many places, and explained volume along it in so many.
STEPS, LOOKS = 6, 4
#: Bones that fit worse than this are no candidates (little more than 4 is possible), nor those this much too short or
#: long.
WORST, STRETCHED = 3.2, 0.15
#: The end's bone may turn back on the middle's up to this cosine: a limb does not fold onto itself.
FOLDED = 0.87
#: What a tip outside the hull counts.
TIP_WEIGHT = 0.3
#: So many middles get ends, so far apart; and so far (as parts of the first bone) differ limbs that are both returned.
MIDDLES, MIDDLES_APART, LIMBS_APART = 24, 0.12, 0.22


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def cells_within(sdf: Any, origin: Any, voxel: float, stride: int, most: float) -> tuple[Any, Any, Any]:
    """Cells of `stride` voxels up to `most` (m) outside: places [3, N + LANES], indices [3, N], where slices begin.

    They are in array order; slice i of the first axis has those from `starts`[i] to `starts`[i + 1].
    """
    nx = (sdf.shape[0] + stride - 1) // stride
    ny = (sdf.shape[1] + stride - 1) // stride
    nz = (sdf.shape[2] + stride - 1) // stride
    indices = np.empty((3, nx * ny * nz + 1), np.int32)
    starts = np.zeros(nx + 1, np.int64)
    count = 0
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                indices[0, count], indices[1, count], indices[2, count] = i, j, k
                count += sdf[i * stride, j * stride, k * stride] <= most
        starts[i + 1] = count
    places = np.zeros((3, count + LANES))
    for n in range(count):
        places[0, n] = origin[0] + indices[0, n] * stride * voxel
        places[1, n] = origin[1] + indices[1, n] * stride * voxel
        places[2, n] = origin[2] + indices[2, n] * stride * voxel
    return places, indices[:, :count], starts


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def explained_grid(sdf: Any, origin: Any, voxel: float, stride: int, parts: Any, spheres: Any, radii: Any) -> Any:
    """How far each cell of `stride` voxels lies inside the given parts: 0 outside, 1 from 5 cm depth on; float32."""
    places, indices, starts = cells_within(sdf, origin, voxel, stride, 0.02)
    nx = len(starts) - 1
    worst = np.zeros(places.shape[1])
    near = np.zeros(len(worst) + LANES)
    asked = np.zeros(len(worst) + LANES, np.int64)
    buffer = np.zeros(BUFFER)  # no rays, no normals
    rows, bounds = lay_out(parts, spheres, radii)
    for p in range(len(parts)):
        px, py, pz, reach = bounds[0, p], bounds[1, p], bounds[2, p], bounds[3, p]
        low = math.floor((px - reach - origin[0]) / (stride * voxel))
        high = math.floor((px + reach - origin[0]) / (stride * voxel)) + 2
        first = np.uint64(starts[min(max(low, 0), nx)])
        last = np.uint64(starts[min(max(high, 0), nx)])
        for n in range(first, last):
            bx, by, bz = places[0, n] - px, places[1, n] - py, places[2, n] - pz
            left = reach + worst[n]  # a part around which less is left lies nowhere so deep
            inside = (left > 0.0) & (bx * bx + by * by + bz * bz <= left * left) & (worst[n] >= -0.05)
            near[n] = 1.0 if inside else 0.0
        count = 0
        for n in range(first, last):
            asked[count] = n
            count += int(near[n])
        for lane in range(LANES):
            for i in range(3):
                buffer[U + i * LANES + lane] = rows[p, 4 + i]
                buffer[V + i * LANES + lane] = rows[p, 7 + i]
                buffer[R + i * LANES + lane] = rows[p, 10 + i]
        for begin in range(0, count, LANES):
            for lane in range(LANES):
                n = asked[begin + lane]
                for i in range(3):
                    buffer[Q + i * LANES + lane] = places[i, n] - rows[p, 1 + i]
            if rows[p, 0] == 3.0:
                measure_pairs_of_three(buffer, 0.0)
            else:
                measure_pairs_of_two(buffer, 0.0)
            for lane in range(min(LANES, count - begin)):
                n = asked[begin + lane]
                worst[n] = min(worst[n], buffer[PLAIN + lane])
    out = np.zeros((nx, (sdf.shape[1] + stride - 1) // stride, (sdf.shape[2] + stride - 1) // stride), np.float32)
    for n in range(indices.shape[1]):
        out[indices[0, n], indices[1, n], indices[2, n]] = min(-worst[n] / 0.05, 1.0)
    return out


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def ways_from(start: Any, length: float, forbidden: Any, points: Any, uniform: Any, ways: Any, work: Any) -> int:
    """Unit directions from `start` [3]: to points [3, N] about `length` away, then of uniform [3, D] ones; to `ways`.

    Those within the cone `forbidden` [4] (direction, cosine) are left out. Returns how many there are; `ways` [7, M]
    gets directions and where they end after `length`.
    """
    x0, y0, z0 = start[0], start[1], start[2]
    fx, fy, fz, cosine = forbidden[0], forbidden[1], forbidden[2], forbidden[3]
    shortest, longest = (1.0 - STRETCHED) * length, (1.0 + STRETCHED) * length
    # Most points are too near or too far. By their squares, vector code leaves few, of which roots are taken.
    least, most = shortest * shortest * (1.0 - 1e-9), longest * longest * (1.0 + 1e-9)
    some = 0
    for first in range(0, points.shape[1], CHUNK):
        size = min(CHUNK, points.shape[1] - first)
        for n in range(size):
            dx, dy, dz = points[0, first + n] - x0, points[1, first + n] - y0, points[2, first + n] - z0
            square = dx * dx + dy * dy + dz * dz
            work[n] = 1.0 if least <= square <= most else 0.0
        for n in range(size):
            ways[6, some] = first + n
            some += int(work[n])
    count = 0
    for m in range(some):
        n = int(ways[6, m])
        dx, dy, dz = points[0, n] - x0, points[1, n] - y0, points[2, n] - z0
        away = math.sqrt(dx * dx + dy * dy + dz * dz)
        dx /= away
        dy /= away
        dz /= away
        ways[0, count], ways[1, count], ways[2, count] = dx, dy, dz
        count += (away >= shortest) & (away <= longest) & (dx * fx + dy * fy + dz * fz <= cosine)
    for n in range(uniform.shape[1]):
        dx, dy, dz = uniform[0, n], uniform[1, n], uniform[2, n]
        ways[0, count], ways[1, count], ways[2, count] = dx, dy, dz
        count += dx * fx + dy * fy + dz * fz <= cosine
    for n in range(count):
        ways[3, n] = x0 + length * ways[0, n]
        ways[4, n] = y0 + length * ways[1, n]
        ways[5, n] = z0 + length * ways[2, n]
    return count


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def score_tubes(
    sdf: Any, origin: Any, voxel: float, start: Any, ra: float, rb: float, steps: int, clip: float, skip: float,
    ways: Any, count: int, scratch: tuple[Any, Any, Any],
) -> None:  # fmt: skip
    """How badly cones from `start` [3] to the ends ways[3:6] of the first `count` ways fit into the hull, to ways[6].

    The mean clipped square of a cone's miss, from the fraction `skip` of the bone on: phi + radius; where that is
    positive, what masks may have eaten by EATEN_WEIGHT, and the rest doubled.
    """
    work, cells, corners = scratch
    ax, ay, az = start[0], start[1], start[2]
    norm = steps * clip * clip
    for first in range(0, count, CHUNK):
        for n in range(CHUNK):
            ways[6, first + n] = 0.0
        for step in range(steps):
            t = skip + (1.0 - skip) * (step + 0.5) / steps
            radius = ra + t * (rb - ra)
            for n in range(CHUNK):
                work[n] = ax + t * (ways[3, first + n] - ax)
                work[CHUNK + n] = ay + t * (ways[4, first + n] - ay)
                work[2 * CHUNK + n] = az + t * (ways[5, first + n] - az)
            depths_at(sdf, origin, voxel, work, cells, corners)
            for n in range(CHUNK):
                e = work[3 * CHUNK + n]
                e += clip if e > 0.0 else 0.0  # the bone itself lies outside: constraint 3
                e += radius
                eaten = min(max(e, 0.0), EATEN * radius)
                e = 2.0 * (e - eaten) if e > 0.0 else e
                e = min(max(e, -clip), 2.0 * clip)
                ways[6, first + n] += e * e + EATEN_WEIGHT * eaten * eaten
        for n in range(CHUNK):
            ways[6, first + n] /= norm


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def add_explained(
    grid: Any, origin: Any, cell: float, start: Any, skip: float, weight: float, ways: Any, count: int, cells: Any
) -> None:
    """Add to ways[6] the mean of the explained grid along each bone, from the fraction `skip` on, times `weight`."""
    ax, ay, az = start[0], start[1], start[2]
    x0, y0, z0 = origin[0], origin[1], origin[2]
    nx, ny, nz = grid.shape
    totals = np.empty(CHUNK)
    for first in range(0, count, CHUNK):
        for n in range(CHUNK):
            totals[n] = 0.0
        for look in range(LOOKS):
            t = skip + (1.0 - skip) * (look + 0.5) / LOOKS
            for n in range(CHUNK):
                cells[n] = np.int32((ax + t * (ways[3, first + n] - ax) - x0) / cell + 0.5)
                cells[CHUNK + n] = np.int32((ay + t * (ways[4, first + n] - ay) - y0) / cell + 0.5)
                cells[2 * CHUNK + n] = np.int32((az + t * (ways[5, first + n] - az) - z0) / cell + 0.5)
            for n in range(min(CHUNK, count - first)):
                i, j, k = cells[n], cells[CHUNK + n], cells[2 * CHUNK + n]
                if i >= 0 and j >= 0 and k >= 0 and i < nx and j < ny and k < nz:
                    totals[n] += grid[i, j, k]
        for n in range(CHUNK):
            ways[6, first + n] += weight * (totals[n] / LOOKS)


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def bones_from(
    start: Any, length: float, ra: float, rb: float, forbidden: Any, points: Any, uniform: Any,
    sdf: Any, origin: Any, voxel: float, explained: Any, cell: float, hidden: tuple[float, float],
    clip: float, explained_weight: float, ways: Any, scratch: tuple[Any, Any, Any],
) -> int:  # fmt: skip
    """Bones from `start` [3] that fit into the hull: direction, end and score, to `ways` [7, M]; returns how many.

    Of a bone the first part lies in other flesh: so much is `hidden` from the hull, and from what is explained.
    """
    count = ways_from(start, length, forbidden, points, uniform, ways, scratch[0])
    score_tubes(sdf, origin, voxel, start, ra, rb, STEPS, clip, hidden[0], ways, count, scratch)
    kept = 0
    for n in range(count):
        for i in range(7):
            ways[i, kept] = ways[i, n]
        kept += ways[6, n] <= WORST
    add_explained(explained, origin, cell, start, hidden[1], explained_weight, ways, kept, scratch[1])
    return kept


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def keep_new(found: Any, n: int, kept: Any, count: int, apart: float) -> int:
    """Add limb `n` of `found` to the `count` ones that are kept, unless it lies near one; how many were added."""
    for k in range(count):
        d1 = 0.0
        d2 = 0.0
        for i in range(3):
            d1 += (found[n, i] - kept[k, i]) ** 2
            d2 += (found[n, 3 + i] - kept[k, 3 + i]) ** 2
        if d1 < apart**2 and d2 < apart**2:
            return 0
    kept[count] = found[n]
    return 1


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def search_limb(
    base: Any,
    lengths: Any,
    tube_radii: Any,
    tip_length: float,
    candidates: Any,
    directions: Any,
    sdf: Any,
    origin: Any,
    voxel: float,
    explained: Any,
    stride: int,
    skip: float,
    clip: float,
    explained_weight: float,
    forbidden: Any,
    keep: int,
) -> Any:
    """Two-bone limbs from `base` [3]: middle joints on the sphere of the first bone's length, ends on the second's.

    Candidates for the middle are medial points near the sphere (pulled onto it) and uniform directions; for the end
    likewise around each good middle. `forbidden` [4] is a direction and a cosine: first bones within it are not human.

    Returns float64 [M, 7]: middle, end, score; the best first, of equals the one whose bones came first.
    """
    points = candidates.T.copy()
    uniform = directions.T.copy()
    most = (points.shape[1] + uniform.shape[1] + CHUNK - 1) // CHUNK * CHUNK
    ways = np.zeros((7, most + CHUNK))
    scratch = chunk_scratch()
    work, cells, corners = scratch
    cell = stride * voxel
    count = bones_from(
        base, lengths[0], tube_radii[0], tube_radii[1], forbidden, points, uniform, sdf, origin, voxel, explained, cell,
        (skip, 0.4), clip, explained_weight, ways, scratch,
    )  # fmt: skip
    middle = ways[3:, :count].T.copy()
    chosen = spread_out(middle, np.argsort(middle[:, 3], kind="mergesort"), MIDDLES_APART * lengths[0], MIDDLES)
    found = np.empty((len(chosen) * most, 7))
    scores = np.empty(len(found))
    heap = np.empty(len(found), np.int64)
    total, waiting = 0, 0
    back = np.empty(4)
    back[3] = FOLDED
    kept = np.empty((keep, 7))
    best = 0
    apart = LIMBS_APART * lengths[0]
    for c in range(len(chosen)):
        m = chosen[c]
        for i in range(3):
            back[i] = -((middle[m, i] - base[i]) / lengths[0])
        count = bones_from(
            middle[m], lengths[1], tube_radii[1], tube_radii[2], back, points, uniform, sdf, origin, voxel, explained,
            cell, (0.0, 0.0), clip, explained_weight, ways, scratch,
        )  # fmt: skip
        for first in range(0, count, CHUNK):
            for n in range(CHUNK):  # the hand or heel goes on a little beyond the end
                for i in range(3):
                    work[i * CHUNK + n] = ways[3 + i, first + n] + 0.5 * tip_length * ways[i, first + n]
            depths_at(sdf, origin, voxel, work, cells, corners)
            for n in range(first, min(first + CHUNK, count)):
                tip = work[3 * CHUNK + n - first]
                score = middle[m, 3] + (ways[6, n] + TIP_WEIGHT * min(max(tip / clip, 0.0), 1.0))
                for i in range(3):
                    found[total, i] = middle[m, i]
                    found[total, 3 + i] = ways[3 + i, n]
                found[total, 6] = score
                scores[total] = score
                push(heap, waiting, scores, total)
                total += 1
                waiting += 1
        # Ends of later middles score no less than those: what is better is not waited for.
        settled = middle[chosen[c + 1], 3] if c + 1 < len(chosen) else math.inf
        while waiting > 0 and scores[heap[0]] < settled and best < keep:
            n = pop(heap, waiting, scores)
            waiting -= 1
            best += keep_new(found, n, kept, best, apart)
        if best == keep:
            break
    return kept[:best]
