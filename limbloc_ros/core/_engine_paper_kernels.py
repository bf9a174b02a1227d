# SPDX-License-Identifier: Apache-2.0
"""Numba kernels of `engine_paper.py`: eq. 2 with soft voxels and the constraints of section 2.2."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from limbloc_ros.core._figure_kernels import log_so3, part_bounds
from limbloc_ros.core._surface_kernels import trilinear


@njit(cache=True)  # type: ignore[misc, unused-ignore]
def pack_parts(parts: Any, points: Any, radii: Any) -> Any:
    """[P, 32] per part what its distance needs, so that a query is plain arithmetic on one row.

    0: number of spheres; 1..4 bounding sphere; then the spheres a, b, c (x, y, z, r: 5..16); per edge ab, bc, ca
    1 / length and the slope of the radius along it (17..22; a slope of 2 marks an edge whose one sphere swallows the
    other); 23..29 the plane of the triangle; 30, 31 radius slopes along its sides.
    """
    out = np.zeros((len(parts), 32))
    bounds = part_bounds(parts, points, radii)
    for p in range(len(parts)):
        row = out[p]
        spheres = 3
        if parts[p, 2] == parts[p, 1]:
            spheres = 2
        if parts[p, 1] == parts[p, 0]:
            spheres = 1
        row[0] = spheres
        for k in range(4):
            row[1 + k] = bounds[p, k]
        for k in range(3):
            for i in range(3):
                row[5 + 4 * k + i] = points[parts[p, k], i]
            row[8 + 4 * k] = radii[parts[p, k]]
        for e in range(3):
            a, b = 5 + 4 * e, 5 + 4 * ((e + 1) % 3)
            x, y, z = row[b] - row[a], row[b + 1] - row[a + 1], row[b + 2] - row[a + 2]
            length = math.sqrt(x * x + y * y + z * z)
            change = row[b + 3] - row[a + 3]
            if length <= abs(change) + 1e-9:
                row[18 + 2 * e] = 2.0
            else:
                row[17 + 2 * e] = 1.0 / length
                row[18 + 2 * e] = change / length
        if spheres == 3:
            ux, uy, uz = row[9] - row[5], row[10] - row[6], row[11] - row[7]
            vx, vy, vz = row[13] - row[5], row[14] - row[6], row[15] - row[7]
            uu = ux * ux + uy * uy + uz * uz
            uv = ux * vx + uy * vy + uz * vz
            vv = vx * vx + vy * vy + vz * vz
            det = uu * vv - uv * uv
            rb, rc = row[12] - row[8], row[16] - row[8]
            if det > 1e-10:
                gs, gt = (vv * rb - uv * rc) / det, (uu * rc - uv * rb) / det
                g2 = gs * rb + gt * rc
                if g2 < 0.999:
                    row[23], row[24], row[25] = vv / det, -uv / det, uu / det
                    row[26] = math.sqrt(1.0 - g2)
                    row[27], row[28] = gs / row[26], gt / row[26]
                    row[29] = 1.0
                    row[30], row[31] = rb, rc
    return out


@njit(cache=True, inline="always")  # type: ignore[misc, unused-ignore]
def _edge(x: float, y: float, z: float, table: Any, p: int, e: int) -> Any:
    a, b = 5 + 4 * e, 5 + 4 * ((e + 1) % 3)
    qx, qy, qz = x - table[p, a], y - table[p, a + 1], z - table[p, a + 2]
    g = table[p, 18 + 2 * e]
    if g == 2.0:
        if table[p, b + 3] > table[p, a + 3]:
            qx, qy, qz = x - table[p, b], y - table[p, b + 1], z - table[p, b + 2]
            return math.sqrt(qx * qx + qy * qy + qz * qz) - table[p, b + 3]
        return math.sqrt(qx * qx + qy * qy + qz * qz) - table[p, a + 3]
    inverse = table[p, 17 + 2 * e]
    dx, dy, dz = table[p, b] - table[p, a], table[p, b + 1] - table[p, a + 1], table[p, b + 2] - table[p, a + 2]
    along = (qx * dx + qy * dy + qz * dz) * inverse
    off = math.sqrt(max(qx * qx + qy * qy + qz * qz - along * along, 0.0))
    slant = math.sqrt(1.0 - g * g)
    t = (along + off * g / slant) * inverse
    if t <= 0.0:
        return math.sqrt(along * along + off * off) - table[p, a + 3]
    if t >= 1.0:
        rest = along - 1.0 / inverse
        return math.sqrt(rest * rest + off * off) - table[p, b + 3]
    return off * slant - table[p, a + 3] - along * g


@njit(cache=True)  # type: ignore[misc, unused-ignore]
def packed_distance(x: float, y: float, z: float, table: Any, p: int) -> Any:
    """Signed distance (m) to part `p` of `pack_parts`; equal to `_figure_kernels.part_distance`."""
    if table[p, 0] == 1.0:
        qx, qy, qz = x - table[p, 5], y - table[p, 6], z - table[p, 7]
        return math.sqrt(qx * qx + qy * qy + qz * qz) - table[p, 8]
    if table[p, 0] == 2.0:
        return _edge(x, y, z, table, p, 0)
    if table[p, 29] == 1.0:
        qx, qy, qz = x - table[p, 5], y - table[p, 6], z - table[p, 7]
        ux, uy, uz = table[p, 9] - table[p, 5], table[p, 10] - table[p, 6], table[p, 11] - table[p, 7]
        vx, vy, vz = table[p, 13] - table[p, 5], table[p, 14] - table[p, 6], table[p, 15] - table[p, 7]
        qu, qv = qx * ux + qy * uy + qz * uz, qx * vx + qy * vy + qz * vz
        s = table[p, 23] * qu + table[p, 24] * qv
        t = table[p, 24] * qu + table[p, 25] * qv
        ex, ey, ez = qx - s * ux - t * vx, qy - s * uy - t * vy, qz - s * uz - t * vz
        h = math.sqrt(ex * ex + ey * ey + ez * ez)
        s1, t1 = s + h * table[p, 27], t + h * table[p, 28]
        if s1 >= 0.0 and t1 >= 0.0 and s1 + t1 <= 1.0:
            return h * table[p, 26] - (table[p, 8] + s * table[p, 30] + t * table[p, 31])
    return min(_edge(x, y, z, table, p, 0), min(_edge(x, y, z, table, p, 1), _edge(x, y, z, table, p, 2)))


@njit(cache=True)  # type: ignore[misc, unused-ignore]
def distance_up_to(
    query: Any, blocks: Any, starts: Any, known: Any, limit: float, parts: Any, points: Any, radii: Any
) -> Any:
    """[Q] m: signed distance of points to the union of `parts` and of what is `known`, cut at +-limit.

    A voxel's share of flesh only depends on distances within half its width. A distance changes by no more than the
    way travelled, so the distance at a block's middle (blocks[b]: x, y, z, radius; rows starts[b] to starts[b + 1])
    tells which parts are too far off to matter to any point of it, and whether one covers it whole.
    """
    table = pack_parts(parts, points, radii)
    out = np.empty(len(query))
    near = np.empty(len(parts), np.int64)
    for b in range(len(blocks)):
        count = 0
        covered = False
        x, y, z, radius = blocks[b, 0], blocks[b, 1], blocks[b, 2], blocks[b, 3]
        for p in range(len(parts)):
            bx, by, bz = x - table[p, 1], y - table[p, 2], z - table[p, 3]
            reach = limit + radius + table[p, 4]
            if bx * bx + by * by + bz * bz > reach * reach:
                continue
            d = packed_distance(x, y, z, table, p)
            if d < -limit - radius:
                covered = True
                break
            if d < limit + radius:
                near[count] = p
                count += 1
        for q in range(starts[b], starts[b + 1]):
            best = -limit if covered else min(known[q], limit)
            for n in range(count):
                if best <= -limit:
                    break
                best = min(best, packed_distance(query[q, 0], query[q, 1], query[q, 2], table, near[n]))
            out[q] = max(best, -limit)
    return out


@njit(cache=True)  # type: ignore[misc, unused-ignore]
def soft_xor(
    query: Any,
    blocks: Any,
    starts: Any,
    worth: Any,
    hull_share: Any,
    known: Any,
    width: float,
    parts: Any,
    points: Any,
    radii: Any,
) -> float:
    """Sum over voxels of worth * |share of hull - share of flesh|; at a surface a share falls to 0 over `width` m."""
    distance = distance_up_to(query, blocks, starts, known, 0.5 * width, parts, points, radii)
    total = 0.0
    for q in range(len(query)):
        total += worth[q] * abs(hull_share[q] - (0.5 - distance[q] / width))
    return total


@njit(cache=True)  # type: ignore[misc, unused-ignore]
def bones_outside(sdf: Any, origin: Any, voxel: float, begins: Any, ends: Any, reach: float) -> float:
    """Mean over the bones of the length share outside the hull (constraint 3), rising to 1 at `reach` m outside."""
    total = 0.0
    for b in range(len(begins)):
        for s in range(1, 9):
            t = s / 8.0
            d = trilinear(
                sdf,
                (begins[b, 0] + t * (ends[b, 0] - begins[b, 0]) - origin[0]) / voxel,
                (begins[b, 1] + t * (ends[b, 1] - begins[b, 1]) - origin[1]) / voxel,
                (begins[b, 2] + t * (ends[b, 2] - begins[b, 2]) - origin[2]) / voxel,
            )
            total += min(max(d, 0.0) / reach, 1.0)
    return total / (8 * len(begins))


@njit(cache=True)  # type: ignore[misc, unused-ignore]
def angles_from_rest(rotations: Any, rest: Any, dof_bones: Any, dof_axes: Any) -> Any:
    """[D] rad: each joint's rotation vector from the middle of its range, by its axes."""
    vectors = np.empty((len(rotations), 3))
    for b in range(len(rotations)):
        vectors[b] = log_so3(rest[b].T @ rotations[b])
    out = np.empty(len(dof_bones))
    for d in range(len(dof_bones)):
        v = vectors[dof_bones[d]]
        out[d] = v[0] * dof_axes[d, 0] + v[1] * dof_axes[d, 1] + v[2] * dof_axes[d, 2]
    return out


@njit(cache=True)  # type: ignore[misc, unused-ignore]
def penetration_depth(pairs: Any, parts: Any, points: Any, radii: Any, allowed: float) -> float:
    """Sum (m) of how far spheres reach into parts they must not enter, beyond `allowed` of their radius."""
    table = pack_parts(parts, points, radii)
    total = 0.0
    for n in range(len(pairs)):
        s, p = pairs[n, 0], pairs[n, 1]
        d = packed_distance(points[s, 0], points[s, 1], points[s, 2], table, p)
        total += max(0.0, (1.0 - allowed) * radii[s] - d)
    return total
