# SPDX-License-Identifier: Apache-2.0
"""Where to hang cameras, what they see of a room, and how fat the hull of a person will be."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core.camera import Camera, Rig
from limbloc_ros.core.config import HullConfig
from limbloc_ros.core.errors import ConfigError, NoPerson
from limbloc_ros.core.hull import Hull, carve
from limbloc_ros.rig.consistency import look_up
from limbloc_ros.rig.geometry import looking_at
from limbloc_ros.rig.volume import derive_volume

Array = NDArray[np.float64]
Mask = NDArray[np.uint8]

#: Heights at which a place must be seen: a standing person's ankles, waist and raised hands, m.
HEIGHTS_M = (0.2, 1.0, 2.0)
#: Places on the floor are looked at in this grid, m.
STEP_M = 0.1
#: Cameras hang this far below the ceiling and from the walls, m, and every other one lower, at this height.
FROM_CEILING_M, FROM_WALL_M, LOW_M = 0.15, 0.1, 1.4
#: They look at this height, m.
AIM_M = 0.95


@dataclass(frozen=True)
class Coverage:
    """How many cameras see each place.

    Attributes:
        x, y: [nx], [ny] places, m.
        counts: [3, nx, ny] cameras that see it at each of HEIGHTS_M.
        needed: as many cameras as a voxel must be seen by to be carved.
    """

    x: Array
    y: Array
    counts: NDArray[np.int64]
    needed: int

    @property
    def whole(self) -> NDArray[np.int64]:
        """[nx, ny] cameras that see the place at the height at which the fewest do."""
        return np.asarray(self.counts.min(axis=0))

    def share(self, cameras: int) -> float:
        """Share of the places that so many cameras or more see from ankles to raised hands."""
        return float((self.whole >= cameras).mean())


@dataclass(frozen=True)
class Fatness:
    """The hull of a standing person in several places.

    Attributes:
        factors: hull's volume over the body's, one a place.
        lost: places where the hull lacks a piece of the body or there is none.
        tried: places.
    """

    factors: tuple[float, ...]
    lost: int
    tried: int

    @property
    def median(self) -> float:
        """The middle factor; NaN without any."""
        return float(np.median(self.factors)) if self.factors else float("nan")


def propose(
    count: int,
    room: tuple[float, float, float],
    *,
    size: tuple[int, int] = (1280, 720),
    view_deg: float = 80.0,
) -> Rig:
    """Cameras along the walls of a room, evenly around its middle, by turns below the ceiling and at shoulder height.

    Two heights tell arms from the trunk; an odd step keeps cameras from facing each other, for two that do see one and
    the same silhouette.

    Args:
        count: 2 to 32 cameras.
        room: length (x), width (y) and height, m; the origin is the middle of the floor.
        size: width, height of the images, px.
        view_deg: horizontal angle of view.

    Raises:
        ConfigError: a number out of range.
    """
    length, width, height = room
    if not 2 <= count <= 32:
        raise ConfigError(f"--cameras: expected 2 to 32, got {count}")
    if not (2 <= length <= 30 and 2 <= width <= 30 and 2 <= height <= 10):
        raise ConfigError(f"--room: expected 2 to 30 m long and wide and 2 to 10 m high, got {length}x{width}x{height}")
    if not 20 <= view_deg <= 120:
        raise ConfigError(f"--view: expected 20 to 120 degrees, got {view_deg:g}")
    half = np.array([length, width]) / 2 - FROM_WALL_M
    focal = size[0] / 2 / math.tan(math.radians(view_deg) / 2)
    K = np.array([[focal, 0, (size[0] - 1) / 2], [0, focal, (size[1] - 1) / 2], [0, 0, 1]])
    # An even ring has opposite pairs; squeezing it by half a step of one camera breaks them up.
    around = 2 * math.pi * (count - 0.5) / count if count % 2 == 0 and count > 2 else 2 * math.pi
    cameras = []
    for k in range(count):
        angle = math.pi / 4 + (around * k / count if count > 2 else math.pi / 2 * k)
        direction = np.array([math.cos(angle), math.sin(angle)])
        reach = float((half / np.maximum(np.abs(direction), 1e-9)).min())
        top = height - FROM_CEILING_M if k % 2 == 0 else min(LOW_M, height - FROM_CEILING_M)
        centre = np.array([*(reach * direction), top])
        cameras.append(Camera(f"cam{k}", size[0], size[1], K, looking_at(centre, np.array([0.0, 0.0, AIM_M]))))
    low, high = derive_volume(cameras)
    inner = np.array([length, width]) / 2
    low[:2], high[:2] = np.maximum(low[:2], -inner), np.minimum(high[:2], inner)
    high[2] = min(high[2], height)
    return Rig(tuple(cameras), low, high)


def cover_floor(rig: Rig, low: Array | None = None, high: Array | None = None) -> Coverage:
    """How many cameras see each place between two corners (default: the carve volume)."""
    low, high = (rig.volume_min if low is None else low), (rig.volume_max if high is None else high)
    x, y = (np.arange(low[a] + STEP_M / 2, high[a], STEP_M) for a in (0, 1))
    counts = np.zeros((len(HEIGHTS_M), len(x), len(y)), np.int64)
    for i, z in enumerate(HEIGHTS_M):
        points = np.stack(np.meshgrid(x, y, [z], indexing="ij"), axis=-1).reshape(-1, 3)
        for camera in rig.cameras:
            counts[i] += (look_up(camera, points) >= 0).reshape(len(x), len(y))
    return Coverage(x, y, counts, max(min(2, len(rig.cameras)), len(rig.cameras) // 2 + 1))


def blind_spots(coverage: Coverage, floor: float = 0.5) -> list[str]:
    """Where a person would lose limbs or not be seen at all, in words.

    Args:
        coverage: what is seen.
        floor: smaller spots than this (m2) are not named.
    """
    bad = (coverage.whole < coverage.needed).astype(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(bad, connectivity=4)
    out = []
    for k in sorted(range(1, count), key=lambda k: -int(stats[k, cv2.CC_STAT_AREA])):
        area = float(stats[k, cv2.CC_STAT_AREA]) * STEP_M**2
        if area < floor:
            break
        inside = labels == k
        at = np.argwhere(inside)
        (i0, j0), (i1, j1) = at.min(axis=0), at.max(axis=0)
        least = [int(counts[inside].min()) for counts in coverage.counts]
        part = ("at the ankles", "at the waist", "with raised hands")[int(np.argmin(least))]
        last = np.array(inside.shape) - 1
        if i0 == j0 == 0 and i1 == last[0] and j1 == last[1]:
            inwards = (np.minimum(at, last - at).min(axis=1).max() + 1) * STEP_M
            where = f"along all sides, up to {inwards:.1f} m inwards"
        else:
            where = f"between x {coverage.x[i0]:.1f} and {coverage.x[i1]:.1f}, y {coverage.y[j0]:.1f} and "
            where += f"{coverage.y[j1]:.1f} m"
        out.append(f"{area:.1f} m2 {where}: down to {min(least)} cameras {part} (needed: {coverage.needed})")
    return out


def silhouettes(rig: Rig, vertices: Array, faces: NDArray[np.int32]) -> dict[str, Mask]:
    """The silhouettes of a closed mesh, camera name -> uint8 [height, width], 0 or 255."""
    masks = {}
    for camera in rig.cameras:
        uv, depth = camera.world_to_image(vertices)
        mask = np.zeros((camera.height, camera.width), np.uint8)
        good = (depth[faces] > 0.05).all(axis=1)
        corners = np.nan_to_num(uv)[faces[good]]
        # Corners in sixteenths of a pixel; a pixel that an edge touches is filled, so half a pixel is added all round.
        for corner in np.rint(np.clip(corners, -30000, 30000) * 16).astype(np.int32):
            cv2.fillConvexPoly(mask, corner, 255, cv2.LINE_8, 4)
        masks[camera.name] = mask
    return masks


def mesh_volume(vertices: Array, faces: NDArray[np.int32]) -> float:
    """The volume of a closed mesh, m3."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float(abs(np.einsum("ij,ij->i", a, np.cross(b, c)).sum()) / 6)


