# SPDX-License-Identifier: Apache-2.0
"""Every exported file, read again by other means, holds the run's own joints."""

import csv
import io
from pathlib import Path

import cv2
import numpy as np
import pytest
from figure_poses import fitted_states, pose_of
from motion_files import Gltf, read_bvh, read_c3d, read_ply

from limbloc_ros import cli
from limbloc_ros.core.errors import ConfigError, InputError, NoPerson
from limbloc_ros.core.figure import FigureState, flesh_distance
from limbloc_ros.core.pose import JOINT, JOINT_NAMES
from limbloc_ros.export.bvh import bvh_text
from limbloc_ros.export.clip import clip_of
from limbloc_ros.export.gltf import write_gltf
from limbloc_ros.export.markers import MARKER_SETS, joints_of_markers, marker_places
from limbloc_ros.export.skeleton import ORIGINS, TIPS, skeleton_of
from limbloc_ros.export.tables import csv_text
from limbloc_ros.export.trc import read_trc, trc_text
from limbloc_ros.files import replaced
from limbloc_ros.recordings.cases import load_case
from limbloc_ros.recordings.kept_frames import KeptFrames
from limbloc_ros.recordings.results import FrameResult, Run
from limbloc_ros.rig.rig_file import load_rig, save_rig

DATA = Path(__file__).parent / "data"
WALK = DATA / "rgb_walk"
STEP_NS = 40_000_000


def to_y_up(points):
    """World (z up) -> the axes of animation files."""
    return np.asarray(points)[..., [1, 2, 0]]


def recorded(states, lost=(), **about):
    """A run of these states at 25 Hz; frames in `lost` have nobody."""
    outcomes = [NoPerson("empty, room") if f in lost else pose_of(s) for f, s in enumerate(states)]
    frames = [FrameResult(10**18 + f * STEP_NS, outcome) for f, outcome in enumerate(outcomes)]
    return Run(tuple(frames), about)


@pytest.fixture(scope="module")
def many():
    """79 fits to people of different sizes, so that lengths change from frame to frame."""
    return recorded(fitted_states())


@pytest.fixture(scope="module")
def one_person():
    """The same postures of one person."""
    return recorded([FigureState(s.root, s.rotations, fitted_states()[0].shape) for s in fitted_states()])


def node_joints(names):
    """(node, joint) indices of every published joint that a BVH or glTF skeleton has."""
    wanted = ORIGINS | {f"{bone} end": joint for bone, joint in TIPS.items()} | {tip: tip for tip in TIPS.values()}
    return [(node, JOINT[wanted[name]]) for node, name in enumerate(names) if name in wanted]


@pytest.mark.parametrize("unit", ["m", "cm"])
def test_bvh_read_again_has_every_joint_within_a_tenth_of_a_millimetre(many, unit):
    names, _, _, frame_time, places = read_bvh(bvh_text(skeleton_of(clip_of(many)), unit))
    pairs = node_joints(names)
    assert len(pairs) == 19
    scale = {"m": 1.0, "cm": 100.0}[unit]
    for node, joint in pairs:
        np.testing.assert_allclose(places[:, node] / scale, to_y_up(many.joints[:, joint]), atol=1e-4)
    assert frame_time == pytest.approx(0.04)


def test_bvh_of_one_person_has_constant_lengths_and_the_same_joints(one_person):
    skeleton = skeleton_of(clip_of(one_person))
    assert not skeleton.stretches
    text = bvh_text(skeleton)
    assert text.count("position") == 3  # the root's
    names, parents, offsets, _, places = read_bvh(text)
    for node, joint in node_joints(names):
        np.testing.assert_allclose(places[:, node], to_y_up(one_person.joints[:, joint]), atol=1e-4)
    thigh, shin = names.index("thigh_L"), names.index("shin_L")
    length = np.linalg.norm(one_person.joints[:, JOINT["knee_L"]] - one_person.joints[:, JOINT["hip_L"]], axis=1)
    np.testing.assert_allclose(np.linalg.norm(offsets[shin]), length, atol=1e-5)
    assert parents[shin] == thigh


def test_bvh_at_rest_stands_straight_and_faces_forward(one_person):
    _, _, offsets, _, _ = read_bvh(bvh_text(skeleton_of(clip_of(one_person))))
    names, *_ = read_bvh(bvh_text(skeleton_of(clip_of(one_person))))
    assert offsets[names.index("thigh_L")][0] > 0.04  # x to the person's left
    assert offsets[names.index("shin_L")][1] < -0.2  # y up
    assert offsets[names.index("foot_L end")][2] > 0.1  # z forward


