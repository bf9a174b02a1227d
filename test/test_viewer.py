# SPDX-License-Identifier: Apache-2.0
"""What the viewer shows, without its window: scenes of frames, playback, and what it says when it cannot."""

import sys
import types
from pathlib import Path

import numpy as np
import pytest
from figure_poses import fitted_states, pose_of

from limbloc_ros import cli
from limbloc_ros.core.config import HullConfig
from limbloc_ros.core.errors import InputError, NoPerson
from limbloc_ros.recordings.cases import load_case
from limbloc_ros.recordings.results import FrameResult, Run
from limbloc_ros.report import viewer_window
from limbloc_ros.report.mesh import Mesh
from limbloc_ros.report.viewer_scene import (
    COLOURS,
    LAYERS,
    Lines,
    Masks,
    Playback,
    RunScene,
    camera_lines,
    contour_lines,
    shaded,
)
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
    assert set(scene.shapes(0, LAYERS)) == {"hull", "flesh", "sticks"}
    assert set(scene.shapes(0, {"sticks"})) == {"sticks"}
    assert scene.shapes(1, LAYERS) == {}
    assert set(scene.shapes(2, LAYERS)) == {"flesh", "sticks"}
    hull = scene.shapes(0, LAYERS)["hull"]
    assert isinstance(hull, Lines)  # a hull of lines lets the figure be seen
    assert len(hull.segments) > 1000
    coloured = scene.shapes(0, LAYERS, COLOURS[1])
    assert set(coloured) == {"hull"}  # and the figure would spoil its colours
    assert isinstance(coloured["hull"], Mesh)
    assert isinstance(scene.shapes(0, {"hull"})["hull"], Mesh)
    assert set(scene.lines(LAYERS)) == {"path", "cameras", "floor"}
    assert "no person: empty room" in scene.text(1)
    assert "were not kept" in scene.text(2)
    assert "not kept" not in scene.text(0)
    assert "frame 3 of 4, 0.12 s" in scene.text(3)


@pytest.mark.parametrize("colour", COLOURS)
def test_the_hull_is_coloured_by_what_is_asked(scene, colour):
    colours = scene.shapes(0, {"hull"}, colour)["hull"].colours
    assert ((colours >= 0) & (colours <= 1)).all()
    hues = colours / colours.sum(axis=1, keepdims=True)  # without the light
    assert (np.ptp(hues, axis=0).max() > 0.1) == (colour != "plain")
    if colour == "geodesic distance":  # from the centre of mass outwards; viridis grows yellow
        vertices = scene.shapes(0, {"hull"}, colour)["hull"].vertices
        away = np.linalg.norm(vertices - vertices.mean(axis=0), axis=1)
        assert colours[away > 0.8 * away.max(), 1].mean() > colours[away < 0.3 * away.max(), 1].mean() + 0.2


def test_the_lights_are_in_the_colours():
    """Upwards 0.55 + 0.45 * 0.74 + 0.15 * 0.33 of the colour, downwards, away from both lights, 0.55 of it."""
    normals = np.array([[0, 0, 1.0], [0, 0, -1.0], [0, 0, 1.0]])
    colours = np.array([[0.2, 0.4, 0.6], [0.2, 0.4, 0.6], [1, 1, 1]])
    lit = shaded(Mesh.of(np.eye(3), np.array([[0, 1, 2]]), normals, colours)).colours
    up = 0.55 + 0.45 * 0.74 + 0.15 * 0.33
    np.testing.assert_allclose(lit, [up * colours[0], 0.55 * colours[1], up * colours[2]])


def test_level_lines_of_a_tetrahedron():
    """From (0, 0, 0), (1, 0, 0), (0, 1, 0) up to (0, 0, 1): at height h a triangle with legs of 1 - h."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    lines = contour_lines(Mesh.of(vertices, faces, vertices, 0.5), step_m=0.25)
    ends = lines.points[lines.segments]
    np.testing.assert_array_equal(np.unique(ends[..., 2]), [0.25, 0.5, 0.75])
    for height in (0.25, 0.5, 0.75):
        level = ends[ends[:, 0, 2] == height]
        lengths = np.sort(np.linalg.norm(level[:, 1] - level[:, 0], axis=1))
        np.testing.assert_allclose(lengths, (1 - height) * np.array([1, 1, np.sqrt(2)]))
    nothing = contour_lines(Mesh.join([]))
    assert len(nothing.segments) == 0


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
    shown = [(playback.press(key), playback.number) for key in ("end", "left", "right", "right", "home", "x")]
    assert shown == [(True, 4), (True, 3), (True, 4), (True, 4), (True, 0), (False, 0)]
    assert playback.press("space")
    assert not playback.playing
    playback.go(99)
    assert playback.number == 4
    playback.go(-1)
    assert playback.number == 0
    playback.switch("hull", False)
    assert "hull" not in playback.layers


def test_the_view_holds_the_whole_movement(scene):
    target, eye = view_point(scene)
    joints = scene.run.joints[[0, 2, 3]].reshape(-1, 3)
    assert 15 < angles_seen(joints, target, eye).max() < 25
    one = Playback(4, np.zeros(4), number=3, layers={"sticks"})
    target, eye = view_point(scene, one)
    assert 15 < angles_seen(scene.run.joints[3], target, eye).max() < 25
    one.layers.add("cameras")
    target, eye = view_point(scene, one)
    centres = np.array([camera.T_world_camera[:3, 3] for camera in scene.rig.cameras])
    assert 15 < angles_seen(centres, target, eye).max() < 25


def angles_seen(points, target, eye):
    """Degrees between the line of sight and each point [N]; the picture reaches to 25."""
    look = (target - eye) / np.linalg.norm(target - eye)
    away = points - eye
    return np.degrees(np.arccos(away @ look / np.linalg.norm(away, axis=1)))


def test_without_a_driver_or_a_display_it_says_so(monkeypatch, tmp_path, capsys, scene):
    """Open3D itself aborts the process without Vulkan, and waits for ever for a display."""
    open3d = types.SimpleNamespace(__version__="0.20.0", visualization=types.SimpleNamespace(gui=None, rendering=None))
    monkeypatch.setitem(sys.modules, "open3d", open3d)
    monkeypatch.setitem(sys.modules, "open3d.visualization", open3d.visualization)
    monkeypatch.setattr(viewer_window, "has_vulkan", lambda: False)
    monkeypatch.setattr(sys, "platform", "linux")
    scene.run.save(tmp_path)
    save_rig(scene.rig, tmp_path / "rig.yaml")
    assert cli.main(["view", str(tmp_path), "--picture", "a.png"]) == 2
    assert "apt install mesa-vulkan-drivers" in capsys.readouterr().err
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert cli.main(["view", str(tmp_path)]) == 2
    assert "--picture FILE" in capsys.readouterr().err


def test_without_open3d_it_says_what_to_install(monkeypatch, tmp_path, capsys, scene):
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(InputError, match=r"pip install 'limbloc_ros\[viewer\]'"):
        load_open3d()
    scene.run.save(tmp_path)
    save_rig(scene.rig, tmp_path / "rig.yaml")
    assert cli.main(["view", str(tmp_path)]) == 2
    assert "needs Open3D" in capsys.readouterr().err
    assert cli.main(["view", str(tmp_path), "--frame", "4"]) == 2
    assert "--frame: expected 0 to 3, got 4" in capsys.readouterr().err
