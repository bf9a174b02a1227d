# SPDX-License-Identifier: Apache-2.0
"""`limbloc rig check`: footage of a person + a rig file -> what is wrong with it, and which camera."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from limbloc_ros.core.camera import Rig
from limbloc_ros.core.errors import ConfigError, InputError
from limbloc_ros.files import write_bytes, write_text
from limbloc_ros.recordings.config_file import load_config
from limbloc_ros.recordings.open_source import open_source
from limbloc_ros.rig.check import GOOD, Report, check
from limbloc_ros.rig.consistency import Mask, low_view, shrink_masks
from limbloc_ros.rig.fine_check import FineFrames, look_closely
from limbloc_ros.rig.rig_file import load_rig, save_rig

DESCRIPTION = """\
Find out from footage with one person in it whether a rig file is right. The person's silhouettes are carved coarsely,
and what comes out is compared with every camera's own silhouette, together, in pairs, and without each camera.

Found and said in words: wrong units, z not up or upside down, a floor that is elsewhere, exchanged cameras, a camera
that is late, a camera that was moved (by how much), and one whose masks or lens are wrong. Where nothing of that kind
is found, larger images tell whether one camera is off by some pixels. INPUT is what `limbloc process` takes: a bag, a
folder of videos or pictures, silhouettes (--masks), or a benchmark case.
"""

EPILOG = """\
examples:
  limbloc rig check videos/ --rig rig.yaml --background empty_room/
  limbloc rig check silhouettes/ --rig rig.yaml --masks --height 1.78 --report check/
  limbloc rig check bags/walk --rig rig.yaml --fix checked.yaml       a camera that is off put where it seems to be
  limbloc rig check test/data/benchmark/public/seq_walk_circle

