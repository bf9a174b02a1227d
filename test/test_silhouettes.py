# SPDX-License-Identifier: Apache-2.0
"""Signed distances of masks are exact to the last bit; specks and pinholes go, limbs and daylight stay."""

import cv2
import numpy as np
import pytest

from limbloc_ros.core import _silhouettes_kernels as kernels
from limbloc_ros.core.camera import Camera, Rig
from limbloc_ros.core.config import HullConfig
from limbloc_ros.core.errors import RigError
from limbloc_ros.core.silhouettes import (
    cleaned,
    measure_silhouettes,
    min_seen,
    pack_camera,
    pack_cameras,
    signed_distance_px,
)
from limbloc_ros.simulation.ring import default_rig


def exact_distance(mask):
    """The definition: float32 of the root of the smallest squared pixel distance, minus half a pixel."""
    inside = mask != 0
    points = np.argwhere(np.ones_like(inside))
    result = np.zeros(mask.shape, np.float32)
    for there in (True, False):
        others = np.argwhere(inside != there)
        for y, x in points[(inside == there).ravel()]:
            squared = ((others - (y, x)) ** 2).sum(axis=1).min()
            distance = np.sqrt(np.float32(squared)) - np.float32(0.5)
            result[y, x] = -distance if there else distance
    return result


def shape():
    mask = np.zeros((37, 53), np.uint8)
    cv2.circle(mask, (22, 17), 11, 255, -1)
    cv2.rectangle(mask, (30, 20), (47, 24), 255, -1)
    return mask


def test_distances_are_exact():
    """OpenCV's own are not: their last bit depends on where the picture lies in memory."""
    assert (signed_distance_px(shape()) == exact_distance(shape())).all()


def test_distances_of_noise_are_exact():
    rng = np.random.default_rng(0)
    for _ in range(60):
        mask = (rng.random(rng.integers(1, 24, 2)) < rng.random() ** 2).astype(np.uint8)
        if mask.all() or not mask.any():
            continue
        assert (signed_distance_px(mask) == exact_distance(mask)).all()


@pytest.mark.parametrize("most", [1, 2, 5, 17])
def test_distances_beyond_the_most_are_the_most(most):
    for seed in range(5):
        rng = np.random.default_rng(seed)
        mask = np.zeros(rng.integers(2, 50, 2), np.uint8)
        for _ in range(3):
            cv2.circle(mask, tuple(int(n) for n in rng.uniform(0, 1, 2) * mask.shape[::-1]), rng.integers(1, 9), 1, -1)
        if mask.all():
            continue
        exact, out = exact_distance(mask), np.full(mask.shape, np.nan, np.float32)
        assert kernels.signed_distance(mask, most, 100, np.empty(0, np.uint16), out)
        np.testing.assert_array_equal(out, np.minimum(exact, np.float32(most - 0.5)))
        assert kernels.signed_distance(mask, most, 3, np.empty(0, np.int32), out) == (exact.min() > -2.5)
        np.testing.assert_array_equal(out, np.clip(exact, -2.5, np.float32(most - 0.5)))


@pytest.mark.parametrize("shape", [(900, 3), (3, 900), (400, 400), (360, 360)])
def test_distances_too_large_for_sixteen_bits(shape):
    """A mask that is foreground but for its corner, and the other way round: everything is as far as that corner."""
    mask = np.ones(shape, np.uint8)
    mask[0, 0] = 0
    y, x = np.indices(shape)
    expected = np.where(mask > 0, np.float32(0.5) - np.sqrt(np.float32(x**2 + y**2)), np.float32(0.5))
    np.testing.assert_array_equal(signed_distance_px(mask), expected)
    expected = np.where(mask > 0, -expected, -np.float32(0.5))
    np.testing.assert_array_equal(signed_distance_px(1 - mask), expected)


