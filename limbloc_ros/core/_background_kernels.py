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

LANES = 16
"""So many pixels are measured at a time."""

# The maths holds no NaN (variances are floored), so these flags only let the compiler use vector instructions.
_VECTOR = {"nnan", "ninf", "nsz", "contract", "reassoc"}


@njit(cache=True)
def split(values: Bytes, first: int, channels: Bytes) -> None:
    """Put the three channels of some pixels, which are interleaved in the image, one behind the other.

    Args:
        values: [3 H W] the image; to be reshaped once, not for every few pixels: numba calls NumPy for it.
        first: the first of these pixels, counted row by row.
        channels: [3 n] out.
    """
    # Written like this, with one array on each side and no index that might be negative, it becomes some shuffles of
    # vectors: a tenth of the time.
    pixels = values[3 * first :]
    n = channels.size // 3
    for x in range(n):
        channels[x] = pixels[3 * x]
        channels[n + x] = pixels[3 * x + 1]
        channels[2 * n + x] = pixels[3 * x + 2]


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
    width, values = image.shape[1], image.reshape(-1)
    top, least = np.float32(255), far * far
    unit = np.float32(1.0 / SHARPNESS_SCALE)
    distances = np.empty((1, width), dtype=np.float32)
    distance = distances[0]
    channels = np.empty(3 * width, dtype=np.uint8)
    total = 0
    for k in range(len(changed)):
        y = first + k * step
        split(values, y * width, channels)
        distance[:] = 0
        for c in range(3):
            pixel, means, sharp = channels[c * width : (c + 1) * width], level[c, y], sharpness[c, y]
            g = gain[c] * np.float32(1.0 / LEVEL_SCALE)
            for x in range(width):
                off = (np.float32(pixel[x]) - min(g * np.float32(means[x]), top)) * (np.float32(sharp[x]) * unit)
                distance[x] += off * off
        for n in range(width // WORD):
            changed[k, n] = word_at_least(distances, 0, WORD * n, WORD, least)
        if width % WORD:
            changed[k, -1] = word_at_least(distances, 0, width - width % WORD, width % WORD, least)
        total += count_in(changed, k, 0, width)
    return total


@njit(cache=True, fastmath=_VECTOR, error_model="numpy")
def _measure_run(
    values: Bytes,
    level: Words,
    sharpness: Words,
    gain: Floats,
    darkest: np.float32,
    brightest: np.float32,
    y: int,
    begin: int,
    channels: Bytes,
    sums: Floats,
    change: Bytes,
    colour: Bytes,
) -> None:
    """Measure some pixels beside each other.

    Args:
        values, level, sharpness, gain, darkest, brightest: as in `measure`; of the image [3 H W] as in `split`.
        y, begin: row and first column.
        channels, sums: [3 W] and [6 W], to work with.
        change, colour: [n] out, as in `measure`.
    """
    n, top = change.size, np.float32(255)
    split(values, y * level.shape[2] + begin, channels[: 3 * n])
    # What the channels give lives in one array: few pointers, so that the compiler can prove that the loops may run on
    # vectors. Rounding (1e-2 sigma squared) is far below any threshold.
    for c in range(3):
        pixel = channels[c * n : (c + 1) * n]
        means, sharp = level[c, y, begin : begin + n], sharpness[c, y, begin : begin + n]
        expected, off = sums[2 * c * n : (2 * c + 1) * n], sums[(2 * c + 1) * n : (2 * c + 2) * n]
        g = gain[c] * np.float32(1.0 / LEVEL_SCALE)
        for x in range(n):
            per_sigma = np.float32(sharp[x]) * np.float32(1.0 / SHARPNESS_SCALE)
            expected[x] = min(g * np.float32(means[x]), top) * per_sigma
            off[x] = np.float32(pixel[x]) * per_sigma - expected[x]
    for x in range(n):
        e0, e1, e2 = sums[x], sums[x + 2 * n], sums[x + 4 * n]
        off0, off1, off2 = sums[x + n], sums[x + 3 * n], sums[x + 5 * n]
        far2 = off0 * off0 + off1 * off1 + off2 * off2
        along = off0 * e0 + off1 * e1 + off2 * e2
        length2 = e0 * e0 + e1 * e1 + e2 * e2 + np.float32(1e-6)
        # The nearest point of the line of scaled backgrounds, kept between the darkest and the brightest.
        t = min(max(along / length2, darkest - np.float32(1)), brightest - np.float32(1))
        rest2 = max(far2 - t * (np.float32(2) * along - t * length2), np.float32(0))
        change[x] = np.uint8(np.int32(min(np.float32(CHANGE_SCALE) * np.sqrt(far2), top)))
        colour[x] = np.uint8(np.int32(min(np.float32(COLOUR_SCALE) * np.sqrt(rest2), top)))


@njit(cache=True)
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
        spans: [h, 2] of each row the first column of the frame to measure, and the one behind the last; measured
            are LANES pixels at a time.
        change: [h, w] out, distance to the background in sigmas * CHANGE_SCALE; w is a multiple of WORD or reaches to
            the end of the frame.
        colour: [h, w] out, what of it no shadow or highlight explains, in sigmas * COLOUR_SCALE.
    """
    width, values = image.shape[1], image.reshape(-1)
    sums, channels = np.empty(6 * width, dtype=np.float32), np.empty(3 * width, dtype=np.uint8)
    for row in range(len(change)):
        begin, end = spans[row, 0] // LANES * LANES, min((spans[row, 1] + LANES - 1) // LANES * LANES, width)
        if begin >= end:
            continue
        out, tint = change[row, begin - left : end - left], colour[row, begin - left : end - left]
        _measure_run(values, level, sharpness, gain, darkest, brightest, top + row, begin, channels, sums, out, tint)


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
    samples: Words,
    stride: int,
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
        samples, stride: as in `sampled`; they follow the levels.
        busy: [H, N] bits, set where nothing may be learned (foreground and its rim).
        changed, first, step: nor may what is changed in the rows that were looked at, as in `look`.
        rate: weight of the new pixel.
        floor_variance: added to every variance before it is turned into a sharpness.
        weight: 1, or 1/3 when the three channels are copies of one.
        turn, turns: of the rows that were looked at those turn, turn + turns, ... are learned.
    """
    width, values = image.shape[1], image.reshape(-1)
    one, zero = np.float32(1), np.float32(0)
    weights = np.empty(width, dtype=np.float32)
    channels = np.empty(3 * width, dtype=np.uint8)
    flags = np.empty((2, width), dtype=np.uint8)
    for k in range(turn, len(changed), turns):
        y = first + k * step
        split(values, y * width, channels)
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
        if y % stride == stride // 2:
            for c in range(3):
                for column in range(samples.shape[2]):
                    samples[c, y // stride, column] = level[c, y, stride // 2 + column * stride]


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


@njit(cache=True)
def _pairs(word: np.uint64) -> np.uint64:
    """The pixels of a word whose right neighbour in it is set as they are."""
    return word & (word >> np.uint64(1))


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
    values, number = image.reshape(-1), changed.shape[1]
    spans[:, 0] = width
    spans[:, 1] = 0
    change, colour = np.empty(width, dtype=np.uint8), np.empty((1, WORD * number), dtype=np.uint8)
    sums, channels = np.empty(6 * width, dtype=np.float32), np.empty(3 * width, dtype=np.uint8)
    level_of = np.uint8(least)
    for k in range(len(changed)):
        y = first + k * step
        before, behind = number, 0  # the words that hold pairs
        for n in range(number):
            if _pairs(changed[k, n]):
                before, behind = min(before, n), n + 1
        begin, end = WORD * before, min(WORD * behind, width)
        if begin >= end:
            continue
        _measure_run(
            values, level, sharpness, gain, darkest, brightest, y, begin, channels, sums,
            change[: end - begin], colour[0, : end - begin],
        )  # fmt: skip
        left, right = width, 0
        for n in range(before, behind):
            word = changed[k, n]
            if _pairs(word):
                word &= word_at_least(colour, 0, WORD * n - begin, WORD, level_of)
                found = _pairs(word)
                if found:
                    left = min(left, WORD * n + lowest(found))
                    right = WORD * n + highest(found) + 2
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


@njit(cache=True)
def measure_around(
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
    pad: int,
    everywhere: bool,
) -> tuple[int, int, Bytes, Bytes]:
    """Measure an image where somebody may be (`foreground_spans`, with its arguments), in one call.

    Args:
        pad: pixels around everything that is measured to take into the arrays, as 0.
        everywhere: measure all of it.

    Returns:
        top and left of the arrays in the image, `change` and `colour` as in `measure`; 0 where nothing was measured.
    """
    height, width = image.shape[:2]
    spans = np.empty((height, 2), dtype=np.int32)
    if everywhere:
        spans[:, 0] = 0
        spans[:, 1] = width
    else:
        foreground_spans(image, level, sharpness, gain, darkest, brightest, changed, least, first, step, rim, spans)
    top, bottom, left, right = box_of(spans, pad, width)
    change = np.zeros((bottom - top, right - left), dtype=np.uint8)
    colour = np.zeros_like(change)
    measure(image, level, sharpness, gain, darkest, brightest, top, left, spans[top:bottom], change, colour)
    return top, left, change, colour


def sampled(level: Words, stride: int) -> Words:
    """Of levels [3, H, W] those that `light_gain` needs, by themselves: else it mostly waits for memory."""
    some = slice(stride // 2, None, stride)
    return np.ascontiguousarray(level[:, some, some])


@njit(cache=True, fastmath=_VECTOR, error_model="numpy")
def light_gain(image: Bytes, samples: Words, busy: Bits, last: Floats, stride: int) -> Floats:
    """Brightness of the light per channel relative to the model: a median ratio, then a trimmed ratio of sums.

    Looks at every `stride`-th pixel that is not `busy` and whose background is neither dark nor near clipping.

    Args:
        image: [H, W, 3].
        samples: `sampled` levels of the model.
        busy: [H, N] bits.

    Returns:
        [3] the gains; `last` for a channel with too few usable pixels.
    """
    gain = last.copy()
    bins = 1024
    means = np.empty(samples[0].size, dtype=np.float32)
    values = np.empty_like(means)
    for c in range(3):
        counts = np.zeros(bins, dtype=np.int32)
        total = 0
        for row in range(samples.shape[1]):
            y = stride // 2 + row * stride
            for column in range(samples.shape[2]):
                x = stride // 2 + column * stride
                m = np.float32(samples[c, row, column]) * np.float32(1.0 / LEVEL_SCALE)
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
