# SPDX-License-Identifier: Apache-2.0
"""Numba kernels of the surface term: which part of the figure explains a point of the hull's surface, and how well."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from limbloc_ros.core._many_parts_kernels import BUFFER, LANES, put_pair, settle_pairs
from limbloc_ros.core._part_kernels import SLACK, distance_to_part, lay_out

#: A figure that has moved by more than this in one step, m, is looked at anew.
FORGET_M = 0.1


@njit(cache=True, inline="always", error_model="numpy")  # type: ignore[misc, unused-ignore]
def robust_weight(d: float, width: float) -> tuple[float, float]:
    """Geman-McClure: cost width^2 u / (1 + u) with u = (d / width)^2, and the weight of its Gauss-Newton step."""
    u = (d / width) * (d / width)
    return width * width * u / (1.0 + u), 1.0 / ((1.0 + u) * (1.0 + u))


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def add_block(blocks: Any, slopes: Any, p: int, w: Any, q: int, away: Any, residual: float, weight: float) -> None:
    """Add one residual to part p's block (on and above the diagonal of its 4 x 4 pieces) and slope.

    The residual falls by w[q, k] * away[i] with the place of sphere k along axis i, and by w[q, k] * away[3] with its
    radius.
    """
    for k in range(3):
        if w[q, k] == 0.0:
            continue
        first = weight * w[q, k]
        for i in range(4):
            slopes[p, 4 * k + i] -= first * residual * away[i]
        for m in range(k, 3):
            if w[q, m] == 0.0:
                continue
            for i in range(4):
                both = first * w[q, m] * away[i]
                for j in range(4):
                    blocks[p, 4 * k + i, 4 * m + j] += both * away[j]


@njit(cache=True, inline="always", error_model="numpy")  # type: ignore[misc, unused-ignore]
def gated_distance(
    row: Any, x: float, y: float, z: float, ray: Any, nx: float, ny: float, nz: float, gate: float
) -> tuple[float, float, float, float]:
    """Signed distance to a part of `lay_out`, the same plus what the gate adds, weights of its 2nd and 3rd sphere.

    A part whose surface looks the other way than the normal counts as up to 2 `gate` further off.
    """
    d, wb, wc = distance_to_part(row, x, y, z, ray)
    gated = d
    if d > 0.0 and gate > 0.0:
        facing = (
            (x - row[1] - wb * row[4] - wc * row[7]) * nx
            + (y - row[2] - wb * row[5] - wc * row[8]) * ny
            + (z - row[3] - wb * row[6] - wc * row[9]) * nz
        )
        gated += gate * (1.0 - facing / (d + row[10] + wb * row[11] + wc * row[12] + 1e-12))
    return d, gated, wb, wc


@njit(cache=True, inline="always", error_model="numpy")  # type: ignore[misc, unused-ignore]
def across(normal: Any, ray: Any) -> tuple[float, float, float]:
    """What of a normal [3] lies across a ray (unit; zero for none)."""
    along = normal[0] * ray[0] + normal[1] * ray[1] + normal[2] * ray[2]
    return normal[0] - along * ray[0], normal[1] - along * ray[1], normal[2] - along * ray[2]


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def go_on(parts: Any, spheres: Any, radii: Any, spheres_then: Any, radii_then: Any, way: Any) -> float:
    """Add to `way` [P] by how much the distance to each part can have changed, m, since its spheres were as they were
    then, which from now on is as they are now. Returns the most that one has changed."""
    by_sphere = np.empty(len(radii))
    for s in range(len(radii)):
        d2 = 0.0
        for i in range(3):
            d2 += (spheres[s, i] - spheres_then[s, i]) ** 2
            spheres_then[s, i] = spheres[s, i]
        by_sphere[s] = math.sqrt(d2) + abs(radii[s] - radii_then[s])
        radii_then[s] = radii[s]
    most = 0.0
    for p in range(len(parts)):
        by = max(by_sphere[parts[p, 0]], by_sphere[parts[p, 1]], by_sphere[parts[p, 2]])
        way[p] += np.float32(by + SLACK)
        most = by if by > most or by != by else most  # a number that is none is never forgotten
    return most


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def bound_distances(query: Any, rays: Any, bounds: Any, hints: Any, least: Any) -> None:
    """Write to `least` [Q, P] how near each part is at least, by what `lay_out` puts around it. The one that may be the
    nearest becomes the hint of a point that has none (-1)."""
    for q in range(len(query)):
        x, y, z = query[q, 0], query[q, 1], query[q, 2]
        rx, ry, rz = rays[q, 0], rays[q, 1], rays[q, 2]
        for p in range(least.shape[1]):
            bx, by, bz = bounds[0, p] - x, bounds[1, p] - y, bounds[2, p] - z
            along = bx * rx + by * ry + bz * rz
            least[q, p] = np.float32(math.sqrt(max(bx * bx + by * by + bz * bz - along * along, 0.0)) - bounds[3, p])
        if hints[q] < 0:
            nearest = 0
            for p in range(1, least.shape[1]):
                if least[q, p] < least[q, nearest]:
                    nearest = p
            hints[q] = nearest


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def explaining_parts(
    query: Any, normals: Any, rays: Any, rows: Any, gate: float, hints: Any, least: Any, way: Any
) -> Any:
    """Write to `hints` [Q] the part that explains each surface point best: by its distance plus what the gate adds.

    With a ray (unit; zero for none) any point of the ray may be explained. Seen along it spheres are circles, so the
    distances are those of the spheres' projections. `rows`: of `lay_out`.

    `least` [Q, P], less the `way` [P] that a part's spheres have gone meanwhile: no part is nearer than that. So most
    parts are known to be further off than the one that explained the point before, which is asked first. What is
    learned here is written.

    Returns:
        [Q, 3] barycentric weights of the part's nearest sphere.
    """
    count = len(query)
    w = np.empty((count, 3))
    best = np.full(count, 1e9)
    facing = np.empty((count, 3))
    buffers = np.zeros((2, BUFFER))  # parts of two spheres, parts of three
    pairs = np.zeros((2, LANES, 2), np.int64)
    filled = np.zeros(2, np.int64)
    for q in range(count):
        facing[q, 0], facing[q, 1], facing[q, 2] = across(normals[q], rays[q])
        kind = int(rows[hints[q], 0] == 3.0)
        put_pair(buffers, pairs, kind, filled[kind], query, facing, rays, q, rows, hints[q])
        filled[kind] += 1
        if filled[kind] == LANES:
            settle_pairs(buffers, pairs, kind, filled, gate, best, hints, w, least, way)
    for kind in range(2):
        settle_pairs(buffers, pairs, kind, filled, gate, best, hints, w, least, way)
    able = np.zeros(-(-len(rows) // 8) * 8, np.uint8)
    able_8 = able.view(np.uint64)
    for q in range(count):
        reach = np.float32(best[q] + SLACK)
        for p in range(np.uint64(len(rows))):  # all at once: without a branch this takes a few nanoseconds
            able[p] = least[q, p] - way[p] <= reach
        able[hints[q]] = 0
        for eight in range(len(able_8)):
            if able_8[eight] == 0:
                continue
            for p in range(8 * eight, 8 * eight + 8):
                if able[p] == 0:
                    continue
                kind = int(rows[p, 0] == 3.0)
                put_pair(buffers, pairs, kind, filled[kind], query, facing, rays, q, rows, p)
                filled[kind] += 1
                if filled[kind] == LANES:
                    settle_pairs(buffers, pairs, kind, filled, gate, best, hints, w, least, way)
    for kind in range(2):
        settle_pairs(buffers, pairs, kind, filled, gate, best, hints, w, least, way)
    return w


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
    least: Any,
    way: Any,
    spheres_then: Any,
    radii_then: Any,
    parts: Any,
    spheres: Any,
    radii: Any,
    width: float,
    gate: float,
    inside_weight: float,
    blocks: Any,
    slopes: Any,
) -> float:
    """Hull surface points to the nearest part: the figure should explain the whole surface (`explaining_parts`).

    From step to step figures move by millimetres, and a distance changes by no more than the figure moves. So it is
    kept which part was the nearest (`hints` [Q]), how near each part was at least (`least` [Q, P]), and how far it has
    gone meanwhile (`way` [P]), from `spheres_then` [S, 3] with `radii_then` [S]: few parts need be asked. All five are
    written.
    """
    rows, bounds = lay_out(parts, spheres, radii)
    most = go_on(parts, spheres, radii, spheres_then, radii_then, way)
    if not most <= FORGET_M:  # also where nothing is known yet
        way[:] = 0.0
        bound_distances(query, rays, bounds, hints, least)
    weights = explaining_parts(query, normals, rays, rows, gate, hints, least, way)
    away = np.ones(4)
    cost = 0.0
    for q in range(len(query)):
        p = hints[q]
        d = offset_from(query[q], rays[q], parts[p], weights[q], spheres, radii, away)
        c, wd = robust_weight(d, width)
        scale = weight_of[q] * (inside_weight if d < 0.0 else 1.0)
        cost += scale * c
        add_block(blocks, slopes, p, weights, q, away, d, scale * wd)
    return cost
