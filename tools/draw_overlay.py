# SPDX-License-Identifier: Apache-2.0
"""Draw the stick figure of one frame of a run over the images of all its cameras.

    python tools/draw_overlay.py out/walk --frame 20 --out docs/images/walk.jpg

OUT is the folder that `limbloc process` wrote; it keeps the images of some two dozen frames, and the nearest of them
is drawn. The person's left is blue, right orange.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import cv2

from limbloc_ros.core.errors import InputError, LimblocError
from limbloc_ros.core.pose import Pose
from limbloc_ros.export.stick_drawing import Image
from limbloc_ros.recordings.kept_frames import KeptFrames
from limbloc_ros.recordings.results import Run
from limbloc_ros.report.overlay import overlay_montage
from limbloc_ros.rig.rig_file import load_rig


def draw(run_folder: Path, frame: int, *, flesh: bool, close_up: bool, width_px: int) -> tuple[Image, int]:
    """The picture (uint8 bgr) and the number of the frame that it shows.

    Raises:
        InputError: no run, none of its frames with images has a pose.
    """
    run, kept = Run.load(run_folder), KeptFrames.load(run_folder)
    drawable = [n for n in kept.numbers if isinstance(run.frames[n].outcome, Pose)]
    if not drawable:
        raise InputError(f"{run_folder}: none of its {len(kept.numbers)} kept frames has a pose")
    number = min(drawable, key=lambda n: abs(n - frame))
    pose = run.frames[number].outcome
    assert isinstance(pose, Pose)
    picture = overlay_montage(
        kept.images(number),
        load_rig(run_folder / "rig.yaml"),
        pose.joints,
        pose.flesh if flesh else None,
        columns=4,
        panel_width_px=width_px,
        close_up=close_up,
    )
    return picture, number


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="folder that `limbloc process` wrote")
    parser.add_argument("--frame", type=int, default=0, help="row of the results")
    parser.add_argument("--out", type=Path, required=True, help="picture to write, .jpg or .png")
    parser.add_argument("--flesh", action="store_true", help="draw the flesh figure too")
    parser.add_argument("--close-up", action="store_true", help="only the part of each image around the person")
    parser.add_argument("--width", type=int, default=300, metavar="PX", help="of each camera's panel (default: 300)")
    args = parser.parse_args()
    try:
        picture, number = draw(args.run, args.frame, flesh=args.flesh, close_up=args.close_up, width_px=args.width)
    except LimblocError as error:
        print(f"draw_overlay: {error}", file=sys.stderr)
        return 1
    quality = [cv2.IMWRITE_JPEG_QUALITY, 85] if args.out.suffix.lower() in (".jpg", ".jpeg") else []
    if not cv2.imwrite(str(args.out), picture, quality):
        print(f"draw_overlay: {args.out} cannot be written", file=sys.stderr)
        return 1
    print(f"frame {number} in {args.out}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
