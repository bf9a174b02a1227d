# SPDX-License-Identifier: Apache-2.0
"""`limbloc rig import`: another tool's calibration -> a rig file."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np

from limbloc_ros.core.camera import Rig
from limbloc_ros.core.errors import ConfigError, InputError
from limbloc_ros.recordings.bag_calibration import bag_intrinsics, bag_transforms
from limbloc_ros.recordings.bags import is_bag
from limbloc_ros.recordings.videos import VIDEO_SUFFIXES, ImageFolder, Stream, Video, pictures_in
from limbloc_ros.rig.formats import FORMATS, recognise
from limbloc_ros.rig.formats.common import CAMERA_TO_WORLD, WORLD_TO_CAMERA, Reading
from limbloc_ros.rig.formats.ros import read_transforms, with_poses
from limbloc_ros.rig.importing import AXES, FITS, UNITS, Wishes, settle
from limbloc_ros.rig.rig_file import save_rig

T = TypeVar("T")

DESCRIPTION = (
    """\
Read a calibration that another tool made and write our rig file: metres, z up, the floor at z = 0, the pose of each
camera's optical frame. FILE is one of

"""
    + "\n".join(f"  {name:11s} {entry.title}" for name, entry in FORMATS.items())
    + """
  (a bag)     CameraInfo topics and /tf_static

Units, direction and up are what the format documents, and each is checked against the cameras' geometry: do they look
at one place, is it at a room's distance, are their images upright. Where the format leaves something open, or the
geometry contradicts it, nothing is guessed: an option is asked for, and the message says what was seen.
"""
)

EPILOG = """\
examples:
  limbloc rig import Calib.qca.txt --out rig.yaml
  limbloc rig import Calib.qca.txt --images videos/ --fit letterbox --out rig.yaml    the videos were rescaled since
  limbloc rig import Calib.toml --rename int_cam01_img=cam01 --out rig.yaml
  limbloc rig import calibration.toml --unit mm --up -y --camera-height A=1.6 --out rig.yaml
  limbloc rig import cam0/ost.yaml cam1/ost.yaml --tf tf_static.yaml --world-frame room --out rig.yaml
  limbloc rig import bags/walk --out rig.yaml
  limbloc rig import camchain.yaml --up cameras --camera-height cam0=1.8 --out rig.yaml

Then look at it (`limbloc rig plan --rig rig.yaml`) and check it with footage (`limbloc rig check`).
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("files", type=Path, nargs="+", metavar="FILE", help="calibration file(s), folder or bag")
    parser.add_argument("--out", type=Path, default=Path("rig.yaml"), help="the rig file to write (default: rig.yaml)")
    parser.add_argument("--format", choices=tuple(FORMATS), help="which tool's (default: recognised)")
    parser.add_argument("--unit", choices=tuple(UNITS), help="unit of length in the file")
    parser.add_argument(
        "--direction", choices=(WORLD_TO_CAMERA, CAMERA_TO_WORLD), help="what the poses in the file take to what"
    )
    parser.add_argument(
        "--up", choices=(*AXES, "cameras"), help="the file's axis that points up, or: level by the images"
    )
    parser.add_argument("--floor", type=float, metavar="METRES", help="height of the floor in the file's world")
    add_pairs(parser, "--camera-height", "CAM=METRES", "height of a camera above the floor, in place of --floor")
    add_pairs(parser, "--size", "[CAM=]WxH", "size of the images, where the file lacks it or they were scaled since")
    parser.add_argument("--images", type=Path, metavar="DIR", help="take the sizes from the videos or pictures there")
    parser.add_argument("--fit", choices=FITS, help="how images of another shape were made of the calibrated ones")
    add_pairs(parser, "--rename", "OLD=NEW", "call a camera otherwise; videos and topics must have its name")
    parser.add_argument(
        "--volume", type=float, nargs=6, metavar=("X0", "Y0", "Z0", "X1", "Y1", "Z1"), help="the carve volume, m"
    )
    tf = parser.add_argument_group("poses from TF (for ROS calibrations)")
    tf.add_argument("--tf", type=Path, help="static transforms: YAML, static_transform_publisher lines, or a bag")
    tf.add_argument("--world-frame", help="the room's frame (default: the one without a parent)")
    add_pairs(tf, "--frame", "CAM=FRAME", "a camera's frame (default: found by its name)")
    tf.add_argument("--body-frames", action="store_true", help="the cameras' frames look along x, with z up")


