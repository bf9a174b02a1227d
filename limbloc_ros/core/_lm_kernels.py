# SPDX-License-Identifier: Apache-2.0
"""Numba kernel of the minimiser: one damped step."""

from __future__ import annotations

import math
from typing import Any

from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def damped_step(matrix: Any, gradient: Any, damping: float) -> Any:
    """The step x [P] of (matrix + damping * diagonal) x = -gradient, by a Cholesky decomposition.

    Of the diagonal nothing counts as less than a millionth of its largest number, so that what nothing holds stays
    where it is. For 80 unknowns LAPACK by way of NumPy, with its copies and checks, takes twice as long.
    """
    n = len(gradient)
    lowest = 0.0
    for k in range(n):
        lowest = max(lowest, 1e-6 * matrix[k, k])
    lowest += 1e-12
    U = matrix.copy()  # its upper triangle becomes the factor: matrix = U' U
    x = -gradient
    for k in range(n):
        U[k, k] += damping * max(matrix[k, k], lowest)
    for k in range(n):
        # What nothing holds may have come out a little below zero, by rounding.
        pivot = math.sqrt(max(U[k, k], 1e-3 * damping * lowest))
        inverse = 1.0 / pivot
        U[k, k] = pivot
        for j in range(k + 1, n):
            U[k, j] *= inverse
        x[k] *= inverse  # U' y = -gradient, along with it
        for i in range(k + 1, n):
            f = U[k, i]
            if f != 0.0:
                x[i] -= f * x[k]
                for j in range(i, n):
                    U[i, j] -= f * U[k, j]
    for i in range(n - 1, -1, -1):
        x[i] /= U[i, i]
        for j in range(i):
            x[j] -= U[j, i] * x[i]
    return x
