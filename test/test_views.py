# SPDX-License-Identifier: Apache-2.0
"""A figure drawn into the cameras against the silhouettes: balls whose images are known, and their convex hulls."""

import dataclasses
from functools import cache

import cv2
import numpy as np
import pytest
from camera_rings import LENSES, ball_masks, ring

from limbloc_ros.core import _views_kernels as kernels
from limbloc_ros.core import views as views_module
from limbloc_ros.core.config import HullConfig
from limbloc_ros.core.errors import InputError
from limbloc_ros.core.hull import Hull, carve
from limbloc_ros.core.pose import Flesh
from limbloc_ros.core.silhouettes import pack_cameras
from limbloc_ros.core.views import Views

CENTRE, RADIUS = np.array([[0.0, 0.1, 1.0]]), np.array([0.4])
BALL = np.array([[0, 0, 0]])


@cache
def views_of(*balls, count=4):
    rig = ring(count, focal=140.0, size=(192, 144))
    hull = carve(ball_masks(rig, list(balls)), rig, HullConfig(min_voxels=1))
    assert isinstance(hull, Hull)
    assert hull.views is not None
    return hull.views


def one_ball():
    return views_of((tuple(CENTRE[0]), float(RADIUS[0])))


def test_a_ball_covers_its_own_silhouettes():
    views = one_ball()
    assert (views.sizes > 100).all()
    # A ball off the axis is seen as an ellipse, and drawn as a disc; cells along the outline may be either.
    assert views.mismatch(BALL, CENTRE, RADIUS) < 0.08


def test_worked_by_hand_what_is_missed_and_what_is_too_much():
    views = one_ball()
    nothing = views.mismatch(BALL, CENTRE + np.array([0.0, 0.0, 50.0]), RADIUS)
    assert nothing == pytest.approx(1.0)
    half = views.mismatch(BALL, CENTRE, 0.5**0.5 * RADIUS)
    assert half == pytest.approx(0.5, abs=0.03)
    more = views.mismatch(BALL, CENTRE, 1.2 * RADIUS)
    assert more == pytest.approx(1.2**2 - 1.0, abs=0.08)


@pytest.mark.parametrize("lens", LENSES[:2] + LENSES[5:7], ids=lambda lens: f"{lens[0]} {len(lens[1])}")
def test_a_part_is_the_convex_hull_of_its_balls(lens):
    """Against many balls between the three, each drawn by itself."""
    rng = np.random.default_rng(3)
    rig = ring(3, focal=210.0, size=(288, 216), lens=lens)
    frames = np.array([[0, 0, 288, 216, 1, 288 * 216 * c] for c in range(3)])
    views = Views(pack_cameras(rig), frames, np.zeros(3 * 288 * 216, np.uint8))
    shares = np.array([(a, b, 24 - a - b) for a in range(25) for b in range(25 - a)]) / 24
    for _ in range(8):
        centres = np.array([0.0, 0.0, 1.0]) + rng.uniform(-0.3, 0.3, (3, 3))
        radii = rng.uniform(0.03, 0.2, 3)
        drawn = views.drawn(np.array([[0, 1, 2]]), centres, radii) != 0
        balls = np.repeat(np.arange(len(shares))[:, None], 3, axis=1)
        expected = views.drawn(balls, shares @ centres, shares @ radii) != 0
        assert expected.sum() > 300
        assert np.count_nonzero(drawn != expected) < 0.05 * expected.sum()


