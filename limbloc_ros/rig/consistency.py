# SPDX-License-Identifier: Apache-2.0
"""Do the cameras of a rig agree about a person? Silhouettes are carved coarsely and compared with what is left.

A hull lies inside every silhouette by construction, so what tells is foreground that no part of the hull explains:
with a true rig and clean masks there is none. A camera that is out of place cuts pieces off the hull, and then *all*
cameras show unexplained foreground; but without the guilty one, the others agree again. That is what is measured:
the contradiction of all cameras, and of the rest without each of them.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core._silhouettes_kernels import bounds
from limbloc_ros.core.camera import Camera, Rig
from limbloc_ros.core.lens import distort
from limbloc_ros.rig import _consistency_kernels as kernels

Array = NDArray[np.float64]
Mask = NDArray[np.uint8]

#: Images are looked at no wider or higher than this, px.
LOW_PX = 240
#: At most so many voxels.
MOST_VOXELS = 90_000
#: A camera whose foreground is smaller than this share of the image, or larger, says nothing.
FILL = (0.001, 0.6)


@dataclass(frozen=True)
class LowView:
    """A camera with small images.

    Attributes:
        camera: with K scaled to the small image.
        scale: small over large, px.
        ignored: uint8 [h, w] 1 where the image means nothing, or None.
    """

    camera: Camera
    scale: float
    ignored: Mask | None

    def shrink(self, mask: Mask) -> Mask:
        """A mask [height, width] as a small one of 0 and 1; regions to ignore are 0."""
        small = np.zeros((self.camera.height, self.camera.width), np.uint8)
        ones = np.ascontiguousarray(mask != 0).view(np.uint8)
        kernels.shrink(ones, bounds(ones), *_shares(ones.shape, small.shape), small)
        if self.ignored is not None:
            small[self.ignored != 0] = 0
        return small


@cache
def _shares(
    large: tuple[int, int], small: tuple[int, int]
) -> tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.int64], NDArray[np.float32], np.float32]:
    """What `kernels.shrink` reads of the sizes (height, width) of two images: what OpenCV's INTER_AREA does."""
    scales = [1.0 / (few / many) for many, few in zip(large, small, strict=True)]
    places_of, shares_of = [], []
    for many, few, scale in zip(large, small, scales, strict=True):
        places, shares = np.zeros((few, 2), np.int64), np.zeros((few, int(np.ceil(scale)) + 2), np.float32)
        for n in range(few):
            begin, end = n * scale, n * scale + scale
            cell = min(scale, many - begin)
            last = min(int(np.floor(end)), many - 1)
            first = min(int(np.ceil(begin)), last)
            parts = [(first - begin) / cell] if first - begin > 1e-3 else []
            places[n, 0] = first - len(parts)
            parts += [1.0 / cell] * (last - first)
            if end - last > 1e-3:
                parts.append(min(end - last, 1.0, cell) / cell)
            places[n, 1] = len(parts)
            shares[n, : len(parts)] = parts
        places_of.append(places)
        shares_of.append(shares)
    even = all(abs(scale - round(scale)) < np.finfo(float).eps for scale in scales)
    whole = np.float32(1.0 / (round(scales[0]) * round(scales[1])) if even else 0.0)
    return places_of[1], shares_of[1], places_of[0], shares_of[0], whole


@dataclass(frozen=True)
class Grid:
    """Voxels of a box of space and where each camera sees them.

    Attributes:
        views: of the rig's cameras, in their order.
        points: [V, 3] voxel centres, in the rig's unit.
        voxel: their edge.
        pixels: int32 [C, V] index into each small image, -1 where the camera does not see the voxel.
        reach: [C] px: half a voxel's size in each small image where it is largest.
    """

    views: tuple[LowView, ...]
    points: Array
    voxel: float
    pixels: NDArray[np.int32]
    reach: NDArray[np.int64]

    @property
    def names(self) -> tuple[str, ...]:
        """The cameras' names."""
        return tuple(view.camera.name for view in self.views)


@dataclass(frozen=True)
class Scores:
    """How the cameras agree in one frame or in several.

    Attributes:
        names: of the cameras with a usable mask.
        together: mean share of unexplained foreground with the hull of all of them; NaN with fewer than two.
        without: [C] the same of the others with the hull of the others, without each camera.
        unexplained: [C] share of each camera's foreground that the hull of all does not explain.
        alone: [C] share of each camera's foreground that lies outside the hull of all others.
    """

    names: tuple[str, ...]
    together: float
    without: Array
    unexplained: Array
    alone: Array

    @property
    def blame(self) -> Array:
        """[C] by how much the contradiction falls when a camera is left out."""
        return np.asarray(self.together - self.without)


