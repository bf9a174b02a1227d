# SPDX-License-Identifier: Apache-2.0
"""`limbloc view`: a finished run in 3D, in a window."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from tqdm import tqdm

from limbloc_ros.core.errors import ConfigError
from limbloc_ros.export.recording import config_of, open_recording, recorded_frames, rig_of
from limbloc_ros.recordings.kept_frames import KeptFrames
from limbloc_ros.recordings.results import Run
from limbloc_ros.report.viewer_scene import COLOURS, LAYERS, Masks, Playback, RunScene
from limbloc_ros.report.viewer_window import Window, load_open3d, require_display, write_picture

DESCRIPTION = """\
Look at a run that `limbloc process` or `limbloc demo` left in RUN: scrub through its frames or play them; switch hull,
flesh figure, stick figure, path, cameras and floor on and off; colour the hull by geodesic distance or curvature.
Around a figure a plain hull is drawn as level lines, a coloured one hides it. Needs the extra `viewer` (Open3D). The
hull is there for the frames whose masks the run kept; with --recording for all.

Keys: left and right step, space plays, home and end go to the ends; drag turns, ctrl-drag moves, the wheel zooms.
"""

EPILOG = """\
examples:
  limbloc view out/walk
  limbloc view out/walk --recording videos/
  limbloc view out/walk --frame 28 --show hull sticks cameras --picture walk.png     no window, one picture
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("run", type=Path, metavar="RUN", help="folder with the results of `limbloc process`")
    parser.add_argument("--frame", type=int, default=0, metavar="N", help="frame to begin with (default: 0)")
    parser.add_argument("--show", nargs="+", choices=tuple(LAYERS), metavar="LAYER", help=f"of {', '.join(LAYERS)}")
    parser.add_argument("--colour", choices=COLOURS, default=COLOURS[0], help="of the hull (default: plain)")
    parser.add_argument("--recording", type=Path, help="read the masks of all frames from the bag, folder or case")
    parser.add_argument("--background", metavar="DIR", help="pictures of the empty room, if they have been moved")
    parser.add_argument("--picture", type=Path, metavar="FILE", help="write one picture instead of opening a window")


def run(args: argparse.Namespace) -> int:
    """Do it."""
    result = Run.load(args.run)
    if not 0 <= args.frame < len(result):
        raise ConfigError(f"--frame: expected 0 to {len(result) - 1}, got {args.frame}")
    if args.picture is None:
        require_display()
    load_open3d()  # say at once when it is missing
    scene = RunScene(result, rig_of(args.run), _masks(args, result), config_of(result).hull)
    playback = Playback(len(result), result.stamps - result.stamps[0], colour=args.colour)
    playback.go(args.frame)
    if args.show:
        playback.layers = set(args.show)
    if args.picture is not None:
        write_picture(scene, playback, args.picture)
        print(f"{scene.text(args.frame)}\npicture: {args.picture}")
        return 0
    Window(scene, playback, f"limbloc: {args.run}").run()
    return 0


def _masks(args: argparse.Namespace, result: Run) -> Masks:
    masks = Masks()
    if args.recording is None and args.background is None:
        kept = KeptFrames.load(args.run)
        for number in kept.numbers:
            masks.add(number, kept.masks(number))
        return masks
    source = open_recording(result, args.run, args.recording, args.background)
    for number, frame in tqdm(
        recorded_frames(source, result), desc="masks", total=len(result), unit="frame", disable=None
    ):
        masks.add(number, {name: np.asarray(mask) for name, mask in frame.masks.items()} if not frame.reason else {})
    return masks
