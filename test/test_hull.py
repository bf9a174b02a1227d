# SPDX-License-Identifier: Apache-2.0
"""The visual hull: exact against every voxel evaluated in NumPy and SciPy, right on bodies with a known shape."""

import dataclasses
import itertools
import re

import cv2
import numpy as np
import pytest
from scipy import ndimage

from limbloc_ros.core import hull as hulls
from limbloc_ros.core import pipeline
from limbloc_ros.core import silhouettes as outlines
from limbloc_ros.core.camera import Camera, Rig
from limbloc_ros.core.config import HullConfig
from limbloc_ros.core.errors import InputError, NoPerson, RigError
from limbloc_ros.core.hull import NOBODY, Hull, carve, evaluate, evaluate_again, largest_component
from limbloc_ros.core.silhouettes import cleaned, lattice_bounds, measure_silhouettes, min_seen, pack_cameras

LENSES = [
    ("none", []),
    ("radtan", [-0.3, 0.1, 0.002, -0.001]),
    ("radtan", [-0.42, 0.0, 0.0, 0.0]),  # folds far points back into the image
    ("radtan", [0.5, 0.4, 0.01, -0.01]),  # enlarges the border more than twice
    ("radtan", [-0.35, 0.15, 0.0, 0.0, -0.02]),
    ("rational", [1.0, 0.5, 0.001, 0.0, 0.1, 1.3, 0.4, 0.05]),
    ("fisheye", [-0.03, 0.01, -0.002, 0.0]),
    ("fisheye", [0.2, 0.1, 0.0, 0.0]),
]


def look_at(name, position, target, focal=70.0, size=(96, 72), lens=("none", []), roll=0.0):
    """A camera whose optical axis goes from `position` through `target`."""
    forward = np.subtract(target, position) / np.linalg.norm(np.subtract(target, position))
    right = np.cross(forward, [0.0, 0.0, 1.0] if abs(forward[2]) < 0.99 else [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward], axis=1)
    c, s = np.cos(roll), np.sin(roll)
    T = np.eye(4)
    T[:3, :3] = R @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    T[:3, 3] = position
    K = np.array([[focal, 0.0, (size[0] - 1) / 2], [0.0, 1.1 * focal, (size[1] - 1) / 2 + 3.0], [0.0, 0.0, 1.0]])
    return Camera(name, *size, K, T, np.array(lens[1], float), lens[0])


def ring(count, radius=3.0, height=1.2, **how):
    """Cameras around the middle of a room of 2 x 2 x 2 m."""
    angles = np.arange(count) * 2 * np.pi / count + 0.3
    places = [(radius * np.cos(a), radius * np.sin(a), height + 0.7 * (i % 2)) for i, a in enumerate(angles)]
    cameras = [look_at(f"cam{i}", place, (0.0, 0.0, 1.0), **how) for i, place in enumerate(places)]
    return Rig(tuple(cameras), np.array([-1.0, -1.0, 0.0]), np.array([1.0, 1.0, 2.0]))


def ball_masks(rig, balls):
    """Masks of balls (centre, radius): a pixel is foreground when its ray meets one. Undistorted cameras."""
    masks = {}
    for camera in rig.cameras:
        v, u = np.mgrid[: camera.height, : camera.width]
        K = camera.K
        rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], axis=-1)
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        T = camera.T_camera_world
        mask = np.zeros((camera.height, camera.width), np.uint8)
        for centre, radius in balls:
            c = T[:3, :3] @ np.asarray(centre) + T[:3, 3]
            along = rays @ c
            mask[(along > 0) & (c @ c - along**2 < radius**2)] = 255
        masks[camera.name] = mask
    return masks


def measured(rig, masks, config):
    return measure_silhouettes(masks, rig, pack_cameras(rig), config)


def one_to_one(camera, points):
    """1 where the lens maps the way from the axis to a point without turning back, 0 where not, 0.5 close to a turn."""
    if not camera.distortion.any() or len(points) == 0:
        return np.ones(len(points))
    T = camera.T_camera_world
    p = points @ T[:3, :3].T + T[:3, 3]
    part = np.linspace(0.04, 1.06, 27)
    steps = np.stack([part - 1e-4, part + 1e-4])[..., None, None]
    ahead = np.concatenate([steps * (p[:, :2] / p[:, 2:]), np.ones((2, 27, len(p), 1))], axis=-1)
    W = camera.T_world_camera
    uv, _ = camera.world_to_image(ahead @ W[:3, :3].T + W[:3, 3])
    below, above = np.linalg.norm((uv - camera.K[:2, 2]) / np.diag(camera.K)[:2], axis=-1)
    rising = above > below
    fine, nearly = rising.all(axis=0), rising[part < 0.94].all(axis=0)
    return np.where(fine, 1.0, np.where(nearly, 0.5, 0.0))