def add_pairs(parser: argparse._ActionsContainer, option: str, form: str, text: str) -> None:
    """An option that may come several times, with pairs KEY=VALUE."""
    parser.add_argument(option, action="append", nargs="+", default=[], metavar=form, help=text)


def pairs(
    groups: Sequence[Sequence[str]], option: str, convert: Callable[[str], T], bare: bool = False
) -> dict[str, T]:
    """KEY=VALUE words -> mapping.

    Args:
        groups: what argparse collected.
        option: how messages call it.
        convert: text -> value; may raise ValueError.
        bare: a word without `=` is the value of the key ``.

    Raises:
        ConfigError: a word of another form.
    """
    found = {}
    for word in (word for group in groups for word in group):
        key, equals, value = word.rpartition("=")
        try:
            if not (equals or bare):
                raise ValueError
            found[key] = convert(value)
        except ValueError:
            raise ConfigError(f"{option}: expected {'VALUE or ' if bare else ''}KEY=VALUE, got {word!r}") from None
    return found


def size(text: str) -> tuple[int, int]:
    """`1080x1920` -> (1080, 1920); raises ValueError."""
    width, height = (int(word) for word in text.lower().split("x"))
    if min(width, height) < 1:
        raise ValueError
    return width, height


def run(args: argparse.Namespace) -> int:
    """Do it."""
    reading = read(args)
    names = pairs(args.rename, "--rename", str)
    sizes = pairs(args.size, "--size", size, bare=True)
    if args.images:
        known = [names.get(camera.name, camera.name) for camera in reading.cameras]
        sizes = {**sizes_of(args.images, known), **sizes}
    volume = None if args.volume is None else (np.array(args.volume[:3]), np.array(args.volume[3:]))
    heights = pairs(args.camera_height, "--camera-height", float)
    rig, said = settle(
        reading, Wishes(args.unit, args.direction, args.up, args.floor, heights, sizes, args.fit, names, volume)
    )
    save_rig(rig, args.out)
    print("\n".join(f"  {line}" for line in said))
    print(describe(rig))
    print(f"rig file: {args.out}")
    return 0


def read(args: argparse.Namespace) -> Reading:
    """What the files say, with poses from TF where they are asked for."""
    frames = pairs(args.frame, "--frame", str)
    if len(args.files) == 1 and is_bag(args.files[0]):
        reading, found = bag_intrinsics(args.files[0])
        frames = {**found, **frames}
        tf = args.tf or args.files[0]
    else:
        form = FORMATS[args.format] if args.format else recognise(args.files)
        reading, tf = form.read(args.files), args.tf
    if tf is None:
        return reading
    transforms = bag_transforms(tf) if is_bag(tf) else read_transforms(tf)
    return with_poses(reading, transforms, frames, args.world_frame, args.body_frames)


def sizes_of(folder: Path, names: Sequence[str]) -> dict[str, tuple[int, int]]:
    """Camera -> width, height of its video or pictures in `folder`.

    Raises:
        InputError: no such folder, or nothing in it has a camera's name.
    """
    if not folder.is_dir():
        raise InputError(f"--images {folder}: expected a folder with videos or pictures named like the cameras")
    found = {}
    for child in sorted(folder.iterdir()):
        name = child.name if child.is_dir() else child.stem
        stream: Stream | None = None
        if name not in names:
            continue
        if child.is_dir() and pictures_in(child):
            stream = ImageFolder(child)
        elif child.suffix.lower() in VIDEO_SUFFIXES:
            stream = Video(child)
        if stream is not None:
            _, pixels = next(stream.read(list(stream.numbers)[:1]))
            found[name] = (pixels.shape[1], pixels.shape[0])
    if not found:
        raise InputError(f"--images {folder}: nothing in it is named like a camera ({', '.join(names)}); see --rename")
    return found


def describe(rig: Rig) -> str:
    """The cameras in a table."""
    lines = ["  camera          size        focal px   stands at m               looks down deg  lens"]
    for camera in rig.cameras:
        x, y, z = camera.T_world_camera[:3, 3]
        down = np.degrees(np.arcsin(np.clip(-camera.T_world_camera[2, 2], -1, 1)))
        lines.append(
            f"  {camera.name:15s} {f'{camera.width}x{camera.height}':11s} {camera.K[0, 0]:8.1f}   "
            f"{x:7.3f} {y:7.3f} {z:7.3f}   {down:14.1f}  {camera.distortion_model}"
        )
    low, high = (" ".join(f"{v:.2f}" for v in corner) for corner in (rig.volume_min, rig.volume_max))
    return "\n".join([*lines, f"  carve volume from {low} to {high} m"])
