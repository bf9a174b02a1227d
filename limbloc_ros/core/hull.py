# SPDX-License-Identifier: Apache-2.0
"""Masks + cameras -> the visual hull as a signed distance field (paper section 1).

The paper keeps a voxel when every camera that sees it says foreground. Here each camera gives a signed distance
instead of a yes or no: the distance of the projected voxel to the silhouette's outline, in pixels, times depth over
focal length. The largest over the cameras is the hull's signed distance, good to a fraction of a voxel.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core import _block_kernels as near
from limbloc_ros.core import _component_kernels as apart
from limbloc_ros.core import _hull_kernels as kernels
from limbloc_ros.core import _mending_kernels as mending_kernels
from limbloc_ros.core import mending
from limbloc_ros.core._hull_kernels import LEAF
from limbloc_ros.core.camera import Rig
from limbloc_ros.core.config import HullConfig
from limbloc_ros.core.errors import InputError, NoPerson
from limbloc_ros.core.mending import INNER_PX, Voxels, cover_silhouettes
from limbloc_ros.core.silhouettes import (
    PixelCounts,
    Silhouettes,
    measure_silhouettes,
    min_seen,
    pack_cameras,
)
from limbloc_ros.core.views import Views

#: Fraction of unexplained foreground from which on the cameras contradict each other as much as we distinguish.
DOUBTED_FRACTION = 0.02
#: A part of the hull is a phantom when in all cameras but one less of what it covers is covered by it alone.
PHANTOM_SHARE = 0.1
#: Masks may cut a body in two, as where a belt has the wall's colour: one piece lies above the other, no further from
#: it than this, m (from shell to shell), on an area of no less than this, m^2 (a leg has 0.02), and has no less than
#: this share of its volume. People side by side do not lie above each other.
PIECE_GAP_M, PIECE_AREA_M2, PIECE_SHARE = 0.10, 0.012, 0.1
#: A carve volume that ends below this height, m, ends at the floor.
FLOOR_M = 0.5
#: By so many voxels of the hull its silhouettes are told from other blobs.
VIEW_POINTS = 500
#: In `Hull.cut_by`: no camera decided here.
NOBODY = 255


@dataclass(frozen=True)
class Hull:
    """A visual hull on the world's voxel lattice (see docs/conventions.md).

    Attributes:
        voxel_m: edge length of a voxel, m.
        index_min: (i, j, k) lattice indices of element [0, 0, 0]; voxel centres are (index + 0.5) * voxel_m.
        sdf: float32 [nx, ny, nz] signed distance, m; negative inside, clamped to band_m outside.
        band_m: where the clamp lies, m.
        cameras: names of the cameras that were used.
        rejected: camera name -> why its mask was not used.
        cut_by: uint8 [nx, ny, nz] which camera's silhouette decided the signed distance: a row of `viewpoints`, or
            NOBODY. None if that is not known.
        viewpoints: float32 [C, 3] centres of the cameras, m, world.
        views: what the cameras saw, by which figures are judged; None if that is not known.
    """

    voxel_m: float
    index_min: tuple[int, int, int]
    sdf: NDArray[np.float32]
    band_m: float
    cameras: tuple[str, ...] = ()
    rejected: dict[str, str] = field(default_factory=dict)
    cut_by: NDArray[np.uint8] | None = None
    viewpoints: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    views: Views | None = None

    @property
    def origin_m(self) -> NDArray[np.float64]:
        """[3] centre of element [0, 0, 0] in the world, m."""
        return (np.asarray(self.index_min) + 0.5) * self.voxel_m

    @property
    def inside_count(self) -> int:
        """Number of voxels inside."""
        return int(np.count_nonzero(self.sdf < 0))

    @property
    def cut_area_m2(self) -> float:
        """How much of the carve volume's sides lies inside the hull, m^2, but of the floor: what is beyond is unknown.

        Elsewhere the signed distance grows by no more than a voxel from voxel to voxel; there it jumps.
        """
        on_floor = not self.origin_m[2] > FLOOR_M  # people stand and lie on the floor
        faces = kernels.cut_faces(self.sdf, np.float32(self.band_m), on_floor)
        return float(faces) * self.voxel_m**2

    def shell(self) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        """The voxels that matter: the inside and the thin shell around it.

        Returns:
            lattice indices int32 [V, 3] and signed distances float32 [V] m, all below band_m, in array order.
        """
        first = np.asarray(self.index_min)
        return kernels.voxels_below(self.sdf, np.float32(self.band_m), first)  # type: ignore[no-any-return]

    @staticmethod
    def from_shell(
        voxel_m: float,
        band_m: float,
        indices: NDArray[np.int32],
        values: NDArray[np.float32],
        cameras: tuple[str, ...] = (),
        rejected: dict[str, str] | None = None,
        cut_by: NDArray[np.uint8] | None = None,
        viewpoints: NDArray[np.float32] | None = None,
    ) -> Hull:
        """Rebuild from `shell()` the very same hull, bit for bit.

        Raises:
            InputError: no voxel, or voxels spread over more than 10^8 cells.
        """
        if len(indices) == 0 or len(indices) != len(values):
            raise InputError(f"a hull needs as many signed distances as voxels and at least one, got {len(values)}")
        # Whatever a message's arrays are like: the kernels are compiled for one kind, not again in the first frame.
        indices, values = np.require(indices, np.int32, ["C", "W"]), np.require(values, np.float32, ["C", "W"])
        low, high = kernels.index_range(indices)
        low -= 1
        shape = tuple(int(n) for n in high - low + 2)
        if math.prod(shape) > 100_000_000:
            raise InputError(f"a hull of {shape} cells is too large: expected at most 10^8; use larger voxels")
        sdf = np.full(shape, band_m, np.float32)
        kernels.fill_grid(sdf, indices, low, values)
        corner = (int(low[0]), int(low[1]), int(low[2]))
        hull = Hull(voxel_m, corner, sdf, band_m, cameras, rejected or {})
        if cut_by is None or viewpoints is None:
            return hull
        grid = np.full(shape, NOBODY, np.uint8)
        kernels.fill_grid(grid, indices, low, np.require(cut_by, np.uint8, ["C", "W"]))
        return replace(hull, cut_by=grid, viewpoints=viewpoints)


def evaluate(
    silhouettes: Silhouettes, band_m: float, keep_second: bool = True, changed: PixelCounts | None = None
) -> Voxels:
    """Signed distances of every voxel near the hull, in the blocks that may hold some of it.

    Exact: the same voxels and values as the evaluation of every voxel of the volume. A voxel must be seen by more
    than half of the cameras.

    Args:
        silhouettes: as measured, for a band not narrower than band_m.
        band_m: how far outside the hull voxels are wanted.
        keep_second: whether voxels that a single camera denies are wanted too.
        changed: only blocks that may read one of these pixels (see `Silhouettes.changes_since`).

    Returns:
        indices int32 [V, 3], largest camera distance float32 [V] m, second largest float32 [V] m, and the index of
        the camera that gave the largest int16 [V]; all voxels whose largest distance is below band_m or, with
        keep_second, whose second largest is negative (those that a single camera denies).
    """
    seen, voxel_m, cameras = min_seen(len(silhouettes.names)), silhouettes.voxel_m, silhouettes.cameras
    blocks = silhouettes.blocks
    if changed is not None:
        blocks = blocks[near.blocks_beside(blocks, LEAF, voxel_m, cameras, changed.frames, changed.sums, 0.0)]
    table = (cameras, silhouettes.boxes, silhouettes.field)
    return kernels.evaluate_blocks(  # type: ignore[no-any-return]
        blocks, *table, voxel_m, band_m, keep_second, seen, silhouettes.lattice[1]
    )


def evaluate_again(voxels: Voxels, before: Silhouettes, silhouettes: Silhouettes, band_m: float) -> Voxels:
    """What `evaluate` finds, but for the voxels' order, from what it found before some silhouettes grew."""
    changed = silhouettes.changes_since(before)
    new = evaluate(silhouettes, band_m, changed=changed)
    blocks, block_of = near.blocks_of_voxels(voxels[0], silhouettes.lattice[0], LEAF)
    table = (silhouettes.voxel_m, silhouettes.cameras, changed.frames, changed.sums)
    dropped = near.blocks_beside(blocks, LEAF, *table, 0.0)[block_of]
    return kernels.replace_voxels(voxels, dropped, new)  # type: ignore[no-any-return]


