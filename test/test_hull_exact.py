# SPDX-License-Identifier: Apache-2.0
"""The hull's signed distances: exact against every voxel evaluated in NumPy and SciPy, and against pixels by hand."""

import cv2
import numpy as np
import pytest
from camera_rings import LENSES, ball_masks, every_voxel, in_order, look_at, measured, ring

from limbloc_ros.core import silhouettes as outlines
from limbloc_ros.core.camera import Camera, Rig
from limbloc_ros.core.config import HullConfig
from limbloc_ros.core.hull import Hull, carve, evaluate, evaluate_again
from limbloc_ros.core.silhouettes import min_seen


def assert_exact(rig, masks, voxel_m, band_m):
    """`evaluate` finds the very voxels and values; returns how many there are."""
    silhouettes = measured(rig, masks, HullConfig(voxel_m=voxel_m, band_m=band_m))
    every = every_voxel(rig, masks, voxel_m, band_m, silhouettes.names)
    without, all_of_them = (agree(silhouettes, rig, voxel_m, band_m, every, keep) for keep in (False, True))
    assert without <= all_of_them
    return all_of_them


def agree(silhouettes, rig, voxel_m, band_m, every, keep_second):
    """`evaluate` finds what `every_voxel` found; returns how many voxels there are."""
    found, first, second, who = evaluate(silhouettes, band_m, keep_second)
    indices, distances, largest, unsure = every[0], every[1], every[2], every[3].copy()
    assert unsure.mean() < 0.2
    seen = np.isfinite(distances).sum(axis=0)
    d1 = distances[0]
    d2 = distances[1] if len(distances) > 1 else np.full_like(d1, -np.inf)
    wanted = (d1 < band_m) | (keep_second & (d2 < 0))
    wanted &= seen >= min_seen(len(silhouettes.names))
    unsure |= (np.abs(d1 - band_m) < 1e-6) | (np.abs(d2) < 1e-6)
    shape = indices.max(axis=0) - indices.min(axis=0) + 1
    at = np.ravel_multi_index(tuple((found - indices.min(axis=0)).T), shape)
    assert len(np.unique(at)) == len(at)
    got = np.zeros(len(indices), bool)
    got[at] = True
    np.testing.assert_array_equal(got[~unsure], wanted[~unsure])
    sure = ~unsure[at]
    np.testing.assert_allclose(first[sure], np.minimum(d1[at], band_m)[sure], atol=2e-6)
    near = sure & (d2[at] < band_m)
    np.testing.assert_allclose(second[near], d2[at][near], atol=2e-6)
    clear = sure & (d1[at] - d2[at] > 1e-5)
    np.testing.assert_array_equal(who[clear], largest[at][clear])
    return int(got.sum())


def random_rig(rng, lenses):
    """Two to nine cameras anywhere in and around the room, some at each other's backs, with blobs for masks."""
    cameras, masks = [], {}
    for i in range(rng.integers(2, 10)):
        near = rng.random() < 0.3
        position = rng.uniform([-3, -3, 0], [3, 3, 3]) if not near else rng.uniform([-0.8, -0.8, 0.2], [0.8, 0.8, 1.8])
        target = rng.uniform([-0.5, -0.5, 0.5], [0.5, 0.5, 1.5])
        size = tuple(int(n) for n in rng.integers(40, 130, 2))
        lens = lenses[rng.integers(len(lenses))]
        camera = look_at(f"c{i}", position, target, rng.uniform(25, 120), size, lens, rng.uniform(-3, 3))
        mask = np.zeros((camera.height, camera.width), np.uint8)
        for _ in range(rng.integers(1, 5)):
            centre = tuple(int(n) for n in rng.uniform(-0.1, 1.1, 2) * size)
            axes = tuple(int(n) for n in rng.integers(3, 40, 2))
            cv2.ellipse(mask, centre, axes, rng.uniform(0, 180), 0, 360, 255, -1)
        if rng.random() < 0.3:
            mask[rng.random(mask.shape) < 0.05] ^= 255
        cameras.append(camera)
        masks[camera.name] = mask
    low, high = np.array([-1.0, -0.9, 0.0]), np.array([1.0, 1.1, 1.9])
    return Rig(tuple(cameras), low + rng.uniform(-0.05, 0.05, 3), high), masks


