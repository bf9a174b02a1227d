# SPDX-License-Identifier: Apache-2.0
"""Regions to ignore: read from polygons and pictures, kept on saving, and no carving there."""

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from limbloc_ros.core.config import HullConfig
from limbloc_ros.core.errors import RigError
from limbloc_ros.core.hull import Hull, carve
from limbloc_ros.recordings.cases import load_case
from limbloc_ros.rig.rig_file import load_rig, rig_from_mapping, save_rig

CASE = Path(__file__).parent / "data" / "benchmark" / "public_few" / "cams6_p_man_avg"
CAMERA = {
    "name": "cam0",
    "width": 120,
    "height": 90,
    "K": [100, 0, 60, 0, 100, 45, 0, 0, 1],
    "T_world_camera": [[0, 0, -1, 2], [1, 0, 0, 0], [0, -1, 0, 1], [0, 0, 0, 1]],
}


def rig_of(folder=None, **camera):
    data = {"version": 1, "volume": {"min": [-1, -1, 0], "max": [1, 1, 2]}, "cameras": [{**CAMERA, **camera}]}
    return rig_from_mapping(data, "room.yaml", folder)


def test_polygons_are_filled_with_their_outline():
    rig = rig_of(ignore=[[[10, 20], [19, 20], [19, 29], [10, 29]]])
    pixels = rig.cameras[0].ignored_pixels()
    assert pixels.shape == (90, 120)
    assert pixels.sum() == 100  # 10 x 10 px, both borders included
    assert pixels[20:30, 10:20].all()
    assert rig_of().cameras[0].ignored_pixels() is None


def test_a_picture_gives_its_own_pixels_also_after_saving(tmp_path):
    noise = np.random.default_rng(0).random((90, 120), np.float32)
    wanted = (cv2.GaussianBlur(noise, (0, 0), 3) > 0.5).astype(np.uint8)  # blobs with holes
    wanted[5, 5] = wanted[0, 100:102] = 1  # single pixels at the border too
    cv2.imwrite(str(tmp_path / "ignore.png"), wanted * 255)
    rig = rig_of(tmp_path, ignore_mask="ignore.png")
    np.testing.assert_array_equal(rig.cameras[0].ignored_pixels(), wanted)
    save_rig(rig, tmp_path / "saved.yaml")
    np.testing.assert_array_equal(load_rig(tmp_path / "saved.yaml").cameras[0].ignored_pixels(), wanted)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"ignore": [[[1, 2], [3, 4]]]}, "key ignore[0]: expected three or more points"),
        ({"ignore": "left"}, "key ignore: expected a list of polygons"),
        ({"ignore": [[[1, 2, 3], [4, 5, 6], [7, 8, 9]]]}, "key ignore[0]: expected pairs of numbers"),
        ({"ignore_mask": "nothing.png"}, "nothing.png is missing or no picture"),
    ],
)
def test_what_is_wrong_is_said(keys, message):
    with pytest.raises(RigError, match=re.escape(message)):
        rig_of(**keys)


def test_a_picture_of_another_size_is_refused(tmp_path):
    cv2.imwrite(str(tmp_path / "small.png"), np.zeros((45, 60), np.uint8))
    with pytest.raises(RigError, match="expected 120x90 px"):
        rig_of(tmp_path, ignore_mask="small.png")


def test_nothing_is_carved_behind_a_region_to_ignore():
    """A screen in front of one of two cameras hides the legs: ignoring it gives them back."""
    case = load_case(CASE)
    names = case.rig.names[0], case.rig.names[2]  # two: with more, mending gives lost legs back by itself
    rig = replace(case.rig, cameras=tuple(map(case.rig.camera, names)))
    masks = {name: case.masks(0)[name] for name in names}
    name = names[1]
    x, y, w, h = cv2.boundingRect(masks[name])
    left, top, right, bottom = x - 2, y + int(0.7 * h), x + w + 2, y + h + 2
    hidden = {**masks, name: masks[name].copy()}
    hidden[name][top:bottom, left:right] = 0
    polygon = np.array([[left, top], [right - 1, top], [right - 1, bottom - 1], [left, bottom - 1]], float)
    blind = replace(rig, cameras=(rig.cameras[0], replace(rig.cameras[1], ignore=(polygon,))))
    config = HullConfig(voxel_m=0.03)
    whole, lost, kept = (carve(*pair, config) for pair in ((masks, rig), (hidden, rig), (hidden, blind)))
    assert all(isinstance(hull, Hull) for hull in (whole, lost, kept))
    assert lost.inside_count < 0.9 * whole.inside_count
    assert whole.inside_count <= kept.inside_count < 2 * whole.inside_count
    # What a television shows there does not matter.
    noise = {**hidden, name: np.where(blind.cameras[1].ignored_pixels(), np.uint8(255), hidden[name])}
    np.testing.assert_array_equal(carve(noise, blind, config).sdf, kept.sdf)