def every_voxel(rig, masks, voxel_m, band_m, names):
    """Camera distances of every voxel of the volume, by the definition: (indices, sorted distances, who, unsure)."""
    low = np.ceil(rig.volume_min / voxel_m - 0.5 - 1e-9).astype(int)
    high = np.floor(rig.volume_max / voxel_m - 0.5 + 1e-9).astype(int) + 1
    indices = np.stack(np.meshgrid(*map(np.arange, low, high), indexing="ij"), axis=-1).reshape(-1, 3)
    points = (indices + 0.5) * voxel_m
    rows, unsure = [], np.zeros(len(points), bool)
    for name in names:
        camera = rig.camera(name)
        solid = cleaned(masks[name]) > 0
        inner, outer = ndimage.distance_transform_edt(solid), ndimage.distance_transform_edt(~solid)
        field = np.where(solid, 0.5 - inner, outer - 0.5).astype(np.float32)
        uv, depth = camera.world_to_image(points)
        u, v = np.clip(np.nan_to_num(uv, nan=-1e9), -1e9, 1e9).T
        in_image = (u >= 0) & (v >= 0) & (u <= camera.width - 1) & (v <= camera.height - 1) & (depth > 1e-6)
        fold = np.ones(len(points))
        fold[in_image] = one_to_one(camera, points[in_image])
        unsure |= fold == 0.5
        borders = np.stack([u, v, u - camera.width + 1, v - camera.height + 1])
        unsure |= (np.abs(borders) < 1e-6).any(axis=0)
        x = np.clip(u.astype(int), 0, camera.width - 2)
        y = np.clip(v.astype(int), 0, camera.height - 2)
        fx, fy = u - x, v - y
        top = (1 - fx) * field[y, x] + fx * field[y, x + 1]
        bottom = (1 - fx) * field[y + 1, x] + fx * field[y + 1, x + 1]
        distance = ((1 - fy) * top + fy * bottom) * depth / camera.K[0, 0]
        rows.append(np.where(in_image & (fold > 0), distance, -np.inf))
    rows = np.array(rows)
    order = np.argsort(-rows, axis=0, kind="stable")
    return indices, np.take_along_axis(rows, order, axis=0), order[0], unsure


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


def in_order(voxels):
    order = np.lexsort(voxels[0].T)
    return [part[order] for part in voxels]


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


def test_ball():
    """The hull holds the ball; in its middle the distance is its radius; more cameras fit it closer."""
    centre, radius, voxel = np.array([0.07, -0.04, 1.02]), 0.45, 0.03
    excess = []
    for count in (3, 4, 6, 8, 12, 16):
        rig = ring(count, focal=220.0, size=(320, 240))
        masks = ball_masks(rig, [(centre, radius)])
        hull = carve(masks, rig, HullConfig(voxel_m=voxel, repair_depth_m=1.0, min_share=0.0))
        assert isinstance(hull, Hull)
        points = hull.origin_m + voxel * np.stack(np.meshgrid(*map(np.arange, hull.sdf.shape), indexing="ij"), axis=-1)
        away = np.linalg.norm(points - centre, axis=-1)
        # Half a pixel is 7 mm here.
        assert (hull.sdf[away < radius - 0.01] < 0).all()
        deepest = hull.sdf[tuple(np.round((centre - hull.origin_m) / voxel).astype(int))]
        assert deepest == pytest.approx(-radius, abs=0.05)
        if count >= 8:
            close = (np.abs(away - radius) < 0.03) & (np.abs(points[..., 2] - centre[2]) < 0.1)
            np.testing.assert_allclose(hull.sdf[close], (away - radius)[close], atol=0.035)
        excess.append(hull.inside_count * voxel**3 / (4 / 3 * np.pi * radius**3))
    assert all(more > less for more, less in itertools.pairwise(excess)), excess
    assert 0.98 < excess[-1] < 1.04 and excess[0] > 1.1


