# SPDX-License-Identifier: Apache-2.0
"""Numba kernels of the flesh: how far a point is from a part, the convex hull of up to three spheres."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

#: Distances that differ by less (m) are equal but for rounding.
SLACK = 1e-6


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def part_bounds(parts: Any, points: Any, radii: Any) -> Any:
    """[P, 4] a sphere (x, y, z, radius) around each part."""
    out = np.empty((len(parts), 4))
    for p in range(len(parts)):
        for i in range(3):
            out[p, i] = (points[parts[p, 0], i] + points[parts[p, 1], i] + points[parts[p, 2], i]) / 3.0
        reach = 0.0
        for k in range(3):
            s = parts[p, k]
            x = points[s, 0] - out[p, 0]
            y = points[s, 1] - out[p, 1]
            z = points[s, 2] - out[p, 2]
            reach = max(reach, math.sqrt(x * x + y * y + z * z) + radii[s])
        out[p, 3] = reach
    return out


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def lay_out_part(part: Any, spheres: Any, radii: Any, row: Any) -> None:
    """Write one row of `lay_out`."""
    a, b, c = part
    row[0] = 1.0 if b == a else (2.0 if c == b else 3.0)
    for i in range(3):
        row[1 + i] = spheres[a, i]
        row[4 + i] = spheres[b, i] - spheres[a, i]
        row[7 + i] = spheres[c, i] - spheres[a, i]
    row[10] = radii[a]
    row[11] = radii[b] - radii[a]
    row[12] = radii[c] - radii[a]


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def lay_out(parts: Any, spheres: Any, radii: Any) -> tuple[Any, Any]:
    """What `distance_to_part` reads of the parts, each number where it is needed next.

    Returns:
        [P, 13]: number of spheres; the first one's place a; the ways u, v from it to the second and third; its radius,
        and by how much theirs are larger; [4, P]: spheres around the parts (x, y, z, radius).
    """
    rows = np.empty((len(parts), 13))
    for p in range(len(parts)):
        lay_out_part(parts[p], spheres, radii, rows[p])
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

    A part is the convex hull of its (up to three) spheres. The nearest sphere of the continuous family c(w), r(w) with
    barycentric weights w minimises |p - c(w)| - r(w), which is convex: inside the triangle it is where the offset from
    p's foot equals h g / sqrt(1 - g^2) along the slope g of the radius, else it lies on an edge. All is said by
    products of the ways between the point and the spheres; looking along a ray (unit; zero for none) only takes the
    share along it out of those.
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
def flesh_distance(query: Any, parts: Any, points: Any, radii: Any) -> Any:
    """Signed distance [Q] (m) of points [Q, 3] to the union of the parts, and the nearest part [Q].

    Outside it is exact; inside it is the depth below the nearest part's own surface.
    """
    rows, bounds = lay_out(parts, points, radii)
    no_ray = np.zeros(3)
    out = np.empty(len(query))
    nearest = np.empty(len(query), np.int64)
    for q in range(len(query)):
        x, y, z = query[q, 0], query[q, 1], query[q, 2]
        best = 1e9
        for p in range(len(parts)):
            bx = x - bounds[0, p]
            by = y - bounds[1, p]
            bz = z - bounds[2, p]
            reach = best + bounds[3, p]
            if reach <= 0.0 or bx * bx + by * by + bz * bz > reach * reach:
                continue
            d, _, _ = distance_to_part(rows[p], x, y, z, no_ray)
            if d < best:
                best = d
                nearest[q] = p
        out[q] = best
    return out, nearest
