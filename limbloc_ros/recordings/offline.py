# SPDX-License-Identifier: Apache-2.0
"""The offline run: a recording -> the pose of every frame, on all cores, the same code as the live nodes.

Frames are independent (paper section 4), so carving and fitting go to a pool of single-threaded processes, while the
masks come from one sequential stream. Any number of jobs gives the same result. Only with `temporal` each frame starts
from the one before, and one process does them in order.

Who is who (`core/people`) goes on from frame to frame in any case. It is cheap, so this process does it with what the
others have found: the parts of each hull and the pose of each part alone. Only where people touch it needs the hull
itself, carves it once more, and fits the pieces.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import multiprocessing
import os
import shutil
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from limbloc_ros import __version__
from limbloc_ros.core import background, parts
from limbloc_ros.core.camera import Rig
from limbloc_ros.core.config import BackgroundConfig, FitConfig, HullConfig, SyncConfig
from limbloc_ros.core.errors import InputError, Interrupted, NoPerson
from limbloc_ros.core.hull import Hull
from limbloc_ros.core.parts import Part, Sight, candidates
from limbloc_ros.core.people import Body, People
from limbloc_ros.core.pipeline import Carver, PoseEstimator
from limbloc_ros.core.pose import Pose
from limbloc_ros.recordings.cases import pack_mask, unpack_mask
from limbloc_ros.recordings.checkpoint import Checkpoint, fingerprint
from limbloc_ros.recordings.kept_frames import KeptFrames
from limbloc_ros.recordings.results import FrameResult, Run
from limbloc_ros.recordings.sources import Source


@dataclass(frozen=True)
class OfflineConfig:
    """Every parameter of an offline run; `background_of` replaces `background` for single cameras."""

    background: BackgroundConfig = field(default_factory=BackgroundConfig)
    background_of: dict[str, BackgroundConfig] = field(default_factory=dict)
    sync: SyncConfig = field(default_factory=SyncConfig)
    hull: HullConfig = field(default_factory=HullConfig)
    fit: FitConfig = field(default_factory=FitConfig)


#: Called after each frame with the finished ones and, where it is known, their total.
Progress = Callable[[int, int | None], None]


def process(
    source: Source,
    config: OfflineConfig,
    *,
    partial: Path | None = None,
    jobs: int = 0,
    leave_out: int = 0,
    kept: KeptFrames | None = None,
    progress: Progress = lambda done, total: None,
    say: Callable[[str], None] = lambda text: None,
) -> Run:
    """Fit every frame of a recording.

    Args:
        source: where the masks come from.
        config: all parameters.
        partial: folder in which finished frames are kept; the caller calls `forget_partial` once it has saved the
            run. None: nothing is kept.
        jobs: processes; 0 takes one per usable core.
        leave_out: the first so many frames give no result; the background is learnt from them all the same.
        kept: takes a few frames with masks and images for the report.
        progress: told after each frame.
        say: told in words what a person would want to know.

    Raises:
        InputError: the recording cannot be used.
        Interrupted: Ctrl-C.
    """
    if jobs < 0:
        raise InputError(f"jobs: expected 0 (one per core) or more, got {jobs}")
    # A temporal frame depends on all before it, so that half a run is of no use.
    keep = partial is not None and not config.fit.temporal
    key = run_key(source, config, leave_out)
    checkpoint = Checkpoint(partial if keep else None, key)
    if checkpoint.discarded:
        say(f"the unfinished run in {partial} was of other input or settings; starting anew")
    done = checkpoint.done
    if done:
        say(f"going on after frame {len(done)}, where the last run was interrupted")
    if config.fit.temporal and jobs != 1:
        say("temporal: each frame starts from the one before, so one process does them all, in order")
    if source.frames is not None and leave_out >= source.frames:
        raise InputError(f"{leave_out} frames are to be left out, but the recording has only {source.frames}")
    total = None if source.frames is None else source.frames - leave_out
    jobs = 1 if config.fit.temporal else min(jobs or usable_cores(), total or 10**6)
    frames = list(done)
    # Frames of a set that is no sequence have nothing to do with each other.
    people = People(config.fit, consecutive=source.about.get("consecutive", True))
    if checkpoint.state is not None:
        people.resume(checkpoint.state)
    kept = kept if kept is not None else KeptFrames()
    progress(len(frames), total)
    told = 0
    try:
        for seen in _seen(source, config, people.max_people, jobs, _Left(leave_out, len(done)), kept):
            frame = _followed(people, seen)
            frames.append(frame)
            checkpoint.add(frame, people.snapshot)
            progress(len(frames), total)
            for note in source.notes[told:]:  # at once: who is told only at the end has waited in vain
                say(note)
            told = len(source.notes)
    except KeyboardInterrupt:
        raise Interrupted(_how_to_go_on(len(frames), total, keep, config)) from None
    except BrokenProcessPool:
        raise InputError(
            f"a worker process died after {len(frames)} frames, most likely for want of memory; "
            "run the same command again with fewer --jobs: finished frames are kept"
        ) from None
    finally:
        checkpoint.flush()
    for note in source.notes[told:]:
        say(note)
    if not frames:
        raise InputError(f"{source.about['input']}: no frame could be made of it; " + "; ".join(source.notes))
    settings = {"left_out": leave_out, "config": dataclasses.asdict(config), "version": __version__, "key": key}
    about = {**source.about, **settings}
    return Run(tuple(frames), about)


def prepare(say: Callable[[str], None] = lambda text: None) -> None:
    """Compile or load the kernels, once for all worker processes; when that takes long, `say` tells so."""
    cv2.setNumThreads(1)
    patience = threading.Timer(
        4.0, say, ["loading the numeric kernels; the first run compiles them, which takes a minute or more"]
    )
    patience.daemon = True
    patience.start()
    try:
        background.warm_up()
        PoseEstimator.warm_up()
        parts.warm_up()
    finally:
        patience.cancel()


def forget_partial(partial: Path) -> None:
    """Remove the partial results of a run that has been saved."""
    if partial.is_dir():
        shutil.rmtree(partial)


def run_key(source: Source, config: OfflineConfig, leave_out: int = 0) -> str:
    """Fingerprint of everything that the results depend on."""
    return fingerprint([__version__, source.identity, dataclasses.asdict(config), leave_out])


def usable_cores() -> int:
    """Cores that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _how_to_go_on(done: int, total: int | None, kept: bool, config: OfflineConfig) -> str:
    text = f"interrupted after {done}{f' of {total}' if total else ''} frames; "
    if kept:
        return text + "run the same command again to go on from there"
    if config.fit.temporal:
        return text + "a temporal run starts anew, because every frame depends on all before it"
    return text + "nothing was kept"


