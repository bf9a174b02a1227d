# SPDX-License-Identifier: Apache-2.0
"""What can be wrong with one camera, tried out: its time, its place, its name. Each trial is carved and compared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from limbloc_ros.core.camera import Camera
from limbloc_ros.rig.consistency import (
    Grid,
    Mask,
    core_of,
    cover,
    inside,
    look_up,
    score,
    share_outside,
    splat,
    unexplained_share,
)

Array = NDArray[np.float64]

#: Small masks of one instant by camera index.
Frame = Mapping[int, Mask]

#: Candidates for the hull are thinned to this in a frame while a pose is searched.
MOST_CANDIDATES = 8_000


@dataclass(frozen=True)
class Move:
    """How a camera would have to stand for the silhouettes to agree.

    Attributes:
        T_world_camera: [4, 4] the pose that fits.
        turn_rad: its turn against the rig file.
        shift_m: its shift against the rig file, in the rig's unit.
        shift_px: how far the middle of its image moves, px of the full image.
        before, after: contradiction of all cameras with the rig's pose and with this one.
    """

    T_world_camera: Array
    turn_rad: float
    shift_m: float
    shift_px: float
    before: float
    after: float


def contradiction(grid: Grid, frames: Sequence[Frame]) -> float:
    """Mean over frames of the share of foreground that the hull of all cameras does not explain."""
    values = [_together(grid, frame) for frame in frames if len(frame) >= 2]
    return float(np.mean(values)) if values else float("nan")


def _together(grid: Grid, frame: Frame) -> float:
    """`score(...).together` without the rest."""
    kept = np.ones(len(grid.points), bool)
    seen = np.zeros(len(grid.points), np.int64)
    for c, mask in frame.items():
        kept &= inside(grid, c, mask)
        seen += grid.pixels[c] >= 0
    voxels = np.flatnonzero(kept & (seen > max(1, len(frame) // 2)))
    return float(np.mean([unexplained_share(mask, cover(grid, c, voxels)) for c, mask in frame.items()]))


def swapped_pair(grid: Grid, frames: Sequence[Frame]) -> tuple[tuple[int, int], float] | None:
    """The two cameras whose masks fit best when exchanged, and the contradiction then; None without such a pair."""
    cameras = sorted(set().union(*frames)) if frames else []
    best: tuple[tuple[int, int], float] | None = None
    for a, b in combinations(cameras, 2):
        if grid.views[a].camera.width != grid.views[b].camera.width:
            continue
        if grid.views[a].camera.height != grid.views[b].camera.height:
            continue
        value = contradiction(grid, [exchange(frame, a, b) for frame in frames])
        if best is None or value < best[1]:
            best = (a, b), value
    return best


def exchange(frame: Frame, a: int, b: int) -> dict[int, Mask]:
    """A frame with two cameras' masks exchanged."""
    other = {a: b, b: a}
    return {other.get(c, c): mask for c, mask in frame.items()}


def best_delay(
    grid: Grid, recording: Sequence[Frame], chosen: Sequence[int], camera: int, reach: int
) -> tuple[int, Array]:
    """By how many frames one camera's masks come late.

    Args:
        grid: the voxels.
        recording: all frames, in order and evenly spaced.
        chosen: those that are compared, at least `reach` from both ends.
        camera: which.
        reach: so many frames to either side are tried.

    Returns:
        the delay with the least contradiction (positive: its frame n shows what the others show at n - delay), and the
        contradiction [2 reach + 1] of each delay from -reach on.
    """
    curve = []
    for delay in range(-reach, reach + 1):
        frames = []
        for n in chosen:
            mask = recording[n + delay].get(camera)
            if mask is not None:
                frames.append({**recording[n], camera: mask})
        curve.append(contradiction(grid, frames))
    values = np.array(curve)
    return int(np.nanargmin(values)) - reach if np.isfinite(values).any() else 0, values


