# SPDX-License-Identifier: Apache-2.0
"""Hull and surface as point clouds: bytes of one voxel, the same grid bit for bit, clouds that no hull makes."""

from __future__ import annotations

import dataclasses
import struct
from array import array
from typing import Any

import numpy as np
import pytest
from camera_rings import ball_masks, ring
from sensor_msgs.msg import PointCloud2, PointField

from limbloc_ros.core.config import HullConfig
from limbloc_ros.core.engine_robust import outline_rays
from limbloc_ros.core.errors import InputError
from limbloc_ros.core.hull import NOBODY, Hull, carve
from limbloc_ros.core.surface import extract_surface
from limbloc_ros.core.views import Views
from limbloc_ros.ros import _cloud_kernels, messages
from limbloc_ros.ros.cloud_messages import (
    check_voxel_size,
    cloud_to_hull,
    empty_hull_cloud,
    hull_to_cloud,
    surface_to_cloud,
    warm_up,
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
    """Four rows of it: so many words take the sizes of the hull."""
    indices, sdf = np.array([[10, -3, 50]], np.int32), np.array([-0.25], np.float32)
    msg = hull_to_cloud(Hull.from_shell(0.02, 0.06, indices, sdf), HEADER)
    voxel = (0.21, -0.05, 1.01, -0.25)
    rows = [struct.pack("<ffffHHI", *voxel, NOBODY, 0, extra) for extra in (20_000, 60_000, 0, 0)]
    assert bytes(msg.data) == b"".join(rows)
    assert (msg.width, msg.height, msg.point_step, msg.row_step, msg.is_bigendian) == (4, 1, 24, 96, False)
    assert [(f.name, f.offset) for f in msg.fields] == [
        ("x", 0), ("y", 4), ("z", 8), ("sdf", 12), ("camera", 16), ("extra", 20)
    ]  # fmt: skip
    assert [f.datatype for f in msg.fields] == [PointField.FLOAT32] * 4 + [PointField.UINT16, PointField.UINT32]
    assert (messages.stamp_ns(msg.header), msg.header.frame_id) == (1_700_000_000_123_456_789, "room")

    cut_by, viewpoints = np.array([1], np.uint8), np.array([[0, 0, 0], [2, -1, 1.5]], np.float32)
    hull = Hull.from_shell(0.02, 0.06, indices, sdf, cut_by=cut_by, viewpoints=viewpoints)
    cut = hull_to_cloud(hull, HEADER)
    rows = [struct.pack("<ffffHHI", *voxel, 1, 0, extra) for extra in (20_000, 60_000, 2, 0, 0, 0, 0)]
    rows += [struct.pack("<ffffHHf", *voxel, 1, 0, place) for place in (2.0, -1.0, 1.5)]
    assert bytes(cut.data) == b"".join(rows)
    back = cloud_to_hull(cut)
    assert back is not None
    assert back.cut_by is not None
    assert back.cut_by.tobytes() == hull.cut_by.tobytes()
    assert back.sdf.tobytes() == hull.sdf.tobytes()
    assert back.viewpoints.tobytes() == viewpoints.tobytes()


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
    assert back.viewpoints.tobytes() == viewpoints.tobytes()


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
    """Without `cut_by`; where no camera decided, its place is not known, or it decided only outside the shell."""
    hull = ball(0.1, 1.0)
    nobody = np.full(hull.sdf.shape, NOBODY, np.uint8)
    for unknown in (
        hull,
        dataclasses.replace(hull, cut_by=nobody, viewpoints=np.zeros((3, 3), np.float32)),
        dataclasses.replace(hull, cut_by=nobody - 200, viewpoints=np.ones((3, 3), np.float32)),
        dataclasses.replace(
            hull,
            cut_by=np.where(hull.sdf < np.float32(0.06), nobody, 0).astype(np.uint8),
            viewpoints=np.ones((3, 3), np.float32),
        ),
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


def test_of_a_small_hull_travels_everything_too() -> None:
    """What belongs to the hull as a whole takes more words than it has voxels."""
    rig = ring(4)
    views = carve(ball_masks(rig, [((0.0, 0.0, 1.0), 0.4)]), rig, HullConfig()).views
    assert views is not None
    indices, sdf = np.array([[0, 0, 5], [0, 1, 5]], np.int32), np.array([-0.02, 0.01], np.float32)
    cut_by, viewpoints = np.array([NOBODY, 1], np.uint8), np.array([[0, 0, 0], [2, -1, 1.5]], np.float32)
    hull = Hull.from_shell(0.02, 0.06, indices, sdf, cut_by=cut_by, viewpoints=viewpoints)
    hull = dataclasses.replace(hull, views=views)
    back = cloud_to_hull(hull_to_cloud(hull, HEADER))
    assert back is not None and back.views is not None and back.cut_by is not None and hull.cut_by is not None
    assert (back.sdf.tobytes(), back.views.packed) == (hull.sdf.tobytes(), views.packed)
    assert (back.cut_by.tobytes(), back.viewpoints.tobytes()) == (hull.cut_by.tobytes(), viewpoints.tobytes())


def extra_of(msg: PointCloud2) -> bytes:
    return b"".join(bytes(msg.data)[24 * n + 20 : 24 * n + 24] for n in range(msg.width))


def test_what_belongs_to_the_hull_as_a_whole_stands_in_its_order_and_nothing_behind_it() -> None:
    hull = ball(0.1)
    shell = hull.sdf < np.float32(hull.band_m)
    viewpoints = np.array([[1.5, -2, 3]], np.float32)
    hull = dataclasses.replace(hull, cut_by=np.where(shell, 0, NOBODY).astype(np.uint8), viewpoints=viewpoints)
    lengths = set()
    for cells in range(20, 200, 10):  # packed they have all remainders by 4
        camera = np.zeros((1, 35))
        camera[0, [0, 4, 8]], camera[0, 11:16], camera[0, 31:33] = 1.0, (3.0, 100.0, 100.0, 32.0, 24.0), (64.0, 48.0)
        pattern = np.random.default_rng(cells).integers(0, 3, cells).astype(np.uint8)
        views = Views(camera, np.array([[8, 8, cells // 2, 2, 2, 0]]), pattern)
        lengths.add(len(views.packed) % 4)
        msg = hull_to_cloud(dataclasses.replace(hull, views=views), HEADER)
        expected = struct.pack("<4I3f", 100_000, 60_000, 1, len(views.packed), 1.5, -2, 3) + views.packed
        assert msg.width == np.count_nonzero(shell)
        assert extra_of(msg) == expected.ljust(4 * msg.width, b"\0")
        back = cloud_to_hull(msg)
        assert back is not None and back.views is not None
        assert back.views.packed == views.packed
        one = Hull.from_shell(0.02, 0.06, np.array([[0, 0, 5]], np.int32), np.array([-0.02], np.float32))
        cut = hull_to_cloud(dataclasses.replace(one, views=views), HEADER)
        cut.width, cut.data = cut.width - 1, cut.data[:-24]  # the last bytes of the views are missing
        with pytest.raises(InputError, match="cannot hold"):
            cloud_to_hull(cut)
    assert lengths == {0, 1, 2, 3}


@pytest.mark.parametrize("index", [(-32768, 32767, 0), (32767, -32768, 32767)])
def test_voxels_far_from_the_origin_are_told_apart(index: tuple[int, int, int]) -> None:
    hull = Hull.from_shell(0.0123, 0.06, np.array([index], np.int32), np.array([-0.01], np.float32))
    back = cloud_to_hull(hull_to_cloud(hull, HEADER))
    assert back is not None
    assert back.index_min == hull.index_min


@pytest.mark.parametrize(("last", "beyond"), [(32767, 32768), (-32768, -32769)])
@pytest.mark.parametrize("voxel_m", [0.02, 0.0123])
def test_voxels_too_far_from_the_origin_are_refused(voxel_m: float, last: int, beyond: int) -> None:
    msg = hull_to_cloud(
        Hull.from_shell(voxel_m, 0.06, np.array([[last, 0, 0]], np.int32), np.array([-0.01], np.float32)), HEADER
    )
    rows = np.frombuffer(bytes(msg.data), np.float32).reshape(-1, 6).copy()
    rows[:, 0] = (beyond + 0.5) * voxel_m
    msg.data = array("B", rows.tobytes())
    with pytest.raises(InputError, match="not too far away"):
        cloud_to_hull(msg)


def test_points_lie_at_centres_of_voxels_but_for_what_float32_rounds() -> None:
    here = struct.unpack_from("<f", bytes(damaged().data))[0]
    hull = cloud_to_hull(overwritten(0, struct.pack("<f", here + 0.0005)))
    assert hull is not None
    assert hull.sdf.tobytes() == ball(0.1).sdf.tobytes()
    for off in (0.002, -0.002):
        with pytest.raises(InputError, match="centres of voxels"):
            cloud_to_hull(overwritten(0, struct.pack("<f", here + off)))


def test_what_pads_a_row_means_nothing() -> None:
    hull = cloud_to_hull(overwritten(18, b"\xff\xff", 42, b"\x01\x80"))
    assert hull is not None
    assert hull.sdf.tobytes() == ball(0.1).sdf.tobytes()


def test_no_hull_has_a_kernel_compiled_once_more_after_warming_up() -> None:
    warm_up()
    rig = ring(4)
    hull = carve(ball_masks(rig, [((0.0, 0.0, 1.0), 0.4)]), rig, HullConfig())
    assert isinstance(hull, Hull) and hull.cut_by is not None
    kernels = (_cloud_kernels.somebody_cut, _cloud_kernels.write_rows, _cloud_kernels.read_rows)
    before = [len(kernel.signatures) for kernel in kernels]
    msg = hull_to_cloud(hull, HEADER)
    for data in (msg.data, array("B", bytes(msg.data))):
        msg.data = data
        cloud_to_hull(msg)
    assert [len(kernel.signatures) for kernel in kernels] == before


def test_an_empty_cloud_is_nobody() -> None:
    assert cloud_to_hull(empty_hull_cloud(HEADER)) is None


def damaged(**changes: object) -> PointCloud2:
    msg = hull_to_cloud(ball(0.1), HEADER)
    for key, value in changes.items():
        setattr(msg, key, value)
    return msg


def overwritten(*changes: Any) -> PointCloud2:
    """With other bytes from some offset on, and from another."""
    msg = damaged()
    data = bytearray(msg.data)
    for offset, value in zip(changes[::2], changes[1::2], strict=True):
        data[offset : offset + len(value)] = value
    msg.data = array("B", data)
    return msg


@pytest.mark.parametrize(
    ("msg", "words"),
    [
        (damaged(width=1_000_000_000), "1000000000x1 points needs 24000000000 bytes"),
        (damaged(data=array("B", bytes(100))), "got 100"),
        (damaged(width=3, data=array("B", bytes(72))), "4 points or more, got 3"),
        (damaged(point_step=16), "24 bytes per point"),
        (damaged(is_bigendian=True), "little-endian"),
        (damaged(fields=[PointField(name="rgb")]), "got rgb"),
        (overwritten(0, struct.pack("<f", 0.02)), "centres of voxels of 0.1 m"),
        (overwritten(4, struct.pack("<f", float("nan"))), "centres of voxels"),
        (overwritten(8, struct.pack("<f", 3276.85)), "not too far away"),
        (overwritten(12, struct.pack("<f", float("nan"))), "finite"),
        (overwritten(12, struct.pack("<f", 7.0)), "below the band"),
        (overwritten(12, struct.pack("<f", 0.06)), "below the band"),
        (overwritten(12, struct.pack("<f", -100.0)), "finite"),
        (overwritten(0, struct.pack("<fff", 3200.05, -3200.05, 3200.05)), "too large"),
        (overwritten(16, struct.pack("<H", 256)), r"up to 255 \(nobody\), got 256"),
        (overwritten(16, struct.pack("<H", 65_535)), "got 65535"),
        (overwritten(20, struct.pack("<I", 0)), "above 0; got 0 um and 60000 um"),
        (overwritten(44, struct.pack("<I", 0)), "above 0; got 100000 um and 0 um"),
        (overwritten(68, struct.pack("<I", 256)), "up to 255 viewpoints, got 256"),
        (overwritten(68, struct.pack("<I", 200)), "cannot hold 200 viewpoints"),
        (overwritten(92, struct.pack("<I", 4_000_000_000)), "views of 4000000000 bytes"),
        (overwritten(92, struct.pack("<I", 5)), "8 bytes or more"),
        (overwritten(92, struct.pack("<I", 40)), "1 to 255 cameras .* got 0 and 0"),
        (overwritten(68, struct.pack("<I", 1), 116, struct.pack("<f", float("-inf"))), "viewpoints .* finite"),
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
