# SPDX-License-Identifier: Apache-2.0
"""Numba kernels of the figure: forward kinematics with its Jacobian, and distances to the flesh."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def exp_so3(w: Any) -> Any:
    """Rotation vector [3], rad -> rotation matrix [3, 3] (Rodrigues)."""
    t2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    t = math.sqrt(t2)
    if t < 1e-4:
        a = 1.0 - t2 / 6.0
        b = 0.5 - t2 / 24.0
    else:
        a = math.sin(t) / t
        b = (1.0 - math.cos(t)) / t2
    R = np.empty((3, 3))
    R[0, 0] = 1.0 - b * (w[1] * w[1] + w[2] * w[2])
    R[1, 1] = 1.0 - b * (w[0] * w[0] + w[2] * w[2])
    R[2, 2] = 1.0 - b * (w[0] * w[0] + w[1] * w[1])
    R[0, 1] = b * w[0] * w[1] - a * w[2]
    R[1, 0] = b * w[0] * w[1] + a * w[2]
    R[0, 2] = b * w[0] * w[2] + a * w[1]
    R[2, 0] = b * w[0] * w[2] - a * w[1]
    R[1, 2] = b * w[1] * w[2] - a * w[0]
    R[2, 1] = b * w[1] * w[2] + a * w[0]
    return R


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def log_so3(R: Any) -> Any:
    """Rotation matrix [3, 3] -> rotation vector [3], rad, of length at most pi."""
    # Through the unit quaternion with the largest component first: exact near 0 and near pi.
    q = np.empty(4)
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    if trace > 0.0:
        s = 2.0 * math.sqrt(max(trace + 1.0, 1e-30))
        q[0] = 0.25 * s
        q[1] = (R[2, 1] - R[1, 2]) / s
        q[2] = (R[0, 2] - R[2, 0]) / s
        q[3] = (R[1, 0] - R[0, 1]) / s
    else:
        i = 0
        if R[1, 1] > R[0, 0]:
            i = 1
        if R[2, 2] > R[i, i]:
            i = 2
        j = (i + 1) % 3
        k = (i + 2) % 3
        s = 2.0 * math.sqrt(max(1.0 + R[i, i] - R[j, j] - R[k, k], 1e-30))
        q[1 + i] = 0.25 * s
        q[0] = (R[k, j] - R[j, k]) / s
        q[1 + j] = (R[j, i] + R[i, j]) / s
        q[1 + k] = (R[k, i] + R[i, k]) / s
    if q[0] < 0.0:
        q = -q
    n = math.sqrt(q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    if n < 1e-12:
        return 2.0 * q[1:4]
    return (2.0 * math.atan2(n, q[0]) / n) * q[1:4]


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def forward(
    root: Any,
    rotations: Any,
    shape: Any,
    parents: Any,
    bone_offsets: Any,
    point_bones: Any,
    point_offsets: Any,
    point_radii: Any,
) -> Any:
    """Place bones and points.

    Lengths are linear in the shape: x = exp(shape[0]) * (mean + modes @ shape[1:]).

    Args:
        root: [3] pelvis in the world, m.
        rotations: [B, 3, 3] of each bone in its parent.
        shape: [1 + K] log scale and mode weights.
        parents: [B] index of each bone's parent, -1 for the root.
        bone_offsets: [B, 3, 1 + K] a bone's origin in its parent (mean, then modes).
        point_bones: [N] the bone that carries each point.
        point_offsets: [N, 3, 1 + K] each point in its bone.
        point_radii: [N, 1 + K].

    Returns:
        origins [B, 3] m, T_world_bone rotations [B, 3, 3], points [N, 3] m, radii [N] m.
    """
    nb = len(parents)
    nk = len(shape)
    scale = math.exp(shape[0])
    origins = np.empty((nb, 3))
    world = np.empty((nb, 3, 3))
    for b in range(nb):
        p = parents[b]
        if p < 0:
            origins[b] = root
            world[b] = rotations[b]
            continue
        for i in range(3):
            origins[b, i] = origins[p, i]
        for j in range(3):
            o = bone_offsets[b, j, 0]
            for k in range(1, nk):
                o += bone_offsets[b, j, k] * shape[k]
            o *= scale
            for i in range(3):
                origins[b, i] += world[p, i, j] * o
        for i in range(3):
            for j in range(3):
                world[b, i, j] = (
                    world[p, i, 0] * rotations[b, 0, j]
                    + world[p, i, 1] * rotations[b, 1, j]
                    + world[p, i, 2] * rotations[b, 2, j]
                )
    n_points = len(point_bones)
    points = np.empty((n_points, 3))
    radii = np.empty(n_points)
    for n in range(n_points):
        b = point_bones[n]
        for i in range(3):
            points[n, i] = origins[b, i]
        for j in range(3):
            o = point_offsets[n, j, 0]
            for k in range(1, nk):
                o += point_offsets[n, j, k] * shape[k]
            o *= scale
            for i in range(3):
                points[n, i] += world[b, i, j] * o
        r = point_radii[n, 0]
        for k in range(1, nk):
            r += point_radii[n, k] * shape[k]
        radii[n] = r * scale
    return origins, world, points, radii


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def jacobian(
    origins: Any,
    world: Any,
    points: Any,
    radii: Any,
    shape: Any,
    parents: Any,
    bone_offsets: Any,
    point_bones: Any,
    point_offsets: Any,
    point_radii: Any,
    dof_bones: Any,
    dof_axes: Any,
    subtree: Any,
) -> Any:
    """Derivatives of the placed points and radii.

    The parameters are the root's translation (3), the D rotations about `dof_axes` (in the bone's own axes, applied
    after its rotation) and the shape (1 + K).

    Returns:
        [N, 4, 3 + D + 1 + K]: d(x, y, z, radius) / d(parameter).
    """
    n_points = len(point_bones)
    nd = len(dof_bones)
    nk = len(shape)
    nb = len(parents)
    scale = math.exp(shape[0])
    first_shape = 3 + nd
    J = np.zeros((n_points, 4, first_shape + nk))
    axes = np.empty((nd, 3))
    for d in range(nd):
        b = dof_bones[d]
        for i in range(3):
            axes[d, i] = (
                world[b, i, 0] * dof_axes[d, 0] + world[b, i, 1] * dof_axes[d, 1] + world[b, i, 2] * dof_axes[d, 2]
            )
    # How the bone origins move with the modes; the scale moves everything away from the root alike.
    origin_modes = np.zeros((nb, 3, nk))
    for b in range(nb):
        p = parents[b]
        if p < 0:
            continue
        for k in range(1, nk):
            for i in range(3):
                origin_modes[b, i, k] = origin_modes[p, i, k] + scale * (
                    world[p, i, 0] * bone_offsets[b, 0, k]
                    + world[p, i, 1] * bone_offsets[b, 1, k]
                    + world[p, i, 2] * bone_offsets[b, 2, k]
                )
    for n in range(n_points):
        b = point_bones[n]
        for i in range(3):
            J[n, i, i] = 1.0
            J[n, i, first_shape] = points[n, i] - origins[0, i]
        J[n, 3, first_shape] = radii[n]
        for d in range(nd):
            j = dof_bones[d]
            if not subtree[j, b]:
                continue
            x = points[n, 0] - origins[j, 0]
            y = points[n, 1] - origins[j, 1]
            z = points[n, 2] - origins[j, 2]
            J[n, 0, 3 + d] = axes[d, 1] * z - axes[d, 2] * y
            J[n, 1, 3 + d] = axes[d, 2] * x - axes[d, 0] * z
            J[n, 2, 3 + d] = axes[d, 0] * y - axes[d, 1] * x
        for k in range(1, nk):
            for i in range(3):
                J[n, i, first_shape + k] = origin_modes[b, i, k] + scale * (
                    world[b, i, 0] * point_offsets[n, 0, k]
                    + world[b, i, 1] * point_offsets[n, 1, k]
                    + world[b, i, 2] * point_offsets[n, 2, k]
                )
            J[n, 3, first_shape + k] = scale * point_radii[n, k]
    return J


@njit(cache=True, inline="always", error_model="numpy")  # type: ignore[misc, unused-ignore]
def _segment(px: float, py: float, pz: float, a: Any, ra: float, b: Any, rb: float) -> tuple[float, float]:
    """Signed distance to the convex hull of two spheres, and the weight of the second one at the nearest sphere."""
    dx = b[0] - a[0]
    dy = b[1] - a[1]
    dz = b[2] - a[2]
    qx = px - a[0]
    qy = py - a[1]
    qz = pz - a[2]
    length2 = dx * dx + dy * dy + dz * dz
    dr = rb - ra
    if length2 <= dr * dr + 1e-12:  # one sphere swallows the other
        t = 1.0 if dr > 0.0 else 0.0
    else:
        length = math.sqrt(length2)
        along = (qx * dx + qy * dy + qz * dz) / length
        off = math.sqrt(max(qx * qx + qy * qy + qz * qz - along * along, 0.0))
        g = dr / length
        t = (along + off * g / math.sqrt(1.0 - g * g)) / length
        t = min(1.0, max(0.0, t))
    ex = qx - t * dx
    ey = qy - t * dy
    ez = qz - t * dz
    return math.sqrt(ex * ex + ey * ey + ez * ez) - (ra + t * dr), t


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def part_distance(px: float, py: float, pz: float, part: Any, points: Any, radii: Any, weights: Any) -> float:
    """Signed distance (m) of a point to one part: the convex hull of its (up to three) spheres.

    The nearest sphere of the continuous family c(w), r(w) with barycentric weights w minimises |p - c(w)| - r(w),
    which is convex: inside the triangle it is where the offset from p's foot equals h g / sqrt(1 - g^2) along the
    slope g of the radius, else it lies on an edge. Writes w to `weights` [3].
    """
    ia, ib, ic = part[0], part[1], part[2]
    a = points[ia]
    b = points[ib]
    weights[0] = 1.0
    weights[1] = 0.0
    weights[2] = 0.0
    if ib == ia:
        x = px - a[0]
        y = py - a[1]
        z = pz - a[2]
        return math.sqrt(x * x + y * y + z * z) - radii[ia]  # type: ignore[no-any-return]
    if ic == ib:
        d, t = _segment(px, py, pz, a, radii[ia], b, radii[ib])
        weights[0] = 1.0 - t
        weights[1] = t
        return d  # type: ignore[no-any-return]
    c = points[ic]
    ux = b[0] - a[0]
    uy = b[1] - a[1]
    uz = b[2] - a[2]
    vx = c[0] - a[0]
    vy = c[1] - a[1]
    vz = c[2] - a[2]
    uu = ux * ux + uy * uy + uz * uz
    uv = ux * vx + uy * vy + uz * vz
    vv = vx * vx + vy * vy + vz * vz
    det = uu * vv - uv * uv
    if det > 1e-10:
        qx = px - a[0]
        qy = py - a[1]
        qz = pz - a[2]
        qu = qx * ux + qy * uy + qz * uz
        qv = qx * vx + qy * vy + qz * vz
        s = (vv * qu - uv * qv) / det
        t = (uu * qv - uv * qu) / det
        ex = qx - s * ux - t * vx
        ey = qy - s * uy - t * vy
        ez = qz - s * uz - t * vz
        h = math.sqrt(ex * ex + ey * ey + ez * ez)
        rb = radii[ib] - radii[ia]
        rc = radii[ic] - radii[ia]
        # slope of the radius in the triangle's plane: g = gs * u + gt * v with g.u = rb, g.v = rc
        gs = (vv * rb - uv * rc) / det
        gt = (uu * rc - uv * rb) / det
        g2 = gs * rb + gt * rc
        if g2 < 0.999:
            f = h / math.sqrt(1.0 - g2)
            s += f * gs
            t += f * gt
            if s >= 0.0 and t >= 0.0 and s + t <= 1.0:
                weights[0] = 1.0 - s - t
                weights[1] = s
                weights[2] = t
                ex = qx - s * ux - t * vx
                ey = qy - s * uy - t * vy
                ez = qz - s * uz - t * vz
                return math.sqrt(ex * ex + ey * ey + ez * ez) - (radii[ia] + s * rb + t * rc)  # type: ignore[no-any-return]
    best, t = _segment(px, py, pz, a, radii[ia], b, radii[ib])
    weights[0] = 1.0 - t
    weights[1] = t
    d, t = _segment(px, py, pz, b, radii[ib], c, radii[ic])
    if d < best:
        best = d
        weights[0] = 0.0
        weights[1] = 1.0 - t
        weights[2] = t
    d, t = _segment(px, py, pz, a, radii[ia], c, radii[ic])
    if d < best:
        best = d
        weights[0] = 1.0 - t
        weights[1] = 0.0
        weights[2] = t
    return best  # type: ignore[no-any-return]


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
def flesh_distance(query: Any, parts: Any, points: Any, radii: Any) -> Any:
    """Signed distance [Q] (m) of points [Q, 3] to the union of the parts, and the nearest part [Q].

    Outside it is exact; inside it is the depth below the nearest part's own surface.
    """
    bounds = part_bounds(parts, points, radii)
    out = np.empty(len(query))
    nearest = np.empty(len(query), np.int64)
    weights = np.empty(3)
    for q in range(len(query)):
        x, y, z = query[q, 0], query[q, 1], query[q, 2]
        best = 1e9
        for p in range(len(parts)):
            bx = x - bounds[p, 0]
            by = y - bounds[p, 1]
            bz = z - bounds[p, 2]
            reach = best + bounds[p, 3]
            if reach <= 0.0 or bx * bx + by * by + bz * bz > reach * reach:
                continue
            d = part_distance(x, y, z, parts[p], points, radii, weights)
            if d < best:
                best = d
                nearest[q] = p
        out[q] = best
    return out, nearest


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def turned(rotations: Any, angles: Any, dof_bones: Any, dof_axes: Any) -> Any:
    """Each bone's rotation [B, 3, 3] followed by the rotation vector of its degrees of freedom (rad)."""
    out = rotations.copy()
    vectors = np.zeros((len(rotations), 3))
    for d in range(len(dof_bones)):
        for i in range(3):
            vectors[dof_bones[d], i] += dof_axes[d, i] * angles[d]
    for b in range(len(rotations)):
        if vectors[b, 0] != 0.0 or vectors[b, 1] != 0.0 or vectors[b, 2] != 0.0:
            E = exp_so3(vectors[b])
            for i in range(3):
                for j in range(3):
                    out[b, i, j] = (
                        rotations[b, i, 0] * E[0, j] + rotations[b, i, 1] * E[1, j] + rotations[b, i, 2] * E[2, j]
                    )
    return out
