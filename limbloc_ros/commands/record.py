# SPDX-License-Identifier: Apache-2.0
"""`limbloc record`: the running graph into a bag."""

from __future__ import annotations

import argparse

DESCRIPTION = """\
Record the running graph into a rosbag2 bag that `limbloc process`, `limbloc replay` and `ros2 bag play` read: the
cameras' images (compressed where a camera has them), masks, joints, joint states and diagnostics. Ctrl-C ends it; a
full disk ends it too, and the bag is complete up to there.
"""

EPILOG = """\
examples:
  limbloc record bags/walk
  limbloc record bags/walk --duration 60 --images none      masks and results only, about 1 MB a minute and camera
  limbloc record bags/walk --topics '/cam[0-3]/image_raw' /tf_static
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("bag", metavar="BAG", nargs="?", default="", help="folder to make (default: limbloc_<date>)")
    parser.add_argument("--duration", type=float, default=0.0, metavar="S", help="end after S seconds")
    parser.add_argument("--storage", choices=("mcap", "sqlite3"), default="mcap", help="file format (default: mcap)")
    parser.add_argument(
        "--images", choices=("auto", "raw", "compressed", "none"), default="auto", help="which images (default: auto)"
    )
    parser.add_argument("--topics", nargs="+", metavar="NAME", help="only these topics or regular expressions")
    parser.add_argument("--exclude", nargs="+", metavar="NAME", help="but not these")


def run(args: argparse.Namespace) -> int:
    """Do it."""
    from limbloc_ros.commands._nodes import run_node
    from limbloc_ros.nodes import record

    parameters = {
        "bag": args.bag,
        "duration_s": args.duration,
        "storage": args.storage,
        "images": args.images,
        "topics": args.topics,
        "exclude": args.exclude,
    }
    return run_node(record.main, parameters)
