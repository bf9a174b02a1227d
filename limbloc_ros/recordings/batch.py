# SPDX-License-Identifier: Apache-2.0
"""Many recordings: one after the other here, or spread over the machines of a Dask cluster that is there already.

A recording is one task, done by the same `offline.process` in one process of a worker, so that the results are the same
bit for bit. Finished frames are kept beside the results, which all machines see under the same path (a shared disk):
when a worker dies, the next one that gets its recording goes on where it stopped. A recording whose results are there
is not done again.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from limbloc_ros import __version__
from limbloc_ros.core import interrupts
from limbloc_ros.core.camera import Rig
from limbloc_ros.core.errors import ConfigError, InputError, Interrupted, LimblocError
from limbloc_ros.recordings import offline
from limbloc_ros.recordings.kept_frames import KeptFrames
from limbloc_ros.recordings.offline import OfflineConfig
from limbloc_ros.recordings.open_source import open_source
from limbloc_ros.recordings.results import Run
from limbloc_ros.rig.rig_file import load_rig, save_rig

#: A cluster that has not answered after this is not there, s.
PATIENCE_S = 15.0


@dataclass(frozen=True)
class Task:
    """One recording and where its results go; plain values, so that it travels to a worker.

    Attributes:
        recording: as in `open_source`.
        out: folder for the results.
        rig: rig file; None for benchmark cases.
        config: all parameters.
        background, masks, fps, leave_out: as in `open_source` and `offline.process`.
    """

    recording: Path
    out: Path
    rig: Path | None
    config: OfflineConfig
    background: str | None = None
    masks: bool = False
    fps: float | None = None
    leave_out: int = 0


@dataclass(frozen=True)
class Outcome:
    """What became of a recording: frames with and without a pose, or the error that ended it."""

    task: Task
    frames: int = 0
    poses: int = 0
    done_before: bool = False
    error: str = ""


def do(task: Task, jobs: int = 1) -> Outcome:
    """Process one recording, unless its results are there; an error of ours ends only this recording."""
    try:
        rig = load_rig(task.rig) if task.rig else None
        source = open_source(
            task.recording, rig, task.config, background=task.background, masks=task.masks, fps=task.fps
        )
        key = offline.run_key(source, task.config, task.leave_out)
        if (task.out / "run.json").is_file():  # the last file that a run writes
            run = Run.load(task.out)
            if run.about.get("key") != key:
                raise InputError(
                    f"{task.out} holds results of another recording or other parameters; choose another --out, or "
                    "remove it"
                )
            return _outcome(task, run, done_before=True)
        with interrupts.ending_at_once(f"limbloc batch: interrupted before the first frame of {task.recording}"):
            offline.prepare()
        partial, kept = task.out / ".partial", KeptFrames()
        run = offline.process(source, task.config, partial=partial, jobs=jobs, leave_out=task.leave_out, kept=kept)
        save_folder(run, source.rig, kept, task.out)
        return _outcome(task, run)
    except LimblocError as error:
        if isinstance(error, Interrupted):
            raise
        return Outcome(task, error=str(error))


def do_here(tasks: Sequence[Task], jobs: int = 0) -> Iterator[Outcome]:
    """One recording after the other, each on `jobs` processes (0: one per core)."""
    for task in tasks:
        yield do(task, jobs)


def do_on_cluster(tasks: Sequence[Task], address: str) -> Iterator[Outcome]:
    """Every recording as a task of a Dask cluster, in the order in which they end.

    Args:
        tasks: their paths must be the same on all machines.
        address: of the scheduler, such as `tcp://host:8786`.

    Raises:
        ConfigError: no Dask here, no scheduler or worker there, or workers with another version of limbloc.
        Interrupted: Ctrl-C.
    """
    try:
        from distributed import Client, as_completed
    except ModuleNotFoundError:
        raise ConfigError("--dask needs distributed; install it with `pip install 'limbloc_ros[cluster]'`") from None
    try:
        client = Client(address, timeout=PATIENCE_S)
    except (OSError, ValueError) as error:
        raise ConfigError(f"--dask {address}: no scheduler answers ({error}); expected tcp://HOST:8786") from None
    with client:
        _check_workers(client, address)
        futures = {client.submit(do, _absolute(task), pure=False): task for task in tasks}
        try:
            for future in as_completed(futures):
                reason = future.exception()  # not ours, which `do` catches: a worker that died again and again
                failed = Outcome(futures[future], error=f"{type(reason).__name__}: {reason}")
                yield future.result() if reason is None else failed
        except KeyboardInterrupt:
            client.cancel(list(futures), force=True)
            raise Interrupted(
                "interrupted; finished recordings and frames are kept: run the same command again to go on"
            ) from None


def version_here() -> str:
    """What a worker runs."""
    return __version__


def _check_workers(client: Any, address: str) -> None:
    """Raise ConfigError unless there are workers, and all would give our results."""
    try:
        versions: dict[str, str] = client.run(version_here)
    except ModuleNotFoundError as error:
        raise ConfigError(f"--dask {address}: its workers lack {error.name}; install limbloc_ros there") from None
    others = {worker: version for worker, version in versions.items() if version != __version__}
    if not versions or others:
        what = ", ".join(f"{worker} has {version}" for worker, version in others.items()) or "it has no worker"
        raise ConfigError(f"--dask {address}: expected workers with limbloc_ros {__version__}; {what}")


def _absolute(task: Task) -> Task:
    """The same for processes with another working folder."""
    rig = task.rig.resolve() if task.rig else None
    return replace(task, recording=task.recording.resolve(), out=task.out.resolve(), rig=rig)


def _outcome(task: Task, run: Run, done_before: bool = False) -> Outcome:
    return Outcome(task, len(run), sum(not reason for reason in run.reasons), done_before)


def save_folder(run: Run, rig: Rig, kept: KeptFrames, out: Path) -> None:
    """Everything about a run; `run.json`, which says that it is finished, after all else."""
    save_rig(rig, out / "rig.yaml")
    kept.save(out)
    run.save(out)
    offline.forget_partial(out / ".partial")
