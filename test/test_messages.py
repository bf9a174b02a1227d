# SPDX-License-Identifier: Apache-2.0
"""Messages worked by hand: pixel values of every encoding, bytes of the clouds, and what must be refused."""

from __future__ import annotations

import dataclasses
import struct
from array import array

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2, PointField
from std_msgs.msg import Header
from visualization_msgs.msg import Marker

from limbloc_ros.core.camera import Camera
from limbloc_ros.core.engine_robust import outline_rays
from limbloc_ros.core.errors import InputError, RigError
from limbloc_ros.core.hull import NOBODY, Hull
from limbloc_ros.core.pose import JOINT, JOINT_NAMES, STICK_BONES, Flesh, Pose
from limbloc_ros.core.surface import extract_surface
from limbloc_ros.ros import messages
from limbloc_ros.ros.cloud_messages import (
    check_voxel_size,
    cloud_to_hull,
    empty_hull_cloud,
    hull_to_cloud,
    surface_to_cloud,
)
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


# --- hull ---


def ball(voxel_m: float = 0.02, radius_m: float = 0.3, centre: tuple[float, float, float] = (-0.5, 0.2, 1.0)) -> Hull:
    grid = np.indices((60, 60, 60)).transpose(1, 2, 3, 0)
    index_min = tuple(int(np.floor(c / voxel_m)) - 30 for c in centre)
    centres = (grid + np.array(index_min) + 0.5) * voxel_m
    sdf = np.linalg.norm(centres - centre, axis=-1) - radius_m
    raw = Hull(voxel_m, index_min, np.minimum(sdf, 0.06).astype(np.float32), 0.06)
    return Hull.from_shell(voxel_m, 0.06, *raw.shell())


def test_bytes_of_one_voxel() -> None:
    indices, sdf = np.array([[10, -3, 50]], np.int32), np.array([-0.25], np.float32)
    msg = hull_to_cloud(Hull.from_shell(0.02, 0.06, indices, sdf), HEADER)
    voxel = (0.21, -0.05, 1.01, -0.25, 10, -3, 50)
    assert bytes(msg.data) == struct.pack("<ffffhhhHIIfff", *voxel, NOBODY, 20_000, 60_000, 0, 0, 0)
    assert (msg.width, msg.height, msg.point_step, msg.row_step, msg.is_bigendian) == (1, 1, 44, 44, False)
    assert [(f.name, f.offset) for f in msg.fields][:4] == [("x", 0), ("y", 4), ("z", 8), ("sdf", 12)]
    assert [f.datatype for f in msg.fields] == [PointField.FLOAT32] * 4 + [PointField.INT16] * 3 + [
        PointField.UINT16
    ] + [PointField.UINT32] * 2 + [PointField.FLOAT32] * 3
    assert (messages.stamp_ns(msg.header), msg.header.frame_id) == (1_700_000_000_123_456_789, "room")

    cut_by, viewpoints = np.array([1], np.uint8), np.array([[0, 0, 0], [2, -1, 1.5]], np.float32)
    hull = Hull.from_shell(0.02, 0.06, indices, sdf, cut_by=cut_by, viewpoints=viewpoints)
    cut = hull_to_cloud(hull, HEADER)
    assert bytes(cut.data) == struct.pack("<ffffhhhHIIfff", *voxel, 1, 20_000, 60_000, 2, -1, 1.5)
    back = cloud_to_hull(cut)
    assert back is not None
    assert back.cut_by is not None
    assert back.cut_by.tobytes() == hull.cut_by.tobytes()
    np.testing.assert_array_equal(back.viewpoints[1], viewpoints[1])


@pytest.mark.parametrize("voxel_m", [0.02, 0.1, 0.005, 0.0123])
def test_the_hull_comes_back_bit_for_bit(voxel_m: float) -> None:
    hull = ball(voxel_m, 12 * voxel_m)
    back = cloud_to_hull(hull_to_cloud(hull, HEADER))
    assert back is not None
    assert (back.voxel_m, back.band_m, back.index_min) == (hull.voxel_m, hull.band_m, hull.index_min)
    assert back.sdf.dtype == np.float32
    assert back.sdf.tobytes() == hull.sdf.tobytes()
    assert back.sdf.shape == hull.sdf.shape


