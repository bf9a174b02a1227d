# SPDX-License-Identifier: Apache-2.0
"""`limbloc rig calibrate`: images of a board -> a rig file and a report."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from tqdm import tqdm

from limbloc_ros.commands.rig_import import describe
from limbloc_ros.core.camera import Camera, Rig
from limbloc_ros.core.errors import ConfigError, InputError, OutputError, RigError
from limbloc_ros.files import write_bytes, write_text
from limbloc_ros.recordings.image_sets import count_sets, find_cameras, image_sets
from limbloc_ros.rig.advice import CameraQuality, assess, what_to_record
from limbloc_ros.rig.board import Board, parse_board
from limbloc_ros.rig.bundle import View
from limbloc_ros.rig.calibration import LENSES, Calibration, calibrate, calibrate_lens
from limbloc_ros.rig.formats.ros import write_intrinsics
from limbloc_ros.rig.rig_file import save_rig
from limbloc_ros.rig.volume import derive_volume

DESCRIPTION = """\
Calibrate all cameras of a room: lenses, places, floor. RECORDING is a folder with a video or a folder of pictures per
camera, started at the same instant, or a bag, in which somebody

  1. holds the board near each camera, tilted in all directions, until it was everywhere in the image,
  2. walks it through the room, slowly, so that it is always seen by two cameras or more,
  3. lays it on the floor where several cameras see it, for some seconds: there the origin will be, x along its longer
     side's squares, z up.

A ChArUco board is best (it may be partly hidden); of a checkerboard, one side must have an odd and the other an even
number of inner corners, or it looks the same upside down. Lenses that were recorded apart go to --intrinsics.
"""

EPILOG = """\
examples:
  limbloc rig calibrate --board charuco:9x7:0.1:0.075 --print-board board.png     the picture to print
  limbloc rig calibrate board/ --board charuco:9x7:0.1:0.075 --out rig.yaml
  limbloc rig calibrate bags/board --board checkerboard:9x6:0.04 --every 5 --out rig.yaml
  limbloc rig calibrate board/ --board charuco:9x7:0.1:0.075 --intrinsics lenses/ --floor 310 311 312 --out rig.yaml
  limbloc rig calibrate lenses/ --board checkerboard:7x4:0.06 --intrinsics-only --out lenses/   ROS camera YAMLs

