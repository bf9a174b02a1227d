# SPDX-License-Identifier: Apache-2.0
"""Planning: proposals that can be carved with, counts worked by hand, blind spots, and the hull's fatness."""

import itertools
import re

import cv2
import numpy as np
import pytest

from limbloc_ros import cli
from limbloc_ros.core.camera import Camera, Rig
from limbloc_ros.core.errors import ConfigError
from limbloc_ros.rig.geometry import where_they_look
from limbloc_ros.rig.pictures import rig_figure
from limbloc_ros.rig.plan import (
    blind_spots,
    cover_floor,
    hull_fatness,
    mesh_volume,
    propose,
    silhouettes,
    standing_places,
)
from limbloc_ros.rig.rig_file import load_rig
from limbloc_ros.simulation.person import load_person

CUBE = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
CUBE_FACES = np.array(
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4],
     [1, 5, 7], [1, 7, 3]], np.int32,
)  # fmt: skip


@pytest.mark.parametrize("count", [2, 4, 5, 8, 16])
def test_a_proposal_fits_the_room_and_looks_at_its_middle(count):
    rig = propose(count, (5.0, 4.0, 2.6))
    places = np.array([camera.T_world_camera[:3, 3] for camera in rig.cameras])
    assert (np.abs(places[:, :2]) <= [2.5, 2.0]).all()
    assert (places[:, 2] < 2.6).all()
    assert (np.abs(rig.volume_min[:2]) <= [2.5, 2.0]).all()
    np.testing.assert_allclose(where_they_look([c.T_world_camera for c in rig.cameras]).point, [0, 0, 0.95], atol=0.01)
    angles = np.arctan2(places[:, 1], places[:, 0])
    for i in range(count):
        for j in range(i):
            opposite = abs((angles[i] - angles[j]) % (2 * np.pi) - np.pi)
            same_height = abs(places[i, 2] - places[j, 2]) < 0.1
            assert opposite > np.radians(3) or not same_height  # such a pair would see one silhouette


def test_how_many_cameras_see_a_place_worked_by_hand():
    """One camera 3 m high looks straight down with 90 degrees: at height z it sees a square of half 3 - z."""
    T = np.eye(4)
    T[:3, :3] = [[1, 0, 0], [0, -1, 0], [0, 0, -1]]
    T[:3, 3] = 0, 0, 3
    K = np.array([[100, 0, 99.5], [0, 100, 99.5], [0, 0, 1.0]])
    rig = Rig((Camera("down", 200, 200, K, T),), np.array([-4.0, -4, 0]), np.array([4.0, 4, 2.5]))
    coverage = cover_floor(rig)
    for z, counts in zip((0.2, 1.0, 2.0), coverage.counts, strict=True):
        side = np.sqrt(counts.sum() * 0.01)
        assert side == pytest.approx(2 * (3 - z), abs=0.15)
    assert coverage.whole.sum() * 0.01 == pytest.approx(4.0, abs=0.3)  # raised hands decide
    spots = blind_spots(coverage)
    assert len(spots) == 1
    assert re.search(r"along all sides, up to (2\.9|3\.0|3\.1) m inwards: down to 0 cameras", spots[0])


def test_silhouettes_and_volume_of_a_cube():
    assert mesh_volume(CUBE, CUBE_FACES) == pytest.approx(1.0)
    rig = propose(4, (6.0, 6.0, 2.8))
    centred = CUBE - [0.5, 0.5, 0.0]
    for name, mask in silhouettes(rig, centred, CUBE_FACES).items():
        uv, _ = rig.camera(name).world_to_image(centred)
        hull = cv2.contourArea(cv2.convexHull(uv.astype(np.float32)))
        assert np.count_nonzero(mask) == pytest.approx(hull, rel=0.03)


def test_more_cameras_give_a_leaner_hull():
    body = load_person("man")
    fatness = {}
    for count in (4, 8, 16):
        rig = propose(count, (5.0, 5.0, 2.8))
        fatness[count] = hull_fatness(rig, body.vertices, body.faces, [(0.0, 0.0), (0.6, 0.3)], 0.025)
        assert fatness[count].lost == 0
    factors = [f.median for f in fatness.values()]
    assert 1.0 < factors[2] < factors[1] < factors[0] < 2.0


def test_a_body_that_most_cameras_do_not_see_is_lost():
    body = load_person("man")
    rig = propose(8, (5.0, 5.0, 2.8), view_deg=25)
    assert hull_fatness(rig, body.vertices, body.faces, [(1.8, 1.8)], 0.03).lost == 1


def test_standing_places_are_well_seen():
    coverage = cover_floor(propose(8, (5.0, 5.0, 2.8)))
    places = standing_places(coverage)
    assert len(places) == 5
    assert len(set(places)) == 5
    for x, y in places:
        i, j = np.abs(coverage.x - x).argmin(), np.abs(coverage.y - y).argmin()
        assert coverage.whole[i, j] >= coverage.needed


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((1, (5.0, 5.0, 2.8)), "expected 2 to 32, got 1"),
        ((8, (50.0, 5.0, 2.8)), "--room: expected 2 to 30 m"),
    ],
)
def test_impossible_rooms_are_refused(arguments, message):
    with pytest.raises(ConfigError, match=message):
        propose(*arguments)


def test_the_command_line(tmp_path, capsys):
    saved = tmp_path / "proposal.yaml"
    command = ["rig", "plan", "--cameras", "6", "--room", "5x4x2.6", "--out", str(tmp_path), "--save", str(saved)]
    assert cli.main(command) == 0
    said = capsys.readouterr().out
    assert "hull / body volume" in said
    assert len(load_rig(saved).cameras) == 6
    for name in ("rig.png", "coverage.png"):
        assert cv2.imread(str(tmp_path / name)).std() > 10
    assert cli.main(["rig", "plan", "--rig", str(saved), "--out", str(tmp_path / "again")]) == 0
    assert cli.main(["rig", "plan", "--compare", "4", "8", "--out", str(tmp_path)]) == 0
    assert cv2.imread(str(tmp_path / "fatness.png")).std() > 10
    capsys.readouterr()
    for wrong, message in (
        (["--cameras", "6", "--room", "big"], "--room: expected LENGTHxWIDTHxHEIGHT"),
        (["--cameras", "6", "--size", "1"], "--size: expected WIDTHxHEIGHT"),
        ([], "expected --rig FILE, --cameras N or --compare"),
    ):
        assert cli.main(["rig", "plan", *wrong]) == 2
        assert message in capsys.readouterr().err


@pytest.mark.parametrize("count", [8, 16, 32])
def test_no_name_hides_another_in_the_picture(count):
    rig = propose(count, (5.0, 5.0, 2.8), size=(1280, 720), view_deg=80.0)
    figure = rig_figure(rig.cameras, rig.volume_min, rig.volume_max)
    for axes in figure.axes:
        boxes = {text.get_text(): text.get_window_extent() for text in axes.texts}
        assert set(boxes) == set(rig.names)
        for one, other in itertools.combinations(boxes, 2):
            assert not boxes[one].overlaps(boxes[other]), (one, other)
