# SPDX-License-Identifier: Apache-2.0
"""Messages in the form in which they are sent (CDR), read and written without rclpy's conversion.

rclpy makes a C structure of a message and bytes of that, and the other way round. Of images with 0.9 MB, whose pixels
are copied each time, that takes 0.2 ms to publish one and 0.15 to receive one; of masks with 1 KB 0.05 each; of 25
joints, all of them Python objects, 0.35. What is read has the fields of the messages (`core.images` reads pixels from
it), and the stamp in ns.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CompressedImage, Image

from limbloc_ros.core.errors import InputError
from limbloc_ros.core.images import Pixels
from limbloc_ros.core.mask_png import encode_mask
from limbloc_ros.core.pose import JOINT_NAMES
from limbloc_ros.core.synchroniser import NANOSECONDS
from limbloc_ros.ros.image_messages import MASK_FORMAT, pixels_to_image
from limbloc_ros.ros.messages import make_header


@dataclass
class SentImage:
    """A sensor_msgs/Image that came; `data` is a view of its bytes."""

    stamp_ns: int
    frame_id: str
    height: int
    width: int
    encoding: str
    is_bigendian: int
    step: int
    data: memoryview


@dataclass
class SentCompressed:
    """A sensor_msgs/CompressedImage that came; `data` is a view of its bytes."""

    stamp_ns: int
    frame_id: str
    format: str
    data: memoryview


def read_sent(kind: type[Image] | type[CompressedImage], cdr: bytes | bytearray) -> SentImage | SentCompressed:
    """What a raw subscription to messages of this kind got.

    Raises:
        InputError: the bytes are no such message.
    """
    try:
        fields = _Fields(cdr)
        stamp_ns, frame_id = fields.number("i") * NANOSECONDS + fields.number(), fields.text()
        if kind is CompressedImage:
            return SentCompressed(stamp_ns, frame_id, fields.text(), fields.data())
        height, width, encoding = fields.number(), fields.number(), fields.text()
        return SentImage(
            stamp_ns, frame_id, height, width, encoding, fields.number("B"), fields.number(), fields.data()
        )
    except (struct.error, UnicodeDecodeError, IndexError) as error:
        raise InputError(
            f"expected a sensor_msgs/{kind.__name__}, got {len(cdr)} bytes that begin with {cdr[:8].hex(' ')}: {error}"
        ) from None


class _Fields:
    """Reads the fields of a message one after the other."""

    def __init__(self, cdr: bytes | bytearray) -> None:
        self._cdr, self._at = cdr, 4  # numbers are aligned from there on, which is aligned itself
        self._order = "<" if cdr[1] else ">"

    def number(self, kind: str = "I") -> int:
        size = struct.calcsize(kind)
        at = -(-self._at // size) * size
        self._at = at + size
        return int(struct.unpack_from(self._order + kind, self._cdr, at)[0])

    def text(self) -> str:
        return bytes(self.data()[:-1]).decode()  # it ends with a zero

    def data(self) -> memoryview:
        size = self.number()
        self._at += size
        if self._at > len(self._cdr):
            raise IndexError(f"{self._at - len(self._cdr)} bytes are missing")
        return memoryview(self._cdr)[self._at - size : self._at]


def mask_cdr(mask: Pixels, stamp_ns: int, frame_id: str) -> bytes:
    """What publishes the same as `image_messages.mask_to_compressed`."""
    cdr = _begin(stamp_ns, frame_id)
    for field in (MASK_FORMAT.encode() + b"\0", encode_mask(mask)):
        _add(cdr, field)
    return bytes(cdr)


def joints_cdr(joints: NDArray[np.float64] | None, stamp_ns: int, frame_id: str) -> bytes:
    """What publishes the same as `messages.joints_to_message`, joints of another shape than [25, 3] refused."""
    if joints is not None and joints.shape != (len(JOINT_NAMES), 3):
        raise InputError(f"expected joints of shape ({len(JOINT_NAMES)}, 3), got {joints.shape}")
    poses = np.zeros((0 if joints is None else len(joints), 7))  # x y z, and a quaternion x y z w
    if joints is not None:
        poses[:, :3], poses[:, 6] = joints, 1.0
    cdr = _begin(stamp_ns, frame_id)
    cdr += bytes(-len(cdr) % 4) + struct.pack("<I", len(poses))
    if len(poses):
        cdr += bytes((4 - len(cdr)) % 8)  # doubles are aligned behind the first four bytes
    return bytes(cdr + poses.astype("<f8").tobytes())


def _begin(stamp_ns: int, frame_id: str) -> bytearray:
    """A little-endian message as far as its header goes."""
    cdr = bytearray(struct.pack("<4BiI", 0, 1, 0, 0, *divmod(stamp_ns, NANOSECONDS)))
    _add(cdr, frame_id.encode() + b"\0")
    return cdr


def _add(cdr: bytearray, field: bytes) -> None:
    """A text with its zero, or bytes."""
    cdr += bytes(-len(cdr) % 4) + struct.pack("<I", len(field)) + field


class StampedCdr:
    """A message that begins with a header, made once: then only its stamp changes."""

    def __init__(self, msg: Any) -> None:
        self._cdr = bytearray(serialize_message(msg))

    def stamped(self, stamp_ns: int) -> bytes:
        """The message of this instant, to be published as it is."""
        struct.pack_into("<iI", self._cdr, 4, *divmod(stamp_ns, NANOSECONDS))
        return bytes(self._cdr)


class ImageCdr(StampedCdr):
    """A camera's sensor_msgs/Image (bgr8), of which only stamp and pixels change.

    Attributes:
        pixels: uint8 [height, width, 3], to be drawn into.
    """

    def __init__(self, height: int, width: int, frame_id: str) -> None:
        empty = np.zeros((height, width, 3), np.uint8)
        super().__init__(pixels_to_image(empty, make_header(0, frame_id)))
        data = read_sent(Image, self._cdr).data
        self.pixels: Pixels = np.frombuffer(data, np.uint8).reshape(empty.shape)