The report (--report, a page with pictures) says how good it is and what to record again. Squares are measured in
metres between their corners: measure ten of them with a ruler, printers scale.
"""

#: Of longer recordings only so many sets are looked at, evenly spread.
MOST_SETS = 400


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("recording", type=Path, nargs="?", metavar="RECORDING", help="folder or bag")
    parser.add_argument(
        "--board",
        required=True,
        help="checkerboard:COLUMNSxROWS:SQUARE_M (inner corners) or charuco:COLUMNSxROWS:SQUARE_M:MARKER_M[:DICTIONARY]"
        "[:legacy] (squares)",
    )
    parser.add_argument("--print-board", type=Path, metavar="PNG", help="only write the board as a picture to print")
    parser.add_argument(
        "--out", type=Path, help="rig file to write (default: rig.yaml), or folder with --intrinsics-only (lenses)"
    )
    parser.add_argument("--report", type=Path, metavar="DIR", help="folder of the report (default: beside OUT)")
    parser.add_argument("--cameras", nargs="+", metavar="CAM", help="only these (default: all in RECORDING)")
    parser.add_argument("--lens", choices=LENSES, default="radtan", help="lens model (default: radtan, k1 k2 p1 p2)")
    parser.add_argument("--intrinsics", type=Path, metavar="DIR", help="another recording, for the lenses only")
    parser.add_argument("--intrinsics-only", action="store_true", help="lenses only: a ROS YAML of each camera")
    parser.add_argument("--every", type=int, metavar="N", help=f"look at every N-th set (default: {MOST_SETS} in all)")
    parser.add_argument("--floor", type=int, nargs="+", metavar="FRAME", help="frames with the board on the floor")
    parser.add_argument("--thickness", type=float, default=0.0, metavar="METRES", help="of the board on the floor")


def run(args: argparse.Namespace) -> int:
    """Do it."""
    board = parse_board(args.board)
    if args.print_board:
        if not cv2.imwrite(str(args.print_board), board.draw(200)):
            raise OutputError(f"--print-board {args.print_board}: cannot be written as a picture")
        print(
            f"{args.print_board}: print it so that a square measures {1000 * board.square_m:g} mm, glue it on a plate"
        )
        return 0
    if args.recording is None:
        raise InputError("RECORDING is missing: a folder with a video or pictures of each camera, or a bag")
    names = args.cameras or find_cameras(args.recording)
    if board.ambiguous and len(names) > 1 and not args.intrinsics_only:
        raise ConfigError(
            f"--board {args.board}: it looks the same upside down: two cameras may number its corners otherwise; "
            "take one with an odd and an even number of inner corners, or a ChArUco board"
        )
    if args.every is not None and args.every < 1:
        raise ConfigError(f"--every: expected 1 or more, got {args.every}")
    out = args.out or Path("lenses" if args.intrinsics_only else "rig.yaml")
    views, sizes = find_boards(args.recording, names, board, args.every)
    if args.intrinsics_only:
        return _lenses_only(args, out, board, names, sizes, views)
    lens_views: list[View] = []
    if args.intrinsics:
        lens_views, more = find_boards(args.intrinsics, names, board, args.every)
        for name, size in more.items():
            if sizes.setdefault(name, size) != size:
                raise InputError(f"camera {name}: {sizes[name]} px in {args.recording}, {size} px in {args.intrinsics}")
    missing = [name for name in names if name not in sizes]
    if missing:
        raise InputError(f"{args.recording}: no image of camera {', '.join(missing)} can be read")
    ordered = [sizes[name] for name in names]
    result = calibrate(
        names, ordered, views, board,
        lens=args.lens, lens_views=lens_views, floor=args.floor, thickness_m=args.thickness,
    )  # fmt: skip
    rig = Rig(result.cameras, *derive_volume(result.cameras))
    save_rig(rig, out)
    qualities = assess(result)
    advice = what_to_record(qualities, len(result.floor_frames))
    folder = args.report or out.with_name(f"{out.stem}_calibration")
    print(describe(rig))
    print(quality_table(qualities))
    _say(result.dropped, advice, result.floor_frames)
    page = write_report(result, rig, qualities, advice, folder, args.board)
    print(f"rig file: {out}\nreport: {page}")
    return 0


def find_boards(
    path: Path, names: Sequence[str], board: Board, every: int | None
) -> tuple[list[View], dict[str, tuple[int, int]]]:
    """Find the board in a recording.

    Returns:
        views, and each camera's image size.

    Raises:
        InputError: a camera's images change their size.
    """
    total = count_sets(path, names)
    step = every or max(1, -(-(total or 0) // MOST_SETS))
    views: list[View] = []
    sizes: dict[str, tuple[int, int]] = {}
    with tqdm(total=None if total is None else -(-total // step), unit="set", disable=None, desc="boards") as bar:
        for number, images in image_sets(path, names, step):
            bar.update()
            for name, image in images.items():
                size = (image.shape[1], image.shape[0])
                if sizes.setdefault(name, size) != size:
                    raise InputError(f"{path}: camera {name}: its images are {sizes[name]} and then {size} px")
                found = board.find(image)
                if found is not None:
                    views.append(View(names.index(name), number, *found))
    return views, sizes


def _lenses_only(
    args: argparse.Namespace,
    out: Path,
    board: Board,
    names: Sequence[str],
    sizes: dict[str, tuple[int, int]],
    views: Sequence[View],
) -> int:
    missing = [name for name in names if name not in sizes]
    if missing:
        raise RigError(f"{args.recording}: no image of camera {', '.join(missing)} can be read")
    cameras: list[Camera] = []
    every, residuals_of_all, thrown, advice = [], [], [], []
    for c, name in enumerate(names):
        mine = [view for view in views if view.camera == c]
        camera, used, residuals, dropped = calibrate_lens(name, sizes[name], mine, board, args.lens)
        write_intrinsics(camera, out / f"{name}.yaml")
        quality = assess(Calibration((camera,), used, residuals, np.zeros(1), np.zeros(1), {}, [], dropped))
        better = what_to_record(quality, 0, alone=True)
        K = camera.K
        print(
            f"  {name}: {len(used)} views, {quality[0].rms_px:.3f} px, {100 * quality[0].coverage:.0f} % of the image; "
            f"fx {K[0, 0]:.1f} fy {K[1, 1]:.1f} cx {K[0, 2]:.1f} cy {K[1, 2]:.1f}, "
            f"distortion {camera.distortion.round(4).tolist()}"
        )
        _say(dropped, better, [])
        cameras.append(camera)
        every += [replace(view, camera=c) for view in used]
        residuals_of_all += residuals
        thrown += dropped
        advice += better
    zeros = np.zeros(len(cameras))
    result = Calibration(tuple(cameras), every, residuals_of_all, zeros, zeros, {}, [], thrown)
    folder = args.report or out.with_name(f"{out.name}_calibration")
    page = write_report(result, None, assess(result), advice, folder, args.board)
    print(f"lenses: {out}\nreport: {page}")
    return 0


def _say(dropped: Sequence[str], advice: Sequence[str], floor_frames: Sequence[int]) -> None:
    if floor_frames:
        shown = ", ".join(map(str, floor_frames[:6])) + (" ..." if len(floor_frames) > 6 else "")
        print(f"  floor: the board lies on it in {len(floor_frames)} frame(s): {shown}")
    if dropped:
        print(f"  thrown away: {dropped[0]}" + (f" (and {len(dropped) - 1} more)" if len(dropped) > 1 else ""))
    for line in advice:
        print(f"  better: {line}")


_HEAD = ("camera", "views", "corners", "rms px", "95 % px", "image %", "tilt deg", "common", "place mm", "gaze deg")
#: So many columns say something of a lens alone.
_ALONE = 6


def _cells(q: CameraQuality) -> list[str]:
    return [
        q.name,
        str(q.views),
        str(q.corners),
        f"{q.rms_px:.3f}",
        f"{q.p95_px:.3f}",
        f"{100 * q.coverage:.0f}",
        f"{q.slant_deg:.0f}",
        str(q.common),
        f"{1000 * q.sigma_m:.2f}",
        f"{np.degrees(q.sigma_rad):.3f}",
    ]


def quality_table(qualities: Sequence[CameraQuality]) -> str:
    """The figures of every camera, as text."""
    rows = [_HEAD, *(_cells(q) for q in qualities)]
    widths = [max(len(row[i]) for row in rows) for i in range(len(_HEAD))]
    return "\n".join(
        "  " + "  ".join(word.rjust(width) for word, width in zip(row, widths, strict=True)) for row in rows
    )


def write_report(
    result: Calibration,
    rig: Rig | None,
    qualities: Sequence[CameraQuality],
    advice: Sequence[str],
    folder: Path,
    board: str,
) -> Path:
    """Write pictures and page into `folder`, and return the page; without a rig it is about lenses alone.

    Raises:
        OutputError: the folder cannot be written.
    """
    from limbloc_ros.report.page import Section, Table, build_page
    from limbloc_ros.rig.pictures import coverage_picture, rig_picture

    places, errors = [], []
    for c in range(len(result.cameras)):
        mine = [(v, r) for v, r in zip(result.views, result.residuals, strict=True) if v.camera == c]
        places.append(np.concatenate([v.places for v, _ in mine]))
        errors.append(np.concatenate([np.linalg.norm(r, axis=1) for _, r in mine]))
    pictures = {"coverage.png": coverage_picture(result.cameras, places, errors, [q.cells for q in qualities])}
    head, among_each_other = _HEAD[:_ALONE], ""
    if rig is not None:
        pictures["rig.png"] = rig_picture(rig.cameras, rig.volume_min, rig.volume_max)
        head, among_each_other = _HEAD, (
            " Place and gaze are standard deviations of the cameras among each other, as the residuals suggest; common "
            "are the frames shared with the best neighbour."
        )  # fmt: skip
    verdict = "Nothing to improve." if not advice else ""
    sections = [
        Section("quality", "How good it is", f"Root mean square error {result.rms_px():.3f} px.{among_each_other}",
                tables=[Table([_cells(q)[: len(head)] for q in qualities], head)]),
        Section("again", "What to record again", verdict, tables=[Table([(f"{i + 1}", line) for i, line in
                enumerate(advice)])] if advice else ()),
        Section("coverage", "Where the board was", "Corners in each image, coloured by their distance from where the "
                "calibrated camera sees them. Red cells saw no board: there the lens is a guess.",
                pictures["coverage.png"], "board corners in every camera's image", wide=True),
    ]  # fmt: skip
    if rig is not None:
        sections.append(
            Section("rig", "The room", "Cameras with what they see, the carve volume (dotted) and a person of 1.75 m "
                    "for scale; from the side and from above. Red, green and blue are x, y and z at the origin.",
                    pictures["rig.png"], "the cameras in 3D", wide=True)
        )  # fmt: skip
    if result.dropped:
        rows = [(f"{i + 1}", line) for i, line in enumerate(result.dropped)]
        sections.append(Section("dropped", "Thrown away", "Views and corners that did not fit.", tables=[Table(rows)]))
    about = [f"{len(result.cameras)} cameras, {len(result.views)} views of {board}"]
    for name, data in pictures.items():
        write_bytes(folder / name, data)
    page = folder / "calibration.html"
    write_text(page, build_page("limbloc: calibration", about, sections, "limbloc rig calibrate"))
    return page