def test_who_cut_the_hull_comes_back_bit_for_bit() -> None:
    hull = ball(0.05, 0.5)
    rng = np.random.default_rng(0)
    viewpoints = rng.normal(0, 3, (5, 3)).astype(np.float32)
    shell = hull.sdf < np.float32(hull.band_m)
    rows = rng.choice(np.array([0, 1, 3, 4, NOBODY], np.uint8), hull.sdf.shape)  # camera 2 decides nowhere
    hull = dataclasses.replace(hull, cut_by=np.where(shell, rows, np.uint8(NOBODY)), viewpoints=viewpoints)
    back = cloud_to_hull(hull_to_cloud(hull, HEADER))
    assert back is not None and back.cut_by is not None and hull.cut_by is not None
    assert back.sdf.tobytes() == hull.sdf.tobytes()
    assert (back.cut_by.dtype, back.viewpoints.dtype) == (np.uint8, np.float32)
    assert back.cut_by.tobytes() == hull.cut_by.tobytes()
    for camera in (0, 1, 3, 4):
        assert back.viewpoints[camera].tobytes() == viewpoints[camera].tobytes()


def test_outline_rays_are_the_same_live_as_offline() -> None:
    hull = ball(0.05, 0.5)
    rng = np.random.default_rng(1)
    rows = np.where(hull.sdf < np.float32(hull.band_m), rng.integers(0, 3, hull.sdf.shape), NOBODY).astype(np.uint8)
    viewpoints = rng.normal(0, 3, (4, 3)).astype(np.float32)
    hull = dataclasses.replace(hull, cut_by=rows, viewpoints=viewpoints)
    back = cloud_to_hull(hull_to_cloud(hull, HEADER))
    assert back is not None
    here, there = (
        outline_rays(one, surface, np.arange(len(surface)))
        for one, surface in ((hull, extract_surface(hull)), (back, extract_surface(back)))
    )
    assert np.linalg.norm(here, axis=1).min() > 0.99
    np.testing.assert_array_equal(here, there)


def test_a_hull_of_which_nobody_knows_who_cut_it() -> None:
    """Neither without `cut_by`, nor where no camera decided, nor where its place is not known."""
    hull = ball(0.1, 1.0)
    nobody = np.full(hull.sdf.shape, NOBODY, np.uint8)
    for unknown in (
        hull,
        dataclasses.replace(hull, cut_by=nobody, viewpoints=np.zeros((3, 3), np.float32)),
        dataclasses.replace(hull, cut_by=nobody - 200, viewpoints=np.ones((3, 3), np.float32)),
    ):
        back = cloud_to_hull(hull_to_cloud(unknown, HEADER))
        assert back is not None
        assert back.cut_by is None
        assert back.viewpoints.shape == (0, 3)
        assert back.sdf.tobytes() == hull.sdf.tobytes()


def test_where_nobody_cut_no_place_is_asked_for() -> None:
    """Bytes of a place are read only where a camera is named."""
    msg = overwritten(32, struct.pack("<fff", float("nan"), 1.0, 2.0))
    back = cloud_to_hull(msg)
    assert back is not None
    assert back.cut_by is None


def test_an_empty_cloud_is_nobody() -> None:
    assert cloud_to_hull(empty_hull_cloud(HEADER)) is None


def damaged(**changes: object) -> PointCloud2:
    msg = hull_to_cloud(ball(0.1), HEADER)
    for key, value in changes.items():
        setattr(msg, key, value)
    return msg


def overwritten(offset: int, value: bytes) -> PointCloud2:
    msg = damaged()
    data = bytearray(msg.data)
    data[offset : offset + len(value)] = value
    msg.data = array("B", data)
    return msg


