# SPDX-License-Identifier: Apache-2.0
"""Numba kernels of `geodesic.py`; they trust their caller."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
Ints = NDArray[np.int32]


@njit(cache=True)
def bucket_dijkstra(neighbours: Ints, weights: Array, seeds: NDArray[np.int64], offsets: Array) -> Array:
    """Shortest distance [N] from any seed (seed s starts at `offsets[s]`); inf where none can be reached.

    Exact: a bucket is as wide as the lightest edge (1, a face neighbour), so no vertex of a bucket can shorten the way
    to another one of it and their order does not matter. Edges are at most sqrt(3) long, so 3 buckets are ever in use
    beyond the seeds' own, and the ring below is as long as the seeds' offsets need.
    """
    count = neighbours.shape[0]
    distance = np.full(count, np.inf)
    spread = 0.0
    for s in range(seeds.shape[0]):
        spread = max(spread, offsets[s])
    ring = int(spread) + 4
    head = np.full(ring, -1, dtype=np.int64)
    after = np.full(count, -1, dtype=np.int64)  # each vertex waits in one bucket at most: doubly linked lists
    before = np.full(count, -1, dtype=np.int64)
    bucket = np.full(count, -1, dtype=np.int64)
    waiting = 0
    for s in range(seeds.shape[0]):
        v = seeds[s]
        if offsets[s] >= distance[v]:
            continue
        if bucket[v] >= 0:
            _unlink(v, head, after, before, bucket)
            waiting -= 1
        distance[v] = offsets[s]
        _link(v, int(offsets[s]) % ring, head, after, before, bucket)
        waiting += 1
    current = 0
    while waiting > 0:
        slot = current % ring
        while head[slot] >= 0:
            v = head[slot]
            _unlink(v, head, after, before, bucket)
            waiting -= 1
            for m in range(neighbours.shape[1]):
                q = neighbours[v, m]
                if q < 0:
                    continue
                d = distance[v] + weights[m]
                if d < distance[q]:
                    if bucket[q] >= 0:
                        _unlink(q, head, after, before, bucket)
                        waiting -= 1
                    distance[q] = d
                    _link(q, int(d) % ring, head, after, before, bucket)
                    waiting += 1
        current += 1
    return distance


@njit(cache=True)
def _link(
    v: int,
    slot: int,
    head: NDArray[np.int64],
    after: NDArray[np.int64],
    before: NDArray[np.int64],
    bucket: NDArray[np.int64],
) -> None:
    first = head[slot]
    after[v] = first
    before[v] = -1
    if first >= 0:
        before[first] = v
    head[slot] = v
    bucket[v] = slot


@njit(cache=True)
def _unlink(
    v: int, head: NDArray[np.int64], after: NDArray[np.int64], before: NDArray[np.int64], bucket: NDArray[np.int64]
) -> None:
    if before[v] >= 0:
        after[before[v]] = after[v]
    else:
        head[bucket[v]] = after[v]
    if after[v] >= 0:
        before[after[v]] = before[v]
    bucket[v] = -1


@njit(cache=True)
def maxima_in_ball(values: Array, points: Array, neighbours: Ints, radius: float) -> tuple[NDArray[np.bool_], Array]:
    """Whether each vertex is the greatest of the patch within `radius` of it, and how far the patch's mean lies below.

    Ties go to the lower row, so a plateau has one maximum.
    """
    count = values.shape[0]
    is_maximum = np.zeros(count, dtype=np.bool_)
    drop = np.zeros(count)
    seen = np.full(count, -1, dtype=np.int32)
    stack = np.empty(count, dtype=np.int32)
    limit = radius * radius
    for n in range(count):
        if not math.isfinite(values[n]):
            continue
        beaten = False
        for q in neighbours[n]:  # most vertices lose to a neighbour: no need to flood
            if q >= 0 and (values[q] > values[n] or (values[q] == values[n] and q < n)):
                beaten = True
                break
        if beaten:
            continue
        seen[n] = n
        stack[0] = n
        top = 1
        members = 0
        total = 0.0
        while top > 0 and not beaten:
            top -= 1
            v = stack[top]
            members += 1
            total += values[v]
            for q in neighbours[v]:
                if q < 0 or seen[q] == n:
                    continue
                seen[q] = n
                dx, dy, dz = points[q, 0] - points[n, 0], points[q, 1] - points[n, 1], points[q, 2] - points[n, 2]
                if dx * dx + dy * dy + dz * dz > limit:
                    continue
                if values[q] > values[n] or (values[q] == values[n] and q < n):
                    beaten = True
                    break
                stack[top] = q
                top += 1
        if not beaten:
            is_maximum[n] = True
            drop[n] = values[n] - total / members
    return is_maximum, drop