def test_a_limb_is_asked_as_the_whole_figure_is():
    """What a limb explains beside a body, and covers of background, is what the mismatch falls and rises by."""
    centres = np.array([[0.0, 0.0, 1.0], [0.3, 0.0, 1.0], [0.6, 0.1, 1.1]])
    radii = np.array([0.25, 0.1, 0.08])
    views = views_of(((0.0, 0.0, 1.0), 0.25), ((0.35, 0.0, 1.0), 0.12))
    body, limb = np.array([[0, 0, 0]]), np.array([[1, 2, 2]])
    drawn = views.drawn(body, centres, radii)
    asked, weights = views.open_cells(drawn, 1_000_000)
    places = centres[1:] + np.array([[0.0, 0.0, 0.0], [0.0, 0.1, -0.1], [-0.5, 0.0, 0.0]])[:, None]
    balls = np.column_stack([radii, centres])
    covers, bare = views.limbs(limb, np.array([1, 2]), places, balls, drawn, asked)
    for m, place in enumerate(places):
        both = views.mismatch(np.vstack([body, limb]), np.vstack([centres[:1], place]), radii)
        alone = views.mismatch(body, centres, radii)
        assert both == pytest.approx(alone - weights[covers[m]].sum() + bare[m], abs=1e-12)
    assert covers[0].sum() > covers[2].sum()
    some, share = views.open_cells(drawn, 40)
    assert len(some) <= 40
    assert share.sum() == pytest.approx(weights.sum(), rel=0.1)


def test_what_only_one_group_of_parts_covers():
    """Against the silhouettes that the figure leaves open without it, whatever the order of the parts."""
    centres = np.array([[0.0, 0.0, 1.0], [0.3, 0.0, 1.0], [0.6, 0.1, 1.1], [0.3, 0.0, 1.6]])
    radii = np.array([0.25, 0.1, 0.08, 0.1])
    views = views_of(((0.0, 0.0, 1.0), 0.25), ((0.35, 0.0, 1.0), 0.12))
    parts = np.array([[1, 2, 2], [0, 0, 0], [3, 3, 3], [1, 1, 1]])  # the third is seen where there is nothing
    groups = np.array([1, 0, 2, 1])
    alone, mismatch = views.shares(parts, groups, centres, radii)
    assert mismatch == pytest.approx(views.mismatch(parts, centres, radii), abs=1e-12)
    for group in range(3):
        others = views.drawn(parts[groups != group], centres, radii)
        this = views.drawn(parts[groups == group], centres, radii)
        only = (this != 0) & (others == 0) & (views.cells == kernels.SEEN)
        cells = np.add.reduceat(only, views.frames[:, 5])
        assert alone[group] == pytest.approx(views.worth @ cells, abs=1e-12)
    assert alone[0] > alone[1] > 0.05 > alone[2] == 0.0


def test_nobody_is_asked_about_others():
    views = views_of(((-0.35, 0.0, 1.0), 0.25), ((0.35, 0.1, 1.0), 0.25))
    first, second = np.array([[-0.35, 0.0, 1.0]]), np.array([[0.35, 0.1, 1.0]])
    radius = np.array([0.25])
    assert views.mismatch(BALL, first, radius) > 0.3
    other = Flesh(second, 1.1 * radius, BALL, ())
    assert views.without([other]).mismatch(BALL, first, radius) < 0.18


def test_a_camera_that_sees_hardly_anything_decides_hardly_anything():
    """Of a person whom another hides but for a rim, the rim of the figure beside it is not the whole mismatch."""
    views = one_ball()
    cells = views.cells.copy()
    first = np.flatnonzero(cells[: views.frames[1, 5]] == kernels.SEEN)
    cells[first[3:]] = kernels.UNASKED
    rim = dataclasses.replace(views, cells=cells)
    assert rim.sizes[0] == 3
    assert rim.mismatch(BALL, CENTRE, 1.1 * RADIUS) < 4.0 * views.mismatch(BALL, CENTRE, 1.1 * RADIUS)