@pytest.mark.parametrize("seed", range(12))
def test_blocks_find_what_every_voxel_gives(seed):
    """Random cameras of all lenses, also inside the volume; random masks, also cut by the image's border."""
    rng = np.random.default_rng(seed)
    rig, masks = random_rig(rng, LENSES)
    assert_exact(rig, masks, rng.uniform(0.1, 0.2), rng.uniform(0.03, 0.2))


@pytest.mark.parametrize("lens", LENSES)
def test_distorted_cameras_are_exact(lens):
    """Close wide-angle cameras, bodies at the image's border where the lens enlarges most."""
    rng = np.random.default_rng(7)
    rig = ring(5, radius=1.9, focal=38.0, size=(100, 80), lens=lens)
    masks = {}
    for camera in rig.cameras:
        mask = np.zeros((camera.height, camera.width), np.uint8)
        mask[20:75, 2:60] = 255
        cv2.circle(mask, (85, 12), 14, 255, -1)
        mask[rng.random(mask.shape) < 0.02] = 0
        masks[camera.name] = mask
    assert assert_exact(rig, masks, 0.13, 0.1) > 100


@pytest.mark.parametrize("count", [2, 3, 4, 5, 6, 7, 8, 11, 16])
def test_two_to_sixteen_cameras(count):
    rig = ring(count)
    masks = ball_masks(rig, [((0.1, 0.0, 1.0), 0.4)])
    assert assert_exact(rig, masks, 0.1, 0.15) > 100
    hull = carve(masks, rig, HullConfig(voxel_m=0.05, min_voxels=10))
    assert isinstance(hull, Hull) and hull.cameras == rig.names and not hull.rejected


def test_changed_masks_are_evaluated_again_as_if_from_scratch():
    for seed in range(5):
        rng = np.random.default_rng(seed)
        rig, masks = random_rig(rng, LENSES)
        config = HullConfig(voxel_m=0.08, band_m=0.12)
        before = measured(rig, masks, config)
        if len(before.names) < 2:
            continue
        changes = {}
        for c in rng.choice(len(before.names), 2, replace=False):
            mask = before.whole_mask(c)
            cv2.circle(mask, tuple(int(n) for n in rng.uniform(0, 1, 2) * mask.shape[::-1]), rng.integers(2, 15), 1, -1)
            changes[int(c)] = mask, 0, 0
        after = before.with_masks(changes)
        voxels = evaluate(before, 0.12)
        again = evaluate_again(voxels, before, after, 0.12)
        scratch = evaluate(after, 0.12)
        for mine, theirs in zip(in_order(again), in_order(scratch), strict=True):
            np.testing.assert_array_equal(mine, theirs)
        fresh = outlines._measured(after, None)  # not from what was known before the masks grew
        assert set(map(tuple, after.blocks.tolist())) == set(map(tuple, fresh.blocks.tolist()))
        for mine, theirs in zip(in_order(again), in_order(evaluate(fresh, 0.12)), strict=True):
            np.testing.assert_array_equal(mine, theirs)
        whole = {name: after.whole_mask(c) for c, name in enumerate(after.names)}
        assert_exact(rig, whole, 0.16, 0.12)


