# SPDX-License-Identifier: Apache-2.0
"""Compiled loops of `background`: the per-pixel Gaussian test with its update, and the light gain.

The state is planar ([channel, height, width]) because the compiler then handles eight pixels at a time. What every
frame reads of it is kept a second time in 16-bit fixed point: the loop over the image waits for memory, not for sums.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]
Words = NDArray[np.uint16]
Floats = NDArray[np.float32]
Spans = NDArray[np.int32]

CHANGE_SCALE = 2.0
"""Grey levels of the change map per sigma (the map ends at 127 sigma)."""
COLOUR_SCALE = 8.0
"""Grey levels of the colour map per sigma (the map ends at 32 sigma)."""

LEVEL_SCALE = 128.0
"""Fixed point of the means: units per grey level (256 grey levels fit into 15 bits)."""
SHARPNESS_SCALE = 4096.0
"""Fixed point of one over sigma: units at a sigma of one grey level (a sigma of 0.1 fits into 16 bits)."""

STRIP = 320
"""Pixels that are worked on at a time; their intermediate sums stay in the fastest cache."""

# The maths holds no NaN (variances are floored), so these flags only let the compiler use vector instructions.
_VECTOR = {"nnan", "ninf", "nsz", "contract", "reassoc"}


@njit(cache=True, fastmath=_VECTOR, error_model="numpy")
def measure(
    image: Bytes,
    level: Words,
    sharpness: Words,
    gain: Floats,
    darkest: np.float32,
    brightest: np.float32,
    spans: Spans,
    change: Bytes,
    colour: Bytes,
) -> None:
    """Measure how far the pixels of some part of every row are from their background; the other ones stay.

    Args:
        image: [3, H, W] the frame, planar.
        level: [3, H, W] means in grey levels * LEVEL_SCALE.
        sharpness: [3, H, W] SHARPNESS_SCALE over the standard deviation.
        gain: [3] brightness of the light now over that of the model.
        darkest, brightest: shadows and highlights scale the background by a factor in this range.
        spans: [H, 2] first column to measure of each row, and the one behind the last.
        change: [H, W] out, distance to the background in sigmas * CHANGE_SCALE.
        colour: [H, W] out, what of it no shadow or highlight explains, in sigmas * COLOUR_SCALE.
    """
    top = np.float32(255)
    # Sums over the channels live in one scratch row at constant offsets: few pointers, so that the compiler can prove
    # that the loops may run on vectors. Their rounding (1e-2 sigma squared) is far below any threshold.
    scratch = np.empty(3 * STRIP, dtype=np.float32)
    for y in range(change.shape[0]):
        end = spans[y, 1]
        for start in range(spans[y, 0], end, STRIP):
            n = min(STRIP, end - start)
            for x in range(n):
                scratch[x] = np.float32(0)
                scratch[x + STRIP] = np.float32(0)
                scratch[x + 2 * STRIP] = np.float32(0)
            for c in range(3):
                pixel = image[c, y, start : start + n]
                means = level[c, y, start : start + n]
                sharp = sharpness[c, y, start : start + n]
                g = gain[c] * np.float32(1.0 / LEVEL_SCALE)
                for x in range(n):
                    expected = min(g * np.float32(means[x]), top)
                    per_sigma = np.float32(sharp[x]) * np.float32(1.0 / SHARPNESS_SCALE)
                    off = (np.float32(pixel[x]) - expected) * per_sigma
                    expected *= per_sigma
                    scratch[x] += off * off
                    scratch[x + STRIP] += off * expected
                    scratch[x + 2 * STRIP] += expected * expected
            out_change, out_colour = change[y, start : start + n], colour[y, start : start + n]
            for x in range(n):
                far2 = scratch[x]
                along = scratch[x + STRIP]
                length2 = scratch[x + 2 * STRIP] + np.float32(1e-6)
                # The nearest point of the line of scaled backgrounds, kept between the darkest and the brightest.
                t = min(max(along / length2, darkest - np.float32(1)), brightest - np.float32(1))
                rest2 = max(far2 - t * (np.float32(2) * along - t * length2), np.float32(0))
                out_change[x] = np.uint8(np.int32(min(np.float32(CHANGE_SCALE) * np.sqrt(far2), top)))
                out_colour[x] = np.uint8(np.int32(min(np.float32(COLOUR_SCALE) * np.sqrt(rest2), top)))


@njit(cache=True, fastmath=_VECTOR, error_model="numpy")
def fix(
    mean: Floats, variance: Floats, floor_variance: np.float32, weight: np.float32, level: Words, sharpness: Words
) -> None:
    """Write one row of the model (all [W]) in the fixed point that `measure` reads; arguments as in `learn`."""
    top = np.float32(65535)
    for x in range(mean.size):
        units = max(mean[x], np.float32(0)) * np.float32(LEVEL_SCALE)
        level[x] = np.uint16(np.int32(min(units + np.float32(0.5), top)))
    for x in range(mean.size):
        sharp = np.float32(SHARPNESS_SCALE) * np.sqrt(weight / (variance[x] + floor_variance))
        sharpness[x] = np.uint16(np.int32(min(sharp + np.float32(0.5), top)))


@njit(cache=True)
def fix_all(
    mean: Floats, variance: Floats, floor_variance: np.float32, weight: np.float32, level: Words, sharpness: Words
) -> None:
    """`fix` for the whole model, all [3, H, W]."""
    for c in range(mean.shape[0]):
        for y in range(mean.shape[1]):
            fix(mean[c, y], variance[c, y], floor_variance, weight, level[c, y], sharpness[c, y])


@njit(cache=True, fastmath=_VECTOR, error_model="numpy")
def learn(
    image: Bytes,
    mean: Floats,
    variance: Floats,
    level: Words,
    sharpness: Words,
    gain: Floats,
    busy: Bytes,
    change: Bytes,
    limit: np.float32,
    rate: np.float32,
    floor_variance: np.float32,
    weight: np.float32,
    first: int,
    step: int,
) -> None:
    """Running Gaussian average: move mean and variance of background pixels towards the frame, in place.

    Args:
        image, level, sharpness, gain, change: as in `measure`.
        mean, variance: [3, H, W] grey levels and their square, without the floor.
        busy: [H, W] non-zero where nothing may be learned (foreground and its rim).
        limit: pixels with a `change` of this or more are not learned.
        rate: weight of the new pixel.
        floor_variance: added to every variance before it is turned into a sharpness.
        weight: 1, or 1/3 when the three channels are copies of one.
        first, step: rows first, first + step, ... are learned.
    """
    height, width = busy.shape
    one, zero = np.float32(1), np.float32(0)
    weights = np.empty(width, dtype=np.float32)
    for y in range(first, height, step):
        skip, far = busy[y], change[y]
        for x in range(width):
            weights[x] = rate if (skip[x] == 0) & (np.float32(far[x]) < limit) else zero
        for c in range(3):
            pixel, m, v = image[c, y], mean[c, y], variance[c, y]
            inverse = one / gain[c]
            for x in range(width):
                # A clipped pixel says only that the light is at least this bright.
                w = weights[x] if np.float32(pixel[x]) < np.float32(254) else zero
                off = np.float32(pixel[x]) * inverse - m[x]
                v[x] = (one - w) * (v[x] + w * off * off)
                m[x] += w * off
            fix(m, v, floor_variance, weight, level[c, y], sharpness[c, y])


@njit(cache=True, fastmath=_VECTOR, error_model="numpy")
def add_to_mean(image: Bytes, gain: Floats, count: int, mean: Floats, squares: Floats) -> None:
    """Take one more image into a running mean and sum of squared deviations, in place (Welford 1962).

    Args:
        image, gain: as in `measure`; the image is brought to the mean's light.
        count: images with this one.
        mean, squares: [3, H, W] grey levels and their square.
    """
    share = np.float32(1) / np.float32(count)
    for c in range(image.shape[0]):
        inverse = np.float32(1) / gain[c]
        for y in range(image.shape[1]):
            pixel, m, s = image[c, y], mean[c, y], squares[c, y]
            for x in range(pixel.size):
                now = np.float32(pixel[x]) * inverse
                before = now - m[x]
                after = m[x] + before * share
                s[x] += before * (now - after)
                m[x] = after


@njit(cache=True)
def foreground_spans(
    change: Bytes, threshold: int, colour: Bytes, colour_level: int, first: int, step: int, rim: int, spans: Spans
) -> None:
    """Where somebody may be, judged by the rows first, first + step, ...

    Foreground is two neighbours of a row that both have this change and this colour: noise alters single pixels.

    Args:
        change, colour: [H, W] as `measure` gives them, for these rows at least.
        threshold, colour_level: levels of foreground.
        rim: pixels around foreground that belong to it, at least `step`.
        spans: [H, 2] out, first column and the one behind the last, over all foreground of the rows around.
    """
    height, width = change.shape
    spans[:, 0] = width
    spans[:, 1] = 0
    far, coloured = np.uint8(threshold), np.uint8(colour_level)
    here = np.empty(width, dtype=np.uint8)
    for y in range(first, height, step):
        change_row, colour_row = change[y], colour[y]
        # Most rows hold no foreground at all, which a loop without a way out finds out on vectors.
        for x in range(width):
            here[x] = np.uint8(change_row[x] >= far) & np.uint8(colour_row[x] >= coloured)
        some = np.uint8(0)
        for x in range(width - 1):
            some |= here[x] & here[x + 1]
        if some == 0:
            continue
        left = 0
        while here[left] + here[left + 1] < 2:
            left += 1
        right = width
        while here[right - 1] + here[right - 2] < 2:
            right -= 1
        left, right = max(left - rim, 0), min(right + rim, width)
        for row in range(max(y - rim, 0), min(y + rim + 1, height)):
            spans[row, 0] = min(spans[row, 0], left)
            spans[row, 1] = max(spans[row, 1], right)


@njit(cache=True)
def light_gain(image: Bytes, level: Words, busy: Bytes, last: Floats, stride: int) -> Floats:
    """Brightness of the light per channel relative to the model: a median ratio, then a trimmed ratio of sums.

    Looks at every `stride`-th pixel that is not `busy` and whose background is neither dark nor near clipping.

    Returns:
        [3] the gains; `last` for a channel with too few usable pixels.
    """
    height, width = busy.shape
    gain = last.copy()
    bins = 1024
    means = np.empty((height // stride + 1) * (width // stride + 1), dtype=np.float32)
    values = np.empty_like(means)
    for c in range(3):
        counts = np.zeros(bins, dtype=np.int64)
        total = 0
        for y in range(stride // 2, height, stride):
            for x in range(stride // 2, width, stride):
                m = np.float32(level[c, y, x]) * np.float32(1.0 / LEVEL_SCALE)
                v = np.float32(image[c, y, x])
                if busy[y, x] == 0 and m > 20.0 and v < 250:
                    counts[min(int(v / m * np.float32(256.0)), bins - 1)] += 1
                    means[total], values[total] = m, v
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
        for k in range(total):
            if abs(values[k] - centre * means[k]) <= 0.08 * centre * means[k] + 2.0:
                top += values[k]
                bottom += means[k]
        if bottom > 0.0:
            gain[c] = min(max(top / bottom, 0.2), 5.0)
    return gain


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
