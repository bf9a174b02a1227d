# SPDX-License-Identifier: Apache-2.0
"""A run beside a reference: another system's joints, another run, or the truth.

References have their own rate, their own start and sometimes their own axes. Times are matched frame by frame, places
are moved only when asked to, and what was done is said in words.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core.errors import InputError
from limbloc_ros.core.pose import JOINT, JOINT_NAMES
from limbloc_ros.export.markers import joints_of_markers
from limbloc_ros.export.trc import read_trc
from limbloc_ros.recordings.cases import joints_of
from limbloc_ros.recordings.npz_file import read_npz
from limbloc_ros.recordings.results import Run

Array = NDArray[np.float64]

ALIGN = ("none", "rigid")


@dataclass(frozen=True)
class Reference:
    """Joints to compare with, frame by frame of the run.

    Attributes:
        name: what they are, in words.
        joints: [F, 25, 3] m in the run's frames and axes; NaN where the reference knows nothing.
        angles: native angles [F] rad by name, where the reference is a run.
        notes: how they were brought together.
    """

    name: str
    joints: Array
    angles: Mapping[str, Array] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Agreement:
    """How two measurements of one quantity agree (Bland and Altman 1986); the unit is theirs.

    Attributes:
        count: pairs.
        bias: mean of run minus reference.
        sd: standard deviation of the differences.
        mae, rmsd: mean absolute and root mean square difference.
        r: correlation; NaN where one of them does not vary.
    """

    count: int
    bias: float
    sd: float
    mae: float
    rmsd: float
    r: float

    @property
    def limits(self) -> tuple[float, float]:
        """The 95 % limits of agreement."""
        return self.bias - 1.96 * self.sd, self.bias + 1.96 * self.sd


def load_reference(path: Path, run: Run, *, offset_s: float = 0.0, align: str = "none") -> Reference:
    """Read a reference and bring it to the run's frames.

    Args:
        path: TRC file (y up, m or mm), .npz with `joints` [N, J, 3] m (z up) and `joint_names`, `stamps` in s if it
            has them, or the folder of another run.
        run: the run.
        offset_s: added to the reference's times.
        align: `none`, or `rigid`: turned and moved as a whole to where it fits the run best.

    Raises:
        InputError: it cannot be read, has no joint of ours, or its frames cannot be matched.
    """
    angles: dict[str, Array] = {}
    stamps: Array | None
    if path.is_dir():
        other = Run.load(path)
        joints, stamps, name = other.joints, other.stamps, f"run {path}"
        angles = {n: other.angles[:, i] for i, n in enumerate(other.angle_names)}
    elif path.suffix.lower() == ".trc":
        markers = read_trc(path)
        joints, stamps, name = joints_of_markers(markers.names, markers.places), markers.seconds, f"markers {path}"
        if not np.isfinite(joints).any():
            raise InputError(f"{path}: expected markers such as RKnee or knee_R, got {', '.join(markers.names[:8])}")
    elif path.suffix.lower() == ".npz":
        joints, stamps = _from_npz(path)
        name = f"joints {path}"
    else:
        raise InputError(f"--reference {path}: expected a .trc or .npz file or the folder of a run")
    rows, note = _matching_rows(run.stamps, None if stamps is None else stamps + offset_s, len(joints), path)
    found = np.full((len(run), len(JOINT_NAMES), 3), np.nan)
    found[rows >= 0] = joints[rows[rows >= 0]]
    notes = [note]
    if align == "rigid":
        found, moved = _aligned(found, run.joints, path)
        notes.append(moved)
    matched = {}
    for angle, values in angles.items():
        matched[angle] = np.full(len(run), np.nan)
        matched[angle][rows >= 0] = values[rows[rows >= 0]]
    return Reference(name, found, matched, tuple(notes))


def agreement(run: Array, reference: Array) -> Agreement | None:
    """How two series agree where both are known; None with fewer than two pairs."""
    both = np.isfinite(run) & np.isfinite(reference)
    if both.sum() < 2:
        return None
    a, b = run[both], reference[both]
    difference = a - b
    steady = min(np.ptp(a), np.ptp(b)) < 1e-9
    r = float("nan") if steady else float(np.corrcoef(a, b)[0, 1])
    return Agreement(
        int(both.sum()),
        float(difference.mean()),
        float(difference.std(ddof=1)),
        float(np.abs(difference).mean()),
        float(np.sqrt((difference**2).mean())),
        r,
    )


def limb_angles(joints: Array) -> dict[str, Array]:
    """Angles that joints alone tell, so that they can be had from any system, rad.

    `knee_L_bend`, `elbow_L_bend`: 0 when straight. `hip_L_bend`: between thigh and the way down the trunk.
    `shoulder_L_raise`: between upper arm and the way down the trunk.
    """

    def at(name: str) -> Array:
        return np.asarray(joints[:, JOINT[name]])

    hips = (at("hip_L") + at("hip_R")) / 2
    down = hips - (at("shoulder_L") + at("shoulder_R")) / 2
    found: dict[str, Array] = {}
    for s in "LR":
        thigh, shin = at(f"knee_{s}") - at(f"hip_{s}"), at(f"ankle_{s}") - at(f"knee_{s}")
        arm, forearm = at(f"elbow_{s}") - at(f"shoulder_{s}"), at(f"wrist_{s}") - at(f"elbow_{s}")
        found |= {
            f"knee_{s}_bend": _between(thigh, shin),
            f"hip_{s}_bend": _between(down, thigh),
            f"elbow_{s}_bend": _between(arm, forearm),
            f"shoulder_{s}_raise": _between(down, arm),
        }
    return found


def _between(a: Array, b: Array) -> Array:
    """[F] angle between vectors [F, 3], rad; NaN where one is unknown."""
    across = np.linalg.norm(np.cross(a, b), axis=1)
    return np.asarray(np.arctan2(across, np.sum(a * b, axis=1)))


def _from_npz(path: Path) -> tuple[Array, Array | None]:
    arrays = read_npz(path)
    places, names = joints_of(_under_our_names(arrays), path)
    joints = joints_of_markers(names, places)
    if not np.isfinite(joints).any():
        raise InputError(f"{path}: expected joints such as knee_R, got {', '.join(names[:8])}")
    stamps = arrays.get("stamps")
    if stamps is not None and (stamps.dtype.kind not in "fiu" or stamps.shape != (len(joints),)):
        raise InputError(f"{path}: expected stamps [{len(joints)}] in s, got {stamps.dtype} {list(stamps.shape)}")
    return joints, None if stamps is None else stamps.astype(np.float64)


def _under_our_names(arrays: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Arrays called otherwise, where only one can be the names and only one the joints: by their shapes."""
    if "joints" in arrays or "joint_names" in arrays:
        return arrays
    pairs = [
        (joints, names)
        for names in arrays.values()
        if names.dtype.kind == "U" and names.ndim == 1
        for joints in arrays.values()
        if joints.dtype.kind == "f" and joints.ndim == 3 and joints.shape[1:] == (len(names), 3)
    ]
    return {**arrays, "joints": pairs[0][0], "joint_names": pairs[0][1]} if len(pairs) == 1 else arrays


