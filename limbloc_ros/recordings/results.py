# SPDX-License-Identifier: Apache-2.0
"""What a run leaves behind: `joints.npz`, `joint_angles.csv`, `run.npz` and `run.json`.

| file | for |
|---|---|
| `joints.npz` | `joints` [F, 25, 3] and `sigma` [F, 25] in m, `joint_names`, `stamps` in s, `energy`, `reliable` |
| `joint_angles.csv` | a row per frame: stamp in s, every native joint angle in rad, energy, reliable |
| `run.npz` | everything of every pose, so that `Run.load` gives the poses back (for the report) |
| `run.json` | what was run on what, for people: input, rig, settings, counts |

NaN where there is no pose; the reason stands in `run.npz`. Files appear complete or not at all.

With several people all of that is about one of them, the one followed longest (`body` [F] in `joints.npz` tells whose
each row is). Then `joints.npz` also has everybody: `people` [P] ids, `people_joints` [F, P, 25, 3], `people_sigma`
[F, P, 25], `people_reliable` [F, P]; and `people/<id>/` holds the same four files for each person, as a run of its own.
"""

from __future__ import annotations

import contextlib
import csv
import io
import json
import math
from collections.abc import Callable, Collection, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core.errors import InputError, NoPerson, OutputError
from limbloc_ros.core.people import Body
from limbloc_ros.core.pose import JOINT_NAMES, Flesh, Pose
from limbloc_ros.files import ADVICE, replaced
from limbloc_ros.recordings.npz_file import read_npz
from limbloc_ros.rig.plain_values import read_values

Array = NDArray[np.float64]

#: What became of a person in a frame in which only others are followed.
NOT_THERE = NoPerson("this person is not in the room")


@dataclass(frozen=True)
class FrameResult:
    """What became of one frame.

    Attributes:
        stamp_ns: its acquisition stamp, ns.
        outcome: the pose, or why there is none.
        stage_ms: process time of the stages before the pose, ms.
        number: whose outcome this is: 1 for p1; of several people the one followed longest.
        others: everybody else who is followed.
    """

    stamp_ns: int
    outcome: Pose | NoPerson
    stage_ms: dict[str, float] = field(default_factory=dict)
    number: int = 1
    others: tuple[Body, ...] = ()

    @property
    def times(self) -> dict[str, float]:
        """Process time of all stages, those of the pose included, ms; `others` is all of theirs."""
        times = {**self.stage_ms, **(self.outcome.stage_ms if isinstance(self.outcome, Pose) else {})}
        others = [ms for o in self.others if isinstance(o.outcome, Pose) for ms in o.outcome.stage_ms.values()]
        return {**times, "others": sum(others)} if others else times

    def of(self, number: int) -> FrameResult:
        """The same frame as one person's."""
        if number == self.number:
            return FrameResult(self.stamp_ns, self.outcome, self.stage_ms, number)
        found = [body.outcome for body in self.others if body.number == number]
        return FrameResult(self.stamp_ns, found[0] if found else NOT_THERE, self.stage_ms, number)


