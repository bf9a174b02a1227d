# SPDX-License-Identifier: Apache-2.0
"""The checker on the benchmark's people: a true rig is called good, and each injected fault is found and named."""

import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from limbloc_ros import cli
from limbloc_ros.recordings.cases import load_case
from limbloc_ros.rig.check import Report, check
from limbloc_ros.rig.consistency import low_view, make_grid, mean_scores, score, shrink_masks
from limbloc_ros.rig.fine_check import FineFrames, look_closely
from limbloc_ros.rig.rig_file import load_rig, save_rig

DATA = Path(__file__).parent / "data" / "benchmark"
WALK, JUMP = DATA / "public" / "seq_walk_circle", DATA / "public_motion" / "mocap_jump"
FPS = 25.0


@cache
def case(folder):
    return load_case(folder)


@cache
def recording(folder):
    """Every second frame would lose the delays: all frames, small."""
    of = case(folder)
    views = [low_view(camera) for camera in of.rig.cameras]
    return [shrink_masks(views, of.masks(i)) for i in range(len(of))]


def with_camera(rig, name, **changes):
    return replace(rig, cameras=tuple(replace(c, **changes) if c.name == name else c for c in rig.cameras))


def turned(rig, name, degrees, axis=(0.0, 1.0, 0.0)):
    T = rig.camera(name).T_world_camera.copy()
    T[:3, :3] = T[:3, :3] @ Rotation.from_rotvec(np.radians(degrees) * np.array(axis)).as_matrix()
    return with_camera(rig, name, T_world_camera=T)


def world_moved(rig, T=None, scale=1.0):
    """The same rig in another world."""
    cameras = []
    for camera in rig.cameras:
        pose = (np.eye(4) if T is None else T) @ camera.T_world_camera
        pose[:3, 3] *= scale
        cameras.append(replace(camera, T_world_camera=pose))
    return replace(rig, cameras=tuple(cameras))


def kinds(report):
    return [(finding.kind, finding.cameras) for finding in report.findings if finding.severe]


@pytest.mark.parametrize(
    "folder",
    [
        "public/poses_p_child_8y",
        "public_noisy/noisy_p_man_avg",
        "public_noisy/noisy_seq_wave",
        "public_few/cams4_p_man_avg",
        "public_clothed/clothed_p_woman_dress",
    ],
)
def test_a_true_rig_is_good(folder):
    """Also with ragged masks, holes, false blobs, a limb missing in a camera, and few cameras."""
    report = check(case(DATA / folder).rig, recording(DATA / folder), fps=FPS if "seq" in folder else None)
    assert report.good, report.findings
    assert report.scores.together < 0.05


def test_millimetres_are_noticed():
    report = check(world_moved(case(WALK).rig, scale=1000.0), recording(WALK))
    assert kinds(report) == [("unit", ())]
    assert "millimetres" in report.findings[0].text


def test_a_flipped_world_is_noticed():
    report = check(world_moved(case(WALK).rig, np.diag([1.0, -1, -1, 1])), recording(WALK))
    assert kinds(report) == [("up", ())]
    assert "upside down" in report.findings[0].text


def test_y_up_is_noticed():
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("x", -90, degrees=True).as_matrix()
    report = check(world_moved(case(WALK).rig, T), recording(WALK))
    assert kinds(report) == [("up", ())]
    assert "import again with --up y" in report.findings[0].text


def test_heels_59_cm_under_the_floor():
    T = np.eye(4)
    T[2, 3] = -0.59
    report = check(world_moved(case(WALK).rig, T), recording(WALK))
    assert kinds(report) == [("floor", ())]
    assert re.search(r"feet are 0\.(5[5-9]|6[0-4]) m below the floor", report.findings[0].text)


def test_a_wrong_scale_shows_in_a_known_height():
    stature = case(WALK).meta.get("stature", 1.75)
    report = check(world_moved(case(WALK).rig, scale=0.85), recording(WALK), height_m=stature)
    assert kinds(report) == [("height", ())]
    assert "lengths are off by -1" in report.findings[0].text


