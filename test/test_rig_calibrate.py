# SPDX-License-Identifier: Apache-2.0
"""Calibration against known truth: derivatives, projected corners with noise, rendered images, and what is refused."""

import re
import shlex
from collections import Counter

import cv2
import numpy as np
import pytest
import rig_boards
from documented import ROOT, TEXTS, commands, examples
from scipy.spatial.transform import Rotation

from limbloc_ros import cli
from limbloc_ros.core.camera import Camera, Rig
from limbloc_ros.core.errors import ConfigError, RigError
from limbloc_ros.rig.advice import assess, what_to_record
from limbloc_ros.rig.board import parse_board
from limbloc_ros.rig.bundle import Bundle, Lens, View, _Layout, _view
from limbloc_ros.rig.calibration import calibrate, calibrate_lens
from limbloc_ros.rig.formats import FORMATS
from limbloc_ros.rig.rig_file import load_rig
from limbloc_ros.simulation.room import default_rig

BOARD = parse_board("charuco:9x7:0.1:0.075")


def errors(truth, found):
    """[C] m and [C] degrees."""
    place = [
        np.linalg.norm(a.T_world_camera[:3, 3] - b.T_world_camera[:3, 3]) for a, b in zip(truth, found, strict=True)
    ]
    turn = [
        Rotation.from_matrix(a.T_world_camera[:3, :3].T @ b.T_world_camera[:3, :3]).magnitude()
        for a, b in zip(truth, found, strict=True)
    ]
    return np.array(place), np.degrees(turn)


def sizes(rig):
    return [(c.width, c.height) for c in rig.cameras]


@pytest.mark.parametrize(("model", "count"), [("radtan", 5), ("rational", 8), ("fisheye", 4)])
def test_derivatives_against_differences(model, count):
    rng = np.random.default_rng(0)
    lens = Lens(model, np.r_[500, 505, 320, 240, rng.normal(0, 0.05, count)], np.ones(4 + count, bool))
    lens.free[-1] = False
    cameras = rng.normal(0, 0.2, (2, 6))
    cameras[:, 5] += 2.0
    bundle = Bundle((lens, lens), cameras, {3: rng.normal(0, 0.1, 6)})
    points = np.c_[rng.uniform(0, 0.5, (7, 2)), np.zeros(7)]
    view = View(1, 3, np.arange(7), np.zeros((7, 2)))
    layout = _Layout(bundle, 0)
    x = layout.pack()
    J = np.zeros((14, layout.size))
    for column, block in _view(bundle, layout, view, points)[1]:
        J[:, column : column + block.shape[1]] += block
    for i in range(layout.size):
        step = np.zeros(layout.size)
        step[i] = 1e-6 * max(1, abs(x[i]))
        ahead, behind = (_view(layout.unpack(x + s), layout, view, points)[0] for s in (step, -step))
        np.testing.assert_allclose(J[:, i], (ahead - behind).ravel() / (2 * step[i]), atol=1e-5 * np.abs(J).max())


def test_under_a_millimetre_and_a_twentieth_of_a_degree_at_0_3_px():
    """Four full-HD cameras, a board of 1.1 m: lenses from near views, places from a walk through the room."""
    rng = np.random.default_rng(1)
    rig = default_rig(4, 1920, 1080)
    board = parse_board("charuco:9x7:0.12:0.09")
    views = rig_boards.project(rig, board, rig_boards.walk(board, 160, 40, rng), 0.3, rng)
    lens_views = rig_boards.near(rig, board, 50, 0.3, rng)
    result = calibrate(rig.names, sizes(rig), views, board, lens_views=lens_views)
    place, turn = errors(rig.cameras, result.cameras)
    assert place.max() < 1e-3
    assert turn.max() < 0.05
    assert result.rms_px() == pytest.approx(0.3 * np.sqrt(2), rel=0.03)
    assert result.floor_frames == list(range(160, 200))
    # What it says of its own precision is true within a factor.
    assert 0.3 < np.sqrt((place**2).mean()) / np.sqrt((result.sigma_m**2).mean()) < 2.0
    for camera, found in zip(rig.cameras, result.cameras, strict=True):
        assert abs(camera.K[0, 0] / found.K[0, 0] - 1) < 1e-3
    qualities = assess(result)
    assert all(q.coverage > 0.9 and q.rms_px < 0.5 for q in qualities)
    assert what_to_record(qualities, len(result.floor_frames)) == []


