# SPDX-License-Identifier: Apache-2.0
"""The empty room that the simulated cameras see: plank floor, rug, painted walls with pictures, a door, a window."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core.camera import Camera
from limbloc_ros.simulation import _render_kernels as kernels

Image = NDArray[np.uint8]
Floats = NDArray[np.float32]
Colour = tuple[float, float, float]

#: The room is a box: walls at +-HALF_M on x and y, the floor at 0, the ceiling at HEIGHT_M.
HALF_M = 3.0
HEIGHT_M = 2.9
#: Edge length of a texture pixel, m.
TEXEL_M = 0.005
#: The door's middle on the wall x = -HALF_M, m, and its size.
DOOR_Y_M = 0.0
DOOR_SIZE_M = (0.95, 2.05)

# Wall colours (bgr) on -x, +x, -y, +y.
_WALLS = ((176, 186, 190), (168, 172, 158), (150, 168, 182), (182, 172, 160))


def _size(metres: float) -> int:
    return round(metres / TEXEL_M)


def _cloud(rng: np.random.Generator, shape: tuple[int, ...], grain_m: tuple[float, float], strength: float) -> Floats:
    """Smooth random variation [h, w] of about +-strength; grain_m is its size down and across."""
    size = [max(2, round(n * TEXEL_M / g)) for n, g in zip(shape, grain_m, strict=True)]
    small = np.asarray(rng.normal(0, strength, size), dtype=np.float32)
    return np.asarray(cv2.resize(small, shape[::-1], interpolation=cv2.INTER_CUBIC))


def _floor(rng: np.random.Generator) -> Image:
    n = _size(2 * HALF_M)
    image = np.empty((n, n, 3), np.float32)
    plank = _size(0.14)
    for row in range(0, n, plank):
        end = -int(rng.integers(0, _size(1.3)))
        while end < n:
            begin, end = end, end + int(rng.integers(_size(0.9), _size(1.6)))
            image[row : row + plank, max(begin, 0) : end] = np.array([126, 140, 150]) * rng.uniform(0.86, 1.1)
            image[row : row + plank, max(begin, 0) : max(begin, 0) + 1] *= 0.6
        image[row : row + 1] *= 0.6
    image *= (1 + _cloud(rng, (n, n), (0.012, 0.25), 0.05) + _cloud(rng, (n, n), (0.5, 0.5), 0.03))[..., None]
    x = np.arange(n, dtype=np.float32) * np.float32(TEXEL_M) - np.float32(HALF_M)
    y = x[:, None]
    radius = np.hypot(x, y)
    rug = radius < 1.25
    weave = 1 + 0.035 * np.sin(x * 180) * np.sin(y * 180) + _cloud(rng, (n, n), (0.02, 0.02), 0.03)
    ring = (np.abs(radius - 1.1) < 0.03) | (np.abs(radius - 0.55) < 0.02)
    colours = np.where(ring[rug][:, None], np.array([120, 128, 140], np.float32), np.array([104, 98, 110], np.float32))
    image[rug] = colours * weave[rug][:, None]
    lamp = 0.72 + 0.36 * np.exp(-((x - 0.4) ** 2) / 6.0) * np.exp(-((y + 0.3) ** 2) / 6.0)
    return np.asarray(np.clip(image * lamp[..., None], 0, 255).astype(np.uint8))


def _wall(rng: np.random.Generator, index: int) -> Image:
    """Wall `index` seen from inside; row 0 is the ceiling, columns go along +y or +x."""
    h, w = _size(HEIGHT_M), _size(2 * HALF_M)
    image = np.tile(np.array(_WALLS[index], dtype=np.float32), (h, w, 1))
    image *= (1 + _cloud(rng, (h, w), (0.6, 0.6), 0.025) + _cloud(rng, (h, w), (0.03, 0.03), 0.012))[..., None]

    def box(along_m: float, low_m: float, width_m: float, height_m: float, colour: Colour) -> Floats:
        x, y = _size(along_m + HALF_M), h - _size(low_m + height_m)
        area = image[y : y + _size(height_m), x : x + _size(width_m)]
        area[:] = colour
        return area

    def paint(darkest: float) -> Colour:
        blue, green, red = rng.uniform(darkest, 190, 3)
        return float(blue), float(green), float(red)

    def picture(along_m: float, low_m: float, width_m: float, height_m: float, frame: float) -> None:
        box(along_m, low_m, width_m, height_m, (frame, frame, frame))
        inner = box(along_m + 0.04, low_m + 0.04, width_m - 0.08, height_m - 0.08, paint(60))
        inner *= 1 + _cloud(rng, inner.shape[:2], (0.25, 0.25), 0.25)[..., None]

    if index == 0:
        box(DOOR_Y_M - DOOR_SIZE_M[0] / 2 - 0.07, 0, DOOR_SIZE_M[0] + 0.14, DOOR_SIZE_M[1] + 0.07, (196, 202, 204))
        box(DOOR_Y_M - DOOR_SIZE_M[0] / 2, 0, DOOR_SIZE_M[0], DOOR_SIZE_M[1], (58, 60, 62))
        picture(1.2, 1.2, 0.9, 0.65, 70)
    elif index == 1:
        box(-1.1, 0.95, 2.1, 1.35, (150, 158, 160))
        view = box(-1.04, 1.01, 1.98, 1.23, (235, 222, 205))
        view *= 1 + _cloud(rng, view.shape[:2], (0.2, 0.5), 0.06)[..., None]
        box(-0.08, 1.01, 0.05, 1.23, (160, 166, 168))
    elif index == 2:
        picture(-1.9, 1.0, 0.7, 1.0, 40)
        picture(0.2, 1.3, 1.3, 0.75, 200)
    else:
        for shelf in range(3):
            box(-0.9, 0.75 + 0.42 * shelf, 1.7, 0.035, (70, 96, 122))
            at = -0.86
            while at < 0.7:
                width, height = rng.uniform(0.03, 0.07), rng.uniform(0.2, 0.33)
                box(at, 0.785 + 0.42 * shelf, width, height, paint(50))
                at += width + (rng.uniform(0.1, 0.3) if rng.random() < 0.2 else 0.003)
        picture(1.5, 1.2, 0.6, 0.8, 90)
    skirting = image[h - _size(0.09) :]
    skirting[:] = np.where((skirting.mean(-1) > 80)[..., None], (188, 192, 196), skirting)
    up = np.linspace(HEIGHT_M, 0, h, dtype=np.float32)[:, None]
    along = np.linspace(-HALF_M, HALF_M, w, dtype=np.float32)[None]
    light = 0.78 + 0.22 * np.exp(-((up - 1.6) ** 2) / 2.5 - (along - 0.4) ** 2 / 6.0)
    return np.asarray(np.clip(image * light[..., None], 0, 255).astype(np.uint8))


@cache
def _atlas(seed: int) -> Image:
    """All surfaces below each other: floor, four walls, ceiling (its first row is enough: it is plain)."""
    rng = np.random.default_rng([seed, 7])
    ceiling = np.full((4, _size(2 * HALF_M), 3), 168, np.uint8)
    return np.concatenate([_floor(rng), *(_wall(rng, index) for index in range(4)), ceiling])


@dataclass(frozen=True)
class Backdrop:
    """What one camera sees of the empty room.

    Attributes:
        image: uint8 [H, W, 3] bgr.
        floor_m: float32 [H, W, 2] where on the floor a pixel looks, m; NaN where it sees something else.
    """

    image: Image
    floor_m: NDArray[np.float32]


def camera_rays(camera: Camera) -> Floats:
    """[3, H, W] directions of the pixels in world axes, depth 1 along the camera's axis; planes are faster to go on."""
    R = np.ascontiguousarray(camera.T_world_camera[:3, :3])
    rays = np.empty((3, camera.height, camera.width), np.float32)
    if camera.distortion_model != "fisheye" and camera.distortion.size <= 8:
        coefficients = np.zeros(8)
        coefficients[: camera.distortion.size] = camera.distortion
        kernels.cast_rays(camera.K, coefficients, R, rays)
        return rays
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float64)
    pixels = np.stack([u, v], axis=-1).reshape(-1, 1, 2)
    undistort = cv2.fisheye.undistortPoints if camera.distortion_model == "fisheye" else cv2.undistortPoints
    flat = undistort(pixels, camera.K, camera.distortion).reshape(-1, 2)
    rays[:] = (np.concatenate([flat, np.ones((len(flat), 1))], axis=1) @ R.T).T.reshape(rays.shape)
    return rays


