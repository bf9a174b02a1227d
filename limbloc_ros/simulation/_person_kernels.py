# SPDX-License-Identifier: Apache-2.0
"""Kernels of `person` and `retarget`: linear blend skinning, and link rotations -> bone rotations.

`test/test_simulated_person.py` holds the plain numpy reference of the skinning.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Quaternion = tuple[float, float, float, float]

#: How a bone takes part in the rotation of its link.
SHARE, HALF_TWIST, SWING_SHARE = 0, 1, 2


@njit(cache=True)
def chain(heads: Array, parents: Ints, rotations: Array, root: Array, positions: Array) -> None:
    """Bone head positions [B, 3] in the world; `rotations` [B, 3, 3] are rest -> world."""
    positions[0] = root
    for b in range(1, len(parents)):
        p = parents[b]
        for i in range(3):
            s = positions[p, i]
            for j in range(3):
                s += rotations[p, i, j] * (heads[b, j] - heads[p, j])
            positions[b, i] = s


@njit(cache=True)
def skin(
    rest: Array, bones: Ints, weights: Array, heads: Array, rotations: Array, positions: Array, out: Array
) -> None:
    """Linear blend skinning: out [V, 3] = sum over four bones of w (position + R (rest - head))."""
    n = len(heads)
    shift = np.empty((n, 3))
    for b in range(n):
        for i in range(3):
            s = positions[b, i]
            for j in range(3):
                s -= rotations[b, i, j] * heads[b, j]
            shift[b, i] = s
    for v in range(len(rest)):
        x, y, z = 0.0, 0.0, 0.0
        for k in range(bones.shape[1]):
            w = weights[v, k]
            if w == 0.0:
                continue
            b = bones[v, k]
            R = rotations[b]
            x += w * (R[0, 0] * rest[v, 0] + R[0, 1] * rest[v, 1] + R[0, 2] * rest[v, 2] + shift[b, 0])
            y += w * (R[1, 0] * rest[v, 0] + R[1, 1] * rest[v, 1] + R[1, 2] * rest[v, 2] + shift[b, 1])
            z += w * (R[2, 0] * rest[v, 0] + R[2, 1] * rest[v, 1] + R[2, 2] * rest[v, 2] + shift[b, 2])
        out[v, 0], out[v, 1], out[v, 2] = x, y, z


@njit(cache=True)
def _multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    return (
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


@njit(cache=True)
def _power(q: Quaternion, f: float) -> Quaternion:
    """The fraction f of the rotation q, along the shorter arc."""
    w, x, y, z = q
    if w < 0.0:
        w, x, y, z = -w, -x, -y, -z
    n = math.sqrt(x * x + y * y + z * z)
    if n < 1e-9:
        return 1.0, 0.0, 0.0, 0.0
    half = math.atan2(n, w) * f
    s = math.sin(half) / n
    return math.cos(half), x * s, y * s, z * s


@njit(cache=True)
def _twist(q: Quaternion) -> Quaternion:
    """The part of q that turns about z (the axis of a hanging limb): q = swing * twist."""
    n = math.sqrt(q[0] * q[0] + q[3] * q[3])
    if n < 1e-6:
        return 1.0, 0.0, 0.0, 0.0
    return q[0] / n, 0.0, 0.0, q[3] / n


@njit(cache=True)
def bones_of_links(
    local: Array, link_parents: Ints, bone_links: Ints, bone_modes: Ints, bone_fractions: Array, to_neutral: Array,
    out: Array,
) -> None:  # fmt: skip
    """Bone rotations rest -> world [B, 3, 3] from the links' rotations relative to their parents [L, 4].

    A bone takes a part of its link's rotation (a spine bone a fraction, the upper half of a limb half of the twist, a
    clavicle some of the arm's swing), on top of the parent link, after `to_neutral` [B, 3, 3] has turned its rest pose
    into the stance of a straight body with hanging arms.
    """
    n_links = len(link_parents)
    world = np.empty((n_links, 4))
    for k in range(n_links):
        q = (local[k, 0], local[k, 1], local[k, 2], local[k, 3])
        p = link_parents[k]
        if p >= 0:
            q = _multiply((world[p, 0], world[p, 1], world[p, 2], world[p, 3]), q)
        world[k, 0], world[k, 1], world[k, 2], world[k, 3] = q
    for b in range(len(bone_links)):
        k = bone_links[b]
        q = (local[k, 0], local[k, 1], local[k, 2], local[k, 3])
        f = bone_fractions[b]
        if bone_modes[b] == 0:
            if f != 1.0:
                q = _power(q, f)
        else:
            twist = _twist(q)
            swing = _multiply(q, (twist[0], -twist[1], -twist[2], -twist[3]))
            q = _multiply(swing, _power(twist, f)) if bone_modes[b] == 1 else _power(swing, f)
        p = link_parents[k]
        if p >= 0:
            q = _multiply((world[p, 0], world[p, 1], world[p, 2], world[p, 3]), q)
        w, x, y, z = q
        R = (
            (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        )
        A = to_neutral[b]
        for j in range(3):
            out[b, 0, j] = R[0][0] * A[0, j] + R[0][1] * A[1, j] + R[0][2] * A[2, j]
            out[b, 1, j] = R[1][0] * A[0, j] + R[1][1] * A[1, j] + R[1][2] * A[2, j]
            out[b, 2, j] = R[2][0] * A[0, j] + R[2][1] * A[1, j] + R[2][2] * A[2, j]
