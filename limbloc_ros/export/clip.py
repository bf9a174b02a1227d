# SPDX-License-Identifier: Apache-2.0
"""A run as a clip: frames at an even rate, as motion files want them.

A recording's stamps are hardly ever even, and frames are missing where a camera was late; motion files hold a rate and
one row after the other. So every result goes to the row nearest to its stamp, and rows without one stay empty.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core.errors import InputError
from limbloc_ros.core.figure import FigureState
from limbloc_ros.core.pose import JOINT_NAMES, Pose
from limbloc_ros.core.ros4hri import state_of
from limbloc_ros.recordings.results import Run

Array = NDArray[np.float64]

#: Rate of a run of a single frame, Hz.
DEFAULT_RATE_HZ = 25.0
#: More empty rows than this for each result mean that the stamps are not those of one recording.
MOST_EMPTY = 50


@dataclass(frozen=True)
class Clip:
    """Frames of a run at an even rate.

    Attributes:
        run: the results.
        rate_hz: rows a second.
        rows: [N] number of the run's frame that stands in each row; -1 where there is none.
        doubled: frames that had to go because two stamps fell on one row.
    """

    run: Run
    rate_hz: float
    rows: NDArray[np.int64]
    doubled: int = 0

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def seconds(self) -> Array:
        """[N] time since the first row, s."""
        return np.arange(len(self.rows)) / self.rate_hz

    @property
    def empty(self) -> int:
        """Rows without a pose."""
        return int((self.rows < 0).sum())

    @property
    def joints(self) -> Array:
        """[N, 25, 3] m, NaN where there is no pose."""
        found = np.full((len(self.rows), len(JOINT_NAMES), 3), np.nan)
        found[self.rows >= 0] = self.run.joints[self.rows[self.rows >= 0]]
        return found

    def poses(self) -> list[Pose]:
        """The pose of each row; an empty row repeats the pose before it (at the beginning, the first one)."""
        filled = self.rows[self.rows >= 0][0]
        poses = []
        for row in self.rows:
            filled = row if row >= 0 else filled
            pose = self.run.frames[filled].outcome
            assert isinstance(pose, Pose)
            poses.append(pose)
        return poses

    def states(self) -> list[FigureState]:
        """The figure's state in each row, as `poses`.

        Raises:
            InputError: the run was made by a version with another figure.
        """
        try:
            return [state_of(pose) for pose in self.poses()]
        except ValueError as error:
            raise InputError(f"the run's poses are those of another version ({error}); run `process` again") from None


def clip_of(run: Run, *, only_reliable: bool = False, first: int = 0, last: int | None = None) -> Clip:
    """Put a run's frames on even rows.

    Args:
        run: the results.
        only_reliable: leave out poses that should not be acted on.
        first: the first frame of the run to take.
        last: the last one; None is the run's end.

    Raises:
        InputError: no frame with a pose is left, or the stamps make no recording.
    """
    end = len(run) if last is None else min(last + 1, len(run))
    chosen = np.arange(len(run))[max(first, 0) : end]
    posed = np.array([isinstance(frame.outcome, Pose) for frame in run.frames], dtype=np.bool_)
    usable = (posed & run.reliable if only_reliable else posed)[chosen]
    if not usable.any():
        kind = "reliable pose" if only_reliable and posed[chosen].any() else "pose"
        asked = "" if len(chosen) == len(run) else f" from {first} to {end - 1}"
        raise InputError(f"none of the run's {len(run)} frames{asked} has a {kind}; there is nothing to export")
    stamps = np.array([run.frames[i].stamp_ns for i in chosen], dtype=np.int64)
    steps = np.diff(stamps)
    if (steps <= 0).any():
        raise InputError(f"the stamps go back or repeat after frame {chosen[int(np.argmax(steps <= 0))]} of the run")
    step = float(np.median(steps)) if len(steps) else 1e9 / DEFAULT_RATE_HZ
    slots = np.round((stamps - stamps[0]) / step).astype(np.int64)
    count = int(slots[-1]) + 1
    if count > (MOST_EMPTY + 1) * len(chosen):
        raise InputError(
            f"{len(chosen)} frames {step * 1e-9:.3f} s apart would lie in {count} rows, almost all empty; "
            "export a part of the run with --first and --last"
        )
    rows = np.full(count, -1, dtype=np.int64)
    rows[slots[usable]] = chosen[usable]
    return Clip(run, float(f"{1e9 / step:.6g}"), rows, len(slots) - len(np.unique(slots)))
