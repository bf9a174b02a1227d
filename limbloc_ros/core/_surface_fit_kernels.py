# SPDX-License-Identifier: Apache-2.0
"""Numba kernels of the surface term: which part of the figure explains a point of the hull's surface, and how well."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from limbloc_ros.core._part_kernels import SLACK, distance_to_part, lay_out


@njit(cache=True, inline="always", error_model="numpy")  # type: ignore[misc, unused-ignore]
def robust_weight(d: float, width: float) -> tuple[float, float]:
    """Geman-McClure: cost width^2 u / (1 + u) with u = (d / width)^2, and the weight of its Gauss-Newton step."""
    u = (d / width) * (d / width)
    return width * width * u / (1.0 + u), 1.0 / ((1.0 + u) * (1.0 + u))


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def add_block(block: Any, slope: Any, w: Any, away: Any, residual: float, weight: float) -> None:
    """Add one residual to a part's block (on and above the diagonal of its 4 x 4 pieces) and slope.

    The residual falls by w[k] * away[i] with the place of sphere k along axis i, and by w[k] * away[3] with its radius.
    """
    for k in range(3):
        if w[k] == 0.0:
            continue
        first = weight * w[k]
        for i in range(4):
            slope[4 * k + i] -= first * residual * away[i]
        for m in range(k, 3):
            if w[m] == 0.0:
                continue
            for i in range(4):
                both = first * w[m] * away[i]
                for j in range(4):
                    block[4 * k + i, 4 * m + j] += both * away[j]


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def nearest_part(
    point: Any, normal: Any, ray: Any, rows: Any, bounds: Any, gate: float, within: float, hint: int, far: Any, w: Any
) -> tuple[float, int]:
    """The part that explains a surface point best, and its distance plus what the gate adds; -1 if none is `within`.

    With a `ray` (unit; zero for none) any point of the ray may be explained. Seen along it spheres are circles, so the
    distances are those of the spheres' projections. A part whose surface looks the other way than `normal` counts as
    up to 2 `gate` further off. `hint` is asked first: neighbouring points mostly have the same part, and then nearly
    all others are out of reach. `rows`, `bounds`: of `lay_out`. Writes the nearest sphere's barycentric weights to
    w [3]; far [P] is scratch.
    """
    x, y, z = point[0], point[1], point[2]
    across = normal[0] * ray[0] + normal[1] * ray[1] + normal[2] * ray[2]
    nx, ny, nz = normal[0] - across * ray[0], normal[1] - across * ray[1], normal[2] - across * ray[2]
    best = within
    best_part = -1
    for n in range(-1, len(rows)):
        p = hint if n < 0 else n
        if p >= 0 and (n < 0 or (n != hint and far[n] <= 0.0)):
            row = rows[p]
            d, wb, wc = distance_to_part(row, x, y, z, ray)
            if 0.0 < d < best and gate > 0.0:
                facing = (
                    (x - row[1] - wb * row[4] - wc * row[7]) * nx
                    + (y - row[2] - wb * row[5] - wc * row[8]) * ny
                    + (z - row[3] - wb * row[6] - wc * row[9]) * nz
                )
                d += gate * (1.0 - facing / (d + row[10] + wb * row[11] + wc * row[12] + 1e-12))
            if d < best or (d == best and p < best_part):  # of equals the first, whatever the hint
                best = d
                best_part = p
                w[0] = 1.0 - wb - wc
                w[1] = wb
                w[2] = wc
        if n < 0:  # all others at once: without a branch this takes a few nanoseconds
            for m in range(len(rows)):
                bx, by, bz = bounds[0, m] - x, bounds[1, m] - y, bounds[2, m] - z
                along = bx * ray[0] + by * ray[1] + bz * ray[2]
                reach = max(best + bounds[3, m] + SLACK, 0.0)
                far[m] = bx * bx + by * by + bz * bz - along * along - reach * reach
    return best, best_part


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
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


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
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
    rows, bounds = lay_out(parts, spheres, radii)
    w = np.empty(3)
    away = np.ones(4)
    far = np.empty(len(parts))
    p = -1
    cost = 0.0
    for q in range(len(query)):
        hint = hints[q] if hints[q] >= 0 else p
        _, p = nearest_part(query[q], normals[q], rays[q], rows, bounds, gate, 1e9, hint, far, w)
        hints[q] = p
        d = offset_from(query[q], rays[q], parts[p], w, spheres, radii, away)
        c, wd = robust_weight(d, width)
        scale = weight_of[q] * (inside_weight if d < 0.0 else 1.0)
        cost += scale * c
        add_block(blocks[p], slopes[p], w, away, d, scale * wd)
    return cost
