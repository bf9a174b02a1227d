# SPDX-License-Identifier: Apache-2.0
"""Numba kernels of the surface term: which part of the figure explains a point of the hull's surface, and how well."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from limbloc_ros.core._figure_kernels import part_bounds

#: Distances that differ by less (m) are equal but for rounding.
SLACK = 1e-6


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
def lay_out(parts: Any, spheres: Any, radii: Any) -> tuple[Any, Any]:
    """What `nearest_part` reads of the parts, each number where it is needed next.

    Returns:
        [P, 13]: number of spheres; the first one's place a; the ways u, v from it to the second and third; its radius,
        and by how much theirs are larger; [4, P]: spheres around the parts (x, y, z, radius).
    """
    rows = np.zeros((len(parts), 13))
    for p in range(len(parts)):
        a, b, c = parts[p]
        rows[p, 0] = 1.0 if b == a else (2.0 if c == b else 3.0)
        for i in range(3):
            rows[p, 1 + i] = spheres[a, i]
            rows[p, 4 + i] = spheres[b, i] - spheres[a, i]
            rows[p, 7 + i] = spheres[c, i] - spheres[a, i]
        rows[p, 10] = radii[a]
        rows[p, 11] = radii[b] - radii[a]
        rows[p, 12] = radii[c] - radii[a]
    return rows, part_bounds(parts, spheres, radii).T.copy()


@njit(cache=True, inline="always", error_model="numpy")  # type: ignore[misc, unused-ignore]
def _on_edge(qq: float, qd: float, dd: float, r: float, dr: float) -> tuple[float, float]:
    """Signed distance to the convex hull of two spheres, and the weight of the second one at the nearest sphere.

    qq: squared distance of the point from the first centre; qd: its product with the way to the second; dd: that way
    squared; r: the first radius; dr: how much larger the second is.
    """
    if dd <= dr * dr + 1e-12:  # one sphere swallows the other
        t = 1.0 if dr > 0.0 else 0.0
    else:
        t = qd / dd + dr * math.sqrt(max(qq - qd * qd / dd, 0.0) / (dd * (dd - dr * dr)))
        t = min(1.0, max(0.0, t))
    return math.sqrt(max(qq - 2.0 * t * qd + t * t * dd, 0.0)) - (r + t * dr), t


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def distance_to_part(row: Any, x: float, y: float, z: float, ray: Any) -> tuple[float, float, float]:
    """Signed distance of a point, or of a ray through it, to a part of `lay_out`; weights of its 2nd and 3rd sphere.

    See `_figure_kernels.part_distance`; but all is said by products of the ways between the point and the spheres, and
    looking along a ray only takes the share along it out of those.
    """
    qx, qy, qz = x - row[1], y - row[2], z - row[3]
    along_q = qx * ray[0] + qy * ray[1] + qz * ray[2]
    qq = qx * qx + qy * qy + qz * qz - along_q * along_q
    if row[0] == 1.0:
        return math.sqrt(max(qq, 0.0)) - row[10], 0.0, 0.0
    along_u = row[4] * ray[0] + row[5] * ray[1] + row[6] * ray[2]
    uu = row[4] * row[4] + row[5] * row[5] + row[6] * row[6] - along_u * along_u
    qu = qx * row[4] + qy * row[5] + qz * row[6] - along_q * along_u
    r, rb, rc = row[10], row[11], row[12]
    if row[0] == 2.0:
        d, t = _on_edge(qq, qu, uu, r, rb)
        return d, t, 0.0
    along_v = row[7] * ray[0] + row[8] * ray[1] + row[9] * ray[2]
    vv = row[7] * row[7] + row[8] * row[8] + row[9] * row[9] - along_v * along_v
    uv = row[4] * row[7] + row[5] * row[8] + row[6] * row[9] - along_u * along_v
    qv = qx * row[7] + qy * row[8] + qz * row[9] - along_q * along_v
    s = t = -1.0
    det = uu * vv - uv * uv
    known = False
    if det > 1e-10:
        gs = (vv * rb - uv * rc) / det
        gt = (uu * rc - uv * rb) / det
        g2 = gs * rb + gt * rc
        if g2 < 0.999:
            known = True
            s = (vv * qu - uv * qv) / det
            t = (uu * qv - uv * qu) / det
            h2 = qq - s * qu - t * qv  # above the plane, squared; along a ray all lies in one, but for rounding
            f = math.sqrt(h2 / (1.0 - g2)) if h2 > SLACK * SLACK else 0.0
            s += f * gs
            t += f * gt
            if s >= 0.0 and t >= 0.0 and s + t <= 1.0:
                e = qq - 2.0 * (s * qu + t * qv) + s * s * uu + 2.0 * s * t * uv + t * t * vv
                return math.sqrt(max(e, 0.0)) - (r + s * rb + t * rc), s, t
    # The distance is convex over the triangle's plane: its least value within is on an edge that the least value
    # in the whole plane lies beyond.
    best = 1e9
    wb = wc = 0.0
    if t < 0.0:
        best, wb = _on_edge(qq, qu, uu, r, rb)
    if s < 0.0:
        d, w = _on_edge(qq, qv, vv, r, rc)
        if d < best:
            best, wb, wc = d, 0.0, w
    if not known or s + t > 1.0:
        d, w = _on_edge(qq - 2.0 * qu + uu, qv - qu - uv + uu, uu - 2.0 * uv + vv, r + rb, rc - rb)
        if d < best:
            best, wb, wc = d, 1.0 - w, w
    return best, wb, wc


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
