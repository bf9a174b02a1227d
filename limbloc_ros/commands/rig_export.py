# SPDX-License-Identifier: Apache-2.0
"""`limbloc rig export`: a rig file -> another tool's calibration."""

from __future__ import annotations

import argparse
from pathlib import Path

from limbloc_ros.rig.formats import FORMATS
from limbloc_ros.rig.rig_file import load_rig

DESCRIPTION = (
    """\
Write a rig file in another tool's format; what that cannot hold is said, and a lens that it cannot hold is refused.

"""
    + "\n".join(f"  {name:11s} {entry.title}" for name, entry in FORMATS.items() if entry.write)
    + "\n"
)

EPILOG = """\
examples:
  limbloc rig export rig.yaml --format anipose --out Calib.toml
  limbloc rig export rig.yaml --format ros --out calibration/      one YAML per camera and tf_static.yaml
  limbloc rig export rig.yaml --format easymocap --out easymocap/  intri.yml and extri.yml
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("rig", type=Path, metavar="RIG", help="rig file (or calib.json)")
    parser.add_argument("--format", required=True, choices=[n for n, f in FORMATS.items() if f.write], help="the tool")
    parser.add_argument("--out", type=Path, required=True, help="the file to write; a folder for ros and easymocap")


def run(args: argparse.Namespace) -> int:
    """Do it."""
    write = FORMATS[args.format].write
    assert write is not None
    for note in write(load_rig(args.rig), args.out):
        print(f"  note: {note}")
    print(f"{FORMATS[args.format].title}: {args.out}")
    return 0