def test_bvh_angles_are_continuous(one_person):
    """Programs interpolate between rows: a slow turn must not jump by a full circle."""
    shape = fitted_states()[0].shape
    turns = [FigureState.standing(np.array([0, 0, 1.0]), np.radians(8 * f)) for f in range(90)]
    text = bvh_text(skeleton_of(clip_of(recorded([FigureState(s.root, s.rotations, shape) for s in turns]))))
    rows = np.array([line.split() for line in text.split("Frame Time: 0.04\n")[1].splitlines()], dtype=float)
    assert np.abs(np.diff(rows[:, 3:], axis=0)).max() < 9


def test_the_median_person_is_told_with_what_it_costs(many):
    clip = clip_of(many)
    fixed, exact = skeleton_of(clip, "person"), skeleton_of(clip, "frame")
    assert fixed.deviation_m(clip).max() > 0.05  # the states are of different people
    assert exact.deviation_m(clip).max() < 1e-9
    with pytest.raises(ConfigError, match="lengths: expected one of auto, frame, person, got 'long'"):
        skeleton_of(clip, "long")


def test_gaps_repeat_the_pose_in_skeletons_and_are_empty_elsewhere(one_person):
    run = recorded(fitted_states()[:6], lost=(0, 3))
    clip = clip_of(run)
    assert clip.empty == 2
    names, _, _, _, places = read_bvh(bvh_text(skeleton_of(clip)))
    head = names.index("head")
    np.testing.assert_array_equal(places[0, head], places[1, head])
    np.testing.assert_array_equal(places[3, head], places[2, head])
    assert np.isnan(clip.joints[[0, 3]]).all()
    markers = read_trc_text(trc_text(clip, "x.trc"))
    np.testing.assert_array_equal(np.isnan(markers.places).all(axis=(1, 2)), [True, False, False, True, False, False])


def test_missing_stamps_make_empty_rows_and_odd_ones_are_refused():
    poses = [pose_of(s) for s in fitted_states()[:5]]
    stamps = np.array([0, 1, 2, 5, 6]) * STEP_NS + np.array([0, 3, -2, 1, 0]) * 10**6
    clip = clip_of(Run(tuple(FrameResult(int(t), p) for t, p in zip(stamps, poses, strict=True))))
    np.testing.assert_array_equal(clip.rows, [0, 1, 2, -1, -1, 3, 4])
    assert clip.rate_hz == pytest.approx(25, rel=0.1)
    late = Run((FrameResult(0, poses[0]), FrameResult(STEP_NS, poses[1]), FrameResult(2 * STEP_NS, poses[2]),
                FrameResult(10**13, poses[3])))  # fmt: skip
    with pytest.raises(InputError, match="almost all empty"):
        clip_of(late)
    with pytest.raises(InputError, match="stamps go back or repeat after frame 1"):
        clip_of(Run(tuple(FrameResult(t, poses[0]) for t in (0, 5, 5))))
    with pytest.raises(InputError, match="none of the run's 1 frames has a pose"):
        clip_of(Run((FrameResult(0, NoPerson("x")),)))


def read_trc_text(text):
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "x.trc"
        path.write_text(text)
        return read_trc(path)


@pytest.mark.parametrize("unit", ["m", "mm"])
def test_trc_has_pose2sims_markers_and_reads_back(many, unit):
    text = trc_text(clip_of(many), "walk.trc", unit)
    lines = text.splitlines()
    assert lines[0] == "PathFileType\t4\t(X/Y/Z)\twalk.trc"
    about = dict(zip(lines[1].split("\t"), lines[2].split("\t"), strict=True))
    assert (about["Units"], about["NumFrames"], about["DataRate"]) == (unit, str(len(fitted_states())), "25")
    names = [cell for cell in lines[3].split("\t")[2:] if cell]
    halpe = {"Hip", "Neck", "Head"} | {
        s + n for s in "RL" for n in ["Hip", "Knee", "Ankle", "BigToe", "Heel", "Shoulder", "Elbow", "Wrist"]
    }
    assert set(names) == halpe
    assert len(lines[4].split("\t")) == 2 + 3 * len(names) == len(lines[5].split("\t"))
    row = np.array(lines[5].split("\t")[2:], dtype=float).reshape(-1, 3) * {"m": 1.0, "mm": 0.001}[unit]
    np.testing.assert_allclose(row[names.index("RKnee")], to_y_up(many.joints[0, JOINT["knee_R"]]), atol=1e-5)
    markers = read_trc_text(text)
    joints = joints_of_markers(markers.names, markers.places)
    known = np.isfinite(joints).all(axis=(0, 2))
    assert known.sum() == 18  # Hip is the middle of two
    np.testing.assert_allclose(joints[:, known], many.joints[:, known], atol=2e-6)


