# SPDX-License-Identifier: Apache-2.0
"""Surface points, normals and curvature against spheres, capsules, boxes and a plain scipy reference."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from limbloc_ros.core import _surface_kernels as kernels
from limbloc_ros.core.errors import InputError
from limbloc_ros.core.hull import Hull
from limbloc_ros.core.surface import curvature_variability, extract_surface

VOXEL = 0.02


def hull_of(distance, low, high, voxel=VOXEL, band=0.06):
    """A hull from an analytic signed distance function over the box low..high."""
    first = np.floor(np.asarray(low) / voxel).astype(int)
    last = np.ceil(np.asarray(high) / voxel).astype(int)
    axes = [(np.arange(a, b) + 0.5) * voxel for a, b in zip(first, last, strict=True)]
    p = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    sdf = np.minimum(distance(p), band).astype(np.float32)
    return Hull(voxel, tuple(int(i) for i in first), sdf, band, (), {})


def sphere(centre, radius):
    return lambda p: np.linalg.norm(p - np.asarray(centre), axis=-1) - radius


def capsule(a, b, radius):
    a, b = np.asarray(a, float), np.asarray(b, float)

    def distance(p):
        t = np.clip(((p - a) @ (b - a)) / ((b - a) @ (b - a)), 0, 1)
        return np.linalg.norm(p - a - t[..., None] * (b - a), axis=-1) - radius

    return distance


def box(centre, half):
    def distance(p):
        q = np.abs(p - np.asarray(centre)) - np.asarray(half)
        return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(-1), 0)

    return distance


CENTRE = np.array([0.31, -0.17, 1.04])


def test_points_and_normals_of_a_sphere():
    surface = extract_surface(hull_of(sphere(CENTRE, 0.15), CENTRE - 0.25, CENTRE + 0.25))
    outward = surface.points - CENTRE
    radius = np.linalg.norm(outward, axis=1)
    assert np.abs(radius - 0.15).max() < 0.05 * VOXEL
    angle = np.arccos(np.clip((outward / radius[:, None] * surface.normals).sum(1), -1, 1))
    assert np.degrees(angle).max() < 1.0
    assert np.abs(np.linalg.norm(surface.normals, axis=1) - 1).max() < 1e-12


def test_points_of_a_capsule_lie_on_it_and_the_poles_are_covered():
    a, b = [0, 0, 0.3], [0.1, 0.2, 0.8]
    distance = capsule(a, b, 0.05)
    surface = extract_surface(hull_of(distance, [-0.2, -0.2, 0.1], [0.3, 0.4, 1.0]))
    assert np.abs(distance(surface.points)).max() < 0.1 * VOXEL
    assert surface.points[:, 2].max() == pytest.approx(0.85, abs=VOXEL)


def test_surface_voxels_are_the_inside_ones_with_an_open_face():
    hull = hull_of(capsule([0, 0, 0], [0.2, 0.1, 0.3], 0.07), [-0.2] * 3, [0.5] * 3)
    inside = hull.sdf < 0
    expected = np.argwhere(inside & ~ndimage.binary_erosion(inside, ndimage.generate_binary_structure(3, 1)))
    surface = extract_surface(hull)
    assert np.array_equal(surface.indices - np.array(hull.index_min), expected)
    assert np.array_equal(surface.centres, (surface.indices + 0.5) * VOXEL)


@pytest.mark.parametrize("volume", ["sdf", "occupancy"])
def test_normals_equal_the_papers_sobel_filter_over_the_whole_volume(volume):
    hull = hull_of(box(CENTRE, [0.1, 0.13, 0.2]), CENTRE - 0.3, CENTRE + 0.3)
    surface = extract_surface(hull, volume=volume)
    plane = np.array([[1, 2, 1], [2, 4, 2], [1, 2, 1]], float)  # eq. 1: S1; S2 = 0; S3 = -S1
    S = np.stack([plane, 0 * plane, -plane])  # ndimage.convolve flips it: a rise along the first axis is positive
    field = hull.sdf.astype(float) if volume == "sdf" else (hull.sdf >= 0).astype(float)
    gradient = np.stack(
        [ndimage.convolve(field, np.moveaxis(S, 0, axis), mode="nearest") for axis in range(3)], axis=-1
    )
    i, j, k = (surface.indices - np.array(hull.index_min)).T
    expected = gradient[i, j, k] / np.linalg.norm(gradient[i, j, k], axis=1, keepdims=True)
    assert np.abs(surface.normals - expected).max() < 1e-5


def test_curvature_is_zero_on_a_plane_and_high_on_edges():
    surface = extract_surface(hull_of(box(CENTRE, [0.2, 0.2, 0.2]), CENTRE - 0.3, CENTRE + 0.3))
    q = np.sort(np.abs(surface.points - CENTRE), axis=1)
    flat = q[:, 1] < 0.2 - 4 * VOXEL  # in the middle of a face
    edge = (q[:, 1] > 0.2 - VOXEL) & (q[:, 0] < 0.1)
    assert flat.sum() > 500 and edge.sum() > 50
    assert surface.curvature[flat].max() < 1e-3
    assert surface.curvature[edge].min() > np.radians(15)


@pytest.mark.parametrize("radius", [0.1, 0.2])
def test_curvature_of_a_sphere_is_the_mean_angle_to_the_neighbours(radius):
    surface = extract_surface(hull_of(sphere(CENTRE, radius), CENTRE - radius - 0.1, CENTRE + radius + 0.1))
    there = surface.neighbours >= 0
    chord = np.linalg.norm(surface.points[surface.neighbours] - surface.points[:, None], axis=2)
    angle = 2 * np.arcsin(np.minimum(chord / (2 * radius), 1))
    expected = (angle * there).sum(1) / there.sum(1)
    assert np.abs(surface.curvature - expected).max() < np.radians(0.7)


def test_neighbours_are_mutual_and_one_voxel_away():
    surface = extract_surface(hull_of(sphere(CENTRE, 0.12), CENTRE - 0.2, CENTRE + 0.2))
    rows, columns = np.nonzero(surface.neighbours >= 0)
    others = surface.neighbours[rows, columns]
    assert (np.abs(surface.indices[rows] - surface.indices[others]).max(axis=1) == 1).all()
    pairs = set(zip(rows.tolist(), others.tolist(), strict=True))
    assert all((b, a) in pairs for a, b in pairs)
    distance = np.abs(surface.indices[:, None] - surface.indices[None]).max(axis=2)
    assert len(pairs) == (distance == 1).sum()


def test_the_surface_has_neither_specks_nor_the_walls_of_cavities():
    def distance(p):
        hollow = np.maximum(sphere(CENTRE, 0.2)(p), -sphere(CENTRE, 0.1)(p))
        return np.minimum(hollow, sphere(CENTRE + np.array([0.4, 0, 0]), 0.03)(p))

    surface = extract_surface(hull_of(distance, CENTRE - 0.3, CENTRE + 0.5))
    assert np.abs(np.linalg.norm(surface.points - CENTRE, axis=1) - 0.2).max() < 0.1 * VOXEL
    assert surface.neighbours.max() < len(surface)


def test_a_body_that_masks_cut_in_two_has_the_surface_of_both_pieces():
    up = np.array([0.0, 0.0, 1.0])
    pieces = capsule(CENTRE - 0.3 * up, CENTRE - 0.08 * up, 0.06), sphere(CENTRE + 0.08 * up, 0.08)
    surface = extract_surface(hull_of(lambda p: np.minimum(*(d(p) for d in pieces)), CENTRE - 0.4, CENTRE + 0.4))
    for distance in pieces:
        alone = extract_surface(hull_of(distance, CENTRE - 0.4, CENTRE + 0.4))
        kept = {tuple(index) for index in surface.indices}
        assert sum(tuple(index) in kept for index in alone.indices) > 0.9 * len(alone)


def test_thin_sheets_and_hulls_cut_by_the_grid_keep_unit_normals():
    sdf = np.full((9, 9, 9), 0.06, np.float32)
    sdf[2:7, 2:7, 4] = -0.005  # one voxel thick: the gradient across it vanishes
    sheet = extract_surface(Hull(VOXEL, (0, 0, 0), sdf, 0.06, (), {}))
    assert np.abs(np.linalg.norm(sheet.normals, axis=1) - 1).max() < 1e-9
    middle = np.flatnonzero((sheet.indices == [4, 4, 4]).all(1))[0]
    assert sheet.normals[middle].tolist() == [0, 0, 1]

    cut = extract_surface(hull_of(sphere(CENTRE, 0.3), CENTRE - 0.1, CENTRE + 0.1))  # wholly inside: the grid's faces
    assert len(cut) > 0 and np.isfinite(cut.points).all() and np.isfinite(cut.normals).all()


def test_variability_is_high_where_curvature_changes():
    surface = extract_surface(hull_of(box(CENTRE, [0.2, 0.2, 0.2]), CENTRE - 0.3, CENTRE + 0.3))
    mean, deviation = curvature_variability(surface, 0.06)
    q = np.sort(np.abs(surface.points - CENTRE), axis=1)
    flat = q[:, 1] < 0.05
    assert deviation[flat].max() < 1e-3
    assert deviation[(q[:, 1] > 0.18)].min() > 0.08
    one = int(np.argmax(deviation))
    patch = np.linalg.norm(surface.points - surface.points[one], axis=1) <= 0.06  # convex: nothing to jump over
    assert mean[one] == pytest.approx(surface.curvature[patch].mean(), rel=0.05)


def test_empty_hull_is_refused():
    with pytest.raises(InputError, match="got an empty one"):
        extract_surface(Hull(VOXEL, (0, 0, 0), np.full((4, 4, 4), 0.06, np.float32), 0.06, (), {}))


@pytest.mark.parametrize("density", [0.05, 0.2, 0.5])
def test_pieces_are_those_that_scipy_finds(density):
    cells = np.random.default_rng(5).random((9, 14, 11)) < density
    local = np.argwhere(cells).astype(np.int32)
    number = np.full(cells.shape, -1, np.int32)
    number[cells] = np.arange(len(local))
    piece = kernels.label_pieces(local, number, kernels.OFFSETS)
    labels, count = ndimage.label(cells, np.ones((3, 3, 3)))
    assert count > 1 or density == 0.5
    np.testing.assert_array_equal(piece, labels[cells] - 1)  # both count in the order of the first cells
