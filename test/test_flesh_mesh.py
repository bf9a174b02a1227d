# SPDX-License-Identifier: Apache-2.0
"""Meshes of the flesh figure, against the spheres that they come from."""

import numpy as np
import pytest

from limbloc_ros.core.flesh_mesh import flesh_mesh, icosphere, support_points
from limbloc_ros.core.pose import Flesh

CENTRES = np.array([[0.0, 0.0, 1.0], [0.1, 0.0, 0.6], [0.3, 0.2, 0.7], [1.0, 1.0, 1.0]])
RADII = np.array([0.10, 0.06, 0.08, 0.12])
FLESH = Flesh(CENTRES, RADII, np.array([[3, 3, 3], [0, 1, 1], [0, 1, 2]]), ("head", "upper_arm_L", "chest"))


def volume(vertices, faces) -> float:
    """Signed volume of a closed mesh: positive when faces are anticlockwise from outside."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


@pytest.mark.parametrize("subdivisions", [0, 1, 3])
def test_icosphere_is_a_closed_sphere(subdivisions):
    vertices, faces = icosphere(subdivisions)
    assert len(vertices) == 10 * 4**subdivisions + 2
    assert len(faces) == 20 * 4**subdivisions
    np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 1, atol=1e-12)
    directed = {tuple(edge) for edge in faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)}
    assert len(directed) == 3 * len(faces)  # each directed edge once: no face twice, none turned round
    assert all((b, a) in directed for a, b in directed)
    full = 4 / 3 * np.pi
    assert 0.6 * full < volume(vertices, faces) < full


def test_vertices_lie_on_the_hull_of_the_spheres():
    directions, _ = icosphere(2)
    for part, (vertices, _) in zip(FLESH.parts, flesh_mesh(FLESH), strict=True):
        centres, radii = CENTRES[part], RADII[part]
        touching = np.abs(np.linalg.norm(vertices[:, None] - centres, axis=2) - radii).min(axis=1)
        assert touching.max() < 1e-12  # each vertex is on one of its spheres
        reach = (directions @ centres.T + radii).max(axis=1)  # the hull's support function, by hand
        assert (vertices @ directions.T <= reach + 1e-12).all()  # no vertex lies outside the hull
        np.testing.assert_allclose(np.einsum("ij,ij->i", vertices, directions), reach, atol=1e-12)


def test_volume_of_a_sphere_and_a_frustum():
    (ball, faces), (limb, _), _ = flesh_mesh(FLESH, subdivisions=4)
    assert volume(ball - CENTRES[3], faces) == pytest.approx(4 / 3 * np.pi * 0.12**3, rel=0.01)
    # A round-ended frustum: two spherical caps and the cone between the circles where the tangent planes touch.
    d, (r1, r2) = np.linalg.norm(CENTRES[1] - CENTRES[0]), (0.10, 0.06)
    s = (r1 - r2) / d
    a1, a2 = r1 * np.sqrt(1 - s * s), r2 * np.sqrt(1 - s * s)
    height = d - (r1 - r2) * s
    cone = np.pi * height / 3 * (a1 * a1 + a1 * a2 + a2 * a2)
    caps = sum(np.pi * h * h * (3 * r - h) / 3 for r, h in ((r1, r1 * (1 + s)), (r2, r2 * (1 - s))))
    assert volume(limb - CENTRES[0], faces) == pytest.approx(cone + caps, rel=0.02)


def test_support_point_of_two_equal_spheres():
    point = support_points([[0, 0, 0], [1, 0, 0]], [0.5, 0.5], [[1.0, 0, 0], [-1.0, 0, 0], [0.6, 0.8, 0]])
    np.testing.assert_allclose(point, [[1.5, 0, 0], [-0.5, 0, 0], [1.3, 0.4, 0]])


def test_subdivisions_out_of_range():
    with pytest.raises(ValueError, match="expected 0 to 6, got 7"):
        icosphere(7)
