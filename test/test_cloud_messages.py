# SPDX-License-Identifier: Apache-2.0
"""Hull and surface as point clouds: bytes of one voxel, the same grid bit for bit, clouds that no hull makes."""

from __future__ import annotations

import dataclasses
import struct
from array import array

import numpy as np
import pytest
from camera_rings import ball_masks, ring
from sensor_msgs.msg import PointCloud2, PointField

from limbloc_ros.core.config import HullConfig
from limbloc_ros.core.engine_robust import outline_rays
from limbloc_ros.core.errors import InputError
from limbloc_ros.core.hull import NOBODY, Hull, carve
from limbloc_ros.core.surface import extract_surface
from limbloc_ros.ros import messages
from limbloc_ros.ros.cloud_messages import (
    check_voxel_size,
    cloud_to_hull,
    empty_hull_cloud,
    hull_to_cloud,
    surface_to_cloud,
)

HEADER = messages.make_header(1_700_000_000_123_456_789, "room")


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
    assert bytes(msg.data) == struct.pack("<ffffhhhHIIfffI", *voxel, NOBODY, 20_000, 60_000, 0, 0, 0, 0)
    assert (msg.width, msg.height, msg.point_step, msg.row_step, msg.is_bigendian) == (1, 1, 48, 48, False)
    assert [(f.name, f.offset) for f in msg.fields][:4] == [("x", 0), ("y", 4), ("z", 8), ("sdf", 12)]
    assert [f.datatype for f in msg.fields] == [PointField.FLOAT32] * 4 + [PointField.INT16] * 3 + [
        PointField.UINT16
    ] + [PointField.UINT32] * 2 + [PointField.FLOAT32] * 3 + [PointField.UINT32]
    assert (messages.stamp_ns(msg.header), msg.header.frame_id) == (1_700_000_000_123_456_789, "room")

    cut_by, viewpoints = np.array([1], np.uint8), np.array([[0, 0, 0], [2, -1, 1.5]], np.float32)
    hull = Hull.from_shell(0.02, 0.06, indices, sdf, cut_by=cut_by, viewpoints=viewpoints)
    cut = hull_to_cloud(hull, HEADER)
    assert bytes(cut.data) == struct.pack("<ffffhhhHIIfffI", *voxel, 1, 20_000, 60_000, 2, -1, 1.5, 0)
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


def test_what_the_cameras_saw_travels_along_bit_for_bit() -> None:
    rig = ring(4)
    hull = carve(ball_masks(rig, [((0.0, 0.0, 1.0), 0.4)]), rig, HullConfig())
    assert isinstance(hull, Hull)
    assert hull.views is not None
    back = cloud_to_hull(hull_to_cloud(hull, HEADER))
    assert back is not None
    assert back.views is not None
    for name in ("cameras", "frames", "cells"):
        assert getattr(back.views, name).tobytes() == getattr(hull.views, name).tobytes()
    assert back.views.packed == hull.views.packed


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
        (damaged(width=1_000_000_000), "1000000000x1 points needs 48000000000 bytes"),
        (damaged(data=array("B", bytes(100))), "got 100"),
        (damaged(point_step=16), "48 bytes per point"),
        (damaged(is_bigendian=True), "little-endian"),
        (damaged(fields=[PointField(name="rgb")]), "got rgb"),
        (overwritten(12, struct.pack("<f", float("nan"))), "finite"),
        (overwritten(12, struct.pack("<f", 7.0)), "below the band"),
        (overwritten(24, struct.pack("<I", 5)), "one voxel size"),
        (overwritten(16, struct.pack("<hhh", 32_000, -32_000, 32_000)), "too large"),
        (overwritten(22, struct.pack("<H", 256)), r"up to 255 \(nobody\), got 256"),
        (overwritten(22, struct.pack("<H", 65_535)), "got 65535"),
        (overwritten(22, struct.pack("<HIIf", 3, 100_000, 60_000, float("nan"))), "vp_x, vp_y, vp_z.*finite"),
        (overwritten(44, struct.pack("<I", 4_000_000_000)), "cannot hold views of 4000000000 bytes"),
        (overwritten(44, struct.pack("<I", 5)), "8 bytes or more"),
        (overwritten(44, struct.pack("<I", 40)), "1 to 255 cameras .* got 0 and 0"),
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
