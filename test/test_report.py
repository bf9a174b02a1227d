# SPDX-License-Identifier: Apache-2.0
"""The report: its view of a run, its plots' gaps and jumps, its numbers, and the page as a file."""

import base64
import datetime
import xml.etree.ElementTree as ElementTree

import cv2
import numpy as np
import pytest
from test_renderer import DISTORTED, RIG, ball_hull, person

from limbloc_ros.core.errors import InputError, NoPerson, OutputError
from limbloc_ros.core.pose import JOINT, JOINT_NAMES, Flesh, Pose
from limbloc_ros.recordings.results import FrameResult, Run
from limbloc_ros.report import pictures, plots
from limbloc_ros.report.page import Section, Table, build_page
from limbloc_ros.report.report import write_report
from limbloc_ros.report.run import RunData, jumps, steps
from limbloc_ros.report.samples import Sample, carve_samples, choose_frames
from limbloc_ros.report.summary import error_table, summary

CREATED = datetime.datetime(2026, 1, 2, 3, 4, tzinfo=datetime.UTC)


def pose_of(joints, energy=0.2):
    flesh = Flesh(np.array([[0.0, 0, 1.2], [0, 0, 0.9]]), np.array([0.2, 0.15]), np.array([[0, 1, 1]]), ("chest",))
    angles = {"knee_flexion_L": 0.5, "knee_flexion_R": 0.25, "neck_twist": 0.0}
    return Pose(joints, np.eye(3)[None], ("pelvis",), angles, {}, flesh, np.zeros(3), energy, np.full(25, 0.02), True,
                {"fit": 40.0})  # fmt: skip


def recorded(frames=12, lost=(4, 5, 8), jump=10):
    """A person who walks along x by 2 cm a frame, is lost in some frames and jumps at one."""
    results = []
    for f in range(frames):
        joints = person((0.02 * f + (0.5 if f >= jump else 0.0), 0.0))
        outcome = NoPerson("empty mask") if f in lost else pose_of(joints)
        results.append(FrameResult(int(f * 4e7), outcome, {"carve": 10.0}))
    return Run(tuple(results), {"input": "a <b>folder</b>", "config": {"hull": {"voxel_m": 0.02}}, "version": "9.9"})


def truth_of(frames=12):
    """True joints 3 cm above the recorded ones before the jump, and unknown heels."""
    joints = np.stack([person((0.02 * f, 0.0)) + np.array([0, 0, 0.03]) for f in range(frames)])
    return {name: joints[:, i] for i, name in enumerate(JOINT_NAMES) if not name.startswith("heel")}


def sample_of(frame=0, **more):
    return Sample.of(frame, ball_hull((0, 0, 1.0), 0.3, voxel_m=0.04, band_m=0.12), pose_of(person()), **more)


def test_run_data_keeps_gaps_reasons_times_and_settings():
    data = RunData.of(recorded(), title="t", truth=truth_of())
    np.testing.assert_array_equal(np.flatnonzero(~data.found), [4, 5, 8])
    assert data.missing_reasons() == [("empty mask", 3)]
    assert np.isnan(data.joints[4]).all()
    np.testing.assert_allclose(data.total_ms[[0, 4]], [50.0, 10.0])  # carving was done, fitting was not
    assert data.settings == {"hull.voxel_m": "0.02"}
    assert (data.source, data.version) == ("a <b>folder</b>", "9.9")
    assert data.seconds[3] == pytest.approx(0.12)
    assert data.consecutive
    assert data.error_m is not None
    np.testing.assert_allclose(data.error_m[0, JOINT["knee_L"]], 0.03)
    assert np.isnan(data.error_m[:, JOINT["heel_L"]]).all()


def test_frames_far_apart_are_unrelated_poses():
    rng = np.random.default_rng(0)
    frames = [FrameResult(int(f * 4e7), pose_of(person(rng.uniform(-2, 2, 2)))) for f in range(20)]
    data = RunData.of(Run(tuple(frames)), title="t")
    assert not data.consecutive
    assert ("frames", "20, unrelated poses") in summary(data)


def test_jumps_are_steps_unlike_the_others_and_never_over_gaps():
    path = np.array([0, 0.1, 0.2, np.nan, 5.0, 5.1, 6.2, 6.3])
    np.testing.assert_allclose(steps(path), [np.nan, 0.1, 0.1, np.nan, np.nan, 0.1, 1.1, 0.1])
    np.testing.assert_array_equal(np.flatnonzero(jumps(path, 0.15)), [6])
    assert not jumps(path, 2.0).any()
    assert not jumps(np.full(5, np.nan), 0.1).any()
    assert not jumps(np.arange(9) * 0.5, 0.15).any()  # fast but steady


