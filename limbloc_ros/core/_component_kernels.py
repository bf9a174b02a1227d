# SPDX-License-Identifier: Apache-2.0
"""Numba kernels that find the connected parts of a hull and take it apart; `hull` documents, these trust it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from limbloc_ros.core._union_kernels import join, root


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def label_components(sdf: Any, limit: Any) -> tuple[Any, Any, Any]:
    """6-connected components of the cells below a limit (of the grid's type), put together from runs of cells along the
    last axis.

    Returns int32 labels (0 = not below it) in the order of their first cells, the cell count of each label, and the box
    of each, int64 [labels, 2, 3]: lowest and highest (exclusive) indices.
    """
    nx, ny, nz = sdf.shape
    runs = np.empty((nx * ny * ((nz + 1) // 2), 2), np.int32)  # first and last (exclusive) cell
    parent = np.empty(len(runs), np.int32)
    start = np.empty(nx * ny + 1, np.int64)  # the first run of each row
    count = 0
    for row in range(nx * ny):
        start[row] = count
        line = sdf[row // ny, row % ny]
        some = False
        for k in range(nz):
            some |= line[k] < limit
        k = 0 if some else nz  # most rows are empty
        while k < nz:
            if not line[k] < limit:
                k += 1
                continue
            runs[count, 0] = k
            while k < nz and line[k] < limit:
                k += 1
            runs[count, 1] = k
            parent[count] = count
            count += 1
        if row % ny > 0:
            join_runs(runs, parent, start[row - 1], start[row], start[row], count)
        if row >= ny:
            join_runs(runs, parent, start[row - ny], start[row - ny + 1], start[row], count)
    start[nx * ny] = count
    number = np.empty(count, np.int32)  # of each run
    largest = 0
    for n in range(count):
        first = root(parent, n)
        if first == n:
            largest += 1
            number[n] = largest
        number[n] = number[first]
    labels = np.zeros(sdf.shape, np.int32)
    sizes = np.zeros(largest + 1, np.int64)
    boxes = np.zeros((largest + 1, 2, 3), np.int64)
    boxes[:, 0] = max(nx, ny, nz)
    for row in range(nx * ny):
        i, j = row // ny, row % ny
        for n in range(start[row], start[row + 1]):
            k, end, label = runs[n, 0], runs[n, 1], number[n]
            labels[i, j, k:end] = label
            sizes[label] += end - k
            low, high = boxes[label, 0], boxes[label, 1]
            low[0], low[1], low[2] = min(low[0], i), min(low[1], j), min(low[2], k)
            high[0], high[1], high[2] = max(high[0], i + 1), max(high[1], j + 1), max(high[2], end)
    return labels, sizes, boxes


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def join_runs(runs: Any, parent: Any, first: int, end: int, other: int, other_end: int) -> None:
    """Join those of two rows of runs that lie beside each other."""
    while first < end and other < other_end:
        if runs[first, 0] < runs[other, 1] and runs[other, 0] < runs[first, 1]:
            join(parent, first, other)
        if runs[first, 1] < runs[other, 1]:
            first += 1
        else:
            other += 1


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def spread(cells: Any, step: int, reach: int, out: Any) -> None:
    """Let `out` [N] be 1 where one of the cells [N] is that lies 0 to `reach` steps away."""
    for n in range(len(cells)):
        out[n] = cells[n]
    for way in range(step, min(step * reach + 1, len(cells)), step):
        before, behind = cells[way:], out[way:]
        for n in range(len(before)):
            out[n] |= before[n]
        for n in range(len(behind)):
            behind[n] |= cells[n]


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def grow_part(part: Any, reach: int) -> Any:
    """The cells, 1, of a grid of 0 and 1 that lie within `reach` of one that is 1, along all axes; uint8.

    Whole planes are moved at once, which is vector code; their rows have room at the end for what leaves them.
    """
    nx, ny, nz = part.shape
    stride = nz + reach
    plane, along, across = np.zeros((3, ny * stride), np.uint8)
    planes = np.zeros((nx, ny * stride), np.uint8)
    for i in range(nx):
        some = False
        for j in range(ny):
            row, cells = part[i, j], plane[j * stride : j * stride + nz]
            for k in range(nz):
                cells[k] = row[k]
                some |= row[k] != 0
        if not some:
            continue
        spread(plane, 1, reach, along)
        spread(along, stride, reach, across)
        for other in range(max(i - reach, 0), min(i + reach + 1, nx)):
            grown = planes[other]
            for n in range(len(grown)):
                grown[n] |= across[n]
    out = np.empty(part.shape, np.uint8)
    for i in range(nx):
        for j in range(ny):
            row, cells = out[i, j], planes[i, j * stride : j * stride + nz]
            for k in range(nz):
                row[k] = cells[k]
    return out


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def parts_and_shell(sdf: Any, limit: Any, labels: Any, boxes: Any, keep: Any, reach: int) -> tuple[Any, Any]:
    """The cells of a grid below a limit that belong to some of its parts (`keep` [K], labels and boxes are those of
    `label_components`), or to none but lie within `reach` of one of these.

    Returns them, 1 in a grid of 0, uint8, cropped to the smallest box around them and one cell more on every side, and
    the box's lowest indices. The grid's border must not be below the limit.
    """
    low, high = boxes[keep[0], 0].copy(), boxes[keep[0], 1].copy()
    for label in keep[1:]:
        low, high = np.minimum(low, boxes[label, 0]), np.maximum(high, boxes[label, 1])
    for axis in range(3):
        low[axis] = max(low[axis] - reach - 1, 0)
        high[axis] = min(high[axis] + reach + 1, labels.shape[axis])
    part = np.zeros((high[0] - low[0], high[1] - low[1], high[2] - low[2]), np.uint8)
    for i in range(part.shape[0]):
        for j in range(part.shape[1]):
            # Rows of the whole grid, not of a part of it: the compiler knows that their cells follow each other.
            label_row, part_row = labels[low[0] + i, low[1] + j, low[2] : high[2]], part[i, j]
            for label in keep:
                for k in range(len(part_row)):
                    part_row[k] |= np.uint8(label_row[k] == label)
    near = grow_part(part, reach)
    first = np.array(part.shape)
    last = np.zeros(3, np.int64)
    for i in range(part.shape[0]):
        for j in range(part.shape[1]):
            row, part_row = near[i, j], part[i, j]
            label_row = labels[low[0] + i, low[1] + j, low[2] : high[2]]
            sdf_row = sdf[low[0] + i, low[1] + j, low[2] : high[2]]
            some = np.uint8(0)
            for k in range(len(row)):
                row[k] &= np.uint8(sdf_row[k] < limit) & (np.uint8(label_row[k] == 0) | part_row[k])
                some |= row[k]
            if some:
                begin, end = 0, len(row)
                while not row[begin]:
                    begin += 1
                while not row[end - 1]:
                    end -= 1
                first[0], first[1], first[2] = min(first[0], i), min(first[1], j), min(first[2], begin)
                last[0], last[1], last[2] = max(last[0], i + 1), max(last[1], j + 1), max(last[2], end)
    first -= 1
    cropped = np.empty((last[0] + 1 - first[0], last[1] + 1 - first[1], last[2] + 1 - first[2]), np.uint8)
    for i in range(cropped.shape[0]):
        for j in range(cropped.shape[1]):
            row, cells = cropped[i, j], near[first[0] + i, first[1] + j, first[2] : last[2] + 1]
            for k in range(len(row)):
                row[k] = cells[k]
    return cropped, low + first


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def copy_where(grid: Any, corner: Any, kept: Any, otherwise: Any) -> Any:
    """The cells of a grid from `corner` on that are kept (uint8 [X, Y, Z]), and elsewhere another number (of its
    type)."""
    out = np.empty(kept.shape, grid.dtype)
    for i in range(kept.shape[0]):
        for j in range(kept.shape[1]):
            row, stays, new = grid[corner[0] + i, corner[1] + j, corner[2] :], kept[i, j], out[i, j]
            for k in range(kept.shape[2]):
                new[k] = row[k] if stays[k] else otherwise
    return out


@njit(cache=True, nogil=True)
def inside_cells(sdf: Any, most: int) -> tuple[Any, Any, int]:
    """Some of the cells below 0, and what their mean needs.

    Returns int64 [M, 3] every so-many-th of them in the order of the grid, all of them or `most` to 2 `most`; the sum
    of all of them, int64 [3]; how many there are.
    """
    count = 0
    total = np.zeros(3, np.int64)
    for i in range(sdf.shape[0]):
        for j in range(sdf.shape[1]):
            line = sdf[i, j]
            here: Any = 0
            for k in range(len(line)):
                if line[k] < 0.0:
                    here += 1
                    total[2] += k
            count += here
            total[0] += here * i
            total[1] += here * j
    every = max(1, count // most)
    cells = np.empty(((count + every - 1) // every, 3), np.int64)
    n = 0
    for i in range(sdf.shape[0]):
        for j in range(sdf.shape[1]):
            line = sdf[i, j]
            for k in range(len(line)):
                if line[k] < 0.0:
                    if n % every == 0:
                        at = cells[n // every]
                        at[0], at[1], at[2] = i, j, k
                    n += 1
    return cells, total, count
