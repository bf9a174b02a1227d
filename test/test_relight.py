# SPDX-License-Identifier: Apache-2.0
"""The background under new light: against the picture it should be, and against views it is not."""

import cv2
import numpy as np
import pytest

from limbloc_ros.core.relight import relight

HEIGHT, WIDTH = 120, 160
PERSON = (slice(30, 100), slice(60, 85))


def scene(seed=1):
    rng = np.random.default_rng(seed)
    image = np.full((HEIGHT, WIDTH, 3), (90.0, 110.0, 130.0))
    for _ in range(60):
        y, x = rng.integers(0, (HEIGHT - 10, WIDTH - 10))
        image[y : y + rng.integers(5, 40), x : x + rng.integers(5, 40)] = rng.integers(30, 150, 3)
    return cv2.GaussianBlur(image, (0, 0), 0.7)


def planes(image):
    return np.ascontiguousarray(np.clip(np.rint(image), 0, 255).astype(np.uint8).transpose(2, 0, 1))


def test_light_from_the_side_is_carried_behind_the_person():
    y, x = np.mgrid[-1 : 1 : HEIGHT * 1j, -1 : 1 : WIDTH * 1j]
    light = (1.1 + 0.4 * x - 0.2 * y * y)[..., None] * (0.8, 1.0, 1.1)
    lit = scene() * light
    image = lit.copy()
    image[PERSON] = (20, 160, 60)
    changed = np.zeros((HEIGHT, WIDTH), np.uint8)
    changed[PERSON] = 255
    found = relight(planes(image), np.float32(scene()).transpose(2, 0, 1), changed)
    assert found.same_view and not found.other_view
    assert found.agreement > 0.95
    off = np.abs(found.mean.transpose(1, 2, 0) - lit)
    assert np.percentile(off[PERSON], 99) < 4.0  # grey levels, of about 100
    assert off.max() < 15.0


@pytest.mark.parametrize("how", ["another room", "shifted", "upside down", "a hand before the lens"])
def test_another_view_is_told_from_another_light(how):
    views = {
        "another room": scene(2),
        "shifted": np.roll(scene(), 12, axis=1),
        "upside down": scene()[::-1],
        "a hand before the lens": np.full((HEIGHT, WIDTH, 3), (100.0, 130.0, 190.0))
        + np.linspace(0, 30, WIDTH)[:, None],
    }
    found = relight(planes(views[how]), np.float32(scene()).transpose(2, 0, 1), np.zeros((HEIGHT, WIDTH), np.uint8))
    assert found.other_view and not found.same_view


def test_a_bare_wall_has_only_its_brightness_to_tell_by():
    wall = np.full((HEIGHT, WIDTH, 3), 100.0)
    nobody = np.zeros((HEIGHT, WIDTH), np.uint8)
    found = relight(planes(wall * 1.7), np.float32(wall).transpose(2, 0, 1), nobody)
    assert np.isnan(found.agreement) and found.smooth == 1.0 and found.same_view
    patches = np.kron(np.random.default_rng(3).uniform(20, 220, (6, 8)), np.ones((20, 20)))[..., None] * np.ones(3)
    found = relight(planes(patches), np.float32(wall).transpose(2, 0, 1), nobody)
    assert not found.same_view and not found.other_view  # it may be either: the background is learned anew
