# SPDX-License-Identifier: Apache-2.0
"""From evidence to silhouettes: hysteresis, parts, blobs and holes."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from limbloc_ros.core import _bit_kernels as bits
from limbloc_ros.core import _mask_kernels as kernels
from limbloc_ros.core import background, background_evidence
from limbloc_ros.core._background_kernels import CHANGE_SCALE, COLOUR_SCALE, learn, look, measure
from limbloc_ros.core.config import BackgroundConfig
from limbloc_ros.core.mask_cleaning import clean_mask


def iou(a, b):
    return np.count_nonzero(a & b) / np.count_nonzero(a | b)


def packed(mask):
    return bits.at_least(np.asarray(mask).astype(np.uint8), 1)


def unpacked(mask, like):
    return bits.spread(mask, like.shape[1]) > 0


def speckles(seed, share=0.45):
    """A random mask without anything at its rim, of a width that no word of eight pixels divides."""
    mask = (np.random.default_rng(seed).random((33, 47)) < share).astype(np.uint8) * 255
    mask[[0, -1]] = mask[:, [0, -1]] = 0
    return mask


class TestKernels:
    """Compiled loops on runs against OpenCV's on pixels."""

    @given(st.integers(0, 1000), st.sampled_from([0.05, 0.5, 0.95]))
    @settings(max_examples=25, deadline=None)
    def test_runs_are_the_mask(self, seed, share):
        mask = speckles(seed, share)
        mask[10:14] = 255
        runs = bits.runs_of(packed(mask), mask.shape[1])
        painted = np.zeros_like(mask)
        for row, start, end in runs:
            painted[row, start:end] = 255
        np.testing.assert_array_equal(painted, mask)
        rows, ends = runs[runs[:, bits.END] < mask.shape[1]][:, [bits.ROW, bits.END]].T
        assert (mask[rows, ends] == 0).all()  # no run goes on
        again = bits.no_pixels(*mask.shape)
        bits.set_runs(again, runs)
        np.testing.assert_array_equal(again, packed(mask))
        bits.clear_runs(again, runs)
        assert not again.any()

    @given(st.integers(0, 1000), st.booleans())
    @settings(max_examples=25, deadline=None)
    def test_parts_are_the_connected_components(self, seed, diagonal):
        mask = speckles(seed)
        runs = bits.runs_of(packed(mask), mask.shape[1])
        parts = kernels.parts_of(runs, diagonal)
        _, labels = cv2.connectedComponents(mask, connectivity=8 if diagonal else 4)
        found = labels[runs[:, bits.ROW], runs[:, bits.START]]
        same = found[:, None] == found
        np.testing.assert_array_equal(parts[:, None] == parts, same)
        np.testing.assert_array_equal(parts, same.argmax(axis=1))  # the first run of each

    @given(st.integers(0, 1000))
    @settings(max_examples=25, deadline=None)
    def test_hysteresis_keeps_whole_parts(self, seed):
        weak = speckles(seed)
        strong = np.random.default_rng(seed).random(weak.shape) < 0.02
        _, labels = cv2.connectedComponents(weak, connectivity=8)
        kept = np.isin(labels, np.unique(labels[strong])) & (weak > 0)
        found = packed(weak)
        kernels.keep_strong_parts(found, packed(strong), weak.shape[1])
        np.testing.assert_array_equal(unpacked(found, weak), kept)

    @given(st.integers(0, 1000), st.integers(1, 40))
    @settings(max_examples=25, deadline=None)
    def test_small_blobs_and_holes(self, seed, least):
        mask = speckles(seed, 0.55)
        _, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
        blobs = (mask > 0) & (stats[labels, cv2.CC_STAT_AREA] >= least)
        _, labels, stats, _ = cv2.connectedComponentsWithStats(255 - mask, connectivity=4)
        holes = (mask == 0) & (stats[labels, cv2.CC_STAT_AREA] < least) & (labels != labels[0, 0])
        erased, filled = packed(mask), packed(mask)
        kernels.erase_blobs(erased, mask.shape[1], least)
        kernels.fill_holes(filled, np.zeros_like(filled), np.zeros_like(mask), 10.0, least)
        np.testing.assert_array_equal(unpacked(erased, mask), blobs)
        np.testing.assert_array_equal(unpacked(filled, mask), (mask > 0) | holes)

    @given(st.integers(0, 1000), st.floats(0.05, 0.95))
    @settings(max_examples=25, deadline=None)
    def test_the_outline_is_trimmed_where_the_change_is_small(self, seed, fraction):
        mask = speckles(seed, 0.7)
        change = np.random.default_rng(seed).integers(0, 256, mask.shape, dtype=np.uint8)
        core = cv2.erode(mask, np.ones((5, 5), np.uint8))
        units = round(fraction * kernels.FRACTION)
        tallest = cv2.dilate(change & mask, np.ones((5, 5), np.uint8)).astype(int)
        enough = change >= (tallest * units + kernels.FRACTION // 2) // kernels.FRACTION
        found = packed(mask)
        kernels.trim(found, packed(core), change, units)
        np.testing.assert_array_equal(unpacked(found, mask), (mask > 0) & ((core > 0) | enough))

    @pytest.mark.parametrize("shape", [(1, 3), (2, 64), (33, 47), (20, 130)])
    def test_the_median_of_nine(self, shape):
        values = np.random.default_rng(shape).integers(0, 256, shape, dtype=np.uint8)
        np.testing.assert_array_equal(kernels.median_of_nine(values), cv2.medianBlur(values, 3))

    def test_nothing_to_clean_and_to_place(self):
        nothing = np.zeros((0, 0), dtype=np.uint8)
        part = clean_mask(nothing, nothing, BackgroundConfig(), 1.0)
        mask, busy, count = kernels.place(part, 0, 0, np.full(5, 2, dtype=np.int32), 40, 140)
        assert (mask.shape, busy.shape, count) == ((40, 140), (40, 3), 0)
        assert not mask.any()
        assert not busy.any()

    def test_body_parts_by_hand(self):
        mask = np.zeros((12, 12), dtype=np.uint8)
        mask[2:10, 2:10] = 255
        mask[4:6, 4:6] = 0  # a hole: 8 border pixels' worth beside the mask, none beside background
        mask[9, 6] = 0  # a notch: three sides mask, one background
        changed = mask > 0
        changed[4:6, 4:6] = True
        changed[9:11, 6] = True  # the notch and one pixel that sticks out below it
        colour = np.full_like(mask, 20)

        def added(colour, ratio, box=(0, 11, 0, 11)):
            out = packed(mask)
            kernels.add_body_parts(out, packed(changed), colour, 10.0, ratio, box)
            return sorted(zip(*np.nonzero(unpacked(out, mask) != (mask > 0)), strict=True))

        hole = [(4, 4), (4, 5), (5, 4), (5, 5)]
        assert added(colour, 0.7) == [*hole, (9, 6), (10, 6)]  # 1 pixel beside the mask, 1 beside background
        assert added(colour, 1.0) == hole
        assert added(colour, 0.7, (0, 10, 0, 11)) == hole  # it reaches the rim of the box
        assert kernels.box_around(packed(mask), 12, 1) == (1, 10, 1, 10)
        assert kernels.box_around(packed(mask), 12, 5) == (0, 11, 0, 11)
        assert added(np.zeros_like(mask), 0.7) == []  # the background's very colour: a shadow

    @pytest.mark.parametrize(("top", "left", "width"), [(3, 64, 64), (0, 0, 128), (3, 64, 76), (0, 0, 140)])
    def test_a_part_is_placed_and_the_outermost_pixels_follow(self, top, left, width):
        part = (np.random.default_rng(top).random((20, width)) < 0.1).astype(np.uint8) * 255
        expected = np.zeros((40, 140), dtype=np.uint8)
        expected[top : top + 20, left : left + width] = part
        expected[0], expected[-1] = expected[1], expected[-2]
        expected[:, 0], expected[:, -1] = expected[:, 1], expected[:, -2]
        inside = np.zeros_like(expected)
        inside[top : top + 20, left : left + width] = 255
        square = np.full(5, 2, dtype=np.int32)
        mask, busy, count = kernels.place(packed(part), top, left, square, 40, 140)
        np.testing.assert_array_equal(mask, expected)
        assert count == np.count_nonzero(expected)
        around = cv2.dilate(expected, np.ones((5, 5), np.uint8)) & inside
        np.testing.assert_array_equal(bits.spread(busy, 140), around)


class TestCleaning:
    """Evidence drawn by hand at 640x480, where sizes in the configuration are plain pixels."""

    def setup_method(self):
        self.change = np.zeros((480, 640), dtype=np.uint8)
        self.colour = np.zeros_like(self.change)

    def draw(self, rows, columns, change_sigmas=30, colour_sigmas=20):
        self.change[rows, columns] = change_sigmas * CHANGE_SCALE
        self.colour[rows, columns] = colour_sigmas * COLOUR_SCALE

    def mask(self, **kwargs):
        found = clean_mask(self.change, self.colour, BackgroundConfig(**kwargs), 1.0)
        return bits.spread(found, 640) > 0

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

    def test_what_lies_around_a_person_is_no_hole_however_large_holes_may_be(self):
        self.draw(slice(100, 140), slice(100, 140))
        self.draw(slice(110, 130), slice(110, 130), 0, 0)
        truth = np.zeros((480, 640), dtype=bool)
        truth[100:140, 100:140] = True
        assert iou(self.mask(max_hole_px=1_000_000), truth) > 0.98

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
        assert mask[478, 10:50].all()
        assert mask[310:470, 1].all()


def test_the_warm_up_leaves_no_kernel_to_be_compiled_for_the_first_person(monkeypatch):
    """As it was when nothing in its images was foreground: the first person was not seen for ten seconds."""
    used = set()
    wanted = {"measure_around", "clean", "place", "learn", "light_gain", "look"}
    for module in (background, background_evidence, kernels):
        for name in wanted & set(vars(module)):
            kernel = getattr(module, name)
            monkeypatch.setattr(module, name, lambda *args, n=name, k=kernel: (used.add(n), k(*args))[1])
    background.warm_up.__wrapped__()
    assert used == wanted


def test_the_warm_up_compiles_what_images_of_messages_need():
    """Pixels of messages are read-only, those of files are not: a kernel is compiled for one kind of array only."""
    background.warm_up()
    before = [len(kernel.signatures) for kernel in (look, measure, learn)]
    for writeable in (True, False):
        model = background.BackgroundModel(BackgroundConfig(learning_frames=1))
        for level in (100, 102):
            image = np.full((64, 64, 3), level, dtype=np.uint8)
            image.flags.writeable = writeable
            model.segment(image)
    assert [len(kernel.signatures) for kernel in (look, measure, learn)] == before
