# SPDX-License-Identifier: Apache-2.0
"""Numba kernels of the energy: each term adds its cost, gradient and Gauss-Newton matrix.

Every geometric residual depends on one part's (up to) three spheres only, so the terms first add 12 x 12 blocks per
part (three times x, y, z, radius); `gather` multiplies them by the figure's Jacobian once.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from limbloc_ros.core._figure_kernels import log_so3
from limbloc_ros.core._part_kernels import distance_to_part, lay_out_part
from limbloc_ros.core._surface_fit_kernels import add_block, robust_weight

#: How much more a negative amount of clothing costs than a positive one.
TIGHT = 25.0

#: Over which way, in voxels, it is looked how the hull's distance bends.
BEND_VOXELS = 0.75
#: By how much its bending is overrated: a step that goes a little too short is better than one that is rejected.
STIFFER = 1.5


@njit(cache=True, inline="always", error_model="numpy")  # type: ignore[misc, unused-ignore]
def sample_sdf(sdf: Any, origin: Any, voxel: float, x: float, y: float, z: float, out: Any) -> float:
    """Trilinear signed distance (m) with its gradient in `out` [3]; beyond the grid the value at its border."""
    gx = (x - origin[0]) / voxel
    gy = (y - origin[1]) / voxel
    gz = (z - origin[2]) / voxel
    nx, ny, nz = sdf.shape
    cx = min(max(gx, 0.0), nx - 1.001)
    cy = min(max(gy, 0.0), ny - 1.001)
    cz = min(max(gz, 0.0), nz - 1.001)
    i = int(cx)
    j = int(cy)
    k = int(cz)
    a = cx - i
    b = cy - j
    c = cz - k
    v000 = sdf[i, j, k]
    v001 = sdf[i, j, k + 1]
    v010 = sdf[i, j + 1, k]
    v011 = sdf[i, j + 1, k + 1]
    v100 = sdf[i + 1, j, k]
    v101 = sdf[i + 1, j, k + 1]
    v110 = sdf[i + 1, j + 1, k]
    v111 = sdf[i + 1, j + 1, k + 1]
    v00 = v000 + c * (v001 - v000)
    v01 = v010 + c * (v011 - v010)
    v10 = v100 + c * (v101 - v100)
    v11 = v110 + c * (v111 - v110)
    v0 = v00 + b * (v01 - v00)
    v1 = v10 + b * (v11 - v10)
    out[0] = (v1 - v0) / voxel
    out[1] = ((1.0 - a) * (v01 - v00) + a * (v11 - v10)) / voxel
    w0 = (1.0 - a) * (v001 - v000) + a * (v101 - v100)
    w1 = (1.0 - a) * (v011 - v010) + a * (v111 - v110)
    out[2] = ((1.0 - b) * w0 + b * w1) / voxel
    return v0 + a * (v1 - v0)  # type: ignore[no-any-return]


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def add_bending(
    sdf: Any, origin: Any, voxel: float, x: float, y: float, z: float, depth: float, w: Any, force: float, block: Any
) -> None:
    """Add to a part's block what the bending of the signed distance adds to the stiffness of a sphere's residual.

    In the middle between two walls the distance has a kink, where one wall takes over from the other: a sphere thicker
    than the hull sits right there, pushed from all sides. Gauss-Newton, which takes distances for straight, sends it
    across to the other wall and back, and nearly every second step of a fit was rejected for that. The second
    derivatives are differences over BEND_VOXELS; what is added is lifted to a matrix that no direction makes negative.

    `depth`: the distance at the sphere's centre x, y, z; `w` [3]: its barycentric weights; `force`: how strongly it is
    pushed, half the derivative of the cost with the distance.
    """
    h = BEND_VOXELS * voxel
    ahead, behind = np.empty(3), np.empty(3)
    bend = np.empty((3, 3))
    for i in range(3):
        hx, hy, hz = h * (i == 0), h * (i == 1), h * (i == 2)
        up = sample_sdf(sdf, origin, voxel, x + hx, y + hy, z + hz, ahead)
        down = sample_sdf(sdf, origin, voxel, x - hx, y - hy, z - hz, behind)
        for j in range(3):
            bend[i, j] = (ahead[j] - behind[j]) / (2.0 * h)
        bend[i, i] = (up - 2.0 * depth + down) / (h * h)
    for i in range(3):
        for j in range(i):
            bend[i, j] = bend[j, i] = 0.5 * (bend[i, j] + bend[j, i])
    for i in range(3):
        bend[i, i] = max(bend[i, i], abs(bend[i, (i + 1) % 3]) + abs(bend[i, (i + 2) % 3]))
    for k in range(3):
        for m in range(k, 3):
            both = STIFFER * force * w[k] * w[m]
            if both != 0.0:
                for i in range(3):
                    for j in range(3):
                        block[4 * k + i, 4 * m + j] += both * bend[i, j]


@njit(cache=True, inline="always", error_model="numpy")  # type: ignore[misc, unused-ignore]
def blended_sphere(w: Any, part: Any, spheres: Any, radii: Any) -> tuple[float, float, float, float]:
    """Centre and radius of the sphere with barycentric weights w [3] within a part."""
    x = 0.0
    y = 0.0
    z = 0.0
    r = 0.0
    for k in range(3):
        s = part[k]
        x += w[k] * spheres[s, 0]
        y += w[k] * spheres[s, 1]
        z += w[k] * spheres[s, 2]
        r += w[k] * radii[s]
    return x, y, z, r


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def inclusion_term(
    samples: Any,
    sample_parts: Any,
    parts: Any,
    spheres: Any,
    radii: Any,
    sdf: Any,
    origin: Any,
    voxel: float,
    slack: float,
    width: float,
    weight: float,
    blocks: Any,
    slopes: Any,
) -> float:
    """Spheres of the figure that stick out of the hull (constraint 3): one-sided, phi(centre) + radius > slack.

    `samples` [M, 3] are barycentric weights within the parts `sample_parts` [M].
    """
    grad = np.zeros(3)
    away = -np.ones(4)
    cost = 0.0
    for m in range(len(samples)):
        p = sample_parts[m]
        x, y, z, r = blended_sphere(samples[m], parts[p], spheres, radii)
        depth = sample_sdf(sdf, origin, voxel, x, y, z, grad)
        e = depth + r - slack
        if e <= 0.0:
            continue
        c, wd = robust_weight(e, width)
        cost += weight * c
        for i in range(3):
            away[i] = -grad[i]
        add_block(blocks, slopes, p, samples, m, away, e, weight * wd)
        add_bending(sdf, origin, voxel, x, y, z, depth, samples[m], weight * wd * e, blocks[p])
    return cost


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def gather(blocks: Any, slopes: Any, parts: Any, J: Any, A: Any, g: Any) -> None:
    """Multiply the parts' blocks by the figure's Jacobian [S, 4, P] and add them to A [P, P] and g [P].

    Blocks are complete on and above the diagonal of their 4 x 4 pieces. A = J' B J goes by way of B J, sphere by
    sphere, and all inner loops run along rows, for the processor to take several parameters at a time.
    """
    n = A.shape[0]
    end = np.uint64(n)  # of numbers that may be negative the compiler makes no vectors
    pushed = np.zeros(J.shape)
    force = np.zeros((len(J), 4))
    touched = np.zeros(len(J), np.bool_)
    for p in range(len(parts)):
        for k in range(3):
            if blocks[p, 4 * k + 3, 4 * k + 3] == 0.0:
                continue
            s = parts[p, k]
            touched[s] = True
            for i in range(4):
                force[s, i] += slopes[p, 4 * k + i]
            for m in range(3):
                if blocks[p, 4 * m + 3, 4 * m + 3] == 0.0:
                    continue
                q = parts[p, m]
                for i in range(4):
                    a = 4 * k + i
                    b = 4 * m
                    if k <= m:
                        b0, b1, b2, b3 = blocks[p, a, b], blocks[p, a, b + 1], blocks[p, a, b + 2], blocks[p, a, b + 3]
                    else:
                        b0, b1, b2, b3 = blocks[p, b, a], blocks[p, b + 1, a], blocks[p, b + 2, a], blocks[p, b + 3, a]
                    for j in range(end):
                        pushed[s, i, j] += b0 * J[q, 0, j] + b1 * J[q, 1, j] + b2 * J[q, 2, j] + b3 * J[q, 3, j]
    for s in range(len(J)):
        if not touched[s]:
            continue
        for i in range(n):
            x, y, z, r = J[s, 0, i], J[s, 1, i], J[s, 2, i], J[s, 3, i]
            if x == 0.0 and y == 0.0 and z == 0.0 and r == 0.0:  # half of the parameters do not move this sphere
                continue
            g[i] += x * force[s, 0] + y * force[s, 1] + z * force[s, 2] + r * force[s, 3]
            for j in range(np.uint64(i), end):
                A[i, j] += x * pushed[s, 0, j] + y * pushed[s, 1, j] + z * pushed[s, 2, j] + r * pushed[s, 3, j]
    for i in range(n):  # only the upper triangle was added to
        for j in range(i):
            A[i, j] = A[j, i]


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def penetration_term(
    pairs: Any,
    parts: Any,
    spheres: Any,
    radii: Any,
    J: Any,
    allowed: float,
    width: float,
    weight: float,
    A: Any,
    g: Any,
) -> float:
    """Limb spheres inside parts they do not belong to (constraint 5): `pairs` [M, 2] sphere, part.

    A sphere may sink in by the fraction `allowed` of its radius: flesh gives way, and figures are coarse.
    """
    w, no_ray = np.empty(3), np.zeros(3)
    n = A.shape[0]
    row = np.empty(n)
    part = np.empty(13)
    cost = 0.0
    for m in range(len(pairs)):
        s = pairs[m, 0]
        p = pairs[m, 1]
        x, y, z = spheres[s, 0], spheres[s, 1], spheres[s, 2]
        a = parts[p, 0]
        dx = spheres[a, 0] - x
        dy = spheres[a, 1] - y
        dz = spheres[a, 2] - z
        if dx * dx + dy * dy + dz * dz > 0.36:
            continue
        lay_out_part(parts[p], spheres, radii, part)
        d, w[1], w[2] = distance_to_part(part, x, y, z, no_ray)
        w[0] = 1.0 - w[1] - w[2]
        e = (1.0 - allowed) * radii[s] - d
        if e <= 0.0:
            continue
        nx = x
        ny = y
        nz = z
        for k in range(3):
            q = parts[p, k]
            nx -= w[k] * spheres[q, 0]
            ny -= w[k] * spheres[q, 1]
            nz -= w[k] * spheres[q, 2]
        length = math.sqrt(nx * nx + ny * ny + nz * nz) + 1e-9
        nx /= length
        ny /= length
        nz /= length
        c, wd = robust_weight(e, width)
        cost += weight * c
        for i in range(n):
            v = (1.0 - allowed) * J[s, 3, i] - nx * J[s, 0, i] - ny * J[s, 1, i] - nz * J[s, 2, i]
            for k in range(3):
                if w[k] != 0.0:
                    q = parts[p, k]
                    v += w[k] * (nx * J[q, 0, i] + ny * J[q, 1, i] + nz * J[q, 2, i] + J[q, 3, i])
            row[i] = v
        for i in range(n):
            wi = weight * wd * row[i]
            if wi != 0.0:
                g[i] += wi * e
                for j in range(n):
                    A[i, j] += wi * row[j]
    return cost


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def turn_derivative(w: Any, out: Any) -> None:
    """How the rotation vector w of a rotation changes with a small turn after it: inverse right Jacobian of SO(3)."""
    t2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    if t2 < 1e-6:
        c = 1.0 / 12.0
    else:
        t = math.sqrt(t2)
        c = 1.0 / t2 - 0.5 / (t * math.tan(0.5 * t))
    for i in range(3):
        for j in range(3):
            out[i, j] = c * w[i] * w[j]
        out[i, i] += 1.0 - c * t2
    out[0, 1] -= 0.5 * w[2]
    out[1, 0] += 0.5 * w[2]
    out[0, 2] += 0.5 * w[1]
    out[2, 0] -= 0.5 * w[1]
    out[1, 2] -= 0.5 * w[0]
    out[2, 1] += 0.5 * w[0]


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def posture_term(
    rotations: Any,
    shape: Any,
    dof_bones: Any,
    dof_axes: Any,
    rest: Any,
    low: Any,
    high: Any,
    spread: Any,
    prior_weight: float,
    limit_weight: float,
    smooth_pairs: Any,
    smooth_weight: float,
    shape_weight: float,
    clothing_weight: float,
    clothing_from: int,
    log_stature: float,
    log_stature_std: float,
    A: Any,
    g: Any,
) -> float:
    """Joint limits (constraint 4), a weak pull to the middle of the range, an even spine, human proportions.

    `rest`, `low`, `high`, `spread` belong to the degrees of freedom; the angle of one is the component of the
    rotation vector from the bone's rest rotation `rest` [B, 3, 3] along its axis. `shape[clothing_from:]` is clothing.
    """
    cost = 0.0
    nb = len(rotations)
    nd = len(dof_bones)
    vectors = np.empty((nb, 3))
    turns = np.empty((nb, 3, 3))
    R = np.empty((3, 3))
    for b in range(1, nb):
        for i in range(3):
            for j in range(3):
                R[i, j] = (
                    rest[b, 0, i] * rotations[b, 0, j]
                    + rest[b, 1, i] * rotations[b, 1, j]
                    + rest[b, 2, i] * rotations[b, 2, j]
                )
        vectors[b] = log_so3(R)
        turn_derivative(vectors[b], turns[b])
    # each angle, and how it changes with the degrees of freedom of its bone (which stand together)
    angles = np.zeros(nd)
    slopes = np.zeros((nd, nd))
    for d in range(nd):
        b = dof_bones[d]
        if b == 0:
            continue
        for i in range(3):
            angles[d] += vectors[b, i] * dof_axes[d, i]
        for f in range(max(0, d - 2), min(nd, d + 3)):
            if dof_bones[f] == b:
                for i in range(3):
                    for j in range(3):
                        slopes[d, f] += dof_axes[d, i] * turns[b, i, j] * dof_axes[f, j]
    for d in range(nd):
        b = dof_bones[d]
        if b == 0:
            continue
        over = 0.0
        if angles[d] > high[d]:
            over = angles[d] - high[d]
        elif angles[d] < low[d]:
            over = angles[d] - low[d]
        prior = prior_weight / (spread[d] * spread[d])
        cost += prior * angles[d] * angles[d] + limit_weight * over * over
        pull = prior * angles[d] + limit_weight * over
        stiffness = prior + (limit_weight if over != 0.0 else 0.0)
        for f in range(max(0, d - 2), min(nd, d + 3)):
            g[3 + f] += pull * slopes[d, f]
            for h in range(max(0, d - 2), min(nd, d + 3)):
                A[3 + f, 3 + h] += stiffness * slopes[d, f] * slopes[d, h]
    for m in range(len(smooth_pairs)):
        d1 = smooth_pairs[m, 0]
        d2 = smooth_pairs[m, 1]
        e = angles[d1] - angles[d2]
        cost += smooth_weight * e * e
        row = slopes[d1] - slopes[d2]
        for f in range(nd):
            if row[f] != 0.0:
                g[3 + f] += smooth_weight * e * row[f]
                for h in range(nd):
                    A[3 + f, 3 + h] += smooth_weight * row[f] * row[h]
    first = 3 + len(dof_bones)
    e = (shape[0] - log_stature) / log_stature_std
    cost += shape_weight * e * e
    A[first, first] += shape_weight / (log_stature_std * log_stature_std)
    g[first] += shape_weight * e / log_stature_std
    for k in range(1, len(shape)):
        # clothes add to a body and never take away
        weight = shape_weight if k < clothing_from else clothing_weight * (TIGHT if shape[k] < 0.0 else 1.0)
        cost += weight * shape[k] * shape[k]
        A[first + k, first + k] += weight
        g[first + k] += weight * shape[k]
    return cost  # type: ignore[no-any-return]
