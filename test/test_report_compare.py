# SPDX-License-Identifier: Apache-2.0
"""A run beside a reference: matched in time, moved only when asked, compared in numbers that can be checked by hand."""

import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
from figure_poses import fitted_states, pose_of, posed

from limbloc_ros import cli
from limbloc_ros.commands.report import run_data, with_reference
from limbloc_ros.core.errors import InputError, NoPerson
from limbloc_ros.core.figure import FigureState
from limbloc_ros.core.pose import JOINT, JOINT_NAMES
from limbloc_ros.export.clip import clip_of
from limbloc_ros.export.trc import trc_text
from limbloc_ros.recordings.results import FrameResult, Run
from limbloc_ros.report import plots, plots_compare, plots_motion
from limbloc_ros.report.compare import agreement, limb_angles, load_reference
from limbloc_ros.report.summary import agreement_table, error_table, jump_table

STEP_NS = 40_000_000


def walking(frames=12, start_ns=0, lost=(), jump_at=None):
    """A person of one size who moves 2 cm a frame, and flings an arm at one."""
    shape = fitted_states()[0].shape
    results = []
    for f in range(frames):
        state = posed({"knee_L_flexion": 5.0 * f, "shoulder_R_abduction": 90.0 if f == jump_at else 10.0})
        placed = FigureState(np.array([0.02 * f, 0.0, 1.0]), state.rotations, shape)
        results.append(FrameResult(start_ns + f * STEP_NS, NoPerson("gone") if f in lost else pose_of(placed)))
    return Run(tuple(results), {"input": "nowhere", "consecutive": True})


def turned(points, degrees, shift):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return points @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T + shift


def test_limb_angles_are_those_that_were_posed():
    degrees = {"knee_L_flexion": 40.0, "elbow_R_flexion": 70.0, "shoulder_L_abduction": 90.0, "hip_R_flexion": 30.0}
    found = {n: float(np.degrees(v[0])) for n, v in limb_angles(pose_of(posed(degrees)).joints[None]).items()}
    straight = {n: float(np.degrees(v[0])) for n, v in limb_angles(pose_of(posed({})).joints[None]).items()}
    assert found["knee_L_bend"] == pytest.approx(40, abs=3)
    assert found["elbow_R_bend"] == pytest.approx(70, abs=3)
    assert found["shoulder_L_raise"] - straight["shoulder_L_raise"] == pytest.approx(85, abs=10)
    assert found["hip_R_bend"] == pytest.approx(30, abs=6)
    assert found["knee_R_bend"] < 3
    assert max(straight.values()) < 12


def test_agreement_is_bland_and_altmans():
    reference = np.array([0.0, 10, 20, 30, np.nan, 50])
    found = agreement(reference + np.array([1.0, 3, 1, 3, 0, 2]), reference)
    assert found.count == 5
    assert found.bias == pytest.approx(2.0)
    assert found.sd == pytest.approx(1.0)
    assert found.limits == pytest.approx((0.04, 3.96))
    assert (found.mae, found.rmsd) == pytest.approx((2.0, np.sqrt(24 / 5)))
    assert found.r > 0.99
    assert agreement(reference, np.full(6, np.nan)) is None
    assert np.isnan(agreement(np.ones(4), np.arange(4.0)).r)


def test_markers_of_another_rate_and_start_are_matched_by_time(tmp_path):
    run = walking(start_ns=10**18, lost=(3,))
    path = tmp_path / "x.trc"
    path.write_text(trc_text(clip_of(walking(24)), "x.trc", "mm"))
    reference = load_reference(path, run)
    assert reference.notes == ("12 of 12 frames matched by the time since the run's first frame",)
    known = np.isfinite(reference.joints).all(axis=2)
    assert known.sum(axis=1).tolist() == [18] * 12
    same = np.isfinite(run.joints).all(axis=2) & known
    np.testing.assert_allclose(reference.joints[same], run.joints[same], atol=2e-6)
    late = load_reference(path, run, offset_s=0.08)
    np.testing.assert_allclose(late.joints[5, JOINT["knee_L"]], walking().joints[3, JOINT["knee_L"]], atol=2e-6)


def test_a_reference_with_other_axes_is_only_moved_when_asked(tmp_path):
    run = walking()
    np.savez(tmp_path / "x.npz", joints=turned(run.joints, 70.0, [1.0, -2.0, 0.1]), joint_names=np.array(JOINT_NAMES))
    as_it_is = load_reference(tmp_path / "x.npz", run)
    assert np.linalg.norm(as_it_is.joints - run.joints, axis=2).min() > 0.5
    moved = load_reference(tmp_path / "x.npz", run, align="rigid")
    np.testing.assert_allclose(moved.joints, run.joints, atol=1e-9)
    assert "turned by 70.0 degrees" in moved.notes[1]


@pytest.mark.parametrize("names", [("RKnee", "LWrist", "Nose"), ("RIGHT_KNEE", "LEFT_WRIST", "NOSE")])
def test_arrays_of_another_tool_are_known_by_their_shapes(names, tmp_path):
    """Pose2Sim's and MediaPipe's names; two arrays of that shape would leave open which one it is."""
    run = walking()
    places = np.stack([run.joints[:, JOINT["knee_R"]], run.joints[:, JOINT["wrist_L"]], run.joints[:, 0] + 1], axis=1)
    arrays = {"names": np.array(names), "xyz": places, "confidence": np.ones((len(run), 3))}
    np.savez(tmp_path / "a.npz", **arrays)
    reference = load_reference(tmp_path / "a.npz", run)
    known = np.isfinite(reference.joints).all(axis=(0, 2))
    assert [JOINT_NAMES[i] for i in np.flatnonzero(known)] == [n for n in JOINT_NAMES if n in ("knee_R", "wrist_L")]
    np.testing.assert_array_equal(reference.joints[:, known], run.joints[:, known])
    np.savez(tmp_path / "b.npz", **arrays, raw=places)
    with pytest.raises(InputError, match="save the arrays under these names"):
        load_reference(tmp_path / "b.npz", run)


