# SPDX-License-Identifier: Apache-2.0
"""Compiled loops of `background`: the per-pixel Gaussian test with its update, and the light gain.

The state is planar ([channel, height, width]) because the compiler then handles eight pixels at a time. What every
frame reads of it is kept a second time in 16-bit fixed point: the loop over the image waits for memory, not for sums.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from limbloc_ros.core._bit_kernels import WORD, Bits, count_in, highest, lowest, spread_row, word_at_least

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

# The maths holds no NaN (variances are floored), so these flags only let the compiler use vector instructions.
_VECTOR = {"nnan", "ninf", "nsz", "contract", "reassoc"}


@njit(cache=True)
def split_row(image: Bytes, y: int, left: int, channels: Bytes) -> None:
    """Put the three channels of a part of a row, which are interleaved in the image, one behind the other.

    Args:
        image: [H, W, 3].
        y, left: the row, and its first column.
        channels: [3 n] out.
    """
    # Written like this, with one array on each side and no index that might be negative, it becomes some shuffles of
    # vectors: a tenth of the time.
    pixels = image[y].reshape(-1)[3 * left :]
    n = channels.size // 3
    for x in range(n):
        channels[x] = pixels[3 * x]
        channels[n + x] = pixels[3 * x + 1]
        channels[2 * n + x] = pixels[3 * x + 2]


@njit(cache=True, inline="always")
def _word_of(distance: Floats, x: int, number: int, least: np.float32) -> np.uint64:
    word = np.uint64(0)
    for j in range(number):
        word |= np.uint64(distance[x + j] >= least) << np.uint64(j)
    return word


@njit(cache=True, fastmath=_VECTOR, error_model="numpy")
def look(
    image: Bytes, level: Words, sharpness: Words, gain: Floats, first: int, step: int, far: np.float32, changed: Bits
) -> int:
    """Tell of the rows first, first + step, ... of an image which pixels are not the background's.

    Args:
        image, level, sharpness, gain: as in `measure`.
        far: so many sigmas from the background is another thing.
        changed: [R, N] bits out, set where another thing is.

    Returns:
        how many pixels.
    """
    width = image.shape[1]
    top, least = np.float32(255), far * far
    unit = np.float32(1.0 / SHARPNESS_SCALE)
    distance = np.empty(width, dtype=np.float32)
    channels = np.empty(3 * width, dtype=np.uint8)
    total = 0
    for k in range(len(changed)):
        y = first + k * step
        split_row(image, y, 0, channels)
        distance[:] = 0
        for c in range(3):
            pixel, means, sharp = channels[c * width : (c + 1) * width], level[c, y], sharpness[c, y]
            g = gain[c] * np.float32(1.0 / LEVEL_SCALE)
            for x in range(width):
                off = (np.float32(pixel[x]) - min(g * np.float32(means[x]), top)) * (np.float32(sharp[x]) * unit)
                distance[x] += off * off
        for n in range(width // WORD):
            changed[k, n] = _word_of(distance, WORD * n, WORD, least)
        if width % WORD:
            changed[k, -1] = _word_of(distance, width - width % WORD, width % WORD, least)
        total += count_in(changed, k, 0, width)
    return total


# Loops of a constant length need no code for what is left over behind the last vector: hence the two calls of functions
# that are inlined.


@njit(cache=True, inline="always")
def _measure_word(
    image: Bytes,
    level: Words,
    sharpness: Words,
    gain: Floats,
    darkest: np.float32,
    brightest: np.float32,
    y: int,
    begin: int,
    n: int,
    channels: Bytes,
    sums: Floats,
    change: Bytes,
    colour: Bytes,
) -> None:
    top = np.float32(255)
    split_row(image, y, begin, channels[: 3 * n])
    # Sums over the channels live in one array at constant offsets: few pointers, so that the compiler can prove that
    # the loops may run on vectors. Their rounding (1e-2 sigma squared) is far below any threshold.
    for x in range(n):
        sums[x] = np.float32(0)
        sums[x + WORD] = np.float32(0)
        sums[x + 2 * WORD] = np.float32(0)
    for c in range(3):
        pixel = channels[c * n : (c + 1) * n]
        means = level[c, y, begin : begin + n]
        sharp = sharpness[c, y, begin : begin + n]
        g = gain[c] * np.float32(1.0 / LEVEL_SCALE)
        for x in range(n):
            per_sigma = np.float32(sharp[x]) * np.float32(1.0 / SHARPNESS_SCALE)
            expected = min(g * np.float32(means[x]), top) * per_sigma
            off = np.float32(pixel[x]) * per_sigma - expected
            sums[x] += off * off
            sums[x + WORD] += off * expected
            sums[x + 2 * WORD] += expected * expected
    for x in range(n):
        far2 = sums[x]
        along = sums[x + WORD]
        length2 = sums[x + 2 * WORD] + np.float32(1e-6)
        # The nearest point of the line of scaled backgrounds, kept between the darkest and the brightest.
        t = min(max(along / length2, darkest - np.float32(1)), brightest - np.float32(1))
        rest2 = max(far2 - t * (np.float32(2) * along - t * length2), np.float32(0))
        change[x] = np.uint8(np.int32(min(np.float32(CHANGE_SCALE) * np.sqrt(far2), top)))
        colour[x] = np.uint8(np.int32(min(np.float32(COLOUR_SCALE) * np.sqrt(rest2), top)))


@njit(cache=True, fastmath=_VECTOR, error_model="numpy")
def measure(
    image: Bytes,
    level: Words,
    sharpness: Words,
    gain: Floats,
    darkest: np.float32,
    brightest: np.float32,
    top: int,
    left: int,
    spans: Spans,
    change: Bytes,
    colour: Bytes,
) -> None:
    """Measure how far the pixels of some part of each row are from their background; the other ones stay.

    Args:
        image: [H, W, 3] the frame.
        level: [3, H, W] means in grey levels * LEVEL_SCALE.
        sharpness: [3, H, W] SHARPNESS_SCALE over the standard deviation.
        gain: [3] brightness of the light now over that of the model.
        darkest, brightest: shadows and highlights scale the background by a factor in this range.
        top, left: row and column of the frame where `change` and `colour` begin; `left` is a multiple of WORD.
        spans: [h, 2] of each row the first column of the frame to measure, and the one behind the last. Whole words
            of pixels are measured.
        change: [h, w] out, distance to the background in sigmas * CHANGE_SCALE; w is a multiple of WORD or reaches to
            the end of the frame.
        colour: [h, w] out, what of it no shadow or highlight explains, in sigmas * COLOUR_SCALE.
    """
    width = image.shape[1]
    sums, channels = np.empty(3 * WORD, dtype=np.float32), np.empty(3 * WORD, dtype=np.uint8)
    for row in range(len(change)):
        y = top + row
        for begin in range(spans[row, 0] // WORD * WORD, spans[row, 1], WORD):
            out, tint = change[row, begin - left :], colour[row, begin - left :]
            if begin + WORD <= width:
                _measure_word(
                    image, level, sharpness, gain, darkest, brightest, y, begin, WORD, channels, sums, out, tint
                )
            else:
                n = width - begin
                _measure_word(image, level, sharpness, gain, darkest, brightest, y, begin, n, channels, sums, out, tint)


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
    busy: Bits,
    changed: Bits,
    rate: np.float32,
    floor_variance: np.float32,
    weight: np.float32,
    first: int,
    step: int,
    turn: int,
    turns: int,
) -> None:
    """Running Gaussian average: move mean and variance of background pixels towards the frame, in place.

    Args:
        image, level, sharpness, gain: as in `measure`.
        mean, variance: [3, H, W] grey levels and their square, without the floor.
        busy: [H, N] bits, set where nothing may be learned (foreground and its rim).
        changed, first, step: nor may what is changed in the rows that were looked at, as in `look`.
        rate: weight of the new pixel.
        floor_variance: added to every variance before it is turned into a sharpness.
        weight: 1, or 1/3 when the three channels are copies of one.
        turn, turns: of the rows that were looked at those turn, turn + turns, ... are learned.
    """
    width = image.shape[1]
    one, zero = np.float32(1), np.float32(0)
    weights = np.empty(width, dtype=np.float32)
    channels = np.empty(3 * width, dtype=np.uint8)
    flags = np.empty((2, width), dtype=np.uint8)
    for k in range(turn, len(changed), turns):
        y = first + k * step
        split_row(image, y, 0, channels)
        spread_row(busy, y, flags, 0, width)
        spread_row(changed, k, flags, 1, width)
        taken, far = flags[0], flags[1]
        for x in range(width):
            weights[x] = rate if (taken[x] == 0) & (far[x] == 0) else zero
        for c in range(3):
            pixel, m, v = channels[c * width : (c + 1) * width], mean[c, y], variance[c, y]
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
        image, gain: [3, H, W] planar and [3] as in `measure`; the image is brought to the mean's light.
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


@njit(cache=True, fastmath=_VECTOR, error_model="numpy")
def foreground_spans(
    image: Bytes,
    level: Words,
    sharpness: Words,
    gain: Floats,
    darkest: np.float32,
    brightest: np.float32,
    changed: Bits,
    least: int,
    first: int,
    step: int,
    rim: int,
    spans: Spans,
) -> None:
    """Where somebody may be, judged by the rows first, first + step, ...

    Foreground is two neighbours in a word of a row that both are changed and have this colour: noise alters single
    pixels.

    Args:
        image, level, sharpness, gain, darkest, brightest: as in `measure`.
        changed: [R, N] bits, what changed in these rows, as `look` tells.
        least: level of foreground's `colour`.
        rim: pixels around foreground that belong to it, at least `step`.
        spans: [H, 2] out, first column and the one behind the last, over all foreground of the rows around.
    """
    height, width = image.shape[:2]
    number = changed.shape[1]
    spans[:, 0] = width
    spans[:, 1] = 0
    change, colour = np.empty((2, 1, WORD), dtype=np.uint8)
    sums, channels = np.empty(3 * WORD, dtype=np.float32), np.empty(3 * WORD, dtype=np.uint8)
    level_of, one = np.uint8(least), np.uint64(1)
    for k in range(len(changed)):
        y = first + k * step
        left, right = width, 0
        # The colour is measured word by word, from both ends inwards, until there is a pair that has it.
        for side in range(2):
            found = np.uint64(0)
            for i in range(number):
                n = i if side == 0 else number - 1 - i
                word = changed[k, n]
                if word & (word >> one) == 0:
                    continue
                _measure_word(
                    image, level, sharpness, gain, darkest, brightest, y, WORD * n, min(WORD, width - WORD * n),
                    channels, sums, change[0], colour[0],
                )  # fmt: skip
                word &= word_at_least(colour, 0, 0, WORD, level_of)
                found = word & (word >> one)
                if found:
                    left = min(left, WORD * n + lowest(found))
                    right = max(right, WORD * n + highest(found) + 2)
                    break
            if found == 0:
                break
        if right == 0:
            continue  # noise, or a shadow
        left, right = max(left - rim, 0), min(right + rim, width)
        for row in range(max(y - rim, 0), min(y + rim + 1, height)):
            spans[row, 0] = min(spans[row, 0], left)
            spans[row, 1] = max(spans[row, 1], right)


@njit(cache=True)
def box_of(spans: Spans, pad: int, width: int) -> tuple[int, int, int, int]:
    """Top, bottom, left and right of all spans [H, 2] and `pad` pixels around; left and right at whole words."""
    top, bottom, left, right = len(spans), 0, width, 0
    for y in range(len(spans)):
        if spans[y, 0] < spans[y, 1]:
            top, bottom = min(top, y), y + 1
            left, right = min(left, spans[y, 0]), max(right, spans[y, 1])
    if bottom == 0:
        return 0, 0, 0, 0
    left = max(left - pad, 0) // WORD * WORD
    right = min((right + pad + WORD - 1) // WORD * WORD, width)
    return max(top - pad, 0), min(bottom + pad, len(spans)), left, right


@njit(cache=True, fastmath=_VECTOR, error_model="numpy")
def light_gain(image: Bytes, level: Words, busy: Bits, last: Floats, stride: int) -> Floats:
    """Brightness of the light per channel relative to the model: a median ratio, then a trimmed ratio of sums.

    Looks at every `stride`-th pixel that is not `busy` and whose background is neither dark nor near clipping.

    Args:
        image: [H, W, 3].
        level: [3, H, W] as in `measure`.
        busy: [H, N] bits.

    Returns:
        [3] the gains; `last` for a channel with too few usable pixels.
    """
    height, width = image.shape[:2]
    gain = last.copy()
    bins = 1024
    means = np.empty((height // stride + 1) * (width // stride + 1), dtype=np.float32)
    values = np.empty_like(means)
    for c in range(3):
        counts = np.zeros(bins, dtype=np.int32)
        total = 0
        for y in range(stride // 2, height, stride):
            for x in range(stride // 2, width, stride):
                m = np.float32(level[c, y, x]) * np.float32(1.0 / LEVEL_SCALE)
                v = np.float32(image[y, x, c])
                means[total], values[total] = m, v
                free = (busy[y, x // WORD] >> np.uint64(x % WORD)) & np.uint64(1) == 0
                total += free & (m > np.float32(20)) & (v < np.float32(250))
        for k in range(total):
            counts[min(int(values[k] / means[k] * np.float32(256)), bins - 1)] += 1
        if total < 64:
            continue
        seen = 0
        middle = 0
        while 2 * (seen + counts[middle]) < total:
            seen += counts[middle]
            middle += 1
        centre = np.float32((middle + 0.5) / 256.0)
        top, bottom = np.float32(0), np.float32(0)
        for k in range(total):
            expected = centre * means[k]
            near = abs(values[k] - expected) <= np.float32(0.08) * expected + np.float32(2)
            top += values[k] if near else np.float32(0)
            bottom += means[k] if near else np.float32(0)
        if bottom > 0:
            gain[c] = min(max(top / bottom, np.float32(0.2)), np.float32(5))
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