def test_distances_near_opencv_on_a_large_mask():
    """Where the roots of large numbers are not whole, as OpenCV computes them."""
    mask = cv2.resize(shape(), (901, 640), interpolation=cv2.INTER_NEAREST)
    solid = (mask > 0).astype(np.uint8)
    inner = cv2.distanceTransform(solid, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    outer = cv2.distanceTransform(1 - solid, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    np.testing.assert_allclose(signed_distance_px(mask), np.where(solid, 0.5 - inner, outer - 0.5), atol=1e-3)


def test_specks_go_and_limbs_stay():
    mask = np.zeros((120, 100), np.uint8)
    mask[20:70, 30:70] = 255  # 2000 px
    mask[100:103, 10:13] = 255  # 9 of 2000 px: a speck
    mask[90:94, 80:84] = 255  # 16 of 2000 px: a hand that a mask cut off
    mask[40:45, 40:45] = 0  # 25 px: a pinhole, below 1.5 %
    mask[55:62, 50:56] = 0  # 42 px: daylight between arm and trunk
    expected = (mask > 0).astype(np.uint8)
    expected[100:103, 10:13] = 0
    expected[40:45, 40:45] = 1
    np.testing.assert_array_equal(cleaned(mask), expected)
    np.testing.assert_array_equal(cleaned(expected), expected)


def test_cleaning_reads_any_number_as_foreground_and_keeps_its_input():
    mask = np.zeros((30, 30), np.uint8)
    mask[5:25, 5:25] = 7
    before = mask.copy()
    out = cleaned(mask)
    assert out.dtype == np.uint8 and set(np.unique(out)) == {0, 1} and out.sum() == 400
    np.testing.assert_array_equal(mask, before)
    assert not cleaned(np.zeros((30, 30), np.uint8)).any()


@pytest.mark.parametrize("share", [0.0, 0.001, 0.05, 0.4])
def test_bounds_and_lone_pixels_are_those_of_opencv(share):
    rng = np.random.default_rng(5)
    for shape in ((1, 1), (7, 70), (70, 7), (40, 133)):
        mask = np.uint8(rng.random(shape) < share) * np.uint8(200)
        x, y, width, height = box = kernels.bounds(mask)
        assert box == cv2.boundingRect(mask)
        around = cv2.dilate(mask, np.uint8([[1, 1, 1], [1, 0, 1], [1, 1, 1]]))
        expected = ((mask > 0) & (around > 0))[y : y + height, x : x + width]
        np.testing.assert_array_equal(kernels.without_lone_pixels(mask, *box), expected)


def test_small_masks_keep_their_lone_pixels():
    """Beside 99 px (98.5 as its contour gives it) a pixel is no speck; beside 130 it is."""
    for rows, kept in ((9, True), (13, False)):
        mask = np.zeros((30, 30), np.uint8)
        mask[2 : 2 + rows, 2 : 13 if kept else 12] = 1
        mask[20, 20] = 1
        assert cleaned(mask)[20, 20] == kept
    lone = np.zeros((9, 9), np.uint8)
    lone[4, 4] = lone[7, 7] = 255
    assert cleaned(lone).sum() == 2


def test_cleaning_noise_against_labelled_regions():
    """Specks that hold nothing else are what connected components of few pixels are, by another algorithm."""
    rng = np.random.default_rng(3)
    mask = np.zeros((200, 200), np.uint8)
    cv2.circle(mask, (100, 100), 60, 1, -1)
    mask[rng.random(mask.shape) < 0.01] ^= 1
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    body = int(stats[1:, cv2.CC_STAT_AREA].argmax()) + 1
    filled = (labels == body).astype(np.uint8)  # every speck and every pinhole is far below the limits
    _, holes, hole_stats, _ = cv2.connectedComponentsWithStats(1 - filled, connectivity=4)
    for label in range(1, len(hole_stats)):
        if hole_stats[label, cv2.CC_STAT_AREA] < 100:
            filled[holes == label] = 1
    np.testing.assert_array_equal(cleaned(mask), filled)


def rig_of(position, focal=100.0):
    """One camera that looks along +x, in a room of x, y in -1 to 1 and z in 0 to 2."""
    T = np.eye(4)
    T[:3, :3] = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    T[:3, 3] = position
    K = np.array([[focal, 0.0, 99.5], [0.0, focal, 74.5], [0.0, 0.0, 1.0]])
    return Rig((Camera("cam", 200, 150, K, T),), np.array([-1.0, -1.0, 0.0]), np.array([1.0, 1.0, 2.0]))


def one_mask(rig, config=None):
    mask = np.zeros((150, 200), np.uint8)
    mask[60:90, 95:105] = 255
    return measure_silhouettes({"cam": mask}, rig, pack_cameras(rig), config or HullConfig())


@pytest.mark.parametrize("x", [-6.0, -3.0, -1.6])
def test_pieces_end_where_nothing_nearer_than_the_band_can_be_seen(x):
    silhouettes = one_mask(rig_of((x, 0.0, 1.0)))
    x0, y0, width, height, _ = silhouettes.boxes[0]
    nearest = -1.0 - x
    margin = min(95 - x0, 60 - y0, x0 + width - 105, y0 + height - 90)
    assert margin * nearest / 100.0 >= 0.06
    assert margin <= 100 * 0.06 / (0.5 * nearest) + 4
    exact = exact_distance(silhouettes.whole_mask(0))[y0:, x0:][:height, :width]
    np.testing.assert_array_equal(silhouettes.piece(0), np.minimum(exact, silhouettes.margins[0] - 0.5))


def test_wide_images_of_lenses_are_cut_as_well():
    """At the corners of a 16:9 image some space is beyond what the lens's polynomial tells; it is not near for that."""
    rig = default_rig(8, 640, 360)
    mask = np.zeros((360, 640), np.uint8)
    mask[120:240, 300:340] = 255
    masks = {camera.name: mask for camera in rig.cameras}
    silhouettes = measure_silhouettes(masks, rig, pack_cameras(rig), HullConfig())
    assert silhouettes.margins.max() < 60


def test_a_camera_in_the_volume_keeps_its_whole_image():
    assert one_mask(rig_of((0.0, 0.0, 1.0))).boxes[0].tolist() == [0, 0, 200, 150, 0]


def test_masks_that_grow_get_larger_pieces():
    silhouettes = one_mask(rig_of((-3.0, 0.0, 1.0)))
    grown = silhouettes.whole_mask(0)
    grown[20:60, 98:101] = 1
    after = silhouettes.with_masks({0: (grown, 0, 0)})
    x0, y0, width, height, _ = after.boxes[0]
    assert y0 < 20 and (after.whole_mask(0) == grown).all()
    exact = exact_distance(grown)[y0:, x0:][:height, :width]
    np.testing.assert_array_equal(after.piece(0), np.minimum(exact, after.margins[0] - 0.5))
    changes = after.changes_since(silhouettes)
    left, top, columns, rows, _ = changes.frames[0]
    # From the new tip's margin to where the old top's influence ends.
    assert top == y0 or top >= 20 - after.margins[0]
    assert left < 98 < 101 < left + columns and 60 < top + rows < 90
    counted = np.diff(np.diff(changes.sums.reshape(rows + 1, columns + 1), axis=0), axis=1)
    before = np.full(grown.shape, np.inf)
    x, y, width, height, _ = silhouettes.boxes[0]
    before[y : y + height, x : x + width] = silhouettes.piece(0)
    nearer = (exact_distance(grown) < before) & (exact_distance(grown) < after.margins[0] - 0.5)
    np.testing.assert_array_equal(counted > 0, nearer[top : top + rows, left : left + columns])
    assert nearer.sum() == counted.sum()
    assert not silhouettes.with_masks({}).changes_since(silhouettes).frames[:, 2:].any()


def test_most_cameras_must_see_a_voxel():
    assert [min_seen(n) for n in (1, 2, 3, 4, 8, 16)] == [1, 2, 2, 3, 5, 9]


def test_an_image_of_one_row_is_refused():
    camera = Camera("flat", 640, 1, np.array([[100.0, 0, 0], [0, 100.0, 0], [0, 0, 1.0]]), np.eye(4))
    with pytest.raises(RigError, match="flat: expected an image of 2x2 px or more, got 640x1"):
        pack_camera(camera)
