# SPDX-License-Identifier: Apache-2.0
"""Segmentation pixel by pixel: distances worked by hand, kernels against plain NumPy."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from limbloc_ros.core import _background_kernels as kernels


def measured(image, mean, variance, gain=(1, 1, 1), floor=2.0, darkest=0.5, brightest=1.0):
    """The compiled measurement of an [H, W, 3] image, in sigmas."""
    f = np.float32
    planar = [np.ascontiguousarray(np.asarray(a, dtype=f).transpose(2, 0, 1)) for a in (mean, variance)]
    level = np.empty(planar[0].shape, dtype=np.uint16)
    sharpness = np.empty_like(level)
    kernels.fix_all(*planar, f(floor**2), f(1), level, sharpness)
    height, width = image.shape[:2]
    change, colour = np.empty((2, height, width), dtype=np.uint8)
    spans = np.tile(np.array([0, width], dtype=np.int32), (height, 1))
    kernels.measure(
        np.ascontiguousarray(image.transpose(2, 0, 1)), level, sharpness, np.array(gain, dtype=f), f(darkest),
        f(brightest), spans, change, colour,
    )  # fmt: skip
    return change / kernels.CHANGE_SCALE, colour / kernels.COLOUR_SCALE


class TestPixels:
    """One pixel at a time; sigma is the floor, 2 grey levels."""

    def one(self, pixel, mean=(100, 120, 80), **kwargs):
        image = np.full((1, 1, 3), pixel, dtype=np.uint8)
        change, colour = measured(image, np.full((1, 1, 3), mean), np.zeros((1, 1, 3)), **kwargs)
        return change[0, 0], colour[0, 0]

    def test_the_background_itself_has_no_distance(self):
        assert self.one((100, 120, 80)) == (0, 0)

    def test_distance_is_in_sigmas(self):
        # 6 levels in one channel, 8 in another: 10 levels, 5 sigmas.
        assert self.one((106, 128, 80))[0] == 5

    def test_a_shadow_keeps_the_colour(self):
        # 0.8 of the background: 0.2 * |(100, 120, 80)| = 0.2 * 175.5 = 35.1 levels = 17.5 sigmas.
        change, colour = self.one((80, 96, 64))
        assert change == 17.5
        assert colour == 0

    def test_darker_than_a_shadow_is_foreground(self):
        # 0.25 of the background is 0.25 * 175.5 = 43.9 levels, 21.9 sigmas, from the darkest shadow (0.5).
        assert self.one((25, 30, 20))[1] == pytest.approx(21.9, abs=0.15)

    def test_brighter_than_the_brightest_highlight_is_foreground(self):
        assert self.one((110, 132, 88))[1] == pytest.approx(0.1 * 175.5 / 2, abs=0.15)
        assert self.one((110, 132, 88), brightest=1.2)[1] == 0

    def test_another_colour_is_no_shadow(self):
        # The nearest point of the line through black and the background, by orthogonal projection.
        scale = (60 * 100 + 120 * 120 + 80 * 80) / (100**2 + 120**2 + 80**2)
        away = np.linalg.norm(np.array([60, 120, 80]) - scale * np.array([100, 120, 80]))
        assert self.one((60, 120, 80))[1] == pytest.approx(away / 2, abs=0.13)

    def test_the_gain_of_the_light_moves_the_expectation(self):
        assert self.one((80, 96, 64), gain=(0.8, 0.8, 0.8)) == (0, 0)

    def test_an_overexposed_background_is_expected_at_white(self):
        assert self.one((255, 255, 255), mean=(250, 250, 250), gain=(1.2, 1.2, 1.2)) == (0, 0)


class TestKernels:
    """Compiled loops against plain NumPy."""

    def test_measure(self):
        rng = np.random.default_rng(1)
        shape = (37, 700, 3)  # more than two strips wide
        image = rng.integers(0, 256, shape, dtype=np.uint8)
        mean, variance = rng.uniform(0, 255, shape), rng.uniform(0, 400, shape)
        gain = np.array([0.9, 1.0, 1.2])
        expected = np.minimum(mean * gain, 255)
        precision = 1 / (variance + 4)
        far = np.sqrt(((image - expected) ** 2 * precision).sum(axis=2))
        scale = (image * expected * precision).sum(axis=2) / (expected**2 * precision).sum(axis=2)
        near = np.clip(scale, 0.5, 1.1)[..., None] * expected
        rest = np.sqrt(((image - near) ** 2 * precision).sum(axis=2))
        change, colour = measured(image, mean, variance, gain, brightest=1.1)
        unit = 1 / kernels.CHANGE_SCALE, 1 / kernels.COLOUR_SCALE
        assert np.abs(change - np.minimum(far, 127.5)).max() < 1.5 * unit[0]
        assert np.abs(colour - np.minimum(rest, 255 * unit[1])).max() < 1.5 * unit[1]

    def test_only_spans_are_measured(self):
        rng = np.random.default_rng(3)
        shape = (3, 20, 700)
        image = rng.integers(0, 256, shape, dtype=np.uint8)
        level = rng.integers(0, 32000, shape, dtype=np.uint16)
        sharpness = rng.integers(100, 2000, shape, dtype=np.uint16)
        light = np.ones(3, dtype=np.float32), np.float32(0.5), np.float32(1.1)
        everywhere = np.tile(np.array([0, 700], dtype=np.int32), (20, 1))
        some = everywhere.copy()
        some[3:9], some[9:] = (5, 420), (700, 0)
        whole, part = np.zeros((2, 2, 20, 700), dtype=np.uint8)
        kernels.measure(image, level, sharpness, *light, everywhere, *whole)
        kernels.measure(image, level, sharpness, *light, some, *part)
        columns = np.arange(700)
        inside = (columns >= some[:, :1]) & (columns < some[:, 1:])
        np.testing.assert_array_equal(part, np.where(inside, whole, 0))

    def test_spans_of_foreground_by_hand(self):
        change, colour = np.zeros((2, 40, 60), dtype=np.uint8)
        change[8, 20:23] = colour[8, 20:23] = 50
        change[9, 40:50] = colour[9, 40:50] = 50  # a row that is not looked at
        change[16, 30] = colour[16, 30] = 50  # a single pixel: noise
        change[24, 30:40] = 50  # a shadow
        spans = np.empty((40, 2), dtype=np.int32)
        kernels.foreground_spans(change, 8, colour, 16, 0, 4, 5, spans)
        assert (spans[3:14] == (15, 28)).all()
        assert (spans[:3] == (60, 0)).all()
        assert (spans[14:] == (60, 0)).all()

    def test_learn(self):
        rng = np.random.default_rng(2)
        shape = (3, 24, 50)
        image = rng.integers(0, 256, shape, dtype=np.uint8)
        mean, variance = rng.uniform(0, 255, shape).astype(np.float32), rng.uniform(0, 99, shape).astype(np.float32)
        busy = (rng.random(shape[1:]) < 0.3).astype(np.uint8)
        change = rng.integers(0, 20, shape[1:], dtype=np.uint8)
        gain = np.array([0.8, 1.0, 1.1], dtype=np.float32)
        level, sharpness = np.zeros(shape, dtype=np.uint16), np.zeros(shape, dtype=np.uint16)
        rows = np.zeros(shape[1:], dtype=bool)
        rows[1::4] = True
        may = (busy == 0) & (change < 8) & rows & (image < 254)
        off = image / gain[:, None, None] - mean
        new_mean = np.where(may, mean + 0.1 * off, mean)
        new_variance = np.where(may, 0.9 * (variance + 0.1 * off**2), variance)
        f = np.float32
        kernels.learn(
            image, mean, variance, level, sharpness, gain, busy, change, f(8), f(0.1), f(4), f(1), 1, 4
        )  # fmt: skip
        np.testing.assert_allclose(mean, new_mean, rtol=1e-5, atol=1e-3)
        np.testing.assert_allclose(variance, new_variance, rtol=1e-4, atol=1e-2)
        assert np.abs(level[:, 1::4] / kernels.LEVEL_SCALE - new_mean[:, 1::4]).max() < 0.6 / kernels.LEVEL_SCALE
        sigma = np.sqrt(new_variance + 4)[:, 1::4]
        assert np.abs(sharpness[:, 1::4] - kernels.SHARPNESS_SCALE / sigma).max() < 0.6
        assert not level[:, 0::4].any()

    def test_images_are_taken_into_mean_and_variance(self):
        images = np.random.default_rng(4).integers(0, 256, (6, 3, 20, 33), dtype=np.uint8)
        gain = np.array([0.8, 1.0, 1.1], dtype=np.float32)
        mean, squares = images[0].astype(np.float32), np.zeros(images[0].shape, dtype=np.float32)
        for count, image in enumerate(images[1:], start=2):
            kernels.add_to_mean(image, gain, count, mean, squares)
        brought = np.concatenate([images[:1].astype(float), images[1:] / gain[:, None, None]])
        np.testing.assert_allclose(mean, brought.mean(axis=0), rtol=1e-5, atol=1e-3)
        np.testing.assert_allclose(squares / len(images), brought.var(axis=0), rtol=1e-4, atol=1e-2)

    @given(st.tuples(*[st.floats(0.4, 1.6)] * 3), st.integers(0, 5))
    @settings(max_examples=30, deadline=None)
    def test_light_gain_ignores_a_person(self, gain, seed):
        rng = np.random.default_rng(seed)
        mean = rng.uniform(40, 140, (3, 60, 80))
        image = np.clip(np.rint(mean * np.array(gain)[:, None, None] + rng.normal(0, 1.5, mean.shape)), 0, 255)
        image[:, 10:50, 20:45] = 30  # a fifth of the image, unknown to the model
        level = np.rint(mean * kernels.LEVEL_SCALE).astype(np.uint16)
        nobody = np.zeros((60, 80), dtype=np.uint8)
        found = kernels.light_gain(image.astype(np.uint8), level, nobody, np.ones(3, dtype=np.float32), 2)
        np.testing.assert_allclose(found, gain, rtol=0.02)

    def test_light_gain_keeps_the_last_one_in_the_dark(self):
        black = np.zeros((3, 40, 40), dtype=np.uint8)
        last = np.array([0.7, 0.8, 0.9], dtype=np.float32)
        nobody = np.zeros((40, 40), dtype=np.uint8)
        found = kernels.light_gain(black, black.astype(np.uint16), nobody, last, 1)
        np.testing.assert_array_equal(found, last)

    def test_densest_mean_finds_the_crowd(self):
        rng = np.random.default_rng(4)
        samples = rng.integers(0, 256, (15, 5, 6, 3), dtype=np.uint8)
        gains = rng.uniform(0.8, 1.2, (15, 3)).astype(np.float32)
        mean, sigma = kernels.densest_mean(samples, gains, 0.4)
        values = samples / gains[:, None, None]
        for y in range(5):
            for x in range(6):
                order = np.argsort(values[:, y, x].sum(axis=1))
                total = values[order, y, x].sum(axis=1)
                best = np.argmin(total[5:] - total[:-5])  # 6 of 15
                crowd = values[order[best : best + 6], y, x]
                np.testing.assert_allclose(mean[y, x], crowd.mean(axis=0), rtol=1e-4)
                np.testing.assert_allclose(sigma[y, x], crowd.std(axis=0), rtol=1e-2)
