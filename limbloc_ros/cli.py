# SPDX-License-Identifier: Apache-2.0
"""The one command line for people: `python -m limbloc_ros`, `limbloc`, or `ros2 run limbloc_ros limbloc`."""

from __future__ import annotations

import argparse
import importlib
import signal
import sys
from collections.abc import Sequence

from limbloc_ros import __version__
from limbloc_ros.core import interrupts
from limbloc_ros.core.errors import Interrupted, LimblocError

#: Subcommand -> one line about it. Modules are imported when called, so that `process` needs no ROS.
COMMANDS = {
    "demo": "see it work: a simulated person, 8 cameras, the whole graph over real DDS",
    "run": "start the smart space on your cameras",
    "rig": "import, calibrate, check and plan the cameras of a room",
    "process": "work out the poses of a recording: a bag, videos, image folders or a benchmark case",
    "batch": "work out the poses of many recordings, here or on a Dask cluster",
    "replay": "play a bag into the running graph",
    "record": "record the running graph into a bag",
    "report": "make pictures and a page of a finished run",
    "export": "write a finished run for other programs: CSV, TRC, C3D, BVH, glTF, PLY, video",
    "view": "look at a finished run in 3D, in a window",
    "security": "write the SROS2 policy of a smart space",
}

EPILOG = """\
first steps:
  limbloc demo                                          no cameras needed, takes a minute
  limbloc process DIR --rig rig.yaml --out out/walk     poses of a folder of videos, one per camera
  limbloc COMMAND --help                                options and examples of a command

Exit codes: 0 done, 1 something failed on the way, 2 wrong input (one line says what was expected), 130 interrupted.
"""

EXIT_INPUT, EXIT_INTERRUPTED = 2, interrupts.EXIT_CODE


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code.

    Args:
        argv: arguments without the program's name; the process's own if None.
    """
    arguments = _joined(list(sys.argv[1:] if argv is None else argv))
    name = next((word for word in arguments if not word.startswith("-")), "")
    # While modules are imported there is nothing to clean up, and numpy would make an ImportError of an interrupt.
    ours = signal.signal(signal.SIGINT, signal.SIG_DFL)
    parser = _parser(name)
    signal.signal(signal.SIGINT, ours)
    args = parser.parse_args(arguments)
    if not args.command:
        _parser("").print_help()
        return EXIT_INPUT
    module = importlib.import_module(f"limbloc_ros.commands.{args.command}")
    # `kill` and a closing terminal end like Ctrl-C: files are finished, children stopped.
    interrupts.install((signal.SIGINT, signal.SIGTERM, signal.SIGHUP))
    try:
        return int(module.run(args))
    except LimblocError as error:
        print(f"limbloc {args.command}: {error}", file=sys.stderr)
        return EXIT_INTERRUPTED if isinstance(error, Interrupted) else EXIT_INPUT
    except KeyboardInterrupt:
        print(f"limbloc {args.command}: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    except ModuleNotFoundError as error:
        if error.name is None or error.name.startswith("limbloc_ros"):
            raise
        print(
            f"limbloc {args.command}: the Python module {error.name} is missing. ROS modules come with an apt ROS 2 "
            "(source /opt/ros/jazzy/setup.bash) or with `make setup`; all others with `pip install .`",
            file=sys.stderr,
        )
        return EXIT_INPUT


def _parser(name: str) -> argparse.ArgumentParser:
    """The parser, with the arguments of subcommand `name` only: the others' modules are not imported."""
    parser = argparse.ArgumentParser(
        prog="limbloc",
        description="Markerless 3D human posture from a few calibrated cameras.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"limbloc_ros {__version__}")
    subparsers = parser.add_subparsers(dest="command", metavar="COMMAND")
    for command, summary in COMMANDS.items():
        if command != name:
            subparsers.add_parser(command, help=summary, add_help=False)
            continue
        module = importlib.import_module(f"limbloc_ros.commands.{command}")
        subparser = subparsers.add_parser(
            command,
            help=summary,
            description=module.DESCRIPTION,
            epilog=module.EPILOG,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        module.add_arguments(subparser)
    return parser


def _joined(arguments: list[str]) -> list[str]:
    """`--up -y` as `--up=-y`: argparse would take the axis for another option."""
    joined: list[str] = []
    for word in arguments:
        if word in ("-x", "-y", "-z") and joined and joined[-1] == "--up":
            joined[-1] += f"={word}"
        else:
            joined.append(word)
    return joined
