# SPDX-License-Identifier: Apache-2.0
"""Triangle meshes of what the report shows: hull, stick figure, flesh figure, markers."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from limbloc_ros.core.flesh_mesh import flesh_mesh, icosphere, support_points
from limbloc_ros.core.hull import Hull
from limbloc_ros.core.pose import JOINT, JOINT_NAMES, STICK_BONES, Array, Flesh
from limbloc_ros.export.hull_surface import hull_surface
from limbloc_ros.export.stick_drawing import side_of

#: The person's own left, right and middle, from the Okabe-Ito palette that colour-blind people can tell apart.
SIDE_COLOURS = {"L": (0.0, 0.447, 0.698), "R": (0.835, 0.369, 0.0), "": (0.25, 0.27, 0.30)}


@dataclass(frozen=True)
class Mesh:
    """Triangles with what is needed to shade them.

    Attributes:
        vertices: [V, 3] m, in the world.
        faces: [T, 3] vertex indices, anticlockwise seen from outside.
        normals: [V, 3] outward unit vectors.
        colours: [V, 3] sRGB, 0 to 1.
        scalars: [V] any quantity that a layer may colour by.
    """

    vertices: Array
    faces: NDArray[np.int64]
    normals: Array
    colours: Array
    scalars: Array

    @staticmethod
    def of(
        vertices: Array, faces: NDArray[np.int64], normals: Array, colour: ArrayLike, scalars: ArrayLike = 0.0
    ) -> Mesh:
        """A mesh of one colour ([3]) or of one colour per vertex ([V, 3])."""
        n = len(vertices)
        colours = np.array(np.broadcast_to(np.asarray(colour, dtype=np.float64), (n, 3)))
        return Mesh(vertices, faces, normals, colours, np.array(np.broadcast_to(scalars, (n,)), dtype=np.float64))

    @staticmethod
    def join(meshes: Iterable[Mesh]) -> Mesh:
        """All meshes as one (an empty mesh when there is none)."""
        parts = list(meshes)
        empty = np.zeros((0, 3))
        offsets = np.cumsum([0, *(len(m.vertices) for m in parts)])
        return Mesh(
            np.concatenate([empty, *(m.vertices for m in parts)]),
            np.concatenate(
                [np.zeros((0, 3), dtype=np.int64), *(m.faces + o for m, o in zip(parts, offsets[:-1], strict=True))]
            ),
            np.concatenate([empty, *(m.normals for m in parts)]),
            np.concatenate([empty, *(m.colours for m in parts)]),
            np.concatenate([np.zeros(0), *(m.scalars for m in parts)]),
        )


def hull_mesh(hull: Hull, colour: ArrayLike = (0.62, 0.68, 0.75)) -> Mesh:
    """The hull's surface, where its signed distance is zero."""
    vertices, faces, normals = hull_surface(hull)
    return Mesh.of(vertices, faces, normals, colour)


def with_field(mesh: Mesh, points: Array, field: Array) -> Mesh:
    """The mesh with `field`, known at `points` [S, 3], as its scalars: the mean of the three nearest, by nearness."""
    known = np.isfinite(field)
    ranks = list(range(1, 1 + min(3, int(known.sum()))))
    distance, nearest = cKDTree(points[known]).query(mesh.vertices, k=ranks)
    weight = 1.0 / (np.asarray(distance) + 1e-4)
    scalars = (weight * field[known][nearest]).sum(axis=1) / weight.sum(axis=1)
    return Mesh(mesh.vertices, mesh.faces, mesh.normals, mesh.colours, scalars)


def capsule(a: ArrayLike, b: ArrayLike, radius_a: float, radius_b: float, colour: ArrayLike, detail: int = 2) -> Mesh:
    """A rod with round ends from `a` to `b` [3] m; a ball when both are the same point."""
    directions, faces = icosphere(detail)
    return Mesh.of(support_points(np.stack([a, b]), [radius_a, radius_b], directions), faces, directions, colour)


def stick_mesh(joints: Array, joint_radius_m: float = 0.021, bone_radius_m: float = 0.011) -> Mesh:
    """The stick figure: joints as spheres, bones as cylinders (paper section 2), coloured by the person's own side.

    Args:
        joints: [25, 3] m in the order of JOINT_NAMES; joints that are not finite are left out, and their bones.
    """
    seen: NDArray[np.bool_] = np.asarray(np.isfinite(joints).all(axis=1))
    parts = []
    for a, b in STICK_BONES:
        i, j = JOINT[a], JOINT[b]
        if seen[i] and seen[j]:
            parts.append(capsule(joints[i], joints[j], bone_radius_m, bone_radius_m, SIDE_COLOURS[side_of(b)]))
    for name, joint, here in zip(JOINT_NAMES, joints, seen, strict=True):
        if here:
            parts.append(capsule(joint, joint, joint_radius_m, joint_radius_m, SIDE_COLOURS[side_of(name)]))
    return Mesh.join(parts)


def flesh_figure_mesh(flesh: Flesh) -> Mesh:
    """The flesh figure, each part coloured by the person's own side in pale tones."""
    directions, _ = icosphere(3)
    parts = []
    for (vertices, faces), name in zip(flesh_mesh(flesh, 3), flesh.part_names, strict=True):
        pale = 0.45 + 0.55 * np.asarray(SIDE_COLOURS[side_of(name)])
        parts.append(Mesh.of(vertices, faces, directions, pale))
    return Mesh.join(parts)


def needles(points: Array, normals: Array, length_m: float = 0.05, radius_m: float = 0.004) -> Mesh:
    """Thin cones along normals, coloured by direction (x, y, z of the normal as red, green, blue)."""
    tips = points + length_m * normals
    return Mesh.join(
        capsule(p, q, radius_m, radius_m / 4, 0.5 + 0.45 * n, detail=1)
        for p, q, n in zip(points, tips, normals, strict=True)
    )


def balls(centres: Sequence[ArrayLike], radius_m: float, colour: ArrayLike) -> Mesh:
    """Balls of one size and colour."""
    return Mesh.join(capsule(c, c, radius_m, radius_m, colour, detail=3) for c in centres)
