# SPDX-License-Identifier: Apache-2.0
"""`limbloc report`: pictures and a page of a finished run."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from limbloc_ros.core.config import HullConfig, from_mapping
from limbloc_ros.core.pose import JOINT_NAMES, Array
from limbloc_ros.recordings.cases import is_case, load_case
from limbloc_ros.recordings.kept_frames import KeptFrames
from limbloc_ros.recordings.results import Run
from limbloc_ros.report.report import write_report
from limbloc_ros.report.run import RunData
from limbloc_ros.report.samples import carve_samples, choose_frames
from limbloc_ros.rig.rig_file import load_rig

DESCRIPTION = """\
Make the report of a run that `limbloc process` or `limbloc demo` left in RUN: stick and flesh figure over the hull,
hull by geodesic distance and by curvature, head path, joint angles, energy and times; one PNG each, and report.html,
which holds them all and needs no other file.
"""

EPILOG = """\
examples:
  limbloc report out/walk
  limbloc report out/walk --out pages/walk
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("run", type=Path, metavar="RUN", help="folder with the results of `limbloc process`")
    parser.add_argument("--out", type=Path, help="folder for pictures and page (default: RUN/report)")


def run(args: argparse.Namespace) -> int:
    """Do it."""
    make_report(args.run, args.out)
    return 0


def make_report(folder: Path, out: Path | None = None) -> Path:
    """Write the report of the run in `folder` and return its page."""
    result = Run.load(folder)
    data = run_data(result)
    samples = []
    kept = KeptFrames.load(folder)
    if kept.numbers and (folder / "rig.yaml").is_file():
        reasons = result.reasons
        held = [n for n in kept.numbers if n < len(result) and not reasons[n]]
        chosen = [held[i] for i in choose_frames([True] * len(held))]
        hull = from_mapping(HullConfig, result.about.get("config", {}).get("hull", {}))
        rig = load_rig(folder / "rig.yaml")
        samples = carve_samples(result, chosen, kept.masks, rig, hull, kept.images)
    with tqdm(desc="report", unit="picture", disable=None, dynamic_ncols=True) as bar:

        def on_picture(_name: str, number: int, total: int) -> None:
            bar.total = total
            bar.update(number + 1 - bar.n)

        page = write_report(data, samples, out or folder / "report", on_picture=on_picture)
    print(f"report: {page}")
    return page


def run_data(result: Run) -> RunData:
    """The results of a run as the report wants them."""
    about = result.about
    source = Path(str(about.get("input", "")))
    stages = list(dict.fromkeys(name for frame in result.frames for name in frame.times))
    return RunData(
        title=f"limbloc: {source.name}" if source.name else "limbloc",
        source=f"{about.get('kind', 'recording')} {source}",
        joints=result.joints,
        stamps=result.stamps,
        energy=result.energy,
        sigma=result.sigma,
        reliable=result.reliable,
        stage_ms={name: np.array([f.times.get(name, np.nan) for f in result.frames]) for name in stages},
        angles={name: result.angles[:, i] for i, name in enumerate(result.angle_names)},
        missing={i: reason for i, reason in enumerate(result.reasons) if reason},
        truth=_truth(source, len(result)),
        settings=_settings(about.get("config", {})),
        command=str(about.get("command", "")),
        consecutive=bool(about.get("consecutive", True)),
    )


def _truth(source: Path, frames: int) -> Array | None:
    """[F, 25, 3] true joints of a benchmark case that is still where it was, m; NaN where they are not known."""
    if not is_case(source):
        return None
    truth = load_case(source).truth
    if not truth or len(next(iter(truth.values()))) != frames:
        return None
    missing = np.full((frames, 3), np.nan)
    return np.stack([truth.get(name, missing) for name in JOINT_NAMES], axis=1)


def _settings(config: Mapping[str, Any]) -> dict[str, str]:
    return {f"{section}.{name}": str(value) for section, values in config.items() for name, value in values.items()}