def test_the_area_that_the_volumes_walls_cut():
    """A ball whose centre lies in a wall, or in an edge of two walls, is cut in discs; on the floor it is not cut."""
    rig = ring(12, radius=4.0, focal=220.0, size=(480, 360))
    disc = np.pi * 0.3**2
    balls = ((0.0, 0.0, 1.0), 0.0), ((1.0, 0.0, 1.0), disc), ((0.0, -1.0, 1.0), disc), ((0.0, 0.0, 2.0), disc), \
        ((-1.0, 0.0, 2.0), disc), ((0.0, 0.0, 0.0), 0.0)  # fmt: skip
    for centre, area in balls:
        hull = carve(ball_masks(rig, [(np.array(centre), 0.3)]), rig, HullConfig(voxel_m=0.02, min_share=0.0))
        assert isinstance(hull, Hull)
        assert hull.cut_area_m2 == pytest.approx(area, rel=0.15), centre


def test_shell_rebuilds_the_hull_bit_for_bit():
    hull = carve(ball_masks(ring(6), [((0.0, 0.0, 1.0), 0.4)]), ring(6), HullConfig(voxel_m=0.05, min_voxels=10))
    assert isinstance(hull, Hull)
    indices, values = hull.shell()
    assert indices.dtype == np.int32 and values.dtype == np.float32
    shuffled = np.random.default_rng(0).permutation(len(indices))
    again = Hull.from_shell(0.05, hull.band_m, indices[shuffled], values[shuffled], hull.cameras, hull.rejected)
    assert again.index_min == hull.index_min and again.sdf.dtype == hull.sdf.dtype
    np.testing.assert_array_equal(again.sdf, hull.sdf)
    assert (again.cameras, again.rejected, again.band_m) == (hull.cameras, hull.rejected, hull.band_m)
    # The border is empty, so that surfaces are closed.
    outside = hull.sdf.copy()
    outside[1:-1, 1:-1, 1:-1] = hull.band_m
    assert (outside == np.float32(hull.band_m)).all()


def test_from_shell_says_what_is_wrong():
    none = np.zeros((0, 3), np.int32)
    with pytest.raises(InputError, match="at least one"):
        Hull.from_shell(0.02, 0.06, none, np.zeros(0, np.float32))
    with pytest.raises(InputError, match="as many"):
        Hull.from_shell(0.02, 0.06, np.zeros((2, 3), np.int32), np.zeros(1, np.float32))
    with pytest.raises(InputError, match="too large"):
        Hull.from_shell(0.02, 0.06, np.array([[0, 0, 0], [9000, 9000, 9000]], np.int32), np.zeros(2, np.float32))


def test_the_same_masks_give_the_same_bits():
    rig = ring(8)
    masks = ball_masks(rig, [((0.0, 0.0, 1.0), 0.35), ((0.0, 0.0, 1.5), 0.2)])
    config = HullConfig(voxel_m=0.04, min_voxels=10)
    hulls_seen = {carve({name: masks[name].copy() for name in order}, rig, config).sdf.tobytes()
                  for order in (rig.names, rig.names[::-1], rig.names)}  # fmt: skip
    assert len(hulls_seen) == 1


# who cut the hull


def who_cut(hull):
    """Lattice indices [V, 3] of the shell's voxels and the row of the camera that decided each."""
    indices, _ = hull.shell()
    local = indices - np.asarray(hull.index_min)
    return indices, hull.cut_by[tuple(local.T)]


def box_masks(rig, half):
    """Masks of a box in the middle of the room as cameras that look along an axis see its middle plane."""
    masks = {}
    for camera in rig.cameras:
        v, u = np.mgrid[: camera.height, : camera.width]
        depth = np.linalg.norm(camera.T_world_camera[:3, 3] - [0.0, 0.0, 1.0])
        rays = np.stack([(u - camera.K[0, 2]) / camera.K[0, 0], (v - camera.K[1, 2]) / camera.K[1, 1]], axis=-1)
        flat = np.concatenate([rays, np.ones((*u.shape, 1))], axis=-1) * depth
        points = flat @ camera.T_world_camera[:3, :3].T + camera.T_world_camera[:3, 3] - [0.0, 0.0, 1.0]
        masks[camera.name] = np.where((np.abs(points) < half).all(axis=-1), 255, 0).astype(np.uint8)
    return masks


