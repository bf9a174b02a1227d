# SPDX-License-Identifier: Apache-2.0
"""Flesh figure -> triangle meshes, for markers, pictures and exports.

A part is the convex hull of spheres, so its surface has a closed form: in direction d the outermost point is
`c_s + r_s d` of the sphere s with the largest `c_s . d + r_s` (its support function). Carrying the vertices of a
subdivided icosahedron there keeps the icosahedron's faces and gives exact normals: d itself.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from limbloc_ros.core.pose import Array, Flesh

Faces = NDArray[np.int64]


@lru_cache(maxsize=8)
def icosphere(subdivisions: int = 2) -> tuple[Array, Faces]:
    """Directions that cover the unit sphere evenly, and the triangles between them.

    Args:
        subdivisions: how often each triangle of an icosahedron is split into four (0 to 6).

    Returns:
        unit vectors [V, 3] with V = 10 * 4**subdivisions + 2, and faces [T, 3] with T = 20 * 4**subdivisions,
        anticlockwise seen from outside. Both are shared and read-only.

    Raises:
        ValueError: `subdivisions` is out of its range.
    """
    if not 0 <= subdivisions <= 6:
        raise ValueError(f"subdivisions: expected 0 to 6, got {subdivisions}")
    g = (1.0 + 5.0**0.5) / 2.0
    corners = [(-1, g, 0), (1, g, 0), (-1, -g, 0), (1, -g, 0), (0, -1, g), (0, 1, g)]
    corners += [(0, -1, -g), (0, 1, -g), (g, 0, -1), (g, 0, 1), (-g, 0, -1), (-g, 0, 1)]
    vertices = np.array(corners, dtype=np.float64)
    triangles = (
        "0 11 5  0 5 1  0 1 7  0 7 10  0 10 11  1 5 9  5 11 4  11 10 2  10 7 6  7 1 8 "
        "3 9 4  3 4 2  3 2 6  3 6 8  3 8 9  4 9 5  2 4 11  6 2 10  8 6 7  9 8 1"
    )
    faces = np.array(triangles.split(), dtype=np.int64).reshape(-1, 3)
    vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    for _ in range(subdivisions):
        edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        unique, inverse = np.unique(edges, axis=0, return_inverse=True)
        middle = vertices[unique].sum(axis=1)
        middle /= np.linalg.norm(middle, axis=1, keepdims=True)
        ab, bc, ca = (inverse.reshape(-1, 3) + len(vertices)).T
        a, b, c = faces.T
        vertices = np.concatenate([vertices, middle])
        faces = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], axis=1).reshape(-1, 3)
    vertices.setflags(write=False)
    faces.setflags(write=False)
    return vertices, faces


def support_points(centres: ArrayLike, radii: ArrayLike, directions: ArrayLike) -> Array:
    """The points of a convex hull of spheres that lie furthest in the given directions.

    Args:
        centres: [S, 3] sphere centres, m.
        radii: [S] m.
        directions: [V, 3] unit vectors.

    Returns:
        [V, 3] points on the hull, m; the hull's outward normal there is the direction.
    """
    centres, radii = np.asarray(centres, dtype=np.float64), np.asarray(radii, dtype=np.float64)
    directions = np.asarray(directions, dtype=np.float64)
    outermost = np.argmax(directions @ centres.T + radii, axis=1)
    return np.asarray(centres[outermost] + radii[outermost, None] * directions)


def flesh_mesh(flesh: Flesh, subdivisions: int = 2) -> list[tuple[Array, Faces]]:
    """One closed triangle mesh per part of the flesh figure.

    Args:
        flesh: the figure, in the world, m.
        subdivisions: of the icosahedron; 2 gives 162 vertices and 320 triangles per part.

    Returns:
        (vertices [V, 3] m, faces [T, 3]) in the order of `flesh.parts`. Every vertex lies on the part's surface; its
        outward unit normal is `icosphere(subdivisions)[0]`, the same for all parts. Faces are anticlockwise seen
        from outside; those between two spheres are long, those within one are small, some may have no area.
    """
    directions, faces = icosphere(subdivisions)
    return [
        (support_points(flesh.centres[np.unique(part)], flesh.radii[np.unique(part)], directions), faces)
        for part in flesh.parts
    ]
