# SPDX-License-Identifier: Apache-2.0
"""Segmentation pixel by pixel: distances worked by hand, kernels against plain NumPy."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from limbloc_ros.core import _background_kernels as kernels
from limbloc_ros.core._background_estimate_kernels import densest_mean
from limbloc_ros.core._bit_kernels import at_least, no_pixels, spread


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
    light = np.array(gain, dtype=f), f(darkest), f(brightest)
    kernels.measure(image, level, sharpness, *light, 0, 0, spans, change, colour)
    return change / kernels.CHANGE_SCALE, colour / kernels.COLOUR_SCALE


def packed(mask):
    return at_least(mask.astype(np.uint8), 1)


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
        shape = (37, 700, 3)  # ten words of pixels and a part of one
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

    def frame(self, shape, seed=3):
        """An image and a background that have nothing to do with each other, as the kernels take them."""
        rng = np.random.default_rng(seed)
        image = rng.integers(0, 256, (*shape, 3), dtype=np.uint8)
        level = rng.integers(0, 32000, (3, *shape), dtype=np.uint16)
        sharpness = rng.integers(100, 2000, (3, *shape), dtype=np.uint16)
        return image, level, sharpness, np.ones(3, dtype=np.float32)

    def test_only_spans_are_measured_in_whole_vectors(self):
        frame = *self.frame((20, 700)), np.float32(0.5), np.float32(1.1)
        everywhere = np.tile(np.array([0, 700], dtype=np.int32), (20, 1))
        whole = np.zeros((2, 20, 700), dtype=np.uint8)
        kernels.measure(*frame, 0, 0, everywhere, *whole)
        spans = np.tile(np.array([700, 0], dtype=np.int32), (12, 1))
        spans[2:5], spans[5:7] = (70, 420), (650, 700)
        part = np.zeros((2, 12, 636), dtype=np.uint8)  # of the image from row 5 and column 64 on
        kernels.measure(*frame, 5, 64, spans, *part)
        inside = np.zeros((12, 700), dtype=bool)
        inside[2:5, 64:432] = inside[5:7, 640:] = True
        np.testing.assert_array_equal(part, np.where(inside, whole[:, 5:17], 0)[:, :, 64:])

    def test_looking_tells_the_pixels_that_are_far(self):
        frame = self.frame((23, 150))
        changed = np.zeros((6, 3), dtype=np.uint64)
        count = kernels.look(*frame, 2, 4, np.float32(60), changed)
        change = np.zeros((2, 23, 150), dtype=np.uint8)
        everywhere = np.tile(np.array([0, 150], dtype=np.int32), (23, 1))
        kernels.measure(*frame, np.float32(0.5), np.float32(1.1), 0, 0, everywhere, *change)
        expected = change[0, 2::4] >= 60 * kernels.CHANGE_SCALE
        assert 0.2 < expected.mean() < 0.8
        np.testing.assert_array_equal(spread(changed, 150) > 0, expected)
        assert count == np.count_nonzero(expected)

    def test_spans_of_foreground_by_hand(self):
        background = np.full((40, 200, 3), 100, dtype=np.uint8)
        image = background.copy()
        other, shadow = (100, 140, 60), (80, 80, 80)
        image[8, 70:73] = other
        image[9, 140:150] = other  # a row that is not looked at
        image[16, 130] = other  # a single pixel: noise
        image[24, 30:40] = shadow
        image[32, 10:190] = shadow
        image[32, 50:60] = image[32, 66:69] = image[32, 188:190] = other
        level, sharpness = np.empty((2, 3, 40, 200), dtype=np.uint16)
        mean = np.ascontiguousarray(background.transpose(2, 0, 1), dtype=np.float32)
        kernels.fix_all(mean, np.zeros_like(mean), np.float32(4), np.float32(1), level, sharpness)
        frame = image, level, sharpness, np.ones(3, dtype=np.float32)
        changed = np.zeros((10, 4), dtype=np.uint64)
        kernels.look(*frame, 0, 4, np.float32(4), changed)
        spans = np.empty((40, 2), dtype=np.int32)
        light = np.float32(0.5), np.float32(1.1)
        kernels.foreground_spans(*frame, *light, changed, 16, 0, 4, 5, spans)
        assert (spans[3:14] == (65, 78)).all()
        assert (spans[27:38] == (45, 195)).all()
        assert (np.delete(spans, [*range(3, 14), *range(27, 38)], axis=0) == (200, 0)).all()
        assert kernels.box_of(spans, 2, 200) == (1, 40, 0, 200)
        assert kernels.box_of(spans[:20], 1, 200) == (2, 15, 64, 128)
        assert kernels.box_of(spans[:3], 2, 200) == (0, 0, 0, 0)

    def test_learn(self):
        rng = np.random.default_rng(2)
        shape = (3, 24, 70)
        image = rng.integers(0, 256, (24, 70, 3), dtype=np.uint8)
        planes = image.transpose(2, 0, 1)
        mean, variance = rng.uniform(0, 255, shape).astype(np.float32), rng.uniform(0, 99, shape).astype(np.float32)
        busy, changed = rng.random((24, 70)) < 0.3, rng.random((12, 70)) < 0.3
        gain = np.array([0.8, 1.0, 1.1], dtype=np.float32)
        level, sharpness = np.zeros(shape, dtype=np.uint16), np.zeros(shape, dtype=np.uint16)
        rows = np.zeros(shape[1:], dtype=bool)
        rows[5::6] = True  # of the rows 1, 3, 5 ... that were looked at every third, from number 2 on
        may = ~busy & ~np.repeat(changed, 2, axis=0) & rows & (planes < 254)
        off = planes / gain[:, None, None] - mean
        new_mean = np.where(may, mean + 0.1 * off, mean)
        new_variance = np.where(may, 0.9 * (variance + 0.1 * off**2), variance)
        f = np.float32
        samples = kernels.sampled(level, 2)
        kernels.learn(
            image, mean, variance, level, sharpness, samples, 2, gain, packed(busy), packed(changed),
            f(0.1), f(4), f(1), 1, 2, 2, 3,
        )  # fmt: skip
        np.testing.assert_allclose(mean, new_mean, rtol=1e-5, atol=1e-3)
        np.testing.assert_allclose(variance, new_variance, rtol=1e-4, atol=1e-2)
        assert np.abs(level[:, 5::6] / kernels.LEVEL_SCALE - new_mean[:, 5::6]).max() < 0.6 / kernels.LEVEL_SCALE
        sigma = np.sqrt(new_variance + 4)[:, 5::6]
        assert np.abs(sharpness[:, 5::6] - kernels.SHARPNESS_SCALE / sigma).max() < 0.6
        assert not level[:, 0::6].any()
        np.testing.assert_array_equal(samples, level[:, 1::2, 1::2])
        assert samples.any()

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
        image = np.ascontiguousarray(image.transpose(1, 2, 0), dtype=np.uint8)
        found = kernels.light_gain(image, kernels.sampled(level, 2), no_pixels(60, 80), np.ones(3, dtype=np.float32), 2)
        np.testing.assert_allclose(found, gain, rtol=0.02)

    def test_light_gain_leaves_out_who_is_known_to_be_there(self):
        image = np.full((60, 80, 3), 100, dtype=np.uint8)
        level = np.full((3, 60, 80), 100 * kernels.LEVEL_SCALE, dtype=np.uint16)
        busy = np.zeros((60, 80), dtype=bool)
        busy[:, :50] = True
        image[busy] = 60  # five eighths of the image
        found = kernels.light_gain(image, kernels.sampled(level, 2), packed(busy), np.ones(3, dtype=np.float32), 2)
        np.testing.assert_allclose(found, 1, rtol=1e-3)

    def test_light_gain_keeps_the_last_one_in_the_dark(self):
        black, level = np.zeros((40, 40, 3), dtype=np.uint8), np.zeros((3, 40, 40), dtype=np.uint16)
        last = np.array([0.7, 0.8, 0.9], dtype=np.float32)
        found = kernels.light_gain(black, level, no_pixels(40, 40), last, 1)
        np.testing.assert_array_equal(found, last)

    def test_densest_mean_finds_the_crowd(self):
        rng = np.random.default_rng(4)
        samples = rng.integers(0, 256, (15, 5, 6, 3), dtype=np.uint8)
        gains = rng.uniform(0.8, 1.2, (15, 3)).astype(np.float32)
        mean, sigma = densest_mean(samples, gains, 0.4)
        values = samples / gains[:, None, None]
        for y in range(5):
            for x in range(6):
                order = np.argsort(values[:, y, x].sum(axis=1))
                total = values[order, y, x].sum(axis=1)
                best = np.argmin(total[5:] - total[:-5])  # 6 of 15
                crowd = values[order[best : best + 6], y, x]
                np.testing.assert_allclose(mean[y, x], crowd.mean(axis=0), rtol=1e-4)
                np.testing.assert_allclose(sigma[y, x], crowd.std(axis=0), rtol=1e-2)
