# SPDX-License-Identifier: Apache-2.0
"""Masks -> the signed distance to each silhouette's outline, cut to the piece that can matter."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core import _projection_kernels as projection
from limbloc_ros.core import _silhouettes_kernels as kernels
from limbloc_ros.core.camera import Camera, Rig
from limbloc_ros.core.config import HullConfig
from limbloc_ros.core.errors import InputError, RigError
from limbloc_ros.core.lens import lens_range

#: Edge (m) of the cubes of space that are asked how near to a camera a body can be; larger ones in large rooms.
CUBE_M = 0.3
MAX_CUBES = 4000
#: Cameras are judged on voxels COARSE times as large, with a band of so many of the voxels proper.
COARSE = 3
COARSE_BAND = 0.5 * COARSE


@dataclass(frozen=True)
class Silhouettes:
    """The 2D signed distance (px, negative inside) of each usable mask, cut to the part that can matter.

    Attributes:
        names: the C cameras that take part.
        cameras: float64 [C, 35] packed table (see `_projection_kernels`).
        boxes: int64 [C, 5] x0, y0, width, height of each piece and its offset in `field`.
        field: float32, the pieces one after the other.
        rejected: camera name -> why it does not take part.
        masks: the whole masks, uint8 [height, width], 0 or 1; regions to ignore are foreground, so that nothing is
            carved there.
        outlines: int64 [C, 4] first column and row, last column and row of each mask's foreground.
        margins: float64 [C] px from a mask to its piece's border: further out, every point that can matter is further
            from the silhouette than the band.
        room: float64 [2, 3] corners of the carve volume, m.
        band_m: how far outside a silhouette distances are needed, m.
        ignored: uint8 [height, width] of each camera, 1 where its image means nothing; None where it has no such part.
    """

    names: tuple[str, ...]
    cameras: NDArray[np.float64]
    boxes: NDArray[np.int64]
    field: NDArray[np.float32]
    rejected: dict[str, str]
    masks: tuple[NDArray[np.uint8], ...]
    outlines: NDArray[np.int64]
    margins: NDArray[np.float64]
    room: NDArray[np.float64]
    band_m: float
    ignored: tuple[NDArray[np.uint8] | None, ...]

    def piece(self, c: int) -> NDArray[np.float32]:
        """[height, width] the stored piece of camera number c, px."""
        _, _, width, height, offset = self.boxes[c]
        return self.field[offset : offset + width * height].reshape(height, width)

    def with_masks(self, masks: Mapping[int, NDArray[np.uint8]]) -> Silhouettes:
        """The same with the whole masks (0 or 1) of some camera numbers replaced."""
        new = tuple(masks.get(c, mask) for c, mask in enumerate(self.masks))
        outlines = self.outlines.copy()
        for c, mask in masks.items():
            outlines[c] = _outline(mask)
        grown = replace(self, masks=new, outlines=outlines)
        if not np.array_equal(outlines, self.outlines):
            grown = replace(grown, margins=_margins(grown))
        return _cut(grown, self)

    def without(self, name: str, why: str) -> Silhouettes:
        """The same without one camera."""
        keep = [i for i, other in enumerate(self.names) if other != name]
        rest = replace(
            self,
            names=tuple(self.names[i] for i in keep),
            cameras=self.cameras[keep],
            boxes=self.boxes[keep],
            rejected={**self.rejected, name: why},
            masks=tuple(self.masks[i] for i in keep),
            outlines=self.outlines[keep],
            margins=self.margins[keep],
            ignored=tuple(self.ignored[i] for i in keep),
        )
        return _cut(replace(rest, margins=_margins(rest)), rest)

    def changes_since(self, before: Silhouettes) -> NDArray[np.float64]:
        """Where another distance than before is read, if it is nearer than the margin; the masks may only have grown.

        Returns:
            [C, 4] smallest rectangle of pixels x0, y0, x1, y1 of each camera; empty (x1 < x0) where nothing changed.
        """
        changed = np.tile([0.0, 0.0, -1.0, -1.0], (len(self.names), 1))
        for c, mask in enumerate(self.masks):
            if mask is before.masks[c]:
                continue
            x, y, width, height, _ = self.boxes[c]
            x_old, y_old, width_old, height_old, _ = before.boxes[c]
            x0, x1 = max(x, x_old), min(x + width, x_old + width_old)
            y0, y1 = max(y, y_old), min(y + height, y_old + height_old)
            old = np.full((height, width), np.inf, np.float32)
            old[y0 - y : y1 - y, x0 - x : x1 - x] = before.piece(c)[y0 - y_old : y1 - y_old, x0 - x_old : x1 - x_old]
            new = self.piece(c)
            left, top, columns, rows = cv2.boundingRect(((new < old) & (new < self.margins[c])).astype(np.uint8))
            if columns > 0:  # one pixel more: bilinear reading
                changed[c] = x + left - 1, y + top - 1, x + left + columns, y + top + rows
        return changed


def signed_distance_px(mask: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Exact Euclidean distance [height, width] to the outline of a mask, px, negative inside.

    The outline runs half-way between the last foreground and the first background pixel centre. (OpenCV's exact
    transform takes an approximate root where its vectors fit: its last bit depends on the alignment in memory, and
    the same bag would not give the same angles every time. It is also slower for both sides of an outline.)
    """
    return kernels.signed_distance(np.not_equal(mask, 0).view(np.uint8))  # type: ignore[no-any-return]


