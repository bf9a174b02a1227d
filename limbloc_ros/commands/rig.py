# SPDX-License-Identifier: Apache-2.0
"""`limbloc rig`: everything about the calibrated cameras of a room."""

from __future__ import annotations

import argparse
import importlib

DESCRIPTION = """\
The cameras of a room: read what another tool calibrated, calibrate with a board, find out whether it is right, and
plan where cameras should hang. The result is a rig file, see docs/rig_file.md.
"""

EPILOG = """\
examples:
  limbloc rig import Calib.qca.txt --out rig.yaml       from Qualisys, Kalibr, multical, Pose2Sim, ROS, ...
  limbloc rig calibrate board/ --board charuco:7x5:0.08:0.06 --out rig.yaml
  limbloc rig check bags/walk --rig rig.yaml            is it right? which camera is not?
  limbloc rig plan --cameras 8 --room 5x5x2.8           where to hang them, and what to expect
  limbloc rig ACTION --help                             options and examples of each
"""

#: Action -> one line about it.
ACTIONS = {
    "import": "read another tool's calibration and make a rig file of it",
    "export": "write a rig file for another tool",
    "calibrate": "calibrate all cameras with a checkerboard or ChArUco board",
    "check": "find out from footage of a person whether a rig file is right, and which camera is not",
    "plan": "where to hang cameras, what they see, and how fat the hull will be",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the actions and their arguments."""
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    for action, summary in ACTIONS.items():
        module = importlib.import_module(f"limbloc_ros.commands.rig_{action}")
        module.add_arguments(
            actions.add_parser(
                action,
                help=summary,
                description=module.DESCRIPTION,
                epilog=module.EPILOG,
                formatter_class=argparse.RawDescriptionHelpFormatter,
            )
        )


def run(args: argparse.Namespace) -> int:
    """Do it."""
    return int(importlib.import_module(f"limbloc_ros.commands.rig_{args.action}").run(args))
