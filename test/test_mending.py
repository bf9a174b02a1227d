# SPDX-License-Identifier: Apache-2.0
"""What the cameras give back to each other's masks: limbs that one of them lost, but no phantoms."""

import cv2
import numpy as np
import pytest

from limbloc_ros.core import hull
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
    covered = hull.cover_silhouettes(silhouettes, voxels, CONFIG)
    mended = hull.mend_silhouettes(silhouettes, covered, voxels, CONFIG)
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