def test_another_run_also_brings_its_native_angles(tmp_path):
    run = walking()
    walking(lost=(2,)).save(tmp_path / "other")
    reference = load_reference(tmp_path / "other", run)
    assert np.isnan(reference.angles["knee_L_flexion"][2])
    rows = {row[0]: row for row in agreement_table(run_data(run).angles, reference.angles)}
    assert rows["knee L flexion"][1:5] == ["11", "+0.0", "+0.0 to +0.0", "0.0"]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda p: np.savez(p / "x.npz", joints=np.zeros((3, 1, 3)), joint_names=["knee_L"]), "cannot be matched with"),
        (lambda p: np.savez(p / "x.npz", joints=np.zeros((12, 1, 3)), joint_names=["tail"]), "expected joints such as"),
        (lambda p: np.savez(p / "x.npz", joints=np.zeros((12, 3)), joint_names=["knee_L"]), "expected joints"),
        (lambda p: np.savez(p / "x.npz", other=np.zeros(3)), "m and joint_names [J], got other"),
        (lambda p: (p / "x.npz").write_text("no"), "cannot be read"),
    ],
)
def test_references_that_cannot_be_used_are_refused(make, message, tmp_path, capsys):
    walking().save(tmp_path / "run")
    make(tmp_path)
    assert cli.main(["report", str(tmp_path / "run"), "--reference", str(tmp_path / "x.npz")]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "run" / "report").exists()


def test_the_page_has_the_comparison(tmp_path, capsys):
    walking(jump_at=8, lost=(2,)).save(tmp_path / "run")
    joints = walking(jump_at=8).joints + np.array([0, 0, 0.03])
    np.savez(tmp_path / "x.npz", joints=joints, joint_names=np.array(JOINT_NAMES))
    assert cli.main(["report", str(tmp_path / "run"), "--reference", str(tmp_path / "x.npz")]) == 0
    folder = tmp_path / "run" / "report"
    assert {p.stem for p in folder.glob("*.png")} >= {
        "error", "limb_angles", "bland_altman", "trajectories", "ranges_of_motion", "joint_angles", "bone_lengths",
    }  # fmt: skip
    root = ElementTree.fromstring((folder / "report.html").read_text(encoding="utf-8"))
    tables = {section.get("id"): section for section in root.iter("section")}
    errors = {row[0].text: [cell.text for cell in row[1:]] for row in tables["errors"].iter("tr")}
    assert errors["knee L"] == ["30.0", "30.0", "30.0", "30.0", "100.0 %"]
    assert "12 frames matched one by one" in capsys.readouterr().out
    jumps = ["".join(row.itertext()) for row in tables["jumps"].iter("tr")]
    assert any(row.startswith("80.32 s") and "wrist R" in row for row in jumps)
    ranges = {row[0].text: [cell.text for cell in row[1:]] for row in tables["ranges"].iter("tr")}
    assert ranges["knee L flexion"] == ["0", "30", "55", "55", "-10 to 165", "0 %"]


def test_plots_show_the_numbers():
    run = walking(40)
    data = with_reference(run_data(run), load_reference_of(run, 0.01))
    ours, theirs = limb_angles(data.joints), limb_angles(data.truth)
    bias = float(np.degrees(np.mean([ours[f"knee_{s}_bend"] - theirs[f"knee_{s}_bend"] for s in "LR"])))
    figure = plots_compare.bland_altman(ours, theirs)
    knee = next(axes for axes in figure.axes if axes.get_title() == "knee bend")
    levels = [line.get_ydata()[0] for line in knee.get_lines() if len(line.get_xdata()) == 2]
    assert min(abs(level - bias) for level in levels) < 1e-9
    limits = plots.joint_angles(data)
    panel = next(axes for axes in limits.axes if axes.get_title().startswith("knee flexion"))
    assert panel.get_title() == "knee flexion  (-10 to 165)"
    assert panel.get_ylim()[1] > 165  # 195 degrees were posed
    assert len(panel.patches) >= 1
    table = {row[0]: row[1:] for row in plots_motion.ranges_table(data)}
    assert table["knee L flexion"][-1] == "15 %"  # 170 degrees and more
    assert error_table(data)


def load_reference_of(run, noise):
    """The run's own joints with noise, as a reference."""
    from limbloc_ros.report.compare import Reference

    rng = np.random.default_rng(0)
    return Reference("noise", run.joints + rng.normal(0, noise, run.joints.shape))


def test_jumps_are_told_the_farthest_first():
    rows = jump_table(run_data(walking(jump_at=6)))
    assert [row[0] for row in rows] == ["6", "7"]
    told = rows[0][2].split(", ")
    assert [text.rsplit(" ", 2)[0] for text in told] == ["fingertip R", "hand R", "wrist R", "elbow R"]
    assert jump_table(run_data(walking())) == []