@dataclass(frozen=True)
class Run:
    """The results of a run, frame by frame.

    Attributes:
        frames: in the order of their stamps.
        about: what was run on what (input, rig, settings, version), plain values.
    """

    frames: tuple[FrameResult, ...]
    about: dict[str, Any] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def stamps(self) -> Array:
        """[F] acquisition stamps, s."""
        return np.array([frame.stamp_ns for frame in self.frames], dtype=np.float64) * 1e-9

    @property
    def joints(self) -> Array:
        """[F, 25, 3] m in world axes, by JOINT_NAMES; NaN where there is no pose."""
        nothing = np.full((len(JOINT_NAMES), 3), np.nan)
        return self._rows(lambda pose: pose.joints, nothing)

    @property
    def sigma(self) -> Array:
        """[F, 25] expected error of each joint, m; NaN where there is no pose."""
        return self._rows(lambda pose: pose.sigma, np.full(len(JOINT_NAMES), np.nan))

    @property
    def energy(self) -> Array:
        """[F] XOR energy (eq. 2); NaN where there is no pose."""
        return self._rows(lambda pose: pose.energy, np.nan)

    @property
    def reliable(self) -> NDArray[np.bool_]:
        """[F] whether the pose can be acted on; False where there is none."""
        return np.array([isinstance(f.outcome, Pose) and f.outcome.reliable for f in self.frames], dtype=np.bool_)

    @property
    def reasons(self) -> tuple[str, ...]:
        """F texts: why a frame has no pose, empty where it has one."""
        return tuple(f.outcome.reason if isinstance(f.outcome, NoPerson) else "" for f in self.frames)

    @property
    def numbers(self) -> tuple[int, ...]:
        """The numbers of all people of the run: 1 for p1."""
        return tuple(sorted({n for f in self.frames for n in (f.number, *(body.number for body in f.others))}))

    def of(self, number: int) -> Run:
        """The run of one person alone."""
        return Run(tuple(frame.of(number) for frame in self.frames), {**self.about, "person": person_id(number)})

    @property
    def angle_names(self) -> tuple[str, ...]:
        """The native joint angles, in the order in which the poses name them."""
        return _union(tuple(f.outcome.angles) for f in self.frames if isinstance(f.outcome, Pose))

    @property
    def angles(self) -> Array:
        """[F, A] rad, by `angle_names`; NaN where there is no pose."""
        names = self.angle_names
        return self._rows(
            lambda pose: [pose.angles.get(name, math.nan) for name in names], np.full(len(names), np.nan)
        ).reshape(len(self), len(names))

    def _rows(self, value: Callable[[Pose], Any], nothing: Any) -> Array:
        rows = [value(f.outcome) if isinstance(f.outcome, Pose) else nothing for f in self.frames]
        return np.array(rows, dtype=np.float64).reshape(len(rows), *np.shape(nothing))

    def save(self, folder: str | Path) -> None:
        """Write all four files into `folder`, which is made if need be; they replace those of an earlier run.

        Raises:
            OutputError: the folder cannot be written to (a full disk, no permission).
        """
        folder = Path(folder)
        alone = () if self.numbers == (1,) else self.numbers
        for number in alone:
            self.of(number).save_alone(folder / PEOPLE / person_id(number))
        _forget_people(folder, {person_id(number) for number in alone})
        self.save_alone(folder)

    def save_alone(self, folder: Path) -> None:
        """Write the four files of the frames' own outcomes."""
        self.save_joints(folder / "joints.npz")
        with result_file(folder / "joint_angles.csv") as file:
            file.write_text(self._angles_csv(), encoding="utf-8", newline="\n")
        save_frames(self.frames, folder / "run.npz")
        found = [f.outcome for f in self.frames if isinstance(f.outcome, Pose)]
        summary = {
            **self.about,
            "frames": len(self),
            "poses": len(found),
            "reliable": int(self.reliable.sum()),
            "median_energy": float(np.median([pose.energy for pose in found])) if found else None,
        }
        with result_file(folder / "run.json") as file:
            file.write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8", newline="\n")

    def save_joints(self, path: str | Path) -> None:
        """Write just the prediction file, `joints.npz` of the module's table."""
        arrays: dict[str, Any] = {
            "joints": self.joints,
            "joint_names": np.array(JOINT_NAMES),
            "stamps": self.stamps,
            "energy": self.energy,
            "sigma": self.sigma,
            "reliable": self.reliable,
        }
        if len(self.numbers) > 1:
            alone = [self.of(number) for number in self.numbers]
            arrays |= {
                "body": np.array([frame.number for frame in self.frames]),
                "people": np.array([person_id(number) for number in self.numbers]),
                "people_joints": np.stack([run.joints for run in alone], axis=1),
                "people_sigma": np.stack([run.sigma for run in alone], axis=1),
                "people_reliable": np.stack([run.reliable for run in alone], axis=1),
            }
        with result_file(Path(path)) as file:
            np.savez_compressed(file, **arrays)

    def _angles_csv(self) -> str:
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(["stamp_s", *(f"{name}_rad" for name in self.angle_names), "energy", "reliable"])
        for frame, angles, energy, reliable in zip(self.frames, self.angles, self.energy, self.reliable, strict=True):
            writer.writerow([stamp_text(frame.stamp_ns), *(f"{a:.9g}" for a in angles), f"{energy:.6g}", int(reliable)])
        return text.getvalue()

    @staticmethod
    def load(folder: str | Path) -> Run:
        """Read back what `save` wrote.

        Raises:
            InputError: no run was saved there, or a file is damaged.
        """
        folder = Path(folder)
        if not (folder / "run.npz").is_file():
            raise InputError(
                f"{folder} holds no finished run: expected run.npz in it; make one with `process INPUT --out {folder}`"
            )
        frames = load_frames(folder / "run.npz")
        for other in sorted((folder / PEOPLE).glob("p*/run.npz")):
            frames = with_others(frames, load_frames(other))
        return Run(frames, read_about(folder / "run.json"))


#: Folder of the single people's runs within a run's.
PEOPLE = "people"
#: The files of a run.
FILES = ("joints.npz", "joint_angles.csv", "run.npz", "run.json")


def result_file(path: Path) -> AbstractContextManager[Path]:
    """A temporary name for a file of a run, as `files.replaced`: it survives a power cut, and who fails can go on."""
    return replaced(path, advice=f"{ADVICE}, then run the same command again: finished frames are kept", durable=True)