def test_files_that_are_no_trc_are_refused(tmp_path):
    path = tmp_path / "x.trc"
    for text, message in (
        ("hello", "begins with PathFileType, got 'hello'"),
        ("", "an empty file"),
        ("PathFileType\n\nUnits\n\n\n", "Units: expected m or mm"),
    ):
        path.write_text(text)
        with pytest.raises(InputError, match=message):
            read_trc(path)
    with pytest.raises(InputError, match="cannot be read"):
        read_trc(tmp_path / "nowhere.trc")


def test_csv_has_a_row_for_every_frame_and_says_why_one_is_empty():
    run = recorded(fitted_states()[:3], lost=(1,))
    rows = list(csv.DictReader(io.StringIO(csv_text(run))))
    assert [row["frame"] for row in rows] == ["0", "1", "2"]
    place = [float(rows[2][f"wrist_R_{axis}_m"]) for axis in "xyz"]
    np.testing.assert_allclose(place, run.joints[2, JOINT["wrist_R"]], atol=1e-6)
    assert float(rows[2]["elbow_R_flexion_rad"]) == pytest.approx(
        run.frames[2].outcome.angles["elbow_R_flexion"], abs=1e-6
    )
    assert rows[1]["reason"] == "empty, room"
    assert rows[1]["wrist_R_x_m"] == ""
    assert rows[0]["stamp_s"] == "1000000000.000000000"
    assert len(list(csv.DictReader(io.StringIO(csv_text(run, first=1, last=1))))) == 1


def test_c3d_read_again_has_every_joint(many, tmp_path):
    many.save(tmp_path / "run")
    assert cli.main(["export", str(tmp_path / "run"), "--format", "c3d", "--out", str(tmp_path / "x.c3d")]) == 0
    points, rate = read_c3d((tmp_path / "x.c3d").read_bytes())
    assert rate == 25
    np.testing.assert_allclose(points[..., :3] / 1000, many.joints, atol=1e-5)


def test_marker_sets_name_real_joints():
    joints = np.random.default_rng(0).normal(size=(3, 25, 3))
    for names, markers in MARKER_SETS.items():
        labels, places = marker_places(joints, names)
        assert labels == tuple(markers)
        assert places.shape == (3, len(labels), 3)
    assert tuple(MARKER_SETS["limbloc"]) == JOINT_NAMES


def test_gltf_carries_every_sphere_of_the_flesh(one_person, many, tmp_path):
    write_gltf(skeleton_of(clip_of(one_person)), tmp_path / "x.glb")
    figure = Gltf((tmp_path / "x.glb").read_bytes())
    names = [node["name"] for node in figure.json["nodes"]]
    for frame in (0, 17, 40):
        nodes = figure.nodes(frame)
        for node, joint in node_joints(names):
            np.testing.assert_allclose(nodes[node, :3, 3], to_y_up(one_person.joints[frame, joint]), atol=1e-4)
        flesh = one_person.frames[frame].outcome.flesh
        vertices = figure.skin(frame)[:, [2, 0, 1]]  # to the world's axes
        distance, _ = flesh_distance(vertices, flesh)
        assert distance.max() < 1e-4  # nothing stands out
        spheres = np.linalg.norm(vertices[:, None] - flesh.centres, axis=2) - flesh.radii
        assert np.abs(spheres).min(axis=1).max() < 1e-4  # every vertex lies on a sphere
        assert len(set(np.abs(spheres).argmin(axis=1))) == len(flesh.radii)  # and every sphere is there
    write_gltf(skeleton_of(clip_of(many)), tmp_path / "many.glb")
    moving = Gltf((tmp_path / "many.glb").read_bytes())
    for node, joint in node_joints(names):
        np.testing.assert_allclose(moving.nodes(30)[node, :3, 3], to_y_up(many.joints[30, joint]), atol=1e-4)


