# SPDX-License-Identifier: Apache-2.0
"""Boards seen by several cameras -> a calibrated rig: first guesses, bundle adjustment, the room's floor and origin.

The first guesses are OpenCV's: each lens by itself (Zhang's method), then the board's pose in each view, then the
cameras among each other along those pairs that saw the board together most often.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core.camera import Camera
from limbloc_ros.core.errors import RigError
from limbloc_ros.rig.board import Board
from limbloc_ros.rig.bundle import Adjusted, Bundle, Lens, View, adjust
from limbloc_ros.rig.geometry import cameras_up, inverse

Array = NDArray[np.float64]

LENSES = ("radtan", "radtan3", "rational", "fisheye")
#: A lens is first fitted to at most so many views, those that differ most.
LENS_VIEWS = 40
#: Fewer views than this do not determine a lens.
MIN_LENS_VIEWS = 4
#: A view whose corners are off by more than this (px, root mean square) after the first fit is thrown away, as are
#: those far beyond what is usual.
BAD_VIEW_PX, BAD_VIEW_TIMES = 3.0, 4.0
#: So is a corner that is so many times as far off as its view's median corner, where at most this share of them is: one
#: at the image's edge, or under a finger. Many are no misreading but a lens of another model.
BAD_CORNER_TIMES, BAD_CORNERS = 8.0, 0.1
#: The board lies on the floor when nothing is further below it than this (m), and its normal is as upright as this.
BELOW_FLOOR_M, UPRIGHT_RAD = 0.03, np.radians(40.0)


@dataclass(frozen=True)
class Calibration:
    """The outcome.

    Attributes:
        cameras: calibrated, in the room's world: z up, the floor at z = 0, the origin at the board's corner.
        views: those that were used.
        residuals: of each of them [M, 2] px, found minus projected.
        sigma_m, sigma_rad: [C] standard deviation of each camera's position and rotation among the others.
        boards: frame -> T_world_board [4, 4].
        floor_frames: those in which the board lay on the floor; empty when the world is a camera's.
        dropped: views and corners that were thrown away, and why.
    """

    cameras: tuple[Camera, ...]
    views: list[View]
    residuals: list[Array]
    sigma_m: Array
    sigma_rad: Array
    boards: dict[int, Array]
    floor_frames: list[int]
    dropped: list[str]

    def rms_px(self, camera: int | None = None) -> float:
        """Root mean square distance of found and projected corners, px; of one camera or of all."""
        chosen = [r for v, r in zip(self.views, self.residuals, strict=True) if camera in (None, v.camera)]
        squares = np.concatenate([(r**2).sum(axis=1) for r in chosen]) if chosen else np.array([np.nan])
        return float(np.sqrt(squares.mean()))


def calibrate(
    names: Sequence[str],
    sizes: Sequence[tuple[int, int]],
    views: Sequence[View],
    board: Board,
    *,
    lens: str = "radtan",
    lens_views: Sequence[View] = (),
    floor: Sequence[int] | None = None,
    thickness_m: float = 0.0,
) -> Calibration:
    """Calibrate the cameras of a room.

    Args:
        names, sizes: of the cameras; width, height in px.
        views: the board in synchronous frames; a frame that one camera alone sees helps that camera's lens.
        board: the board.
        lens: of LENSES; `radtan` is k1 k2 p1 p2, `radtan3` also k3.
        lens_views: further views for the lenses only, whose frames mean nothing (other recordings).
        floor: frames in which the board lies on the floor, None: found by themselves.
        thickness_m: of the board lying on the floor.

    Raises:
        RigError: too few views of a camera, cameras that never saw the board together, or no floor.
    """
    offset = 1 + max((view.frame for view in views), default=0) - min((view.frame for view in lens_views), default=0)
    alone = [View(v.camera, v.frame * len(names) + offset + v.camera, v.ids, v.places) for v in _renumbered(lens_views)]
    every = [*views, *alone]
    lenses, poses, dropped = first_lenses(names, sizes, every, board, lens)
    kept = [(view, T) for view, T in zip(every, poses, strict=True) if T is not None]
    reference, cameras = first_cameras(names, [view for view, _ in kept], [T for _, T in kept])
    boards = _first_boards(kept, cameras)
    bundle = Bundle(lenses, np.array([_vector(T) for T in cameras]), {f: _vector(T) for f, T in boards.items()})
    used = [view for view, _ in kept]
    done = adjust(bundle, used, board.points, reference)
    worst = _outliers(used, done)
    if worst:
        dropped += [_dropped(names, used[i], done.residuals[i]) for i in worst]
        used = [view for i, view in enumerate(used) if i not in worst]
        frames = {view.frame for view in used}
        rest = Bundle(
            done.bundle.lenses, done.bundle.cameras, {f: b for f, b in done.bundle.boards.items() if f in frames}
        )
        done = adjust(rest, used, board.points, reference)
    used, done = _without_misread_corners(names, used, done, board, reference, dropped)
    T_cameras = [_matrix(pose) for pose in done.bundle.cameras]
    synchronous = {view.frame for view in views}
    T_boards = {f: _matrix(pose) for f, pose in done.bundle.boards.items() if f in synchronous}
    T_room, floor_frames = find_floor([inverse(T) for T in T_cameras], T_boards, board, floor, thickness_m)
    calibrated = tuple(
        _camera(name, size, fitted, T_room @ inverse(T))
        for name, size, fitted, T in zip(names, sizes, done.bundle.lenses, T_cameras, strict=True)
    )
    sigma_rad = np.linalg.norm(done.camera_sigma[:, :3], axis=1)
    return Calibration(
        calibrated,
        used,
        done.residuals,
        np.linalg.norm(done.camera_sigma[:, 3:], axis=1),
        sigma_rad,
        {f: T_room @ T for f, T in T_boards.items()},
        floor_frames,
        dropped,
    )


def _renumbered(views: Sequence[View]) -> list[View]:
    first = min((view.frame for view in views), default=0)
    return [View(v.camera, v.frame - first, v.ids, v.places) for v in views]


def calibrate_lens(
    name: str, size: tuple[int, int], views: Sequence[View], board: Board, lens: str = "radtan"
) -> tuple[Camera, list[View], list[Array], list[str]]:
    """Calibrate one camera's lens alone.

    Returns:
        the camera (its pose means nothing), the views that were used, their residuals [M, 2] px, and what was dropped.

    Raises:
        RigError: too few views.
    """
    numbered = [View(0, i, view.ids, view.places) for i, view in enumerate(views)]
    lenses, poses, dropped = first_lenses([name], [size], numbered, board, lens)
    kept = [(view, T) for view, T in zip(numbered, poses, strict=True) if T is not None]
    bundle = Bundle(lenses, np.zeros((1, 6)), {view.frame: _vector(T) for view, T in kept})
    used = [view for view, _ in kept]
    used, done = _without_misread_corners([name], used, adjust(bundle, used, board.points, 0), board, 0, dropped)
    return _camera(name, size, done.bundle.lenses[0], np.eye(4)), used, done.residuals, dropped


def first_lenses(
    names: Sequence[str], sizes: Sequence[tuple[int, int]], views: Sequence[View], board: Board, lens: str
) -> tuple[tuple[Lens, ...], list[Array | None], list[str]]:
    """Each lens by itself.

    Returns:
        lenses; of each view T_camera_board, None where the view fits no pose; what was dropped, in words.

    Raises:
        RigError: a camera with too few views.
    """
    lenses = []
    poses: list[Array | None] = [None] * len(views)
    dropped: list[str] = []
    for c, (name, size) in enumerate(zip(names, sizes, strict=True)):
        mine = [i for i, view in enumerate(views) if view.camera == c]
        if len(mine) < MIN_LENS_VIEWS:
            raise RigError(
                f"camera {name}: the board was found in {len(mine)} images, expected {MIN_LENS_VIEWS} or more: show it "
                "to this camera, near and tilted, over all of its image; is --board right?"
            )
        chosen = [views[i] for i in _various([views[i] for i in mine], mine)]
        fitted = _fit_lens(chosen, board.points, size, lens)
        lenses.append(fitted)
        errors = {}
        for i in mine:
            pose = _board_pose(fitted, views[i], board.points)
            if pose is not None:
                poses[i], errors[i] = pose
        usual = float(np.median(list(errors.values()))) if errors else np.inf
        for i, error in errors.items():
            if error > max(BAD_VIEW_PX, BAD_VIEW_TIMES * usual):
                poses[i] = None
                dropped.append(f"{name}, frame {views[i].frame}: corners {error:.1f} px off: blurred or misread")
    return tuple(lenses), poses, dropped


def _various(views: Sequence[View], labels: Sequence[int]) -> list[int]:
    """The views that differ most in place, size and slant: each next one is the furthest from those chosen before."""
    rows = []
    for view in views:
        (xx, xy), (_, yy) = np.cov(view.places.T)
        slant = 200 * xy / np.sqrt(xx * yy + 1e-9)
        rows.append([*view.places.mean(axis=0), 2 * np.sqrt(xx), 2 * np.sqrt(yy), slant])
    features = np.array(rows)
    chosen = [int(np.argmax([len(v.ids) for v in views]))]
    away = np.linalg.norm(features - features[chosen[0]], axis=1)
    while len(chosen) < min(LENS_VIEWS, len(views)):
        chosen.append(int(away.argmax()))
        away = np.minimum(away, np.linalg.norm(features - features[chosen[-1]], axis=1))
    return [labels[i] for i in chosen]


def _fit_lens(views: Sequence[View], points: Array, size: tuple[int, int], lens: str) -> Lens:
    """OpenCV's calibration of one camera."""
    flat = [points[view.ids].astype(np.float32) for view in views]
    places = [view.places.astype(np.float32) for view in views]
    guess = cv2.initCameraMatrix2D(flat, places, size, 1.0)
    if not (np.isfinite(guess).all() and 0.2 * max(size) < guess[0, 0] < 20 * max(size)):
        guess = np.array([[1.0 * max(size), 0, (size[0] - 1) / 2], [0, 1.0 * max(size), (size[1] - 1) / 2], [0, 0, 1]])
    if lens == "fisheye":
        model, count, free = "fisheye", 4, np.ones(8, bool)
        flags = (
            cv2.fisheye.CALIB_RECOMPUTE_EXTRINSIC + cv2.fisheye.CALIB_FIX_SKEW + cv2.fisheye.CALIB_USE_INTRINSIC_GUESS
        )
        _, K, D, _, _ = cv2.fisheye.calibrate(
            [p[:, None] for p in flat], [p[:, None] for p in places], size, guess, np.zeros((4, 1)), flags=flags
        )
    else:
        model = "rational" if lens == "rational" else "radtan"
        count = 8 if lens == "rational" else 5
        free = np.ones(4 + count, bool)
        free[8] = lens != "radtan"
        flags = cv2.CALIB_USE_INTRINSIC_GUESS + (0 if lens != "radtan" else cv2.CALIB_FIX_K3)
        flags += cv2.CALIB_RATIONAL_MODEL if lens == "rational" else 0
        _, K, D, _, _ = cv2.calibrateCamera(flat, places, size, guess, np.zeros(count), flags=flags)
    return Lens(model, np.concatenate([K[[0, 1, 0, 1], [0, 1, 2, 2]], np.ravel(D)[:count]]), free)