def hull_fatness(
    rig: Rig, vertices: Array, faces: NDArray[np.int32], places: Sequence[tuple[float, float]], voxel_m: float = 0.02
) -> Fatness:
    """Carve a body with the real carving, at several places, from true silhouettes.

    Args:
        rig: the cameras.
        vertices, faces: the body's closed mesh, its feet at (0, 0, 0), m.
        places: where it stands.
        voxel_m: edge of a voxel.
    """
    volume = mesh_volume(vertices, faces)
    factors, lost = [], 0
    for x, y in places:
        moved = vertices + np.array([x, y, 0.0])
        hull = carve(silhouettes(rig, moved, faces), rig, HullConfig(voxel_m=voxel_m))
        if isinstance(hull, NoPerson):
            lost += 1
            continue
        inside = np.argwhere(hull.sdf < 0)
        top = float((hull.origin_m[2] + inside[:, 2] * voxel_m).max())
        missing = abs(top - moved[:, 2].max()) > 0.08 or not _holds(hull, moved)
        lost += missing
        factors.append(hull.inside_count * voxel_m**3 / volume)
    return Fatness(tuple(factors), lost, len(places))


def _holds(hull: Hull, vertices: Array) -> bool:
    """Whether nearly all of the body lies inside the hull, to a voxel and a half."""
    at = np.rint((vertices - hull.origin_m) / hull.voxel_m).astype(int)
    good = ((at >= 0) & (at < hull.sdf.shape)).all(axis=1)
    inside = np.zeros(len(at), bool)
    inside[good] = hull.sdf[tuple(at[good].T)] < 1.5 * hull.voxel_m
    return bool(inside.mean() > 0.97)


def standing_places(coverage: Coverage, count: int = 5) -> list[tuple[float, float]]:
    """The middle of the places that enough cameras see, and others around it, half-way to the border."""
    good = np.argwhere(coverage.whole >= coverage.needed)
    if len(good) == 0:
        return []
    points = np.stack([coverage.x[good[:, 0]], coverage.y[good[:, 1]]], axis=1)
    middle = points.mean(axis=0)
    out = [tuple(points[int(np.linalg.norm(points - middle, axis=1).argmin())])]
    for k in range(count - 1):
        direction = np.array([math.cos(2 * math.pi * k / (count - 1)), math.sin(2 * math.pi * k / (count - 1))])
        along = (points - middle) @ direction
        target = middle + 0.5 * max(0.0, float(along.max())) * direction
        out.append(tuple(points[int(np.linalg.norm(points - target, axis=1).argmin())]))
    return [(float(x), float(y)) for x, y in out]


def table(rows: Mapping[int, tuple[Coverage, Fatness]]) -> str:
    """Number of cameras -> what to expect, as text."""
    lines = ["  cameras   hull / body volume   places seen by enough cameras   standing places with losses"]
    for count, (coverage, fatness) in rows.items():
        seen = f"{100 * coverage.share(coverage.needed):.0f} % by {coverage.needed}"
        lines.append(f"  {count:7d}   {fatness.median:18.2f}   {seen:>29s}   {fatness.lost:17d} of {fatness.tried}")
    return "\n".join(lines)
