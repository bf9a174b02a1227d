# SPDX-License-Identifier: Apache-2.0
"""Numba kernels of the torso search: place a torso, score it, join pelvis and skull, climb."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from limbloc_ros.core._figure_kernels import exp_so3, forward, log_so3
from limbloc_ros.core._search_kernels import depth_at, pop, push


@njit(cache=True, inline="always", error_model="numpy")  # type: ignore[misc, unused-ignore]
def misfit(phi: float, radius: float, solid: bool, clip: float) -> float:
    """Clipped square of how badly a sphere matches at whose centre the signed distance is phi; see `torso_score`."""
    if solid:
        e = phi + radius
        if e > 0.0:
            e *= 1.5
    else:
        e = max(0.0, radius - phi)
    e = min(max(e, -clip), clip)
    return e * e


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def torso_score(
    sdf: Any, origin: Any, voxel: float, points: Any, radii: Any, weights: Any, n_solid: int, clip: float
) -> float:
    """How badly torso spheres match the hull: the first n_solid should just fit, the others must be empty.

    A solid sphere misses by phi + radius (sticking out counts double), an empty one by how deep its centre lies
    below its radius outside. Mean of clipped squares over clip^2, so 0 is perfect and 1 a complete miss.
    """
    total = 0.0
    for n in range(len(points)):
        phi = depth_at(sdf, origin, voxel, points[n, 0], points[n, 1], points[n, 2])
        total += weights[n] * misfit(phi, radii[n], n < n_solid, clip)
    return total / (weights.sum() * clip * clip)  # type: ignore[no-any-return]


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
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


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
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
    goodness = np.empty(most)  # less score; of the rows in a heap, the worst first
    heap = np.empty(most, np.int64)
    count = 0
    pose = np.zeros(13)
    R = np.empty((3, 3))
    turn = np.empty(3)
    about = np.empty((yaws, 3, 3))
    # the unit figure of each bend; every torso is one of these, turned and scaled
    unit_points = np.empty((len(bends), len(point_bones), 3))
    unit_radii = np.empty(len(point_bones))
    for c in range(len(bends)):
        pose[6:9] = bends[c]
        unit_points[c], unit_radii[:] = place_torso(
            pose, parents, bone_offsets, point_bones, point_offsets, point_radii
        )
    norm = weights.sum()
    for a in range(len(pelvis_seeds)):
        for b in range(len(head_seeds)):
            dx = head_seeds[b, 0] - pelvis_seeds[a, 0]
            dy = head_seeds[b, 1] - pelvis_seeds[a, 1]
            dz = head_seeds[b, 2] - pelvis_seeds[a, 2]
            length = math.sqrt(dx * dx + dy * dy + dz * dz)
            if length < shortest or length > longest:
                continue
            outside = False
            for t in (0.3, 0.5, 0.7):  # a bent trunk's chord may leave the hull a little
                x = pelvis_seeds[a, 0] + t * dx
                y = pelvis_seeds[a, 1] + t * dy
                z = pelvis_seeds[a, 2] + t * dz
                outside |= depth_at(sdf, origin, voxel, x, y, z) > 0.03
            if outside:
                continue
            vx, vy, vz = dx / length, dy / length, dz / length
            for y in range(yaws):
                phi = math.pi * y / yaws
                turn[0] = vx * phi
                turn[1] = vy * phi
                turn[2] = vz * phi
                about[y] = exp_so3(turn)
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
                kx, ky, kz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
                sine = math.sqrt(kx * kx + ky * ky + kz * kz)
                cosine = ux * vx + uy * vy + uz * vz
                turn[:] = 0.0
                angle = math.atan2(sine, cosine)
                if sine > 1e-6:
                    turn[0] = kx / sine * angle
                    turn[1] = ky / sine * angle
                    turn[2] = kz / sine * angle
                elif cosine < 0.0:
                    turn[0] = math.pi
                align = exp_so3(turn)
                for y in range(yaws):
                    for i in range(3):
                        for j in range(3):
                            R[i, j] = (
                                about[y, i, 0] * align[0, j]
                                + about[y, i, 1] * align[1, j]
                                + about[y, i, 2] * align[2, j]
                            )
                    for i in range(3):
                        pose[i] = pelvis_seeds[a, i] - stature * (
                            R[i, 0] * axis_base[c, 0] + R[i, 1] * axis_base[c, 1] + R[i, 2] * axis_base[c, 2]
                        )
                    clip = 0.04 * stature
                    full = count == most
                    enough = -goodness[heap[0]] * norm * clip * clip if full else math.inf
                    total = 0.0
                    for n in range(len(weights)):
                        px, py, pz = unit_points[c, n, 0], unit_points[c, n, 1], unit_points[c, n, 2]
                        e = depth_at(
                            sdf,
                            origin,
                            voxel,
                            pose[0] + stature * (R[0, 0] * px + R[0, 1] * py + R[0, 2] * pz),
                            pose[1] + stature * (R[1, 0] * px + R[1, 1] * py + R[1, 2] * pz),
                            pose[2] + stature * (R[2, 0] * px + R[2, 1] * py + R[2, 2] * pz),
                        )
                        total += weights[n] * misfit(e, stature * unit_radii[n], n < n_solid, clip)
                        if total >= enough:
                            break
                    if total >= enough:
                        continue
                    row = pop(heap, most, goodness) if full else count
                    out[row, :3] = pose[:3]
                    out[row, 3:6] = log_so3(R)
                    out[row, 6:9] = bends[c]
                    out[row, 9:12] = 0.0
                    out[row, 12] = math.log(stature)
                    out[row, 13] = total / (norm * clip * clip)
                    goodness[row] = -out[row, 13]
                    push(heap, most - 1 if full else count, goodness, row)
                    count += not full
    return out[:count]


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def distinct(poses: Any, most: int, apart_m: float, apart_rad: float) -> Any:
    """Rows of the first poses [N, 14] that differ from all before in place, or in axis or heading (modulo half a turn).

    Others are alike; `most` are taken.
    """
    kept = np.empty(most, np.int64)
    turns = np.empty((most, 3, 3))
    least = math.cos(apart_rad)
    count = 0
    for n in range(len(poses)):
        if count == most:
            break
        R = exp_so3(poses[n, 3:6])
        new = True
        for m in range(count):
            away, axis, side = 0.0, 0.0, 0.0
            for i in range(3):
                away += (poses[kept[m], i] - poses[n, i]) ** 2
                side += turns[m, i, 1] * R[i, 1]
                axis += turns[m, i, 2] * R[i, 2]
            if away < apart_m**2 and axis > least and abs(side) > least:
                new = False
                break
        if new:
            kept[count], turns[count] = n, R
            count += 1
    return kept[:count]


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
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
                or (group == 2 and ((i >= 6 and i < 9) or i == 12))
                or (group == 3 and ((i >= 3 and i < 6) or (i >= 9 and i < 12)))
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
