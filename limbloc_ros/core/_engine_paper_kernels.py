# SPDX-License-Identifier: Apache-2.0
"""Numba kernels of `engine_paper.py`: eq. 2 with soft voxels and the constraints of section 2.2."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from limbloc_ros.core._figure_kernels import log_so3
from limbloc_ros.core._part_kernels import distance_to_part, lay_out
from limbloc_ros.core._surface_kernels import trilinear


@njit(cache=True)  # type: ignore[misc, unused-ignore]
def distance_up_to(
    query: Any, blocks: Any, starts: Any, known: Any, limit: float, parts: Any, points: Any, radii: Any
) -> Any:
    """[Q] m: signed distance of points to the union of `parts` and of what is `known`, cut at +-limit.

    A voxel's share of flesh only depends on distances within half its width. A distance changes by no more than the
    way travelled, so the distance at a block's middle (blocks[b]: x, y, z, radius; rows starts[b] to starts[b + 1])
    tells which parts are too far off to matter to any point of it, and whether one covers it whole.
    """
    rows, bounds = lay_out(parts, points, radii)
    no_ray = np.zeros(3)
    out = np.empty(len(query))
    near = np.empty(len(parts), np.int64)
    for b in range(len(blocks)):
        count = 0
        covered = False
        x, y, z, radius = blocks[b, 0], blocks[b, 1], blocks[b, 2], blocks[b, 3]
        for p in range(len(parts)):
            bx, by, bz = x - bounds[0, p], y - bounds[1, p], z - bounds[2, p]
            reach = limit + radius + bounds[3, p]
            if bx * bx + by * by + bz * bz > reach * reach:
                continue
            d, _, _ = distance_to_part(rows[p], x, y, z, no_ray)
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
                d, _, _ = distance_to_part(rows[near[n]], query[q, 0], query[q, 1], query[q, 2], no_ray)
                best = min(best, d)
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
    rows, _ = lay_out(parts, points, radii)
    no_ray = np.zeros(3)
    total = 0.0
    for n in range(len(pairs)):
        s, p = pairs[n, 0], pairs[n, 1]
        d, _, _ = distance_to_part(rows[p], points[s, 0], points[s, 1], points[s, 2], no_ray)
        total += max(0.0, (1.0 - allowed) * radii[s] - d)
    return total
