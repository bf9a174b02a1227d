# SPDX-License-Identifier: Apache-2.0
"""Write footage (a video or a folder of pictures per camera) as a rosbag2 recording.

`limbloc process` reads footage as it is; a bag is for the live graph, which then takes it for its cameras:

    python tools/footage_to_bag.py videos/ --rig rig.yaml --out bags/balance
    limbloc run --source bag --bag bags/balance --rig rig.yaml --set replay.mode=stepped

The bag has `/<camera>/image_raw/compressed` (or `image_raw`, or `mask/compressed`), `/<camera>/camera_info` and the
cameras' poses on `/tf_static`. Nothing is lost on the way: JPEG and PNG files are copied byte by byte, frames of videos
become PNG, unless --encoding says otherwise. Frames of one number have one stamp.
"""

from __future__ import annotations

import argparse
import heapq
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
from rclpy.serialization import serialize_message
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CompressedImage
from std_msgs.msg import Header
from tqdm import tqdm

from limbloc_ros.core.camera import Camera, Rig
from limbloc_ros.core.errors import InputError, LimblocError
from limbloc_ros.core.images import Pixels
from limbloc_ros.recordings.bags import TYPESTORE, BagWriter
from limbloc_ros.recordings.folder_source import DEFAULT_FPS, silhouette
from limbloc_ros.recordings.videos import ImageFolder, Stream, find_streams, read_picture
from limbloc_ros.rig.rig_file import load_rig
from limbloc_ros.ros import topics
from limbloc_ros.ros.image_messages import camera_to_info, mask_to_compressed, pixels_to_compressed, pixels_to_image
from limbloc_ros.ros.messages import make_header

IMAGE, COMPRESSED, INFO, TF = (
    "sensor_msgs/msg/Image",
    "sensor_msgs/msg/CompressedImage",
    "sensor_msgs/msg/CameraInfo",
    "tf2_msgs/msg/TFMessage",
)
KEPT_SUFFIXES = {".jpg": "jpeg", ".jpeg": "jpeg", ".png": "png"}
WORLD_FRAME = "room"


