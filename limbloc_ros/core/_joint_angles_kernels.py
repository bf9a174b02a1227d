# SPDX-License-Identifier: Apache-2.0
"""Numba kernel of the joint angles: a rotation as three turns in a row. Documented in `joint_angles.py`."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from limbloc_ros.core._figure_kernels import exp_so3

TURN = 2.0 * math.pi


@njit(cache=True, nogil=True)  # type: ignore[misc, unused-ignore]
def cross(a: Any, b: Any) -> Any:
    """a x b."""
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


@njit(cache=True, nogil=True)  # type: ignore[misc, unused-ignore]
def dot(a: Any, b: Any) -> Any:
    """a . b, summed in a fixed order."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True, nogil=True)  # type: ignore[misc, unused-ignore]
def apply(R: Any, v: Any) -> Any:
    """R v."""
    return np.array([dot(R[0], v), dot(R[1], v), dot(R[2], v)])


@njit(cache=True, nogil=True)  # type: ignore[misc, unused-ignore]
def other_two(R: Any, axes: Any, q1: float) -> Any:
    """The second and third angle that come nearest to R once the first is chosen."""
    first, second, third = axes[0], axes[1], axes[2]
    undo_1 = exp_so3(-first * q1)
    v = apply(undo_1, apply(R, third))
    q2 = math.atan2(dot(second, cross(third, v)), dot(third, v))
    undo_2 = exp_so3(-second * q2)
    u = apply(undo_2, apply(undo_1, apply(R, second)))
    return q2, math.atan2(dot(third, cross(second, u)), dot(second, u))


@njit(cache=True, nogil=True)  # type: ignore[misc, unused-ignore]
def wound(angle: float, start: float, low: float, high: float) -> float:
    """`angle` plus whole turns, nearest to `start`; but near its range, so that turns do not add up over time."""
    near = angle + TURN * round((start - angle) / TURN)
    middle = 0.5 * (low + high)
    if math.isinf(high) or abs(near - middle) <= 1.5 * math.pi:
        return near
    return angle + TURN * round((middle - angle) / TURN)


@njit(cache=True, nogil=True)  # type: ignore[misc, unused-ignore]
def triple(R: Any, axes: Any, low: Any, high: Any, previous: Any, follow: bool, slack: float, stray: float) -> Any:
    """The angles [3] of a rotation; `previous` counts only if `follow`. Infinite limits: round and round."""
    first, second, third = axes[0], axes[1], axes[2]
    last = apply(R, third)
    along, across = dot(cross(first, second), last), dot(second, last)
    square = along * along + across * across
    rest = np.zeros(3)
    middle = np.zeros(3)
    for i in range(3):
        rest[i] = min(max(0.0, low[i]), high[i])
        if not math.isinf(high[i]):
            middle[i] = 0.5 * (low[i] + high[i])
    start = previous if follow else rest
    near = previous if follow else middle
    # At the pole itself rounding must not choose the first angle, with or without a previous frame.
    damping = max(slack if follow else 0.0, 1e-7)
    trust = square / (square + damping * damping)
    best, best_cost = np.zeros(3), np.inf
    for flip in (0.0, math.pi):
        step = (math.atan2(-across, along) + flip - start[0] + math.pi) % TURN - math.pi
        q = np.zeros(3)
        q[0] = start[0] + trust * step
        q[1], q[2] = other_two(R, axes, q[0])
        margin = stray if follow else 0.0
        beyond, way = 0.0, 0.0
        for i in range(3):
            q[i] = wound(q[i], near[i], low[i], high[i])
            beyond += max(0.0, low[i] - margin - q[i], q[i] - high[i] - margin) ** 2
            way += (q[i] - start[i]) ** 2
        # An arm that hangs, told as three half turns, is worth a jump back.
        cost = 150.0 * beyond + way if follow else beyond + 0.01 * way
        if cost < best_cost:
            best, best_cost = q, cost
    return best