Exit codes: 0 nothing severe, 1 something is wrong, 2 wrong input. A delay can only be seen when the person moves.
"""

EXIT_WRONG = 1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("input", type=Path, metavar="INPUT", help="bag, folder of videos or images, or benchmark case")
    parser.add_argument("--rig", type=Path, help="the rig file to check (a benchmark case has its own)")
    parser.add_argument("--background", metavar="DIR", help="pictures of the empty room, or the word estimate")
    parser.add_argument("--masks", action="store_true", help="the images or videos are silhouettes already")
    parser.add_argument("--fps", type=float, metavar="HZ", help="frame rate of image folders (default: 25)")
    parser.add_argument("--config", type=Path, metavar="YAML", help="parameters, see docs/parameters.md")
    parser.add_argument(
        "--frames", type=int, default=250, metavar="N", help="look at the first N frames (default: 250)"
    )
    parser.add_argument("--skip", type=int, default=0, metavar="N", help="leave out the first N frames")
    parser.add_argument("--height", type=float, metavar="METRES", help="how tall the person is: checks the scale")
    parser.add_argument("--report", type=Path, metavar="DIR", help="write a page with pictures there")
    parser.add_argument(
        "--fix", type=Path, metavar="YAML", help="write the rig, with a camera that is off put where it seems to be"
    )


def run(args: argparse.Namespace) -> int:
    """Do it."""
    if args.frames < 1 or args.skip < 0:
        raise ConfigError(f"expected --frames of 1 or more and --skip of 0 or more, got {args.frames} and {args.skip}")
    if args.height is not None and not 0.5 <= args.height <= 2.5:
        raise ConfigError(f"--height: expected 0.5 to 2.5 m, got {args.height}")
    source = open_source(
        args.input,
        load_rig(args.rig) if args.rig else None,
        load_config(args.config),
        background=args.background,
        masks=args.masks,
        fps=args.fps,
    )
    views = [low_view(camera) for camera in source.rig.cameras]
    recording, stamps, closely = [], [], FineFrames(source.rig)
    with tqdm(total=args.frames, unit="frame", disable=None, desc="masks") as bar:
        for i, masks in enumerate(source.mask_sets()):
            if i >= args.skip + args.frames:
                break
            bar.update(i >= args.skip)
            if i >= args.skip and masks.masks:
                recording.append(shrink_masks(views, masks.masks))
                closely.add(masks.masks)
                stamps.append(masks.stamp_ns)
    if not recording:
        raise InputError(
            f"{args.input}: no frame has masks of any camera (is the background learnt, see --background?)"
        )
    steps = np.diff(stamps) / 1e9
    even = source.about.get("consecutive", True) and len(steps) > 3 and np.ptp(steps) < 0.5 * np.median(steps)
    fps = float(1 / np.median(steps)) if even else None
    report = check(source.rig, recording, fps=fps, height_m=args.height)
    look_closely(source.rig, report, closely)
    print(describe(source.rig, report, len(recording)))
    if args.report:
        print(f"report: {write_report(source.rig, report, args.report, str(args.input))}")
    if args.fix:
        if not report.move and not report.good:
            print("--fix: what is wrong is no single camera's place: nothing is written")
        elif not report.move:
            save_rig(source.rig, args.fix)
            print(f"{args.fix}: the same cameras, none of them is off")
        else:
            save_rig(moved_rig(source.rig, report), args.fix)
            print(f"{args.fix}: {', '.join(report.move)} put where the silhouettes fit; calibrate again when you can")
    return 0 if report.good else EXIT_WRONG


def moved_rig(rig: Rig, report: Report) -> Rig:
    """The rig with the cameras that were moved where they seem to be."""
    cameras = (
        replace(camera, T_world_camera=report.move[camera.name].T_world_camera)
        if camera.name in report.move
        else camera
        for camera in rig.cameras
    )
    return replace(rig, cameras=tuple(cameras))


def describe(rig: Rig, report: Report, frames: int) -> str:
    """The outcome as text."""
    lines = [f"{len(rig.cameras)} cameras, {frames} frames"]
    lines += [f"  {name}: {value}" for name, value in report.facts]
    if report.scores is not None:
        scores = report.scores
        lines.append(
            f"  unexplained foreground, together: {100 * scores.together:.1f} % (good: below {100 * GOOD:.0f} %)"
        )
        lines.append("  camera          its own %   of the others without it %   outside the others' hull %")
        for i, name in enumerate(scores.names):
            values = (scores.unexplained[i], scores.without[i], scores.alone[i])
            a, b, c = ("-" if np.isnan(v) else f"{100 * v:.1f}" for v in values)
            lines.append(f"  {name:15s} {a:>9s}   {b:>26s}   {c:>26s}")
    for finding in report.findings:
        lines.append(f"{'WRONG' if finding.severe else 'note'}: {finding.text}")
    if not report.findings:
        lines.append("good: nothing contradicts the rig file")
    return "\n".join(lines)


def write_report(rig: Rig, report: Report, folder: Path, source: str) -> Path:
    """Write a page with pictures into `folder`, and return it.

    Raises:
        OutputError: the folder cannot be written.
    """
    from limbloc_ros.report.page import Section, Table, build_page
    from limbloc_ros.rig.pictures import overlay_picture, pair_picture, rig_picture

    overlays: dict[str, tuple[Mask, Mask]] = report.overlays
    rows = [(f"{i + 1}", finding.text) for i, finding in enumerate(report.findings)]
    verdict = "" if rows else "Nothing contradicts the rig file."
    sections = [
        Section("findings", "What was found", verdict, tables=[Table(rows)] if rows else ()),
        Section("figures", "Figures", tables=[Table(report.facts)]),
    ]  # fmt: skip
    pictures = {"rig.png": rig_picture(rig.cameras, rig.volume_min, rig.volume_max)}
    if overlays:
        pictures["silhouettes.png"] = overlay_picture(overlays)
        sections.append(
            Section("silhouettes", "Silhouettes and the others' hull", "Each camera's silhouette against the hull that "
                    "all other cameras make: white lies inside, as it must; red is foreground that the others deny; "
                    "blue is what the others would allow, which is normal.", pictures["silhouettes.png"],
                    "silhouettes", wide=True)
        )  # fmt: skip
    if report.pairs is not None:
        pictures["pairs.png"] = pair_picture(report.pairs, rig.names)
        sections.append(
            Section("pairs", "Camera by camera", "Unexplained foreground when two cameras alone are asked. Two agree "
                    "easily: what is dark here is badly wrong.", pictures["pairs.png"], "matrix of pairs")
        )  # fmt: skip
    sections.append(Section("rig", "The room", "Cameras and carve volume.", pictures["rig.png"], "cameras", wide=True))
    for name, data in pictures.items():
        write_bytes(folder / name, data)
    page = folder / "check.html"
    write_text(page, build_page("limbloc: check of a rig", [source], sections, "limbloc rig check"))
    return page
