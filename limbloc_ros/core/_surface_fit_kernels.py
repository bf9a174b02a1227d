# SPDX-License-Identifier: Apache-2.0
"""Numba kernels of the surface term: which part of the figure explains a point of the hull's surface, and how well."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from limbloc_ros.core._figure_kernels import part_bounds, part_distance


@njit(cache=True, inline="always", error_model="numpy")  # type: ignore[misc, unused-ignore]
def robust_weight(d: float, width: float) -> tuple[float, float]:
    """Geman-McClure: cost width^2 u / (1 + u) with u = (d / width)^2, and the weight of its Gauss-Newton step."""
    u = (d / width) * (d / width)
    return width * width * u / (1.0 + u), 1.0 / ((1.0 + u) * (1.0 + u))


@njit(cache=True, inline="always", error_model="numpy")  # type: ignore[misc, unused-ignore]
def add_block(block: Any, slope: Any, v: Any, residual: float, weight: float) -> None:
    """Add one residual with derivative v [12] to a part's block (upper triangle) and slope."""
    for i in range(12):
        wi = weight * v[i]
        if wi == 0.0:
            continue
        slope[i] += wi * residual
        for j in range(i, 12):
            block[i, j] += wi * v[j]


@njit(cache=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def nearest_part(
    point: Any,
    normal: Any,
    ray: Any,
    parts: Any,
    bounds: Any,
    spheres: Any,
    radii: Any,
    gate: float,
    within: float,
    hint: int,
    best_w: Any,
    scratch: Any,
) -> tuple[float, int]:
    """The part that explains a surface point best, and its distance plus what the gate adds; -1 if none is `within`.

    With a `ray` (unit; zero for none) any point of the ray may be explained. Seen along it spheres are circles, so the
    distances are those of the spheres' projections. A part whose surface looks the other way than `normal` counts as
    up to 2 `gate` further off. `hint` is asked first: neighbouring points mostly have the same part, and then nearly
    all others are out of reach. Writes the nearest sphere's barycentric weights to best_w [3]; scratch is [5, 3].
    """
    ux, uy, uz = ray[0], ray[1], ray[2]
    near = scratch[:3]
    near_radii = scratch[3]
    w = scratch[4]
    rows = (0, 1, 2)
    best = within
    best_part = -1
    for n in range(-1, len(parts)):
        p = hint if n < 0 else n
        if n == hint or p < 0:
            continue
        bx = bounds[p, 0] - point[0]
        by = bounds[p, 1] - point[1]
        bz = bounds[p, 2] - point[2]
        along = bx * ux + by * uy + bz * uz
        reach = best + bounds[p, 3]
        if reach <= 0.0 or bx * bx + by * by + bz * bz - along * along > reach * reach:
            continue
        for k in range(3):
            s = parts[p, k]
            x = spheres[s, 0] - point[0]
            y = spheres[s, 1] - point[1]
            z = spheres[s, 2] - point[2]
            along = x * ux + y * uy + z * uz
            near[k, 0] = x - along * ux
            near[k, 1] = y - along * uy
            near[k, 2] = z - along * uz
            near_radii[k] = radii[s]
        second = 0 if parts[p, 1] == parts[p, 0] else 1
        rows = (0, second, second if parts[p, 2] == parts[p, 1] else 2)
        d = part_distance(0.0, 0.0, 0.0, rows, near, near_radii, w)
        if 0.0 < d < best and gate > 0.0:
            nx = -w[0] * near[0, 0] - w[1] * near[1, 0] - w[2] * near[2, 0]
            ny = -w[0] * near[0, 1] - w[1] * near[1, 1] - w[2] * near[2, 1]
            nz = -w[0] * near[0, 2] - w[1] * near[1, 2] - w[2] * near[2, 2]
            length = math.sqrt(nx * nx + ny * ny + nz * nz) + 1e-12
            d += gate * (1.0 - (nx * normal[0] + ny * normal[1] + nz * normal[2]) / length)
        if d < best or (d == best and p < best_part):  # parts share spheres: of equals the first, whatever the hint
            best = d
            best_part = p
            best_w[0] = w[0]
            best_w[1] = w[1]
            best_w[2] = w[2]
    return best, best_part


@njit(cache=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def radius_slope(ray: Any, part: Any, spheres: Any, radii: Any, out: Any) -> None:
    """Minus the gradient of the radius over the triangle of a part's spheres, seen along a ray; [3]; 0 on a line."""
    u = np.empty(3)
    v = np.empty(3)
    for i in range(3):
        u[i] = spheres[part[1], i] - spheres[part[0], i]
        v[i] = spheres[part[2], i] - spheres[part[0], i]
    along_u = u[0] * ray[0] + u[1] * ray[1] + u[2] * ray[2]
    along_v = v[0] * ray[0] + v[1] * ray[1] + v[2] * ray[2]
    uu = 0.0
    uv = 0.0
    vv = 0.0
    for i in range(3):
        u[i] -= along_u * ray[i]
        v[i] -= along_v * ray[i]
        uu += u[i] * u[i]
        uv += u[i] * v[i]
        vv += v[i] * v[i]
    det = uu * vv - uv * uv
    rb = radii[part[1]] - radii[part[0]]
    rc = radii[part[2]] - radii[part[0]]
    for i in range(3):
        out[i] = -((vv * rb - uv * rc) * u[i] + (uu * rc - uv * rb) * v[i]) / det if det > 1e-10 else 0.0


@njit(cache=True, inline="always", error_model="numpy")  # type: ignore[misc, unused-ignore]
def offset_from(point: Any, ray: Any, part: Any, w: Any, spheres: Any, radii: Any, out: Any) -> float:
    """Signed distance of a point (or its ray) to one sphere of a part; how it falls with that sphere's place in `out`.

    That is the direction from the sphere to the point. But a ray that runs through the triangle of three spheres, as it
    does where the trunk is seen, meets the sphere's very centre: there the distance is the radius, whose slope counts.
    """
    r = 0.0
    out[0] = 0.0
    out[1] = 0.0
    out[2] = 0.0
    for k in range(3):
        s = part[k]
        for i in range(3):
            out[i] += w[k] * (point[i] - spheres[s, i])
        r += w[k] * radii[s]
    along = out[0] * ray[0] + out[1] * ray[1] + out[2] * ray[2]
    for i in range(3):
        out[i] -= along * ray[i]
    length = math.sqrt(out[0] * out[0] + out[1] * out[1] + out[2] * out[2])
    if length > 1e-9:
        for i in range(3):
            out[i] /= length
    else:
        radius_slope(ray, part, spheres, radii, out)
    return length - r


@njit(cache=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def surface_term(
    query: Any,
    normals: Any,
    rays: Any,
    weight_of: Any,
    hints: Any,
    parts: Any,
    spheres: Any,
    radii: Any,
    width: float,
    gate: float,
    inside_weight: float,
    blocks: Any,
    slopes: Any,
) -> float:
    """Hull surface points to the nearest part: the figure should explain the whole surface (see `nearest_part`).

    `hints` [Q] holds the part of each point the last time, and is written: from step to step it is mostly the same.
    """
    bounds = part_bounds(parts, spheres, radii)
    w = np.empty(3)
    away = np.empty(3)
    scratch = np.empty((5, 3))
    v = np.zeros(12)
    p = -1
    cost = 0.0
    for q in range(len(query)):
        hint = hints[q] if hints[q] >= 0 else p
        _, p = nearest_part(query[q], normals[q], rays[q], parts, bounds, spheres, radii, gate, 1e9, hint, w, scratch)
        hints[q] = p
        d = offset_from(query[q], rays[q], parts[p], w, spheres, radii, away)
        c, wd = robust_weight(d, width)
        scale = weight_of[q] * (inside_weight if d < 0.0 else 1.0)
        cost += scale * c
        for k in range(3):
            for i in range(3):
                v[4 * k + i] = -w[k] * away[i]
            v[4 * k + 3] = -w[k]
        add_block(blocks[p], slopes[p], v, d, scale * wd)
    return cost
