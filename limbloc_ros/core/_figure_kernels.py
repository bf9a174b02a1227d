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