def test_misread_corners_and_a_camera_out_of_time_do_not_bend_the_rest():
    rng = np.random.default_rng(2)
    rig = default_rig(4, 1920, 1080)
    views = rig_boards.project(rig, BOARD, rig_boards.walk(BOARD, 60, 10, rng), 0.2, rng)
    clean = calibrate(rig.names, sizes(rig), views, BOARD)
    for view in views[::9]:
        view.places[::7] += rng.normal(0, 15, view.places[::7].shape)
    seen = Counter(view.frame for view in views)
    late = next(view for i, view in enumerate(views) if seen[view.frame] == 3 and i % 9)
    late.places[:] += [60, 0]
    dirty = calibrate(rig.names, sizes(rig), views, BOARD)
    place, turn = errors(clean.cameras, dirty.cameras)
    assert place.max() < 3e-3
    assert turn.max() < 0.15
    assert any("off the other cameras" in line for line in dirty.dropped)


def test_a_single_misread_corner_is_thrown_away_and_its_view_kept():
    """As OpenCV reads a corner that lies beyond the image's edge: far off, in a view that is good otherwise."""
    rng = np.random.default_rng(3)
    rig = default_rig(2, 1920, 1080)
    views = [view for view in rig_boards.near(rig, BOARD, 8, 0.2, rng) if view.camera == 0]
    clean, _, _, _ = calibrate_lens("cam0", (1920, 1080), views, BOARD)
    views[5].places[0] += [17.0, -4.0]
    camera, used, residuals, dropped = calibrate_lens("cam0", (1920, 1080), views, BOARD)
    assert [len(view.ids) for view in views] == [len(view.ids) + (i == 5) for i, view in enumerate(used)]
    assert [len(r) for r in residuals] == [len(view.ids) for view in used]
    assert np.sqrt(np.mean(np.concatenate(residuals) ** 2)) < 0.25
    assert abs(camera.K[0, 0] / clean.K[0, 0] - 1) < 1e-3
    (said,) = dropped
    assert re.match(r"cam0, frame 5: 1 of \d+ corners, 1\d\.\d px off: misread", said)


def test_fisheye_and_rational_lenses():
    rng = np.random.default_rng(3)
    cameras = tuple(
        Camera(c.name, 1280, 960, c.K, c.T_world_camera, [0.05, -0.02, 0.01, -0.003], "fisheye")
        for c in default_rig(3, 1280, 960).cameras
    )
    rig = Rig(cameras, np.zeros(3), np.ones(3))
    views = rig_boards.project(rig, BOARD, rig_boards.walk(BOARD, 50, 8, rng), 0.1, rng)
    near = rig_boards.near(rig, BOARD, 15, 0.1, rng)
    result = calibrate(rig.names, sizes(rig), views, BOARD, lens="fisheye", lens_views=near)
    place, turn = errors(rig.cameras, result.cameras)
    assert place.max() < 2e-3
    assert turn.max() < 0.08
    assert result.cameras[0].distortion_model == "fisheye"
    rational = calibrate(rig.names, sizes(rig), views, BOARD, lens="rational", lens_views=near)
    assert rational.rms_px() < 0.2
    assert errors(rig.cameras, rational.cameras)[0].max() < 4e-3