def backdrop(camera: Camera, seed: int) -> Backdrop:
    """Cast every pixel's ray onto the room's walls and floor; the camera must be inside the room."""
    centre = camera.T_world_camera[:3, 3].astype(np.float32)
    x, y, z = rays = camera_rays(camera)
    room = np.array([[-HALF_M, HALF_M], [-HALF_M, HALF_M], [0.0, HEIGHT_M]], np.float32)
    with np.errstate(divide="ignore"):
        reach = [
            np.where(ray > 0, high - at, low - at) / ray
            for ray, at, (low, high) in zip(rays, centre, room, strict=True)
        ]
    to_wall = np.minimum(reach[0], reach[1])
    on_wall, on_x = to_wall <= reach[2], reach[0] <= reach[1]
    is_floor, is_ceiling = ~on_wall & (z <= 0), ~on_wall & (z > 0)
    nearest = np.minimum(to_wall, reach[2])
    hit_x, hit_y, hit_z = (at + ray * nearest for at, ray in zip(centre, rays, strict=True))
    n, h = _size(2 * HALF_M), _size(HEIGHT_M)
    wall = np.where(on_x, x > 0, 2 + (y > 0))
    column = np.where(on_wall & on_x, hit_y, hit_x) + np.float32(HALF_M)
    along_wall = np.clip((HEIGHT_M - hit_z) / TEXEL_M, 0.5, h - 1.5)
    on_floor = np.clip((hit_y + np.float32(HALF_M)) / TEXEL_M - 0.5, 0, n - 1)
    row = np.where(on_wall, n + wall * h + along_wall, np.where(is_ceiling, n + 4 * h + 1.5, on_floor))
    image = cv2.remap(
        _atlas(seed),
        np.clip(column / TEXEL_M - 0.5, 0, n - 1).astype(np.float32),
        row.astype(np.float32),
        cv2.INTER_LINEAR,
    )
    # The lens: a little blur, and darker corners.
    image = cv2.GaussianBlur(image, (3, 3), 0.7).astype(np.float32)
    v = np.arange(camera.height, dtype=np.float32)[:, None] - camera.height / 2
    u = np.arange(camera.width, dtype=np.float32) - camera.width / 2
    image *= 1 - 0.14 * (4 / (camera.width**2 + camera.height**2) * (u * u + v * v))[..., None]
    floor = np.where(is_floor[..., None], np.stack([hit_x, hit_y], axis=-1), np.float32(np.nan))
    return Backdrop(np.clip(image, 0, 255).astype(np.uint8), floor)
