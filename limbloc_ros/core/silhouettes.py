# SPDX-License-Identifier: Apache-2.0
"""Masks -> the signed distance to each silhouette's outline, cut to the piece that can matter."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core import _block_kernels as near
from limbloc_ros.core import _projection_kernels as projection
from limbloc_ros.core import _silhouettes_kernels as kernels
from limbloc_ros.core._hull_kernels import LEAF
from limbloc_ros.core.camera import Camera, Rig
from limbloc_ros.core.config import HullConfig
from limbloc_ros.core.errors import InputError, RigError
from limbloc_ros.core.lens import lens_range

#: Coarsest blocks of the hierarchy, in voxels; halved until they are leaves.
ROOT = 32
#: A blob is a speck when the largest one has so many times its area; a lone pixel's area, as contours give it.
SMALL_BLOB, LONE_AREA = 200.0, 0.5


@dataclass(frozen=True)
class PixelCounts:
    """How many pixels of one kind any rectangle of any camera's image holds, from four sums.

    Attributes:
        frames: int64 [C, 5] x0, y0, width, height of the smallest rectangle around all such pixels of each camera, and
            the offset of its sums; width 0 where there is none.
        sums: int32, for each camera [height + 1, width + 1]: how many lie above and left of each pixel's corner.
    """

    frames: NDArray[np.int64]
    sums: NDArray[np.int32]

    @staticmethod
    def of(pieces: Iterable[tuple[NDArray[np.uint8], int, int]]) -> PixelCounts:
        """Count the ones of the smallest piece [height, width] around them of every image; its first column and row."""
        pieces = list(pieces)
        counts = PixelCounts._empty(
            [(x, y, *piece.shape[::-1]) if piece.size else (x, y, 0, 0) for piece, x, y in pieces]
        )
        for c, (piece, _, _) in enumerate(pieces):
            if piece.size:
                cv2.integral(piece, counts._table(c), cv2.CV_32S)  # into it
        return counts

    def pick(self, cameras: Iterable[int], replaced: Mapping[int, PixelCounts] | None = None) -> PixelCounts:
        """The same of some camera numbers, those of `replaced` with the first camera's counts there."""
        sources = [(self, c) if replaced is None or c not in replaced else (replaced[c], 0) for c in cameras]
        picked = PixelCounts._empty([source.frames[row, :4].tolist() for source, row in sources])
        for c, (source, row) in enumerate(sources):
            picked._table(c)[:] = source._table(row)
        return picked

    @staticmethod
    def _empty(rectangles: Sequence[Sequence[int]]) -> PixelCounts:
        """For x0, y0, width, height of each camera, nothing counted yet."""
        frames = np.zeros((len(rectangles), 5), np.int64)
        offset = 0
        for c, (x, y, width, height) in enumerate(rectangles):
            frames[c] = x, y, width, height, offset
            offset += (width + 1) * (height + 1) if width else 0
        return PixelCounts(frames, np.empty(offset, np.int32))

    def _table(self, c: int) -> NDArray[np.int32]:
        """The sums [height + 1, width + 1] of camera number c; [0, 0] where nothing is to be counted."""
        _, _, width, height, offset = self.frames[c].tolist()
        rows, columns = (height + 1, width + 1) if width else (0, 0)
        return self.sums[offset : offset + rows * columns].reshape(rows, columns)


