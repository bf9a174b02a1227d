# SPDX-License-Identifier: Apache-2.0
"""`limbloc process`: a recording -> joints.npz, joint_angles.csv and, if wanted, a report."""

from __future__ import annotations

import argparse
import dataclasses
import shlex
import sys
import time
from pathlib import Path

import numpy as np
from tqdm import tqdm

from limbloc_ros.core import interrupts
from limbloc_ros.core.config import from_mapping
from limbloc_ros.core.errors import ConfigError, InputError
from limbloc_ros.recordings import offline
from limbloc_ros.recordings.batch import save_folder
from limbloc_ros.recordings.config_file import load_config
from limbloc_ros.recordings.kept_frames import KeptFrames
from limbloc_ros.recordings.offline import OfflineConfig
from limbloc_ros.recordings.open_source import open_source
from limbloc_ros.recordings.results import Run, read_about
from limbloc_ros.recordings.sources import Source, rig_identity
from limbloc_ros.rig.rig_file import load_rig

DESCRIPTION = """\
Work out the pose in every frame of a recording, on all cores, with the code of the live nodes.

INPUT is one of
  a bag       a rosbag2 folder, .mcap or .db3 file with <camera>/mask or <camera>/image_raw topics (raw or compressed)
  videos      a folder with one video or one folder of images per camera, named like the cameras of the rig file
  a case      a benchmark case folder with calib.json and masks.npz (needs no --rig)

and OUT gets joints.npz (joints [F, 25, 3] in metres, joint_names, stamps, energy, sigma, reliable), joint_angles.csv
(radians), run.npz (everything, for `limbloc report`) and run.json. An OUT that ends in .npz gets joints.npz alone.
"""