def best_move(grid: Grid, frames: Sequence[Frame], camera: int) -> Move | None:
    """The pose of one camera with which the silhouettes agree best, the others being right.

    A hull lies inside that of all others, so only those voxels are asked. First a turn is searched, then a turn and a
    shift together.

    Returns:
        the pose, or None when the others have no hull.
    """
    view = grid.views[camera]
    cases = [case for frame in frames if (case := _Case.make(grid, frame, camera)) is not None]
    if not cases:
        return None

    def moved(parameters: Array) -> Camera:
        T = view.camera.T_world_camera.copy()
        T[:3, :3] = T[:3, :3] @ Rotation.from_rotvec(parameters[:3]).as_matrix()
        T[:3, 3] += unit * parameters[3:6]
        return replace(view.camera, T_world_camera=T)

    def cost(parameters: Array) -> float:
        full = np.zeros(6)
        full[: len(parameters)] = parameters
        trial = moved(full)
        return float(np.mean([case.contradiction(grid, camera, trial) for case in cases]))

    # Lengths are counted so that a turn of 1 rad and a shift of `unit` move the image alike.
    unit = float(
        np.median([np.linalg.norm(case.points.mean(axis=0) - view.camera.T_world_camera[:3, 3]) for case in cases])
    )
    focal = view.camera.K[0, 0]
    before = cost(np.zeros(3))
    # Where the mask's middle is and where it should be.
    offsets = [offset for case in cases if (offset := case.offset_px(grid, camera)) is not None]
    du, dv = np.median(offsets, axis=0) if offsets else (0.0, 0.0)
    starts = [np.zeros(3), np.array([dv / focal, -du / focal, 0.0])][: 1 if np.hypot(du, dv) < 1.5 else 2]
    step = 4.0 / focal
    turns = [_simplex(cost, start, step) for start in starts]
    turn = min(turns, key=lambda found: found[1])
    chosen, after = turn
    if after > 0.2 * before:  # a turn does not explain it all
        both = _simplex(cost, np.concatenate([turn[0], np.zeros(3)]), step)
        if both[1] < 0.8 * after - 0.002:
            chosen, after = both
    full = np.zeros(6)
    full[: len(chosen)] = chosen
    T = moved(full).T_world_camera
    # The middle of the image, as far away as the person is.
    middle = view.camera.T_world_camera[:3, 3] + unit * view.camera.T_world_camera[:3, 2]
    here, there = view.camera.world_to_image(middle)[0], moved(full).world_to_image(middle)[0]
    return Move(
        T,
        float(np.linalg.norm(full[:3])),
        unit * float(np.linalg.norm(full[3:])),
        float(np.linalg.norm(np.nan_to_num(there - here, nan=1e3))) / view.scale,
        before,
        after,
    )


def _simplex(cost: object, start: Array, step: float) -> tuple[Array, float]:
    simplex = np.vstack([start, start + step * np.eye(len(start))])
    options = {"initial_simplex": simplex, "maxfev": 40 * len(start), "xatol": 0.05 * step, "fatol": 1e-4}
    found = minimize(cost, start, method="Nelder-Mead", options=options)  # type: ignore[call-overload]
    return np.asarray(found.x), float(found.fun)


@dataclass(frozen=True)
class _Case:
    """One frame while one camera's pose is searched: the candidates are the hull of all others.

    Attributes:
        frame: the masks.
        voxels, points: candidates, and their centres.
        pixels: of the other cameras: index -> where each sees the candidates.
        cores: of all cameras: index -> the foreground without its rim.
    """

    frame: Frame
    voxels: NDArray[np.int64]
    points: Array
    pixels: dict[int, NDArray[np.int32]]
    cores: dict[int, Mask]

    @staticmethod
    def make(grid: Grid, frame: Frame, camera: int) -> _Case | None:
        others = [c for c in frame if c != camera]
        if camera not in frame or len(others) < 2:
            return None
        kept = np.ones(len(grid.points), bool)
        seen = np.zeros(len(grid.points), np.int64)
        for c in others:
            kept &= inside(grid, c, frame[c])
            seen += grid.pixels[c] >= 0
        voxels = np.flatnonzero(kept & (seen > max(1, len(others) // 2)))
        if len(voxels) < 20:
            return None
        voxels = voxels[:: -(-len(voxels) // MOST_CANDIDATES)]
        pixels = {c: grid.pixels[c][voxels] for c in others}
        return _Case(frame, voxels, grid.points[voxels], pixels, {c: core_of(mask) for c, mask in frame.items()})

    def contradiction(self, grid: Grid, camera: int, trial: Camera) -> float:
        """The contradiction of all cameras when `camera` is `trial`."""
        pixels = look_up(trial, self.points)
        mask = self.frame[camera]
        ignored = grid.views[camera].ignored
        kept = ((mask if ignored is None else mask | ignored).ravel()[pixels] != 0) | (pixels < 0)
        shares = []
        for c, seen in {**self.pixels, camera: pixels}.items():
            mine = seen[kept]
            covered = splat(mine[mine >= 0], self.frame[c].shape, int(grid.reach[c]))
            shares.append(share_outside(self.cores[c], covered))
        return float(np.mean(shares))

    def offset_px(self, grid: Grid, camera: int) -> tuple[float, float] | None:
        """How far the mask's middle lies from that of the others' hull, small px."""
        should = cover(grid, camera, self.voxels)
        if not should.any():
            return None
        (y0, x0), (y1, x1) = (np.argwhere(image).mean(axis=0) for image in (should, self.frame[camera]))
        return float(x1 - x0), float(y1 - y0)


def pair_table(grid: Grid, frames: Sequence[Frame], names: Sequence[str]) -> Array:
    """[C, C] mean contradiction of each pair of cameras by itself; NaN on the diagonal and without common frames."""
    count = len(names)
    table = np.full((count, count), np.nan)
    for a, b in combinations(range(count), 2):
        both = [{a: frame[a], b: frame[b]} for frame in frames if a in frame and b in frame]
        if both:
            table[a, b] = table[b, a] = float(np.mean([score(grid, pair).together for pair in both]))
    return table
