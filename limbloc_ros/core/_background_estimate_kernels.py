# SPDX-License-Identifier: Apache-2.0
"""Compiled loops of `background_estimate`."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float32]


@njit(cache=True)
def densest_mean(samples: Bytes, gains: Floats, share: float) -> tuple[Floats, Floats]:
    """Mean and standard deviation of every pixel's most crowded brightness interval.

    Args:
        samples: [N, H, W, 3] frames of one camera.
        gains: [N, 3] light of each frame; samples are divided by it.
        share: part of the N samples that the interval must hold, 0 < share <= 1.

    Returns:
        mean [H, W, 3] and sigma [H, W, 3], grey levels.
    """
    count, height, width, _ = samples.shape
    need = min(max(int(np.ceil(share * count)), 1), count)
    mean = np.empty((height, width, 3), dtype=np.float32)
    sigma = np.empty((height, width, 3), dtype=np.float32)
    brightness = np.empty(count, dtype=np.float32)
    order = np.empty(count, dtype=np.int32)
    inverse = np.float32(1) / gains
    for y in range(height):
        for x in range(width):
            for k in range(count):
                value = np.float32(0)
                for c in range(3):
                    value += np.float32(samples[k, y, x, c]) * inverse[k, c]
                at = k
                while at > 0 and brightness[at - 1] > value:
                    brightness[at] = brightness[at - 1]
                    order[at] = order[at - 1]
                    at -= 1
                brightness[at] = value
                order[at] = k
            best = 0
            for first in range(1, count - need + 1):
                if brightness[first + need - 1] - brightness[first] < brightness[best + need - 1] - brightness[best]:
                    best = first
            for c in range(3):
                total = 0.0
                squares = 0.0
                for k in range(best, best + need):
                    value = samples[order[k], y, x, c] * inverse[order[k], c]
                    total += value
                    squares += value * value
                average = total / need
                mean[y, x, c] = average
                sigma[y, x, c] = np.sqrt(max(squares / need - average * average, 0.0))
    return mean, sigma
