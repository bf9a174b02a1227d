# SPDX-License-Identifier: Apache-2.0
"""The range and the enlargement of lens models, against closed forms and brute force."""

import math

import numpy as np
import pytest

from limbloc_ros.core.camera import Camera
from limbloc_ros.core.errors import RigError
from limbloc_ros.core.lens import distort, lens_range

K = np.array([[300.0, 0.0, 319.5], [0.0, 310.0, 239.5], [0.0, 0.0, 1.0]])


def camera(model, *coefficients, size=(640, 480), K=K):
    return Camera("cam", *size, K, np.eye(4), np.array(coefficients), model)


def test_no_distortion_has_no_limit():
    assert lens_range(camera("none")) == (math.inf, 1.0)
    assert lens_range(camera("radtan", 0.0, 0.0, 0.0, 0.0)) == (math.inf, 1.0)


def test_a_barrel_folds_where_its_slope_is_zero():
    """r (1 - 0.3 r^2) turns at r = sqrt(1 / 0.9), which this image, whose corner lies at r = 1.3, reaches."""
    limit, enlargement = lens_range(camera("radtan", -0.3, 0.0, 0.0, 0.0))
    fold = math.sqrt(1 / 0.9)
    assert 0.98 * fold < limit <= fold
    assert enlargement == pytest.approx(1.0, abs=0.02)


def test_a_pincushion_is_steepest_at_the_border():
    """d/dr of r (1 + 0.5 r^2) is 1 + 1.5 r^2."""
    limit, enlargement = lens_range(camera("radtan", 0.5, 0.0, 0.0, 0.0))
    assert enlargement >= 1 + 1.5 * limit**2
    assert enlargement < 1.05 * (1 + 1.5 * limit**2)


def test_the_range_of_a_fisheye():
    """An equidistant lens of 300 px a radian sees 1.32 rad in the corner of 640x480."""
    limit, enlargement = lens_range(camera("fisheye", 1e-9, 0.0, 0.0, 0.0))
    corner = math.tan(math.hypot(319.5 / 300, 239.5 / 310))
    assert corner < limit < 1.4 * corner
    assert enlargement == pytest.approx(1.0, abs=0.01)


LENSES = [
    ("radtan", -0.3, 0.1, 0.01, -0.02),
    ("radtan", 0.6, 0.4, 0.0, 0.03),
    ("radtan", -0.4, 0.2, 0.0, 0.0, -0.05),
    ("rational", 1.0, 0.5, 0.001, 0.0, 0.1, 1.3, 0.4, 0.05),
    ("rational", 0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.01, 0.02, -0.01, 0.005),
    ("fisheye", 0.3, 0.2, 0.1, 0.0),
    ("fisheye", -0.05, 0.01, 0.0, 0.0),
]


@pytest.mark.parametrize("lens", LENSES)
def test_lenses_distort_as_opencvs_do(lens):
    one, points = camera(*lens), np.random.default_rng(5).uniform(-1.2, 1.2, (6, 50, 2))
    points[0, 0] = 0.0  # on the axis
    uv, _ = one.world_to_image(np.concatenate([points, np.ones((6, 50, 1))], axis=-1))
    np.testing.assert_allclose(distort(one, points), (uv - K[:2, 2]) / np.diag(K)[:2], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("lens", LENSES)
def test_no_two_points_get_further_apart_than_the_enlargement_says(lens):
    one = camera(*lens)
    limit, enlargement = lens_range(one)
    rng = np.random.default_rng(0)
    for spread in (1e-4, 0.05, 0.5):
        angle, away = rng.uniform(0, 2 * np.pi, 20_000), limit * np.sqrt(rng.random(20_000))
        a = away[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        b = a + rng.normal(scale=spread * limit, size=a.shape)
        kept = np.linalg.norm(b, axis=1) <= limit
        a, b = a[kept], b[kept]
        uv = [one.world_to_image(np.column_stack([p, np.ones(len(p))]))[0] / (K[0, 0], K[1, 1]) for p in (a, b)]
        assert (np.linalg.norm(uv[1] - uv[0], axis=1) <= enlargement * np.linalg.norm(b - a, axis=1) + 1e-9).all()


@pytest.mark.parametrize("lens", LENSES)
def test_every_pixel_has_its_point_in_range(lens):
    """The range holds the whole image, unless the lens folds before; and it is one-to-one."""
    one = camera(*lens)
    limit, _ = lens_range(one)
    side = np.linspace(-limit, limit, 400)
    a, b = np.meshgrid(side, side)
    uv, _ = one.world_to_image(np.stack([a, b, np.ones_like(a)], axis=-1))
    inside = np.hypot(a, b) <= limit
    step = side[1] - side[0]
    du_da, du_db = np.gradient(uv[..., 0], step, axis=1), np.gradient(uv[..., 0], step, axis=0)
    dv_da, dv_db = np.gradient(uv[..., 1], step, axis=1), np.gradient(uv[..., 1], step, axis=0)
    well = np.hypot(a, b) <= limit - 2 * step
    assert ((du_da * dv_db - du_db * dv_da)[well] > 0).all()
    rim = inside & (np.hypot(a, b) > limit - 2 * step)
    out = (uv < -0.5).any(axis=-1) | (uv[..., 0] > 639.5) | (uv[..., 1] > 479.5)
    beyond = 1.02 * limit * np.stack([np.cos(side), np.sin(side)], axis=-1)
    nearer = np.linalg.norm(one.world_to_image(np.column_stack([beyond, np.ones(400)]))[0] - K[:2, 2], axis=1)
    folds = nearer.min() < np.linalg.norm(uv[rim] - K[:2, 2], axis=-1).max()
    assert out[rim].all() or folds


def test_impossible_lenses_are_named():
    with pytest.raises(RigError, match=r"cam: its distortion .* is impossible"):
        lens_range(camera("radtan", -4000.0, 0.0, 0.0, 0.0))
    tilted = [0.1] + 11 * [0.0] + [0.02, 0.0]
    with pytest.raises(RigError, match=r"tilted-sensor .* not supported"):
        lens_range(camera("rational", *tilted))
