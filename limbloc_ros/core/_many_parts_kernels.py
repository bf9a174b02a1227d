# SPDX-License-Identifier: Apache-2.0
"""Numba kernels: the distances of many points to one part each, as many at a time as the processor's registers hold.

Pairs of a point and a part are collected in LANES lanes and worked out together. Everything about them lies in one flat
buffer at distances that the compiler knows, and there is no branch: so it needs no checks and uses vectors.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from limbloc_ros.core._part_kernels import SLACK

#: Pairs that are worked out together.
LANES = 64
#: Where in a buffer each number's lanes begin: the way q from the part's first sphere to the point; the ray; what of
#: the normal lies across it; the ways u and v to the second and third sphere; the first radius, and how much larger
#: theirs are. Then the results: signed distance, the same plus what the gate adds, weights of the 2nd and 3rd sphere.
Q, RAY, NORMAL, U, V = 0, 3 * LANES, 6 * LANES, 9 * LANES, 12 * LANES
R, RB, RC = 15 * LANES, 16 * LANES, 17 * LANES
PLAIN, GATED, WB, WC = 18 * LANES, 19 * LANES, 20 * LANES, 21 * LANES
BUFFER = 22 * LANES


@njit(cache=True, inline="always", error_model="numpy")  # type: ignore[misc, unused-ignore]
def put_pair(
    buffers: Any, pairs: Any, kind: int, lane: int, points: Any, facing: Any, rays: Any, q: int, rows: Any, p: int
) -> None:
    """Write point q, what of its normal lies across its ray (`facing` [Q, 3]), and part p of `lay_out` into a lane.

    `kind`: 0 for parts of up to two spheres, 1 for parts of three, which have buffers of their own.
    """
    pairs[kind, lane, 0] = q
    pairs[kind, lane, 1] = p
    for i in range(3):
        buffers[kind, Q + i * LANES + lane] = points[q, i] - rows[p, 1 + i]
        buffers[kind, RAY + i * LANES + lane] = rays[q, i]
        buffers[kind, NORMAL + i * LANES + lane] = facing[q, i]
        buffers[kind, U + i * LANES + lane] = rows[p, 4 + i]
        buffers[kind, V + i * LANES + lane] = rows[p, 7 + i]
        buffers[kind, R + i * LANES + lane] = rows[p, 10 + i]


@njit(cache=True, inline="always", error_model="numpy")  # type: ignore[misc, unused-ignore]
def _on_edge(qq: float, qd: float, dd: float, r: float, dr: float) -> tuple[float, float]:
    """As that of `_part_kernels`, without a branch."""
    swallowed = dd <= dr * dr + 1e-12
    t = qd / dd + dr * math.sqrt(max(qq - qd * qd / dd, 0.0) / (dd * (dd - dr * dr)))
    t = min(1.0, max(0.0, t))
    t = (1.0 if dr > 0.0 else 0.0) if swallowed else t
    return math.sqrt(max(qq - 2.0 * t * qd + t * t * dd, 0.0)) - (r + t * dr), t


@njit(cache=True, inline="always", error_model="numpy")  # type: ignore[misc, unused-ignore]
def _gated(d: float, facing: float, off: float, gate: float) -> float:
    """A distance and what the gate adds (`gated_distance`); `off`: from the point to the nearest sphere's centre."""
    gated = d + gate * (1.0 - facing / (off + 1e-12))
    return gated if (d > 0.0) & (gate > 0.0) else d


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def measure_pairs_of_two(buffer: Any, gate: float) -> None:
    """`gated_distance` of all lanes, for parts of two spheres."""
    for i in range(LANES):
        qx, qy, qz = buffer[Q + i], buffer[Q + LANES + i], buffer[Q + 2 * LANES + i]
        rx, ry, rz = buffer[RAY + i], buffer[RAY + LANES + i], buffer[RAY + 2 * LANES + i]
        ux, uy, uz = buffer[U + i], buffer[U + LANES + i], buffer[U + 2 * LANES + i]
        along_q = qx * rx + qy * ry + qz * rz
        qq = qx * qx + qy * qy + qz * qz - along_q * along_q
        along_u = ux * rx + uy * ry + uz * rz
        uu = ux * ux + uy * uy + uz * uz - along_u * along_u
        qu = qx * ux + qy * uy + qz * uz - along_q * along_u
        d, t = _on_edge(qq, qu, uu, buffer[R + i], buffer[RB + i])
        nx, ny, nz = buffer[NORMAL + i], buffer[NORMAL + LANES + i], buffer[NORMAL + 2 * LANES + i]
        facing = (qx - t * ux) * nx + (qy - t * uy) * ny + (qz - t * uz) * nz
        buffer[PLAIN + i] = d
        buffer[GATED + i] = _gated(d, facing, d + buffer[R + i] + t * buffer[RB + i], gate)
        buffer[WB + i] = t
        buffer[WC + i] = 0.0


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def measure_pairs_of_three(buffer: Any, gate: float) -> None:
    """`gated_distance` of all lanes, for parts of three spheres: `distance_to_part` tells how."""
    for i in range(LANES):
        qx, qy, qz = buffer[Q + i], buffer[Q + LANES + i], buffer[Q + 2 * LANES + i]
        rx, ry, rz = buffer[RAY + i], buffer[RAY + LANES + i], buffer[RAY + 2 * LANES + i]
        ux, uy, uz = buffer[U + i], buffer[U + LANES + i], buffer[U + 2 * LANES + i]
        vx, vy, vz = buffer[V + i], buffer[V + LANES + i], buffer[V + 2 * LANES + i]
        r, rb, rc = buffer[R + i], buffer[RB + i], buffer[RC + i]
        along_q = qx * rx + qy * ry + qz * rz
        along_u = ux * rx + uy * ry + uz * rz
        along_v = vx * rx + vy * ry + vz * rz
        qq = qx * qx + qy * qy + qz * qz - along_q * along_q
        qu = qx * ux + qy * uy + qz * uz - along_q * along_u
        qv = qx * vx + qy * vy + qz * vz - along_q * along_v
        uu = ux * ux + uy * uy + uz * uz - along_u * along_u
        uv = ux * vx + uy * vy + uz * vz - along_u * along_v
        vv = vx * vx + vy * vy + vz * vz - along_v * along_v

        det = uu * vv - uv * uv
        gs = (vv * rb - uv * rc) / det
        gt = (uu * rc - uv * rb) / det
        g2 = gs * rb + gt * rc
        known = (det > 1e-10) & (g2 < 0.999)
        s = (vv * qu - uv * qv) / det
        t = (uu * qv - uv * qu) / det
        h2 = qq - s * qu - t * qv
        f = math.sqrt(max(h2, 0.0) / (1.0 - g2))
        f = f if h2 > SLACK * SLACK else 0.0
        s = s + f * gs if known else -1.0
        t = t + f * gt if known else -1.0
        e = qq - 2.0 * (s * qu + t * qv) + s * s * uu + 2.0 * s * t * uv + t * t * vv
        within = known & (s >= 0.0) & (t >= 0.0) & (s + t <= 1.0)
        d = math.sqrt(max(e, 0.0)) - (r + s * rb + t * rc)

        best, wb, wc = 1e9, 0.0, 0.0
        on_u, at = _on_edge(qq, qu, uu, r, rb)
        take = t < 0.0
        best, wb = on_u if take else best, at if take else wb
        on_v, at = _on_edge(qq, qv, vv, r, rc)
        take = (s < 0.0) & (on_v < best)
        best, wb, wc = on_v if take else best, 0.0 if take else wb, at if take else wc
        across, at = _on_edge(qq - 2.0 * qu + uu, qv - qu - uv + uu, uu - 2.0 * uv + vv, r + rb, rc - rb)
        take = ((not known) | (s + t > 1.0)) & (across < best)
        best, wb, wc = across if take else best, 1.0 - at if take else wb, at if take else wc

        d = d if within else best
        wb = s if within else wb
        wc = t if within else wc
        nx, ny, nz = buffer[NORMAL + i], buffer[NORMAL + LANES + i], buffer[NORMAL + 2 * LANES + i]
        facing = (qx - wb * ux - wc * vx) * nx + (qy - wb * uy - wc * vy) * ny + (qz - wb * uz - wc * vz) * nz
        buffer[PLAIN + i] = d
        buffer[GATED + i] = _gated(d, facing, d + r + wb * rb + wc * rc, gate)
        buffer[WB + i] = wb
        buffer[WC + i] = wc


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def settle_pairs(
    buffers: Any, pairs: Any, kind: int, filled: Any, gate: float, best: Any, hints: Any, w: Any, least: Any, way: Any
) -> None:
    """Measure the pairs of a kind that are there, and keep for each point what explains it best.

    `best` [Q]: by the gated distance; `hints` [Q]: which part that is; `w` [Q, 3]: the weights of its spheres. How far
    the parts are is kept in `least` [Q, P], plus the `way` [P] of the part.
    """
    if kind == 0:
        measure_pairs_of_two(buffers[0], gate)
    else:
        measure_pairs_of_three(buffers[1], gate)
    for lane in range(filled[kind]):
        q, p = pairs[kind, lane, 0], pairs[kind, lane, 1]
        least[q, p] = np.float32(buffers[kind, PLAIN + lane]) + way[p]
        d = buffers[kind, GATED + lane]
        if d < best[q] or (d == best[q] and p < hints[q]):  # of equals the first, whatever the hint
            best[q] = d
            hints[q] = p
            wb, wc = buffers[kind, WB + lane], buffers[kind, WC + lane]
            w[q, 0], w[q, 1], w[q, 2] = 1.0 - wb - wc, wb, wc
    filled[kind] = 0
