# SPDX-License-Identifier: Apache-2.0
"""`limbloc run`: the smart space, live."""

from __future__ import annotations

import argparse

from limbloc_ros.nodes import smart_space

DESCRIPTION = """\
Start the whole smart space: segmentation of every camera, carving, pose, and what else the configuration asks for.
Camera drivers run already or come later; the posture is on /humans/bodies/p1/joint_states, /joints and /markers.
A process that dies is started again; Ctrl-C stops everything.
"""

EPILOG = smart_space.EXAMPLES.replace("  smart_space", "  limbloc run")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    smart_space.load()
    smart_space.add_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Do it."""
    return smart_space.run(smart_space.config_from_arguments(args))