def cleaned(mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A mask without specks and pinholes: what is far too small, beside the largest blob, to be body or daylight.

    Specks would make phantom voxels; a pinhole drills a tunnel through the body. A blob is dropped below 0.5 % of
    the largest blob's area, an enclosed hole filled below 1.5 % of it (a gap between arm and trunk is larger).

    Args:
        mask: uint8 [height, width], non-zero = foreground.

    Returns:
        uint8 [height, width], 0 or 1.
    """
    x, y, width, height = cv2.boundingRect(mask)
    out = np.zeros(mask.shape, np.uint8)
    if width == 0:
        return out
    piece = np.not_equal(mask[y : y + height, x : x + width], 0).astype(np.uint8)
    contours, hierarchy = cv2.findContours(piece, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    if len(contours) > 1:
        # A contour runs through the centres of its pixels: half its length more is the area of the pixels themselves,
        # half its length less that of the hole it surrounds.
        outer = hierarchy[0, :, 3] < 0
        half_length = np.array([0.5 * len(contour) for contour in contours])
        area = np.array([cv2.contourArea(contour) for contour in contours]) + np.where(outer, 1, -1) * half_length
        largest = float(area[outer].max())
        # One by one, for those that touch must not cancel out; only the one, for OpenCV copies the list it is given.
        for i in map(int, np.flatnonzero(outer & (area < 0.005 * largest))):
            cv2.drawContours(piece, [contours[i]], 0, 0, cv2.FILLED)
        for i in map(int, np.flatnonzero(~outer & (area < 0.015 * largest))):
            cv2.drawContours(piece, [contours[i]], 0, 1, cv2.FILLED)
    out[y : y + height, x : x + width] = piece
    return out


def pack_cameras(rig: Rig) -> NDArray[np.float64]:
    """The table [len(rig.cameras), 35] that the kernels read."""
    return np.stack([pack_camera(camera) for camera in rig.cameras])


def pack_camera(camera: Camera) -> NDArray[np.float64]:
    """One row of the table that the kernels read.

    Raises:
        RigError: an image of a single row or column, or a lens that cannot be (see `lens_range`).
    """
    if min(camera.width, camera.height) < 2:
        raise RigError(f"camera {camera.name}: expected an image of 2x2 px or more, got {camera.width}x{camera.height}")
    row = np.zeros(projection.CAMERA_COLUMNS)
    T = camera.T_camera_world
    row[0:9] = T[:3, :3].ravel()
    row[9:12] = T[:3, 3]
    row[12:16] = camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]
    if camera.distortion.any():
        row[16] = projection.FISHEYE if camera.distortion_model == "fisheye" else projection.POLYNOMIAL
        row[17 : 17 + camera.distortion.size] = camera.distortion
    row[31:33] = camera.width, camera.height
    reach, enlargement = lens_range(camera)
    row[33:35] = reach**2, enlargement
    return row


def measure_silhouettes(
    masks: Mapping[str, NDArray[np.uint8]], rig: Rig, packed: NDArray[np.float64], config: HullConfig
) -> Silhouettes:
    """Signed distance to the outline of every mask.

    Args:
        masks: camera name -> uint8 [height, width], non-zero = foreground.
        rig: the cameras.
        packed: float64 [len(rig.cameras), 35], `pack_camera` of each.
        config: the band decides how far outside a silhouette distances are needed.

    Raises:
        InputError: a mask has not its camera's size.
        RigError: the rig has no such camera.
    """
    for name, mask in masks.items():
        camera = rig.camera(name)
        if mask.shape != (camera.height, camera.width):
            raise InputError(
                f"camera {name}: expected a mask of {camera.width}x{camera.height} px as in the rig, "
                f"got {'x'.join(map(str, mask.shape[::-1]))}; is the stream scaled, or the rig file another camera's?"
            )
    usable: list[NDArray[np.uint8]] = []
    ignored: list[NDArray[np.uint8] | None] = []
    rows: list[int] = []
    rejected: dict[str, str] = {}
    for row, camera in enumerate(rig.cameras):
        if camera.name not in masks:
            rejected[camera.name] = "no mask"
            continue
        blind = camera.ignored_pixels()
        mask = cleaned(masks[camera.name] if blind is None else np.where(blind, np.uint8(0), masks[camera.name]))
        foreground = cv2.countNonZero(mask)
        if foreground == 0:
            rejected[camera.name] = "empty mask"
        elif foreground > 0.9 * mask.size:
            rejected[camera.name] = "mask is all foreground"
        else:
            usable.append(mask if blind is None else mask | blind)
            ignored.append(blind)
            rows.append(row)
    whole = Silhouettes(
        names=tuple(rig.cameras[row].name for row in rows),
        cameras=packed[rows],
        boxes=np.zeros((len(rows), 5), np.int64),
        field=np.zeros(0, np.float32),
        rejected=rejected,
        masks=tuple(usable),
        outlines=np.array([_outline(mask) for mask in usable], np.int64).reshape(-1, 4),
        margins=np.zeros(len(rows)),
        room=np.stack([rig.volume_min, rig.volume_max]),
        band_m=max(config.band_m, COARSE_BAND * config.voxel_m),
        ignored=tuple(ignored),
    )
    return _cut(replace(whole, margins=_margins(whole)), None) if rows else whole


def min_seen(cameras: int) -> int:
    """So many of the cameras must see a voxel: what most do not see they do not carve, and it may be huge."""
    return max(min(2, cameras), cameras // 2 + 1)


def _cut(whole: Silhouettes, old: Silhouettes | None) -> Silhouettes:
    """Cut the piece that can matter out of every mask and measure it; `old` has pieces that may still do."""
    count = len(whole.names)
    margins = whole.margins.copy()
    boxes = np.zeros((count, 5), np.int64)
    pieces = []
    offset = 0
    for c, mask in enumerate(whole.masks):
        if old is not None and mask is old.masks[c] and margins[c] <= old.margins[c]:
            margins[c] = old.margins[c]
            boxes[c] = old.boxes[c]
            pieces.append(old.piece(c).ravel())
        else:
            margin = int(margins[c])
            x0, y0 = np.maximum(whole.outlines[c, :2] - margin, 0)
            x1, y1 = np.minimum(whole.outlines[c, 2:] + margin + 1, mask.shape[::-1])
            boxes[c, :4] = x0, y0, x1 - x0, y1 - y0
            pieces.append(kernels.signed_distance(mask[y0:y1, x0:x1]).ravel())
        boxes[c, 4] = offset
        offset += pieces[-1].size
    return replace(whole, boxes=boxes, margins=margins, field=np.concatenate(pieces))


def _outline(mask: NDArray[np.uint8]) -> tuple[int, int, int, int]:
    """First column and row, last column and row of the foreground."""
    x, y, width, height = cv2.boundingRect(mask)
    return x, y, x + width - 1, y + height - 1


def _margins(whole: Silhouettes) -> NDArray[np.float64]:
    """Beyond these distances (px) from the masks [C] every point that can matter is further than the band from them.

    The rectangles around the masks alone tell how near to each camera such a point can be.
    """
    table = (whole.cameras, whole.outlines, whole.band_m, min_seen(len(whole.names)))
    low, high = whole.room
    edge = max(CUBE_M, float(np.cbrt((high - low).prod() / MAX_CUBES)))
    axes = [np.arange(low[a] + 0.5 * edge, high[a] + 0.5 * edge, edge) for a in range(3)]
    cubes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    eighths = np.array(list(np.ndindex(2, 2, 2))) - 0.5
    kept, _ = kernels.nearest_depths(cubes, 0.5 * edge * math.sqrt(3), *table)
    cubes = (cubes[kept][:, None] + 0.5 * edge * eighths).reshape(-1, 3)
    _, nearest = kernels.nearest_depths(cubes, 0.25 * edge * math.sqrt(3), *table)
    margins = np.array([float(max(mask.shape)) for mask in whole.masks])
    seen = nearest > 0
    margins[seen] = np.minimum(margins[seen], np.ceil(whole.cameras[seen, 12] * whole.band_m / nearest[seen]) + 2)
    return margins
