# SPDX-License-Identifier: Apache-2.0
"""What each camera has to say in a hull: who cut it, who is left out, which masks are mended."""

import dataclasses
import re

import cv2
import numpy as np
import pytest
from camera_rings import BODY, CONFIG, ball_masks, every_voxel, in_order, look_at, measured, ring, who_cut

from limbloc_ros.core import mending, pipeline
from limbloc_ros.core.camera import Rig
from limbloc_ros.core.config import HullConfig
from limbloc_ros.core.errors import InputError, NoPerson, RigError
from limbloc_ros.core.hull import NOBODY, Hull, carve, evaluate


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
    covered = mending.cover_silhouettes(silhouettes, voxels, config)
    mended = mending.mend_silhouettes(silhouettes, covered, voxels, config)
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
    covered = mending.cover_silhouettes(silhouettes, voxels, CONFIG)
    assert mending.unexplained_fraction(silhouettes, covered) == 0.0
    assert mending.mend_silhouettes(silhouettes, covered, voxels, CONFIG) is silhouettes


def test_cover_paints_squares_around_voxels(eight):
    """Against squares painted pixel by pixel."""
    rig, masks, _ = eight
    silhouettes = measured(rig, masks, CONFIG)
    voxels = evaluate(silhouettes, CONFIG.band_m)
    covered = mending.cover_silhouettes(silhouettes, voxels, CONFIG)
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


def test_the_warm_up_mends_too():
    """Else the first frame with a broken mask would wait for a compiler."""
    rig, config = pipeline._warm_up_room()
    silhouettes = measured(rig, pipeline._warm_up_masks(), config)
    voxels = evaluate(silhouettes, config.band_m)
    covered = mending.cover_silhouettes(silhouettes, voxels, config)
    assert mending.mend_silhouettes(silhouettes, covered, voxels, config) is not silhouettes
