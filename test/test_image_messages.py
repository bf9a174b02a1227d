# SPDX-License-Identifier: Apache-2.0
"""Images, masks and CameraInfo as messages: against pixels worked by hand, truncated at every byte."""

from __future__ import annotations

import struct
from array import array

import cv2
import numpy as np
import pytest
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from limbloc_ros.core.camera import Camera
from limbloc_ros.core.errors import InputError, RigError
from limbloc_ros.ros import messages
from limbloc_ros.ros.image_messages import (
    camera_to_info,
    compressed_to_pixels,
    image_to_pixels,
    info_to_camera,
    mask_to_compressed,
    mask_to_image,
    message_to_mask,
    pixels_to_compressed,
    pixels_to_image,
)

HEADER = messages.make_header(1_700_000_000_123_456_789, "room")


def image(encoding: str, width: int, height: int, step: int, data: bytes, big_endian: int = 0) -> Image:
    return Image(
        width=width, height=height, encoding=encoding, step=step, is_bigendian=big_endian, data=array("B", data)
    )


# --- raw images ---


@pytest.mark.parametrize(
    ("encoding", "pixel", "bgr"),
    [
        ("bgr8", [10, 20, 30], [10, 20, 30]),
        ("8UC3", [10, 20, 30], [10, 20, 30]),
        ("rgb8", [10, 20, 30], [30, 20, 10]),
        ("bgra8", [10, 20, 30, 99], [10, 20, 30]),
        ("rgba8", [10, 20, 30, 99], [30, 20, 10]),
        ("bgr16", [0x34, 0x12, 0x78, 0x56, 0xBC, 0x9A], [0x12, 0x56, 0x9A]),
        ("rgb16", [0x34, 0x12, 0x78, 0x56, 0xBC, 0x9A], [0x9A, 0x56, 0x12]),
    ],
)
def test_colour_encodings_give_bgr_and_skip_the_padding(encoding: str, pixel: list[int], bgr: list[int]) -> None:
    row = bytes(pixel * 2) + b"\xee" * 5
    pixels = image_to_pixels(image(encoding, 2, 3, len(row), row * 3))
    np.testing.assert_array_equal(pixels, np.tile(np.uint8(bgr), (3, 2, 1)))


