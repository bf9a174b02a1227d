# SPDX-License-Identifier: Apache-2.0
"""What another tool's file says -> a rig: metres, z up, the floor at z = 0, poses of optical frames.

Nothing is guessed silently. What a format documents is checked against the cameras' geometry (do they look at one
place, how far away is it, which way is up), and what neither settles is asked for with an option.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core.camera import Camera, Rig
from limbloc_ros.core.errors import RigError
from limbloc_ros.rig.formats.common import CAMERA_TO_WORLD, WORLD_TO_CAMERA, FoundCamera, Reading
from limbloc_ros.rig.geometry import Look, cameras_up, inverse, rotation_between, where_they_look
from limbloc_ros.rig.volume import derive_volume

Array = NDArray[np.float64]

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254}
AXES = {
    f"{sign}{axis}": (1.0 if not sign else -1.0) * np.eye(3)[i] for i, axis in enumerate("xyz") for sign in ("", "-")
}

#: Cameras of a room stand between these distances from the place that they look at, m.
NEAREST_M, FURTHEST_M = 0.7, 20.0
#: A world whose up differs by more than this from that of the cameras' images is suspicious.
TILT_RAD = np.radians(60.0)
FITS = ("letterbox", "crop", "stretch")


@dataclass(frozen=True)
class Wishes:
    """What the person at the terminal said; None: as the format documents and the geometry confirms.

    Attributes:
        unit: a key of UNITS.
        direction: WORLD_TO_CAMERA or CAMERA_TO_WORLD.
        up: a key of AXES, or `cameras`: the mean up of the images.
        floor_m: the floor's height along `up` in the file's world, m.
        camera_heights: camera -> its height above the floor, m, in place of floor_m.
        sizes: camera -> width, height of its images now; the key `` is for all others.
        fit: how images of another shape than the calibrated ones were made, of FITS.
        names: old name -> new name.
        volume: corners of the carve volume, m.
    """

    unit: str | None = None
    direction: str | None = None
    up: str | None = None
    floor_m: float | None = None
    camera_heights: Mapping[str, float] = field(default_factory=dict)
    sizes: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    fit: str | None = None
    names: Mapping[str, str] = field(default_factory=dict)
    volume: tuple[Array, Array] | None = None


def settle(reading: Reading, wishes: Wishes) -> tuple[Rig, list[str]]:
    """Make the rig.

    Returns:
        the rig, and what was decided on what grounds, a line each.

    Raises:
        RigError: something is missing, contradictory or ambiguous; the message says what was seen and which option
            settles it.
    """
    said = list(reading.notes)
    if not reading.cameras:
        raise RigError(f"{reading.source} holds no camera")
    lost = [camera.name for camera in reading.cameras if camera.T is None]
    if lost:
        raise RigError(
            f"{reading.source}: no pose of camera {', '.join(lost)}: this file holds intrinsics only; give the poses "
            "(--tf for ROS), or measure them with `limbloc rig calibrate`"
        )
    names = _renamed([camera.name for camera in reading.cameras], wishes.names, reading.source)
    poses = _directed(reading, wishes, said)
    poses = _scaled(reading, poses, wishes, said)
    poses = _levelled(reading, poses, names, wishes, said)
    cameras = tuple(
        _resized(found, name, T, wishes, said) for found, name, T in zip(reading.cameras, names, poses, strict=True)
    )
    return Rig(cameras, *(wishes.volume or derive_volume(cameras))), said


def _renamed(names: Sequence[str], wanted: Mapping[str, str], source: str) -> list[str]:
    unknown = [name for name in wanted if name not in names]
    if unknown:
        raise RigError(f"--rename: {source} has no camera {', '.join(unknown)}; it has {', '.join(names)}")
    return [wanted.get(name, name) for name in names]


def _directed(reading: Reading, wishes: Wishes, said: list[str]) -> list[Array]:
    """T_world_camera in the file's unit."""
    matrices = [camera.T for camera in reading.cameras if camera.T is not None]
    for camera, T in zip(reading.cameras, matrices, strict=True):
        R = T[:3, :3]
        if np.abs(R @ R.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R) < 0:
            raise RigError(
                f"{reading.source}: camera {camera.name}: its rotation has determinant {np.linalg.det(R):.3f} and rows "
                f"of length {np.linalg.norm(R, axis=1).round(3).tolist()}; expected a right-handed rotation. Was the "
                "file edited, or written by a program whose axes are left-handed? Export it again, or measure the "
                "cameras with `limbloc rig calibrate`"
            )
    ways = {CAMERA_TO_WORLD: matrices, WORLD_TO_CAMERA: [inverse(T) for T in matrices]}
    chosen = wishes.direction or reading.direction
    other = WORLD_TO_CAMERA if chosen == CAMERA_TO_WORLD else CAMERA_TO_WORLD
    if len(matrices) < 2:
        said.append(f"direction: {chosen}, as the format documents; one camera alone cannot confirm it")
        return ways[chosen]
    look, reverse = where_they_look(ways[chosen]), where_they_look(ways[other])
    if wishes.direction is not None:
        said.append(f"direction: {chosen}, as you said; {_describe(look)}")
    elif look.common and not (reverse.common and reverse.miss < 0.5 * look.miss):
        said.append(f"direction: {chosen}, as the format documents; so read, {_describe(look)}")
    elif look.parallel:
        said.append(f"direction: {chosen}, as the format documents; the cameras look the same way: nothing confirms it")
    else:
        raise RigError(
            f"{reading.source}: read as {chosen}, as the format documents, {_describe(look)}; read as {other}, "
            f"{_describe(reverse)}. Say --direction {chosen} or --direction {other}"
        )
    return ways[chosen]


