# SPDX-License-Identifier: Apache-2.0
"""Compiled loops of `background`: the per-pixel Gaussian test with its update, the light gain, and hysteresis.

The state is planar ([channel, height, width], float32) because the compiler then handles eight pixels at a time.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float32]

CHANGE_SCALE = 2.0
"""Grey levels of the change map per sigma (the map ends at 127 sigma)."""
COLOUR_SCALE = 8.0
"""Grey levels of the colour map per sigma (the map ends at 32 sigma)."""

STRIP = 320
"""Pixels that are worked on at a time; their intermediate sums stay in the fastest cache."""

# The maths holds no NaN (variances are floored), so these flags only let the compiler use vector instructions.
_VECTOR = {"nnan", "ninf", "nsz", "contract", "reassoc"}


@njit(cache=True, fastmath=_VECTOR, error_model="numpy")
def measure_and_update(
    image: Bytes,
    mean: Floats,
    variance: Floats,
    busy: Bytes,
    gain: Floats,
    floor_variance: np.float32,
    weight: np.float32,
    darkest: np.float32,
    brightest: np.float32,
    limit: np.float32,
    rate: np.float32,
    change: Bytes,
    colour: Bytes,
) -> None:
    """Measure how far every pixel is from its background, and learn from those that are near.

    Args:
        image: [3, H, W] the frame, planar.
        mean, variance: [3, H, W] the model, changed in place.
        busy: [H, W] non-zero where nothing may be learned (the last frame's foreground and its rim).
        gain: [3] brightness of the light now over that of the model.
        floor_variance: added to every variance, grey levels squared.
        weight: 1, or 1/3 when the three channels are copies of one.
        darkest, brightest: shadows and highlights scale the background by a factor in this range.
        limit: pixels beyond this many sigmas are not learned.
        rate: weight of the new pixel.
        change: [H, W] out, distance to the background in sigmas * CHANGE_SCALE.
        colour: [H, W] out, what of it no shadow or highlight explains, in sigmas * COLOUR_SCALE.
    """
    height, width = change.shape
    top, near_white = np.float32(255), np.float32(254)
    limit2 = limit * limit
    # Sums over the channels live in one scratch row at constant offsets: few pointers, so that the compiler can prove
    # that the loops may run on vectors. Their rounding (1e-2 sigma squared) is far below any threshold.
    scratch = np.empty(5 * STRIP, dtype=np.float32)
    for y in range(height):
        for start in range(0, width, STRIP):
            n = min(STRIP, width - start)
            for c in range(3):
                pixel, m, v = image[c, y, start : start + n], mean[c, y, start : start + n], variance[c, y, start : start + n]
                g = gain[c]
                if c == 0:
                    for x in range(n):
                        scratch[x] = np.float32(0)
                        scratch[x + STRIP] = np.float32(0)
                        scratch[x + 2 * STRIP] = np.float32(0)
                        scratch[x + 3 * STRIP] = np.float32(0)
                for x in range(n):
                    now = np.float32(pixel[x])
                    expected = min(g * m[x], top)
                    precision = weight / (v[x] + floor_variance)
                    off = now - expected
                    scaled = expected * precision
                    scratch[x] += off * off * precision
                    scratch[x + STRIP] += off * scaled
                    scratch[x + 2 * STRIP] += expected * scaled
                    scratch[x + 3 * STRIP] = max(scratch[x + 3 * STRIP], now)
            out_change, out_colour, skip = change[y, start : start + n], colour[y, start : start + n], busy[y, start : start + n]
            for x in range(n):
                far2 = scratch[x]
                along = scratch[x + STRIP]
                length2 = scratch[x + 2 * STRIP] + np.float32(1e-6)
                # The nearest point of the line of scaled backgrounds, kept between the darkest and the brightest.
                t = min(max(along / length2, darkest - np.float32(1)), brightest - np.float32(1))
                rest2 = max(far2 - t * (np.float32(2) * along - t * length2), np.float32(0))
                out_change[x] = np.uint8(np.int32(min(np.float32(CHANGE_SCALE) * np.sqrt(far2), top)))
                out_colour[x] = np.uint8(np.int32(min(np.float32(COLOUR_SCALE) * np.sqrt(rest2), top)))
                near = (far2 < limit2) & (skip[x] == 0) & (scratch[x + 3 * STRIP] < near_white)
                scratch[x + 4 * STRIP] = rate if near else np.float32(0)
            if rate > 0:
                for c in range(3):
                    pixel, m, v = image[c, y, start : start + n], mean[c, y, start : start + n], variance[c, y, start : start + n]
                    inverse = np.float32(1) / gain[c]
                    for x in range(n):
                        learn = scratch[x + 4 * STRIP]
                        off = np.float32(pixel[x]) * inverse - m[x]
                        v[x] = (np.float32(1) - learn) * (v[x] + learn * off * off)
                        m[x] += learn * off


@njit(cache=True)
def light_gain(image: Bytes, mean: Floats, busy: Bytes, last: Floats, stride: int) -> Floats:
    """Brightness of the light per channel relative to the model: a median ratio, then a trimmed ratio of sums.

    Looks at every `stride`-th pixel that is not `busy` and whose background is neither dark nor near clipping.

    Returns:
        [3] the gains; `last` for a channel with too few usable pixels.
    """
    height, width = busy.shape
    gain = last.copy()
    bins = 1024
    for c in range(3):
        counts = np.zeros(bins, dtype=np.int64)
        total = 0
        for y in range(stride // 2, height, stride):
            for x in range(stride // 2, width, stride):
                m = mean[c, y, x]
                v = image[c, y, x]
                if busy[y, x] == 0 and m > 20.0 and v < 250:
                    counts[min(int(np.float32(v) / m * np.float32(256.0)), bins - 1)] += 1
                    total += 1
        if total < 64:
            continue
        seen = 0
        middle = 0
        while 2 * (seen + counts[middle]) < total:
            seen += counts[middle]
            middle += 1
        centre = (middle + 0.5) / 256.0
        top = 0.0
        bottom = 0.0
        for y in range(stride // 2, height, stride):
            for x in range(stride // 2, width, stride):
                m = mean[c, y, x]
                v = image[c, y, x]
                if busy[y, x] == 0 and m > 20.0 and v < 250 and abs(v - centre * m) <= 0.08 * centre * m + 2.0:
                    top += v
                    bottom += m
        if bottom > 0.0:
            gain[c] = min(max(top / bottom, 0.2), 5.0)
    return gain


@njit(cache=True)
def grow_from_seeds(weak: Bytes, strong: Bytes) -> Bytes:
    """Keep the 8-connected parts of `weak` that hold a pixel of `strong` (hysteresis).

    Args:
        weak, strong: [H, W] C-contiguous, non-zero = set. The outermost pixels of `weak` must be zero, so that no
            neighbour lies outside the array.

    Returns:
        [H, W] 0 or 255.
    """
    width = weak.shape[1]
    out = np.zeros_like(weak)
    flat_weak, flat_out, flat_strong = weak.ravel(), out.ravel(), strong.ravel()
    size = flat_weak.size
    stack = np.empty(size, dtype=np.int32)
    # Almost all of `strong` is zero: eight pixels at a time are skipped.
    words = flat_strong[: size - size % 8].view(np.uint64)
    start = 0
    while start < size:
        if start % 8 == 0 and start // 8 < words.size and words[start // 8] == 0:
            start += 8
            continue
        if flat_strong[start] != 0 and flat_weak[start] != 0 and flat_out[start] == 0:
            depth = 1
            stack[0] = start
            flat_out[start] = 255
            while depth > 0:
                depth -= 1
                at = np.int64(stack[depth])
                for row in (at - width, at, at + width):
                    for to in (row - 1, row, row + 1):
                        if flat_weak[to] != 0 and flat_out[to] == 0:
                            flat_out[to] = 255
                            stack[depth] = to
                            depth += 1
        start += 1
    return out


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