@pytest.mark.parametrize(
    ("folder", "pair"), [("public/seq_walk_circle", ("cam1", "cam4")), ("public_few/cams4_p_man_avg", ("cam0", "cam3"))]
)
def test_exchanged_cameras_are_named(folder, pair):
    rig = case(DATA / folder).rig
    a, b = (rig.names.index(name) for name in pair)
    exchanged = [{{a: b, b: a}.get(c, c): mask for c, mask in frame.items()} for frame in recording(DATA / folder)]
    assert kinds(check(rig, exchanged)) == [("swap", pair)]


@pytest.mark.parametrize(("folder", "camera", "frames"), [(JUMP, "cam1", -3), (WALK, "cam3", 4)])
def test_a_late_camera_is_named_with_its_delay(folder, camera, frames):
    rig, good = case(folder).rig, recording(folder)
    c = rig.names.index(camera)
    last = len(good) - 1
    late = [{**frame, c: good[min(max(i - frames, 0), last)][c]} for i, frame in enumerate(good)]
    report = check(rig, late, fps=FPS)
    assert kinds(report) == [("time", (camera,))]
    assert f"{'late' if frames > 0 else 'early'} by {abs(frames)} frames" in report.findings[0].text


@pytest.mark.parametrize(
    ("folder", "camera", "degrees", "axis"),
    [
        ("public/seq_walk_circle", "cam5", 1.5, (0, 1, 0)),
        ("public/poses_p_man_avg", "cam2", 3.0, (0.6, 0.8, 0)),
        ("public_noisy/noisy_p_man_avg", "cam2", 2.0, (0, 1, 0)),
    ],
)
def test_a_bumped_camera_is_named_with_its_turn(folder, camera, degrees, axis):
    rig = turned(case(DATA / folder).rig, camera, degrees, axis)
    report = check(rig, recording(DATA / folder))
    assert kinds(report) == [("place", (camera,))]
    move = report.move[camera]
    assert np.degrees(move.turn_rad) == pytest.approx(degrees, abs=0.5)
    assert move.after < 0.3 * move.before
    # The pose that it proposes is the true one, as far as a person in one place can tell.
    true = case(DATA / folder).rig.camera(camera)
    point = np.array([0.0, 0.0, 1.0])
    proposed = replace(true, T_world_camera=move.T_world_camera)
    assert np.linalg.norm(proposed.world_to_image(point)[0] - true.world_to_image(point)[0]) < 6


def test_a_camera_whose_masks_are_wrong_is_named():
    """Mirrored images: neither a delay nor a pose explains them."""
    rig = case(WALK).rig
    wrong = [{**frame, 2: np.ascontiguousarray(frame[2][:, ::-1])} for frame in recording(WALK)]
    report = check(rig, wrong, fps=FPS)
    assert next(f.cameras for f in report.findings if f.severe) == ("cam2",)


def test_a_stranger_in_one_camera_is_no_fault_of_the_rig():
    """A shadow or a screen far from the person: only its own camera has unexplained foreground."""
    blob = [{**frame, 3: frame[3].copy()} for frame in recording(WALK)[:8]]
    for frame in blob:
        frame[3][120:175, 5:45] = 1
    report = check(case(WALK).rig, blob)
    assert report.good
    assert [(f.kind, f.cameras) for f in report.findings] == [("mask", ("cam3",))]
    assert "`ignore`" in report.findings[0].text


def test_empty_masks_and_strangers_are_said():
    rig = case(WALK).rig
    assert "nothing can be compared" in check(rig, [{}, {}]).findings[0].text
    corner = np.zeros((180, 240), np.uint8)
    corner[:20, :30] = 1
    nowhere = [{c: np.ascontiguousarray(np.rot90(corner, c % 2 * 2)) for c in range(8)}]
    assert not check(rig, nowhere).good