@dataclass(frozen=True)
class Silhouettes:
    """The 2D signed distance (px, negative inside) of each usable mask, cut to the part that can matter.

    Attributes:
        names: the C cameras that take part.
        cameras: float64 [C, 35] packed table (see `_projection_kernels`).
        boxes: int64 [C, 5] x0, y0, width, height of each piece and its offset in `field`.
        field: float32, the pieces one after the other.
        rejected: camera name -> why it does not take part.
        masks: the smallest rectangle around each mask's foreground (`counts.frames` says where), uint8 [height, width],
            0 or 1; regions to ignore are foreground, so that nothing is carved there.
        counts: how many foreground pixels each mask has up to a pixel.
        margins: float64 [C] px from a mask to its piece's border, and the largest distance in it: further out, every
            point that can matter is further from the silhouette than the band.
        voxel_m: edge length of a voxel, m.
        lattice: int64 [2, 3] lowest and highest (exclusive) lattice indices in the carve volume.
        band_m: how far outside a silhouette distances are needed, m.
        blocks: int32 [B, 3] lowest lattice indices of the blocks of LEAF voxels that can hold voxels that matter.
        nearest: float64 [C] the least depth at which each camera may see a voxel of the blocks, m; inf if it sees none.
        ignored: uint8 [height, width] of each camera, 1 where its image means nothing; None where it has no such part.
    """

    names: tuple[str, ...]
    cameras: NDArray[np.float64]
    boxes: NDArray[np.int64]
    field: NDArray[np.float32]
    rejected: dict[str, str]
    masks: tuple[NDArray[np.uint8], ...]
    counts: PixelCounts
    margins: NDArray[np.float64]
    voxel_m: float
    lattice: NDArray[np.int64]
    band_m: float
    blocks: NDArray[np.int32]
    nearest: NDArray[np.float64]
    ignored: tuple[NDArray[np.uint8] | None, ...]

    def piece(self, c: int) -> NDArray[np.float32]:
        """[height, width] the stored piece of camera number c, px."""
        _, _, width, height, offset = self.boxes[c].tolist()
        return self.field[offset : offset + width * height].reshape(height, width)

    def whole_mask(self, c: int) -> NDArray[np.uint8]:
        """[height, width] the mask of camera number c, 0 or 1, as large as its image."""
        return self.part_of_mask(c, 0, int(self.cameras[c, 31]), 0, int(self.cameras[c, 32]))[0]

    def part_of_mask(self, c: int, left: int, right: int, top: int, bottom: int) -> tuple[NDArray[np.uint8], int, int]:
        """A copy of camera number c's mask, as much as holds all foreground and these columns and rows.

        The last column and row are exclusive.

        Returns:
            the part [height, width], 0 or 1, and its first column and row.
        """
        x, y, width, height, _ = self.counts.frames[c].tolist()
        left, top, right, bottom = min(left, x), min(top, y), max(right, x + width), max(bottom, y + height)
        part = np.zeros((bottom - top, right - left), np.uint8)
        part[y - top : y - top + height, x - left : x - left + width] = self.masks[c]
        return part, left, top

    def with_masks(self, masks: Mapping[int, tuple[NDArray[np.uint8], int, int]]) -> Silhouettes:
        """The same with the masks (0 or 1) of some camera numbers replaced by larger ones.

        Of each the part that holds all foreground, and its first column and row.
        """
        new = {c: _outlined(*part) for c, part in masks.items()}
        every = tuple(new[c][0] if c in new else mask for c, mask in enumerate(self.masks))
        counts = self.counts.pick(range(len(every)), {c: PixelCounts.of([part]) for c, part in new.items()})
        return _measured(replace(self, masks=every, counts=counts), self)

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
            counts=self.counts.pick(keep),
            margins=self.margins[keep],
            blocks=self.blocks[:0],  # without a camera there are more: all are looked for again
            nearest=self.nearest[keep],
            ignored=tuple(self.ignored[i] for i in keep),
        )
        return _measured(rest, rest)

    def gained_since(self, before: Silhouettes) -> PixelCounts:
        """How many foreground pixels of each image, up to a pixel, were none before."""
        gained = []
        for c, mask in enumerate(self.masks):
            x, y, width, height, _ = self.counts.frames[c].tolist()
            if mask is before.masks[c]:
                gained.append((mask[:0], x, y))
                continue
            was, _, _ = before.part_of_mask(c, x, x + width, y, y + height)
            gained.append(_outlined(np.greater(mask, was).view(np.uint8), x, y))
        return PixelCounts.of(gained)

    def changes_since(self, before: Silhouettes) -> PixelCounts:
        """Where another distance than before is read, if it is nearer than the margin; the masks may only have grown.

        Returns:
            how many such pixels each image has up to a pixel.
        """
        changed = []
        for c, mask in enumerate(self.masks):
            x, y, width, height, _ = self.boxes[c].tolist()
            if mask is before.masks[c]:
                changed.append((np.zeros((0, 0), np.uint8), x, y))
                continue
            x_old, y_old, width_old, height_old, _ = before.boxes[c].tolist()
            x0, x1 = max(x, x_old), min(x + width, x_old + width_old)
            y0, y1 = max(y, y_old), min(y + height, y_old + height_old)
            old = np.full((height, width), self.margins[c] - 0.5, np.float32)
            old[y0 - y : y1 - y, x0 - x : x1 - x] = before.piece(c)[y0 - y_old : y1 - y_old, x0 - x_old : x1 - x_old]
            changed.append(_outlined(np.less(self.piece(c), old).view(np.uint8), x, y))
        return PixelCounts.of(changed)


