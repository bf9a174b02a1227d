# SPDX-License-Identifier: Apache-2.0
"""Numba kernels that keep account of which numbered things belong together (union-find).

`parent` [N] leads from everything to an earlier thing of its group, and from the group's first one to itself.
"""

from __future__ import annotations

from typing import Any

from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def root(parent: Any, n: Any) -> Any:
    """The first thing of the group that n belongs to; the way there becomes shorter."""
    while parent[n] != n:
        parent[n] = parent[parent[n]]
        n = parent[n]
    return n


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def join(parent: Any, n: Any, other: Any) -> None:
    """The groups of both become one."""
    a, b = root(parent, n), root(parent, other)
    if a < b:
        parent[b] = a
    else:
        parent[a] = b
