# SPDX-License-Identifier: Apache-2.0
"""Numba kernels of the exhaustive searches: medial ridge, torso score, limbs on spheres, coverage pairs."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from limbloc_ros.core._figure_kernels import exp_so3, forward, log_so3, part_bounds, part_distance


@njit(cache=True, inline="always")  # type: ignore[misc, unused-ignore]
def depth_at(sdf: Any, origin: Any, voxel: float, x: float, y: float, z: float) -> float:
    """Trilinear signed distance (m); beyond the grid its border's value."""
    gx = min(max((x - origin[0]) / voxel, 0.0), sdf.shape[0] - 1.001)
    gy = min(max((y - origin[1]) / voxel, 0.0), sdf.shape[1] - 1.001)
    gz = min(max((z - origin[2]) / voxel, 0.0), sdf.shape[2] - 1.001)
    i = int(gx)
    j = int(gy)
    k = int(gz)
    a = gx - i
    b = gy - j
    c = gz - k
    v00 = sdf[i, j, k] + c * (sdf[i, j, k + 1] - sdf[i, j, k])
    v01 = sdf[i, j + 1, k] + c * (sdf[i, j + 1, k + 1] - sdf[i, j + 1, k])
    v10 = sdf[i + 1, j, k] + c * (sdf[i + 1, j, k + 1] - sdf[i + 1, j, k])
    v11 = sdf[i + 1, j + 1, k] + c * (sdf[i + 1, j + 1, k + 1] - sdf[i + 1, j + 1, k])
    v0 = v00 + b * (v01 - v00)
    v1 = v10 + b * (v11 - v10)
    return v0 + a * (v1 - v0)