def evaluate_live(silhouettes: Silhouettes, config: HullConfig) -> tuple[Silhouettes, Voxels]:
    """`evaluate` without the cameras whose masks contradict all others: without them the hull grows several times.

    Leaving out a camera adds the voxels that only it denies.
    """
    while True:
        voxels = evaluate(silhouettes, config.band_m)
        _, first, second, who = voxels
        if len(silhouettes.names) <= max(config.min_cameras, 3):
            return silhouettes, voxels
        kept, denied = kernels.count_denied(first, second, who, len(silhouettes.names))
        worst = int(denied.argmax())
        others = np.delete(denied, worst)
        if denied[worst] < 2 * kept + config.min_voxels or denied[worst] < 2 * others.max():
            return silhouettes, voxels
        silhouettes = silhouettes.without(
            silhouettes.names[worst], f"its mask alone denies {denied[worst]} voxels, of the hull only {kept} stay"
        )


def carve_silhouettes(silhouettes: Silhouettes, rig: Rig, config: HullConfig) -> Hull | NoPerson:
    """Carve the hull from measured silhouettes; see `carve`."""
    # A few cameras of many leave far too much standing: better no hull than a confident wrong one.
    needed = max(config.min_cameras, math.ceil(config.min_share * len(rig.cameras) - 1e-9))
    if len(silhouettes.names) < needed:
        reasons = "; ".join(f"{name}: {why}" for name, why in silhouettes.rejected.items())
        return NoPerson(
            f"{len(silhouettes.names)} usable masks of {len(rig.cameras)} cameras, "
            f"expected at least {needed} ({reasons})"
        )
    silhouettes, voxels = evaluate_live(silhouettes, config)
    covered = cover_silhouettes(silhouettes, voxels, config)
    contradiction = mending.unexplained_fraction(silhouettes, covered)
    mended = mending.mend_silhouettes(silhouettes, covered, voxels, config)
    if mended is not silhouettes:
        voxels = evaluate_again(voxels, silhouettes, mended, config.band_m)
    if contradiction > DOUBTED_FRACTION:  # else it is not worth looking for what two masks miss at one place
        once = mended
        mended = mending.mend_twice_denied(once, cover_silhouettes(once, voxels, config), voxels, config)
        if mended is not once:
            voxels = evaluate_again(voxels, once, mended, config.band_m)
    # Ragged masks bite a little from every side. The more the cameras contradict each other, the less may a single
    # one decide; with few cameras two vetoes would leave far too much.
    doubt = 0.0
    if len(silhouettes.names) >= mending.ENOUGH_CAMERAS:
        doubt = min(1.0, contradiction / DOUBTED_FRACTION) * config.shared_veto
    indices, distance, who = kernels.blend_voxels(voxels, np.float32(doubt), np.float32(config.band_m))
    if not (distance < 0).any():
        return NoPerson("the silhouettes have no volume in common: is anybody in the carve volume?")
    hull = Hull.from_shell(
        config.voxel_m,
        config.band_m,
        indices,
        distance,
        silhouettes.names,
        silhouettes.rejected,
        who,
        np.stack([rig.camera(name).T_world_camera[:3, 3] for name in silhouettes.names]).astype(np.float32),
    )
    inside = np.flatnonzero(distance < 0)
    every = max(1, len(inside) // VIEW_POINTS)
    views = Views.of(mended, (indices[inside[::every]] + 0.5) * config.voxel_m)
    parts = _parts(hull)
    if len(parts.sizes) > 2:
        hull = _with_parts(hull, parts, _people_among(hull, parts, silhouettes, config))
    if hull.inside_count * (config.voxel_m / 0.02) ** 3 < config.min_voxels:
        return NoPerson(f"the hull has only {hull.inside_count} voxels of {config.voxel_m} m: too small for a person")
    # They travel with the hull's voxels, a word each but for the first (see `ros.cloud_messages`); only of tiny hulls
    # there are too few. What cannot travel is not used offline either: live angles are the same.
    room = 4 * (int(np.count_nonzero(hull.sdf < np.float32(config.band_m))) - 1)
    return replace(hull, views=views) if views.fits(room) else hull


def largest_component(hull: Hull) -> Hull:
    """The hull with only its largest connected part and the shell around it; bridges gaps of about two voxels, and
    the gap in a body that masks have cut in two."""
    parts = _parts(hull)
    return hull if len(parts.sizes) <= 2 else _with_parts(hull, parts, [int(parts.sizes[1:].argmax()) + 1])


def components(hull: Hull) -> list[Hull]:
    """Every part of the hull (connected, or pieces of one body) as a hull of its own, the largest first; the hull
    itself if it is in one."""
    parts = _parts(hull)
    if len(parts.sizes) <= 2:
        return [hull]
    order = np.argsort(-parts.sizes[1:], kind="stable") + 1
    return [_with_parts(hull, parts, [int(label)]) for label in order]


class _Parts(NamedTuple):
    """The parts of a hull, connected or pieces of one body, numbered from 1 on.

    Attributes:
        labels: int32 [nx, ny, nz] which part each voxel belongs to; 0: none.
        sizes: int64 [L + 1] how many voxels each has.
        boxes: int64 [L + 1, 2, 3] lowest and highest (exclusive) indices of each in the grid.
    """

    labels: NDArray[np.int32]
    sizes: NDArray[np.int64]
    boxes: NDArray[np.int64]


def _parts(hull: Hull) -> _Parts:
    parts = _Parts(*apart.label_components(hull.sdf, np.float32(hull.voxel_m)))
    pairs = _pieces_of_one_body(parts, hull.voxel_m)
    return _parts_joined(parts, pairs) if pairs else parts


def _pieces_of_one_body(parts: _Parts, voxel_m: float) -> list[tuple[int, int]]:
    """Every two parts of which one lies above the other. Both legs may be below one trunk."""
    large = np.flatnonzero(parts.sizes >= PIECE_SHARE * parts.sizes[1:].max(initial=0))
    pairs = itertools.permutations(large[large > 0].tolist(), 2)
    return [(upper, lower) for upper, lower in pairs if _area_above(parts, upper, lower, voxel_m) >= PIECE_AREA_M2]


def _area_above(parts: _Parts, upper: int, lower: int, voxel_m: float) -> float:
    """On how much of the floor, m^2, one part lies just above the other."""
    low = np.maximum(parts.boxes[upper, 0], parts.boxes[lower, 0])
    high = np.minimum(parts.boxes[upper, 1], parts.boxes[lower, 1])
    labels = parts.labels[low[0] : max(low[0], high[0]), low[1] : max(low[1], high[1])]
    below, just_above = labels == lower, np.zeros(labels.shape, np.bool_)
    for step in range(1, int(PIECE_GAP_M / voxel_m) + 1):
        just_above[:, :, step:] |= below[:, :, :-step]
    return float(np.count_nonzero((just_above & (labels == upper)).any(axis=2))) * voxel_m**2


def _parts_joined(parts: _Parts, pairs: list[tuple[int, int]]) -> _Parts:
    """The parts, with both of each pair as one."""
    first = np.arange(len(parts.sizes))  # which part each is one with
    for a, b in pairs:
        first[(first == first[a]) | (first == first[b])] = min(first[a], first[b])
    _, numbers = np.unique(first, return_inverse=True)
    count = int(numbers.max()) + 1
    sizes = np.zeros(count, np.int64)
    low, high = np.full((count, 3), max(parts.labels.shape), np.int64), np.zeros((count, 3), np.int64)
    np.add.at(sizes, numbers, parts.sizes)
    np.minimum.at(low, numbers, parts.boxes[:, 0])
    np.maximum.at(high, numbers, parts.boxes[:, 1])
    return _Parts(numbers.astype(parts.labels.dtype)[parts.labels], sizes, np.stack([low, high], axis=1))


def _people_among(hull: Hull, hull_parts: _Parts, silhouettes: Silhouettes, config: HullConfig) -> list[int]:
    """The parts of the hull that may be people: the largest, and others that are large enough and no phantoms.

    Where the silhouettes of several people cross there may be volume that nobody fills (a phantom). All of it hides
    before or behind somebody in every camera: it covers hardly a pixel that another part does not cover as well. Of
    the parts of which that is true the one with the least to itself goes, and the others are asked again.
    """
    sizes = hull_parts.sizes
    inside = np.bincount(hull_parts.labels[hull.sdf < 0], minlength=len(sizes))
    large = inside * (config.voxel_m / 0.02) ** 3 >= config.min_further_voxels
    large[0], large[int(sizes[1:].argmax()) + 1] = False, True
    parts = [int(label) for label in np.flatnonzero(large)]
    covers = [_cover(hull, hull_parts, label, silhouettes) for label in parts] if len(parts) > 1 else []
    while len(parts) > 1:
        total: NDArray[np.uint8] = np.stack(covers).sum(axis=0, dtype=np.uint8)
        alone = [_share_alone(cover, total, silhouettes) for cover in covers]
        least = min(range(len(parts)), key=lambda n: (alone[n], int(sizes[parts[n]])))
        if alone[least] >= PHANTOM_SHARE:
            break
        del parts[least], covers[least]
    return parts


def _cover(hull: Hull, parts: _Parts, label: int, silhouettes: Silhouettes) -> NDArray[np.uint8]:
    """Which pixels of all silhouettes a part of the hull covers; uint8 in the layout of `silhouettes.field`.

    One voxel of eight stands for all: this is asked for every part of every frame with several people.
    """
    low, high = parts.boxes[label]
    cut = tuple(slice(a, b, 2) for a, b in zip(low.tolist(), high.tolist(), strict=True))
    local = np.stack(np.nonzero((parts.labels[cut] == label) & (hull.sdf[cut] < 0))) * 2
    centres = (local + (hull.index_min + low)[:, None] + 0.5) * hull.voxel_m
    covered = np.zeros(silhouettes.field.size, np.uint8)
    mending_kernels.cover(
        np.ascontiguousarray(centres), 1.75 * hull.voxel_m, silhouettes.cameras, silhouettes.boxes, covered
    )
    return covered & (silhouettes.field < -INNER_PX)


def _share_alone(cover: NDArray[np.uint8], total: NDArray[np.uint8], silhouettes: Silhouettes) -> float:
    """How much of what a part covers it alone covers, in the camera where that is second most."""
    shares = np.zeros(len(silhouettes.names))
    for c, (_, _, width, height, offset) in enumerate(silhouettes.boxes):
        mine = cover[offset : offset + width * height] > 0
        shares[c] = (total[offset : offset + width * height][mine] == 1).sum() / max(int(mine.sum()), 1)
    return float(np.sort(shares)[-min(2, len(shares))])


def _with_parts(hull: Hull, parts: _Parts, keep: list[int]) -> Hull:
    """The hull with only some of its connected parts and the shell around them."""
    band, reach = np.float32(hull.band_m), math.ceil(hull.band_m / hull.voxel_m)
    stays, corner = apart.parts_and_shell(hull.sdf, band, parts.labels, parts.boxes, np.array(keep), reach)
    i, j, k = (low + int(first) for low, first in zip(hull.index_min, corner, strict=True))
    sdf = apart.copy_where(hull.sdf, corner, stays, band)
    cut_by = None if hull.cut_by is None else apart.copy_where(hull.cut_by, corner, stays, np.uint8(NOBODY))
    return replace(hull, index_min=(i, j, k), sdf=sdf, cut_by=cut_by)


def carve(masks: Mapping[str, NDArray[np.uint8]], rig: Rig, config: HullConfig) -> Hull | NoPerson:
    """Carve the hull of one frame (paper section 1).

    Args:
        masks: camera name -> uint8 [height, width], non-zero = foreground. Cameras without a mask are left out.
        rig: the cameras and the carve volume.
        config: voxel size, voting, limits.

    Returns:
        the hull, cropped to those connected parts that may be people (`components` takes them apart) plus the shell, or
        why there is none.

    Raises:
        InputError: a mask has not its camera's size.
        RigError: the rig has no such camera, or one with an impossible lens.
    """
    return carve_silhouettes(measure_silhouettes(masks, rig, pack_cameras(rig), config), rig, config)