def stamp_text(stamp_ns: int) -> str:
    """A stamp in seconds with all its digits, which a float would lose: `1700000000.040000000`."""
    return f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d}"


def _forget_people(folder: Path, present: Collection[str]) -> None:
    """Remove the files of people whom an earlier run found here; else they would be taken for this run's."""
    for other in (folder / PEOPLE).glob("p*"):
        if other.name not in present:
            try:
                for name in FILES:
                    (other / name).unlink(missing_ok=True)
            except OSError as error:
                raise OutputError(f"{other} of an earlier run cannot be removed: {error.strerror}; remove it") from None
            with contextlib.suppress(OSError):  # something of somebody else is left in it
                other.rmdir()


def person_id(number: int) -> str:
    """What a person is called in files and topics."""
    return f"p{number}"


def with_others(frames: Sequence[FrameResult], other: Sequence[FrameResult]) -> tuple[FrameResult, ...]:
    """Frames of a run with what became of one more person in them."""
    if [frame.stamp_ns for frame in frames] != [frame.stamp_ns for frame in other]:
        raise InputError("the frames of single people do not belong to this run; run `process` again")
    merged = []
    for frame, more in zip(frames, other, strict=True):
        if more.number != frame.number and more.outcome != NOT_THERE:
            frame = replace(frame, others=(*frame.others, Body(more.number, more.outcome)))
        merged.append(frame)
    return tuple(merged)


def save_frames(frames: Sequence[FrameResult], path: Path) -> None:
    """Write frames with all that is in their poses; `load_frames` gives the same numbers back, bit for bit."""
    poses = [f.outcome for f in frames if isinstance(f.outcome, Pose)]
    stages = _union(tuple(f.stage_ms) for f in frames)
    arrays: dict[str, Any] = {
        "stamps_ns": np.array([f.stamp_ns for f in frames], dtype=np.int64),
        "numbers": np.array([f.number for f in frames], dtype=np.int64),
        "found": np.array([isinstance(f.outcome, Pose) for f in frames], dtype=np.bool_),
        "reasons": np.array(
            [f.outcome.reason if isinstance(f.outcome, NoPerson) else "" for f in frames], dtype=np.str_
        ),
        "stage_names": np.array(stages, dtype=np.str_),
        "stage_ms": np.array([[f.stage_ms.get(s, np.nan) for s in stages] for f in frames], dtype=np.float64),
    }
    # The figure's layout is the engine's: equal in every pose of a run, so that each field is one array.
    if poses:
        first = poses[0]
        arrays |= {
            "bone_names": np.array(first.bone_names),
            "angle_names": np.array(list(first.angles)),
            "size_names": np.array(list(first.sizes), dtype=str),
            "pose_stage_names": np.array(_union(tuple(p.stage_ms) for p in poses), dtype=np.str_),
            "flesh_parts": first.flesh.parts,
            "flesh_part_names": np.array(first.flesh.part_names),
            "joints": np.array([p.joints for p in poses]),
            "rotations": np.array([p.rotations for p in poses]),
            "angles": np.array([[p.angles[n] for n in first.angles] for p in poses]),
            "sizes": np.array([[p.sizes[n] for n in first.sizes] for p in poses]),
            "flesh_centres": np.array([p.flesh.centres for p in poses]),
            "flesh_radii": np.array([p.flesh.radii for p in poses]),
            "parameters": np.array([p.parameters for p in poses]),
            "energy": np.array([p.energy for p in poses]),
            "sigma": np.array([p.sigma for p in poses]),
            "reliable": np.array([p.reliable for p in poses]),
            "risk": np.array([p.risk for p in poses]),
            "doubts": np.array([p.doubt for p in poses], dtype=np.str_),
        }
        names = arrays["pose_stage_names"]
        arrays["pose_stage_ms"] = np.array([[p.stage_ms.get(str(s), np.nan) for s in names] for p in poses])
    with result_file(path) as file:
        np.savez_compressed(file, **arrays)


def load_frames(path: Path) -> tuple[FrameResult, ...]:
    """Read what `save_frames` wrote; raises InputError when the file is damaged."""
    data = read_npz(path)
    if "stamps_ns" in data:  # runs from before there were several people
        data.setdefault("numbers", np.ones(data["stamps_ns"].shape, np.int64))
    if "reliable" in data and data["reliable"].dtype == bool:  # and from before it was told why a pose is not
        data.setdefault("risk", np.where(data["reliable"], 0.0, 1.0))
        data.setdefault("doubts", np.full(data["reliable"].shape, ""))
    try:
        _check_layout(data)
        return tuple(_frames(data))
    except (KeyError, ValueError) as error:  # ValueError also: characters that no text has
        raise InputError(f"{path} is not a results file of this version ({error}); run `process` again") from None


