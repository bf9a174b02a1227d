# SPDX-License-Identifier: Apache-2.0
"""What every camera saw of the person, coarsely: the judge of figures that explain a hull equally well.

A hull keeps of all silhouettes only the most cautious: where one mask lost an arm, or is ragged, that mask alone
decides. The silhouettes themselves still say what all others saw. So a figure is drawn into every camera, and the area
that it and the silhouette do not share is measured: eq. 2 of the paper, in the images instead of the volume.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core import _projection_kernels as projection
from limbloc_ros.core import _views_kernels as kernels
from limbloc_ros.core.errors import InputError
from limbloc_ros.core.pose import Flesh
from limbloc_ros.core.silhouettes import Silhouettes

Array = NDArray[np.float64]

#: Edge of a cell at the person's distance, m: an arm is seven cells wide. Never less than a pixel.
CELL_M = 0.012
#: So far beyond the silhouette a figure that leaves it is still counted, m.
MARGIN_M = 0.2
#: A camera that sees less than this share of what the one that sees most sees, at the image's border or of somebody
#: who is hidden, counts less than the others: of a few cells any figure misses many times as many.
LEAST_SHARE = 0.1
#: More than these are no views.
MOST_CAMERAS, MOST_CELLS = 255, 1_000_000


@dataclass(frozen=True)
class Views:
    """The silhouettes of one frame in coarse cells, and the cameras that saw them.

    Attributes:
        cameras: float64 [C, 35] packed table (see `_projection_kernels`).
        frames: int64 [C, 6] for each camera first column and row (px), cells across and down, edge of a cell (px), and
            the first cell in `cells`.
        cells: uint8, row by row and camera after camera: 0 background, 1 foreground, 2 not asked about.
    """

    cameras: Array
    frames: NDArray[np.int64]
    cells: NDArray[np.uint8]

    @staticmethod
    def of(silhouettes: Silhouettes, points: Array) -> Views:
        """The silhouettes' blobs that hold some of the hull; of regions to ignore nobody is asked.

        Args:
            silhouettes: as they were carved with.
            points: [P, 3] m, some points in the hull.
        """
        cameras = silhouettes.cameras
        frames = np.zeros((len(cameras), 6), np.int64)
        middle = points.mean(axis=0)
        depths = cameras[:, 6:9] @ middle + cameras[:, 11]
        count = 0
        for c, (x, y, width, height, _) in enumerate(silhouettes.counts.frames.tolist()):
            depth, focal = max(0.5, float(depths[c])), float(cameras[c, 12])
            step, margin = max(1, round(CELL_M * focal / depth)), math.ceil(MARGIN_M * focal / depth)
            left, top = max(0, x - margin), max(0, y - margin)
            right = min(int(cameras[c, 31]), x + width + margin)
            bottom = min(int(cameras[c, 32]), y + height + margin)
            columns, rows = max(0, right - left) // step, max(0, bottom - top) // step
            frames[c] = left, top, columns, rows, step, count
            count += columns * rows
        cells, marks = np.zeros((2, count), np.uint8)
        kernels.sample_cells(silhouettes.field, silhouettes.boxes, frames, cells)
        kernels.mark_points(np.ascontiguousarray(points.T), cameras, frames, marks)
        boxes = []
        images = zip(frames.tolist(), silhouettes.ignored, _images(frames, cells), _images(frames, marks), strict=True)
        for (left, top, _, _, step, _), ignored, image, held in images:
            if image.size and ignored is not None:  # foreground, for the hull's sake
                at = (
                    first + step // 2 + step * np.arange(n) for first, n in zip((top, left), image.shape, strict=True)
                )
                image[ignored[np.ix_(*at)] > 0] = kernels.UNASKED
            boxes.append(kernels.keep_held(image, held))
        return Views(cameras, frames, cells)._cropped(boxes)

    def _cropped(self, boxes: Sequence[tuple[int, int, int, int]]) -> Views:
        """The same with no more than a margin around each silhouette, which lies in a box: first and last (exclusive)
        column and row."""
        frames, images = self.frames.copy(), []
        margin = round(MARGIN_M / CELL_M)
        count = 0
        for frame, image, (x0, x1, y0, y1) in zip(frames, _images(self.frames, self.cells), boxes, strict=True):
            left, top = max(0, x0 - margin), max(0, y0 - margin)
            part = image[top : y1 + margin, left : x1 + margin] if x1 else image[:0, :0]
            step = int(frame[4])
            frame[:4] += left * step, top * step, 0, 0
            frame[2], frame[3], frame[5] = part.shape[1], part.shape[0], count
            count += part.size
            images.append(part.ravel())
        return Views(self.cameras, frames, np.concatenate(images) if images else self.cells)

    def without(self, others: Sequence[Flesh]) -> Views:
        """The same without what other people explain of the silhouettes: nobody is asked about that."""
        cells = self.cells.copy()
        for body in others:
            drawn = self.drawn(body.parts, body.centres, body.radii)
            cells[(drawn != 0) & (cells == kernels.SEEN)] = kernels.UNASKED
        return replace(self, cells=cells)

    @cached_property
    def packed(self) -> bytes:
        """All of it in few bytes; `unpacked` makes the very same of them."""
        shape = np.array([len(self.cameras), len(self.cells)], "<u4")
        numbers = self.cameras.astype("<f8").tobytes() + self.frames.astype("<i8").tobytes()
        bits = [np.packbits(self.cells == kind).tobytes() for kind in (kernels.SEEN, kernels.UNASKED)]
        return shape.tobytes() + zlib.compress(numbers + b"".join(bits), 1)

    def fits(self, room: int) -> bool:
        """Whether these views can be sent in so many bytes."""
        if len(self.cameras) > MOST_CAMERAS or len(self.cells) > MOST_CELLS:
            return False
        loose = 8 * (self.cameras.size + self.frames.size) + len(self.cells) // 4 + 100
        # What cannot be compressed at all grows by an eighth at most: mostly there is room for that anyway.
        return 9 * loose <= 8 * room or len(self.packed) <= room

    @staticmethod
    def unpacked(data: bytes) -> Views:
        """What was `packed`.

        Raises:
            InputError: these bytes are no views.
        """
        if len(data) < 8:
            raise InputError(f"packed views have 8 bytes or more, got {len(data)}")
        count, size = (int(n) for n in np.frombuffer(data[:8], "<u4"))
        columns = projection.CAMERA_COLUMNS
        expected = count * 8 * (columns + 6) + 2 * ((size + 7) // 8)
        if not 0 < count <= MOST_CAMERAS or size > MOST_CELLS:
            raise InputError(
                f"expected views of 1 to {MOST_CAMERAS} cameras and at most {MOST_CELLS} cells, got {count} and {size}"
            )
        reader = zlib.decompressobj()
        try:
            found = reader.decompress(data[8:], expected + 1)
        except zlib.error as error:
            raise InputError(f"packed views cannot be read: {error}") from error
        if len(found) != expected or not reader.eof or reader.unused_data:
            raise InputError(f"views of {count} cameras and {size} cells need {expected} bytes; others were packed")
        cut = count * 8 * columns
        cameras = np.frombuffer(found[:cut], "<f8").reshape(count, columns).copy()
        frames = np.frombuffer(found[cut : cut + count * 48], "<i8").reshape(count, 6).copy()
        bits = np.frombuffer(found[cut + count * 48 :], np.uint8).reshape(2, -1)
        seen, unasked = np.unpackbits(bits, axis=1, count=size)
        _check(cameras, frames, size)
        return Views(cameras, frames, np.where(unasked, np.uint8(kernels.UNASKED), seen))

    def drawn(self, parts: NDArray[np.int64], centres: Array, radii: Array) -> NDArray[np.int16]:
        """Which cells a figure of parts [P, 3] over balls (centres [S, 3], radii [S], m) covers."""
        out = np.zeros(len(self.cells), np.int16)
        kernels.draw(*_contiguous(parts, centres, radii), self.cameras, self.frames, self.cells, out)
        return out

    def mismatch(self, parts: NDArray[np.int64], centres: Array, radii: Array) -> float:
        """Area that the figure and the silhouettes do not share over that of the silhouettes; mean of the cameras that
        see anybody, in which one that sees far less than others (LEAST_SHARE) has less of a say."""
        figure = _contiguous(parts, centres, radii)
        counts = kernels.covered(*figure, self.cameras, self.frames, *self._bits)
        return float(self.worth @ (self.sizes - counts[:, 0] + counts[:, 1]))

    def shares(
        self, parts: NDArray[np.int64], groups: NDArray[np.int64], centres: Array, radii: Array
    ) -> tuple[Array, float]:
        """What each group of parts (`groups` [P], from 0 on) alone covers of the silhouettes, and the `mismatch`.

        Returns:
            [G] area over that of the silhouettes, mean of the cameras as in the mismatch; and that.
        """
        count = int(groups.max()) + 1
        counts = kernels.draw_groups(parts, groups, count, centres, radii, self.cameras, self.frames, self.cells)
        mismatch = self.sizes - counts[:, count] + counts[:, count + 1]
        return np.asarray(self.worth @ counts[:, :count]), float(self.worth @ mismatch)

    @cached_property
    def _bits(self) -> tuple[NDArray[np.uint64], NDArray[np.uint64]]:
        """Which cells are foreground, and background, 64 cells a word."""
        kinds = np.zeros((2, -(-len(self.cells) // 64) * 64), np.bool_)
        kinds[0, : len(self.cells)] = self.cells == kernels.SEEN
        kinds[1, : len(self.cells)] = self.cells == kernels.BARE
        seen, bare = np.packbits(kinds, axis=1, bitorder="little").view("<u8").astype(np.uint64)
        return seen, bare

    @cached_property
    def sizes(self) -> NDArray[np.int64]:
        """[C] cells of each silhouette."""
        return np.array([np.count_nonzero(image == kernels.SEEN) for image in _images(self.frames, self.cells)])

    @cached_property
    def worth(self) -> Array:
        """[C] what one cell of each camera counts in the mismatch."""
        seen = self.sizes > 0
        least = max(1.0, LEAST_SHARE * float(self.sizes.max()))
        return np.asarray(np.where(seen, 1.0 / np.maximum(self.sizes, least), 0.0) / max(np.count_nonzero(seen), 1))

    def open_cells(self, body: NDArray[np.int16], most: int) -> tuple[NDArray[np.int64], Array]:
        """Some cells of the silhouettes that a body, as it was `drawn`, leaves open, and what each stands for."""
        asked = np.flatnonzero((self.cells == kernels.SEEN) & (body == 0))
        every = -(-len(asked) // most) or 1
        asked = asked[every // 2 :: every]
        return asked, self.worth[np.searchsorted(self.frames[:, 5], asked, side="right") - 1] * every

    def limbs(
        self, parts: NDArray[np.int64], moving: NDArray[np.int64], placed: Array, balls: Array,
        body: NDArray[np.int16], asked: NDArray[np.int64],
    ) -> tuple[NDArray[np.bool_], Array]:  # fmt: skip
        """What a limb explains of the silhouettes beside the body, and what it covers of background, in many places.

        Args:
            parts: [P, 3] the limb's.
            moving: [S] balls that move with it.
            placed: [M, S, 3] where these are in each place, m.
            balls: [S_all, 4] radius and place of all balls, m.
            body: the rest of the figure as it was `drawn`.
            asked: [Q] indices of cells.

        Returns:
            bool [M, Q] whether a limb covers these cells, and [M] the mismatch that it adds on the background.
        """
        covers = np.zeros((len(placed), len(asked)), np.bool_)
        bare = np.zeros((len(self.frames), len(placed)), np.int64)
        kernels.draw_limbs(
            parts, moving, placed, balls, self.cameras, self.frames, self.cells, body.copy(), asked, covers, bare
        )
        return covers, self.worth @ bare


def _contiguous(parts: NDArray[np.int64], centres: Array, radii: Array) -> tuple[NDArray[np.int64], Array, Array]:
    """Parts of other arrays, too: kernels are compiled for one layout, not again in the first frame with others."""
    return np.ascontiguousarray(parts), np.ascontiguousarray(centres), np.ascontiguousarray(radii)


def _check(cameras: Array, frames: NDArray[np.int64], size: int) -> None:
    """Raise InputError where the kernels could read or draw beside the cells."""
    _, _, width, height, step, offset = frames.T
    fair = (np.abs(frames) < MOST_CELLS).all() and (frames[:, :4] >= 0).all() and (step > 0).all()
    cells = width * height
    fair = fair and ((width == 0) == (height == 0)).all()  # no rows to go through that have no cells
    if not fair or (offset != np.cumsum(cells) - cells).any() or int(cells.sum()) != size:
        raise InputError("the frames of packed views do not fit their cells")
    if not (np.abs(cameras) < 1e9).all() or (cameras[:, 12:14] <= 0).any() or (cameras[:, 31:33] < 2).any():
        raise InputError(
            "packed views hold a camera that cannot be: expected finite numbers and a focal length above 0"
        )


def _images(frames: NDArray[np.int64], cells: NDArray[np.uint8]) -> list[NDArray[np.uint8]]:
    return [cells[offset : offset + width * height].reshape(height, width) for _, _, width, height, _, offset in frames]