def _board_pose(lens: Lens, view: View, points: Array) -> tuple[Array, float] | None:
    """T_camera_board and the root mean square error in px, or None."""
    flat = points[view.ids]
    if lens.model == "fisheye":
        ideal = cv2.fisheye.undistortPoints(view.places[:, None], lens.K, lens.distortion).reshape(-1, 2)
    else:
        ideal = cv2.undistortPoints(view.places[:, None], lens.K, lens.distortion).reshape(-1, 2)
    if np.linalg.matrix_rank(flat[:, :2] - flat[:, :2].mean(axis=0), tol=1e-6) < 2:
        return None
    good, rotations, translations, _ = cv2.solvePnPGeneric(flat, ideal, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
    best: tuple[Array, float] | None = None
    for rotation, translation in zip(rotations, translations, strict=True) if good else ():
        rotation, translation = cv2.solvePnPRefineLM(flat, ideal, np.eye(3), None, rotation, translation)
        if translation[2, 0] <= 0:
            continue
        places, _ = lens.project(flat, rotation, translation)
        error = float(np.sqrt(((places - view.places) ** 2).sum(axis=1).mean()))
        if best is None or error < best[1]:
            best = _matrix(np.concatenate([rotation.ravel(), translation.ravel()])), error
    return best


def first_cameras(names: Sequence[str], views: Sequence[View], poses: Sequence[Array]) -> tuple[int, list[Array]]:
    """The cameras among each other, along pairs with many common frames.

    Returns:
        the reference camera, and T_camera_world of each, the world being the reference camera's.

    Raises:
        RigError: groups of cameras that never saw the board together.
    """
    seen: dict[int, dict[int, Array]] = defaultdict(dict)
    for view, T in zip(views, poses, strict=True):
        seen[view.frame][view.camera] = T
    steps: dict[tuple[int, int], list[Array]] = defaultdict(list)
    for by_camera in seen.values():
        for a, T_a in by_camera.items():
            for b, T_b in by_camera.items():
                if a != b:
                    steps[a, b].append(T_a @ inverse(T_b))
    total = Counter(dict.fromkeys(range(len(names)), 0))
    for (a, _), found in steps.items():
        total[a] += len(found)
    reference = max(range(len(names)), key=lambda c: (total[c], -c))
    reached = {reference: np.eye(4)}
    while len(reached) < len(names):
        edges = [(len(found), a, b) for (a, b), found in steps.items() if b in reached and a not in reached]
        if not edges:
            inside = ", ".join(names[c] for c in sorted(reached))
            outside = ", ".join(names[c] for c in range(len(names)) if c not in reached)
            raise RigError(
                f"no frame shows the board to one of {inside} and at the same time to one of {outside}: record it "
                "where both see it (or the videos do not start at the same instant)"
            )
        _, a, b = max(edges)
        reached[a] = _medoid(steps[a, b]) @ reached[b]
    return reference, [reached[c] for c in range(len(names))]


def _medoid(transforms: Sequence[Array]) -> Array:
    """The one that the others are nearest to; a radian counts like 2 m."""
    stack = np.array(transforms[:200])
    apart = np.linalg.norm(stack[:, None, :3, 3] - stack[None, :, :3, 3], axis=-1)
    turn = np.linalg.norm(stack[:, None, :3, :3] - stack[None, :, :3, :3], axis=(-2, -1)) / np.sqrt(2)
    return np.asarray(stack[int(np.median(apart + 2 * turn, axis=1).argmin())])


def _first_boards(kept: Sequence[tuple[View, Array]], cameras: Sequence[Array]) -> dict[int, Array]:
    """Frame -> T_world_board, by the view in which the board is largest."""
    best: dict[int, tuple[float, Array]] = {}
    for view, T in kept:
        size = float(np.prod(np.ptp(view.places, axis=0)))
        if view.frame not in best or size > best[view.frame][0]:
            best[view.frame] = size, inverse(cameras[view.camera]) @ T
    return {frame: T for frame, (_, T) in best.items()}


def _outliers(views: Sequence[View], done: Adjusted) -> set[int]:
    """Views that do not fit: the board moved while the cameras were not in time, or corners were misread."""
    errors = np.array([np.sqrt((r**2).sum(axis=1).mean()) for r in done.residuals])
    limit = max(BAD_VIEW_PX, BAD_VIEW_TIMES * float(np.median(errors)))
    worst = {int(i) for i in np.flatnonzero(errors > limit)}
    # No camera and no reference may vanish.
    left = Counter(view.camera for i, view in enumerate(views) if i not in worst)
    return {i for i in worst if left[views[i].camera] >= MIN_LENS_VIEWS}


def _without_misread_corners(
    names: Sequence[str], views: list[View], done: Adjusted, board: Board, reference: int, dropped: list[str]
) -> tuple[list[View], Adjusted]:
    """The views without single corners that are far off, and the adjustment without them; says which in `dropped`."""
    cleaned = []
    for view, residual in zip(views, done.residuals, strict=True):
        errors = np.linalg.norm(residual, axis=1)
        good = errors <= max(BAD_VIEW_PX, BAD_CORNER_TIMES * float(np.median(errors)))
        bad = int((~good).sum())
        if 0 < bad <= max(1.0, BAD_CORNERS * len(good)):
            dropped.append(
                f"{names[view.camera]}, frame {view.frame}: {bad} of {len(good)} corners, {errors.max():.1f} px off: "
                "misread"
            )
            view = replace(view, ids=view.ids[good], places=view.places[good])
        cleaned.append(view)
    if all(new is old for new, old in zip(cleaned, views, strict=True)):
        return views, done
    return cleaned, adjust(done.bundle, cleaned, board.points, reference)


def _dropped(names: Sequence[str], view: View, residual: Array) -> str:
    error = float(np.sqrt((residual**2).sum(axis=1).mean()))
    return f"{names[view.camera]}, frame {view.frame}: {error:.1f} px off the other cameras: in motion and not in time?"


def find_floor(
    cameras: Sequence[Array],
    boards: Mapping[int, Array],
    board: Board,
    frames: Sequence[int] | None,
    thickness_m: float,
) -> tuple[Array, list[int]]:
    """Where the room is: the board lying on the floor is its origin, x along its columns, z up.

    Args:
        cameras: T_world_camera in any world.
        boards: frame -> T_world_board in the same world.
        board: the board.
        frames: in which it lies on the floor; None: those below which nothing is.
        thickness_m: height of its face above the floor.

    Returns:
        T_room_world [4, 4] and the frames.

    Raises:
        RigError: no such frame, or the board does not lie below the cameras in it.
    """
    up, _ = cameras_up(list(cameras))
    centres = np.array([T[:3, 3] for T in cameras])
    nx, ny = board.grid
    corners = board.points[[0, nx - 1, nx * (ny - 1), nx * ny - 1]]
    held = {f: corners @ T[:3, :3].T + T[:3, 3] for f, T in boards.items()}
    everything = np.concatenate([*held.values(), centres])

    def lies(frame: int) -> bool:
        T = boards[frame]
        normal = T[:3, 2] * np.sign(T[:3, 2] @ up)
        upright = normal @ up > np.cos(UPRIGHT_RAD)
        above = (everything - T[:3, 3]) @ normal
        return bool(
            upright and above.min() > -BELOW_FLOOR_M - 0.01 * np.linalg.norm(everything - T[:3, 3], axis=1).max()
        )

    if frames is None:
        lying = [f for f in boards if lies(f)]
        # A board held low lies in a plane of its own: the floor is the plane that most of them share.
        chosen = max(([f for f in lying if _coplanar(boards[f], boards[g])] for g in lying), key=len, default=[])
        if len(chosen) < 2:  # a single one may be held like that by chance
            raise RigError(
                "in no two frames does the board lie below everything else: lay it on the floor where several "
                "cameras see it, at the beginning or the end, or name such frames with --floor"
            )
    else:
        missing = [f for f in frames if f not in boards]
        if missing:
            raise RigError(f"--floor: the board was not found in frame {', '.join(map(str, missing))}")
        chosen = list(frames)
        tilted = [f for f in chosen if abs(boards[f][:3, 2] @ up) < np.cos(UPRIGHT_RAD)]
        if tilted:
            raise RigError(
                f"--floor: in frame {tilted[0]} the board is tilted by more than {np.degrees(UPRIGHT_RAD):.0f} degrees "
                "against the cameras' images: is it on the floor there?"
            )
    # The board may have been laid down more than once: the plane is that of all frames, the origin that of the most.
    origins = np.array([boards[f][:3, 3] for f in chosen])
    points = np.concatenate([held[f] for f in chosen])
    middle = points.mean(axis=0)
    normal = np.linalg.svd(points - middle)[2][2]
    normal = normal * np.sign(normal @ up)
    apart = np.linalg.norm(origins[:, None] - origins[None], axis=-1)
    near = apart[int(np.median(apart, axis=1).argmin())] < 0.02
    origin = origins[near].mean(axis=0)
    x = np.array([boards[f][:3, 0] for f in chosen])[near].mean(axis=0)
    x -= (x @ normal) * normal
    x /= np.linalg.norm(x)
    origin = origin - ((origin - middle) @ normal) * normal
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(normal, x), normal], axis=1)
    T[:3, 3] = origin - thickness_m * normal
    return inverse(T), sorted(chosen)


def _coplanar(a: Array, b: Array) -> bool:
    """Whether two boards lie in one plane, within a centimetre and two degrees."""
    apart = a[:3, 3] - b[:3, 3]
    flat = max(abs(float(apart @ a[:3, 2])), abs(float(apart @ b[:3, 2]))) < 0.01
    return flat and abs(float(a[:3, 2] @ b[:3, 2])) > np.cos(np.radians(2.0))


def _camera(name: str, size: tuple[int, int], lens: Lens, T: Array) -> Camera:
    distortion = lens.distortion if lens.free[8:9].all() else lens.distortion[:4]
    return Camera(name, size[0], size[1], lens.K, T, distortion, lens.model)


def _vector(T: Array) -> Array:
    return np.concatenate([cv2.Rodrigues(T[:3, :3])[0].ravel(), T[:3, 3]])


def _matrix(pose: Array) -> Array:
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(pose[:3])[0]
    T[:3, 3] = pose[3:]
    return T