@pytest.mark.parametrize(
    ("encoding", "big_endian", "data", "grey"),
    [
        ("mono8", 0, [1, 2, 3, 4], [[1, 2], [3, 4]]),
        ("8UC1", 0, [1, 2, 3, 4], [[1, 2], [3, 4]]),
        ("mono16", 0, [0xFF, 1, 0, 2, 0, 3, 0, 4], [[1, 2], [3, 4]]),
        ("mono16", 1, [1, 0xFF, 2, 0, 3, 0, 4, 0], [[1, 2], [3, 4]]),
    ],
)
def test_grey_encodings_stay_one_channel(
    encoding: str, big_endian: int, data: list[int], grey: list[list[int]]
) -> None:
    np.testing.assert_array_equal(image_to_pixels(image(encoding, 2, 2, len(data) // 2, bytes(data), big_endian)), grey)


#: BT.601 studio swing: white, black and pure red.
WHITE, BLACK, RED = (235, 128, 128), (16, 128, 128), (81, 90, 240)


@pytest.mark.parametrize(("yuv", "bgr"), [(WHITE, (255, 255, 255)), (BLACK, (0, 0, 0)), (RED, (0, 0, 254))])
def test_yuv_encodings(yuv: tuple[int, int, int], bgr: tuple[int, int, int]) -> None:
    y, u, v = yuv
    expected = np.tile(np.uint8(bgr), (2, 2, 1)).astype(int)
    packed = {
        "uyvy": [u, y, v, y],
        "yuv422": [u, y, v, y],
        "yuyv": [y, u, y, v],
        "yuv422_yuy2": [y, u, y, v],
    }
    for encoding, row in packed.items():
        pixels = image_to_pixels(image(encoding, 2, 2, 4, bytes(row * 2)))
        assert np.abs(pixels - expected).max() <= 1, encoding
    planes = {"nv12": [y] * 4 + [u, v], "nv21": [y] * 4 + [v, u]}
    for encoding, data in planes.items():
        for height in (2, 3):  # drivers count the colour plane in or not
            pixels = image_to_pixels(image(encoding, 2, height, 2, bytes(data)))
            assert pixels.shape == (2, 2, 3)
            assert np.abs(pixels - expected).max() <= 1, encoding


@pytest.mark.parametrize(
    ("pattern", "at"),
    [("rggb", (0, 0)), ("bggr", (1, 1)), ("gbrg", (1, 0)), ("grbg", (0, 1))],
)
@pytest.mark.parametrize("bits", [8, 16])
def test_bayer_red_sites_become_red(pattern: str, at: tuple[int, int], bits: int) -> None:
    mosaic = np.zeros((8, 8), np.uint8)
    mosaic[at[0] :: 2, at[1] :: 2] = 200
    data = mosaic.tobytes() if bits == 8 else (mosaic.astype("<u2") << 8).tobytes()
    pixels = image_to_pixels(image(f"bayer_{pattern}{bits}", 8, 8, 8 * bits // 8, data))
    np.testing.assert_array_equal(pixels[2:6, 2:6], np.tile(np.uint8([0, 0, 200]), (4, 4, 1)))


@pytest.mark.parametrize(
    ("msg", "words"),
    [
        (image("32FC1", 2, 2, 8, bytes(16)), ["32FC1", "mono8"]),
        (image("bgr8", 4, 4, 12, bytes(40)), ["48 bytes", "got 40", "truncated"]),
        (image("bgr8", 4, 4, 11, bytes(48)), ["12 bytes", "11"]),
        (image("mono8", 0, 4, 0, b""), ["0x4"]),
        (image("mono8", 100_000, 100_000, 100_000, bytes(10)), ["100000x100000"]),
        (image("yuyv", 3, 2, 6, bytes(12)), ["3x2", "even"]),
        (image("nv12", 2, 2, 2, bytes(5)), ["nv12", "5 bytes"]),
    ],
)
def test_bad_images_are_refused_with_expected_and_got(msg: Image, words: list[str]) -> None:
    with pytest.raises(InputError) as caught:
        image_to_pixels(msg)
    for word in words:
        assert word in str(caught.value)


def test_missing_padding_of_the_last_row_is_accepted() -> None:
    pixels = image_to_pixels(image("mono8", 2, 2, 4, bytes([1, 2, 0, 0, 3, 4])))
    np.testing.assert_array_equal(pixels, [[1, 2], [3, 4]])


def test_pixels_to_image_lays_out_rows() -> None:
    pixels = np.arange(12, dtype=np.uint8).reshape(2, 2, 3)
    msg = pixels_to_image(pixels, HEADER)
    assert (msg.encoding, msg.width, msg.height, msg.step, bytes(msg.data)) == ("bgr8", 2, 2, 6, bytes(range(12)))
    assert messages.stamp_ns(msg.header) == 1_700_000_000_123_456_789
    grey = pixels_to_image(pixels[..., 0], HEADER)  # not contiguous
    assert (grey.encoding, grey.step, bytes(grey.data)) == ("mono8", 2, bytes([0, 3, 6, 9]))


# --- compressed images ---


def photo() -> np.ndarray:
    y, x = np.mgrid[0:120, 0:160]
    return np.stack([x, y * 2, (x + y) // 2], axis=-1).astype(np.uint8)


def test_jpeg_round_trip_and_name() -> None:
    msg = pixels_to_compressed(photo(), HEADER)
    assert msg.format == "bgr8; jpeg compressed bgr8"
    assert np.abs(compressed_to_pixels(msg).astype(int) - photo()).mean() < 3


def test_every_truncation_of_a_jpeg_is_refused() -> None:
    data = bytes(pixels_to_compressed(photo(), HEADER).data)
    for length in range(3, len(data) - 1, 7):
        with pytest.raises(InputError, match=r"JPEG image of .* bytes"):
            compressed_to_pixels(CompressedImage(format="jpeg", data=array("B", data[:length])))


def test_jpeg_with_zeros_behind_its_end_is_accepted() -> None:
    data = bytes(pixels_to_compressed(photo(), HEADER).data) + bytes(100)
    assert compressed_to_pixels(CompressedImage(format="jpeg", data=array("B", data))).shape == (120, 160, 3)


def test_every_truncation_of_a_png_is_refused() -> None:
    data = cv2.imencode(".png", photo())[1].tobytes()
    np.testing.assert_array_equal(compressed_to_pixels(CompressedImage(format="png", data=array("B", data))), photo())
    for length in range(8, len(data) - 8, 11):
        with pytest.raises(InputError, match=r"PNG image of .* bytes"):
            compressed_to_pixels(CompressedImage(format="png", data=array("B", data[:length])))


def test_a_picture_that_claims_to_be_huge_is_refused_before_it_is_decoded() -> None:
    data = bytearray(cv2.imencode(".png", photo())[1].tobytes())
    data[16:24] = struct.pack(">II", 60_000, 60_000)
    with pytest.raises(InputError, match="60000x60000"):
        compressed_to_pixels(CompressedImage(format="png", data=array("B", data)))


@pytest.mark.parametrize("data", [b"", b"RIFF....WEBP", bytes(1000)])
def test_other_formats_are_named(data: bytes) -> None:
    with pytest.raises(InputError, match=r"expected a JPEG or PNG image, got .* 'h264'"):
        compressed_to_pixels(CompressedImage(format="h264", data=array("B", data)))


# --- masks ---


@pytest.mark.parametrize("shape", [(480, 640), (7, 13), (1, 1)])
def test_masks_survive_both_ways_bit_for_bit(shape: tuple[int, int]) -> None:
    mask = np.where(np.random.default_rng(0).random(shape) < 0.3, 255, 0).astype(np.uint8)
    for msg in (mask_to_image(mask, HEADER), mask_to_compressed(mask, HEADER)):
        np.testing.assert_array_equal(message_to_mask(msg), mask)


def test_a_persons_mask_is_about_a_kilobyte_of_bilevel_png() -> None:
    mask = np.zeros((480, 640), np.uint8)
    cv2.ellipse(mask, (320, 240), (50, 180), 5, 0, 360, 255, -1)
    cv2.circle(mask, (320, 50), 30, 255, -1)
    data = bytes(mask_to_compressed(mask, HEADER).data)
    assert len(data) < 2000
    assert data[24] == 1  # bit depth in IHDR


def test_any_non_zero_value_is_foreground_and_colour_is_no_mask() -> None:
    np.testing.assert_array_equal(
        message_to_mask(image("mono8", 4, 1, 4, bytes([0, 1, 128, 255]))), [[0, 255, 255, 255]]
    )
    with pytest.raises(InputError, match="one channel"):
        message_to_mask(image("bgr8", 1, 1, 3, bytes(3)))


# --- cameras ---


@pytest.mark.parametrize(
    ("model", "name", "distortion"),
    [
        ("none", "plumb_bob", []),
        ("radtan", "plumb_bob", [0.1, -0.2, 0.01, 0.02, 0.3]),
        ("rational", "rational_polynomial", [0.1, -0.2, 0.01, 0.02, 0.3, 0.4, 0.5, 0.6]),
        ("fisheye", "equidistant", [0.1, -0.2, 0.01, 0.02]),
    ],
)
def test_camera_info_round_trip(model: str, name: str, distortion: list[float]) -> None:
    K = np.array([[500.0, 0, 319.5], [0, 510, 239.5], [0, 0, 1]])
    camera = Camera("a", 640, 480, K, np.eye(4), np.array(distortion), model)
    msg = camera_to_info(camera, HEADER)
    assert msg.distortion_model == name
    assert list(msg.p) == [500.0, 0, 319.5, 0, 0, 510, 239.5, 0, 0, 0, 1, 0]
    back = info_to_camera(msg, "a", np.eye(4))
    assert (back.width, back.height, back.distortion_model) == (640, 480, model)
    np.testing.assert_array_equal(back.K, K)
    np.testing.assert_array_equal(back.distortion, distortion)


def test_roi_and_binning_move_the_pixels() -> None:
    """A pixel (u, v) of the full image lies in the cropped and binned one at ((u - x + 0.5) / 2 - 0.5, ...)."""
    K = [500.0, 0.0, 319.5, 0.0, 500.0, 239.5, 0.0, 0.0, 1.0]
    msg = CameraInfo(width=640, height=480, k=K, distortion_model="plumb_bob", binning_x=2, binning_y=2)
    msg.roi.x_offset, msg.roi.y_offset, msg.roi.width, msg.roi.height = 100, 40, 400, 400
    camera = info_to_camera(msg, "a", np.eye(4))
    assert (camera.width, camera.height) == (200, 200)
    p = np.array([0.3, -0.2, 2.0])
    u, v = 500 * 0.15 + 319.5, 500 * -0.1 + 239.5
    np.testing.assert_allclose(
        camera.world_to_image(p)[0], [(u - 100 + 0.5) / 2 - 0.5, (v - 40 + 0.5) / 2 - 0.5], atol=1e-9
    )


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"k": [0.0] * 9}, ["camera cam3", "all-zero K", "camera_calibration"]),
        ({"distortion_model": "mystery", "d": [1.0]}, ["cam3", "mystery", "plumb_bob"]),
        ({"d": [0.1, 0.2]}, ["cam3", "4 or 5", "got 2"]),
        ({"distortion_model": "", "d": [0.1, 0.2, 0, 0]}, ["cam3", "no distortion_model", "4 coefficients"]),
        ({"width": 0}, ["cam3", "0x480"]),
    ],
)
def test_unusable_camera_info_says_why(change: dict[str, object], words: list[str]) -> None:
    msg = CameraInfo(width=640, height=480, k=[500.0, 0, 320, 0, 500, 240, 0, 0, 1], distortion_model="plumb_bob")
    for key, value in change.items():
        setattr(msg, key, value)
    with pytest.raises(RigError) as caught:
        info_to_camera(msg, "cam3", np.eye(4))
    for word in words:
        assert word in str(caught.value)