@pytest.mark.parametrize(
    ("msg", "words"),
    [
        (damaged(width=1_000_000_000), "1000000000x1 points needs 44000000000 bytes"),
        (damaged(data=array("B", bytes(100))), "got 100"),
        (damaged(point_step=16), "44 bytes per point"),
        (damaged(is_bigendian=True), "little-endian"),
        (damaged(fields=[PointField(name="rgb")]), "got rgb"),
        (overwritten(12, struct.pack("<f", float("nan"))), "finite"),
        (overwritten(12, struct.pack("<f", 7.0)), "below the band"),
        (overwritten(24, struct.pack("<I", 5)), "one voxel size"),
        (overwritten(16, struct.pack("<hhh", 32_000, -32_000, 32_000)), "too large"),
        (overwritten(22, struct.pack("<H", 256)), r"up to 255 \(nobody\), got 256"),
        (overwritten(22, struct.pack("<H", 65_535)), "got 65535"),
        (overwritten(22, struct.pack("<HIIf", 3, 100_000, 60_000, float("nan"))), "vp_x, vp_y, vp_z.*finite"),
        (overwritten(22, struct.pack("<HIIfff", 0, 100_000, 60_000, 1.0, 2.0, float("-inf"))), "finite"),
    ],
)
def test_clouds_that_no_hull_makes_are_refused(msg: PointCloud2, words: str) -> None:
    with pytest.raises(InputError, match=words):
        cloud_to_hull(msg)


def test_a_voxel_size_that_the_cloud_cannot_carry_is_refused() -> None:
    with pytest.raises(InputError, match=r"voxel_m: .* micrometres"):
        check_voxel_size(0.02000005, 0.06)
    far = Hull.from_shell(0.02, 0.06, np.array([[40_000, 0, 0]], np.int32), np.array([-0.1], np.float32))
    with pytest.raises(InputError, match="origin"):
        hull_to_cloud(far, HEADER)


def test_surface_cloud_fields() -> None:
    surface = extract_surface(ball())
    geodesic = np.arange(len(surface), dtype=float)
    msg = surface_to_cloud(surface, geodesic, HEADER)
    assert [f.name for f in msg.fields] == ["x", "y", "z", "normal_x", "normal_y", "normal_z", "curvature", "geodesic"]
    row = struct.unpack_from("<8f", bytes(msg.data), 32 * 7)
    expected = [*surface.points[7], *surface.normals[7], surface.curvature[7], 7.0]
    np.testing.assert_array_equal(np.float32(expected), row)


# --- figures ---


def standing(reliable: bool = True) -> Pose:
    joints = np.random.default_rng(1).random((25, 3))
    flesh = Flesh(
        np.array([[0.0, 0, 1], [0, 0, 2]]), np.array([0.1, 0.2]), np.array([[0, 0, 0], [0, 1, 1]]), ("a", "b")
    )
    return Pose(
        joints, np.eye(3)[None], ("pelvis",), {"knee": 0.5}, {}, flesh, np.zeros(1), 0.2, np.zeros(25), reliable
    )


def test_joints_round_trip_and_nobody() -> None:
    joints = standing().joints
    msg = messages.joints_to_message(joints, HEADER)
    assert len(msg.poses) == len(JOINT_NAMES) == 25
    assert all(pose.orientation.w == 1.0 for pose in msg.poses)
    np.testing.assert_array_equal(messages.message_to_joints(msg), joints)
    assert messages.message_to_joints(messages.joints_to_message(None, HEADER)) is None
    msg.poses.pop()
    with pytest.raises(InputError, match="got 24"):
        messages.message_to_joints(msg)


def test_angles_round_trip_with_suffix() -> None:
    msg = messages.angles_to_message({"waist": 0.25, "l_knee": -1.5}, HEADER, "_p1")
    assert list(msg.name) == ["waist_p1", "l_knee_p1"]
    assert messages.message_to_angles(msg) == {"waist_p1": 0.25, "l_knee_p1": -1.5}
    msg.position.pop()
    with pytest.raises(InputError, match="2 names and 1 positions"):
        messages.message_to_angles(msg)


