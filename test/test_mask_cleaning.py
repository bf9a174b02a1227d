# SPDX-License-Identifier: Apache-2.0
"""From evidence to silhouettes: hysteresis, parts, blobs and holes."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from limbloc_ros.core import _mask_kernels as kernels
from limbloc_ros.core import background
from limbloc_ros.core._background_kernels import CHANGE_SCALE, COLOUR_SCALE
from limbloc_ros.core.config import BackgroundConfig
from limbloc_ros.core.mask_cleaning import clean_mask


def iou(a, b):
    return np.count_nonzero(a & b) / np.count_nonzero(a | b)


def speckles(seed, share=0.45):
    """A random mask without anything at its rim, of a width that no word of eight pixels divides."""
    mask = (np.random.default_rng(seed).random((33, 47)) < share).astype(np.uint8) * 255
    mask[[0, -1]] = mask[:, [0, -1]] = 0
    return mask


class TestKernels:
    """Compiled loops on runs against OpenCV's on pixels."""

    @given(st.integers(0, 1000), st.sampled_from([8, 16, 33, 640]), st.integers(1, 30), st.integers(1, 30))
    @settings(max_examples=25, deadline=None)
    def test_most_of_nine_is_the_median(self, seed, width, far, coloured):
        change, colour = np.random.default_rng(seed).integers(0, 30, (2, 20, width), dtype=np.uint8)
        found = np.empty_like(change)
        kernels.mostly_at_least(change, far, colour, coloured, found)
        expected = (cv2.medianBlur(change, 3) >= far) & (cv2.medianBlur(colour, 3) >= coloured)
        expected[[0, -1]] = expected[:, [0, -1]] = False
        np.testing.assert_array_equal(found, expected * np.uint8(255))

    @given(st.integers(0, 1000), st.sampled_from([0.05, 0.5, 0.95]), st.sampled_from([0, 255]))
    @settings(max_examples=25, deadline=None)
    def test_runs_are_the_mask(self, seed, share, wanted):
        mask = speckles(seed, share)
        mask[10:14] = wanted
        runs = kernels.runs_of(mask, wanted)
        painted = np.zeros_like(mask)
        kernels.paint(painted, runs)
        np.testing.assert_array_equal(painted > 0, mask == wanted)
        ends = runs[:, kernels.END]
        assert (runs[:, kernels.START] < ends).all()
        rows, ends = runs[ends < mask.shape[1], kernels.ROW], ends[ends < mask.shape[1]]
        assert (mask[rows, ends] != wanted).all()  # no run goes on

    @given(st.integers(0, 1000), st.booleans())
    @settings(max_examples=25, deadline=None)
    def test_parts_are_the_connected_components(self, seed, diagonal):
        mask = speckles(seed)
        runs = kernels.runs_of(mask, 255)
        parts = kernels.parts_of(runs, diagonal)
        _, labels = cv2.connectedComponents(mask, connectivity=8 if diagonal else 4)
        found = labels[runs[:, kernels.ROW], runs[:, kernels.START]]
        same = found[:, None] == found
        np.testing.assert_array_equal(parts[:, None] == parts, same)
        np.testing.assert_array_equal(parts, same.argmax(axis=1))  # the first run of each

    @given(st.integers(0, 1000))
    @settings(max_examples=25, deadline=None)
    def test_hysteresis_keeps_whole_parts(self, seed):
        weak = speckles(seed)
        colour = cv2.blur(np.random.default_rng(seed).integers(0, 256, weak.shape, dtype=np.uint8), (3, 3))
        strong = (weak > 0) & (cv2.medianBlur(colour, 3) >= 150)
        _, labels = cv2.connectedComponents(weak, connectivity=8)
        kept = np.isin(labels, np.unique(labels[strong])) & (weak > 0)
        found = np.zeros_like(weak)
        kernels.paint(found, kernels.strong_parts(weak, colour, 150))
        np.testing.assert_array_equal(found > 0, kept)

    @given(st.integers(0, 1000), st.integers(1, 40))
    @settings(max_examples=25, deadline=None)
    def test_small_blobs_and_holes(self, seed, least):
        mask = speckles(seed, 0.55)
        _, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
        blobs = (mask > 0) & (stats[labels, cv2.CC_STAT_AREA] >= least)
        _, labels, stats, _ = cv2.connectedComponentsWithStats(255 - mask, connectivity=4)
        holes = (mask == 0) & (stats[labels, cv2.CC_STAT_AREA] < least) & (labels != labels[0, 0])
        erased, filled, nothing = mask.copy(), mask.copy(), np.zeros_like(mask)
        kernels.erase_blobs(erased, least)
        kernels.fill_holes(filled, nothing, nothing, 8, 10.0, least)
        np.testing.assert_array_equal(erased > 0, blobs)
        np.testing.assert_array_equal(filled > 0, (mask > 0) | holes)

    def test_body_parts_by_hand(self):
        mask = np.zeros((12, 12), dtype=np.uint8)
        mask[2:10, 2:10] = 255
        mask[4:6, 4:6] = 0  # a hole: 8 border pixels' worth beside the mask, none beside background
        mask[9, 6] = 0  # a notch: three sides mask, one background
        changed = np.where(mask > 0, 50, 0).astype(np.uint8)
        changed[4:6, 4:6] = 30
        changed[9:11, 6] = 30  # the notch and one pixel that sticks out below it
        colour = np.full_like(mask, 20)

        def added(colour, ratio):
            out = mask.copy()
            kernels.add_body_parts(out, changed, colour, 8, 10.0, ratio)
            return sorted(zip(*np.nonzero(out != mask), strict=True))

        hole = [(4, 4), (4, 5), (5, 4), (5, 5)]
        assert added(colour, 0.7) == [*hole, (9, 6), (10, 6)]  # 1 pixel beside the mask, 1 beside background
        assert added(colour, 1.0) == hole
        assert added(np.zeros_like(mask), 0.7) == []  # the background's very colour: a shadow


