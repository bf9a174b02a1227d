# SPDX-License-Identifier: Apache-2.0
"""What a run leaves on disk, and what comes back."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest

from limbloc_ros.core.errors import InputError, NoPerson, OutputError
from limbloc_ros.core.people import Body
from limbloc_ros.core.pose import JOINT_NAMES, Flesh, Pose
from limbloc_ros.recordings.checkpoint import FLUSH_FRAMES, Checkpoint, fingerprint
from limbloc_ros.recordings.kept_frames import CAPACITY, KeptFrames
from limbloc_ros.recordings.results import FrameResult, Run, load_frames, save_frames


def make_pose(seed):
    rng = np.random.default_rng(seed)
    return Pose(
        joints=rng.normal(size=(len(JOINT_NAMES), 3)),
        rotations=rng.normal(size=(2, 3, 3)),
        bone_names=("pelvis", "chest"),
        angles={"knee_L": rng.normal(), "knee_R": rng.normal()},
        sizes={"femur": rng.uniform()},
        flesh=Flesh(rng.normal(size=(4, 3)), rng.uniform(size=4), np.array([[0, 0, 0], [1, 2, 3]]), ("head", "chest")),
        parameters=rng.normal(size=7),
        energy=rng.uniform(),
        sigma=rng.uniform(size=len(JOINT_NAMES)),
        reliable=bool(seed % 2),
        stage_ms={"search": 3.5},
        risk=rng.uniform(),
        doubt="" if seed % 2 else "an arm shows nowhere",
    )


def make_frames(count=4):
    """Every third frame is empty."""
    return [
        FrameResult(
            1_700_000_000_123_456_789 + 40_000_000 * i,
            NoPerson("the room is empty") if i % 3 == 2 else make_pose(i),
            {"hull": 1.0 + i},
        )
        for i in range(count)
    ]


def assert_same(a, b):
    """Equal bit for bit, also inside the poses."""
    assert (a.stamp_ns, a.stage_ms) == (b.stamp_ns, b.stage_ms)
    if isinstance(b.outcome, NoPerson):
        assert a.outcome == b.outcome
        return
    for name in ("joints", "rotations", "parameters", "sigma"):
        np.testing.assert_array_equal(getattr(a.outcome, name), getattr(b.outcome, name))
    for name in ("bone_names", "angles", "sizes", "energy", "reliable", "stage_ms", "risk", "doubt"):
        assert getattr(a.outcome, name) == getattr(b.outcome, name)
    for name in ("centres", "radii", "parts"):
        np.testing.assert_array_equal(getattr(a.outcome.flesh, name), getattr(b.outcome.flesh, name))
    assert a.outcome.flesh.part_names == b.outcome.flesh.part_names


@pytest.mark.parametrize("empty_only", [False, True])
def test_frames_come_back_bit_for_bit(tmp_path, empty_only):
    frames = [f for f in make_frames(7) if not empty_only or isinstance(f.outcome, NoPerson)]
    save_frames(frames, tmp_path / "run.npz")
    again = load_frames(tmp_path / "run.npz")
    assert len(again) == len(frames)
    for a, b in zip(again, frames, strict=True):
        assert_same(a, b)


def test_a_run_from_before_doubts_were_told_can_be_read(tmp_path):
    save_frames(make_frames(), tmp_path / "run.npz")
    with np.load(tmp_path / "run.npz") as data:
        older = {name: array for name, array in data.items() if name not in ("risk", "doubts")}
    np.savez(tmp_path / "run.npz", **older)
    poses = [frame.outcome for frame in load_frames(tmp_path / "run.npz") if isinstance(frame.outcome, Pose)]
    assert [pose.reliable for pose in poses] == [False, True, True]
    assert [(pose.doubt, pose.risk) for pose in poses] == [("", 1.0), ("", 0.0), ("", 0.0)]


def test_joints_file_is_what_the_benchmark_reads(tmp_path):
    frames = make_frames()
    Run(tuple(frames)).save_joints(tmp_path / "new" / "case.npz")
    with np.load(tmp_path / "new" / "case.npz", allow_pickle=False) as data:
        assert data["joint_names"].tolist() == list(JOINT_NAMES)
        assert data["joints"].shape == (4, 25, 3)
        assert np.isnan(data["joints"][2]).all()
        np.testing.assert_array_equal(data["joints"][1], frames[1].outcome.joints)
        assert np.isnan(data["energy"][2])
        assert np.isnan(data["sigma"][2]).all()
        assert data["reliable"].tolist() == [False, True, False, True]
        np.testing.assert_allclose(np.diff(data["stamps"]), 0.04, atol=1e-6)
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["case.npz"]


def test_angles_file_names_units_and_keeps_every_nanosecond(tmp_path):
    frames = make_frames()
    Run(tuple(frames), {"input": "bags/walk"}).save(tmp_path)
    with (tmp_path / "joint_angles.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["stamp_s", "knee_L_rad", "knee_R_rad", "energy", "reliable"]
    assert rows[0]["stamp_s"] == "1700000000.123456789"
    assert float(rows[1]["knee_R_rad"]) == pytest.approx(frames[1].outcome.angles["knee_R"], rel=1e-8)
    assert rows[2]["knee_L_rad"] == "nan"
    assert (rows[1]["reliable"], rows[2]["reliable"]) == ("1", "0")
    about = json.loads((tmp_path / "run.json").read_text())
    assert (about["input"], about["frames"], about["poses"]) == ("bags/walk", 4, 3)
    again = Run.load(tmp_path)
    assert again.about["input"] == "bags/walk"
    assert again.reasons == ("", "", "the room is empty", "")
    for a, b in zip(again.frames, frames, strict=True):
        assert_same(a, b)


def test_a_run_without_any_pose_can_be_saved(tmp_path):
    Run((FrameResult(0, NoPerson("empty")),)).save(tmp_path)
    with np.load(tmp_path / "joints.npz") as data:
        assert np.isnan(data["joints"]).all()
    assert (tmp_path / "joint_angles.csv").read_text().splitlines()[1] == "0.000000000,nan,0"


def test_nothing_is_lost_when_writing_fails(tmp_path):
    run = Run(tuple(make_frames()))
    run.save_joints(tmp_path / "joints.npz")
    before = (tmp_path / "joints.npz").read_bytes()
    (tmp_path / ".writing-joints.npz").mkdir()  # as if the disk refused
    with pytest.raises(OutputError, match=r"joints\.npz cannot be written: .*finished frames are kept"):
        run.save_joints(tmp_path / "joints.npz")
    assert (tmp_path / "joints.npz").read_bytes() == before
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be written: Not a directory"):
        run.save(tmp_path / "file" / "out")


def test_people_of_an_earlier_run_in_the_same_folder_are_forgotten(tmp_path):
    frames = make_frames()
    together = [replace(frame, others=(Body(2, make_pose(9)),)) for frame in frames]
    Run(tuple(together)).save(tmp_path)
    (tmp_path / "people" / "p2" / "notes.txt").write_text("ours")
    assert Run.load(tmp_path).numbers == (1, 2)
    Run(tuple(frames)).save(tmp_path)
    assert Run.load(tmp_path).numbers == (1,)
    assert [path.name for path in tmp_path.glob("people/*/*")] == ["notes.txt"]  # what is not the run's own stays
    Run(tuple(make_frames(7))).save(tmp_path)  # another recording
    assert len(Run.load(tmp_path)) == 7


def test_no_run_or_a_damaged_one(tmp_path):
    with pytest.raises(InputError, match=r"holds no finished run: expected run\.npz"):
        Run.load(tmp_path)
    (tmp_path / "run.npz").write_bytes(b"PK")
    with pytest.raises(InputError, match=r"cannot be read as an \.npz archive"):
        Run.load(tmp_path)
    np.savez(tmp_path / "run.npz", something=np.zeros(1))
    with pytest.raises(InputError, match="is not a results file of this version"):
        Run.load(tmp_path)


def test_checkpoint_goes_on_where_it_stopped(tmp_path):
    frames = make_frames(FLUSH_FRAMES + 5)
    first = Checkpoint(tmp_path / ".partial", "key")
    for frame in frames[:-2]:
        first.add(frame)
    first.flush()
    second = Checkpoint(tmp_path / ".partial", "key")
    assert not second.discarded
    for a, b in zip(second.done, frames[:-2], strict=True):
        assert_same(a, b)
    second.add(frames[-2])
    second.flush()
    assert len(Checkpoint(tmp_path / ".partial", "key").done) == len(frames) - 1


def test_checkpoint_of_another_run_or_a_damaged_one_is_not_used(tmp_path):
    first = Checkpoint(tmp_path / ".partial", "key")
    for frame in make_frames(FLUSH_FRAMES + 1):
        first.add(frame)
    first.flush()
    chunks = sorted((tmp_path / ".partial" / "key").glob("*.npz"))
    assert len(chunks) == 2
    chunks[1].write_bytes(b"half a file")
    assert len(Checkpoint(tmp_path / ".partial", "key").done) == FLUSH_FRAMES
    other = Checkpoint(tmp_path / ".partial", "other")
    assert other.discarded
    assert other.done == []
    assert not (tmp_path / ".partial" / "key").exists()


def test_fingerprint_depends_on_every_value():
    assert fingerprint({"a": 1, "b": 2}) == fingerprint({"b": 2, "a": 1})
    assert fingerprint({"a": 1}) != fingerprint({"a": 2})


def test_kept_frames_are_few_and_spread_over_the_whole_recording(tmp_path):
    rng = np.random.default_rng(5)
    masks = [{"cam0": rng.integers(0, 2, (6, 10), dtype=np.uint8) * 255} for _ in range(500)]
    image = np.full((6, 10, 3), (10, 120, 240), dtype=np.uint8)
    kept = KeptFrames()
    for number, frame in enumerate(masks):
        kept.add(number, frame, {"cam0": image})
    assert CAPACITY // 2 <= len(kept.numbers) <= CAPACITY
    gaps = np.diff([*kept.numbers, 500])
    assert gaps.max() <= 2 * gaps[:-1].min()
    kept.save(tmp_path)
    again = KeptFrames.load(tmp_path)
    assert again.numbers == kept.numbers
    for number in again.numbers:
        np.testing.assert_array_equal(again.masks(number)["cam0"], masks[number]["cam0"])
        assert np.abs(again.images(number)["cam0"].astype(int) - image).max() < 12  # JPEG
    assert KeptFrames.load(tmp_path / "nothing").numbers == ()


def test_kept_masks_stand_in_for_images():
    kept = KeptFrames()
    mask = np.eye(9, dtype=np.uint8) * 255
    kept.add(0, {"cam0": mask}, {})
    np.testing.assert_array_equal(kept.images(0)["cam0"], mask)
