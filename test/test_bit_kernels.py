# SPDX-License-Identifier: Apache-2.0
"""Masks of one bit per pixel against OpenCV's of one byte."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from limbloc_ros.core import _bit_kernels as bits
from limbloc_ros.core.mask_cleaning import disc

WIDTHS = [17, 63, 64, 65, 128, 200]
"""With and without a word that is not full, and with neighbours across words."""


def random_mask(seed, width, share=0.4, height=25):
    return (np.random.default_rng(seed).random((height, width)) < share).astype(np.uint8) * 255


def packed(mask):
    return bits.at_least(mask, 1)


@given(st.integers(0, 2**64 - 1).filter(bool), st.integers(0, 64), st.integers(0, 64))
@settings(max_examples=50, deadline=None)
def test_single_words(word, start, end):
    digits = [i for i in range(64) if word >> i & 1]
    number = np.uint64(word)
    assert bits.count(number) == len(digits)
    assert (bits.lowest(number), bits.highest(number)) == (digits[0], digits[-1])
    expected = sum(1 << i for i in range(start, end))
    assert int(bits.between(64 + start, 64 + end, 1)) == expected
    row = np.array([[0, word]], dtype=np.uint64)
    assert bits.count_in(row, 0, 64 + start, 64 + end) == sum(start <= i < end for i in digits)


@pytest.mark.parametrize("width", WIDTHS)
def test_packing_and_spreading(width):
    values = np.random.default_rng(width).integers(0, 256, (9, width), dtype=np.uint8)
    mask = bits.at_least(values, 100)
    assert mask.shape == (9, bits.words(width))
    np.testing.assert_array_equal(bits.spread(mask, width), (values >= 100) * np.uint8(255))
    np.testing.assert_array_equal(bits.spread(bits.inverse(mask, width), width), (values < 100) * np.uint8(255))
    np.testing.assert_array_equal(bits.inverse(bits.inverse(mask, width), width), mask)  # nothing behind the last one


@given(st.integers(0, 1000), st.sampled_from(WIDTHS))
@settings(max_examples=25, deadline=None)
def test_most_of_nine_is_the_median(seed, width):
    mask = random_mask(seed, width, 0.5)
    expected = cv2.medianBlur(mask, 3)
    expected[[0, -1]] = expected[:, [0, -1]] = 0
    np.testing.assert_array_equal(bits.spread(bits.mostly(packed(mask), width), width), expected)


@given(st.integers(0, 1000), st.sampled_from(WIDTHS))
@settings(max_examples=25, deadline=None)
def test_pixels_beside_others(seed, width):
    mask = random_mask(seed, width, 0.2)
    up, down, left, right = (np.roll(np.pad(mask, 1), by, axis)[1:-1, 1:-1] for axis in (0, 1) for by in (1, -1))
    np.testing.assert_array_equal(bits.spread(bits.beside(packed(mask), width), width), up | down | left | right)


@given(st.integers(0, 1000), st.sampled_from(WIDTHS), st.sampled_from([0, 1, 2, 3, 7, 20, 70]))
@settings(max_examples=30, deadline=None)
def test_dilation_and_erosion(seed, width, radius):
    window = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    mask = random_mask(seed, width, 0.01)
    found = bits.dilate(packed(mask), width, disc(radius))
    np.testing.assert_array_equal(bits.spread(found, width), cv2.dilate(mask, window))
    found = bits.erode(packed(255 - mask), width, disc(radius))
    np.testing.assert_array_equal(bits.spread(found, width), cv2.erode(255 - mask, window))