def _matching_rows(stamps: Array, times: Array | None, count: int, path: Path) -> tuple[NDArray[np.int64], str]:
    """Row of the reference for each frame of the run, -1 where there is none, and what was done, in words."""
    frames = len(stamps)
    if times is not None:
        step = float(np.median(np.diff(stamps))) if frames > 1 else 0.04
        for start, text in ((0.0, "by their stamps"), (stamps[0], "by the time since the run's first frame")):
            nearest = np.abs(times[None, :] + start - stamps[:, None]).argmin(axis=1)
            apart = np.abs(times[nearest] + start - stamps)
            rows = np.where(apart <= 0.5 * step + 1e-6, nearest, -1)
            if (rows >= 0).mean() > 0.1:
                return rows.astype(np.int64), f"{int((rows >= 0).sum())} of {frames} frames matched {text}"
    if count == frames:
        return np.arange(frames), f"{frames} frames matched one by one"
    detail = "without stamps" if times is None else f"{times[0]:.3f} to {times[-1]:.3f} s"
    raise InputError(
        f"{path}: its {count} frames ({detail}) cannot be matched with the run's {frames} "
        f"({stamps[0]:.3f} to {stamps[-1]:.3f} s); expected as many frames, or stamps that overlap (--reference-offset)"
    )


def _aligned(joints: Array, target: Array, path: Path) -> tuple[Array, str]:
    """The joints turned and moved as a whole to fit the target best (Kabsch), and how far."""
    both = np.isfinite(joints).all(axis=2) & np.isfinite(target).all(axis=2)
    if both.sum() < 3:
        raise InputError(f"{path}: expected at least 3 joints in common with the run to align it, got {both.sum()}")
    a, b = joints[both], target[both]
    U, _, Vt = np.linalg.svd((b - b.mean(axis=0)).T @ (a - a.mean(axis=0)))
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    shift = b.mean(axis=0) - R @ a.mean(axis=0)
    turn = np.degrees(np.arccos(np.clip((np.trace(R) - 1) / 2, -1, 1)))
    moved = float(np.linalg.norm(b.mean(axis=0) - a.mean(axis=0)))
    return (
        joints @ R.T + shift,
        f"moved by {100 * moved:.1f} cm and turned by {turn:.1f} degrees as a whole to fit best",
    )