def low_view(camera: Camera, low_px: int = LOW_PX) -> LowView:
    """A camera with small images, at most `low_px` wide and high."""
    scale = min(1.0, low_px / max(camera.width, camera.height))
    width, height = max(2, round(scale * camera.width)), max(2, round(scale * camera.height))
    A = np.array([[width / camera.width, 0, 0.0], [0, height / camera.height, 0.0], [0, 0, 1]])
    A[:2, 2] = 0.5 * np.diag(A)[:2] - 0.5
    ignored = camera.ignored_pixels()
    if ignored is not None:
        ignored = np.asarray(cv2.resize(ignored, (width, height), interpolation=cv2.INTER_NEAREST), dtype=np.uint8)
    small = replace(camera, width=width, height=height, K=A @ camera.K, ignore=())
    return LowView(small, scale, ignored)


def look_up(camera: Camera, points: Array) -> NDArray[np.int32]:
    """[V] index of each point's pixel in the flattened image, -1 where it is not seen."""
    T = camera.T_camera_world
    ahead = points @ T[:3, :3].T + T[:3, 3]
    depth = ahead[:, 2]
    plain = ahead[:, :2] / np.where(depth > 0, depth, np.inf)[:, None]
    if camera.distortion[12:].any():  # a tilted sensor
        uv = camera.world_to_image(points)[0]
    else:  # many times as fast
        bent = distort(camera, plain) if camera.distortion.any() else plain
        uv = bent * camera.K[[0, 1], [0, 1]] + camera.K[[0, 1], [2, 2]]
    uv = np.nan_to_num(uv, nan=-1.0, posinf=-1.0, neginf=-1.0)
    x, y = np.rint(uv).clip(-1e6, 1e6).astype(np.int64).T
    # Distortion folds far points back into the image: only those near it without distortion can be in it.
    limit = 1.4 * np.array([camera.width, camera.height]) / camera.K[[0, 1], [0, 1]]
    seen = (depth > 0) & (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
    seen &= (np.abs(plain) < limit).all(axis=1)
    return np.where(seen, y * camera.width + x, -1).astype(np.int32)


def make_grid(
    rig: Rig, low: Array | None = None, high: Array | None = None, most: int = MOST_VOXELS, low_px: int = LOW_PX
) -> Grid:
    """Voxels of the carve volume, or of the box from low to high, as fine as `most` allows; images of `low_px`."""
    low = rig.volume_min if low is None else np.asarray(low, dtype=np.float64)
    high = rig.volume_max if high is None else np.asarray(high, dtype=np.float64)
    voxel = float(np.cbrt(np.prod(high - low) / most))
    axes = [np.arange(low[a] + 0.5 * voxel, high[a], voxel) for a in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    views = tuple(low_view(camera, low_px) for camera in rig.cameras)
    middle = (low + high) / 2
    pixels = np.stack([look_up(view.camera, points) for view in views])
    reach = []
    for view in views:
        distance = max(float(np.linalg.norm(view.camera.T_world_camera[:3, 3] - middle)), 1e-9)
        reach.append(int(np.ceil(0.87 * voxel * view.camera.K[0, 0] / distance)))
    return Grid(views, points, voxel, pixels, np.array(reach))


def shrink_masks(views: Sequence[LowView], masks: Mapping[str, Mask]) -> dict[int, Mask]:
    """Camera index -> small mask, of those whose mask says something."""
    out = {}
    for c, view in enumerate(views):
        mask = masks.get(view.camera.name)
        if mask is None:
            continue
        small = view.shrink(mask)
        if FILL[0] * small.size <= int(small.sum()) <= FILL[1] * small.size:
            out[c] = small
    return out


def inside(grid: Grid, camera: int, mask: Mask, chosen: NDArray[np.int64] | None = None) -> NDArray[np.bool_]:
    """[V] voxels that the camera does not deny: on its foreground, unseen by it, or where it is to be ignored."""
    pixels = grid.pixels[camera] if chosen is None else grid.pixels[camera][chosen]
    return np.asarray((_opened(grid, camera, mask).ravel()[pixels] != 0) | (pixels < 0))


def _opened(grid: Grid, camera: int, mask: Mask) -> Mask:
    ignored = grid.views[camera].ignored
    return mask if ignored is None else mask | ignored


def cover(grid: Grid, camera: int, voxels: NDArray[np.int64]) -> Mask:
    """Pixels (0 or 1) of a small image that voxels project to, with their size."""
    camera_ = grid.views[camera].camera
    pixels = grid.pixels[camera][voxels]
    return splat(pixels[pixels >= 0], (camera_.height, camera_.width), int(grid.reach[camera]))


def splat(pixels: NDArray[np.int32], shape: tuple[int, int], reach: int) -> Mask:
    """An image with these pixels and what is within `reach` of them set to 1."""
    image = np.zeros(shape, np.uint8)
    image.ravel()[pixels] = 1
    return np.asarray(cv2.dilate(image, _ellipse(reach)), dtype=np.uint8)


@cache
def _ellipse(reach: int) -> Mask:
    """What is within `reach` of a pixel; uint8 [2 reach + 1, 2 reach + 1]."""
    size = (2 * reach + 1, 2 * reach + 1)
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, size), dtype=np.uint8)


