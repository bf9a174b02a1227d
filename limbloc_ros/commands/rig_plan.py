# SPDX-License-Identifier: Apache-2.0
"""`limbloc rig plan`: a rig, or a proposal for a room, drawn and measured."""

from __future__ import annotations

import argparse
from pathlib import Path

from tqdm import tqdm

from limbloc_ros.commands.rig_import import describe, size
from limbloc_ros.core.camera import Rig
from limbloc_ros.core.errors import ConfigError
from limbloc_ros.files import write_bytes
from limbloc_ros.rig.plan import (
    Coverage,
    Fatness,
    blind_spots,
    cover_floor,
    hull_fatness,
    propose,
    standing_places,
    table,
)
from limbloc_ros.rig.rig_file import load_rig, save_rig
from limbloc_ros.simulation.person import PERSON_NAMES, load_person

DESCRIPTION = """\
Draw the cameras of a rig file, or propose where to hang N cameras in a room: what each sees in 3D, how many see each
place of the floor from ankles to raised hands, the blind spots, and how much fatter than the body the hull will be (a
standing person is carved from true silhouettes, with the real carving, in five places).

In a room of 5 x 5 m the hull of a standing man has 1.4 times his volume with four cameras, 1.2 times with eight and 1.1
times with sixteen: see it for your room with --compare.
"""

EPILOG = """\
examples:
  limbloc rig plan --rig rig.yaml --out plan/
  limbloc rig plan --cameras 8 --room 5x5x2.8 --save proposal.yaml
  limbloc rig plan --cameras 6 --room 6x4x2.5 --view 90 --size 1920x1080
  limbloc rig plan --room 5x5x2.8 --compare 4 6 8 12 16      one line per number of cameras
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--rig", type=Path, help="rig file to look at")
    what.add_argument("--cameras", type=int, metavar="N", help="propose so many cameras (2 to 32)")
    what.add_argument("--compare", type=int, nargs="+", metavar="N", help="proposals of several sizes in one table")
    parser.add_argument("--room", default="5x5x2.8", metavar="LxWxH", help="the room, m (default: 5x5x2.8)")
    parser.add_argument(
        "--view", type=float, default=80.0, metavar="DEG", help="horizontal angle of view (default: 80)"
    )
    parser.add_argument("--size", default="1280x720", metavar="WxH", help="image size (default: 1280x720)")
    parser.add_argument("--person", choices=PERSON_NAMES, default="man", help="who stands there (default: man)")
    parser.add_argument("--out", type=Path, default=Path("out/plan"), help="folder of the pictures (default: out/plan)")
    parser.add_argument("--save", type=Path, metavar="YAML", help="write the proposal as a rig file, to start from")


def run(args: argparse.Namespace) -> int:
    """Do it."""
    if args.rig is None and args.cameras is None and args.compare is None:
        raise ConfigError("expected --rig FILE, --cameras N or --compare N N N")
    if args.save and args.cameras is None:
        raise ConfigError("--save: there is a proposal only with --cameras N")
    if args.compare:
        return _compare(args)
    rig = load_rig(args.rig) if args.rig else _proposal(args, args.cameras)
    coverage, fatness = _measure(rig, args.person)
    print(describe(rig))
    print(table({len(rig.cameras): (coverage, fatness)}))
    spots = blind_spots(coverage)
    for spot in spots:
        print(f"  blind: {spot}")
    if not spots:
        print("  no blind spots in the carve volume")
    if args.save:
        save_rig(rig, args.save)
        print(f"proposal: {args.save}")
    from limbloc_ros.rig.pictures import coverage_map, rig_picture

    pictures = {
        "rig.png": rig_picture(rig.cameras, rig.volume_min, rig.volume_max),
        "coverage.png": coverage_map(coverage, rig),
    }
    _write(args.out, pictures)
    return 0


def _proposal(args: argparse.Namespace, count: int) -> Rig:
    try:
        length, width, height = (float(word) for word in args.room.lower().split("x"))
    except ValueError:
        raise ConfigError(
            f"--room: expected LENGTHxWIDTHxHEIGHT in metres such as 5x5x2.8, got {args.room!r}"
        ) from None
    try:
        pixels = size(args.size)
    except ValueError:
        raise ConfigError(f"--size: expected WIDTHxHEIGHT in px, got {args.size!r}") from None
    return propose(count, (length, width, height), size=pixels, view_deg=args.view)


def _measure(rig: Rig, person: str) -> tuple[Coverage, Fatness]:
    body = load_person(person)
    coverage = cover_floor(rig)
    return coverage, hull_fatness(rig, body.vertices, body.faces, standing_places(coverage))


def _compare(args: argparse.Namespace) -> int:
    from limbloc_ros.rig.pictures import fatness_plot

    rows: dict[int, tuple[Coverage, Fatness]] = {}
    for count in tqdm(sorted(set(args.compare)), unit="rig", disable=None):
        rows[count] = _measure(_proposal(args, count), args.person)
    print(f"  room {args.room} m, {args.size} px, {args.view:g} degrees")
    print(table(rows))
    _write(args.out, {"fatness.png": fatness_plot(list(rows), [fatness.factors for _, fatness in rows.values()])})
    return 0


def _write(folder: Path, pictures: dict[str, bytes]) -> None:
    for name, data in pictures.items():
        write_bytes(folder / name, data)
    print(f"pictures: {', '.join(str(folder / name) for name in pictures)}")
