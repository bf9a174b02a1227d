# SPDX-License-Identifier: Apache-2.0
"""What the cameras give back to each other's masks: limbs that one of them lost, but no phantoms."""

import dataclasses

import cv2
import numpy as np
import pytest
from camera_rings import LENSES, ball_masks, measured, one_to_one, ring

from limbloc_ros.core import hull, mending
from limbloc_ros.core._mending_kernels import BLOCK
from limbloc_ros.core.config import HullConfig
from limbloc_ros.core.silhouettes import measure_silhouettes, pack_cameras
from limbloc_ros.recordings.cases import Case, load_case

CONFIG = HullConfig()


@pytest.fixture(scope="module")
def four(request: pytest.FixtureRequest) -> Case:
    return load_case(request.config.rootpath / "test" / "data" / "benchmark" / "public_few" / "cams4_p_man_avg")


def volumes(case: Case, masks: dict[str, np.ndarray]) -> tuple[int, int]:
    """Inside voxels of the strict intersection, and after mending."""
    silhouettes = measure_silhouettes(masks, case.rig, pack_cameras(case.rig), CONFIG)
    voxels = hull.evaluate(silhouettes, CONFIG.band_m)
    covered = mending.cover_silhouettes(silhouettes, voxels, CONFIG)
    mended = mending.mend_silhouettes(silhouettes, covered, voxels, CONFIG)
    after = hull.evaluate(mended, CONFIG.band_m)
    return int((voxels[1] < 0).sum()), int((after[1] < 0).sum())


@pytest.mark.parametrize("frame", [0, 4, 8])
def test_clean_masks_of_four_cameras_gain_no_phantom_volume(four: Case, frame: int) -> None:
    strict, mended = volumes(four, four.masks(frame))
    assert mended <= 1.01 * strict


def test_an_arm_that_one_of_four_masks_lost_comes_back(four: Case) -> None:
    frame = 0
    masks = four.masks(frame)
    whole, _ = volumes(four, masks)
    camera = four.rig.cameras[0]
    uv, _ = camera.world_to_image(np.stack([four.truth[f"{j}_L"][frame] for j in ("elbow", "hand")]))
    (x0, y0), (x1, y1) = uv.round().astype(int).tolist()
    masks[camera.name] = cv2.line(masks[camera.name].copy(), (x0, y0), (x1, y1), 0, 24)
    strict, mended = volumes(four, masks)
    assert strict < whole
    assert whole - mended < 0.5 * (whole - strict)


@pytest.fixture(scope="module")
def eight(request: pytest.FixtureRequest) -> Case:
    return load_case(request.config.rootpath / "test" / "data" / "benchmark" / "public" / "seq_walk_circle")


def inside(case: Case, masks: dict[str, np.ndarray], point: np.ndarray) -> float:
    """Signed distance of the carved hull at a point, m."""
    carved = hull.largest_component(hull.carve(masks, case.rig, CONFIG))
    at = np.round((point - carved.origin_m) / carved.voxel_m).astype(int)
    fits = (at >= 0).all() and (at < carved.sdf.shape).all()
    return float(carved.sdf[tuple(at)]) if fits else CONFIG.band_m


def test_a_shin_that_two_of_eight_masks_lost_comes_back(eight: Case) -> None:
    frame = 20
    masks = eight.masks(frame)
    ends = np.stack([eight.truth[f"{j}_L"][frame] for j in ("knee", "ankle")])
    for camera in (eight.rig.cameras[1], eight.rig.cameras[4]):
        uv, _ = camera.world_to_image(ends)
        (x0, y0), (x1, y1) = uv.round().astype(int).tolist()
        masks[camera.name] = cv2.line(masks[camera.name].copy(), (x0, y0), (x1, y1), 0, 30)
    middle = ends.mean(axis=0)
    silhouettes = measure_silhouettes(masks, eight.rig, pack_cameras(eight.rig), CONFIG)
    voxels = hull.evaluate(silhouettes, CONFIG.band_m)
    covered = mending.cover_silhouettes(silhouettes, voxels, CONFIG)
    once = hull.evaluate(mending.mend_silhouettes(silhouettes, covered, voxels, CONFIG), CONFIG.band_m)
    left = (once[0][once[1] < 0] + 0.5) * CONFIG.voxel_m
    assert np.linalg.norm(left - middle, axis=1).min() > 0.04  # each of the two was outvoted by nobody
    assert inside(eight, masks, middle) < -0.02
    assert inside(eight, eight.masks(frame), middle) < -0.02


def test_clean_masks_of_eight_cameras_gain_nothing_from_outvoting_two(eight: Case) -> None:
    silhouettes = measure_silhouettes(eight.masks(20), eight.rig, pack_cameras(eight.rig), CONFIG)
    voxels = hull.evaluate(silhouettes, CONFIG.band_m)
    covered = mending.cover_silhouettes(silhouettes, voxels, CONFIG)
    assert mending.mend_twice_denied(silhouettes, covered, voxels, CONFIG) is silhouettes


@pytest.mark.parametrize("lens", [LENSES[0], LENSES[3]], ids=lambda lens: lens[0])
def test_no_voxel_that_two_masks_miss_is_overlooked(lens: tuple[str, list[float]]) -> None:
    """Halving blocks leaves every voxel that two cameras deny at most, of all in the room, looked at one by one."""
    config = dataclasses.replace(CONFIG, voxel_m=0.04, band_m=0.08)
    rig = ring(7, focal=90.0, lens=lens)
    masks = ball_masks(rig, [((0.0, 0.1, 1.0), 0.4), ((0.5, -0.6, 0.7), 0.2)])
    silhouettes = measured(rig, masks, config)
    low, high = silhouettes.lattice
    blocks = mending._rarely_denied(low, high, silhouettes)
    kept = np.zeros(high - low, bool)
    for i, j, k in blocks - low:
        kept[i : i + BLOCK, j : j + BLOCK, k : k + BLOCK] = True
    local = np.random.default_rng(0).integers(0, high - low, (2000, 3))
    points = (local + low + 0.5) * config.voxel_m
    denied, seen = np.zeros(len(points), int), np.zeros(len(points), int)
    for c, camera in enumerate(rig.cameras):
        uv, depth = camera.world_to_image(points)
        visible = (depth > 0) & (uv >= 0).all(axis=1) & (uv <= (camera.width - 1, camera.height - 1)).all(axis=1)
        visible &= one_to_one(camera, points) == 1.0
        x, y = np.where(visible[:, None], np.floor(uv + 0.5), 0).astype(int).T
        seen += visible
        denied += visible & (silhouettes.whole_mask(c)[y, x] == 0)
    wanted = local[(denied <= 2) & (seen >= 4)]
    assert len(wanted) > 30
    assert kept[tuple(wanted.T)].all()
    assert kept.mean() < 0.5
