# SPDX-License-Identifier: Apache-2.0
"""Numba kernels of the silhouettes; `silhouettes` documents and validates, these trust their caller."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

#: So many pixels of a row are measured together: two to four vector registers of integers.
CHUNK = 32
#: What is neither foreground nor background, for it is not in the image.
BESIDE = 2
#: Up to this distance the squares, also of four steps more, and their sums fit into 16 bits.
SHORT_PX = 178


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def bounds(mask: Any) -> tuple[int, int, int, int]:
    """First column and row, width and height of the smallest rectangle around what is not 0; all 0 if there is nothing.

    What `cv2.boundingRect` does, in vector code.
    """
    height, width = mask.shape
    columns = np.zeros(width, np.uint8)
    top, bottom = 0, 0
    for y in range(height):
        row = mask[y]
        some = np.uint8(0)
        for x in range(width):
            some = np.uint8(some | row[x])
        if some:
            top = y if bottom == 0 else top
            bottom = y + 1
            for x in range(width):
                columns[x] |= row[x]
    if bottom == 0:
        return 0, 0, 0, 0
    left, right = 0, width
    while columns[left] == 0:
        left += 1
    while columns[right - 1] == 0:
        right -= 1
    return left, top, right - left, bottom - top


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def without_lone_pixels(mask: Any, left: int, top: int, width: int, height: int) -> Any:
    """A rectangle of a mask, beside which all is 0: 1 where a pixel and one of its eight neighbours are not 0."""
    every = np.zeros((height + 2, width + 2), np.uint8)
    for y in range(height):
        row, copy = mask[top + y, left : left + width], every[y + 1, 1:]
        for x in range(width):
            copy[x] = row[x] != 0
    out = np.empty((height, width), np.uint8)
    for y in range(height):
        above, here, below, kept = every[y], every[y + 1], every[y + 2], out[y]
        for x in range(width):
            beside = above[x] | above[x + 1] | above[x + 2] | below[x] | below[x + 1] | below[x + 2]
            kept[x] = here[x + 1] & (beside | here[x] | here[x + 2])
    return out


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def widen(mask: Any) -> Any:
    """A mask of 0 and 1 with as many columns of BESIDE as make its width a multiple of CHUNK.

    Loops over rows, of so many times CHUNK pixels, become vector code without rests: twice to five times as fast for
    rows of a hundred pixels, which most are.
    """
    height, width = mask.shape
    out = np.full((height, (width + CHUNK - 1) // CHUNK * CHUNK), np.uint8(BESIDE))
    for y in range(height):
        row, wide = mask[y], out[y]
        for x in range(width):
            wide[x] = row[x]
    return out


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def column_distances(mask: Any, far: Any, out: Any) -> None:
    """To `out`, uint16: distance of every pixel to the nearest one of another kind in its column; `far` or more where
    there is none. The width is a multiple of CHUNK."""
    height, width = mask.shape
    one = np.uint16(1)
    out[0] = far
    for y in range(1, height):
        here, there, row, other = out[y], out[y - 1], mask[y], mask[y - 1]
        for at in range(0, width, CHUNK):
            for i in range(CHUNK):
                x = np.uint64(at) + np.uint64(i)  # unsigned: numba need not ask whether to count from the end
                here[x] = np.uint16(there[x] + one) if row[x] == other[x] else one
    for y in range(height - 2, -1, -1):
        here, there, row, other = out[y], out[y + 1], mask[y], mask[y + 1]
        for at in range(0, width, CHUNK):
            for i in range(CHUNK):
                x = np.uint64(at) + np.uint64(i)
                here[x] = min(here[x], np.uint16(there[x] + one) if row[x] == other[x] else one)


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def nearest_in_row(squares: Any, at: int, width: int, best: Any) -> None:
    """best[x] = min over k of squares[x + k] + k^2 for CHUNK pixels from `at` on.

    Asks k = 0, 1, 2, ... on both sides until none further away can be nearer, or the row ends. That are as many steps
    as the distance has pixels, but for many pixels at once: faster than the lower envelope of parabolas, one by one.
    """
    number = squares.dtype.type
    start = np.uint64(at)  # unsigned: numba need not ask whether to count from the end
    largest = number(0)
    for i in range(CHUNK):
        x = start + np.uint64(i)
        best[x] = squares[x]
        largest = max(largest, squares[x])
    k0 = np.uint64(1)
    while number(k0 * k0) < largest and k0 < np.uint64(width):
        largest = number(0)
        k1, k2, k3 = k0 + np.uint64(1), k0 + np.uint64(2), k0 + np.uint64(3)
        square0, square1, square2, square3 = number(k0 * k0), number(k1 * k1), number(k2 * k2), number(k3 * k3)
        for i in range(CHUNK):
            x = start + np.uint64(i)
            d = best[x]
            d = min(d, number(min(squares[x - k0], squares[x + k0]) + square0))
            d = min(d, number(min(squares[x - k1], squares[x + k1]) + square1))
            d = min(d, number(min(squares[x - k2], squares[x + k2]) + square2))
            d = min(d, number(min(squares[x - k3], squares[x + k3]) + square3))
            best[x] = d
            largest = max(largest, d)
        k0 += np.uint64(4)


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def signed_distance(mask: Any, most: int, deepest: int, numbers: Any, out: Any) -> bool:
    """To `out`: the distance of pixel centres to the nearest one of the other kind less 0.5; negative where mask is 1.

    Exact integer arithmetic in two passes, first along the columns, then along the rows (Saito and Toriwaki, 1994).
    Outside, what is `most` or further away is not told from `most`, inside `deepest`; returns whether nothing is that
    deep. The type of `numbers` must hold their squares and four steps more: up to SHORT_PX that are 16 bits, of which
    twice as many are measured in the same time.
    """
    height, width = mask.shape
    mask = widen(mask)
    columns = np.empty(mask.shape, np.uint16)  # image sides together have less than 65536 pixels
    column_distances(mask, np.uint16(height + width), columns)
    number = numbers.dtype.type
    pad = max(width, CHUNK) + 4  # the furthest that `nearest_in_row` looks beyond the row's ends
    end = pad + width
    beyond, within = number(most * most), number(deepest * deepest)
    size = pad + mask.shape[1] + pad
    inner = np.full(size, within, numbers.dtype)  # of foreground pixels; 0 where there is background
    outer = np.full(size, beyond, numbers.dtype)  # of background pixels; 0 where there is foreground
    best_inner = np.zeros_like(inner)
    best_outer = np.zeros_like(outer)
    shallow = True
    for y in range(height):
        row, column, inside, outside = mask[y], columns[y], inner[pad:], outer[pad:]
        for at in range(0, len(row), CHUNK):
            for i in range(CHUNK):
                k = np.uint64(at) + np.uint64(i)
                d = number(min(column[k], np.uint16(deepest)))
                inside[k] = number(0) if row[k] == 0 else number(d * d)
            for i in range(CHUNK):
                k = np.uint64(at) + np.uint64(i)
                d = number(min(column[k], np.uint16(most)))
                outside[k] = number(0) if row[k] == 1 else number(d * d)
        first, last = 0, width - 1
        while first < width and outside[first] == beyond:
            first += 1
        while last > first and outside[last] == beyond:
            last -= 1
        best_inner[pad:end] = 0
        best_outer[pad:end] = beyond
        for x in range(0, width, CHUNK):
            left = max(min(x, width - CHUNK), 0)
            if first - most < left + CHUNK and left < last + most:
                nearest_in_row(inner, pad + left, width, best_inner)
                nearest_in_row(outer, pad + left, width, best_outer)
        inside, outside, distance = best_inner[pad:end], best_outer[pad:end], out[y]
        deep = number(0)
        for x in range(width):
            d = np.sqrt(np.float32(inside[x] + outside[x])) - np.float32(0.5)  # one of them is 0
            distance[x] = -d if row[x] != 0 else d
        for x in range(width):
            deep = max(deep, inside[x])
        shallow &= deep < within
    return shallow