@pytest.mark.parametrize("names", [("front", "side"), ("front", "side", "top"), ("top", "front", "side")])
def test_who_cut_a_box(names):
    """A face of a box is cut by a camera that sees it edge on, not by the one that looks at it."""
    places = {"front": (-6.0, 0.0, 1.0), "side": (0.0, -6.0, 1.0), "top": (0.0, 0.0, 7.0)}
    cameras = [look_at(name, places[name], (0.0, 0.0, 1.0), focal=300.0, size=(201, 201)) for name in names]
    rig = Rig(tuple(cameras), np.array([-1.0, -1.0, 0.2]), np.array([1.0, 1.0, 1.8]))
    half = np.array([0.6, 0.45, 0.5])
    masks, config = box_masks(rig, half), HullConfig(voxel_m=0.05, min_share=0.0, min_cameras=2)
    hull = carve(masks, rig, config)
    assert isinstance(hull, Hull)
    assert hull.cut_by.dtype == np.uint8
    assert hull.viewpoints.dtype == np.float32
    np.testing.assert_allclose(hull.viewpoints, [places[name] for name in names], atol=1e-6)
    indices, who = who_cut(hull)
    assert set(who) == set(range(len(names)))
    # by hand: what sticks out most, and who sees it
    beyond = np.abs((indices + 0.5) * 0.05 - [0.0, 0.0, 1.0]) - half
    by = np.array(names)[who]
    for axis, blind in enumerate(("front", "side", "top")):
        others = np.delete(beyond, axis, axis=1).max(axis=1)
        clear = (beyond[:, axis] > -0.03) & (beyond[:, axis] > others + 0.12)
        assert clear.sum() > 100
        assert (by[clear] != blind).all()
    # and by all distances of all voxels
    every, distances, largest, unsure = every_voxel(rig, masks, 0.05, config.band_m, names)
    shape = every.max(axis=0) - every.min(axis=0) + 1
    at = np.ravel_multi_index(tuple((indices - every.min(axis=0)).T), shape)
    clear = (distances[0] - distances[1])[at] > 1e-5
    clear &= ~unsure[at]
    assert clear.mean() > 0.8
    np.testing.assert_array_equal(who[clear], largest[at][clear])
    # elsewhere nobody
    everywhere = hull.cut_by.copy()
    everywhere[tuple((indices - np.asarray(hull.index_min)).T)] = NOBODY
    assert (everywhere == NOBODY).all()


def test_who_cut_a_hull_whose_mask_was_mended():
    """Voxels that are evaluated again are cut by whoever decides then."""
    rig = ring(8, focal=110.0, size=(160, 120))
    arm = [((x, 0.3, 1.0), 0.06) for x in np.linspace(0.2, 0.75, 12)]
    masks = ball_masks(rig, BODY + arm)
    masks["cam1"] = ball_masks(rig, BODY)["cam1"]
    config = dataclasses.replace(CONFIG, shared_veto=0.0)
    silhouettes = measured(rig, masks, config)
    voxels = evaluate(silhouettes, config.band_m)
    covered = hulls.cover_silhouettes(silhouettes, voxels, config)
    mended = hulls.mend_silhouettes(silhouettes, covered, voxels, config)
    assert mended is not silhouettes
    indices, _, _, who = evaluate(mended, config.band_m)
    expected = {tuple(index): int(w) for index, w in zip(indices.tolist(), who, strict=True)}
    hull = carve(masks, rig, config)
    for index, w in zip(*who_cut(hull), strict=True):
        assert expected[tuple(index.tolist())] == w


def test_cameras_that_are_left_out_have_no_viewpoint(eight):
    rig, masks, _ = eight
    hull = carve({**masks, "cam2": np.zeros_like(masks["cam2"])}, rig, CONFIG)
    assert hull.cameras == tuple(name for name in rig.names if name != "cam2")
    places = [rig.camera(name).T_world_camera[:3, 3] for name in hull.cameras]
    np.testing.assert_array_equal(hull.viewpoints, np.float32(places))
    _, who = who_cut(hull)
    assert set(who) <= set(range(7))
    assert len(set(who)) > 3


