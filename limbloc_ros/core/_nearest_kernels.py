# SPDX-License-Identifier: Apache-2.0
"""The numba kernel that finds how far the nearest of some points are, for `parts`."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]


@njit(cache=True, nogil=True)
def nearest_distances(points: Array, query: Array) -> Array:
    """Distance [Q] of each of query [Q, 3] to the nearest of points [M, 3]; infinite without any."""
    out = np.empty(len(query))
    x, y, z = np.ascontiguousarray(points[:, 0]), np.ascontiguousarray(points[:, 1]), np.ascontiguousarray(points[:, 2])
    for q in range(len(query)):
        least = np.inf
        for m in range(len(points)):
            dx, dy, dz = x[m] - query[q, 0], y[m] - query[q, 1], z[m] - query[q, 2]
            least = min(least, dx * dx + dy * dy + dz * dz)
        out[q] = np.sqrt(least)
    return out