@dataclass(frozen=True)
class _Left:
    """Which frames are to be fitted: not the first `leave_out`, and of the others not the first `done`."""

    leave_out: int
    done: int


@dataclass(frozen=True)
class _Job:
    """One frame on its way to a worker; masks travel as packed bits."""

    stamp_ns: int
    packed: dict[str, NDArray[np.uint8]]
    reason: str
    stage_ms: dict[str, float]


@dataclass(frozen=True)
class _Seen:
    """What there is to see in one frame, or why there is nothing."""

    stamp_ns: int
    sight: Sight | NoPerson
    stage_ms: dict[str, float]


@dataclass(frozen=True)
class _Fitted:
    """A frame on its way back from a worker: a `Sight` whose hulls stayed there."""

    stamp_ns: int
    parts: tuple[Part, ...]
    outcomes: tuple[Pose | NoPerson, ...]
    reason: str
    stage_ms: dict[str, float]


class _Fitter:
    """One frame at a time: masks -> hull -> poses."""

    def __init__(self, rig: Rig, config: OfflineConfig, max_people: int) -> None:
        self._widths = {camera.name: camera.width for camera in rig.cameras}
        self._carver = Carver(rig, config.hull)
        self._max_people = max_people
        self._estimator = PoseEstimator(config.fit)

    def carve(self, job: _Job) -> Hull | NoPerson:
        """The hull of one frame."""
        if job.reason:
            return NoPerson(job.reason)
        return self._carver.carve({name: unpack_mask(bits, self._widths[name]) for name, bits in job.packed.items()})

    def look(self, job: _Job) -> _Seen:
        """What there is to see in one frame; nothing is fitted yet."""
        start = time.process_time()
        hull = self.carve(job)
        stage_ms = job.stage_ms if job.reason else {**job.stage_ms, "hull": 1e3 * (time.process_time() - start)}
        return _Seen(job.stamp_ns, hull if isinstance(hull, NoPerson) else Sight.of(hull, self._max_people), stage_ms)

    def fit(self, job: _Job) -> _Fitted:
        """The pose of each part of one frame alone; the same in whichever process it runs."""
        seen = self.look(job)
        if isinstance(seen.sight, NoPerson):
            return _Fitted(job.stamp_ns, (), (), seen.sight.reason, seen.stage_ms)
        outcomes = tuple(seen.sight.fit(n, self._estimator) for n in range(len(seen.sight.parts)))
        return _Fitted(job.stamp_ns, seen.sight.parts, outcomes, "", seen.stage_ms)

    def back(self, fitted: _Fitted, job: _Job) -> _Seen:
        """What a worker's `fit` saw; its hulls are carved again when they are asked for."""

        def hulls() -> Sequence[Hull]:
            hull = self.carve(job)
            assert isinstance(hull, Hull), "carving gives the same in every process"
            return candidates(hull, self._max_people)

        sight: Sight | NoPerson = Sight(fitted.parts, functools.cache(hulls), fitted.outcomes)
        if fitted.reason:
            sight = NoPerson(fitted.reason)
        return _Seen(fitted.stamp_ns, sight, fitted.stage_ms)