def test_shell_keeps_who_cut(eight):
    _, _, hull = eight
    indices, values = hull.shell()
    _, who = who_cut(hull)
    shuffled = np.random.default_rng(0).permutation(len(indices))
    again = Hull.from_shell(
        hull.voxel_m, hull.band_m, indices[shuffled], values[shuffled], cut_by=who[shuffled], viewpoints=hull.viewpoints
    )
    assert again.cut_by.dtype == np.uint8
    np.testing.assert_array_equal(again.cut_by, hull.cut_by)
    np.testing.assert_array_equal(again.viewpoints, hull.viewpoints)
    without = Hull.from_shell(hull.voxel_m, hull.band_m, indices, values)
    assert without.cut_by is None
    assert without.viewpoints.shape == (0, 3)


BODY = [((0.0, 0.0, 0.5), 0.3), ((0.0, 0.0, 0.9), 0.3), ((0.0, 0.0, 1.3), 0.25)]
CONFIG = HullConfig(voxel_m=0.04, min_voxels=100)


@pytest.fixture(scope="module")
def eight():
    rig = ring(8, focal=110.0, size=(160, 120))
    masks = ball_masks(rig, BODY)
    return rig, masks, carve(masks, rig, CONFIG)


@pytest.mark.parametrize(
    ("broken", "reason"),
    [
        (lambda mask: np.zeros_like(mask), "empty mask"),
        (lambda mask: np.full_like(mask, 255), "mask is all foreground"),
        (lambda mask: np.roll(mask, 60, axis=1), "denies"),
        (lambda mask: np.where(np.indices(mask.shape).sum(axis=0) < 30, 255, 0).astype(np.uint8), "denies"),
    ],
)
def test_dead_cameras_are_left_out(eight, broken, reason):
    rig, masks, whole = eight
    hull = carve({**masks, "cam2": broken(masks["cam2"])}, rig, CONFIG)
    assert isinstance(hull, Hull)
    assert set(hull.rejected) == {"cam2"} and reason in hull.rejected["cam2"]
    assert set(hull.cameras) == set(rig.names) - {"cam2"}
    assert 0.95 * whole.inside_count < hull.inside_count < 1.3 * whole.inside_count


def test_taking_out_cameras_leaves_what_the_others_measure():
    """Two masks elsewhere say that nothing can be near to cam0. Without them a ball is: its piece is cut anew."""
    others = ring(7, focal=110.0, size=(160, 120))
    close = look_at("close", (-0.9, 0.0, 1.0), (0.0, 0.0, 1.0), focal=60.0, size=(160, 120))
    rig = Rig((close, *others.cameras), others.volume_min, others.volume_max)
    masks = ball_masks(rig, [((-0.5, 0.0, 1.0), 0.15)])
    masks |= ball_masks(Rig(others.cameras[1:6:4], rig.volume_min, rig.volume_max), [((0.3, 0.0, 1.0), 0.2)])
    everyone = measured(rig, masks, CONFIG)
    rest = measured(rig, {name: mask for name, mask in masks.items() if name not in ("cam1", "cam5")}, CONFIG)
    assert rest.margins[0] > everyone.margins[0]
    silhouettes = everyone.without("cam1", "here").without("cam5", "there")
    assert silhouettes.rejected == {"cam1": "here", "cam5": "there"} and silhouettes.names == rest.names
    mine, theirs = (in_order(evaluate(one, 0.06)) for one in (silhouettes, rest))
    for one, other in zip(mine, theirs, strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_camera_without_a_mask_is_named(eight):
    rig, masks, _ = eight
    hull = carve({name: mask for name, mask in masks.items() if name != "cam7"}, rig, CONFIG)
    assert isinstance(hull, Hull) and hull.rejected == {"cam7": "no mask"}


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda masks: {}, "0 usable masks of 8 cameras, expected at least 5"),
        (lambda masks: dict(list(masks.items())[:4]), "4 usable masks.*cam7: no mask"),
        (lambda masks: {name: 0 * mask for name, mask in masks.items()}, "cam0: empty mask"),
    ],
)
def test_too_few_masks_give_no_person(eight, change, reason):
    rig, masks, _ = eight
    result = carve(change(masks), rig, CONFIG)
    assert isinstance(result, NoPerson)
    assert re.search(reason, result.reason)


def test_small_things_and_things_outside_are_no_person():
    rig = ring(6, focal=220.0, size=(320, 240))
    result = carve(ball_masks(rig, [((0.0, 0.0, 1.0), 0.06)]), rig, HullConfig(voxel_m=0.02))
    assert isinstance(result, NoPerson) and "too small" in result.reason
    apart = {camera.name: np.zeros((240, 320), np.uint8) for camera in rig.cameras}
    for mask in apart.values():
        mask[:30, :30] = 255  # every camera sees something in its upper left corner
    result = carve(apart, rig, dataclasses.replace(HullConfig(), min_share=0.0))
    assert isinstance(result, NoPerson) and "no volume in common" in result.reason


