# SPDX-License-Identifier: Apache-2.0
"""`limbloc replay`: a bag into the running graph."""

from __future__ import annotations

import argparse

DESCRIPTION = """\
Publish a recording (rosbag2, MCAP or sqlite3) with /clock, so that a running smart space works on it as if live. To
start the smart space and the replay together, use `limbloc run --source bag --bag BAG --rig RIG`.
"""

EPILOG = """\
examples:
  limbloc replay bags/walk --rate 0.5 --loop
  limbloc replay bags/walk --stepped        waits for each result: the same angles every time, on any machine
  limbloc replay bags/walk --start 12 --duration 3
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("bag", metavar="BAG", help="rosbag2 folder, or an .mcap or .db3 file")
    parser.add_argument("--stepped", action="store_true", help="wait for the result of each set of images")
    parser.add_argument("--rate", type=float, default=1.0, help="pace, 2 is twice as fast (default: 1)")
    parser.add_argument("--start", type=float, default=0.0, metavar="S", help="skip the first S seconds")
    parser.add_argument("--duration", type=float, default=0.0, metavar="S", help="only S seconds (default: to the end)")
    parser.add_argument("--loop", action="store_true", help="begin again at the end")
    parser.add_argument(
        "--select",
        choices=("inputs", "images", "masks", "all"),
        default="inputs",
        help="what is published (default: images and what belongs to them, or masks where there are no images)",
    )
    parser.add_argument(
        "--topics", nargs="+", metavar="NAME", help="topics or regular expressions, in place of --select"
    )


def run(args: argparse.Namespace) -> int:
    """Do it."""
    from limbloc_ros.commands._nodes import run_node
    from limbloc_ros.nodes import replay

    parameters = {
        "bag": args.bag,
        "mode": "stepped" if args.stepped else "realtime",
        "rate": args.rate,
        "start_s": args.start,
        "duration_s": args.duration,
        "loop": args.loop,
        "select": args.select,
        "topics": args.topics,
    }
    return run_node(replay.main, parameters)
