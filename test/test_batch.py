# SPDX-License-Identifier: Apache-2.0
"""Many recordings: on a real Dask cluster of processes the same files as here, also when a worker is killed."""

import os
import re
import shlex
import shutil
import signal
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from distributed import Client, LocalCluster
from documented import commands_by_page

from limbloc_ros import cli
from limbloc_ros.core.config import FitConfig
from limbloc_ros.core.errors import ConfigError
from limbloc_ros.recordings.batch import Task, do, do_here, do_on_cluster
from limbloc_ros.recordings.offline import OfflineConfig
from limbloc_ros.recordings.results import Run

#: Following is the quicker way to fit.
CONFIG = OfflineConfig(fit=FitConfig(temporal=True))
CASE = Path(__file__).parent / "data" / "benchmark" / "public" / "seq_wave"


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    """Two short recordings, and one that cannot be read."""
    folder = tmp_path_factory.mktemp("recordings")
    with np.load(CASE / "masks.npz", allow_pickle=False) as masks:
        for name, first, count in (("long", 0, 2), ("short", 20, 1)):
            (folder / name).mkdir()
            shutil.copy(CASE / "calib.json", folder / name)
            some = {camera: masks[camera][first : first + count] for camera in masks.files}
            np.savez_compressed(folder / name / "masks.npz", **some)
    (folder / "broken").mkdir()
    shutil.copy(CASE / "calib.json", folder / "broken")
    (folder / "broken" / "masks.npz").write_bytes(b"PK no archive")
    return folder


def tasks_into(recordings, out):
    return [Task(recordings / name, out / name, None, CONFIG) for name in ("long", "short", "broken")]


@pytest.fixture(scope="module")
def here(recordings, tmp_path_factory):
    """The results of this process."""
    out = tmp_path_factory.mktemp("here")
    outcomes = list(do_here(tasks_into(recordings, out), jobs=1))
    assert [(o.frames, o.poses) for o in outcomes] == [(2, 2), (1, 1), (0, 0)]
    assert "cannot be read as an .npz archive" in outcomes[2].error
    return out


def kill_the_first_that_works(address, killed):
    """kill -9 the worker that has got the long recording, half a second into it."""
    with Client(address, set_as_default=False) as client:
        pids = client.run(os.getpid)
        busy = []
        while not busy:
            time.sleep(0.05)
            busy = [worker for worker, keys in client.processing().items() if keys]
        time.sleep(0.5)
        os.kill(pids[busy[0]], signal.SIGKILL)
        killed.append(pids[busy[0]])


def run_documented_commands(recordings, out, address):
    """Those for a cluster, on one recording and this cluster in place of theirs."""
    found = {c for page in commands_by_page().values() for c in page if c.startswith("batch ") and "--dask" in c}
    assert found
    ours = {"bags/*": recordings / "short", "rig.yaml": recordings / "short" / "calib.json", "out/study": out}
    for command in sorted(found):
        words = [str(ours.get(word, word)) for word in shlex.split(command)]
        assert cli.main([re.sub(r"^tcp://.*", address, word) for word in words]) == 0
        assert len(Run.load(out / "short")) == 1


@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_cluster_gives_the_same_files_also_when_a_worker_is_killed(recordings, here, tmp_path):
    killed = []
    with LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster:
        address = cluster.scheduler_address
        killer = threading.Thread(target=kill_the_first_that_works, args=(address, killed))
        killer.start()
        outcomes = {o.task.recording.name: o for o in do_on_cluster(tasks_into(recordings, tmp_path), address)}
        killer.join()
        assert killed
        assert "cannot be read as an .npz archive" in outcomes.pop("broken").error
        assert not any(o.error or o.done_before for o in outcomes.values())
        again = list(do_on_cluster(tasks_into(recordings, tmp_path)[:2], address))
        assert all(o.done_before and not o.error for o in again)
        run_documented_commands(recordings, tmp_path / "documented", address)
    for name in ("long", "short"):
        for file in ("joints.npz", "joint_angles.csv", "rig.yaml"):
            assert (tmp_path / name / file).read_bytes() == (here / name / file).read_bytes()
        np.testing.assert_array_equal(Run.load(tmp_path / name).sigma, Run.load(here / name).sigma)
        assert not (tmp_path / name / ".partial").exists()


def test_finished_recordings_are_not_done_again(recordings, here):
    before = (here / "long" / "run.npz").stat().st_mtime_ns
    outcome = do(tasks_into(recordings, here)[0])
    assert outcome.done_before
    assert outcome.poses == 2
    assert (here / "long" / "run.npz").stat().st_mtime_ns == before


def test_what_process_has_done_is_not_done_again(recordings, tmp_path):
    command = ["process", str(recordings / "short"), "--temporal", "--jobs", "1", "--out", str(tmp_path / "short")]
    assert cli.main(command) == 0
    assert do(Task(recordings / "short", tmp_path / "short", None, CONFIG)).done_before


def test_results_of_other_parameters_are_not_taken_for_these(recordings, here):
    outcome = do(Task(recordings / "long", here / "long", None, CONFIG, leave_out=1))
    assert "holds results of another recording or other parameters" in outcome.error


def test_the_command_line(recordings, here, capsys):
    assert (
        cli.main(["batch", str(recordings / "long"), str(recordings / "broken"), "--temporal", "--out", str(here)]) == 1
    )
    said = capsys.readouterr()
    assert "1 of 2 recordings are done" in said.out
    assert "2 of 2 frames have a pose (done before)" in said.out + said.err
    assert (
        cli.main(["batch", str(recordings / "long"), str(recordings / "long"), "--temporal", "--out", str(here)]) == 2
    )
    assert "twice: long" in capsys.readouterr().err


def test_a_cluster_that_is_not_there(recordings, tmp_path, monkeypatch):
    monkeypatch.setattr("limbloc_ros.recordings.batch.PATIENCE_S", 0.5)
    with pytest.raises(ConfigError, match=r"--dask tcp://127\.0\.0\.1:1: no scheduler answers"):
        list(do_on_cluster(tasks_into(recordings, tmp_path), "tcp://127.0.0.1:1"))
