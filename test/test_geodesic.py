# SPDX-License-Identifier: Apache-2.0
"""Geodesic distances against scipy's Dijkstra, and maxima on shapes whose tips are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import sparse
from scipy.sparse.csgraph import dijkstra

from limbloc_ros.core.errors import InputError
from limbloc_ros.core.geodesic import (
    centre_of_mass,
    extremities,
    geodesic_distances,
    geodesic_map,
    nearest_row,
    wide_maxima,
)
from limbloc_ros.core.hull import Hull
from limbloc_ros.core.surface import extract_surface

VOXEL = 0.02


def capsule(a, b, radius):
    a, b = np.asarray(a, float), np.asarray(b, float)

    def distance(p):
        t = np.clip(((p - a) @ (b - a)) / ((b - a) @ (b - a)), 0, 1)
        return np.linalg.norm(p - a - t[..., None] * (b - a), axis=-1) - radius

    return distance


def hull_of(parts, low, high):
    first = np.floor(np.asarray(low) / VOXEL).astype(int)
    axes = [(np.arange(a, int(np.ceil(b / VOXEL))) + 0.5) * VOXEL for a, b in zip(first, high, strict=True)]
    p = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    sdf = np.minimum(np.min([part(p) for part in parts], axis=0), 0.06).astype(np.float32)
    return Hull(VOXEL, tuple(int(i) for i in first), sdf, 0.06, (), {})


TIPS = np.array([[0, 0, 1.75], [0, 0.85, 1.3], [0, -0.85, 1.3], [0, 0.25, 0.05], [0, -0.25, 0.05]])


@pytest.fixture(scope="module")
def star():
    """A person of five capsules in T pose."""
    hull = hull_of(
        [
            capsule([0, 0, 0.9], [0, 0, 1.35], 0.13),
            capsule([0, 0, 1.35], [0, 0, 1.65], 0.09),
            capsule([0, 0, 1.3], [0, 0.8, 1.3], 0.05),
            capsule([0, 0, 1.3], [0, -0.8, 1.3], 0.05),
            capsule([0, 0.08, 0.9], [0, 0.25, 0.1], 0.06),
            capsule([0, -0.08, 0.9], [0, -0.25, 0.1], 0.06),
        ],
        [-0.2, -0.9, 0],
        [0.2, 0.9, 1.8],
    )
    return hull, extract_surface(hull)


def reference(surface, seeds):
    rows, columns = np.nonzero(surface.neighbours >= 0)
    others = surface.neighbours[rows, columns]
    cost = np.linalg.norm(surface.centres[rows] - surface.centres[others], axis=1)
    graph = sparse.csr_matrix((cost, (rows, others)), shape=(len(surface),) * 2)
    return dijkstra(graph, indices=seeds)


def test_distances_equal_scipys(star):
    _, surface = star
    seeds = [0, len(surface) // 2, len(surface) - 1]
    expected = reference(surface, seeds)
    for n, seed in enumerate(seeds):
        assert geodesic_distances(surface, [seed]) == pytest.approx(expected[n], abs=1e-9)
    assert geodesic_distances(surface, seeds) == pytest.approx(expected.min(axis=0), abs=1e-9)


def test_seeds_may_start_late(star):
    _, surface = star
    seeds, start = [0, len(surface) - 1, 700, 700], np.array([0.31, 0.0, 1.0, 0.05])
    expected = (reference(surface, seeds) + start[:, None]).min(axis=0)
    assert geodesic_distances(surface, seeds, start) == pytest.approx(expected, abs=1e-9)


def test_triangle_inequality_and_symmetry(star):
    _, surface = star
    a, b = 5, len(surface) - 9
    from_a, from_b = geodesic_distances(surface, [a]), geodesic_distances(surface, [b])
    assert from_a[b] == pytest.approx(from_b[a])
    assert (from_a + from_b >= from_a[b] - 1e-9).all()
    assert (from_a >= np.linalg.norm(surface.centres - surface.centres[a], axis=1) - 1e-9).all()


def test_centre_of_mass_is_the_mean_of_the_inside_voxels(star):
    hull, _ = star
    expected = ((np.argwhere(hull.sdf < 0) + np.array(hull.index_min) + 0.5) * VOXEL).mean(axis=0)
    assert centre_of_mass(hull) == pytest.approx(expected, abs=1e-12)


def test_map_starts_at_the_surface_point_nearest_the_centre_of_mass(star):
    hull, surface = star
    distance = geodesic_map(hull, surface)
    start = int(np.argmin(distance))
    assert start == nearest_row(surface, centre_of_mass(hull)) and distance[start] == 0
    assert np.isfinite(distance).all()


@pytest.mark.parametrize("find", ["extremities", "wide_maxima"])
def test_tips_of_the_limbs_are_the_maxima(star, find):
    hull, surface = star
    distance = geodesic_map(hull, surface)
    found = extremities(surface, distance, 5) if find == "extremities" else wide_maxima(surface, distance, 0.1)
    assert len(found.rows) == 5
    gaps = np.linalg.norm(surface.points[found.rows][:, None] - TIPS[None], axis=2)
    assert sorted(gaps.argmin(axis=1)) == [0, 1, 2, 3, 4]
    assert gaps.min(axis=1).max() < 0.06
    assert (np.diff(found.distance) <= 0).all()


def test_a_wrinkle_is_no_wide_maximum(star):
    _, surface = star
    rng = np.random.default_rng(0)
    distance = geodesic_distances(surface, [nearest_row(surface, [0, 0, 1.1])])
    bumpy = distance + rng.uniform(0, 0.04, len(distance))
    narrow, wide = wide_maxima(surface, bumpy, 0.021), wide_maxima(surface, bumpy, 0.1)
    assert len(wide.rows) < len(narrow.rows) / 3
    for row, drop in zip(wide.rows, wide.drop, strict=True):
        near = np.linalg.norm(surface.points - surface.points[row], axis=1) <= 0.1
        assert bumpy[row] >= bumpy[near & (distance > 0.5)].max(initial=0) - 1e-12 and drop > 0


def test_plateau_has_one_maximum(star):
    _, surface = star
    assert len(wide_maxima(surface, np.zeros(len(surface)), 10.0).rows) == 1


def test_the_map_leads_through_the_air_between_pieces():
    trunk, legs = capsule([0, 0, 0.6], [0, 0, 1.2], 0.1), capsule([0, 0, 0.0], [0, 0, 0.3], 0.1)
    hull = hull_of([trunk, legs], [-0.2, -0.2, -0.2], [0.2, 0.2, 1.4])  # 10 cm of air between them
    surface = extract_surface(hull)
    distance = geodesic_map(hull, surface)
    assert np.isfinite(distance).all()
    z = surface.points[:, 2]
    bottom, first = distance[(z > 0.45) & (z < 0.52)], distance[z < 0.45].min()
    assert bottom.min() + 0.08 < first < bottom.max() + 0.12
    assert distance[z < -0.08].min() > first + 0.4  # and on, down to the feet


def test_unreachable_and_bad_seeds(star):
    hull, surface = star
    cut = extract_surface(hull)
    lonely = replace(cut, indices=3 * cut.indices)  # no voxel touches another
    distance = geodesic_distances(lonely, [3])
    assert distance[3] == 0 and np.isinf(np.delete(distance, 3)).all()
    for seeds in ([], [-1], [len(surface)]):
        with pytest.raises(InputError, match="rows 0 to"):
            geodesic_distances(surface, seeds)
    with pytest.raises(InputError, match="start_m"):
        geodesic_distances(surface, [0], [-1.0])
