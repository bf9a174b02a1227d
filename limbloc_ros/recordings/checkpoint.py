# SPDX-License-Identifier: Apache-2.0
"""Finished frames of an offline run that has not ended yet, so that an interrupted run goes on where it stopped."""

from __future__ import annotations

import hashlib
import json
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from limbloc_ros.core.errors import InputError
from limbloc_ros.recordings.results import FrameResult, load_frames, result_file, save_frames, with_others
from limbloc_ros.rig.plain_values import read_values

#: Results are written down after this many frames or seconds, whichever comes first.
FLUSH_FRAMES, FLUSH_S = 50, 10.0


def fingerprint(identity: Any) -> str:
    """A short hash of plain values: the same run on the same input has the same one."""
    text = json.dumps(identity, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


class Checkpoint:
    """The folder of partial results; frames are added in order.

    Args:
        folder: where they are kept; made at the first flush. None: nothing is kept.
        key: fingerprint of input and settings. Results kept under another key belong to another run: they are deleted,
            and `discarded` says so.

    Attributes:
        done: the frames that an interrupted run had finished.
        state: what the next frame depends on, as it was given with the last of them; None without any.
    """

    def __init__(self, folder: Path | None, key: str) -> None:
        self._folder = folder / key if folder is not None else None
        others = [child for child in folder.iterdir() if child.name != key] if folder and folder.is_dir() else []
        self.discarded = bool(others)
        for child in others:
            shutil.rmtree(child)
        self.state: dict[str, Any] | None = None
        self.done: list[FrameResult] = self._load()
        self._count = len(self.done)
        self._waiting: list[FrameResult] = []
        self._flushed_s = time.monotonic()

    def _load(self) -> list[FrameResult]:
        frames: list[FrameResult] = []
        while self._folder is not None and (path := _chunk(self._folder, len(frames))).is_file():
            try:
                chunk = load_frames(path)
                for other in sorted(self._folder.glob(f"{path.stem}_p*.npz")):
                    chunk = with_others(chunk, load_frames(other))
                self.state = _read_state(path.with_suffix(".json"))
                frames += chunk
            except InputError:
                path.unlink()  # damaged since it was renamed into place whole: work it out once more
        return frames

    def add(self, frame: FrameResult, state: Callable[[], dict[str, Any]] = dict) -> None:
        """Keep the next frame; `state` gives plain values that the frame after it depends on."""
        if self._folder is None:
            return
        self._waiting.append(frame)
        self._state = state()
        if len(self._waiting) >= FLUSH_FRAMES or time.monotonic() - self._flushed_s >= FLUSH_S:
            self.flush()

    def flush(self) -> None:
        """Write down what is not on disk yet; raises OutputError when that fails."""
        if self._waiting and self._folder is not None:
            path = _chunk(self._folder, self._count)
            for number in {body.number for frame in self._waiting for body in frame.others}:
                save_frames([frame.of(number) for frame in self._waiting], path.with_name(f"{path.stem}_p{number}.npz"))
            with result_file(path.with_suffix(".json")) as file:
                file.write_text(json.dumps(self._state), encoding="utf-8", newline="\n")
            save_frames(self._waiting, path)  # last: with it the others count
            self._count += len(self._waiting)
            self._waiting = []
        self._flushed_s = time.monotonic()


def _chunk(folder: Path, first: int) -> Path:
    """The file that begins with frame number `first`."""
    return folder / f"from_{first:08d}.npz"


def _read_state(path: Path) -> dict[str, Any]:
    """Raises InputError when it is missing or damaged."""
    state = read_values(path, "state", "the .json in it", InputError)
    if not isinstance(state, dict):
        raise InputError(f"{path}: expected a mapping")
    return state