def test_chosen_frames_are_found_and_spread():
    found = np.ones(66, dtype=bool)
    found[:10] = False
    chosen = choose_frames(found, 6)
    assert chosen == sorted(chosen)
    assert len(set(chosen)) == 6
    assert all(found[chosen])
    assert min(np.diff(chosen)) >= 8
    assert max(np.diff(chosen)) <= 10
    assert choose_frames([True, False, True]) == [0, 2]
    assert choose_frames([False]) == []


def test_gaps_and_pairs():
    assert plots.gaps([True, False, False, True, False]) == [(1, 2), (4, 4)]
    assert plots.gaps([True]) == []
    series = {"knee_L": np.zeros(1), "knee_R": np.ones(1), "l_hip": np.zeros(1), "r_hip": np.ones(1)}
    series |= {"spine_L_x": np.zeros(1), "r_head": np.zeros(1), "waist": np.zeros(1)}
    groups = {base: "".join(sorted(sides)) for base, sides in plots.paired(series).items()}
    assert groups == {"knee": "LR", "hip": "LR", "spine_x": "L", "r_head": "", "waist": ""}


def test_plots_break_at_gaps_and_mark_the_jump():
    data = RunData.of(recorded(), title="t")
    figure = plots.head_path(data)
    x_over_time = next(axes for axes in figure.axes if axes.get_ylabel() == "x (m)")
    lines = x_over_time.get_lines()
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(lines[0].get_ydata())), [4, 5, 8])
    crosses = next(line for line in lines if line.get_marker() == "x")
    np.testing.assert_allclose(crosses.get_xdata(), [0.4])
    angles = plots.joint_angles(data)
    titles = {axes.get_title() for axes in angles.axes if axes.get_visible()}
    assert titles == {"knee flexion  (-10 to 165)", "neck twist"}
    knee = next(axes for axes in angles.axes if axes.get_title().startswith("knee flexion"))
    np.testing.assert_allclose(knee.get_lines()[0].get_ydata()[0], np.degrees(0.5))


def test_summary_says_what_was_found_and_how_good():
    rows = dict(summary(RunData.of(recorded(), title="t", truth=truth_of())))
    assert rows["frames"] == "12, 0.44 s"
    assert rows["person found"] == "9 (75.0 %)"
    assert rows["no person"] == "3 (25.0 %)"
    assert rows["energy (eq. 2)"].startswith("median 0.200,")
    assert rows["jumps"] == "1 of 12 frames (10)"
    assert "median 30.0 mm" in rows["true error, 13 joints"]
    assert rows["within 5 cm"].startswith("77.8 %")  # 7 of 9 frames: two lie after the jump
    assert rows["within 2 sigma"].startswith("77.8 %")
    table = {row[0]: row[1:] for row in error_table(RunData.of(recorded(), title="t", truth=truth_of()))}
    assert table["knee L"][1] == "30.0"
    assert "heel L" not in table


def test_arrays_of_wrong_shape_are_named():
    data = RunData.of(recorded(), title="t")
    arrays = {"joints": data.joints, "stamps": data.stamps, "energy": data.energy, "sigma": data.sigma}
    with pytest.raises(InputError, match=r"angles knee: expected shape \(12,\), got \(3,\)"):
        RunData("t", "s", **arrays, reliable=data.reliable, angles={"knee": np.zeros(3)})
    with pytest.raises(InputError, match="at least one frame"):
        RunData.of(Run(()), title="t")


def test_every_hull_fits_its_panel():
    sample = sample_of()
    mesh = pictures.hull_mesh(sample.hull)
    distance = pictures.fitting_distance(sample, mesh, 0.45, (200, 300))
    camera = pictures.view_of(sample, mesh, 0.45, distance, (200, 300))
    uv, _ = camera.world_to_image(mesh.vertices)
    reach = np.abs(uv - [99.5, 149.5]).max(axis=0) / [100, 150]
    assert reach.max() == pytest.approx(0.86, abs=0.01)


def test_heading_is_where_the_person_faces():
    assert pictures.heading_rad(person()) == pytest.approx(0.0)
    turned = person() @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1.0]])  # row vectors: a quarter turn to the left
    assert pictures.heading_rad(turned) == pytest.approx(np.pi / 2)
    lying = person() @ np.array([[0, 0, 1.0], [0, 1, 0], [-1, 0, 0]])  # on the back: the front points up
    assert pictures.heading_rad(lying) == pytest.approx(np.pi / 2)  # seen from the left side