def test_what_is_missing_is_said():
    rng = np.random.default_rng(4)
    rig = default_rig(4)
    poses = rig_boards.walk(BOARD, 40, 5, rng)
    views = rig_boards.project(rig, BOARD, poses, 0.2, rng)
    with pytest.raises(RigError, match="camera cam2: the board was found in 0 images, expected 4"):
        calibrate(rig.names, sizes(rig), [v for v in views if v.camera != 2], BOARD)
    apart = [View(v.camera, v.frame + 1000 * (v.camera >= 2), v.ids, v.places) for v in views]
    with pytest.raises(RigError, match=r"no frame shows the board to one of .* and at the same time to one of"):
        calibrate(rig.names, sizes(rig), apart, BOARD)
    with pytest.raises(RigError, match="in no two frames does the board lie below everything else"):
        calibrate(rig.names, sizes(rig), [v for v in views if v.frame < 40], BOARD)
    with pytest.raises(RigError, match=r"--floor: the board was not found in frame 999"):
        calibrate(rig.names, sizes(rig), views, BOARD, floor=[999])
    upright = next(f for f in range(40) if f % 2 == 0 and any(v.frame == f for v in views))
    with pytest.raises(RigError, match="the board is tilted by more than 40 degrees"):
        calibrate(rig.names, sizes(rig), views, BOARD, floor=[upright])


def test_advice_names_the_camera_and_the_place():
    rng = np.random.default_rng(5)
    rig = default_rig(3)
    views = rig_boards.project(rig, BOARD, rig_boards.walk(BOARD, 60, 2, rng), 0.3, rng)
    kept = [v for v in views if v.camera != 1 or v.places[:, 0].max() < 420]  # cam1's right side saw nothing
    advice = what_to_record(assess(calibrate(rig.names, sizes(rig), kept, BOARD)), 2)
    assert any(re.match(r"cam1: .*% of its image .*: bring it to the (upper|centre|lower) right", a) for a in advice)
    assert any("the floor rests on 2 frame" in a for a in advice)


@pytest.mark.parametrize("text", ["checkerboard:9x6:0.04", "charuco:7x5:0.08:0.06"])
def test_corners_of_rendered_boards(text):
    """Found corners lie on the true ones to a fraction of a pixel, with the same numbers, also upside down."""
    board = parse_board(text)
    rng = np.random.default_rng(6)
    camera = default_rig(4).cameras[0]
    for turn in (0.1, 2.0, 3.2, 4.5):
        T = np.eye(4)
        R = Rotation.from_euler("zx", [turn, 0.4]).as_matrix()
        T[:3, :3], T[:3, 3] = R, np.array([0.05, 0.0, 0.75]) - R @ board.points.mean(axis=0)
        T = camera.T_world_camera @ T
        found = board.find(rig_boards.render(camera, board, T, rng))
        assert found is not None
        ids, places = found
        true, _ = camera.world_to_image(board.points[ids] @ T[:3, :3].T + T[:3, 3])
        assert len(ids) >= 0.8 * len(board.points)
        assert np.sqrt(((places - true) ** 2).sum(axis=1).mean()) < 0.2