def _describe(look: Look) -> str:
    if look.parallel:
        return "the cameras look the same way"
    behind = int((look.depths <= 0).sum())
    if behind:
        return f"the place the optical axes come closest to lies behind {behind} of {len(look.depths)} cameras"
    if not look.common:
        return f"the optical axes miss each other by {100 * look.miss:.0f} % of the distance"
    return f"all cameras look at one place (their axes miss it by {100 * look.miss:.0f} % of the distance)"


def _scaled(reading: Reading, poses: list[Array], wishes: Wishes, said: list[str]) -> list[Array]:
    """The same in metres."""
    look = where_they_look(poses)
    if len(poses) == 1:
        distances, nearest = np.array([np.linalg.norm(poses[0][:3, 3])]), NEAREST_M
        what = "the camera stands {} from the origin"
    elif look.parallel:  # the spread of the cameras is all there is
        origins = np.array([T[:3, 3] for T in poses])
        distances = np.linalg.norm(origins - origins.mean(axis=0), axis=1)[len(poses) // 2 :]
        what, nearest = "the cameras stand {} to {} from their middle", 0.02
    else:
        distances, nearest = look.distances, NEAREST_M
        what = "the cameras stand {} to {} from the place they look at"

    def so_far(unit_m: float) -> str:
        return what.format(*(_length(unit_m * d) for d in (distances.min(), distances.max())))

    def plausible(unit_m: float) -> bool:
        return nearest <= unit_m * float(np.median(distances)) <= FURTHEST_M

    if wishes.unit is not None:
        unit_m, why = UNITS[wishes.unit], "as you said"
    elif reading.unit_m is not None:
        unit_m, why = reading.unit_m, "as the format documents"
    elif plausible(1.0):
        unit_m, why = 1.0, "the format leaves it open, and metres are plausible"
    else:
        options = "; ".join(f"--unit {name}: {so_far(value)}" for name, value in UNITS.items())
        raise RigError(f"{reading.source}: the unit of length is not written in the file. Say which: {options}")
    name = next((name for name, value in UNITS.items() if value == unit_m), f"{unit_m} m")
    if not plausible(unit_m):
        others = [other for other, value in UNITS.items() if plausible(value) and other != name]
        text = f"{reading.source}: taken in {name} ({why}), {so_far(unit_m)}, which no room has"
        if wishes.unit is None:
            hints = " or ".join(f"--unit {other} ({so_far(UNITS[other])})" for other in others)
            raise RigError(f"{text}; expected {NEAREST_M} to {FURTHEST_M} m. Say {hints or '--unit'}")
        said.append(f"warning: {text}")
    said.append(f"unit: {name}, {why}; so read, {so_far(unit_m)}")
    scaled = [T.copy() for T in poses]
    for T in scaled:
        T[:3, 3] *= unit_m
    return scaled


def _length(metres: float) -> str:
    if metres >= 1000:
        return f"{metres / 1000:.1f} km"
    return f"{metres:.2f} m" if metres >= 0.1 else f"{1000 * metres:.1f} mm"


def _levelled(
    reading: Reading, poses: list[Array], names: Sequence[str], wishes: Wishes, said: list[str]
) -> list[Array]:
    """The same with z up and the floor at z = 0."""
    up, agreement = cameras_up(poses)
    declared = wishes.up or ("z" if reading.world == "room" else None)
    nearest = max(AXES, key=lambda name: float(AXES[name] @ up))
    seen = f"the images' own up points along the file's {nearest} ({up.round(2).tolist()})"
    if declared is None and reading.world == "first camera":
        raise RigError(
            f"{reading.source}: its world is its first camera, so it knows no floor. Say --up cameras (level by the "
            f"images; {seen}) and --camera-height {names[0]}=METRES; or measure the floor with `limbloc rig calibrate`"
        )
    if declared is None:
        if float(up[2]) < np.cos(TILT_RAD) * max(agreement, 0.5) or agreement < 0.3:
            raise RigError(
                f"{reading.source}: which way is up is not written in the file, and z is not likely: {seen}. Say --up "
                f"with x, y, z, -x, -y, -z or cameras"
            )
        declared = "z"
    if declared == "cameras":
        if agreement < 0.5:
            raise RigError(f"--up cameras: the images' up directions contradict each other: {seen}; say an axis")
        axis = up
        said.append(f"up: levelled by the cameras' images ({seen}), good to a few degrees")
    else:
        axis = AXES[declared]
        off = float(np.degrees(np.arccos(np.clip(axis @ up, -1, 1))))
        if agreement >= 0.3 and np.radians(off) > TILT_RAD:
            text = f"{reading.source}: up is taken as {declared}, but {seen}, {off:.0f} degrees away: a flipped world?"
            if wishes.up is None:
                raise RigError(f"{text} Say --up {nearest}, or --up {declared} if the cameras really hang like that")
            said.append(f"warning: {text}")
        said.append(f"up: {declared}; {seen}")
    turn = np.eye(4)
    turn[:3, :3] = rotation_between(axis, np.array([0.0, 0, 1]))
    levelled = [turn @ T for T in poses]
    if wishes.camera_heights:
        unknown = [name for name in wishes.camera_heights if name not in names]
        if unknown:
            raise RigError(f"--camera-height: no camera {', '.join(unknown)}; there are {', '.join(names)}")
        floors = [levelled[names.index(name)][2, 3] - height for name, height in wishes.camera_heights.items()]
        floor = float(np.mean(floors))
        said.append(f"floor: by the height of {', '.join(wishes.camera_heights)}; spread {np.ptp(floors):.3f} m")
    elif wishes.floor_m is not None:
        floor = wishes.floor_m
    elif declared == "cameras":
        raise RigError(f"--up cameras needs the floor too: --camera-height {names[0]}=METRES")
    else:
        floor = 0.0
    heights = np.array([T[2, 3] for T in levelled]) - floor
    lowest = int(heights.argmin())
    told = bool(wishes.camera_heights) or wishes.floor_m is not None
    if heights[lowest] < 0 or (heights[lowest] < 0.02 and not told):
        raise RigError(
            f"{reading.source}: camera {names[lowest]} would stand at {heights[lowest]:.2f} m, on the floor (z = 0 of "
            f"the file's world) or below it: say where the floor is: --camera-height {names[lowest]}=METRES or "
            "--floor METRES"
        )
    said.append(f"floor: z = 0; the cameras stand {heights.min():.2f} to {heights.max():.2f} m above it")
    shift = np.eye(4)
    shift[2, 3] = -floor
    if declared == "cameras":
        look = where_they_look(levelled)
        middle = np.mean([T[:3, 3] for T in levelled], axis=0)
        shift[:2, 3] = -(middle if look.parallel else look.point)[:2]
        said.append(f"origin: below {'the cameras' if look.parallel else 'the place that the cameras look at'}")
    return [shift @ T for T in levelled]


def _resized(found: FoundCamera, name: str, T: Array, wishes: Wishes, said: list[str]) -> Camera:
    wanted = wishes.sizes.get(name, wishes.sizes.get(found.name, wishes.sizes.get("")))
    size = found.size or wanted
    if size is None:
        raise RigError(f"camera {name}: the file does not hold the image size: say --size {name}=WIDTHxHEIGHT")
    camera = Camera(name, size[0], size[1], found.K, T, found.distortion, found.model)
    if wanted is None or wanted == size:
        return camera
    said.append(f"{name}: calibrated at {size[0]}x{size[1]}, used at {wanted[0]}x{wanted[1]} px")
    return resized(camera, wanted, wishes.fit)


def resized(camera: Camera, size: tuple[int, int], fit: str | None = None) -> Camera:
    """The same camera, its images scaled to another size.

    Args:
        camera: as calibrated.
        size: width, height of the images now, px.
        fit: how images of another shape were made: `letterbox` (the whole image with bars), `crop` (borders cut off) or
            `stretch`; not needed where the shape is the same.

    Raises:
        RigError: another shape and no fit.
    """
    ratios = np.array([size[0] / camera.width, size[1] / camera.height])
    same = abs(ratios[0] / ratios[1] - 1) < 0.5 / min(*size, camera.width, camera.height)
    if not same and fit is None:
        raise RigError(
            f"camera {camera.name}: calibrated at {camera.width}x{camera.height}, its images are {size[0]}x{size[1]} "
            "px, another shape: say how they were made: --fit letterbox (whole image, bars added), crop or stretch"
        )
    scale = ratios if same or fit == "stretch" else np.full(2, ratios.min() if fit == "letterbox" else ratios.max())
    # Pixel centres are integers: the image's corner is at -0.5. Bars or cuts are the same on both sides.
    offset = 0.5 * (np.array(size) - scale * (camera.width, camera.height))
    A = np.eye(3)
    A[:2, :2] = np.diag(scale)
    A[:2, 2] = 0.5 * scale - 0.5 + offset
    return replace(camera, width=size[0], height=size[1], K=A @ camera.K)
