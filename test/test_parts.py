# SPDX-License-Identifier: Apache-2.0
"""Distances between the points of bodies, against scipy's tree."""

import subprocess
import sys

import numpy as np
from scipy.spatial import cKDTree

from limbloc_ros.core.parts import nearest


def test_the_nearest_point():
    points, query = np.random.default_rng(1).normal(size=(2, 300, 3))
    np.testing.assert_allclose(nearest(points, query), cKDTree(points).query(query)[0], rtol=1e-12)
    rough = points.astype(np.float32)  # any kind of array
    np.testing.assert_allclose(nearest(rough, query[::2]), cKDTree(rough).query(query[::2])[0], rtol=1e-12)
    assert np.isinf(nearest(points[:0], query)).all()


def test_following_one_person_needs_no_trees_of_scipy():
    """Their import takes a tenth of a second of every start."""
    code = "import sys; import limbloc_ros.core.people; print({'scipy.spatial', 'scipy.ndimage'} & set(sys.modules))"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "set()"