def write_bag(
    footage: Path,
    rig: Rig,
    out: Path,
    *,
    encoding: str = "auto",
    masks: bool = False,
    fps: float | None = None,
    numbers: Sequence[int] | None = None,
    start_s: float = 1e9,
    storage: str = "mcap",
    progress: bool = False,
) -> int:
    """Write the bag.

    Args:
        footage: folder with a video or a folder of pictures per camera.
        rig: the cameras.
        out: the bag's folder, which must not exist.
        encoding: `auto`, `raw`, `png` or `jpeg`.
        masks: the frames are silhouettes.
        fps: frame rate of picture folders, Hz.
        numbers: only these frames; all if None.
        start_s: stamp of the first frame, s.
        storage: `mcap` or `sqlite3`.
        progress: show a bar.

    Returns:
        How many frames were written, all cameras together.

    Raises:
        LimblocError: the footage cannot be read or the bag not be written.
    """
    streams = find_streams(footage, rig.names)
    rates = [stream.fps for stream in streams.values() if stream.fps]
    rate = fps or (sorted(rates)[len(rates) // 2] if rates else DEFAULT_FPS)
    known = sorted(set().union(*(stream.numbers for stream in streams.values())))
    wanted = known if numbers is None else sorted(set(known) & set(numbers))
    if not wanted:
        raise InputError(f"{footage}: none of the wanted frames is there; it has {known[0]} to {known[-1]}")
    merged = heapq.merge(*(_frames(name, s, wanted, encoding, masks) for name, s in streams.items()), key=_order)
    count = 0
    with BagWriter(out, storage) as bag:
        start_ns = round(start_s * 1e9)
        _write_poses(bag, rig, start_ns)
        for number, name, picture in tqdm(
            merged, total=len(wanted) * len(streams), unit="frame", disable=None if progress else True
        ):
            stamp_ns = start_ns + round((number - wanted[0]) * 1e9 / rate)
            header = make_header(stamp_ns, topics.optical_frame(name))
            topic, kind, message = _message(name, picture, header, encoding, masks)
            camera = rig.camera(name)
            _write(bag, f"/{topics.camera_info(name)}", INFO, stamp_ns, camera_to_info(camera, header))
            _write(bag, f"/{topic}", kind, stamp_ns, message)
            count += 1
    for stream in streams.values():
        for note in stream.notes:
            print(note, file=sys.stderr)
    return count


def _order(item: tuple[int, str, Path | Pixels]) -> tuple[int, str]:
    return item[:2]


def _frames(
    name: str, stream: Stream, wanted: Sequence[int], encoding: str, masks: bool
) -> Iterator[tuple[int, str, Path | Pixels]]:
    """(number, camera, file to be copied or pixels) in order."""
    if encoding == "auto" and not masks and isinstance(stream, ImageFolder):
        for number in wanted:
            file = stream.file(number)
            if file is not None:
                yield number, name, file if file.suffix.lower() in KEPT_SUFFIXES else read_picture(file)
        return
    for number, pixels in stream.read(wanted):
        yield number, name, pixels


def _message(name: str, picture: Path | Pixels, header: Header, encoding: str, masks: bool) -> tuple[str, str, Any]:
    """Topic, type and message of one frame."""
    compressed = topics.image_compressed(name), COMPRESSED
    if isinstance(picture, Path):
        kind = KEPT_SUFFIXES[picture.suffix.lower()]
        return *compressed, CompressedImage(
            header=header, format=f"bgr8; {kind} compressed bgr8", data=picture.read_bytes()
        )
    if masks:
        return topics.mask_compressed(name), COMPRESSED, mask_to_compressed(silhouette(picture), header)
    if encoding == "raw":
        return topics.image(name), IMAGE, pixels_to_image(picture, header)
    if encoding == "jpeg":
        return *compressed, pixels_to_compressed(picture, header, quality=95)
    _, data = cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    colour = "mono8" if picture.ndim == 2 else "bgr8"
    return *compressed, CompressedImage(header=header, format=f"{colour}; png compressed {colour}", data=data.tobytes())


def _write_poses(bag: BagWriter, rig: Rig, stamp_ns: int) -> None:
    """The cameras' poses, for a graph that takes its rig from CameraInfo and TF."""
    kinds = TYPESTORE.types  # tf2_msgs comes only with an installed ROS

    def pose(camera: Camera) -> Any:
        x, y, z = camera.T_world_camera[:3, 3].tolist()
        quaternion = Rotation.from_matrix(camera.T_world_camera[:3, :3]).as_quat().tolist()
        time = kinds["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
        return kinds["geometry_msgs/msg/TransformStamped"](
            header=kinds["std_msgs/msg/Header"](stamp=time, frame_id=WORLD_FRAME),
            child_frame_id=topics.optical_frame(camera.name),
            transform=kinds["geometry_msgs/msg/Transform"](
                translation=kinds["geometry_msgs/msg/Vector3"](x=x, y=y, z=z),
                rotation=kinds["geometry_msgs/msg/Quaternion"](*quaternion),
            ),
        )

    bag.add_topic("/tf_static", TF, latched=True)
    bag.write("/tf_static", stamp_ns, TYPESTORE.serialize_cdr(kinds[TF](transforms=[pose(c) for c in rig.cameras]), TF))


def _write(bag: BagWriter, topic: str, kind: str, stamp_ns: int, message: Any) -> None:
    bag.add_topic(topic, kind)
    bag.write(topic, stamp_ns, serialize_message(message))


def main(argv: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("footage", type=Path, help="folder with a video or a folder of pictures per camera")
    parser.add_argument("--rig", type=Path, required=True, help="rig YAML or calib.json; names the cameras")
    parser.add_argument("--out", type=Path, required=True, help="the bag's folder, which must not exist")
    parser.add_argument(
        "--encoding",
        choices=("auto", "raw", "png", "jpeg"),
        default="auto",
        help="auto: JPEG and PNG files as they are, anything else as PNG; jpeg is small but loses a little",
    )
    parser.add_argument("--masks", action="store_true", help="the frames are silhouettes: write mask/compressed topics")
    parser.add_argument("--fps", type=float, help="frame rate of picture folders, Hz (default: 25)")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="only every Nth frame")
    parser.add_argument("--first", type=int, default=0, metavar="N", help="begin with frame number N")
    parser.add_argument("--count", type=int, default=10**9, metavar="N", help="at most N frames of each camera")
    parser.add_argument("--start", type=float, default=1e9, metavar="S", help="stamp of the first frame (default: 1e9)")
    parser.add_argument("--storage", choices=("mcap", "sqlite3"), default="mcap")
    args = parser.parse_args(argv)
    stop = args.first + args.every * args.count
    try:
        count = write_bag(
            args.footage,
            load_rig(args.rig),
            args.out,
            encoding=args.encoding,
            masks=args.masks,
            fps=args.fps,
            numbers=range(args.first, min(stop, 10**7), args.every),
            start_s=args.start,
            storage=args.storage,
            progress=True,
        )
    except LimblocError as error:
        print(f"footage_to_bag: {error}", file=sys.stderr)
        return 1
    print(f"{count} frames in {args.out}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
