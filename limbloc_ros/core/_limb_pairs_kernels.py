# SPDX-License-Identifier: Apache-2.0
"""Numba kernels of `limb_pairs`: place limbs of the figure on candidates, what each explains, the best pairs."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from limbloc_ros.core._energy_kernels import blended_sphere, sample_sdf
from limbloc_ros.core._figure_kernels import log_so3
from limbloc_ros.core._part_kernels import SLACK, distance_to_part, lay_out
from limbloc_ros.core._surface_fit_kernels import across, gated_distance, offset_from, robust_weight

#: A candidate pays at most so much (m^2) for violated joint limits.
MOST_FOR_LIMITS = 5e-5


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def limb_turns(upper: Any, lower: Any, parent: Any, rest: Any, sign: float, first: Any, second: Any) -> float:
    """World rotations of a limb's two bones that lie along `upper` and `lower` (unit); returns the flexion, rad.

    The hinge is the bones' y axis: elbows flex about -y (sign -1), knees about +y. A nearly straight limb leaves the
    hinge open and gets that of its rest rotation `rest` (in the `parent`, whose world rotation is given).
    """
    cosine = upper[0] * lower[0] + upper[1] * lower[1] + upper[2] * lower[2]
    flexion = math.acos(min(1.0, max(-1.0, cosine)))
    blend = max(0.0, 0.35 - math.sin(flexion)) if flexion < 1.5 else 0.0
    y = np.empty(3)
    for i in range(3):
        a = (i + 1) % 3
        b = (i + 2) % 3
        y[i] = sign * (upper[a] * lower[b] - upper[b] * lower[a])
        for j in range(3):
            y[i] += blend * parent[i, j] * rest[j, 1]
    along = -(y[0] * upper[0] + y[1] * upper[1] + y[2] * upper[2])
    for i in range(3):
        y[i] += along * upper[i]
    norm = math.sqrt(y[0] * y[0] + y[1] * y[1] + y[2] * y[2])
    if norm < 1e-6:  # the rest hinge lies along the limb: any other will do
        for i in range(3):
            a = (i + 1) % 3
            b = (i + 2) % 3
            y[i] = -upper[a] * parent[b, 0] + upper[b] * parent[a, 0]
        norm = math.sqrt(y[0] * y[0] + y[1] * y[1] + y[2] * y[2])
    for i in range(3):
        first[i, 1] = y[i] / norm
        first[i, 2] = -upper[i]
    for i in range(3):
        a = (i + 1) % 3
        b = (i + 2) % 3
        first[i, 0] = first[a, 1] * first[b, 2] - first[b, 1] * first[a, 2]
    c = math.cos(flexion)
    s = sign * math.sin(flexion)
    for i in range(3):
        second[i, 0] = c * first[i, 0] - s * first[i, 2]
        second[i, 1] = first[i, 1]
        second[i, 2] = s * first[i, 0] + c * first[i, 2]
    return flexion


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def scene_of(query: Any, normals: Any, rays: Any) -> Any:
    """[9, Q] points, rays and what of the normals lies across these, each coordinate in a row."""
    scene = np.empty((9, len(query)))
    for q in range(len(query)):
        for i in range(3):
            scene[i, q] = query[q, i]
            scene[3 + i, q] = rays[q, i]
        scene[6, q], scene[7, q], scene[8, q] = across(normals[q], rays[q])
    return scene


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def explain(
    scene: Any, query: Any, rays: Any, parts: Any, spheres: Any, radii: Any, surface: Any, within: Any,
    least_of: Any, gaps: Any, costs: Any,
) -> None:  # fmt: skip
    """How well parts explain points: gated distance and cost, to gaps and costs [Q]; inf and 0 if not `within` [Q].

    The part is that of `explaining_parts`. How near each part can be at least is worked out for all points at once, in
    vector code, to `least_of` [2 + P, Q]: most points are far from all parts of a limb, or near to one only.
    """
    rows, bounds = lay_out(parts, spheres, radii)
    count = len(query)
    w = np.empty(3)
    away = np.empty(3)
    for q in range(count):
        least_of[0, q] = math.inf  # the least, and the part that it is of
        least_of[1, q] = 0.0
    for p in range(len(parts)):
        bx, by, bz, size = bounds[0, p], bounds[1, p], bounds[2, p], bounds[3, p] + SLACK
        for q in range(count):
            x, y, z = bx - scene[0, q], by - scene[1, q], bz - scene[2, q]
            along = x * scene[3, q] + y * scene[4, q] + z * scene[5, q]
            least = math.sqrt(max(x * x + y * y + z * z - along * along, 0.0)) - size
            least_of[2 + p, q] = least
            least_of[1, q] = p if least < least_of[0, q] else least_of[1, q]
            least_of[0, q] = min(least, least_of[0, q])
    for q in range(count):
        best = within[q]
        found = -1
        if least_of[0, q] <= best:
            x, y, z = scene[0, q], scene[1, q], scene[2, q]
            ray = (scene[3, q], scene[4, q], scene[5, q])
            likely = int(least_of[1, q])
            for n in range(-1, len(parts)):
                p = likely if n < 0 else n
                if n == likely or least_of[2 + p, q] > best:
                    continue
                _, d, wb, wc = gated_distance(
                    rows[p], x, y, z, ray, scene[6, q], scene[7, q], scene[8, q], surface[1]
                )  # fmt: skip
                if d < best or (d == best and p < found):
                    best = d
                    found = p
                    w[0] = 1.0 - wb - wc
                    w[1] = wb
                    w[2] = wc
        if found < 0:
            gaps[q] = math.inf
            costs[q] = 0.0
            continue
        d = offset_from(query[q], rays[q], parts[found], w, spheres, radii, away)
        c, _ = robust_weight(d, surface[0])
        gaps[q] = best
        costs[q] = c * (surface[2] if d < 0.0 else 1.0)


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def limb_fits(
    found: Any,
    base: Any,
    parent: Any,
    rest: Any,
    sign: float,
    joints: Any,
    limb_spheres: Any,
    limb_bones: Any,
    offsets: Any,
    spheres: Any,
    radii: Any,
    all_parts: Any,
    limb_parts: Any,
    query: Any,
    normals: Any,
    rays: Any,
    body_gap: Any,
    surface: Any,
    samples: Any,
    sample_parts: Any,
    sdf: Any,
    origin: Any,
    voxel: float,
    inclusion: Any,
    pairs: Any,
    penetration: Any,
    middle_of_range: Any,
    low: Any,
    high: Any,
    limit_weight: float,
    gaps: Any,
    costs: Any,
    own: Any,
    placed: Any,
) -> None:
    """Place the figure's own limb on every candidate and weigh it with the terms of the energy.

    Args:
        found: [M, 7] middle joint, end joint (m), score.
        base: [3] the limb's first joint.
        parent, rest, sign: see `limb_turns`.
        joints: [2, 3] second joint in the first bone, third joint in the second, m.
        limb_spheres, limb_bones, offsets: the limb's [S] spheres, the bone (0 to 2) that carries each, [S, 3] its
            place in that bone, m.
        spheres, radii: the whole figure; the limb's own places are overwritten.
        all_parts: [P, 3] spheres of every part.
        limb_parts: the same of the limb's parts only.
        query, normals, rays: the surface to explain, see `explaining_parts`.
        body_gap: [Q] how well the rest of the figure explains it (m, gated).
        surface: [3] width, gate and weight inside of the surface term.
        samples, sample_parts: the inclusion samples of the limb's parts.
        sdf, origin, voxel: the hull.
        inclusion: [3] slack, width and weight of the inclusion term.
        pairs: [N, 2] limb sphere, part: what must not go into each other.
        penetration: [3] fraction allowed, width and weight of that.
        middle_of_range: [3, 3] rotation of the first bone in its parent from which its angles are counted.
        low, high: [4] limits of the first bone's three angles and of the hinge's, rad.
        limit_weight: weight of their violation.
        gaps, costs: [M, Q] out: gated distance and cost of a point, inf where the body explains it better.
        own: [M] out: what the limb costs by itself.
        placed: [M, S, 3] out: where the limb's spheres are.
    """
    first = np.empty((3, 3))
    second = np.empty((3, 3))
    local = np.empty((3, 3))
    all_rows, all_bounds = lay_out(all_parts, spheres, radii)  # what the limb must not go into stays where it is
    no_ray = np.zeros(3)
    middle = np.empty(3)
    end = np.empty(3)
    upper = np.empty(3)
    lower = np.empty(3)
    away = np.empty(3)
    scene = scene_of(query, normals, rays)
    least_of = np.empty((2 + len(limb_parts), len(query)))
    for m in range(len(found)):
        n1 = 0.0
        n2 = 0.0
        for i in range(3):
            upper[i] = found[m, i] - base[i]
            lower[i] = found[m, 3 + i] - found[m, i]
            n1 += upper[i] * upper[i]
            n2 += lower[i] * lower[i]
        for i in range(3):
            upper[i] /= math.sqrt(n1)
            lower[i] /= math.sqrt(n2)
        flexion = limb_turns(upper, lower, parent, rest, sign, first, second)
        for i in range(3):
            middle[i] = base[i] + first[i, 0] * joints[0, 0] + first[i, 1] * joints[0, 1] + first[i, 2] * joints[0, 2]
        for i in range(3):
            end[i] = middle[i]
            for j in range(3):
                end[i] += second[i, j] * joints[1, j]
        for n in range(len(limb_spheres)):
            s = limb_spheres[n]
            start = base if limb_bones[n] == 0 else (middle if limb_bones[n] == 1 else end)
            R = first if limb_bones[n] == 0 else second
            for i in range(3):
                spheres[s, i] = start[i] + R[i, 0] * offsets[n, 0] + R[i, 1] * offsets[n, 1] + R[i, 2] * offsets[n, 2]
                placed[m, n, i] = spheres[s, i]
        explain(scene, query, rays, limb_parts, spheres, radii, surface, body_gap, least_of, gaps[m], costs[m])
        cost = 0.0
        for n in range(len(samples)):
            x, y, z, r = blended_sphere(samples[n], all_parts[sample_parts[n]], spheres, radii)
            e = sample_sdf(sdf, origin, voxel, x, y, z, away) + r - inclusion[0]
            if e > 0.0:
                c, _ = robust_weight(e, inclusion[1])
                cost += inclusion[2] * c
        for n in range(len(pairs)):
            s = pairs[n, 0]
            a = pairs[n, 1]
            x = all_bounds[0, a] - spheres[s, 0]
            y = all_bounds[1, a] - spheres[s, 1]
            z = all_bounds[2, a] - spheres[s, 2]
            reach = all_bounds[3, a] + radii[s]
            if x * x + y * y + z * z > reach * reach:
                continue
            d, _, _ = distance_to_part(all_rows[a], spheres[s, 0], spheres[s, 1], spheres[s, 2], no_ray)
            e = (1.0 - penetration[0]) * radii[s] - d
            if e > 0.0:
                c, _ = robust_weight(e, penetration[1])
                cost += penetration[2] * c
        for i in range(3):
            for j in range(3):
                local[i, j] = 0.0
                for k in range(3):
                    for n in range(3):
                        local[i, j] += middle_of_range[k, i] * parent[n, k] * first[n, j]
        angles = log_so3(local)
        limits = 0.0
        for i in range(4):
            angle = angles[i] if i < 3 else sign * flexion
            over = max(angle - high[i], low[i] - angle, 0.0)
            limits += limit_weight * over * over
        # The turn about a nearly straight limb is a guess, and most violations are cheaply mended.
        own[m] = cost + min(limits, MOST_FOR_LIMITS)


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def body_fit(query: Any, normals: Any, rays: Any, parts: Any, spheres: Any, radii: Any, surface: Any) -> Any:
    """How well the given parts explain each point: gated distance [Q], m, and cost [Q], m^2; see `limb_fits`."""
    gaps = np.empty(len(query))
    costs = np.empty(len(query))
    least_of = np.empty((2 + len(parts), len(query)))
    within = np.full(len(query), 1e9)
    scene = scene_of(query, normals, rays)
    explain(scene, query, rays, parts, spheres, radii, surface, within, least_of, gaps, costs)
    return gaps, costs


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def best_alone(gaps: Any, costs: Any, own: Any, body_costs: Any, point_weight: float, keep: int) -> Any:
    """Rows of the candidates that lower the energy most when the other limb is missing, the best first."""
    total = np.empty(len(own))
    for m in range(len(own)):
        cost = 0.0
        for q in range(len(body_costs)):
            cost += costs[m, q] if gaps[m, q] < math.inf else body_costs[q]
        total[m] = own[m] + point_weight * cost
    return np.argsort(total)[:keep]


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def best_pairs(
    left: Any,
    right: Any,
    left_gaps: Any,
    left_costs: Any,
    left_own: Any,
    right_gaps: Any,
    right_costs: Any,
    right_own: Any,
    body_costs: Any,
    point_weight: float,
    left_rows: Any,
    right_rows: Any,
    overlap: float,
    overlap_weight: float,
    apart: float,
    keep: int,
) -> Any:
    """Pairs of candidates (of the given rows) by the energy of both together.

    Each point is explained by whatever is nearest. Limbs whose middles or ends lie nearer than `overlap` (m) pay for
    it. Of the pairs in order of their cost, those are returned of which no earlier one has both ends within `apart`.

    Returns float64 [M, 3]: index left, index right, cost; the best first.
    """
    out = np.empty((len(left_rows) * len(right_rows), 3))
    nq = len(body_costs)
    # Point by point for all limbs of the other side at once: each sum in its order, and vector code all the same.
    count = len(right_rows)
    near = np.empty((nq, count))
    price = np.empty((nq, count))
    totals = np.empty(count)
    for m in range(count):
        for q in range(nq):
            near[q, m] = right_gaps[right_rows[m], q]
            price[q, m] = right_costs[right_rows[m], q]
    n = 0
    for a in left_rows:
        totals[:] = 0.0
        for q in range(nq):
            ga = left_gaps[a, q]
            other = left_costs[a, q] if ga < math.inf else body_costs[q]
            for m in range(count):
                totals[m] += price[q, m] if near[q, m] < ga else other
        for m in range(count):
            b = right_rows[m]
            cost = left_own[a] + right_own[b]
            cost += point_weight * totals[m]
            for first in (0, 3):
                d = 0.0
                for i in range(3):
                    d += (left[a, first + i] - right[b, first + i]) ** 2
                if d < overlap * overlap:
                    e = overlap - math.sqrt(d)
                    cost += overlap_weight * e * e
            out[n, 0] = a
            out[n, 1] = b
            out[n, 2] = cost
            n += 1
    kept = np.empty((keep, 3))
    count = 0
    for n in np.argsort(out[:, 2]):
        a = int(out[n, 0])
        b = int(out[n, 1])
        new = True
        for m in range(count):
            x = 0.0
            y = 0.0
            for i in range(3, 6):
                x += (left[a, i] - left[int(kept[m, 0]), i]) ** 2
                y += (right[b, i] - right[int(kept[m, 1]), i]) ** 2
            if x < apart * apart and y < apart * apart:
                new = False
                break
        if new:
            kept[count] = out[n]
            count += 1
            if count == keep:
                break
    return kept[:count]