#: Arrays of `run.npz`: kind of dtype, and lengths by letter: F frames, P poses, the others as the figure has them.
_LAYOUT = {
    "stamps_ns": ("i", "F"), "numbers": ("i", "F"), "found": ("b", "F"), "reasons": ("U", "F"),
    "stage_names": ("U", "T"), "stage_ms": ("f", "FT"),
}  # fmt: skip
_POSE_LAYOUT = {
    "bone_names": ("U", "B"), "angle_names": ("U", "A"), "size_names": ("U", "S"), "pose_stage_names": ("U", "U"),
    "flesh_parts": ("i", "G3"), "flesh_part_names": ("U", "G"), "joints": ("f", "PJ3"), "rotations": ("f", "PB33"),
    "angles": ("f", "PA"), "sizes": ("f", "PS"), "flesh_centres": ("f", "PC3"), "flesh_radii": ("f", "PC"),
    "parameters": ("f", "PV"), "energy": ("f", "P"), "sigma": ("f", "PJ"), "reliable": ("b", "P"),
    "risk": ("f", "P"), "doubts": ("U", "P"), "pose_stage_ms": ("f", "PU"),
}  # fmt: skip


def _check_layout(data: dict[str, NDArray[Any]]) -> None:
    """Raise KeyError or ValueError unless the arrays are what `save_frames` writes."""
    lengths: dict[str, int] = {"3": 3, "J": len(JOINT_NAMES)}
    if "found" in data and data["found"].dtype.kind == "b":
        lengths["P"] = int(data["found"].sum())
    for name, (kind, letters) in {**_LAYOUT, **(_POSE_LAYOUT if lengths.get("P") else {})}.items():
        array = data[name]
        expected = [lengths.setdefault(letter, n) for letter, n in zip(letters, array.shape, strict=False)]
        if array.dtype.kind != kind or array.ndim != len(letters) or list(array.shape) != expected:
            raise ValueError(f"{name} is {array.dtype} {list(array.shape)}")
        if kind == "f" and not name.endswith("stage_ms") and not np.isfinite(array).all():
            raise ValueError(f"{name} holds numbers that are not finite")
    parts = data.get("flesh_parts", np.zeros((0, 3)))
    if parts.size and (parts.min() < 0 or parts.max() >= lengths.get("C", 0)):
        raise ValueError("flesh_parts names spheres that are not there")


def read_about(path: Path) -> dict[str, Any]:
    """What a `run.json` says; {} without one. Raises InputError when it is damaged."""
    if not path.is_file():
        return {}
    about = read_values(path, "run's description", "the run.json in it", InputError)
    config = about.get("config", {}) if isinstance(about, dict) else None
    if not isinstance(config, dict) or not all(isinstance(section, dict) for section in config.values()):
        raise InputError(f"{path}: expected what was run, with its config by sections; run `process` again")
    return dict(about)


def _frames(data: dict[str, NDArray[Any]]) -> list[FrameResult]:
    frames, row = [], 0
    stages = [str(s) for s in data["stage_names"]]
    for i, found in enumerate(data["found"]):
        outcome: Pose | NoPerson = NoPerson(str(data["reasons"][i]))
        if found:
            outcome = _pose(data, row)
            row += 1
        times = _times(stages, data["stage_ms"][i])
        frames.append(FrameResult(int(data["stamps_ns"][i]), outcome, times, int(data["numbers"][i])))
    return frames


def _pose(data: dict[str, NDArray[Any]], row: int) -> Pose:
    def named(names: str, values: str) -> dict[str, float]:
        return {str(n): float(v) for n, v in zip(data[names], data[values][row], strict=True)}

    return Pose(
        joints=data["joints"][row],
        rotations=data["rotations"][row],
        bone_names=tuple(str(n) for n in data["bone_names"]),
        angles=named("angle_names", "angles"),
        sizes=named("size_names", "sizes"),
        flesh=Flesh(
            data["flesh_centres"][row],
            data["flesh_radii"][row],
            data["flesh_parts"],
            tuple(str(n) for n in data["flesh_part_names"]),
        ),
        parameters=data["parameters"][row],
        energy=float(data["energy"][row]),
        sigma=data["sigma"][row],
        reliable=bool(data["reliable"][row]),
        stage_ms=_times([str(s) for s in data["pose_stage_names"]], data["pose_stage_ms"][row]),
        risk=float(data["risk"][row]),
        doubt=str(data["doubts"][row]),
    )


def _times(names: Sequence[str], values: Array) -> dict[str, float]:
    return {name: float(value) for name, value in zip(names, values, strict=True) if not math.isnan(value)}


def _union(groups: Any) -> tuple[str, ...]:
    """All names of all groups, each once, in the order of their first appearance."""
    return tuple(dict.fromkeys(name for group in groups for name in group))