def _followed(people: People, seen: _Seen) -> FrameResult:
    """Who is who in a frame."""
    bodies = people.follow(seen.sight, seen.stamp_ns)
    first: Body = bodies[0]
    return FrameResult(seen.stamp_ns, first.outcome, seen.stage_ms, first.number, bodies[1:])


def _seen(
    source: Source, config: OfflineConfig, max_people: int, jobs: int, left: _Left, kept: KeptFrames
) -> Iterator[_Seen]:
    """What there is to see, in the order of the frames; with several jobs also the poses of all parts."""
    work = _jobs(source, kept, left)
    fitter = _Fitter(source.rig, config, max_people)
    if jobs == 1:
        cv2.setNumThreads(1)
        yield from map(fitter.look, work)
        return
    # spawn: forked children would inherit the threads' locks of OpenCV and numba
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, context, _start_worker, (source.rig, config, max_people)) as pool:
        waiting: deque[tuple[Future[_Fitted], _Job]] = deque()
        try:
            for job in work:
                with _interrupts_kept_from_children():
                    waiting.append((pool.submit(_work, job), job))
                # enough in flight to keep all busy, few enough for a long recording to fit in memory
                while len(waiting) > 2 * jobs + 2 or (waiting and waiting[0][0].done()):
                    future, done = waiting.popleft()
                    yield fitter.back(future.result(), done)
            while waiting:
                future, done = waiting.popleft()
                yield fitter.back(future.result(), done)
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _jobs(source: Source, kept: KeptFrames, left: _Left) -> Iterator[_Job]:
    """The frames to be fitted; those before are only looked at, because segmentation needs them."""
    for number, frame in enumerate(source.mask_sets(), start=-left.leave_out):
        if number < 0:
            continue
        kept.add(number, frame.masks, frame.images)
        if number >= left.done:
            packed = {name: pack_mask(mask) for name, mask in frame.masks.items()}
            yield _Job(frame.stamp_ns, packed, frame.reason, frame.stage_ms)


_worker: _Fitter | None = None


@contextlib.contextmanager
def _interrupts_kept_from_children() -> Iterator[None]:
    """Processes started within never see Ctrl-C, which reaches the whole group: the parent decides how to end.

    Blocked in the parent, because a child inherits that from its first instruction on; ignoring it in the child would
    leave the second in which it imports. One that comes meanwhile reaches the parent at the end of the block.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _start_worker(rig: Rig, config: OfflineConfig, max_people: int) -> None:
    global _worker
    cv2.setNumThreads(1)
    _worker = _Fitter(rig, config, max_people)


def _work(job: _Job) -> _Fitted:
    assert _worker is not None, "the pool starts every worker with _start_worker"
    return _worker.fit(job)