SMALL_BOARD = "charuco:7x5:0.15:0.11"


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Pictures of a board in a room: near each camera, walked about, on the floor."""
    folder = tmp_path_factory.mktemp("board")
    board = parse_board(SMALL_BOARD)
    rng = np.random.default_rng(7)
    ring = default_rig(8, 960, 720)
    rig = Rig(ring.cameras[:3], ring.volume_min, ring.volume_max)
    poses = rig_boards.walk(board, 36, 4, rng)
    for camera in rig.cameras:
        (folder / camera.name).mkdir()
        for frame, T in enumerate(poses):
            image = rig_boards.render(camera, board, T, rng, 40)
            cv2.imwrite(str(folder / camera.name / f"{frame:04d}.png"), image)
    return folder, rig


def test_from_images_to_a_rig_file_and_a_report(recording, tmp_path, capsys):
    folder, truth = recording
    out = tmp_path / "rig.yaml"
    code = cli.main(["rig", "calibrate", str(folder), "--board", SMALL_BOARD, "--out", str(out)])
    said = capsys.readouterr().out
    assert code == 0, said
    place, turn = errors(truth.cameras, load_rig(out).cameras)
    assert place.max() < 0.01  # 36 frames of 960x720 px
    assert turn.max() < 0.3
    assert "floor: the board lies on it in 4 frame(s): 36, 37, 38, 39" in said
    page = (tmp_path / "rig_calibration" / "calibration.html").read_text()
    assert "What to record again" in page
    assert page.count("data:image/png") == 2
    for name in ("coverage.png", "rig.png"):
        picture = cv2.imread(str(tmp_path / "rig_calibration" / name))
        assert picture.shape[0] > 200
        assert picture.std() > 10


def test_lenses_alone(recording, tmp_path, capsys):
    folder, truth = recording
    command = ["rig", "calibrate", str(folder), "--board", SMALL_BOARD, "--intrinsics-only", "--out", str(tmp_path)]
    assert cli.main([*command, "--cameras", "cam0", "--report", str(tmp_path / "about")]) == 0
    said = capsys.readouterr().out
    assert "cam0: " in said
    assert f"report: {tmp_path / 'about' / 'calibration.html'}" in said
    page = (tmp_path / "about" / "calibration.html").read_text()
    assert page.count("data:image/png") == 1  # where the board was; a lens alone has no room
    assert "place mm" not in page
    camera = FORMATS["ros"].read([tmp_path / "cam0.yaml"]).cameras[0]
    assert abs(camera.K[0, 0] / truth.cameras[0].K[0, 0] - 1) < 0.02


DOCUMENTED = [
    *(command for path in TEXTS for command in commands(path.read_text(encoding="utf-8"))),
    *(command for words in ("rig", "rig calibrate") for command in examples(words)),
]
#: Pictures to lenses and rig are what the two tests above do; of a bag it is done with `--every`.
RUN_ABOVE = ({"--board", "--out"}, {"--board", "--intrinsics-only", "--out"})


def test_the_documented_command_lines_run(recording, tmp_path, monkeypatch):
    """On this recording in place of theirs: its board, folders, floor frames."""
    folder, rig = recording
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    import footage_to_bag

    footage_to_bag.write_bag(folder, rig, tmp_path / "bag", encoding="jpeg")
    ours = {"bags/board": "bag", "310": "36", "311": "37", "312": "38", "5": "2"}
    ours |= dict.fromkeys(("board/", "recording/", "lenses/"), str(folder))
    lines = {line for line in DOCUMENTED if line.startswith("rig calibrate ")}
    assert len(lines) >= 5
    for line in sorted(lines):
        words = [ours.get(word, re.sub(r"^(charuco|checkerboard):.*", SMALL_BOARD, word)) for word in shlex.split(line)]
        if {word for word in words if word.startswith("--")} not in RUN_ABOVE:
            assert cli.main(words) == 0, line


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("checkerboard:9x6", "expected checkerboard:COLUMNSxROWS:SQUARE_M"),
        ("chess:9x6:0.1", "expected checkerboard:COLUMNSxROWS:SQUARE_M"),
        ("checkerboard:9x6:40", "they are metres"),
        ("charuco:7x5:0.04:0.05", "markers smaller than the squares"),
        ("charuco:7x5:0.04:0.03:DICT_9X9", "no dictionary DICT_9X9"),
    ],
)
def test_boards_that_cannot_be(text, message):
    with pytest.raises(ConfigError, match=re.escape(message)):
        parse_board(text)


def test_a_board_that_looks_the_same_upside_down_is_refused(recording, tmp_path, capsys):
    folder, _ = recording
    assert cli.main(["rig", "calibrate", str(folder), "--board", "checkerboard:8x6:0.1"]) == 2
    assert "looks the same upside down" in capsys.readouterr().err
    picture = tmp_path / "board.png"
    assert cli.main(["rig", "calibrate", "--board", "checkerboard:9x6:0.04", "--print-board", str(picture)]) == 0
    assert cv2.imread(str(picture)).shape == (7 * 200 + 200, 10 * 200 + 200, 3)
