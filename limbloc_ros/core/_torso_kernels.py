# SPDX-License-Identifier: Apache-2.0
"""Numba kernels of the torso search: place a torso, score it, join pelvis and skull, climb."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from limbloc_ros.core._figure_kernels import exp_so3, log_so3
from limbloc_ros.core._search_kernels import CHUNK, chunk_scratch, depth_at, depths_at, pop, push

#: A sphere's miss counts up to this fraction of the stature.
CLIP = 0.04
#: Torsos are asked for so many spheres before those that are out already are sorted out.
STAGES = (0, 8, 12)
#: Torsos that wait are columns of a queue; where its rows begin: root, rotation, stature, and what was missed so far.
WIDE = 2 * CHUNK
ROOT, TURN, STATURE, TOTAL = 0, 3 * WIDE, 12 * WIDE, 13 * WIDE
_ONE, _TWO = np.uint32(1), np.uint32(2)


@njit(cache=True, inline="always", error_model="numpy")  # type: ignore[misc, unused-ignore]
def misfit(phi: float, radius: float, solid: bool, clip: float) -> float:
    """Clipped square of how badly a sphere of a torso matches the hull at whose centre the signed distance is phi.

    A solid sphere, which should just fit, misses by phi + radius (half as much again when it sticks out), an empty one
    by radius - phi while that is positive. A torso's score is the weighted mean over clip^2, so 0 is perfect and
    1 a complete miss.
    """
    if solid:
        e = phi + radius
        if e > 0.0:
            e *= 1.5
    else:
        e = max(0.0, radius - phi)
    e = min(max(e, -clip), clip)
    return e * e


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def put_torso(
    pose: Any, parents: Any, bone_offsets: Any, point_bones: Any, point_offsets: Any, point_radii: Any,
    world: Any, origins: Any, points: Any, radii: Any,
) -> None:  # fmt: skip
    """`place_torso`, into arrays that are there: what `forward` does, but that only five bones are turned."""
    scale = math.exp(pose[12])
    third = exp_so3(pose[6:9] / 3.0)
    head = exp_so3(pose[9:12])
    world[0] = exp_so3(pose[3:6])
    for i in range(3):
        origins[0, i] = pose[i]
    for b in range(1, len(parents)):
        p = parents[b]
        turn = head if b == 4 else third
        for i in range(3):
            at = origins[p, i]
            for j in range(3):
                at += world[p, i, j] * (bone_offsets[b, j, 0] * scale)
            origins[b, i] = at
            for j in range(3):
                world[b, i, j] = world[p, i, j]
                if b <= 4:
                    world[b, i, j] = (
                        world[p, i, 0] * turn[0, j] + world[p, i, 1] * turn[1, j] + world[p, i, 2] * turn[2, j]
                    )
    for n in range(len(point_bones)):
        b = point_bones[n]
        for i in range(3):
            at = origins[b, i]
            for j in range(3):
                at += world[b, i, j] * (point_offsets[n, j, 0] * scale)
            points[n, i] = at
        radii[n] = point_radii[n, 0] * scale


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def place_torso(
    pose: Any, parents: Any, bone_offsets: Any, point_bones: Any, point_offsets: Any, point_radii: Any
) -> Any:
    """Torso of a search pose [3 root + 3 rotation vector + 3 spine bend + 3 head turn + log stature]: points, radii.

    The bend is the whole turn from pelvis to chest, spread over the three spine joints.
    """
    points, radii = np.empty((len(point_bones), 3)), np.empty(len(point_bones))
    world, origins = np.empty((len(parents), 3, 3)), np.empty((len(parents), 3))
    put_torso(pose, parents, bone_offsets, point_bones, point_offsets, point_radii, world, origins, points, radii)
    return points, radii


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def ask_spheres(
    queue: Any, bends: Any, units: Any, unit_radii: Any, weights: Any, n_solid: int, first: int, last: int,
    sdf: Any, origin: Any, voxel: float, scratch: tuple[Any, Any, Any],
) -> None:  # fmt: skip
    """Add what the spheres from `first` to `last` miss (`misfit`) to the totals of the first CHUNK torsos of a queue.

    `bends` [WIDE]: where in `units` a torso's unit figure begins, whose spheres lie there one after the other.
    """
    work, cells, corners = scratch
    for s in range(first, last):
        here = np.uint32(3 * s)
        for n in range(CHUNK):
            at = bends[n] + here
            work[4 * CHUNK + n] = units[at]
            work[5 * CHUNK + n] = units[at + _ONE]
            work[6 * CHUNK + n] = units[at + _TWO]
        for n in range(CHUNK):
            px, py, pz = work[4 * CHUNK + n], work[5 * CHUNK + n], work[6 * CHUNK + n]
            stature = queue[STATURE + n]
            for i in range(3):
                k = TURN + 3 * i * WIDE + n
                work[i * CHUNK + n] = queue[ROOT + i * WIDE + n] + stature * (
                    queue[k] * px + queue[k + WIDE] * py + queue[k + 2 * WIDE] * pz
                )
        depths_at(sdf, origin, voxel, work, cells, corners)
        radius, weight = unit_radii[s], weights[s]
        if s < n_solid:
            for n in range(CHUNK):
                stature = queue[STATURE + n]
                miss = misfit(work[3 * CHUNK + n], stature * radius, True, CLIP * stature)
                queue[TOTAL + n] += weight * miss
        else:
            for n in range(CHUNK):
                stature = queue[STATURE + n]
                miss = misfit(work[3 * CHUNK + n], stature * radius, False, CLIP * stature)
                queue[TOTAL + n] += weight * miss


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def work_off(
    queues: Any, bent: Any, waiting: Any, least: int, units: Any, unit_radii: Any, bends: Any, weights: Any,
    n_solid: int, norm: float, sdf: Any, origin: Any, voxel: float, scratch: tuple[Any, Any, Any],
    out: Any, goodness: Any, heap: Any, count: int,
) -> int:  # fmt: skip
    """Ask the first CHUNK torsos of each queue with at least `least`: those that may do go on, in the end to a heap.

    No torso overtakes another, so that a heap meets them in the order they came in. On the way they are compared with
    the worst of a heap that lacks those before them, which leaves out none that belongs there. Returns how many the
    heap has now. A queue keeps less than CHUNK, and gets no more than these from the one before: WIDE hold both.
    """
    most = len(out)
    R = np.empty((3, 3))
    for stage in range(len(STAGES)):
        ends = stage + 1 == len(STAGES)
        last = len(weights) if ends else STAGES[stage + 1]
        queue, bend = queues[stage], bent[stage]
        if waiting[stage] < least:
            continue
        size = min(waiting[stage], CHUNK)
        ask_spheres(queue, bend, units, unit_radii, weights, n_solid, STAGES[stage], last, sdf, origin, voxel, scratch)
        for n in range(size):
            stature, total = queue[STATURE + n], queue[TOTAL + n]
            clip = CLIP * stature
            full = count == most
            enough = -goodness[heap[0]] * norm * clip * clip if full else math.inf
            if total >= enough:
                continue
            if not ends:
                at = waiting[stage + 1]
                for i in range(14):
                    queues[stage + 1, i * WIDE + at] = queue[i * WIDE + n]
                bent[stage + 1, at] = bend[n]
                waiting[stage + 1] += 1
                continue
            for i in range(3):
                for j in range(3):
                    R[i, j] = queue[TURN + (3 * i + j) * WIDE + n]
            row = pop(heap, most, goodness) if full else count
            turn = log_so3(R)
            bending = bend[n] // (3 * len(weights))
            for i in range(3):
                out[row, i] = queue[ROOT + i * WIDE + n]
                out[row, 3 + i] = turn[i]
                out[row, 6 + i] = bends[bending, i]
                out[row, 9 + i] = 0.0
            out[row, 12] = math.log(stature)
            out[row, 13] = total / (norm * clip * clip)
            goodness[row] = -out[row, 13]
            push(heap, most - 1 if full else count, goodness, row)
            count += not full
        rest = waiting[stage] - size
        for n in range(rest):
            for i in range(14):
                queue[i * WIDE + n] = queue[i * WIDE + size + n]
            bend[n] = bend[size + n]
        waiting[stage] = rest
    return count


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
    n_spheres = len(weights)
    units = unit_points.reshape(-1)
    queues = np.zeros((len(STAGES), 14 * WIDE))
    bent = np.zeros((len(STAGES), WIDE), np.uint32)
    waiting = np.zeros(len(STAGES), np.int64)
    R = np.empty((3, 3))
    scratch = chunk_scratch()
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
                    n = waiting[0]
                    queues[0, STATURE + n] = stature
                    queues[0, TOTAL + n] = 0.0
                    bent[0, n] = 3 * c * n_spheres
                    for i in range(3):
                        for j in range(3):
                            R[i, j] = (
                                about[y, i, 0] * align[0, j]
                                + about[y, i, 1] * align[1, j]
                                + about[y, i, 2] * align[2, j]
                            )
                            queues[0, TURN + (3 * i + j) * WIDE + n] = R[i, j]
                    for i in range(3):
                        queues[0, ROOT + i * WIDE + n] = pelvis_seeds[a, i] - stature * (
                            R[i, 0] * axis_base[c, 0] + R[i, 1] * axis_base[c, 1] + R[i, 2] * axis_base[c, 2]
                        )
                    waiting[0] += 1
                    if waiting[0] == CHUNK:
                        count = work_off(
                            queues, bent, waiting, CHUNK, units, unit_radii, bends, weights, n_solid, norm,
                            sdf, origin, voxel, scratch, out, goodness, heap, count,
                        )  # fmt: skip
    while waiting.max() > 0:
        count = work_off(
            queues, bent, waiting, 1, units, unit_radii, bends, weights, n_solid, norm,
            sdf, origin, voxel, scratch, out, goodness, heap, count,
        )  # fmt: skip
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
    points, radii = np.empty((len(point_bones), 3)), np.empty(len(point_bones))
    world, origins = np.empty((len(parents), 3, 3)), np.empty((len(parents), 3))
    whole = weights.sum()
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
        bend = trial[6] * trial[6] + trial[7] * trial[7] + trial[8] * trial[8]
        turn = trial[9] * trial[9] + trial[10] * trial[10] + trial[11] * trial[11]
        unusual = 0.01 * bend + 0.01 * turn + 0.3 * max(0.0, bend - 1.2) + 0.3 * max(0.0, turn - 0.8)
        clip = CLIP * math.exp(trial[12])
        norm = whole * clip * clip
        enough = (best[13] - unusual + 1e-9) * norm  # with more missed it is no better, whatever the roundings
        total = 0.0
        if total < enough:
            put_torso(
                trial, parents, bone_offsets, point_bones, point_offsets, point_radii, world, origins, points, radii
            )
            for m in range(len(points)):
                phi = depth_at(sdf, origin, voxel, points[m, 0], points[m, 1], points[m, 2])
                total += weights[m] * misfit(phi, radii[m], m < n_solid, clip)
                if total >= enough:
                    break
        if total >= enough:
            continue
        score = total / norm + unusual
        if score < best[13]:
            best[:13] = trial[:13]
            best[13] = score
    return best
