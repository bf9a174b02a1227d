# SPDX-License-Identifier: Apache-2.0
"""`limbloc report`: pictures and a page of a finished run."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Mapping
from pathlib import Path

from tqdm import tqdm

from limbloc_ros.core.config import HullConfig, from_mapping
from limbloc_ros.core.pose import Array
from limbloc_ros.recordings.cases import is_case, load_case
from limbloc_ros.recordings.kept_frames import KeptFrames
from limbloc_ros.recordings.results import Run
from limbloc_ros.report.compare import ALIGN, Reference, load_reference
from limbloc_ros.report.report import write_report
from limbloc_ros.report.run import RunData
from limbloc_ros.report.samples import carve_samples, choose_frames
from limbloc_ros.rig.rig_file import load_rig

DESCRIPTION = """\
Make the report of a run that `limbloc process` or `limbloc demo` left in RUN: stick and flesh figure over the hull,
hull by geodesic distance and by curvature, trajectories, joint angles with their usual ranges, ranges of motion,
energy and confidence, bone lengths, jumps and times; one PNG each, and report.html, which holds them all and needs no
other file. With --reference also the error by joint, the agreement of angles and Bland-Altman plots.
"""

EPILOG = """\
examples:
  limbloc report out/walk
  limbloc report out/walk --out pages/walk
  limbloc report out/walk --reference markers.trc --align rigid
  limbloc report out/walk --reference out/walk_paper --out pages/robust_and_paper
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("run", type=Path, metavar="RUN", help="folder with the results of `limbloc process`")
    parser.add_argument("--out", type=Path, help="folder for pictures and page (default: RUN/report)")
    parser.add_argument(
        "--reference",
        type=Path,
        metavar="FILE",
        help="compare with it: markers (.trc, y up), joints (.npz with joints, joint_names, perhaps stamps) "
        "or the folder of another run",
    )
    parser.add_argument(
        "--reference-offset", type=float, default=0.0, metavar="S", help="added to the reference's times (default: 0)"
    )
    parser.add_argument(
        "--align",
        choices=ALIGN,
        default="none",
        help="rigid: turn and move the reference as a whole to fit the run best, if its world axes are others",
    )


def run(args: argparse.Namespace) -> int:
    """Do it."""
    result = Run.load(args.run)
    reference = None
    if args.reference is not None:
        reference = load_reference(args.reference, result, offset_s=args.reference_offset, align=args.align)
    make_report(args.run, args.out, reference)
    return 0


def make_report(folder: Path, out: Path | None = None, reference: Reference | None = None) -> Path:
    """Write the report of the run in `folder`, compared with a reference if given, and return its page."""
    result = Run.load(folder)
    data = run_data(result)
    if reference is not None:
        data = with_reference(data, reference)
        print(f"reference: {reference.name}; {'; '.join(reference.notes)}")
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
    """The results of a run as the report wants them, with the truth of a benchmark case that is still where it was."""
    source = Path(str(result.about.get("input", "")))
    return RunData.of(
        result,
        title=f"limbloc: {source.name}" if source.name else "limbloc",
        source=f"{result.about.get('kind', 'recording')} {source}",
        truth=_truth(source, len(result)),
    )


def with_reference(data: RunData, reference: Reference) -> RunData:
    """The same, compared with a reference in place of the truth."""
    return dataclasses.replace(
        data,
        truth=reference.joints,
        truth_kind="reference",
        truth_about=(f"Reference: {reference.name}", *reference.notes),
        truth_angles=reference.angles,
    )


def _truth(source: Path, frames: int) -> Mapping[str, Array]:
    """Joint -> [F, 3] true places of a benchmark case that is still where it was, m; empty where they are not known."""
    truth = load_case(source).truth if is_case(source) else {}
    return truth if truth and len(next(iter(truth.values()))) == frames else {}
