# SPDX-License-Identifier: Apache-2.0
"""Hull and surface <-> sensor_msgs/PointCloud2.

The hull's cloud holds the inside and a thin shell: per voxel its centre (`x y z`, so that RViz shows it as it is), the
signed distance `sdf` in metres, and the number of the `camera` whose silhouette cut the hull there (NOBODY: unknown).
Numbers survive exactly, so that the grid is the offline path's bit for bit.

`extra` holds what belongs to the hull as a whole, four bytes in each voxel's: the voxel size and the band in whole
micrometres, the number of viewpoints, the number of bytes of the views; the viewpoints, where the cameras stand
(float32 x y z, m); the views, what the cameras saw, by which figures are judged. A hull of fewer voxels than that takes
repeats the last one. An empty cloud says that nobody is there.
"""

from __future__ import annotations

import functools
from array import array
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Header

from limbloc_ros.core.errors import InputError
from limbloc_ros.core.hull import NOBODY, Hull
from limbloc_ros.core.surface import Surface
from limbloc_ros.core.views import Views
from limbloc_ros.ros import _cloud_kernels as kernels

HULL_POINT = np.dtype(
    {
        "names": ["x", "y", "z", "sdf", "camera", "extra"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<u2", "<u4"],
        "offsets": [0, 4, 8, 12, 16, 20],
        "itemsize": 24,
    }
)
#: How far from the centre of a voxel, in voxels, a point may lie: float32 is that exact for all indices that we send.
ASTRAY = 0.01
NOWHERE = np.zeros((0, 3), np.float32)
SURFACE_POINT = np.dtype(
    [(name, "<f4") for name in ("x", "y", "z", "normal_x", "normal_y", "normal_z", "curvature", "geodesic")]
)

_DATATYPES = {"<f4": PointField.FLOAT32, "<u2": PointField.UINT16, "<u4": PointField.UINT32}


def _fields(point: np.dtype[np.void]) -> list[PointField]:
    fields: Any = point.fields
    return [
        PointField(name=name, offset=fields[name][1], datatype=_DATATYPES[fields[name][0].str], count=1)
        for name in point.names or ()
    ]


_HULL_FIELDS = _fields(HULL_POINT)
_SURFACE_FIELDS = _fields(SURFACE_POINT)


def _cloud(data: array[int], point: np.dtype[np.void], fields: list[PointField], header: Header) -> PointCloud2:
    """The cloud whose points these bytes are."""
    msg = PointCloud2(header=header, height=1, width=len(data) // point.itemsize, fields=fields, is_dense=True)
    msg.point_step, msg.row_step = point.itemsize, len(data)
    msg.data = data  # the constructor would copy it byte by byte
    return msg


def check_voxel_size(voxel_m: float, band_m: float) -> None:
    """The cloud carries both in whole micrometres, so that the receiver gets the very same numbers.

    Raises:
        InputError: one of them is not a whole number of micrometres.
    """
    for name, value in (("voxel_m", voxel_m), ("band_m", band_m)):
        if round(value * 1e6) / 1e6 != value:
            raise InputError(f"{name}: expected a whole number of micrometres, got {value!r} m; round it to 6 decimals")


def hull_to_cloud(hull: Hull, header: Header) -> PointCloud2:
    """The inside and the shell of a hull, one point per voxel (see the module's text).

    Raises:
        InputError: sizes that are not whole micrometres, or a hull more than 32767 voxels from the world's origin.
    """
    check_voxel_size(hull.voxel_m, hull.band_m)
    band = np.float32(hull.band_m)
    count = int(np.count_nonzero(hull.sdf < band))
    if count == 0:
        return empty_hull_cloud(header)
    # The outermost cells of a hull's grid are empty.
    low, high = min(hull.index_min) + 1, max(n + i for n, i in zip(hull.sdf.shape, hull.index_min, strict=True)) - 2
    if low < -32768 or high > 32767:
        raise InputError(
            f"the hull's voxels have indices {low} to {high}; expected -32768 to 32767: "
            "move the world's origin into the room, or use larger voxels"
        )
    cut_by = hull.cut_by if hull.cut_by is not None else np.zeros((0, 0, 0), np.uint8)
    viewpoints = hull.viewpoints if kernels.somebody_cut(hull.sdf, band, cut_by, len(hull.viewpoints)) else NOWHERE
    extra = _extra(hull, viewpoints)
    data = array("B", bytes(1)) * (max(count, len(extra)) * HULL_POINT.itemsize)
    words = np.frombuffer(data, np.uint32).reshape(-1, HULL_POINT.itemsize // 4)  # the message's own memory
    kernels.write_rows(
        words, words.view(np.float32), hull.sdf, band, np.array(hull.index_min), cut_by, len(viewpoints), NOBODY,
        hull.voxel_m, extra,
    )  # fmt: skip
    return _cloud(data, HULL_POINT, _HULL_FIELDS, header)


def _extra(hull: Hull, viewpoints: NDArray[np.float32]) -> NDArray[np.uint32]:
    """What is sent once per hull, in words."""
    views = b"" if hull.views is None else hull.views.packed
    sizes = np.array([round(hull.voxel_m * 1e6), round(hull.band_m * 1e6), len(viewpoints), len(views)], "<u4")
    padded = views + bytes(-len(views) % 4)
    return np.frombuffer(sizes.tobytes() + viewpoints.astype("<f4").tobytes() + padded, "<u4").astype(np.uint32)


def empty_hull_cloud(header: Header) -> PointCloud2:
    """Nobody is there at this instant."""
    return _cloud(array("B"), HULL_POINT, _HULL_FIELDS, header)


def cloud_to_hull(msg: PointCloud2) -> Hull | None:
    """The hull that was sent, its grid bit for bit; None when the cloud is empty.

    Names of cameras do not travel with the cloud: `cameras` and `rejected` are empty.

    Raises:
        InputError: not a hull's cloud, truncated, or numbers that no hull has.
    """
    got = [(f.name, f.offset, f.datatype, f.count) for f in msg.fields]
    expected = [(f.name, f.offset, f.datatype, f.count) for f in _HULL_FIELDS]
    if got != expected or msg.point_step != HULL_POINT.itemsize or msg.is_bigendian:
        raise InputError(
            f"expected a hull's cloud with fields {' '.join(f.name for f in _HULL_FIELDS)} in {HULL_POINT.itemsize} "
            f"bytes per point, little-endian; got {' '.join(f.name for f in msg.fields)} in {msg.point_step}"
        )
    count = msg.width * msg.height
    if count * HULL_POINT.itemsize != len(msg.data):
        raise InputError(
            f"a hull's cloud of {msg.width}x{msg.height} points needs {count * HULL_POINT.itemsize} bytes, "
            f"got {len(msg.data)}: the message is truncated or its header wrong"
        )
    if count == 0:
        return None
    words = np.require(np.frombuffer(msg.data, np.uint32).reshape(count, -1), requirements="W")
    voxel_m, band_m, viewpoints, views = _read_extra(words[:, 5])
    indices, sdf, camera, widest, highest, largest, astray = kernels.read_rows(words, words.view(np.float32), voxel_m)
    if not astray < ASTRAY:
        raise InputError(f"the points of a hull's cloud must be centres of voxels of {voxel_m} m, not too far away")
    if not widest < 100.0 or not highest < np.float32(band_m):
        raise InputError(f"signed distances of a hull's cloud must be finite and below the band of {band_m} m")
    if largest > NOBODY:
        raise InputError(f"a hull's cloud numbers cameras up to {NOBODY} (nobody), got {largest}")
    if len(viewpoints) == 0:
        return replace(Hull.from_shell(voxel_m, band_m, indices, sdf), views=views)
    hull = Hull.from_shell(voxel_m, band_m, indices, sdf, cut_by=camera, viewpoints=viewpoints)
    return replace(hull, views=views)


def _read_extra(words: NDArray[np.uint32]) -> tuple[float, float, NDArray[np.float32], Views | None]:
    """Voxel size, band, viewpoints and views."""
    if len(words) < 4:
        raise InputError(f"a hull's cloud has 4 points or more, got {len(words)}")
    voxel_um, band_um, cameras, size = (int(word) for word in words[:4])
    if voxel_um == 0 or band_um == 0:
        raise InputError(f"a hull has a voxel size and a band above 0; got {voxel_um} um and {band_um} um")
    if cameras > NOBODY:
        raise InputError(f"a hull's cloud has up to {NOBODY} viewpoints, got {cameras}")
    begin = 4 + 3 * cameras
    if begin + -(-size // 4) > len(words):
        raise InputError(
            f"a hull's cloud of {len(words)} points cannot hold {cameras} viewpoints and views of {size} bytes"
        )
    viewpoints = words[4:begin].copy().view(np.float32).reshape(-1, 3)
    if not np.isfinite(viewpoints).all():
        raise InputError("the viewpoints in a hull's cloud must be finite")
    views = Views.unpacked(words[begin : begin + -(-size // 4)].tobytes()[:size]) if size else None
    return voxel_um / 1e6, band_um / 1e6, viewpoints, views


@functools.cache  # once per process
def warm_up() -> None:
    """Compile or load the kernels, so that the first cloud is not slow."""
    sdf = np.full((3, 3, 3), 0.06, np.float32)
    sdf[1, 1, 1] = -0.01
    cloud_to_hull(hull_to_cloud(Hull(0.02, (0, 0, 0), sdf, 0.06), Header()))


def surface_to_cloud(surface: Surface, geodesic: NDArray[np.float64], header: Header) -> PointCloud2:
    """Surface points with normal, curvature (rad) and geodesic distance from the centre of mass (m; figs. 1 and 4)."""
    points = np.zeros(len(surface), SURFACE_POINT)
    for axis, name in enumerate("xyz"):
        points[name] = surface.points[:, axis]
        points[f"normal_{name}"] = surface.normals[:, axis]
    points["curvature"] = surface.curvature
    points["geodesic"] = geodesic
    data = array("B")
    data.frombytes(points.view(np.uint8).data)
    return _cloud(data, SURFACE_POINT, _SURFACE_FIELDS, header)