def unexplained_share(mask: Mask, covered: Mask) -> float:
    """Share of the foreground, but its rim, that is not covered; 0 where there is no inner foreground."""
    return share_outside(core_of(mask), covered)


def core_of(mask: Mask) -> Mask:
    """The foreground without its rim, which voxels are too coarse to explain."""
    return np.asarray(cv2.erode(mask, np.ones((3, 3), np.uint8)), dtype=np.uint8)


def share_outside(core: Mask, covered: Mask) -> float:
    """Share of the pixels of `core` that are not covered; 0 without any."""
    total = cv2.countNonZero(core)
    return 1.0 - cv2.countNonZero(cv2.bitwise_and(core, covered)) / total if total else 0.0


def score(grid: Grid, masks: Mapping[int, Mask]) -> Scores:
    """How the cameras agree in one frame.

    Args:
        grid: the voxels.
        masks: of `shrink_masks`: camera index -> small mask.
    """
    cameras = list(masks)
    names = tuple(grid.names[c] for c in cameras)
    if len(cameras) < 2:
        nothing = np.full(len(cameras), np.nan)
        return Scores(names, float("nan"), nothing, nothing, nothing)
    # As in carving: what most cameras do not see is nobody's hull.
    numbers = np.array(cameras)
    opened = [_opened(grid, c, masks[c]) for c in cameras]
    sizes = [image.size for image in opened]
    offsets = np.cumsum([0, *sizes[:-1]])
    voxels, who = kernels.sole_deniers(grid.pixels, numbers, np.concatenate(opened, axis=None), offsets)
    order = np.argsort(who, kind="stable")
    begins = np.searchsorted(who[order], np.arange(len(cameras) + 2))
    cores = [core_of(masks[c]) for c in cameras]
    frames = np.array([(first, *core.shape[::-1]) for first, core in zip(offsets, cores, strict=True)])
    marks = np.concatenate([core != 0 for core in cores], axis=None).view(np.uint8)
    counts = kernels.explained(grid.pixels, numbers, voxels[order], begins, marks, frames, _halves(grid.reach[numbers]))
    totals = np.array([cv2.countNonZero(core) for core in cores])
    shares = np.where(totals > 0, 1.0 - counts / np.maximum(totals, 1), 0.0)
    unexplained, without = shares[-1], np.full(len(cameras), np.nan)
    for i in range(len(cameras)):
        others = np.delete(shares[i], i)
        if len(others) > 1:  # two cameras alone nearly always agree
            without[i] = float(np.mean(others))
    return Scores(names, float(unexplained.mean()), without, unexplained, shares.diagonal().copy())


def _halves(reach: NDArray[np.int64]) -> NDArray[np.int64]:
    """What `kernels.explained` reads of the ellipses that `splat` draws."""
    most = int(reach.max())
    halves = np.full((len(reach), 2 * most + 1), -1)
    for row, own in zip(halves, reach.tolist(), strict=True):
        row[most - own : most + own + 1] = (_ellipse(own).sum(axis=1, dtype=np.int64) - 1) // 2
    return halves


def mean_scores(scores: Collection[Scores], names: Sequence[str]) -> Scores:
    """The mean over frames, for the cameras `names`; NaN for those that no frame has."""
    rows = {key: np.full((len(scores), len(names)), np.nan) for key in ("without", "unexplained", "alone")}
    for f, one in enumerate(scores):
        at = [names.index(name) for name in one.names]
        for key, row in rows.items():
            row[f, at] = getattr(one, key)
    together = np.array([one.together for one in scores])

    def mean(values: Array) -> Array:
        good = np.isfinite(values)
        return np.asarray(
            np.where(good, values, 0.0).sum(axis=0) / np.where(good.any(axis=0), good.sum(axis=0), np.nan)
        )

    return Scores(tuple(names), float(mean(together)), *(mean(rows[k]) for k in ("without", "unexplained", "alone")))
