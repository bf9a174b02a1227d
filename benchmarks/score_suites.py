#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Run `limbloc process` over the public benchmark suites and score the poses: the table of docs/benchmarks.md.

python benchmarks/score_suites.py                         all suites, robust engine, each frame alone
python benchmarks/score_suites.py --engine paper public
python benchmarks/score_suites.py --temporal --sequences  sequences only, each frame from the one before

Predictions and scores.json go to out/scores/robust, out/scores/paper, out/scores/robust_temporal, ...
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import score
from tqdm import tqdm

from limbloc_ros.core.config import FitConfig
from limbloc_ros.recordings import offline
from limbloc_ros.recordings.cases import load_case
from limbloc_ros.recordings.offline import OfflineConfig, process
from limbloc_ros.recordings.sources import CaseSource

DATA = Path(__file__).parents[1] / "test" / "data" / "benchmark"

#: Rows of the table: title, suite, beginning of the case names.
ROWS = (
    ("public", "public", ""),
    ("public_clothed", "public_clothed", ""),
    ("public_noisy", "public_noisy", ""),
    ("public_few, 6 cameras", "public_few", "cams6"),
    ("public_few, 4 cameras", "public_few", "cams4"),
    ("public_few, 8 cameras 1280x960", "public_few", "cams8"),
    ("public_motion", "public_motion", ""),
)
HEAD = (
    "suite", "frames", "mean mm", "median mm", "p95 mm", "PCK50 %", "success %", "swaps %",
    "core mean mm", "in 2 sigma %", "caught %", "false alarms %", "ms",
)  # fmt: skip


def main(argv: Sequence[str] | None = None) -> None:
    """Run, score, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("suites", nargs="*", help="suites to run (default: all)")
    parser.add_argument("--engine", choices=("robust", "paper"), default="robust")
    parser.add_argument("--temporal", action="store_true", help="start each frame from the one before")
    parser.add_argument("--sequences", action="store_true", help="only cases whose frames follow each other")
    parser.add_argument("--jobs", type=int, default=0, help="processes (default: one per core)")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of suites")
    parser.add_argument("--out", type=Path, default=Path("out/scores"), help="a folder per engine goes there")
    args = parser.parse_args(argv)
    if unknown := set(args.suites) - {suite for _, suite, _ in ROWS}:
        parser.error(f"expected suites such as public, got {', '.join(sorted(unknown))}")
    out = args.out / (f"{args.engine}_temporal" if args.temporal else args.engine)
    config = OfflineConfig(fit=FitConfig(engine=args.engine, temporal=args.temporal))
    offline.prepare(lambda text: print(text, file=sys.stderr))
    rows = []
    for title, suite, prefix in ROWS:
        cases = sorted(p.parent for p in (args.data / suite).glob(f"{prefix}*/calib.json"))
        if args.sequences:
            cases = [c for c in cases if json.loads((c / "meta.json").read_text())["kind"] == "sequence"]
        if cases and (not args.suites or suite in args.suites):
            rows.append(run_row(title, cases, config, args.jobs, out / suite))
    text = table(rows)
    print(f"\nengine {args.engine}{', temporal' if args.temporal else ', each frame alone'}; 13 limb joints\n\n{text}")
    out.mkdir(parents=True, exist_ok=True)
    (out / "scores.json").write_text(json.dumps(rows, indent=1) + "\n")


def run_row(title: str, cases: list[Path], config: OfflineConfig, jobs: int, out: Path) -> dict[str, Any]:
    """Process the cases and score them together."""
    times: list[float] = []
    sigma, error, reliable = [], [], []
    scored = []
    for folder in tqdm(cases, desc=title, file=sys.stderr, disable=None):
        case = load_case(folder)
        run = process(CaseSource(case), config, jobs=jobs)
        run.save_joints(out / f"{folder.name}.npz")
        scored.append(score.score_case(str(out / f"{folder.name}.npz"), str(folder)))
        times += [sum(frame.times.values()) for frame in run.frames if frame.times]
        data = np.load(out / f"{folder.name}.npz")
        limbs = [data["joint_names"].tolist().index(name) for name in score.LIMB13]
        truth = np.stack([case.truth[name] for name in score.LIMB13], axis=1)
        error.append(np.linalg.norm(data["joints"][:, limbs] - truth, axis=2))
        sigma.append(data["sigma"][:, limbs])
        reliable.append(data["reliable"])
    limb = score.summarise(scored, score.LIMB13)
    core = score.summarise(scored, score.CORE)
    return {
        "suite": title,
        "frames": limb["frames"],
        "mean mm": limb["mpjpe_mm"]["mean"],
        "median mm": limb["mpjpe_mm"]["median"],
        "p95 mm": limb["mpjpe_mm"]["p95"],
        "PCK50 %": limb["pck50"],
        "success %": limb["frame_success_percent"],
        "swaps %": limb["swapped_arms_percent"] + limb["swapped_legs_percent"],
        "core mean mm": core["mpjpe_mm"]["mean"],
        **confidence(np.concatenate(error), np.concatenate(sigma), np.concatenate(reliable)),
        "ms": statistics.median(times),
        "angles_deg": limb["angles_deg"],
        "acceleration_error": limb.get("acceleration_error_mm_per_frame2"),
    }


def confidence(error: np.ndarray, sigma: np.ndarray, reliable: np.ndarray) -> dict[str, float]:
    """How far sigma and the reliable flag can be believed.

    Args:
        error, sigma: [F, 13] m, NaN where there is no pose.
        reliable: [F].

    Returns:
        joints within 2 sigma, failed frames (a joint off by 15 cm, or no pose) that were flagged, and good frames
        that were flagged, in percent; NaN where there are none.
    """
    failed = ~(error < 0.15).all(axis=1)
    known = np.isfinite(error)

    def percent(flags: np.ndarray) -> float:
        return 100.0 * float(flags.mean()) if len(flags) else float("nan")

    return {
        "in 2 sigma %": percent(error[known] < 2 * sigma[known]),
        "caught %": percent(~reliable[failed]),
        "false alarms %": percent(~reliable[~failed]),
    }


def table(rows: list[dict[str, Any]]) -> str:
    """Rows as a Markdown table."""
    lines = ["| " + " | ".join(HEAD) + " |", "|" + "---|" * len(HEAD)]
    for row in rows:
        cells = [f"{row[name]:.1f}" if isinstance(row[name], float) else str(row[name]) for name in HEAD]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
