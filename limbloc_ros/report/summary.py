# SPDX-License-Identifier: Apache-2.0
"""The report's numbers: what was found, how good, how fast."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from limbloc_ros.core.pose import JOINT, LIMB_JOINTS, Array
from limbloc_ros.report.compare import agreement
from limbloc_ros.report.run import RunData, joint_jumps, steps

Rows = list[tuple[str, str]]

#: The paper claims "precision within 5 cm".
CLAIM_M = 0.05


def summary(run: RunData) -> Rows:
    """(name, value) rows of the run as a whole."""
    frames, found = len(run.joints), int(run.found.sum())
    rows: Rows = [
        ("frames", f"{frames}, {_seconds(run)}" if run.consecutive else f"{frames}, unrelated poses"),
        ("person found", f"{found} ({_percent(found, frames)})"),
        ("no person", f"{frames - found} ({_percent(frames - found, frames)})"),
        ("not reliable", f"{int((run.found & ~run.reliable).sum())} of the frames with a person"),
        ("energy (eq. 2)", _median_p95(run.energy, 1.0, "", 3)),
        ("process time per frame", _median_p95(run.total_ms, 1.0, " ms", 1)),
        ("expected joint error (sigma)", _median_p95(run.sigma[:, [JOINT[n] for n in LIMB_JOINTS]], 1000.0, " mm", 0)),
    ]
    if run.consecutive:
        rows.append(("jumps", _jumps(run)))
    error = run.error_m
    if error is not None:
        limbs = error[:, [JOINT[name] for name in LIMB_JOINTS]]
        known = limbs[np.isfinite(limbs)]
        what = "true error" if run.truth_kind == "true" else "distance from the reference"
        number = f"mean {_mean(limbs)}, {_median_p95(limbs, 1000.0, ' mm', 1)}"
        rows.append((f"{what}, {len(LIMB_JOINTS)} joints", number))
        if len(known):
            rows.append(("within 5 cm", _percent(int((known < CLAIM_M).sum()), len(known)) + " of the joints found"))
            inside = limbs / run.sigma[:, [JOINT[name] for name in LIMB_JOINTS]]
            judged = inside[np.isfinite(inside)]
            rows.append(("within 2 sigma", _percent(int((judged < 2).sum()), len(judged)) + " of the joints found"))
    return rows


def error_table(run: RunData) -> list[list[str]]:
    """Joint, mean, median, RMS, 95th percentile (mm) and the share within 5 cm, of every joint that the truth has."""
    error = run.error_m
    if error is None:
        return []
    table = []
    for name, index in JOINT.items():
        known = error[np.isfinite(error[:, index]), index]
        if len(known):
            rms = np.sqrt((known**2).mean())
            numbers = (known.mean(), np.median(known), rms, np.percentile(known, 95))
            share = _percent(int((known < CLAIM_M).sum()), len(known))
            table.append([name.replace("_", " "), *(f"{1000 * v:.1f}" for v in numbers), share])
    return table


def agreement_table(ours: Mapping[str, Array], theirs: Mapping[str, Array]) -> list[list[str]]:
    """Angle, pairs, bias, 95 % limits of agreement, mean absolute and RMS difference in degrees, correlation."""
    table = []
    for name in ours:
        found = agreement(np.degrees(ours[name]), np.degrees(theirs[name])) if name in theirs else None
        if found is not None:
            low, high = found.limits
            numbers = (f"{found.bias:+.1f}", f"{low:+.1f} to {high:+.1f}", f"{found.mae:.1f}", f"{found.rmsd:.1f}")
            r = "-" if np.isnan(found.r) else f"{found.r:.2f}"
            table.append([name.replace("_", " "), str(found.count), *numbers, r])
    return table


def jump_table(run: RunData, most: int = 40) -> list[list[str]]:
    """Frame, time and which joints jump how far (cm), frame by frame; the last row counts what is left out."""
    broken = joint_jumps(run)
    moved = {name: steps(run.joint_path(name)) for name in broken}
    frames = np.flatnonzero(np.any(list(broken.values()), axis=0)) if broken else np.zeros(0, dtype=np.int64)
    table = []
    for frame in frames[:most]:
        which = sorted((name for name in broken if broken[name][frame]), key=lambda name: -moved[name][frame])
        told = [f"{name.replace('_', ' ')} {100 * moved[name][frame]:.0f} cm" for name in which]
        more = f" and {len(told) - 4} more" if len(told) > 4 else ""
        table.append([str(frame), f"{run.seconds[frame]:.2f} s", ", ".join(told[:4]) + more])
    if len(frames) > most:
        table.append([f"{len(frames) - most} more", "", ""])
    return table


def _jumps(run: RunData) -> str:
    """How many frames break the path of some joint, and the first of them."""
    frames = np.flatnonzero(np.any(list(joint_jumps(run).values()), axis=0))
    if not len(frames):
        return "none"
    listed = ", ".join(str(f) for f in frames[:8]) + (", ..." if len(frames) > 8 else "")
    return f"{len(frames)} of {len(run.joints)} frames ({listed})"


def _seconds(run: RunData) -> str:
    return f"{run.seconds[-1]:.2f} s"


def _percent(part: int, whole: int) -> str:
    return f"{100 * part / whole:.1f} %" if whole else "0 %"


def _mean(values: Array) -> str:
    return f"{1000 * np.nanmean(values):.1f} mm" if np.isfinite(values).any() else "unknown"


def _median_p95(values: Array, scale: float, unit: str, digits: int) -> str:
    known = scale * values[np.isfinite(values)]
    if not len(known):
        return "unknown"
    return f"median {np.median(known):.{digits}f}{unit}, 95 % below {np.percentile(known, 95):.{digits}f}{unit}"