#: No pixel of any camera.
_NONE = PixelCounts(np.zeros((0, 5), np.int64), np.zeros(0, np.int32))


def signed_distance_px(mask: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Exact Euclidean distance [height, width] to the outline of a mask, px, negative inside.

    The outline runs half-way between the last foreground and the first background pixel centre. (OpenCV's exact
    transform takes an approximate root where its vectors fit: its last bit depends on the alignment in memory, and
    the same bag would not give the same angles every time. It is also slower for both sides of an outline.)
    """
    out = np.empty(mask.shape, np.float32)
    _measure(np.not_equal(mask, 0).view(np.uint8), sum(mask.shape), out)
    return out


def cleaned(mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A mask without specks and pinholes: what is far too small, beside the largest blob, to be body or daylight.

    Specks would make phantom voxels; a pinhole drills a tunnel through the body. A blob is dropped below 0.5 % of
    the largest blob's area, an enclosed hole filled below 1.5 % of it (a gap between arm and trunk is larger).

    Args:
        mask: uint8 [height, width], non-zero = foreground.

    Returns:
        uint8 [height, width], 0 or 1.
    """
    piece, x, y = _cleaned_piece(mask)
    out = np.zeros(mask.shape, np.uint8)
    out[y : y + piece.shape[0], x : x + piece.shape[1]] = piece
    return out


def _cleaned_piece(mask: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], int, int]:
    """The smallest part of the cleaned mask that holds all its foreground, and its first column and row."""
    mask = np.require(mask, np.uint8, ["C", "W"])  # whatever it is: the kernels are compiled for one kind
    x, y, width, height = kernels.bounds(mask)
    if width == 0:
        return np.zeros((0, 0), np.uint8), x, y
    # Most specks are lone pixels: dropped at once, where the largest blob is large enough, which nearly always is so.
    rest, left, top = _outlined(kernels.without_lone_pixels(mask, x, y, width, height), x, y)
    if rest.size:
        largest, dropped = _drop_small(rest)
        if largest > SMALL_BLOB * LONE_AREA:
            return _outlined(rest, left, top) if dropped else (rest, left, top)
    every = np.not_equal(mask[y : y + height, x : x + width], 0).view(np.uint8)
    _drop_small(every)
    return _outlined(every, x, y)