@njit(cache=True)  # type: ignore[misc, unused-ignore]
def medial_ridge(sdf: Any, origin: Any, voxel: float, least_depth: float, flat: float) -> Any:
    """Voxels of the medial axis: inside, and the signed distance has no clear slope (|gradient| < flat).

    Returns float64 [R, 4]: x, y, z and depth, m.
    """
    nx, ny, nz = sdf.shape
    out = np.empty((sdf.size // 8 + 64, 4))
    count = 0
    limit = flat * flat * 4.0 * voxel * voxel
    for i in range(1, nx - 1):
        for j in range(1, ny - 1):
            for k in range(1, nz - 1):
                v = sdf[i, j, k]
                if v > -least_depth:
                    continue
                gx = sdf[i + 1, j, k] - sdf[i - 1, j, k]
                gy = sdf[i, j + 1, k] - sdf[i, j - 1, k]
                gz = sdf[i, j, k + 1] - sdf[i, j, k - 1]
                if gx * gx + gy * gy + gz * gz < limit and count < len(out):
                    out[count, 0] = origin[0] + i * voxel
                    out[count, 1] = origin[1] + j * voxel
                    out[count, 2] = origin[2] + k * voxel
                    out[count, 3] = -v
                    count += 1
    return out[:count]


@njit(cache=True)  # type: ignore[misc, unused-ignore]
def spread_out(points: Any, order: Any, apart: float, most: int) -> Any:
    """Indices of points taken in `order`, each at least `apart` (m) from those before, `most` of them."""
    out = np.empty(most, np.int64)
    count = 0
    for n in order:
        ok = True
        for m in range(count):
            x = points[n, 0] - points[out[m], 0]
            y = points[n, 1] - points[out[m], 1]
            z = points[n, 2] - points[out[m], 2]
            if x * x + y * y + z * z < apart * apart:
                ok = False
                break
        if ok:
            out[count] = n
            count += 1
            if count == most:
                break
    return out[:count]


@njit(cache=True)  # type: ignore[misc, unused-ignore]
def torso_score(
    sdf: Any, origin: Any, voxel: float, points: Any, radii: Any, weights: Any, n_solid: int, clip: float
) -> float:
    """How badly torso spheres match the hull: the first n_solid should just fit, the others must be empty.

    A solid sphere misses by phi + radius (sticking out counts double), an empty one by how deep its centre lies
    below its radius outside. Mean of clipped squares over clip^2, so 0 is perfect and 1 a complete miss.
    """
    total = 0.0
    norm = 0.0
    for n in range(len(points)):
        e = depth_at(sdf, origin, voxel, points[n, 0], points[n, 1], points[n, 2])
        w = weights[n]
        if n < n_solid:
            e += radii[n]
            if e > 0.0:
                e *= 1.5
        else:
            e = max(0.0, radii[n] - e)
        e = min(max(e, -clip), clip)
        total += w * e * e
        norm += w
    return total / (norm * clip * clip)


@njit(cache=True)  # type: ignore[misc, unused-ignore]
def place_torso(
    pose: Any, parents: Any, bone_offsets: Any, point_bones: Any, point_offsets: Any, point_radii: Any
) -> Any:
    """Torso of a search pose [3 root + 3 rotation vector + 3 spine bend + 3 head turn + log stature]: points, radii.

    The bend is the whole turn from pelvis to chest, spread over the three spine joints.
    """
    nb = len(parents)
    rotations = np.zeros((nb, 3, 3))
    for b in range(nb):
        for i in range(3):
            rotations[b, i, i] = 1.0
    rotations[0] = exp_so3(pose[3:6])
    third = exp_so3(pose[6:9] / 3.0)
    rotations[1] = third
    rotations[2] = third
    rotations[3] = third
    rotations[4] = exp_so3(pose[9:12])
    shape = np.empty(1)
    shape[0] = pose[12]
    _, _, points, radii = forward(
        pose[:3], rotations, shape, parents, bone_offsets, point_bones, point_offsets, point_radii
    )
    return points, radii


@njit(cache=True)  # type: ignore[misc, unused-ignore]
def torso_from_pairs(
    pelvis_seeds: Any,
    head_seeds: Any,
    axis_base: Any,
    axis_tip: Any,
    bends: Any,
    yaws: int,
    shortest: float,
    longest: float,
    sdf: Any,
    origin: Any,
    voxel: float,
    table: Any,
    weights: Any,
    n_solid: int,
    most: int,
) -> Any:
    """Score torsos that join every pelvis seed with every head seed: float64 [M, 14], search pose and score.

    For each bend the unit figure's pelvis core lies at axis_base[bend] and its skull core at axis_tip[bend]; their
    distance gives the stature, their direction the axis, about which `yaws` headings over a half turn are tried (a
    torso looks much the same from behind; the caller tries both facings).
    """
    parents, bone_offsets, point_bones, point_offsets, point_radii = table
    out = np.empty((most, 14))
    count = 0
    pose = np.zeros(13)
    R = np.empty((3, 3))
    for a in range(len(pelvis_seeds)):
        for b in range(len(head_seeds)):
            dx = head_seeds[b, 0] - pelvis_seeds[a, 0]
            dy = head_seeds[b, 1] - pelvis_seeds[a, 1]
            dz = head_seeds[b, 2] - pelvis_seeds[a, 2]
            length = math.sqrt(dx * dx + dy * dy + dz * dz)
            if length < shortest or length > longest:
                continue
            for c in range(len(bends)):
                ax = axis_tip[c, 0] - axis_base[c, 0]
                ay = axis_tip[c, 1] - axis_base[c, 1]
                az = axis_tip[c, 2] - axis_base[c, 2]
                unit = math.sqrt(ax * ax + ay * ay + az * az)
                stature = length / unit
                if stature < 1.0 or stature > 2.15:
                    continue
                # rotation that takes the figure's axis to the pair's direction, then yaw about the latter
                ux, uy, uz = ax / unit, ay / unit, az / unit
                vx, vy, vz = dx / length, dy / length, dz / length
                kx, ky, kz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
                sine = math.sqrt(kx * kx + ky * ky + kz * kz)
                cosine = ux * vx + uy * vy + uz * vz
                w = np.zeros(3)
                angle = math.atan2(sine, cosine)
                if sine > 1e-6:
                    w[0] = kx / sine * angle
                    w[1] = ky / sine * angle
                    w[2] = kz / sine * angle
                elif cosine < 0.0:
                    w[0] = math.pi
                align = exp_so3(w)
                for y in range(yaws):
                    turn = np.empty(3)
                    phi = math.pi * y / yaws
                    turn[0] = vx * phi
                    turn[1] = vy * phi
                    turn[2] = vz * phi
                    T = exp_so3(turn)
                    for i in range(3):
                        for j in range(3):
                            R[i, j] = T[i, 0] * align[0, j] + T[i, 1] * align[1, j] + T[i, 2] * align[2, j]
                    pose[3:6] = log_so3(R)
                    for i in range(3):
                        pose[i] = pelvis_seeds[a, i] - stature * (
                            R[i, 0] * axis_base[c, 0] + R[i, 1] * axis_base[c, 1] + R[i, 2] * axis_base[c, 2]
                        )
                        pose[6 + i] = bends[c, i]
                        pose[9 + i] = 0.0
                    pose[12] = math.log(stature)
                    points, radii = place_torso(pose, parents, bone_offsets, point_bones, point_offsets, point_radii)
                    score = torso_score(sdf, origin, voxel, points, radii, weights, n_solid, 0.04 * stature)
                    if count < most:
                        out[count, :13] = pose
                        out[count, 13] = score
                        count += 1
                    else:
                        worst = 0
                        for m in range(1, most):
                            if out[m, 13] > out[worst, 13]:
                                worst = m
                        if score < out[worst, 13]:
                            out[worst, :13] = pose
                            out[worst, 13] = score
    return out[:count]


@njit(cache=True)  # type: ignore[misc, unused-ignore]
def climb_torso(
    start: Any, noise: Any, sdf: Any, origin: Any, voxel: float, table: Any, weights: Any, n_solid: int, spread: Any
) -> Any:
    """Hill climbing of one search pose [14] with given normal noise [steps, 13]; steps shrink on the way."""
    parents, bone_offsets, point_bones, point_offsets, point_radii = table
    best = start.copy()
    trial = best.copy()
    steps = len(noise)
    for n in range(steps):
        shrink = 1.0 - 0.8 * n / steps
        # few coordinates at a time climb faster than all at once
        group = n % 4
        for i in range(13):
            active = (
                group == 0
                or (group == 1 and i < 6)
                or (group == 2 and (i >= 6 and i < 9 or i == 12))
                or (group == 3 and (i >= 3 and i < 6 or i >= 9 and i < 12))
            )
            trial[i] = best[i] + (noise[n, i] * spread[i] * shrink if active else 0.0)
        points, radii = place_torso(trial[:13], parents, bone_offsets, point_bones, point_offsets, point_radii)
        score = torso_score(sdf, origin, voxel, points, radii, weights, n_solid, 0.04 * math.exp(trial[12]))
        bend = trial[6] * trial[6] + trial[7] * trial[7] + trial[8] * trial[8]
        turn = trial[9] * trial[9] + trial[10] * trial[10] + trial[11] * trial[11]
        score += 0.01 * bend + 0.01 * turn + 0.3 * max(0.0, bend - 1.2) + 0.3 * max(0.0, turn - 0.8)
        if score < best[13]:
            best[:13] = trial[:13]
            best[13] = score
    return best


@njit(cache=True)  # type: ignore[misc, unused-ignore]
def tube_score(
    sdf: Any,
    origin: Any,
    voxel: float,
    ax: float,
    ay: float,
    az: float,
    bx: float,
    by: float,
    bz: float,
    ra: float,
    rb: float,
    steps: int,
    clip: float,
    skip: float,
) -> float:
    """Mean clipped miss of a cone between two points, from the fraction `skip` on: phi + radius, outside doubled."""
    total = 0.0
    for n in range(steps):
        t = skip + (1.0 - skip) * (n + 0.5) / steps
        e = depth_at(sdf, origin, voxel, ax + t * (bx - ax), ay + t * (by - ay), az + t * (bz - az))
        if e > 0.0:
            e += clip  # the bone itself lies outside: constraint 3
        e += ra + t * (rb - ra)
        if e > 0.0:
            e *= 2.0
        e = min(max(e, -clip), 2.0 * clip)
        total += e * e
    return total / (steps * clip * clip)


@njit(cache=True)  # type: ignore[misc, unused-ignore]
def explained_grid(sdf: Any, origin: Any, voxel: float, stride: int, parts: Any, spheres: Any, radii: Any) -> Any:
    """How far each cell of `stride` voxels lies inside the given parts: 0 outside, 1 from 5 cm depth on; float32."""
    nx = (sdf.shape[0] + stride - 1) // stride
    ny = (sdf.shape[1] + stride - 1) // stride
    nz = (sdf.shape[2] + stride - 1) // stride
    out = np.zeros((nx, ny, nz), np.float32)
    bounds = part_bounds(parts, spheres, radii)
    w = np.empty(3)
    for i in range(nx):
        x = origin[0] + i * stride * voxel
        for j in range(ny):
            y = origin[1] + j * stride * voxel
            for k in range(nz):
                if sdf[i * stride, j * stride, k * stride] > 0.02:
                    continue
                z = origin[2] + k * stride * voxel
                worst = 0.0
                for p in range(len(parts)):
                    bx = x - bounds[p, 0]
                    by = y - bounds[p, 1]
                    bz = z - bounds[p, 2]
                    if bx * bx + by * by + bz * bz > bounds[p, 3] * bounds[p, 3]:
                        continue
                    worst = min(worst, part_distance(x, y, z, parts[p], spheres, radii, w))
                out[i, j, k] = min(-worst / 0.05, 1.0)
    return out


@njit(cache=True)  # type: ignore[misc, unused-ignore]
def explained_fraction(
    grid: Any, origin: Any, cell: float, ax: float, ay: float, az: float, bx: float, by: float, bz: float, skip: float
) -> float:
    """Mean of the explained grid along a bone, from the fraction `skip` on."""
    total = 0.0
    for n in range(4):
        t = skip + (1.0 - skip) * (n + 0.5) / 4
        i = int((ax + t * (bx - ax) - origin[0]) / cell + 0.5)
        j = int((ay + t * (by - ay) - origin[1]) / cell + 0.5)
        k = int((az + t * (bz - az) - origin[2]) / cell + 0.5)
        if i >= 0 and j >= 0 and k >= 0 and i < grid.shape[0] and j < grid.shape[1] and k < grid.shape[2]:
            total += grid[i, j, k]
    return total / 4


@njit(cache=True)  # type: ignore[misc, unused-ignore]
def search_limb(
    base: Any,
    lengths: Any,
    tube_radii: Any,
    tip_length: float,
    candidates: Any,
    directions: Any,
    sdf: Any,
    origin: Any,
    voxel: float,
    explained: Any,
    stride: int,
    skip: float,
    clip: float,
    explained_weight: float,
    forbidden: Any,
    keep: int,
) -> Any:
    """Two-bone limbs from `base` [3]: middle joints on the sphere of the first bone's length, ends on the second's.

    Candidates for the middle are medial points near the sphere (pulled onto it) and uniform directions; for the end
    likewise around each good middle. `forbidden` [4] is a direction and a cosine: first bones within it are not human.

    Returns float64 [M, 7]: middle, end, score; the best first.
    """
    n1 = len(candidates) + len(directions)
    middle = np.empty((n1, 4))
    count = 0
    for n in range(n1):
        if n < len(candidates):
            dx = candidates[n, 0] - base[0]
            dy = candidates[n, 1] - base[1]
            dz = candidates[n, 2] - base[2]
            length = math.sqrt(dx * dx + dy * dy + dz * dz)
            if length < 0.85 * lengths[0] or length > 1.15 * lengths[0]:
                continue
            dx /= length
            dy /= length
            dz /= length
        else:
            dx, dy, dz = directions[n - len(candidates)]
        if dx * forbidden[0] + dy * forbidden[1] + dz * forbidden[2] > forbidden[3]:
            continue
        x = base[0] + lengths[0] * dx
        y = base[1] + lengths[0] * dy
        z = base[2] + lengths[0] * dz
        s = tube_score(
            sdf, origin, voxel, base[0], base[1], base[2], x, y, z, tube_radii[0], tube_radii[1], 6, clip, skip
        )
        if s > 3.2:
            continue
        s += explained_weight * explained_fraction(
            explained, origin, stride * voxel, base[0], base[1], base[2], x, y, z, 0.4
        )
        middle[count, 0] = x
        middle[count, 1] = y
        middle[count, 2] = z
        middle[count, 3] = s
        count += 1
    middle = middle[:count]
    order = np.argsort(middle[:, 3])
    apart = 0.12 * lengths[0]
    chosen = spread_out(middle, order, apart, 24)
    out = np.empty((len(chosen) * n1, 7))
    total = 0
    for m in chosen:
        ex, ey, ez, s1 = middle[m]
        ux = (ex - base[0]) / lengths[0]
        uy = (ey - base[1]) / lengths[0]
        uz = (ez - base[2]) / lengths[0]
        for n in range(n1):
            if n < len(candidates):
                dx = candidates[n, 0] - ex
                dy = candidates[n, 1] - ey
                dz = candidates[n, 2] - ez
                length = math.sqrt(dx * dx + dy * dy + dz * dz)
                if length < 0.85 * lengths[1] or length > 1.15 * lengths[1]:
                    continue
                dx /= length
                dy /= length
                dz /= length
            else:
                dx, dy, dz = directions[n - len(candidates)]
            if dx * ux + dy * uy + dz * uz < -0.87:  # a limb does not fold onto itself
                continue
            x = ex + lengths[1] * dx
            y = ey + lengths[1] * dy
            z = ez + lengths[1] * dz
            s2 = tube_score(sdf, origin, voxel, ex, ey, ez, x, y, z, tube_radii[1], tube_radii[2], 6, clip, 0.0)
            if s2 > 3.2:
                continue
            s2 += explained_weight * explained_fraction(explained, origin, stride * voxel, ex, ey, ez, x, y, z, 0.0)
            # the hand or heel goes on a little beyond the end
            tip = depth_at(
                sdf, origin, voxel, x + 0.5 * tip_length * dx, y + 0.5 * tip_length * dy, z + 0.5 * tip_length * dz
            )
            s2 += 0.3 * min(max(tip / clip, 0.0), 1.0)
            out[total, 0] = ex
            out[total, 1] = ey
            out[total, 2] = ez
            out[total, 3] = x
            out[total, 4] = y
            out[total, 5] = z
            out[total, 6] = s1 + s2
            total += 1
    out = out[:total]
    order = np.argsort(out[:, 6])
    kept = np.empty((keep, 7))
    count = 0
    apart2 = (0.14 * lengths[0]) ** 2
    for n in order:
        ok = True
        for m in range(count):
            d1 = 0.0
            d2 = 0.0
            for i in range(3):
                d1 += (out[n, i] - kept[m, i]) ** 2
                d2 += (out[n, 3 + i] - kept[m, 3 + i]) ** 2
            if d1 < apart2 and d2 < apart2:
                ok = False
                break
        if ok:
            kept[count] = out[n]
            count += 1
            if count == keep:
                break
    return kept[:count]


@njit(cache=True)  # type: ignore[misc, unused-ignore]
def covered_by_limb(limb: Any, base: Any, tube_radii: Any, tip_length: float, samples: Any, reach: float) -> Any:
    """Which samples [Q, 3] lie within `reach` of a limb (base, middle, end and its tip); uint64 bits [Q / 64]."""
    bits = np.zeros((len(samples) + 63) // 64, np.uint64)
    dx = limb[3] - limb[0]
    dy = limb[4] - limb[1]
    dz = limb[5] - limb[2]
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    chain = np.empty((4, 3))
    for i in range(3):
        chain[0, i] = base[i]
        chain[1, i] = limb[i]
        chain[2, i] = limb[3 + i]
    chain[3, 0] = limb[3] + tip_length * dx / length
    chain[3, 1] = limb[4] + tip_length * dy / length
    chain[3, 2] = limb[5] + tip_length * dz / length
    r = np.array([tube_radii[0], tube_radii[1], tube_radii[2], tube_radii[2]])
    for q in range(len(samples)):
        for s in range(3):
            ux = chain[s + 1, 0] - chain[s, 0]
            uy = chain[s + 1, 1] - chain[s, 1]
            uz = chain[s + 1, 2] - chain[s, 2]
            px = samples[q, 0] - chain[s, 0]
            py = samples[q, 1] - chain[s, 1]
            pz = samples[q, 2] - chain[s, 2]
            t = (px * ux + py * uy + pz * uz) / (ux * ux + uy * uy + uz * uz)
            t = min(max(t, 0.0), 1.0)
            x = px - t * ux
            y = py - t * uy
            z = pz - t * uz
            limit = r[s] + t * (r[s + 1] - r[s]) + reach
            if x * x + y * y + z * z < limit * limit:
                bits[q // 64] |= np.uint64(1) << np.uint64(q % 64)
                break
    return bits


@njit(cache=True, inline="always")  # type: ignore[misc, unused-ignore]
def popcount(v: Any) -> Any:
    v = v - ((v >> np.uint64(1)) & np.uint64(0x5555555555555555))
    v = (v & np.uint64(0x3333333333333333)) + ((v >> np.uint64(2)) & np.uint64(0x3333333333333333))
    v = (v + (v >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return (v * np.uint64(0x0101010101010101)) >> np.uint64(56)


@njit(cache=True)  # type: ignore[misc, unused-ignore]
def best_pairs(
    left: Any, right: Any, left_bits: Any, right_bits: Any, taken: Any, samples: int, trade: float, apart: float, keep: int
) -> Any:
    """Pairs of limbs by coverage: samples that neither explains cost, so do the limbs' own misses times `trade`.

    Pairs whose ends or middles coincide (nearer than `apart`) explain one limb twice and pay for it.
    Returns float64 [M, 3]: index left, index right, cost; the best first.
    """
    out = np.empty((len(left) * len(right), 3))
    n = 0
    for a in range(len(left)):
        for b in range(len(right)):
            covered = 0
            for k in range(len(taken)):
                covered += int(popcount(left_bits[a, k] | right_bits[b, k] | taken[k]))
            cost = (samples - covered) / samples + trade * (left[a, 6] + right[b, 6])
            for first in (0, 3):
                d = 0.0
                for i in range(3):
                    d += (left[a, first + i] - right[b, first + i]) ** 2
                if d < apart * apart:
                    cost += 0.05 * (1.0 - math.sqrt(d) / apart)
            out[n, 0] = a
            out[n, 1] = b
            out[n, 2] = cost
            n += 1
    order = np.argsort(out[:, 2])[:keep]
    return out[order]