def test_nobody_is_asked_about_ignored_regions():
    """Their pixels are foreground when the hull is carved, but nobody saw a person there."""
    balls = [(tuple(CENTRE[0]), float(RADIUS[0]))]
    rig = ring(4, focal=140.0, size=(192, 144))
    masks = ball_masks(rig, balls)
    left, bottom = np.array([[-1, -1], [80, -1], [80, 200], [-1, 200]]), np.array([[0, 100], [192, 100], [192, 144]])
    cameras = [
        dataclasses.replace(rig.cameras[0], ignore=(left,)),
        dataclasses.replace(rig.cameras[1], ignore=(bottom,)),
    ]
    hull = carve(masks, dataclasses.replace(rig, cameras=(*cameras, *rig.cameras[2:])), HullConfig(min_voxels=1))
    assert isinstance(hull, Hull)
    assert hull.views is not None
    assert np.count_nonzero(hull.views.cells == kernels.UNASKED) > 500
    assert (hull.views.sizes <= one_ball().sizes).all()
    assert hull.views.mismatch(BALL, CENTRE, RADIUS) < 0.08
    back = Views.unpacked(hull.views.packed)
    assert back.cells.tobytes() == hull.views.cells.tobytes()


@pytest.mark.parametrize("share", [0.0, 0.3, 0.55, 1.0])
def test_only_blobs_that_hold_a_marked_cell_stay(share):
    """As OpenCV labels them, with cells that nobody asks about in between, which stay as they are."""
    rng = np.random.default_rng(int(10 * share))
    image = np.uint8(rng.random((30, 41)) < share)
    image[rng.random(image.shape) < 0.05] = kernels.UNASKED
    marks = np.uint8(rng.random(image.shape) < 0.02)
    _, blobs = cv2.connectedComponents(np.uint8(image == kernels.SEEN), connectivity=8)
    stays = np.isin(blobs, np.setdiff1d(blobs[marks > 0], 0))
    expected = np.where(image == kernels.UNASKED, image, np.where(stays, kernels.SEEN, kernels.BARE))
    x, y, width, height = cv2.boundingRect(np.uint8(stays))
    assert kernels.keep_held(image, marks) == (x, x + width, y, y + height)
    np.testing.assert_array_equal(image, expected)


def test_discs_between_two_rows_cover_nothing():
    """Neither they nor the way between them meets the centre of a cell; one part lies across a row, one does not."""
    frames, cells = np.array([[0, 0, 8, 8, 1, 0]]), np.zeros(64, np.uint8)
    discs = np.array([[3.0, 4.0 - 2e-8, 1e-8], [3.0, 4.0 + 2e-8, 1e-8], [3.3, 4.3, 0.1]])
    span, drawn = np.empty((2, 8)), np.zeros(64, np.int16)
    parts = np.array([[0, 1, 1], [2, 2, 2]])
    assert kernels.draw_parts(parts, discs, frames[0], span, cells, drawn, 1) == (0, 0)
    assert not drawn.any()


def test_cells_are_counted_as_they_are_drawn():
    """Parts of all sizes, beside and behind the cameras too, over foreground, background and what nobody is asked."""
    rng = np.random.default_rng(5)
    rig = ring(3, focal=210.0, size=(288, 216))
    frames = np.array(
        [[0, 0, 288, 216, 1, 0], [20, 30, 77, 13, 3, 62208], [9, 5, 0, 0, 2, 63209], [0, 0, 5, 9, 7, 63209]]
    )
    views = Views(pack_cameras(rig)[[0, 1, 2, 0]], frames, rng.integers(0, 3, 63254).astype(np.uint8))
    kinds = [views.cells == kind for kind in (kernels.SEEN, kernels.BARE)]
    most = 0
    for n in range(60):
        centres = np.array([0.0, 0.0, 1.0]) + rng.uniform(-1, 1, (12, 3)) * [0.2, 1.0, 5.0][n % 3]
        radii = rng.uniform(0.0, 0.3, 12) ** 2
        parts = np.sort(rng.integers(0, 12, (6, 3)), axis=1)
        drawn = views.drawn(parts, centres, radii) != 0
        cells = [[np.count_nonzero(drawn[o : o + w * h] & kind[o : o + w * h]) for kind in kinds]
                 for _, _, w, h, _, o in frames]  # fmt: skip
        counts = kernels.covered(parts, centres, radii, views.cameras, frames, *views._bits)
        np.testing.assert_array_equal(counts, cells)
        most = max(most, counts.max())
    assert most > 5000