def test_poses_the_other_way_round_are_noticed():
    rig = case(WALK).rig
    inverse = tuple(replace(c, T_world_camera=c.T_camera_world) for c in rig.cameras)
    assert not check(replace(rig, cameras=inverse), recording(WALK)).good


def test_scores_worked_by_hand():
    """Perfect silhouettes leave nothing unexplained; a camera that sees nobody there takes the whole blame."""
    grid = make_grid(case(WALK).rig, most=250_000)
    frame = recording(WALK)[10]
    assert score(grid, frame).together < 0.01
    shifted = {**frame, 4: np.roll(frame[4], 90, axis=1)}
    scores = mean_scores([score(grid, shifted)], grid.names)
    assert scores.together > 0.9
    assert int(np.nanargmax(scores.blame)) == 4
    assert scores.without[4] < 0.01


def looked_closely(rig, of, frames):
    kept, report = FineFrames(rig), Report()
    for i in frames:
        kept.add(of.masks(i))
    look_closely(rig, report, kept)
    return report


def test_a_lens_that_is_off_by_a_hundredth_of_the_image_is_found_on_a_closer_look():
    """Too little for images of 240 px; with the camera turned, silhouettes agree again."""
    of = case(DATA / "public_few" / "cams6_p_child_8y")
    off = of.rig.camera("cam2").K + np.array([[0, 0, -4.0], [0, 0, 4.0], [0, 0, 0]])
    rig = with_camera(of.rig, "cam2", K=off)
    views = [low_view(camera) for camera in rig.cameras]
    assert kinds(check(rig, [shrink_masks(views, of.masks(i)) for i in range(len(of))])) == []
    report = looked_closely(rig, of, range(len(of)))
    (finding,) = report.findings
    assert finding.kind == "place"
    assert not finding.severe
    assert re.search(r"cam2 is a little off: its image by about [567] px", finding.text)
    better = with_camera(rig, "cam2", T_world_camera=report.move["cam2"].T_world_camera)
    assert looked_closely(better, of, range(len(of))).findings == []


def test_ragged_masks_of_a_true_rig_are_no_lens_that_is_off():
    of = case(DATA / "public_noisy" / "noisy_seq_wave")
    assert looked_closely(of.rig, of, range(0, len(of), max(1, len(of) // 4))).findings == []


def test_few_frames_are_kept_of_any_number():
    of = case(WALK)
    kept = FineFrames(of.rig)
    for _ in range(100):
        kept.add({})
    assert kept.few() == []
    for i in range(20):
        kept.add(of.masks(i % len(of)))
    assert 1 <= len(kept.few()) <= 6
    assert all(len(frame) == len(of.rig.cameras) for frame in kept.few())


def test_the_command_line(tmp_path, capsys):
    rig = turned(case(WALK).rig, "cam5", 2.0)
    save_rig(rig, tmp_path / "bad.yaml")
    command = ["rig", "check", str(WALK), "--rig", str(tmp_path / "bad.yaml"), "--frames", "20"]
    fixed = tmp_path / "fixed.yaml"
    assert cli.main([*command, "--report", str(tmp_path / "page"), "--fix", str(fixed)]) == 1
    said = capsys.readouterr().out
    assert "WRONG: cam5 contradicts the others" in said
    page = (tmp_path / "page" / "check.html").read_text()
    assert page.count("data:image/png") == 3
    for name in ("silhouettes.png", "pairs.png", "rig.png"):
        assert cv2.imread(str(tmp_path / "page" / name)).std() > 10
    assert load_rig(fixed).names == rig.names
    assert cli.main(["rig", "check", str(WALK), "--rig", str(fixed), "--frames", "20"]) == 0
    assert "good: nothing contradicts" in capsys.readouterr().out
    assert cli.main([*command, "--height", "17"]) == 2
