# SPDX-License-Identifier: Apache-2.0
"""Compiled loops of `background`: the per-pixel Gaussian test with its update, the light gain, and hysteresis.

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
    change: Bytes,
    colour: Bytes,
) -> None:
    """Measure how far every pixel is from its background.

    Args:
        image: [3, H, W] the frame, planar.
        level: [3, H, W] means in grey levels * LEVEL_SCALE.
        sharpness: [3, H, W] SHARPNESS_SCALE over the standard deviation.
        gain: [3] brightness of the light now over that of the model.
        darkest, brightest: shadows and highlights scale the background by a factor in this range.
        change: [H, W] out, distance to the background in sigmas * CHANGE_SCALE.
        colour: [H, W] out, what of it no shadow or highlight explains, in sigmas * COLOUR_SCALE.
    """
    height, width = change.shape
    top = np.float32(255)
    # Sums over the channels live in one scratch row at constant offsets: few pointers, so that the compiler can prove
    # that the loops may run on vectors. Their rounding (1e-2 sigma squared) is far below any threshold.
    scratch = np.empty(3 * STRIP, dtype=np.float32)
    for y in range(height):
        for start in range(0, width, STRIP):
            n = min(STRIP, width - start)
            for x in range(3 * STRIP):
                scratch[x] = np.float32(0)
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
def light_gain(image: Bytes, level: Words, busy: Bytes, last: Floats, stride: int) -> Floats:
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
                m = np.float32(level[c, y, x]) * np.float32(1.0 / LEVEL_SCALE)
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
                m = np.float32(level[c, y, x]) * np.float32(1.0 / LEVEL_SCALE)
                v = image[c, y, x]
                if busy[y, x] == 0 and m > 20.0 and v < 250 and abs(v - centre * m) <= 0.08 * centre * m + 2.0:
                    top += v
                    bottom += float(m)
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
def add_body_parts(
    mask: Bytes, changed: Bytes, colour: Bytes, threshold: int, least_colour: float, border_ratio: float
) -> None:
    """Add to `mask`, in place, the 4-connected changed parts outside it that are more body than shadow.

    A part is body when its border pixels beside `mask` are more than `border_ratio` times those beside unchanged
    background, its mean `colour` is above `least_colour`, and it does not touch the rim of the arrays.

    Args:
        mask: [H, W] 0 or 255.
        changed, colour: [H, W] evidence; a pixel is changed at `threshold`.
    """
    height, width = mask.shape
    seen = np.zeros((height, width), dtype=np.uint8)
    part = np.empty(height * width, dtype=np.int32)
    for y0 in range(height):
        for x0 in range(width):
            if changed[y0, x0] < threshold or mask[y0, x0] != 0 or seen[y0, x0] != 0:
                continue
            part[0] = y0 * width + x0
            seen[y0, x0] = 1
            size = 1
            done = 0
            inner = 0
            outer = 0
            total = 0
            at_rim = False
            while done < size:
                y, x = part[done] // width, part[done] % width
                done += 1
                total += colour[y, x]
                if y == 0 or x == 0 or y == height - 1 or x == width - 1:
                    at_rim = True
                beside_mask = False
                beside_background = False
                for k in range(4):
                    yy = y + (k == 0) - (k == 1)
                    xx = x + (k == 2) - (k == 3)
                    if yy < 0 or xx < 0 or yy >= height or xx >= width:
                        continue
                    if mask[yy, xx] == 255:
                        beside_mask = True
                    elif changed[yy, xx] < threshold:
                        beside_background = True
                    elif seen[yy, xx] == 0:
                        seen[yy, xx] = 1
                        part[size] = yy * width + xx
                        size += 1
                inner += beside_mask
                outer += beside_background
            if not at_rim and inner > border_ratio * outer and total > least_colour * size:
                for k in range(size):
                    mask[part[k] // width, part[k] % width] = 255


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