def test_a_projection_worked_by_hand():
    """A camera at the origin of a 100 px focal length that looks along +x, and a mask of one column.

    The voxel centre (2.05, 0.05, 1.05) lies 2.05 m deep; x right is world -y, y down is world -z, so its pixel is
    (50 - 100 * 0.05 / 2.05, 50 - 100 * 1.05 / 2.05) = (47.561, -1.22): out of the image. (2.05, 0.05, 0.05) is seen at
    (47.561, 47.561). Foreground are the columns 40 to 45: the outline runs at 45.5, so the point lies 47.561 - 45.5 px
    outside, and a px is 2.05 / 100 m.
    """
    side = look_at("side", (2.05, -3.0, 0.5), (2.05, 0.0, 0.5), size=(101, 101))
    T = np.eye(4)
    T[:3, :3] = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    K = np.array([[100.0, 0.0, 50.0], [0.0, 100.0, 50.0], [0.0, 0.0, 1.0]])
    front = Camera("front", 101, 101, K, T)
    rig = Rig((front, side), np.array([1.0, -1.0, -0.2]), np.array([3.0, 1.0, 1.2]))
    column = np.zeros((101, 101), np.uint8)
    column[:, 40:46] = 255
    wide = np.zeros((101, 101), np.uint8)
    wide[5:96, 5:96] = 255
    silhouettes = measured(rig, {"front": column, "side": wide}, HullConfig(voxel_m=0.1, band_m=0.1))
    indices, first, _, who = evaluate(silhouettes, 0.1)
    values = {tuple(map(int, i)): (float(d), int(w)) for i, d, w in zip(indices, first, who, strict=True)}
    distance, camera = values[20, 0, 0]
    assert distance == pytest.approx((50 - 5 / 2.05 - 45.5) * 2.05 / 100, abs=1e-6)
    assert camera == 0
    # Both cameras must see a voxel when there are but two.
    assert (20, 0, 10) not in values
    # In the middle of the column: column 42.5 is 3 px within both outlines.
    inside = min(values.items(), key=lambda item: item[1][0])
    assert inside[1][0] == pytest.approx(-0.03 * 2.0, abs=0.025)


def test_who_does_not_see_a_voxel_has_no_say():
    """Two of four cameras look away from the body, one of them with a mask of something else, and the body stays."""
    rig = ring(4)
    away = look_at("away", (0.0, -3.0, 1.0), (0.0, -6.0, 1.0))  # the body is behind it
    aside = look_at("aside", (0.0, 3.0, 1.0), (8.0, 3.5, 1.0))  # the body is out of its image
    more = Rig((*rig.cameras, away, aside), rig.volume_min, rig.volume_max)
    balls = [((0.0, 0.0, 1.0), 0.5)]
    masks = ball_masks(rig, balls)
    other = np.zeros((72, 96), np.uint8)
    other[:20, :20] = 255
    config = HullConfig(voxel_m=0.05, repair_depth_m=1.0, shared_veto=0.0)
    alone, both = carve(masks, rig, config), carve({**masks, "away": other, "aside": other}, more, config)
    assert isinstance(alone, Hull) and isinstance(both, Hull)
    np.testing.assert_array_equal(alone.sdf, both.sdf)


def test_folded_points_have_no_say():
    """A barrel lens maps points far from its axis back into the image, where it does not see them."""
    lens = ("radtan", [-0.42, 0.0, 0.0, 0.0])
    camera = look_at("fold", (0.0, -1.2, 0.3), (0.0, 0.0, 0.3), focal=60.0, size=(81, 81), lens=lens)
    point = np.array([1.05, -0.45, 0.35])  # 54 degrees off the axis
    uv, depth = camera.world_to_image(point)
    assert depth > 0 and (uv > 0).all() and (uv < 80).all()
    rig = Rig((camera, *ring(2).cameras), np.array([-1.2, -1.0, 0.0]), np.array([1.2, 1.0, 2.0]))
    masks = ball_masks(Rig(rig.cameras[1:], rig.volume_min, rig.volume_max), [(point, 0.4)])
    empty = np.zeros((81, 81), np.uint8)
    empty[78:, 78:] = 1
    silhouettes = measured(rig, {**masks, "fold": empty}, HullConfig(voxel_m=0.1))
    indices, first, _, _ = evaluate(silhouettes, 0.06)
    at = (indices == np.floor(point / 0.1).astype(int)).all(axis=1)
    assert at.any() and first[at] < 0
