# SPDX-License-Identifier: Apache-2.0
"""Compiled loops on masks of one bit per pixel: 64 pixels are worked on by one instruction.

Such a mask is uint64 [H, N], N = words(W): pixel x is bit x % 64 of word x // 64, and bits from W on are 0. Nothing
here knows what a mask shows.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]
Bits = NDArray[np.uint64]
Widths = NDArray[np.int32]
Runs = NDArray[np.int32]

ROW, START, END = 0, 1, 2
"""Columns of an array of runs: the row, the first column, and the one behind the last."""

WORD = 64

_ALL = np.uint64(0xFFFFFFFFFFFFFFFF)
_ZERO, _ONE, _LAST = np.uint64(0), np.uint64(1), np.uint64(WORD - 1)


@njit(cache=True)
def words(width: int) -> int:
    """Words that hold so many pixels."""
    return (width + WORD - 1) // WORD


def no_pixels(height: int, width: int) -> Bits:
    """An empty mask."""
    return np.zeros((height, (width + WORD - 1) // WORD), dtype=np.uint64)


@njit(cache=True)
def count(word: np.uint64) -> int:
    """How many bits are set. (The compiler knows this idiom: one instruction.)"""
    word -= (word >> _ONE) & np.uint64(0x5555555555555555)
    word = (word & np.uint64(0x3333333333333333)) + ((word >> np.uint64(2)) & np.uint64(0x3333333333333333))
    word = (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return int((word * np.uint64(0x0101010101010101)) >> np.uint64(56))


@njit(cache=True)
def lowest(word: np.uint64) -> int:
    """The number of the lowest bit that is set in a word that is not 0."""
    return count((word & (~word + _ONE)) - _ONE)  # type: ignore[no-any-return]


@njit(cache=True)
def highest(word: np.uint64) -> int:
    """The number of the highest bit that is set in a word that is not 0."""
    for step in (1, 2, 4, 8, 16, 32):
        word |= word >> np.uint64(step)
    return count(word) - 1  # type: ignore[no-any-return]


@njit(cache=True)
def between(start: int, end: int, k: int) -> np.uint64:
    """The bits of word `k` that stand for the columns from `start` to before `end`."""
    low, high = max(start - WORD * k, 0), min(end - WORD * k, WORD)
    if low >= high:
        return _ZERO
    return (_ALL >> np.uint64(WORD - (high - low))) << np.uint64(low)


@njit(cache=True)
def count_in(mask: Bits, y: int, start: int, end: int) -> int:
    """How many pixels of row `y` are set from column `start` to before `end`."""
    total = 0
    for k in range(start // WORD, words(end)):
        total += count(mask[y, k] & between(start, end, k))
    return total


# The loops over the pixels of a word run on vectors when their number is a constant; hence the two calls of each.


@njit(cache=True, inline="always")
def word_at_least(values: Bytes, y: int, x: int, number: int, least: np.uint8) -> np.uint64:
    """A word of the mask of the values that have this level: those of row `y` from column `x` on."""
    word = _ZERO
    for j in range(number):
        word |= np.uint64(values[y, x + j] >= least) << np.uint64(j)
    return word


@njit(cache=True, inline="always")
def _spread_word(word: np.uint64, out: Bytes, y: int, x: int, number: int) -> None:
    for j in range(number):
        out[y, x + j] = np.uint8(255) * np.uint8((word >> np.uint64(j)) & _ONE)


@njit(cache=True)
def at_least(values: Bytes, level: int) -> Bits:
    """The mask [H, N] of the pixels of [H, W] that have this level."""
    height, width = values.shape
    mask = np.empty((height, words(width)), dtype=np.uint64)
    least = np.uint8(level)
    for y in range(height):
        for k in range(width // WORD):
            mask[y, k] = word_at_least(values, y, WORD * k, WORD, least)
        if width % WORD:
            mask[y, -1] = word_at_least(values, y, width - width % WORD, width % WORD, least)
    return mask


@njit(cache=True)
def spread_row(mask: Bits, y: int, out: Bytes, row: int, width: int) -> None:
    """Row `y` of a mask as bytes of 0 or 255, into a row of [., W]."""
    for k in range(width // WORD):
        _spread_word(mask[y, k], out, row, WORD * k, WORD)
    if width % WORD:
        _spread_word(mask[y, width // WORD], out, row, width - width % WORD, width % WORD)


@njit(cache=True)
def spread(mask: Bits, width: int) -> Bytes:
    """A mask as bytes of 0 or 255, [H, W]."""
    out = np.empty((len(mask), width), dtype=np.uint8)
    for y in range(len(mask)):
        spread_row(mask, y, out, y, width)
    return out


@njit(cache=True)
def inverse(mask: Bits, width: int) -> Bits:
    """The other pixels."""
    out = ~mask
    last = mask.shape[1] - 1
    inside = between(0, width, last)
    for y in range(len(mask)):
        out[y, last] &= inside
    return out


@njit(cache=True)
def to_right(mask: Bits, y: int, k: int) -> np.uint64:
    """Word `k` of row `y` when it is moved to the right by one pixel."""
    return (mask[y, k] << _ONE) | (mask[y, k - 1] >> _LAST if k > 0 else _ZERO)  # type: ignore[no-any-return]


@njit(cache=True)
def to_left(mask: Bits, y: int, k: int) -> np.uint64:
    """Word `k` of row `y` when it is moved to the left by one pixel."""
    after = mask[y, k + 1] << _LAST if k + 1 < mask.shape[1] else _ZERO
    return (mask[y, k] >> _ONE) | after  # type: ignore[no-any-return]


@njit(cache=True)
def beside(mask: Bits) -> Bits:
    """The pixels with some of their four neighbours set. (Those from W on are not cleared.)"""
    height, number = mask.shape
    out = np.empty_like(mask)
    for y in range(height):
        for k in range(number):
            out[y, k] = to_right(mask, y, k) | to_left(mask, y, k)
        if y > 0:
            for k in range(number):
                out[y, k] |= mask[y - 1, k]
                out[y - 1, k] |= mask[y, k]
    return out


@njit(cache=True)
def mostly(mask: Bits, width: int) -> Bits:
    """The pixels of which at least 5 of the 9 around are set: the median of each neighbourhood.

    The outermost pixels are cleared.
    """
    height, number = mask.shape
    out = np.zeros_like(mask)
    # How many pixels are set of three above each other, as two binary digits.
    ones, twos = np.empty((1, number), dtype=np.uint64), np.empty((1, number), dtype=np.uint64)
    for y in range(1, height - 1):
        for k in range(number):
            a, b, c = mask[y - 1, k], mask[y, k], mask[y + 1, k]
            ones[0, k] = a ^ b ^ c
            twos[0, k] = (a & b) | (c & (a ^ b))
        for k in range(number):
            a, b, c = to_right(ones, 0, k), ones[0, k], to_left(ones, 0, k)
            odd = a ^ b ^ c
            # The number is odd + 2 * (how many of these four are set).
            p, q, r, s = (a & b) | (c & (a ^ b)), to_right(twos, 0, k), twos[0, k], to_left(twos, 0, k)
            two = ((p | q) & (r | s)) | (p & q) | (r & s)
            three = (p & q & (r | s)) | (r & s & (p | q))
            out[y, k] = three | (two & odd)
        out[y, 0] &= ~_ONE
        out[y, number - 1] &= between(0, width - 1, number - 1)
    return out


@njit(cache=True)
def _widen(mask: Bits, y: int, reach: int, out: Bits) -> None:
    """A row with `reach` pixels more on both sides of what is set, into [N]; bits from W on are not cleared."""
    number = mask.shape[1]
    for k in range(number):
        out[k] = mask[y, k]
    done = 0
    while done < reach:
        # What grew by so many leaves no gap when it is moved by one more, even where one side of it is cut off.
        step = min(done + 1, reach - done, WORD - 1)
        by, rest = np.uint64(step), np.uint64(WORD - step)
        before = _ZERO
        for k in range(number):
            here = out[k]
            after = out[k + 1] if k + 1 < number else _ZERO
            out[k] = here | (here << by) | (before >> rest) | (here >> by) | (after << rest)
            before = here
        done += step


@njit(cache=True)
def dilate(mask: Bits, width: int, reaches: Widths) -> Bits:
    """The pixels within a window around some that are set.

    Args:
        mask: [H, N].
        width: W.
        reaches: [2 R + 1] how far the window reaches to both sides in each of its rows, from R above to R below;
            symmetric, and growing towards the middle.
    """
    height, number = mask.shape
    radius = len(reaches) // 2
    out = np.zeros_like(mask)
    wide = np.empty(number, dtype=np.uint64)
    for y in range(height):
        some = _ZERO
        for k in range(number):
            some |= mask[y, k]
        if some == _ZERO:
            continue
        for d in range(radius + 1):
            if d == 0 or reaches[d] != reaches[d - 1]:
                _widen(mask, y, reaches[d], wide)
            up, down = y - radius + d, y + radius - d
            if up >= 0:
                for k in range(number):
                    out[up, k] |= wide[k]
            if down < height and down != up:
                for k in range(number):
                    out[down, k] |= wide[k]
    for y in range(height):
        out[y, number - 1] &= between(0, width, number - 1)
    return out


@njit(cache=True)
def erode(mask: Bits, width: int, reaches: Widths) -> Bits:
    """The pixels whose whole window (as for `dilate`) is set, or lies outside."""
    return inverse(dilate(inverse(mask, width), width, reaches), width)  # type: ignore[no-any-return]


@njit(cache=True)
def runs_of(mask: Bits, width: int) -> Runs:
    """The runs [R, 3] (ROW, START, END) of pixels that are set, row by row."""
    height, number = mask.shape
    runs = np.empty((4 * height, 3), dtype=np.int32)
    found = 0
    for y in range(height):
        last = _ZERO
        inside = False
        for k in range(number):
            word = mask[y, k]
            turns = word ^ ((word << _ONE) | (last >> _LAST))  # where a pixel is not as the one before
            last = word
            while turns != _ZERO:
                x = WORD * k + lowest(turns)
                turns &= turns - _ONE
                if inside:
                    runs[found, END] = x
                    found += 1
                else:
                    if found == len(runs):
                        runs = np.concatenate((runs, np.empty_like(runs)))
                    runs[found, ROW] = y
                    runs[found, START] = x
                inside = not inside
        if inside:
            runs[found, END] = width
            found += 1
    return runs[:found]


@njit(cache=True)
def set_runs(mask: Bits, runs: Runs) -> None:
    """Set the pixels of these runs, in place."""
    for n in range(len(runs)):
        start, end = runs[n, START], runs[n, END]
        for k in range(start // WORD, words(end)):
            mask[runs[n, ROW], k] |= between(start, end, k)


@njit(cache=True)
def clear_runs(mask: Bits, runs: Runs) -> None:
    """Clear the pixels of these runs, in place."""
    for n in range(len(runs)):
        start, end = runs[n, START], runs[n, END]
        for k in range(start // WORD, words(end)):
            mask[runs[n, ROW], k] &= ~between(start, end, k)