def test_wrong_masks_are_refused(eight):
    rig, masks, _ = eight
    with pytest.raises(InputError, match="cam3: expected a mask of 160x120 px as in the rig, got 120x160"):
        carve({**masks, "cam3": masks["cam3"].T}, rig, CONFIG)
    with pytest.raises(RigError, match=r"'nobody'.*cam0, cam1"):
        carve({**masks, "nobody": masks["cam3"]}, rig, CONFIG)


def test_a_limb_that_one_mask_lost_is_given_back(eight):
    """An arm, 12 cm thick: without mending the strict intersection loses it."""
    rig, _, _ = eight
    arm = [((x, 0.3, 1.0), 0.06) for x in np.linspace(0.2, 0.75, 12)]
    masks, alone = ball_masks(rig, BODY + arm), ball_masks(rig, BODY)
    config = dataclasses.replace(CONFIG, voxel_m=0.03)
    whole = carve(masks, rig, config)
    for name in ("cam1", "cam2", "cam6"):  # the others see the arm before the body
        hull = carve({**masks, name: alone[name]}, rig, config)
        assert isinstance(hull, Hull) and name in hull.cameras

        def arm_voxels(one):
            indices, values = one.shell()
            return int(((values < 0) & (indices[:, 0] > 0.4 / 0.03)).sum())

        assert arm_voxels(hull) > 0.8 * arm_voxels(whole)
        lost = measured(rig, {**masks, name: alone[name]}, config)
        strict = evaluate(lost, 0.06)
        inside = strict[0][strict[1] < 0]
        assert (inside[:, 0] > 0.4 / 0.03).sum() < 0.5 * arm_voxels(whole)


def test_clean_masks_stay_the_very_same(eight):
    rig, masks, _ = eight
    silhouettes = measured(rig, masks, CONFIG)
    voxels = evaluate(silhouettes, CONFIG.band_m)
    covered = hulls.cover_silhouettes(silhouettes, voxels, CONFIG)
    assert hulls.unexplained_fraction(silhouettes, covered) == 0.0
    assert hulls.mend_silhouettes(silhouettes, covered, voxels, CONFIG) is silhouettes


def test_cover_paints_squares_around_voxels(eight):
    """Against squares painted pixel by pixel."""
    rig, masks, _ = eight
    silhouettes = measured(rig, masks, CONFIG)
    voxels = evaluate(silhouettes, CONFIG.band_m)
    covered = hulls.cover_silhouettes(silhouettes, voxels, CONFIG)
    points = (voxels[0][voxels[1] < 0] + 0.5) * CONFIG.voxel_m
    for c, name in enumerate(silhouettes.names):
        camera = rig.camera(name)
        (u, v), depth = camera.world_to_image(points)[0].T, camera.world_to_image(points)[1]
        r = 0.875 * CONFIG.voxel_m * camera.K[0, 0] / depth
        image = np.zeros((camera.height, camera.width), np.uint8)
        for x0, x1, y0, y1 in np.stack([u - r, u + r, v - r, v + r], axis=1):
            image[max(0, int(np.ceil(y0))) : int(y1) + 1, max(0, int(np.ceil(x0))) : int(x1) + 1] = 1
        x, y, width, height, offset = silhouettes.boxes[c]
        mine = covered[offset : offset + width * height].reshape(height, width)
        np.testing.assert_array_equal(mine, image[y : y + height, x : x + width])


def test_ragged_masks_still_give_the_body(eight):
    """Bites of noise along every outline, holes and specks: between 85 and 115 % of the volume."""
    rig, masks, whole = eight
    for seed in range(4):
        rng = np.random.default_rng(seed)
        ragged = {}
        for name, mask in masks.items():
            noise = cv2.GaussianBlur(rng.normal(size=mask.shape), (0, 0), 1.5)
            soft = cv2.GaussianBlur(mask / 255.0, (0, 0), 1.5) + 0.8 * noise
            ragged[name] = np.where((soft > 0.5) ^ (rng.random(mask.shape) < 0.003), 255, 0).astype(np.uint8)
        hull = carve(ragged, rig, CONFIG)
        assert isinstance(hull, Hull) and not hull.rejected
        assert 0.85 * whole.inside_count < hull.inside_count < 1.15 * whole.inside_count