class TestCleaning:
    """Evidence drawn by hand at 640x480, where sizes in the configuration are plain pixels."""

    def setup_method(self):
        self.change = np.zeros((480, 640), dtype=np.uint8)
        self.colour = np.zeros_like(self.change)

    def draw(self, rows, columns, change_sigmas=30, colour_sigmas=20):
        self.change[rows, columns] = change_sigmas * CHANGE_SCALE
        self.colour[rows, columns] = colour_sigmas * COLOUR_SCALE

    def mask(self, **kwargs):
        return clean_mask(self.change, self.colour, BackgroundConfig(**kwargs)) > 0

    def test_small_blobs_go_and_large_ones_stay(self):
        self.draw(slice(100, 110), slice(100, 110))
        self.draw(slice(200, 220), slice(100, 120))
        mask = self.mask(min_blob_px=150)
        assert not mask[90:120].any()
        assert mask[200:220, 100:120].mean() > 0.98

    def test_a_part_without_any_strong_pixel_is_nothing(self):
        self.draw(slice(200, 250), slice(100, 150), colour_sigmas=3)
        assert not self.mask().any()
        self.draw(slice(220, 225), slice(120, 125), colour_sigmas=5)
        assert self.mask()[200:250, 100:150].mean() > 0.98

    @pytest.mark.parametrize(
        ("size", "change", "colour", "filled"),
        [
            (8, 0, 0, True),  # too small to be seen through
            (30, 0, 0, False),  # the background itself
            (30, 30, 0.5, False),  # the background in the body's shadow
            (30, 30, 1.6, True),  # nearly the background's colour: cloth
        ],
    )
    def test_holes(self, size, change, colour, filled):
        self.draw(slice(100, 300), slice(100, 200))
        self.draw(slice(150, 150 + size), slice(130, 130 + size), change, colour)
        inside = self.mask()[152 : 148 + size, 132 : 128 + size]
        assert inside.all() if filled else not inside.any()

    def test_a_bite_in_the_outline_is_body_and_a_cast_shadow_is_not(self):
        self.draw(slice(100, 300), slice(100, 200))
        self.draw(slice(150, 190), slice(100, 130), 30, 1.6)  # three sides body, one background
        self.draw(slice(280, 300), slice(200, 300), 15, 1.6)  # touches the body with one short side
        mask = self.mask()
        assert mask[152:188, 102:130].all()
        assert not mask[280:300, 205:].any()

    def test_the_blurred_rim_is_trimmed(self):
        self.draw(slice(98, 302), slice(98, 202), 12, 5)
        self.draw(slice(100, 300), slice(100, 200), 60, 20)
        truth = np.zeros((480, 640), dtype=bool)
        truth[100:300, 100:200] = True
        assert iou(self.mask(), truth) > 0.99
        assert iou(self.mask(edge_fraction=0.0), truth) < 0.95

    def test_a_faint_limb_beside_a_bright_trunk_stays(self):
        self.draw(slice(100, 300), slice(100, 200), 60, 20)
        self.draw(slice(150, 164), slice(200, 300), 6, 6)
        assert self.mask()[152:162, 203:298].mean() > 0.98

    def test_a_body_at_the_image_border_reaches_it(self):
        self.draw(slice(300, 480), slice(0, 60))
        mask = self.mask()
        assert mask[479, 10:50].all()
        assert mask[310:470, 0].all()


def test_the_warm_up_leaves_no_kernel_to_be_compiled_for_the_first_person(monkeypatch):
    """As it was when nothing in its images was foreground: the first person was not seen for ten seconds."""
    used = set()
    for name in ("mostly_at_least", "strong_parts", "paint", "add_body_parts", "fill_holes", "erase_blobs"):
        kernel = getattr(kernels, name)
        monkeypatch.setattr(kernels, name, lambda *args, n=name, k=kernel: (used.add(n), k(*args))[1])
    background.warm_up.__wrapped__()
    assert used == {"mostly_at_least", "strong_parts", "paint", "add_body_parts", "fill_holes", "erase_blobs"}