def test_samples_pair_recorded_poses_with_carved_hulls():
    run = recorded()
    ys, xs = np.mgrid[:240, :320]
    disc = (((xs - 160) ** 2 + (ys - 120) ** 2 < 30**2) * 255).astype(np.uint8)
    cameras = [DISTORTED, pictures.look_at((0, 0, 1.0), np.pi / 2, 0.1, 3.0, (320, 240))]
    rig = type(RIG)(tuple(cameras), RIG.volume_min, RIG.volume_max)
    samples = carve_samples(run, [0, 4, 6], lambda frame: {"cam0": disc, "view": disc}, rig)
    assert [s.frame_index for s in samples] == [0, 6]  # frame 4 has no pose
    assert samples[1].pose is run.frames[6].outcome
    assert np.isfinite(samples[0].geodesic).all()
    np.testing.assert_allclose(samples[0].surface.points.mean(axis=0), [0, 0, 1.0], atol=0.15)


def test_page_escapes_text_and_is_well_formed():
    evil = "<script>alert('1')</script> & \"quotes\""
    sections = [Section("a", evil, evil, tables=[Table([(evil, evil)], (evil, evil)), Table([(evil, evil)])])]
    page = build_page(evil, [evil], sections, evil)
    assert "<script" not in page
    root = ElementTree.fromstring(page)
    assert root.findtext("head/title") == evil
    assert root.findtext(".//section/h2") == evil
    assert root.findtext(".//td") == evil


def test_report_holds_every_picture_and_needs_nothing_else(tmp_path, monkeypatch):
    monkeypatch.setattr(pictures, "PANEL_PX", (120, 160))
    images = {"cam0": np.full((240, 320, 3), 90, dtype=np.uint8)}
    sample = sample_of(anchors={"knee_L": np.array([0.0, 0.1, 0.8])}, images=images, rig=RIG)
    data = RunData.of(recorded(), title="Walk & turn", truth=truth_of(), command="process <in>")
    drawn = []
    page = write_report(data, [sample], tmp_path / "out", created=CREATED, on_picture=lambda *a: drawn.append(a))
    assert page == tmp_path / "out" / "report.html"
    text = page.read_text(encoding="utf-8")
    root = ElementTree.fromstring(text)
    pictures_on_page = [image.get("src") for image in root.iter("img")]
    assert all(src.startswith("data:image/png;base64,") for src in pictures_on_page)
    embedded = {base64.b64decode(src.partition(",")[2]) for src in pictures_on_page}
    files = {path.stem: path.read_bytes() for path in page.parent.glob("*.png")}
    assert embedded == set(files.values())
    assert set(files) == {
        "stick_figure", "flesh_figure", "geodesic_distance", "curvature", "normals", "anchor_points", "overlay",
        "head_path", "trajectories", "joint_angles", "energy", "bone_lengths", "stage_times", "error", "limb_angles",
        "bland_altman",
    }  # fmt: skip
    for name, data_bytes in files.items():
        decoded = cv2.imdecode(np.frombuffer(data_bytes, np.uint8), cv2.IMREAD_COLOR)
        assert decoded.std() > 3, name  # not a blank sheet
    assert sorted(path.name for path in page.parent.iterdir() if path.suffix != ".png") == ["report.html"]
    assert [number for _, number, _ in drawn] == list(range(len(files)))
    assert not any(word in text for word in ("http:", "https:", "<link", "<script", "@import", "url("))
    words = "".join(root.itertext())
    for said in (
        "Walk & turn",
        "a <b>folder</b>",
        "2026-01-02 03:04 UTC",
        "limbloc_ros 9.9",
        "process <in>",
        "fig. 10",
    ):
        assert said in words
    assert all(image.get("alt") for image in root.iter("img"))


def test_report_of_a_run_without_anybody(tmp_path):
    run = Run(tuple(FrameResult(int(f * 4e7), NoPerson("room is <empty>")) for f in range(3)))
    page = write_report(RunData.of(run, title="Empty"), [], tmp_path, created=CREATED)
    root = ElementTree.fromstring(page.read_text(encoding="utf-8"))
    assert not list(root.iter("img"))
    words = "".join(root.itertext())
    assert "room is <empty>" in words
    assert "0 (0.0 %)" in words
    assert "pictures of hull and figure are left out" in words


def test_report_is_the_same_every_time(tmp_path):
    data = RunData.of(recorded(frames=4, lost=(1,)), title="t")
    first, second = (write_report(data, [], tmp_path / name, created=CREATED).read_bytes() for name in "ab")
    assert first == second


def test_report_into_a_file_says_so(tmp_path):
    (tmp_path / "taken").write_text("a file")
    with pytest.raises(OutputError, match=r"taken.* cannot be written: File exists"):
        write_report(RunData.of(recorded(), title="t"), [], tmp_path / "taken")
