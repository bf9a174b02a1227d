# SPDX-License-Identifier: Apache-2.0
"""How the cameras agree, against plain versions: small masks as OpenCV's, scores with whole images of every hull."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from limbloc_ros.core.camera import Camera
from limbloc_ros.recordings.cases import load_case
from limbloc_ros.rig import consistency
from limbloc_ros.rig.consistency import cover, inside, low_view, make_grid, shrink_masks, unexplained_share

DATA = Path(__file__).parent / "data" / "benchmark"


@pytest.mark.parametrize("size", [(640, 480), (960, 720), (641, 479), (480, 640), (500, 240), (200, 150)])
def test_small_masks_are_those_of_opencv(size):
    rng = np.random.default_rng(3)
    camera = Camera("cam", *size, np.array([[500.0, 0, size[0] / 2], [0, 500.0, size[1] / 2], [0, 0, 1]]), np.eye(4))
    noise = rng.integers(0, 2, size[::-1]).astype(np.uint8)
    blobs = np.zeros(size[::-1], np.uint8)
    for _ in range(6):
        at, axes = rng.integers(0, size), rng.integers(1, 90, 2)
        cv2.ellipse(blobs, [int(n) for n in at], [int(n) for n in axes], 30, 0, 360, 255, -1)
    for low_px in (97, 240):
        view = low_view(camera, low_px)
        small = (view.camera.width, view.camera.height)
        for mask in (noise, blobs, np.zeros_like(noise), np.ones_like(noise)):
            expected = cv2.resize((mask != 0).astype(np.float32), small, interpolation=cv2.INTER_AREA) >= 0.5
            np.testing.assert_array_equal(view.shrink(mask), expected)


def plain_score(grid, masks):
    """together, without, unexplained, alone."""
    cameras = list(masks)
    kept = np.stack([inside(grid, c, masks[c]) for c in cameras])
    enough = (grid.pixels[cameras] >= 0).sum(axis=0) > max(1, len(cameras) // 2)
    hull = np.flatnonzero(kept.all(axis=0) & enough)
    unexplained = [unexplained_share(masks[c], cover(grid, c, hull)) for c in cameras]
    without, alone = [], []
    for i in range(len(cameras)):
        rest = np.flatnonzero(np.delete(kept, i, axis=0).all(axis=0) & enough)
        shares = [unexplained_share(masks[k], cover(grid, k, rest)) for k in cameras]
        alone.append(shares.pop(i))
        without.append(np.mean(shares) if len(shares) > 1 else np.nan)
    return np.mean(unexplained), without, unexplained, alone


@pytest.mark.parametrize("degrees", [0.0, 3.0])
@pytest.mark.parametrize(
    "folder", ["public/poses_p_man_avg", "public_noisy/noisy_p_man_avg", "public_few/cams4_p_man_avg"]
)
def test_scores_are_those_of_whole_images(folder, degrees):
    case = load_case(DATA / folder)
    first, *others = case.rig.cameras
    T = first.T_world_camera.copy()
    T[:3, :3] = T[:3, :3] @ Rotation.from_rotvec([0, np.radians(degrees), 0]).as_matrix()
    ignored = np.array([[0, 0], [300, 0], [300, 200], [0, 200]])
    cameras = (replace(first, T_world_camera=T), replace(others[0], ignore=(ignored,)), *others[1:])
    grid = make_grid(replace(case.rig, cameras=cameras), most=30_000)
    for i in range(2):
        masks = shrink_masks(grid.views, case.masks(i))
        for some in (masks, dict(list(masks.items())[::-1]), dict(list(masks.items())[:2])):
            scores = consistency.score(grid, some)
            together, without, unexplained, alone = plain_score(grid, some)
            assert scores.together == together
            np.testing.assert_array_equal(scores.without, without)
            np.testing.assert_array_equal(scores.unexplained, unexplained)
            np.testing.assert_array_equal(scores.alone, alone)


@pytest.mark.parametrize(
    ("model", "lens"),
    [
        ("radtan", (-0.2, 0.05, 0.001, -0.002)),
        ("fisheye", (0.05, -0.01, 0.002, 0.001)),
        ("rational", (-0.1, 0.02, 0.0, 0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.05, -0.04)),  # a tilted sensor
    ],
)
def test_points_are_looked_up_where_the_camera_sees_them(model, lens):
    K = np.array([[150.0, 0.0, 119.5], [0.0, 152.0, 89.5], [0.0, 0.0, 1.0]])
    camera = Camera("cam", 240, 180, K, np.eye(4), np.array(lens), model)
    points = np.random.default_rng(3).uniform([-2, -2, -1], [2, 2, 4], (500, 3))
    points[0] = 0, 0, 2
    found = consistency.look_up(camera, points)
    uv, depth = camera.world_to_image(points)
    beside = np.abs(points[:, :2]) > 1.4 * np.array([240, 180]) / K[[0, 1], [0, 1]] * points[:, 2:]
    for n, (u, v) in enumerate(uv):
        x, y = (-1, -1) if depth[n] <= 0 or beside[n].any() else (round(u), round(v))
        assert found[n] == (y * 240 + x if 0 <= x < 240 and 0 <= y < 180 else -1)
    assert (found >= 0).sum() > 30
