# SPDX-License-Identifier: Apache-2.0
"""Masks -> the signed distance to each silhouette's outline, cut to the piece that can matter."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core import _hull_kernels as kernels
from limbloc_ros.core.camera import Camera, Rig
from limbloc_ros.core.config import HullConfig
from limbloc_ros.core.errors import InputError


@dataclass(frozen=True)
class Silhouettes:
    """The 2D signed distance (px, negative inside) of each usable mask, cut to the part that can matter.

    Attributes:
        names: the C cameras that take part.
        cameras: float64 [C, 33] packed table (see `_hull_kernels`).
        boxes: int64 [C, 5] x0, y0, width, height of each piece and its offset in `field`.
        field: float32, the pieces one after the other.
        rejected: camera name -> why it does not take part.
    """

    names: tuple[str, ...]
    cameras: NDArray[np.float64]
    boxes: NDArray[np.int64]
    field: NDArray[np.float32]
    rejected: dict[str, str]

    def piece(self, c: int) -> NDArray[np.float32]:
        """[height, width] the stored piece of camera number c, px."""
        _, _, width, height, offset = self.boxes[c]
        return self.field[offset : offset + width * height].reshape(height, width)

    def with_masks(self, masks: Mapping[int, NDArray[np.uint8]]) -> Silhouettes:
        """The same with the masks (pieces, non-zero = foreground) of some camera numbers replaced."""
        field = self.field.copy()
        for c, mask in masks.items():
            offset = self.boxes[c, 4]
            field[offset : offset + mask.size] = signed_distance_px(mask).ravel()
        return Silhouettes(self.names, self.cameras, self.boxes, field, self.rejected)

    def without(self, name: str, why: str) -> Silhouettes:
        """The same without one camera."""
        keep = [i for i, other in enumerate(self.names) if other != name]
        names = tuple(self.names[i] for i in keep)
        return Silhouettes(names, self.cameras[keep], self.boxes[keep], self.field, {**self.rejected, name: why})


def signed_distance_px(mask: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Exact Euclidean distance [height, width] to the outline of a mask, px, negative inside.

    The outline runs half-way between the last foreground and the first background pixel centre.
    """
    solid = np.not_equal(mask, 0).astype(np.uint8)
    distance = cv2.distanceTransform(solid, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    distance += cv2.distanceTransform(1 - solid, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    # OpenCV takes an approximate root where its vectors fit, so the last bit depends on the alignment in memory, and
    # the same bag would not give the same angles every time. Squared distances are whole numbers: round them, and take
    # the root anew.
    distance = np.sqrt(np.rint(np.square(distance))) - np.float32(0.5)
    return np.asarray(np.where(solid > 0, -distance, distance), dtype=np.float32)


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
        for i in np.flatnonzero(outer & (area < 0.005 * largest)):
            cv2.drawContours(piece, contours, int(i), 0, cv2.FILLED)
        for i in np.flatnonzero(~outer & (area < 0.015 * largest)):
            cv2.drawContours(piece, contours, int(i), 1, cv2.FILLED)
    out[y : y + height, x : x + width] = piece
    return out


def pack_cameras(rig: Rig) -> NDArray[np.float64]:
    """The table [len(rig.cameras), 33] that the kernels read."""
    return np.stack([pack_camera(camera) for camera in rig.cameras])


def pack_camera(camera: Camera) -> NDArray[np.float64]:
    """One row of the table that the kernels read."""
    row = np.zeros(kernels.CAMERA_COLUMNS)
    T = camera.T_camera_world
    row[0:9] = T[:3, :3].ravel()
    row[9:12] = T[:3, 3]
    row[12:16] = camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]
    if camera.distortion.any():
        row[16] = kernels.FISHEYE if camera.distortion_model == "fisheye" else kernels.POLYNOMIAL
        row[17 : 17 + camera.distortion.size] = camera.distortion
    row[31:33] = camera.width, camera.height
    return row


def measure_silhouettes(
    masks: Mapping[str, NDArray[np.uint8]], rig: Rig, packed: NDArray[np.float64], config: HullConfig
) -> Silhouettes:
    """Signed distance to the outline of every mask.

    Args:
        masks: camera name -> uint8 [height, width], non-zero = foreground.
        rig: the cameras.
        packed: float64 [len(rig.cameras), 33], `pack_camera` of each.
        config: the band decides how far outside a silhouette distances are needed.

    Raises:
        InputError: a mask has not its camera's size, or its camera is unknown.
    """
    for name, mask in masks.items():
        camera = rig.camera(name)
        if mask.shape != (camera.height, camera.width):
            raise InputError(
                f"camera {name}: expected a mask of {camera.width}x{camera.height} px as in the rig, "
                f"got {'x'.join(map(str, mask.shape[::-1]))}; is the stream scaled, or the rig file another camera's?"
            )
    corners = np.array(np.meshgrid(*np.stack([rig.volume_min, rig.volume_max], axis=1))).reshape(3, -1).T
    names: list[str] = []
    rows: list[int] = []
    boxes: list[tuple[int, int, int, int, int]] = []
    pieces: list[NDArray[np.float32]] = []
    rejected: dict[str, str] = {}
    offset = 0
    for row, camera in enumerate(rig.cameras):
        if camera.name not in masks:
            rejected[camera.name] = "no mask"
            continue
        mask = cleaned(masks[camera.name])
        x, y, width, height = cv2.boundingRect(mask)
        if width == 0:
            rejected[camera.name] = "empty mask"
            continue
        if cv2.countNonZero(mask) > 0.9 * mask.size:
            rejected[camera.name] = "mask is all foreground"
            continue
        # Beyond this margin every point of the volume is further than the band from the outline.
        position = camera.T_world_camera[:3, 3]
        inside = bool(((position > rig.volume_min - 0.5) & (position < rig.volume_max + 0.5)).all())
        depths = corners @ camera.T_camera_world[2, :3] + camera.T_camera_world[2, 3]
        nearest = 0.0 if inside else float(depths.min())
        margin = math.ceil(camera.K[0, 0] * config.band_m / nearest) + 2 if nearest > 0.3 else max(mask.shape)
        x0, y0 = max(0, x - margin), max(0, y - margin)
        x1, y1 = min(camera.width, x + width + margin), min(camera.height, y + height + margin)
        piece = np.ascontiguousarray(mask[y0:y1, x0:x1])
        pieces.append(signed_distance_px(piece).ravel())
        boxes.append((x0, y0, x1 - x0, y1 - y0, offset))
        offset += pieces[-1].size
        names.append(camera.name)
        rows.append(row)
    return Silhouettes(
        tuple(names),
        packed[rows],
        np.array(boxes, np.int64).reshape(-1, 5),
        np.concatenate(pieces) if pieces else np.zeros(0, np.float32),
        rejected,
    )
