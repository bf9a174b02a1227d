# SPDX-License-Identifier: Apache-2.0
"""What the viewer shows, without its window: scenes of frames, playback, and what it says when it cannot."""

import sys
from pathlib import Path

import numpy as np
import pytest
from figure_poses import fitted_states, pose_of

from limbloc_ros import cli
from limbloc_ros.core.config import HullConfig
from limbloc_ros.core.errors import InputError, NoPerson
from limbloc_ros.recordings.cases import load_case
from limbloc_ros.recordings.results import FrameResult, Run
from limbloc_ros.report.viewer_scene import COLOURS, LAYERS, Masks, Playback, RunScene, camera_lines
from limbloc_ros.report.viewer_window import load_open3d, view_point
from limbloc_ros.rig.rig_file import save_rig

CASE = Path(__file__).parent / "data" / "benchmark" / "public_few" / "cams4_p_man_avg"


@pytest.fixture(scope="module")
def scene():
    """Four frames: the second without a person, only the first with masks."""
    case = load_case(CASE)
    outcomes = [pose_of(state) for state in fitted_states()[:4]]
    outcomes[1] = NoPerson("empty room")
    masks = Masks()
    masks.add(0, case.masks(0))
    run = Run(tuple(FrameResult(f * 40_000_000, outcome) for f, outcome in enumerate(outcomes)))
    return RunScene(run, case.rig, masks, HullConfig())


def test_masks_come_back_bit_for_bit():
    masks, kept = load_case(CASE).masks(0), Masks()
    kept.add(7, masks)
    assert 7 in kept
    assert 8 not in kept
    for name, mask in kept.get(7).items():
        np.testing.assert_array_equal(mask, masks[name])
    assert kept.get(8) == {}


def test_a_frame_has_the_layers_that_are_wanted_and_there(scene):
    assert set(scene.meshes(0, LAYERS)) == {"hull", "flesh", "sticks"}
    assert set(scene.meshes(0, {"sticks"})) == {"sticks"}
    assert scene.meshes(1, LAYERS) == {}
    assert set(scene.meshes(2, LAYERS)) == {"flesh", "sticks"}
    assert set(scene.lines(LAYERS)) == {"path", "cameras", "floor"}
    assert "no person: empty room" in scene.text(1)
    assert "were not kept" in scene.text(2)
    assert "not kept" not in scene.text(0)
    assert "frame 3 of 4, 0.12 s" in scene.text(3)


@pytest.mark.parametrize("colour", COLOURS)
def test_the_hull_is_coloured_by_what_is_asked(scene, colour):
    colours = scene.meshes(0, {"hull"}, colour)["hull"].colours
    assert ((colours >= 0) & (colours <= 1)).all()
    assert (np.ptp(colours, axis=0).max() > 0.3) == (colour != "plain")
    if colour == "geodesic distance":  # from the centre of mass outwards; viridis grows yellow
        vertices = scene.meshes(0, {"hull"}, colour)["hull"].vertices
        away = np.linalg.norm(vertices - vertices.mean(axis=0), axis=1)
        assert colours[away > 0.8 * away.max(), 1].mean() > colours[away < 0.3 * away.max(), 1].mean() + 0.2


def test_cameras_are_drawn_where_they_stand(scene):
    lines = camera_lines(scene.rig)
    centres = lines.points[::6]
    np.testing.assert_allclose(centres, [c.T_world_camera[:3, 3] for c in scene.rig.cameras])
    assert lines.segments.max() == len(lines.points) - 1
    camera = scene.rig.cameras[2]
    uv, depth = camera.world_to_image(lines.points[2 * 6 + 1 : 2 * 6 + 5])
    assert (depth > 0).all()
    assert uv[0, 0] < uv[1, 0]


def test_playing_keeps_the_recorded_pace():
    playback = Playback(5, np.array([0.0, 0.1, 0.2, 0.5, 0.6]))
    assert not playback.tick(1.0)
    playback.toggle()
    shown = [(playback.tick(0.05), playback.number) for _ in range(6)]
    assert shown == [(False, 0), (True, 1), (False, 1), (True, 2), (False, 2), (False, 2)]
    assert playback.tick(5.0)  # a slow picture skips frames
    assert (playback.number, playback.playing) == (4, False)
    playback.toggle()
    assert (playback.number, playback.playing) == (0, True)
    playback.go(99)
    assert playback.number == 4
    playback.go(-1)
    assert playback.number == 0
    playback.switch("hull", False)
    assert "hull" not in playback.layers


def test_the_view_holds_the_whole_movement(scene):
    target, eye = view_point(scene)
    joints = scene.run.joints[[0, 2, 3]].reshape(-1, 3)
    look = (target - eye) / np.linalg.norm(target - eye)
    away = joints - eye
    angles = np.degrees(np.arccos(away @ look / np.linalg.norm(away, axis=1)))
    assert angles.max() < 45


def test_without_open3d_it_says_what_to_install(monkeypatch, tmp_path, capsys, scene):
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(InputError, match=r"pip install 'limbloc_ros\[viewer\]'"):
        load_open3d()
    scene.run.save(tmp_path)
    save_rig(scene.rig, tmp_path / "rig.yaml")
    assert cli.main(["view", str(tmp_path)]) == 2
    assert "needs Open3D" in capsys.readouterr().err
    assert cli.main(["view", str(tmp_path), "--frame", "4"]) == 2
    assert "--frame: expected 0 to 3, got 4" in capsys.readouterr().err
