# SPDX-License-Identifier: Apache-2.0
"""Compiled loops on masks of one bit per pixel: 64 pixels are worked on by one instruction.

Such a mask is uint64 [H, N], N = words(W): pixel x is bit x % 64 of word x // 64, and bits from W on are 0. Nothing
here knows what a mask shows.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic
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


# Between 64 values and their bits there is one instruction, or a few, for which the compiler does not take a loop.
# Hence these two in its own language; the pixels of a row must lie one behind the other.


@intrinsic
def _whole_word_at_least(typing_context: Any, values: Any, y: Any, x: Any, least: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind = ir.VectorType(context.get_value_type(signature.args[0].dtype), WORD)
        found = builder.load(_pointer(context, builder, signature.args[0], arguments[:3], kind), align=1)
        first = builder.insert_element(ir.Constant(kind, ir.Undefined), arguments[3], ir.IntType(32)(0))
        everywhere = ir.Constant(ir.VectorType(ir.IntType(32), WORD), None)
        level = builder.shuffle_vector(first, first, everywhere)
        compare = builder.fcmp_ordered if signature.args[3] in types.real_domain else builder.icmp_unsigned
        return builder.bitcast(compare(">=", found, level), ir.IntType(64))

    return types.uint64(values, types.intp, types.intp, values.dtype), generate


@intrinsic
def _spread_whole_word(typing_context: Any, word: Any, out: Any, y: Any, x: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind = ir.VectorType(ir.IntType(8), WORD)
        flags = builder.bitcast(arguments[0], ir.VectorType(ir.IntType(1), WORD))
        place = _pointer(context, builder, signature.args[1], arguments[1:], kind)
        builder.store(builder.sext(flags, kind), place, align=1)
        return context.get_dummy_value()

    return types.void(types.uint64, out, types.intp, types.intp), generate


def _pointer(context: Any, builder: Any, kind: Any, arguments: Any, wanted: Any) -> Any:
    """Where pixel (y, x) of an array begins; arguments: array, y, x."""
    array = context.make_array(kind)(context, builder, arguments[0])
    place = cgutils.get_item_pointer(context, builder, kind, array, list(arguments[1:]))
    return builder.bitcast(place, wanted.as_pointer())


@njit(cache=True, inline="always")
def word_at_least(values: Any, y: int, x: int, number: int, least: Any) -> np.uint64:
    """A word of the mask of the values that have this level: `number` of those of row `y` from column `x` on."""
    if number == WORD:
        return _whole_word_at_least(values, y, x, least)  # type: ignore[no-any-return]
    word = _ZERO
    for j in range(number):
        word |= np.uint64(values[y, x + j] >= least) << np.uint64(j)
    return word


@njit(cache=True, inline="always")
def _spread_word(word: np.uint64, out: Bytes, y: int, x: int, number: int) -> None:
    if number == WORD:
        _spread_whole_word(word, out, y, x)
        return
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


# What follows moves whole masks by some pixels. They are brought into one line of words for it, with an empty word
# behind each row and `margin` empty rows above and below: nothing flows from row to row, the loops need not know of
# rows, and so they run on vectors though a row has few words.


@njit(cache=True)
def _in_line(mask: Bits, margin: int) -> Bits:
    """A mask [H, N] as [1 + (H + 2 margin) (N + 1)]: word `k` of row `y` is at 1 + (margin + y) (N + 1) + k."""
    height, number = mask.shape
    line = np.zeros(1 + (height + 2 * margin) * (number + 1), dtype=np.uint64)
    rows = line[1 + margin * (number + 1) :]
    for y in range(height):
        for k in range(number):
            rows[y * (number + 1) + k] = mask[y, k]
    return line


@njit(cache=True)
def _in_rows(line: Bits, height: int, width: int) -> Bits:
    """What `_in_line` made a line of, with `line` beginning at its first row; bits from W on are cleared."""
    number = words(width)
    out = np.empty((height, number), dtype=np.uint64)
    for y in range(height):
        for k in range(number):
            out[y, k] = line[y * (number + 1) + k]
    inside = between(0, width, number - 1)
    for y in range(height):
        out[y, number - 1] &= inside
    return out


@njit(cache=True)
def _to_both_sides(line: Bits, by: int, out: Bits) -> None:
    """A line and what it becomes when it is moved by some pixels, fewer than WORD, to the right and to the left."""
    shift, rest = np.uint64(by), np.uint64(WORD - by)
    for i in range(1, line.size - 1):
        here = line[i]
        out[i] = here | (here << shift) | (line[i - 1] >> rest) | (here >> shift) | (line[i + 1] << rest)


@njit(cache=True)
def _either(a: Bits, b: Bits, out: Bits) -> None:
    for i in range(out.size):
        out[i] |= a[i] | b[i]


@njit(cache=True)
def beside(mask: Bits, width: int) -> Bits:
    """The pixels with some of their four neighbours set."""
    height, number = mask.shape
    pitch, size = number + 1, height * (number + 1)
    line = _in_line(mask, 1)
    out = np.zeros(size, dtype=np.uint64)
    here, before, after = line[pitch + 1 :], line[pitch:], line[pitch + 2 :]
    for i in range(size):
        out[i] = (here[i] << _ONE) | (before[i] >> _LAST)
    for i in range(size):
        out[i] |= (here[i] >> _ONE) | (after[i] << _LAST)
    _either(line[1 : size + 1], line[2 * pitch + 1 :], out)
    return _in_rows(out, height, width)  # type: ignore[no-any-return]


@njit(cache=True)
def mostly(mask: Bits, width: int) -> Bits:
    """The pixels of which at least 5 of the 9 around are set: the median of each neighbourhood.

    The outermost pixels are cleared.
    """
    height, number = mask.shape
    pitch, size = number + 1, height * (number + 1)
    line = _in_line(mask, 1)
    above, level, below = line[1:], line[pitch + 1 :], line[2 * pitch + 1 :]
    # How many pixels are set of three above each other, as two binary digits.
    ones, twos = np.zeros((2, size + 2), dtype=np.uint64)
    for i in range(size):
        ones[i + 1] = above[i] ^ level[i] ^ below[i]
    for i in range(size):
        twos[i + 1] = (above[i] & level[i]) | (below[i] & (above[i] ^ level[i]))
    out = np.empty(size, dtype=np.uint64)
    for i in range(size):
        a = (ones[i + 1] << _ONE) | (ones[i] >> _LAST)
        b = ones[i + 1]
        c = (ones[i + 1] >> _ONE) | (ones[i + 2] << _LAST)
        q = (twos[i + 1] << _ONE) | (twos[i] >> _LAST)
        r = twos[i + 1]
        s = (twos[i + 1] >> _ONE) | (twos[i + 2] << _LAST)
        odd = a ^ b ^ c
        # The number is odd + 2 * (how many of these four are set).
        p = (a & b) | (c & (a ^ b))
        two = ((p | q) & (r | s)) | (p & q) | (r & s)
        three = (p & q & (r | s)) | (r & s & (p | q))
        out[i] = three | (two & odd)
    found = _in_rows(out, height, width)
    for y in range(height):
        found[y, 0] &= ~_ONE
        found[y, number - 1] &= between(0, width - 1, number - 1)
    found[0] = _ZERO
    found[height - 1] = _ZERO
    return found  # type: ignore[no-any-return]


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
    pitch, size = number + 1, height * (number + 1)
    wide = _in_line(mask, radius + 1)
    wider = np.zeros_like(wide)
    out = np.zeros(size, dtype=np.uint64)
    done = 0
    for d in range(radius + 1):
        while done < reaches[d]:
            # What grew by so many leaves no gap when it is moved by one more, even where one side of it is cut off.
            step = min(done + 1, reaches[d] - done, WORD - 1)
            _to_both_sides(wide, step, wider)
            wide, wider = wider, wide
            for y in range(height):
                wide[(radius + 2 + y) * pitch] = _ZERO  # nor may anything flow on by the empty words in between
            wide[(radius + 1) * pitch] = _ZERO
            done += step
        up = 1 + (1 + d) * pitch
        down = 1 + (1 + 2 * radius - d) * pitch
        _either(wide[up : up + size], wide[down : down + size], out)
    return _in_rows(out, height, width)  # type: ignore[no-any-return]


@njit(cache=True)
def erode(mask: Bits, width: int, reaches: Widths) -> Bits:
    """The pixels whose whole window (as for `dilate`) is set, or lies outside."""
    return inverse(dilate(inverse(mask, width), width, reaches), width)  # type: ignore[no-any-return]


@njit(cache=True)
def runs_of(mask: Bits, width: int) -> Runs:
    """The runs [R, 3] (ROW, START, END) of pixels that are set, row by row."""
    height, number = mask.shape
    # Where runs start and end, in turn, with the row of each: no need to ask which of both it is.
    turns = np.empty((2, 8 * height + 2 * WORD), dtype=np.int32)
    found = 0
    for y in range(height):
        last = _ZERO
        for k in range(number):
            word = mask[y, k]
            bits = word ^ ((word << _ONE) | (last >> _LAST))  # where a pixel is not as the one before
            last = word
            if found + WORD >= turns.shape[1]:
                turns = np.concatenate((turns, np.empty_like(turns)), axis=1)
            while bits != _ZERO:
                turns[0, found], turns[1, found] = y, WORD * k + lowest(bits)
                bits &= bits - _ONE
                found += 1
        if found % 2:
            turns[0, found], turns[1, found] = y, width
            found += 1
    runs = np.empty((found // 2, 3), dtype=np.int32)
    for n in range(len(runs)):
        runs[n, ROW], runs[n, START], runs[n, END] = turns[0, 2 * n], turns[1, 2 * n], turns[1, 2 * n + 1]
    return runs


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