def test_arrays_of_any_layout_are_drawn_by_the_same_kernel():
    views = one_ball()
    expected = views.drawn(BALL, CENTRE, RADIUS)
    compiled = len(kernels.draw.signatures)
    spread = np.repeat(np.vstack([CENTRE, CENTRE]), 2, axis=0)[::2]
    assert not spread.flags.c_contiguous
    assert (views.drawn(BALL, spread, np.repeat(RADIUS, 4)[::2]) == expected).all()
    assert len(kernels.draw.signatures) == compiled
    views.mismatch(BALL, CENTRE, RADIUS)
    compiled = len(kernels.covered.signatures)
    views.mismatch(BALL, spread, np.repeat(RADIUS, 4)[::2])
    assert len(kernels.covered.signatures) == compiled


def test_a_hull_has_no_views_that_cannot_be_sent(monkeypatch):
    """A live node would refuse them, and its angles would not be those of the offline run."""
    rig = ring(4)
    masks = ball_masks(rig, [((0.0, 0.1, 1.0), 0.4)])
    monkeypatch.setattr(views_module, "MOST_CELLS", 1000)
    hull = carve(masks, rig, HullConfig(min_voxels=1))
    assert isinstance(hull, Hull)
    assert hull.views is None


def test_they_fit_where_their_packed_bytes_do():
    views = one_ball()
    size = len(views.packed)
    assert [views.fits(room) for room in (0, size - 1, size, size + 1, 100 * size)] == [False, False, True, True, True]


def test_packed_and_unpacked_they_are_the_same():
    whole = one_ball()
    views = whole.without([Flesh(CENTRE + 0.2, 0.5 * RADIUS, BALL, ())])
    assert set(views.cells) == {kernels.BARE, kernels.SEEN, kernels.UNASKED}
    again = Views.unpacked(views.packed)
    for name in ("cameras", "frames", "cells"):
        assert getattr(again, name).tobytes() == getattr(views, name).tobytes()
        assert getattr(again, name).dtype == getattr(views, name).dtype
    assert again.mismatch(BALL, CENTRE, RADIUS) == views.mismatch(BALL, CENTRE, RADIUS)


def test_what_no_views_pack_is_refused():
    views = one_ball()
    data = views.packed
    frames, cameras = views.frames.copy(), views.cameras.copy()
    frames[0, 2] += 1
    cameras[0, 0] = np.nan
    nobody = Views(cameras[:0], frames[:0], views.cells[:0])
    tall = views.frames.copy()
    tall[-1, 2:4] = 0, 3_000_000  # rows without cells
    for broken in (
        b"",
        data[:7],
        data[:-1],
        data + b"\0",
        b"\xff" * 4 + data[4:],
        data[:4] + b"\xff" * 4 + data[8:],
        dataclasses.replace(views, frames=frames).packed,
        dataclasses.replace(views, cameras=cameras).packed,
        dataclasses.replace(views, cells=views.cells[: views.frames[-1, 5]], frames=tall).packed,
        nobody.packed,
    ):
        with pytest.raises(InputError):
            Views.unpacked(broken)


def test_a_part_beside_the_last_image_is_drawn_nowhere():
    """Its cells would begin behind the last one, which may be the last of a word: there is room for two words more."""
    drawn = np.zeros(3, np.uint64)  # as `covered` has it for 8 x 8 cells
    left, right = np.full(8, 9.5), np.full(8, 12.0)
    kernels._fill.py_func(drawn, 7, 7, 8, 0, left, right)  # Python minds where it writes
    assert not drawn.any()
    left, right = np.full(8, 2.0), np.full(8, 12.0)
    kernels._fill.py_func(drawn, 7, 7, 8, 0, left, right)
    assert [cell for cell in range(64) if int(drawn[0]) >> cell & 1] == list(range(58, 64))
