# SPDX-License-Identifier: Apache-2.0
"""The hull's surface as triangles (surface nets), and as a PLY file."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core.hull import Hull
from limbloc_ros.core.pose import Array

Faces = NDArray[np.int64]


def hull_surface(hull: Hull) -> tuple[Array, Faces, Array]:
    """Vertices [V, 3] m, faces [T, 3] (anticlockwise from outside) and normals [V, 3], where the distance is zero.

    Every cell of 2 x 2 x 2 voxel centres that the surface crosses gets one vertex, the mean of the crossings on its
    edges; every lattice edge that the surface crosses gets one quad between the four cells around it.
    """
    phi = np.pad(hull.sdf.astype(np.float64), 1, constant_values=hull.band_m)
    origin = (np.asarray(hull.index_min) - 0.5) * hull.voxel_m  # centre of the padded array's first voxel
    inside = phi < 0
    cells = np.array(phi.shape) - 1
    total, count = np.zeros((*cells, 3)), np.zeros(cells)
    quads = []
    for axis in range(3):
        low = tuple(slice(None, -1) if a == axis else slice(None) for a in range(3))
        high = tuple(slice(1, None) if a == axis else slice(None) for a in range(3))
        at = np.argwhere(inside[low] != inside[high])
        start, end = phi[low][tuple(at.T)], phi[high][tuple(at.T)]
        crossing = at.astype(np.float64)
        crossing[:, axis] += start / (start - end)
        others = [a for a in range(3) if a != axis]
        around = []
        for step in ((0, 0), (-1, 0), (-1, -1), (0, -1)):
            cell = at.copy()
            cell[:, others] += step
            np.add.at(total, tuple(cell.T), crossing)
            np.add.at(count, tuple(cell.T), 1.0)
            around.append(np.ravel_multi_index(tuple(cell.T), tuple(cells)))
        quad = np.stack(around, axis=1)
        # The four cells run clockwise about +x and +z but, because of the order of `others`, not about +y.
        flip = (start < 0) != (axis == 1)
        quads.append(np.where(flip[:, None], quad, quad[:, ::-1]))
    used = np.flatnonzero(count)
    number = np.full(count.size, -1)
    number[used] = np.arange(len(used))
    vertices = origin + hull.voxel_m * (total.reshape(-1, 3)[used] / count.reshape(-1)[used, None])
    quad = number[np.concatenate(quads)]
    faces = np.concatenate([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]])
    return vertices, faces, vertex_normals(vertices, faces)


def vertex_normals(vertices: Array, faces: Faces) -> Array:
    """[V, 3] unit normals: the mean of the adjoining faces, weighted by area."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    normals = np.zeros_like(vertices)
    for i in range(3):
        np.add.at(normals, faces[:, i], np.cross(b - a, c - a))
    return np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30))


def ply_bytes(vertices: Array, faces: Faces, normals: Array, comment: str = "") -> bytes:
    """A binary PLY file of a triangle mesh, m, world axes (z up)."""
    head = [
        "ply",
        "format binary_little_endian 1.0",
        *([f"comment {comment}"] if comment else []),
        f"element vertex {len(vertices)}",
        *(f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    rows = np.empty(len(faces), dtype=[("count", "u1"), ("corner", "<i4", 3)])
    rows["count"], rows["corner"] = 3, faces
    body = np.concatenate([vertices, normals], axis=1).astype("<f4").tobytes() + rows.tobytes()
    return ("\n".join(head) + "\n").encode("ascii") + body
