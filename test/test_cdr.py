# SPDX-License-Identifier: Apache-2.0
"""Messages as they are sent, read and written without rclpy: against what rclpy makes of them, cut at every byte."""

from __future__ import annotations

from array import array

import numpy as np
import pytest
from geometry_msgs.msg import PoseArray
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from limbloc_ros.core.errors import InputError
from limbloc_ros.core.pose import JOINT_NAMES
from limbloc_ros.ros import messages
from limbloc_ros.ros.cdr import ImageCdr, SentCompressed, SentImage, StampedCdr, joints_cdr, mask_cdr, read_sent
from limbloc_ros.ros.image_messages import mask_to_compressed, message_to_mask, message_to_pixels, pixels_to_image

STAMP = 1_700_000_000_123_456_789
FRAMES = ("", "a", "cam0", "cam10_optical", "Kamera_ö")  # of all lengths modulo four


def pixels(*shape: int) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)


def with_other_byte_order(cdr: bytes, *words: int) -> bytes:
    """The same message as a big-endian machine sends it; its 4-byte numbers begin at `words`."""
    swapped = bytearray(cdr)
    swapped[1] = 0
    for at in words:
        swapped[at : at + 4] = cdr[at : at + 4][::-1]
    return bytes(swapped)


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("shape", [(4, 6, 3), (3, 5)])
def test_an_image_is_read_as_rclpy_reads_it(frame: str, shape: tuple[int, ...]) -> None:
    picture = pixels(*shape)
    msg = pixels_to_image(picture, messages.make_header(STAMP, frame))
    sent = read_sent(Image, serialize_message(msg))
    assert isinstance(sent, SentImage)
    assert (sent.stamp_ns, sent.frame_id) == (STAMP, frame)
    for name in ("height", "width", "encoding", "is_bigendian", "step"):
        assert getattr(sent, name) == getattr(msg, name)
    np.testing.assert_array_equal(message_to_pixels(sent), picture)


@pytest.mark.parametrize("frame", FRAMES)
def test_a_mask_is_written_as_rclpy_writes_it_and_read_as_it_was(frame: str) -> None:
    mask = np.where(pixels(30, 43) < 50, 255, 0).astype(np.uint8)
    msg = mask_to_compressed(mask, messages.make_header(STAMP, frame))
    cdr = mask_cdr(mask, STAMP, frame)
    assert deserialize_message(cdr, CompressedImage) == msg
    assert len(cdr) == len(serialize_message(msg))
    sent = read_sent(CompressedImage, cdr)
    assert isinstance(sent, SentCompressed)
    assert (sent.stamp_ns, sent.frame_id, sent.format) == (STAMP, frame, msg.format)
    np.testing.assert_array_equal(message_to_mask(sent), mask)


@pytest.mark.parametrize("frame", [*FRAMES, "room", "room1", "room12", "room123"])
def test_joints_are_written_as_rclpy_writes_them(frame: str) -> None:
    joints = np.random.default_rng(0).normal(size=(len(JOINT_NAMES), 3))
    for found in (joints, None):
        cdr = joints_cdr(found, STAMP, frame)
        msg = messages.joints_to_message(found, messages.make_header(STAMP, frame))
        assert deserialize_message(cdr, PoseArray) == msg
        assert len(cdr) == len(serialize_message(msg))


def test_either_byte_order_is_read() -> None:
    cdr = serialize_message(CompressedImage(header=messages.make_header(STAMP, "abc"), format="png", data=b"12345"))
    sent = read_sent(CompressedImage, with_other_byte_order(cdr, 4, 8, 12, 20, 28))
    assert (sent.stamp_ns, sent.frame_id, sent.format, bytes(sent.data)) == (STAMP, "abc", "png", b"12345")


def test_a_message_that_ends_early_is_refused_and_no_text_is_read_as_one() -> None:
    header = messages.make_header(STAMP, "cam0")
    for msg in (
        pixels_to_image(pixels(2, 3, 3), header),
        CompressedImage(header=header, format="jpeg", data=b"1234567"),
    ):
        cdr = serialize_message(msg)
        for end in range(len(cdr)):
            with pytest.raises(InputError, match=f"expected a sensor_msgs/{type(msg).__name__}, got {end} bytes"):
                read_sent(type(msg), cdr[:end])
    header_only = bytearray(serialize_message(CompressedImage(header=header)))
    header_only[16] = 0xFF  # no UTF-8
    with pytest.raises(InputError, match="that begin with 00 01 00 00"):
        read_sent(CompressedImage, bytes(header_only))


def test_a_camera_draws_into_the_message_that_it_sends() -> None:
    image, picture = ImageCdr(4, 6, "cam0_optical"), pixels(4, 6, 3)
    for stamp in (STAMP, STAMP + 50_000_000):
        image.pixels[:] = picture = 255 - picture
        wanted = pixels_to_image(picture, messages.make_header(stamp, "cam0_optical"))
        assert deserialize_message(image.stamped(stamp), Image) == wanted


def test_a_message_is_stamped_anew() -> None:
    msg = CameraInfo(header=messages.make_header(1, "cam0"), width=640, d=array("d", [0.5]))
    cdr = StampedCdr(msg).stamped(STAMP)
    msg.header.stamp = messages.make_header(STAMP, "").stamp
    assert deserialize_message(cdr, CameraInfo) == msg