EPILOG = """\
examples:
  limbloc process bags/walk --rig rig.yaml --out out/walk --report
  limbloc process videos/ --rig rig.yaml --background empty_room/ --out out/balance
  limbloc process case/rgb --rig case/calib.json --leave-out 15 --out predictions/case.npz
  limbloc process silhouettes/ --rig rig.yaml --masks --fps 60 --out out/balance
  limbloc process test/data/benchmark/public/seq_wave --out predictions/seq_wave.npz

Without --background the first frames of a recording must show the empty room (15 of them by default). Ctrl-C keeps
what is done; the same command goes on from there. Any number of --jobs gives the same result. The same recording may be
worked out again into its OUT; results of another recording or rig are only replaced with --overwrite.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("input", type=Path, metavar="INPUT", help="bag, folder of videos or images, or benchmark case")
    parser.add_argument("--rig", type=Path, help="rig YAML or calib.json with the calibrated cameras")
    parser.add_argument("--out", type=Path, help="folder for the results, or a .npz file (default: out/<INPUT's name>)")
    parser.add_argument(
        "--overwrite", action="store_true", help="replace the results of another recording or rig that are in OUT"
    )
    parser.add_argument("--report", action="store_true", help="also make pictures and a page (OUT/report/report.html)")
    add_options(parser)


def add_options(parser: argparse.ArgumentParser) -> None:
    """What `limbloc batch` takes too."""
    parser.add_argument("--engine", choices=("robust", "paper"), help="which fitting chain runs (default: robust)")
    parser.add_argument(
        "--temporal",
        action=argparse.BooleanOptionalAction,
        default=None,
        help="start each frame from the one before: faster and smoother, but one process (default: no)",
    )
    parser.add_argument("--jobs", type=int, default=0, metavar="N", help="processes (default: one per core)")
    parser.add_argument("--config", type=Path, metavar="YAML", help="parameters, see docs/parameters.md")
    parser.add_argument(
        "--background",
        metavar="DIR",
        help="pictures of the empty room, one per camera, named like the cameras; or the word `estimate`: guess the "
        "room from a recording that always shows a person who moves about",
    )
    parser.add_argument("--masks", action="store_true", help="the images or videos are silhouettes already")
    parser.add_argument(
        "--leave-out",
        type=int,
        default=0,
        metavar="N",
        help="no results for the first N frames, such as those of the empty room, which are learnt from all the same; "
        "row i of the results is then frame N + i",
    )
    parser.add_argument("--fps", type=float, metavar="HZ", help="frame rate of image folders (default: 25)")


def config_of(args: argparse.Namespace) -> OfflineConfig:
    """The parameters file with the options on top; raises ConfigError."""
    config = load_config(args.config)
    chosen = {name: getattr(args, name) for name in ("engine", "temporal") if getattr(args, name) is not None}
    if args.jobs < 0:
        raise ConfigError(f"--jobs: expected 1 or more (0: one per core), got {args.jobs}")
    if args.leave_out < 0:
        raise ConfigError(f"--leave-out: expected 0 or more frames, got {args.leave_out}")
    fit = from_mapping(type(config.fit), {**dataclasses.asdict(config.fit), **chosen})
    return dataclasses.replace(config, fit=fit)


def run(args: argparse.Namespace) -> int:
    """Do it."""
    config = config_of(args)
    source = open_source(
        args.input,
        load_rig(args.rig) if args.rig else None,
        config,
        background=args.background,
        masks=args.masks,
        fps=args.fps,
    )
    out = args.out or Path("out") / args.input.resolve().name
    only_joints = out.suffix == ".npz"
    if only_joints and args.report:
        raise InputError(f"--report needs a folder, but --out {out} is a file; leave the .npz away")
    if out.exists() and out.is_dir() == only_joints:
        raise InputError(f"--out {out} is {'a folder' if only_joints else 'a file'}; choose another name")
    if not only_joints and not args.overwrite:
        refuse_others_results(out, source)
    partial = out.with_name(f"{out.name}.partial") if only_joints else out / ".partial"
    kept = KeptFrames()
    say(f"{source.about['kind']} {args.input}: {len(source.rig.cameras)} cameras, engine {config.fit.engine}")
    if "background" in source.about:
        say(f"background of the room: {source.about['background']}")
    started = time.monotonic()
    with interrupts.ending_at_once("limbloc process: interrupted before the first frame"):
        offline.prepare(say)
    total = None if source.frames is None else source.frames - args.leave_out
    with tqdm(total=total, unit="frame", disable=None, dynamic_ncols=True) as bar:

        def progress(done: int, total: int | None) -> None:
            bar.total = total
            bar.update(done - bar.n)

        result = offline.process(
            source,
            config,
            partial=partial,
            jobs=args.jobs,
            leave_out=args.leave_out,
            kept=kept,
            progress=progress,
            say=say,
        )
    if only_joints:
        result.save_joints(out)
        offline.forget_partial(partial)
    else:
        result.about["command"] = shlex.join(["limbloc", *sys.argv[1:]])
        save_folder(result, source.rig, kept, out)
    print(summary(result, out, time.monotonic() - started))
    if args.report:
        from limbloc_ros.commands.report import make_report

        make_report(out)
    return 0


def refuse_others_results(out: Path, source: Source) -> None:
    """Raise InputError when `out` holds the finished run of another recording, or of this one with another rig."""
    advice = "choose another --out, or replace them with --overwrite"
    try:
        about = read_about(out / "run.json")  # the last file that a run writes
    except InputError as error:
        raise InputError(f"{out} holds results that cannot be read ({error}); {advice}") from None
    if not about:
        return
    before, now = str(about.get("input", "")), str(source.about["input"])
    if Path(before).resolve() != Path(now).resolve():
        raise InputError(f"{out} holds the results of another recording, {before}, and this is {now}; {advice}")
    rig_file = out / "rig.yaml"
    if rig_file.is_file() and rig_identity(load_rig(rig_file)) != rig_identity(source.rig):
        raise InputError(f"{out} holds the results of this recording with another rig, {rig_file}; {advice}")


def summary(result: Run, out: Path, seconds: float) -> str:
    """What came out, in two or three lines."""
    reasons = [reason for reason in result.reasons if reason]
    found = len(result) - len(reasons)
    text = f"{found} of {len(result)} frames have a pose ({int(result.reliable.sum())} reliable), {seconds:.1f} s"
    if found:
        text += f", median energy {np.nanmedian(result.energy):.3f}"
    common = max(set(reasons), key=reasons.count) if reasons else ""
    if common:
        text += f"\nwithout a pose: {len(reasons)} frames, mostly: {common}"
    return f"{text}\nresults in {out}"


def say(text: str) -> None:
    """A line for the person at the terminal, beside the progress bar."""
    tqdm.write(text, file=sys.stderr)
