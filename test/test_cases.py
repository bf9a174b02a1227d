# SPDX-License-Identifier: Apache-2.0
"""Benchmark case folders: packed masks, truth, and what is said of damaged ones."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from limbloc_ros.core.errors import InputError, RigError
from limbloc_ros.core.pose import JOINT_NAMES
from limbloc_ros.recordings.cases import is_case, load_case, pack_mask, unpack_mask

BENCHMARK = Path(__file__).parent / "data" / "benchmark"
CASE = BENCHMARK / "public_few" / "cams4_p_man_avg"


def test_bits_are_packed_from_the_left():
    mask = np.zeros((2, 11), dtype=np.uint8)
    mask[0, 0] = 255
    mask[1, 8] = 1
    packed = pack_mask(mask)
    assert packed.tolist() == [[0b10000000, 0], [0, 0b10000000]]
    np.testing.assert_array_equal(unpack_mask(packed, 11), np.where(mask != 0, 255, 0))


def test_every_public_case_loads_and_its_joints_lie_inside_the_masks():
    folders = sorted(p.parent for p in BENCHMARK.glob("*/*/calib.json"))
    assert len(folders) == 26
    for folder in folders:
        case = load_case(folder)
        assert set(case.truth) == set(JOINT_NAMES), folder
        pelvis = case.truth["pelvis_centre"]
        assert pelvis.shape == (len(case), 3)
        hit = seen = 0
        for frame in range(0, len(case), 10):
            for name, mask in case.masks(frame).items():
                camera = case.rig.camera(name)
                (u, v), _ = camera.world_to_image(pelvis[frame])
                inside = 0 <= u <= camera.width - 1 and 0 <= v <= camera.height - 1
                if inside and mask.any():  # a dead camera's masks are empty
                    seen += 1
                    hit += bool(mask[round(v), round(u)])
        assert hit >= 0.9 * seen > 0, folder


def test_joints_lie_inside_the_derived_volume():
    for calib in BENCHMARK.glob("*/*/calib.json"):
        case = load_case(calib.parent)
        joints = np.concatenate(list(case.truth.values()))
        assert (joints >= case.rig.volume_min - 1e-6).all()
        assert (joints <= case.rig.volume_max - 0.1).all()


def test_stamps_follow_the_frame_rate(tmp_path):
    case = load_case(copy(tmp_path, meta={"fps": 50}))
    np.testing.assert_allclose(case.stamps[:3], [0.0, 0.02, 0.04])


def test_only_calibration_and_masks_are_needed(tmp_path):
    folder = copy(tmp_path)
    (folder / "meta.json").unlink()
    (folder / "gt.npz").unlink()
    case = load_case(folder)
    assert case.truth == {}
    assert case.stamps[1] == pytest.approx(0.04)


def copy(tmp_path, meta=None):
    folder = tmp_path / "case"
    shutil.copytree(CASE, folder)
    if meta is not None:
        (folder / "meta.json").write_text(json.dumps(meta))
    return folder


def save_masks(folder, change):
    masks = dict(np.load(folder / "masks.npz"))
    change(masks)
    np.savez_compressed(folder / "masks.npz", **masks)


def rename(masks):
    masks["side"] = masks.pop("cam1")


def narrow(masks):
    masks["cam1"] = masks["cam1"][:, :, :40]


def shorten(masks):
    masks["cam1"] = masks["cam1"][:-1]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (rename, r"expected masks of the rig's cameras cam0, cam1, .*, got side"),
        (narrow, r"camera cam1 is 640x480 px, so its masks must be uint8 \[F, 480, 80\], got uint8 \[12, 480, 40\]"),
        (shorten, r"expected equally many frames of every camera, got .*'cam1': 11\b"),
        (dict.clear, r"got none"),
    ],
)
def test_masks_that_do_not_fit_the_cameras(tmp_path, change, message):
    folder = copy(tmp_path)
    save_masks(folder, change)
    with pytest.raises(InputError, match=message):
        load_case(folder)


def test_damaged_files(tmp_path):
    folder = copy(tmp_path)
    assert is_case(folder)
    data = (folder / "masks.npz").read_bytes()
    (folder / "masks.npz").write_bytes(data[: len(data) // 2])
    with pytest.raises(InputError, match=r"masks\.npz cannot be read as an \.npz archive"):
        load_case(folder)
    (folder / "masks.npz").write_bytes(data)
    (folder / "meta.json").write_text("{")
    with pytest.raises(InputError, match=r"meta\.json, line 1: not valid JSON"):
        load_case(folder)
    (folder / "meta.json").write_text('{"fps": 0}')
    with pytest.raises(InputError, match=r"key fps: expected a positive number, got 0"):
        load_case(folder)
    (folder / "calib.json").write_text('{"cameras": []}')
    with pytest.raises(RigError, match=r"expected a list of at least one camera"):
        load_case(folder)
    (folder / "calib.json").unlink()
    with pytest.raises(InputError, match=r"is no benchmark case: expected calib\.json and masks\.npz"):
        load_case(folder)


def test_frames_of_the_empty_room_are_left_out():
    case = load_case(BENCHMARK.parent / "rgb_walk")
    assert (len(case), len(next(iter(case.truth.values()))), case.stamps[0]) == (8, 8, 0.0)
    assert all(mask.any() for frame in range(len(case)) for mask in case.masks(frame).values())