def test_gltf_quaternions_go_the_short_way(tmp_path):
    turns = [FigureState.standing(np.array([0, 0, 1.0]), np.radians(20 * f)) for f in range(40)]
    write_gltf(skeleton_of(clip_of(recorded(turns))), tmp_path / "x.glb")
    figure = Gltf((tmp_path / "x.glb").read_bytes())
    animation = figure.json["animations"][0]
    for channel in animation["channels"]:
        if channel["target"]["path"] == "rotation":
            values = figure.array(animation["samplers"][channel["sampler"]]["output"])
            assert (np.sum(values[1:] * values[:-1], axis=1) > 0.9).all()


def test_ply_of_kept_frames_is_the_closed_hull(tmp_path):
    case = load_case(DATA / "benchmark" / "public_few" / "cams4_p_man_avg")
    recorded(fitted_states()[:3]).save(tmp_path)
    save_rig(case.rig, tmp_path / "rig.yaml")
    kept = KeptFrames()
    for frame in range(2):
        kept.add(frame, case.masks(frame), {})
    kept.save(tmp_path)
    assert cli.main(["export", str(tmp_path), "--format", "ply", "--first", "1"]) == 0
    (path,) = (tmp_path / "export").rglob("*.ply")
    assert path.name == "hull_000001.ply"
    vertices, faces = read_ply(path.read_bytes())
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, counts = np.unique(edges, axis=0, return_counts=True)
    assert (counts % 2 == 0).all()
    a, b, c = (vertices[faces[:, i], :3].astype(float) for i in range(3))
    litres = 1000 * np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6
    assert 60 < litres < 250  # outside is outside, and four cameras give a fat hull
    assert abs(vertices[:, 2].min()) < 0.1
    assert 1.6 < vertices[:, 2].max() < 2.1


def test_video_shows_the_figure_where_the_camera_sees_it(tmp_path):
    rig = load_rig(WALK / "calib.json")
    state = fitted_states()[0]
    middle = (rig.volume_min + rig.volume_max) / 2
    states = [FigureState(np.array([middle[0], middle[1], 1.0]), state.rotations, state.shape)] * 4
    frames = recorded(states, lost=(2,)).frames
    frames = [FrameResult(f * STEP_NS, frame.outcome) for f, frame in enumerate(frames)]
    Run(tuple(frames), {"input": str(WALK / "rgb"), "kind": "images", "fps": 25.0}).save(tmp_path)
    save_rig(rig, tmp_path / "rig.yaml")
    out = tmp_path / "x.mp4"
    assert cli.main(["export", str(tmp_path), "--format", "video", "--out", str(out), "--width", "320"]) == 0
    video = cv2.VideoCapture(str(out))
    shown = []
    while (got := video.read())[0]:
        shown.append(got[1])
    assert len(shown) == 4
    assert video.get(cv2.CAP_PROP_FPS) == 25
    camera = rig.cameras[0]
    scale = 320 / camera.width
    uv, _ = camera.world_to_image(frames[0].outcome.joints[[JOINT["knee_L"], JOINT["knee_R"]]])
    for (u, v), blue in zip(scale * (uv + 0.5) - 0.5, (True, False), strict=True):
        b, _, r = shown[0][round(v), round(u)].astype(int)
        assert (b > r + 40) == blue
        assert (r > b + 40) == (not blue)
    assert [p.name for p in tmp_path.glob(".writing*")] == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--format", "bvh", "--out", "x.fbx"], "expected a folder or a name ending in .bvh"),
        (["--format", "bvh", "trc", "--out", "x.bvh"], "expected a folder for several formats"),
        (["--format", "trc", "--unit", "cm"], "--unit: trc takes m or mm, got cm"),
        (["--format", "bvh", "--first", "5", "--last", "2"], "--first and --last: expected 0 or more"),
        (["--format", "bvh", "--first", "99"], "there is nothing to export"),
        (["--format", "video"], "say where it is now with --recording"),
        (["--format", "video", "--width", "3"], "--width: expected 32 to 4096"),
        (["--format", "ply"], "holds no rig.yaml"),
    ],
)
def test_what_cannot_be_exported_is_one_line(arguments, message, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    recorded(fitted_states()[:2], input="gone").save(tmp_path / "run")
    assert cli.main(["export", "run", *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert [p for p in tmp_path.rglob("*") if p.parent.name == "export" and p.is_file()] == []


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "x.txt"
    path.write_text("old")
    with pytest.raises(InputError, match="half"), replaced(path) as temporary:
        temporary.write_text("new")
        raise InputError("half")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]