def _drop_small(piece: NDArray[np.uint8]) -> tuple[float, bool]:
    """In place: blobs and holes that are far too small beside the largest blob go.

    Returns:
        the largest blob's area, px, and whether blobs went.
    """
    contours, hierarchy = cv2.findContours(piece, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    # A contour runs through the centres of its pixels: half its length more is the area of the pixels themselves,
    # half its length less that of the hole it surrounds.
    outer = [parent < 0 for parent in hierarchy[0, :, 3].tolist()]
    areas = [
        cv2.contourArea(contour) + (0.5 if blob else -0.5) * len(contour)
        for contour, blob in zip(contours, outer, strict=True)
    ]
    largest = max(area for area, blob in zip(areas, outer, strict=True) if blob)
    blobs = [n for n, blob in enumerate(outer) if blob and areas[n] < largest / SMALL_BLOB]
    holes = [n for n, blob in enumerate(outer) if not blob and areas[n] < 0.015 * largest]
    # One by one, for those that touch must not cancel out; only the one, for OpenCV copies the list it is given.
    for n in blobs:
        cv2.drawContours(piece, [contours[n]], 0, 0, cv2.FILLED)
    for n in holes:
        cv2.drawContours(piece, [contours[n]], 0, 1, cv2.FILLED)
    return largest, bool(blobs)


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
    if not np.isfinite(reach):
        corners = np.array([[0.0, 0.0], [camera.width - 1, 0.0], [0.0, camera.height - 1]])
        corners = np.concatenate([corners, [[camera.width - 1, camera.height - 1]]]) - camera.K[:2, 2]
        reach = (1 + 1e-9) * float(np.linalg.norm(corners / np.diag(camera.K)[:2], axis=1).max())
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
    usable: list[tuple[NDArray[np.uint8], int, int]] = []
    ignored: list[NDArray[np.uint8] | None] = []
    rows: list[int] = []
    rejected: dict[str, str] = {}
    for row, camera in enumerate(rig.cameras):
        if camera.name not in masks:
            rejected[camera.name] = "no mask"
            continue
        blind = camera.ignored_pixels()
        mask = masks[camera.name] if blind is None else np.where(blind, np.uint8(0), masks[camera.name])
        piece, x, y = _cleaned_piece(mask)
        foreground = cv2.countNonZero(piece) if piece.size else 0
        if foreground == 0:
            rejected[camera.name] = "empty mask"
        elif foreground > 0.9 * mask.size:
            rejected[camera.name] = "mask is all foreground"
        else:
            if blind is not None:
                whole = blind.copy()
                whole[y : y + piece.shape[0], x : x + piece.shape[1]] |= piece
                piece, x, y = _outlined(whole, 0, 0)
            usable.append((piece, x, y))
            ignored.append(blind)
            rows.append(row)
    silhouettes = Silhouettes(
        names=tuple(rig.cameras[row].name for row in rows),
        cameras=packed[rows],
        boxes=np.zeros((len(rows), 5), np.int64),
        field=np.zeros(0, np.float32),
        rejected=rejected,
        masks=tuple(piece for piece, _, _ in usable),
        counts=PixelCounts.of(usable),
        margins=np.zeros(len(rows)),
        voxel_m=config.voxel_m,
        lattice=np.stack(lattice_bounds(rig, config.voxel_m)),
        band_m=config.band_m,
        blocks=np.zeros((0, 3), np.int32),
        nearest=np.full(len(rows), np.inf),
        ignored=tuple(ignored),
    )
    return _measured(silhouettes, None) if rows else silhouettes


def _outlined(mask: NDArray[np.uint8], left: int, top: int) -> tuple[NDArray[np.uint8], int, int]:
    """The smallest rectangle around the foreground of a mask whose first pixel is (left, top), and its first pixel."""
    x, y, width, height = kernels.bounds(np.ascontiguousarray(mask))
    return mask[y : y + height, x : x + width], left + x, top + y


def lattice_bounds(rig: Rig, voxel_m: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Lowest and highest (exclusive) lattice indices whose voxel centres lie in the carve volume."""
    low = np.ceil(rig.volume_min / voxel_m - 0.5 - 1e-9).astype(np.int64)
    high = np.floor(rig.volume_max / voxel_m - 0.5 + 1e-9).astype(np.int64) + 1
    return low, high


def min_seen(cameras: int) -> int:
    """So many of the cameras must see a voxel: what most do not see they do not carve, and it may be huge."""
    return max(min(2, cameras), cameras // 2 + 1)


def _measured(whole: Silhouettes, old: Silhouettes | None) -> Silhouettes:
    """Find the blocks near the hull, cut the piece that can matter out of every mask and measure it.

    Args:
        whole: masks and counts are right, all else is replaced.
        old: has pieces and blocks that may still do.
    """
    blocks = _new_blocks(whole, old)
    nearest = near.nearest_depths(blocks, LEAF, whole.voxel_m, whole.cameras)
    if old is not None and len(old.blocks):
        blocks, nearest = np.concatenate([old.blocks, blocks]), np.minimum(old.nearest, nearest)
    count = len(whole.names)
    images = whole.cameras[:, 31:33].astype(np.int64)  # width, height
    margins = images.sum(axis=1).astype(np.float64)
    seen = nearest > 0
    margins[seen] = np.minimum(margins[seen], np.ceil(whole.cameras[seen, 12] * whole.band_m / nearest[seen]) + 2)
    boxes = np.zeros((count, 5), np.int64)
    reused = [False] * count
    offset = 0
    for c, (mask, frame, (columns, rows)) in enumerate(
        zip(whole.masks, whole.counts.frames.tolist(), images.tolist(), strict=True)
    ):
        reused[c] = old is not None and mask is old.masks[c] and bool(margins[c] <= old.margins[c])
        if old is not None and reused[c]:
            margins[c] = old.margins[c]
            x0, y0, width, height, _ = old.boxes[c].tolist()
        else:
            x, y, width, height, _ = frame
            margin = int(margins[c])
            x0, y0 = max(x - margin, 0), max(y - margin, 0)
            width = min(x + width + margin, columns) - x0
            height = min(y + height + margin, rows) - y0
        boxes[c] = x0, y0, width, height, offset
        offset += width * height
    field = np.empty(offset, np.float32)
    measured = replace(whole, boxes=boxes, margins=margins, field=field, blocks=blocks, nearest=nearest)
    for c in range(count):
        if old is not None and reused[c]:
            measured.piece(c)[:] = old.piece(c)
        else:
            x, y, width, height, _ = boxes[c].tolist()
            piece, _, _ = whole.part_of_mask(c, x, x + width, y, y + height)
            _measure(piece, int(margins[c]), measured.piece(c))
    return measured


def _measure(mask: NDArray[np.uint8], most: int, out: NDArray[np.float32]) -> None:
    """Signed distances (px) of a mask of 0 and 1; outside, what is `most` or further away is not told from it."""
    short = kernels.SHORT_PX
    if most > short or not kernels.signed_distance(mask, most, short, np.empty(0, np.uint16), out):
        far = sum(mask.shape)
        kernels.signed_distance(mask, min(most, far), far, np.empty(0, np.int32), out)


def _new_blocks(whole: Silhouettes, old: Silhouettes | None) -> NDArray[np.int32]:
    """The blocks of LEAF voxels [B, 3] that can hold voxels that matter, but those that `old` has, which remain.

    Found by halving blocks that may hold some, which the masks alone tell. Only beside the foreground that was gained
    since then there can be more than `old` has; and what it has could hold some then, for masks only grow.
    """
    gained = whole.gained_since(old) if old is not None and len(old.blocks) else _NONE
    known = whole.blocks[:0] if old is None or gained is _NONE else old.blocks
    seen, band_m = min_seen(len(whole.names)), whole.band_m
    table = (whole.voxel_m, whole.cameras)
    low, high = whole.lattice
    blocks: NDArray[np.int32] = near.find_blocks(
        low, high, ROOT, LEAF, *table, whole.counts.frames, whole.counts.sums, band_m, seen,
        (gained.frames, gained.sums), known,
    )  # fmt: skip
    if old is None or gained is _NONE:
        return blocks
    before = near.near_blocks(blocks, LEAF, *table, old.counts.frames, old.counts.sums, band_m, seen)
    new: NDArray[np.int32] = blocks[~before]
    return new
