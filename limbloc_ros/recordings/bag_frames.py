# SPDX-License-Identifier: Apache-2.0
"""Sets of camera images or masks out of a rosbag2 recording, grouped by acquisition stamp as the live graph does."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core.config import SyncConfig
from limbloc_ros.core.errors import InputError
from limbloc_ros.core.images import compressed_to_pixels, image_to_pixels, message_to_mask
from limbloc_ros.core.synchroniser import NANOSECONDS, FrameSet, StampSynchroniser
from limbloc_ros.recordings.bags import BagReader, deserialise

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"

#: What a camera's topics may be called below its name, the best first. Small lossless masks before large ones.
MASK_ENDINGS = {"mask/compressed": COMPRESSED, "mask": IMAGE}
IMAGE_ENDINGS = {"image_raw": IMAGE, "image_raw/compressed": COMPRESSED}


@dataclass(frozen=True)
class CameraStream:
    """The topic that a camera's frames are read from; `is_mask` says that they are masks already."""

    camera: str
    topic: str
    type: str
    is_mask: bool


@dataclass(frozen=True)
class BagFrame:
    """One recorded frame, decoded when asked for."""

    stream: CameraStream
    stamp_ns: int
    cdr: bytes

    def pixels(self) -> NDArray[np.uint8]:
        """uint8 mask [height, width] (0 and 255), or image [height, width] (grey) or [height, width, 3] (BGR).

        Raises:
            InputError: the message or its picture is damaged.
        """
        msg = deserialise(self.stream.type, self.cdr, self.stream.topic)
        if self.stream.is_mask:
            return message_to_mask(msg)
        return image_to_pixels(msg) if self.stream.type == IMAGE else compressed_to_pixels(msg)


def camera_streams(bag: BagReader, cameras: Sequence[str], prefer: str = "masks") -> dict[str, CameraStream]:
    """The topic of every camera, in any namespace.

    Args:
        bag: an open recording.
        cameras: the names in the rig file.
        prefer: `masks` or `images`: what to take when the bag has both.

    Raises:
        InputError: a camera without topic (the bag's camera topics are listed), or several namespaces with the same
            camera.
    """
    masks, images = (_find(bag, cameras, endings) for endings in (MASK_ENDINGS, IMAGE_ENDINGS))
    is_mask = bool(masks) and (prefer == "masks" or not images)
    found = masks if is_mask else images
    if missing := [name for name in cameras if name not in found]:
        known = {**MASK_ENDINGS, **IMAGE_ENDINGS}
        others = sorted(t.name for t in bag.topics.values() if t.type in known.values())
        raise InputError(
            f"{bag.path} has no {'masks' if is_mask else 'images'} of camera {', '.join(missing)}: expected a topic "
            f"such as /{missing[0]}/{'mask' if is_mask else 'image_raw'}. Its image topics are "
            f"{', '.join(others) or 'none'}; name the cameras in the rig file like the topics"
        )
    return {name: CameraStream(name, found[name], bag.topics[found[name]].type, is_mask) for name in cameras}


def frame_sets(
    bag: BagReader,
    streams: Mapping[str, CameraStream],
    sync: SyncConfig | None = None,
    min_cameras: int = 1,
    synchroniser: StampSynchroniser[BagFrame] | None = None,
    damaged: dict[str, int] | None = None,
) -> Iterator[FrameSet[BagFrame]]:
    """Frames of one instant, in the order of their stamps, by the rules of the live carving node.

    Args:
        bag: an open recording.
        streams: what `camera_streams` found.
        sync: slop and queue.
        min_cameras: smaller sets are dropped.
        synchroniser: used in place of one made from `sync` and `min_cameras`, to read its counters afterwards.
        damaged: camera -> messages without a readable header, which are left out and counted here.

    Raises:
        InputError: such a message, when `damaged` is None.
    """
    if synchroniser is None:
        synchroniser = StampSynchroniser.from_config(tuple(streams), sync or SyncConfig(), min_cameras)
    by_topic = {stream.topic: stream for stream in streams.values()}
    for message in bag.messages(by_topic):
        stream = by_topic[message.topic]
        try:
            stamp_ns = header_stamp_ns(message.cdr, message.topic)
        except InputError:
            if damaged is None:
                raise
            damaged[stream.camera] = damaged.get(stream.camera, 0) + 1
            continue
        yield from synchroniser.add(stream.camera, stamp_ns, BagFrame(stream, stamp_ns, message.cdr))
    yield from synchroniser.flush()


def header_stamp_ns(cdr: bytes | memoryview, where: str = "message") -> int:
    """The acquisition stamp of a serialised message that begins with a std_msgs/Header, ns.

    Raises:
        InputError: too short, or no plain CDR.
    """
    if len(cdr) < 12 or cdr[0] != 0 or cdr[1] not in (0, 1):
        raise InputError(
            f"{where}: expected a CDR message with a header, got {len(cdr)} bytes {bytes(cdr[:4]).hex(' ')}"
        )
    sec, nanosec = struct.unpack_from("<iI" if cdr[1] else ">iI", cdr, 4)
    return int(sec) * NANOSECONDS + int(nanosec)


def _find(bag: BagReader, cameras: Sequence[str], endings: Mapping[str, str]) -> dict[str, str]:
    """Camera name -> topic, for the cameras that have one with such an ending and its type."""
    found: dict[str, str] = {}
    for camera in cameras:
        for ending, kind in endings.items():
            suffix = f"/{camera}/{ending}"
            topics = [t.name for t in bag.topics.values() if t.type == kind and t.count and t.name.endswith(suffix)]
            if len(topics) > 1:
                raise InputError(
                    f"{bag.path} has camera {camera} in several namespaces ({', '.join(sorted(topics))}); "
                    "expected one: record each room on its own"
                )
            if topics:
                found[camera] = topics[0]
                break
    return found
