# SPDX-License-Identifier: Apache-2.0
"""Parts of a hull against NumPy, and distances between the points of bodies against scipy's tree."""

import subprocess
import sys

import numpy as np
import pytest
from scipy.spatial import cKDTree

from limbloc_ros.core.hull import Hull
from limbloc_ros.core.parts import POINTS, Part, nearest


def test_the_nearest_point():
    points, query = np.random.default_rng(1).normal(size=(2, 300, 3))
    np.testing.assert_allclose(nearest(points, query), cKDTree(points).query(query)[0], rtol=1e-12)
    rough = points.astype(np.float32)  # any kind of array
    np.testing.assert_allclose(nearest(rough, query[::2]), cKDTree(rough).query(query[::2])[0], rtol=1e-12)
    assert np.isinf(nearest(points[:0], query)).all()


@pytest.mark.parametrize("filled", [0.0, 1e-3, 0.02, 0.5, 1.0])
def test_a_part_is_some_of_its_voxels_and_their_mean(filled):
    sdf = np.random.default_rng(2).random((21, 30, 47)).astype(np.float32) - np.float32(filled)
    part = Part.of(Hull(0.02, (-7, 3, 50), sdf, 0.06))
    centres = (np.argwhere(sdf < 0) + [-7, 3, 50] + 0.5) * 0.02
    np.testing.assert_allclose(part.points, centres[:: max(1, len(centres) // POINTS)], rtol=1e-12)
    assert part.volume_m3 == pytest.approx(len(centres) * 8e-6)
    if len(centres):
        np.testing.assert_allclose(part.centre, centres.mean(axis=0), rtol=1e-12)


def test_following_one_person_needs_no_trees_of_scipy():
    """Their import takes a tenth of a second of every start."""
    code = "import sys; import limbloc_ros.core.people; print({'scipy.spatial', 'scipy.ndimage'} & set(sys.modules))"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "set()"