def test_markers_hold_stick_joints_and_flesh() -> None:
    pose = standing()
    stick, joints, flesh = messages.figure_to_markers(pose, HEADER).markers
    assert (stick.type, joints.type, flesh.type) == (Marker.LINE_LIST, Marker.SPHERE_LIST, Marker.TRIANGLE_LIST)
    assert len(stick.points) == 2 * len(STICK_BONES)
    first = stick.points[0]
    np.testing.assert_array_equal([first.x, first.y, first.z], pose.joint(STICK_BONES[0][0]))
    assert len(joints.points) == len(joints.colors) == 25
    assert joints.colors[JOINT["knee_L"]].b > joints.colors[JOINT["knee_L"]].r
    assert joints.colors[JOINT["knee_R"]].r > joints.colors[JOINT["knee_R"]].b
    corners = np.array([(p.x, p.y, p.z) for p in flesh.points]).reshape(2, 80, 3, 3)
    np.testing.assert_allclose(np.linalg.norm(corners[0] - [0, 0, 1], axis=-1), 0.1)
    assert corners[1, ..., 2].max() == pytest.approx(2.2, abs=0.02)
    doubtful = messages.figure_to_markers(standing(reliable=False), HEADER).markers[2]
    assert doubtful.color.a < flesh.color.a
    assert messages.no_markers(HEADER).markers[0].action == Marker.DELETEALL


def test_transform_of_a_quarter_turn() -> None:
    T = np.array([[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
    msg = messages.transform_to_message(T, "child", HEADER)
    rotation, translation = msg.transform.rotation, msg.transform.translation
    half = 0.5**0.5
    np.testing.assert_allclose([rotation.x, rotation.y, rotation.z, rotation.w], [0, 0, half, half], atol=1e-12)
    assert (translation.x, translation.y, translation.z) == (1.0, 2.0, 3.0)
    np.testing.assert_allclose(messages.message_to_transform(msg), T, atol=1e-12)
    msg.transform.rotation.w = 0.0
    with pytest.raises(InputError, match="quaternion of length 1"):
        messages.message_to_transform(msg)


def test_quaternions_are_scipys() -> None:
    turns = Rotation.random(50, random_state=0)
    half_turns = Rotation.from_rotvec(np.pi * np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, 0, -0.8], [0, 0, 0]]))
    for rotation in (*turns, *half_turns):
        q = np.array(messages.quaternion(rotation.as_matrix()))
        theirs = rotation.as_quat()
        assert min(np.abs(q - theirs).max(), np.abs(q + theirs).max()) < 1e-12
        T = np.eye(4)
        T[:3, :3] = rotation.as_matrix()
        back = messages.message_to_transform(messages.transform_to_message(T, "a", HEADER))
        assert np.abs(back - T).max() < 1e-12


def test_status_values_and_worst_level() -> None:
    status = messages.make_status("node: x", messages.WARN, "hm", {"rate_hz": 29.97123, "n": 3, "on": True}, "cam0")
    assert messages.status_values(status) == {"rate_hz": "29.97", "n": "3", "on": "True"}
    assert messages.worst([messages.OK, messages.ERROR, messages.WARN]) == messages.ERROR
    assert messages.worst([]) == messages.OK


def test_header_keeps_nanoseconds() -> None:
    header: Header = messages.make_header(12_345_678_901_234_567, "f")
    assert (header.stamp.sec, header.stamp.nanosec) == (12_345_678, 901_234_567)
    assert messages.stamp_ns(header) == 12_345_678_901_234_567


def test_transforms_of_read_only_arrays() -> None:
    """Cameras hand out read-only matrices, which the SciPy of Ubuntu 24.04 refuses."""
    T = np.eye(4)
    T.setflags(write=False)
    assert messages.transform_to_message(T, "cam0", messages.make_header(0, "room")).transform.rotation.w == 1.0
