# SPDX-License-Identifier: Apache-2.0
"""The command line as a person meets it: help, one-line errors, exit codes, Ctrl-C and going on."""

import dataclasses
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from limbloc_ros import cli
from limbloc_ros.recordings.results import Run
from limbloc_ros.recordings.sources import rig_identity
from limbloc_ros.rig.rig_file import load_rig, save_rig

ROOT = Path(__file__).parents[1]
CASE = ROOT / "test" / "data" / "benchmark" / "public_few" / "cams4_p_man_avg"
LIMBLOC = [sys.executable, "-m", "limbloc_ros"]


@pytest.fixture
def short_case(tmp_path):
    """Two frames of a benchmark case."""
    folder = tmp_path / "short"
    folder.mkdir()
    shutil.copy(CASE / "calib.json", folder)
    np.savez_compressed(folder / "masks.npz", **{n: bits[:2] for n, bits in np.load(CASE / "masks.npz").items()})
    return folder


@pytest.mark.parametrize("command", ["", *cli.COMMANDS])
def test_help_teaches(command, capsys):
    with pytest.raises(SystemExit) as stopped:
        cli.main([*command.split(), "--help"])
    assert stopped.value.code == 0
    text = capsys.readouterr().out
    assert f"limbloc {command}".strip() in text
    assert "examples:" in text or "first steps:" in text


def test_without_a_command_it_shows_the_help(capsys):
    assert cli.main([]) == cli.EXIT_INPUT
    assert "first steps:" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["process", "nowhere"], "nowhere does not exist"),
        (["process", str(ROOT / "docs")], "needs --rig"),
        (["process", str(CASE), "--rig", "nowhere.yaml"], "rig file nowhere.yaml does not exist"),
        (["process", str(CASE), "--jobs", "-2"], "--jobs: expected 1 or more"),
        (["process", str(CASE), "--out", "x.npz", "--report"], "--report needs a folder"),
        (["process", str(CASE), "--config", "nowhere.yaml"], "parameters file nowhere.yaml does not exist"),
        (["report", "nowhere"], "holds no finished run"),
        (["demo", "--cameras", "1"], "--cameras: expected 2 to 16, got 1"),
        (["demo", "--people", "9"], "--people: expected 1 to 4, got 9"),
        (["demo", "--rate", "0"], "--rate: expected 0.1 to 120, got 0"),
    ],
)
def test_wrong_input_is_one_line_and_exit_code_2(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert cli.main(arguments) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.startswith(f"limbloc {arguments[0]}: ")
    assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_process_writes_results_and_a_report(short_case, tmp_path):
    out = tmp_path / "out"
    done = run("process", short_case, "--out", out, "--jobs", "1", "--report")
    assert done.returncode == 0, done.stderr
    assert "2 of 2 frames have a pose" in done.stdout
    names = {p.name for p in out.iterdir()}
    assert names == {
        "joints.npz", "joint_angles.csv", "run.npz", "run.json", "rig.yaml", "kept_frames.npz", "report",
    }  # fmt: skip
    assert (out / "report" / "report.html").stat().st_size > 100_000
    assert "limbloc process" in Run.load(out).about["command"]
    only = tmp_path / "predictions" / "short.npz"
    done = run("process", short_case, "--out", only, "--jobs", "2")
    assert done.returncode == 0, done.stderr
    assert [p.name for p in only.parent.iterdir()] == ["short.npz"]
    with np.load(only) as a, np.load(out / "joints.npz") as b:
        np.testing.assert_array_equal(a["joints"], b["joints"])


def test_results_of_another_recording_or_rig_are_not_replaced_unawares(short_case, tmp_path, capsys):
    out, other = tmp_path / "out", tmp_path / "other"
    command = ["process", str(short_case), "--out", str(out), "--jobs", "1", "--temporal"]
    assert cli.main(command) == 0
    before = (out / "run.npz").read_bytes()
    shutil.copytree(short_case, other)
    assert cli.main(["process", str(other), *command[2:]]) == 2
    error = capsys.readouterr().err
    assert f"{out} holds the results of another recording, {short_case}, and this is {other}" in error
    assert "choose another --out, or replace them with --overwrite" in error
    rig = load_rig(short_case / "calib.json")
    wider = [dataclasses.replace(c, K=c.K * [[1.01], [1], [1]]) if c.name == "cam0" else c for c in rig.cameras]
    save_rig(dataclasses.replace(rig, cameras=tuple(wider)), tmp_path / "rig.yaml")
    assert cli.main([*command, "--rig", str(tmp_path / "rig.yaml")]) == 2
    assert f"this recording with another rig, {out / 'rig.yaml'}" in capsys.readouterr().err
    assert (out / "run.npz").read_bytes() == before
    assert cli.main(command) == 0  # the same again
    assert cli.main(["process", str(other), *command[2:], "--overwrite"]) == 0
    assert Run.load(out).about["input"] == str(other)
    (out / "run.json").write_text("[]")
    capsys.readouterr()
    assert cli.main(command) == 2
    assert "holds results that cannot be read" in capsys.readouterr().err
    assert cli.main(["demo", "--out", str(out)]) == 2
    assert "holds a demo or results already" in capsys.readouterr().err


@pytest.mark.parametrize("folder", ["benchmark/public_few/cams4_p_man_avg/calib.json", "rgb_walk/calib.json"])
def test_the_rig_of_a_run_is_the_one_it_was_made_with(folder, tmp_path):
    rig = load_rig(ROOT / "test" / "data" / folder)
    save_rig(rig, tmp_path / "rig.yaml")
    assert rig_identity(load_rig(tmp_path / "rig.yaml")) == rig_identity(rig)


@pytest.mark.parametrize("after_s", [0.2, 1.0])  # while the workers import, or load kernels, or fit
def test_ctrl_c_keeps_what_is_done_and_the_same_command_goes_on(tmp_path, after_s):
    out = tmp_path / "out"
    command = [*LIMBLOC, "process", str(CASE), "--out", str(out), "--jobs", "2"]
    process = subprocess.Popen(
        command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    assert "4 cameras" in process.stderr.readline()
    time.sleep(after_s)
    os.killpg(process.pid, signal.SIGINT)
    _, error = process.communicate(timeout=60)
    if process.returncode == 0:
        pytest.fail("the case was finished before the signal came; take a longer one")
    assert process.returncode == cli.EXIT_INTERRUPTED, error
    assert "interrupted" in error
    assert "Traceback" not in error
    again = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300, check=False)
    assert again.returncode == 0, again.stderr
    assert not (out / ".partial").exists()
    assert len(Run.load(out)) == 12


def run(*arguments):
    return subprocess.run(
        [*LIMBLOC, *map(str, arguments)], cwd=ROOT, capture_output=True, text=True, timeout=300, check=False
    )