def hull_of(solid, voxel_m=0.05, band_m=0.1, at=(3, -4, 0)):
    """A hull with distance -1 cm inside and up to the band outside of a boolean grid."""
    away = ndimage.distance_transform_edt(np.pad(~solid, 4, constant_values=True)) * voxel_m - 0.01
    inside = np.pad(solid, 4)
    sdf = np.where(inside, -0.01, np.minimum(away, band_m)).astype(np.float32)
    indices = np.argwhere(sdf < np.float32(band_m)) + np.array(at)
    return Hull.from_shell(voxel_m, band_m, indices.astype(np.int32), sdf[sdf < np.float32(band_m)])


def test_largest_component_drops_the_rest_and_its_shell():
    solid = np.zeros((30, 20, 20), bool)
    solid[2:10, 2:12, 2:12] = True
    alone = hull_of(solid)
    solid[20:25, 3:8, 3:8] = True
    both = hull_of(solid)
    assert both.sdf.shape != alone.sdf.shape
    kept = largest_component(both)
    assert kept.index_min == alone.index_min
    np.testing.assert_array_equal(kept.sdf, alone.sdf)


@pytest.mark.parametrize("reach", [0, 1, 3, 9])
def test_parts_grow_along_all_axes(reach):
    part = np.random.default_rng(reach).random((7, 1, 13)) < 0.03
    grown = ndimage.binary_dilation(part, np.ones((2 * reach + 1,) * 3, bool))
    np.testing.assert_array_equal(hulls.kernels.grow_part(part, reach), grown)


def test_largest_component_keeps_who_cut_where_it_was():
    solid = np.zeros((30, 20, 20), bool)
    solid[2:10, 2:12, 2:12] = True
    solid[20:25, 3:8, 3:8] = True
    both = hull_of(solid)
    rows = np.random.default_rng(0).integers(0, 8, both.sdf.shape).astype(np.uint8)
    shell = both.sdf < np.float32(both.band_m)
    viewpoints = np.random.default_rng(1).normal(size=(8, 3)).astype(np.float32)
    both = dataclasses.replace(both, cut_by=np.where(shell, rows, np.uint8(NOBODY)), viewpoints=viewpoints)
    kept = largest_component(both)
    assert kept.sdf.shape != both.sdf.shape
    assert kept.cut_by.shape == kept.sdf.shape
    assert kept.viewpoints is viewpoints
    before = {tuple(index): w for index, w in zip(both.shell()[0].tolist(), who_cut(both)[1], strict=True)}
    indices, who = who_cut(kept)
    assert [before[tuple(index)] for index in indices.tolist()] == who.tolist()
    assert (kept.cut_by[kept.sdf >= np.float32(kept.band_m)] == NOBODY).all()
    # the border stays empty and the hull is what its shell makes
    again = Hull.from_shell(
        kept.voxel_m, kept.band_m, *kept.shell(), cut_by=who_cut(kept)[1], viewpoints=kept.viewpoints
    )
    np.testing.assert_array_equal(again.cut_by, kept.cut_by)


def test_largest_component_keeps_a_single_one_and_bridges_small_gaps():
    solid = np.zeros((30, 12, 12), bool)
    solid[2:10, 2:10, 2:10] = True
    one = hull_of(solid)
    assert largest_component(one) is one
    solid[11:15, 4:8, 4:8] = True  # a gap of one voxel
    two = hull_of(solid)
    assert largest_component(two) is two


def test_lattice_bounds_hold_the_centres_in_the_volume():
    rig = dataclasses.replace(ring(2), volume_min=np.array([-1.0, -0.99, 0.0]), volume_max=np.array([1.0, 1.0, 2.04]))
    low, high = lattice_bounds(rig, 0.1)
    assert low.tolist() == [-10, -10, 0] and high.tolist() == [10, 10, 20]


def test_the_warm_up_mends_too():
    """Else the first frame with a broken mask would wait for a compiler."""
    rig, config = pipeline._warm_up_room()
    silhouettes = measured(rig, pipeline._warm_up_masks(), config)
    voxels = evaluate(silhouettes, config.band_m)
    covered = hulls.cover_silhouettes(silhouettes, voxels, config)
    assert hulls.mend_silhouettes(silhouettes, covered, voxels, config) is not silhouettes
