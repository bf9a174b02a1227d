# SPDX-License-Identifier: Apache-2.0
"""The results of a run as the report reads them: one array per quantity, NaN where a frame has no person."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from limbloc_ros import __version__
from limbloc_ros.core.errors import InputError
from limbloc_ros.core.pose import JOINT, JOINT_NAMES, STICK_BONES, Array
from limbloc_ros.recordings.results import Run, person_id

#: A step between consecutive frames is a jump when it is this many times the joint's usual one and at least so long.
JUMP_RATIO, JUMP_M, JUMP_RAD = 5.0, 0.15, np.radians(40.0)
#: A head that usually moves so far between frames belongs to unrelated poses, not to a movement, m.
UNRELATED_M = 0.3


@dataclass(frozen=True)
class RunData:
    """The results of a run over F frames; NaN where a frame has no person.

    Attributes:
        title: heading of the report.
        source: what was processed, in words.
        joints: [F, 25, 3] m, in the order of JOINT_NAMES.
        stamps: [F] s.
        energy: [F] XOR energy (eq. 2).
        sigma: [F, 25] expected error of each joint, m.
        reliable: bool [F].
        stage_ms: stage -> [F] process time, ms.
        angles: joint angle -> [F] rad.
        missing: frame -> why it has no person.
        truth: [F, 25, 3] true joints or those of a reference, m, when they are known.
        settings: what the run was made with (parameters, number of cameras), shown as they are.
        command: the command line that made it.
        version: of limbloc_ros.
        consecutive: False when the frames are unrelated poses; then no lines are drawn and no jumps sought.
        truth_kind: `true` or `reference`, for captions.
        truth_about: what `truth` is and how it was matched, in words.
        truth_angles: joint angle -> [F] rad of the reference, where it has them.
        people: id -> [F, 25, 3] joints of everybody, m, where there are several; all else is of one of them.
        people_reliable: id -> bool [F].
    """

    title: str
    source: str
    joints: Array
    stamps: Array
    energy: Array
    sigma: Array
    reliable: NDArray[np.bool_]
    stage_ms: Mapping[str, Array] = field(default_factory=dict)
    angles: Mapping[str, Array] = field(default_factory=dict)
    missing: Mapping[int, str] = field(default_factory=dict)
    truth: Array | None = None
    settings: Mapping[str, str] = field(default_factory=dict)
    command: str = ""
    version: str = __version__
    consecutive: bool = True
    truth_kind: str = "true"
    truth_about: tuple[str, ...] = ()
    truth_angles: Mapping[str, Array] = field(default_factory=dict)
    people: Mapping[str, Array] = field(default_factory=dict)
    people_reliable: Mapping[str, NDArray[np.bool_]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        frames = len(self.joints)
        if frames == 0:
            raise InputError("a report needs at least one frame, got a run of none")
        shapes = {
            "joints": (frames, len(JOINT_NAMES), 3),
            "stamps": (frames,),
            "energy": (frames,),
            "sigma": (frames, len(JOINT_NAMES)),
            "reliable": (frames,),
        }
        values: dict[str, Any] = {name: getattr(self, name) for name in shapes}
        if self.truth is not None:
            shapes["truth"], values["truth"] = shapes["joints"], self.truth
        for kind in ("stage_ms", "angles", "truth_angles"):
            for name, value in getattr(self, kind).items():
                shapes[f"{kind} {name}"], values[f"{kind} {name}"] = (frames,), value
        for name, shape in shapes.items():
            if np.shape(values[name]) != shape:
                raise InputError(f"{name}: expected shape {shape}, got {np.shape(values[name])}")

    @staticmethod
    def of(
        run: Run,
        *,
        title: str,
        source: str = "",
        truth: Mapping[str, Array] | None = None,
        command: str = "",
        consecutive: bool | None = None,
    ) -> RunData:
        """The report's view of a recorded run.

        Args:
            run: the recorded results.
            title: heading of the report.
            source: what was processed, in words; by default what the run says.
            truth: joint name -> [F, 3] true positions, m; empty or None when not known.
            command: the command line that made the run; by default what the run says.
            consecutive: whether the frames follow each other; by default what the run says, else judged by how far the
                head moves.
        """
        names, angles, joints, about = run.angle_names, run.angles, run.joints, run.about
        known = None
        if truth:
            nothing = np.full((len(run), 3), np.nan)
            known = np.stack([np.asarray(truth.get(name, nothing), dtype=np.float64) for name in JOINT_NAMES], axis=1)
        several = run.numbers if len(run.numbers) > 1 else ()
        stages = list(dict.fromkeys(stage for frame in run.frames for stage in frame.times))
        if consecutive is None:
            consecutive = about.get("consecutive")
        if consecutive is None:
            head = steps(joints[:, JOINT["head_centre"]])
            consecutive = not np.isfinite(head).any() or float(np.nanmedian(head)) < UNRELATED_M
        return RunData(
            title=title,
            source=source or str(about.get("input", "")),
            joints=joints,
            stamps=run.stamps,
            energy=run.energy,
            sigma=run.sigma,
            reliable=run.reliable,
            stage_ms={s: np.array([f.times.get(s, np.nan) for f in run.frames]) for s in stages},
            angles={name: angles[:, i] for i, name in enumerate(names)},
            missing={i: reason for i, reason in enumerate(run.reasons) if reason},
            truth=known,
            settings=flatten(about.get("config", {})),
            command=command or str(about.get("command", "")),
            version=str(about.get("version", __version__)),
            consecutive=consecutive,
            people={person_id(n): run.of(n).joints for n in several},
            people_reliable={person_id(n): run.of(n).reliable for n in several},
        )

    @property
    def found(self) -> NDArray[np.bool_]:
        """[F] frames with a person."""
        return np.asarray(np.isfinite(self.joints.sum(axis=2)).any(axis=1))

    @property
    def seconds(self) -> Array:
        """[F] time since the first frame, s."""
        return np.asarray(self.stamps - self.stamps[0])

    @property
    def total_ms(self) -> Array:
        """[F] process time of all stages together, ms; NaN where no stage has one."""
        if not self.stage_ms:
            return np.full(len(self.joints), np.nan)
        stages = np.stack(list(self.stage_ms.values()))
        return np.where(np.isfinite(stages).any(axis=0), np.nansum(stages, axis=0), np.nan)

    @property
    def error_m(self) -> Array | None:
        """[F, 25] distance from the true joints, m; None when they are not known."""
        return None if self.truth is None else np.asarray(np.linalg.norm(self.joints - self.truth, axis=2))

    def joint_path(self, name: str) -> Array:
        """[F, 3] where the joint `name` was, m."""
        return np.asarray(self.joints[:, JOINT[name]])

    def missing_reasons(self) -> list[tuple[str, int]]:
        """Why frames have no person, and how often, the most frequent first."""
        lost = np.flatnonzero(~self.found)
        return Counter(self.missing.get(int(f), "no reason was recorded") for f in lost).most_common()

    def bone_lengths(self) -> dict[str, Array]:
        """[F] length of each bone of the stick figure, m, by `from - to`."""
        return {
            f"{a} - {b}": np.asarray(np.linalg.norm(self.joint_path(b) - self.joint_path(a), axis=1))
            for a, b in STICK_BONES
        }


def steps(values: Array) -> Array:
    """How far a quantity moved since the frame before: [F] for [F] or [F, D]; NaN at the first and next to a gap."""
    moved = np.diff(values[:, None] if values.ndim == 1 else values, axis=0)
    return np.concatenate([[np.nan], np.linalg.norm(moved, axis=1)])[: len(values)]


def jumps(values: Array, least: float) -> NDArray[np.bool_]:
    """Frames at which a path breaks: a step of at least `least` that is also far longer than its usual step.

    Args:
        values: [F] or [F, D]; NaN where missing. A step over a gap is not judged.
        least: shortest step that counts, in the unit of `values`.
    """
    step = steps(values)
    if not np.isfinite(step).any():
        return np.zeros(len(values), dtype=np.bool_)
    return np.asarray(np.nan_to_num(step) > max(least, JUMP_RATIO * float(np.nanmedian(step))))


def joint_jumps(run: RunData) -> dict[str, NDArray[np.bool_]]:
    """[F] frames at which each joint jumps; empty for unrelated frames."""
    return {name: jumps(run.joint_path(name), JUMP_M) for name in JOINT_NAMES} if run.consecutive else {}


def flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """Nested plain values as one table of texts: `{"hull": {"voxel_m": 0.02}}` -> `{"hull.voxel_m": "0.02"}`."""
    table: dict[str, str] = {}
    for name, value in values.items():
        if isinstance(value, Mapping):
            table |= flatten(value, f"{prefix}{name}.")
        elif isinstance(value, (list, tuple)):
            table[prefix + name] = ", ".join(str(v) for v in value)
        else:
            table[prefix + name] = str(value)
    return table
