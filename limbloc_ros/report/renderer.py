# SPDX-License-Identifier: Apache-2.0
"""Triangle meshes -> picture, in software: no display, no graphics card, the same pixels everywhere.

A layer keeps only its nearest surface; layers are then blended back to front at every pixel. So a glassy hull shows
the stick figure inside it, and a translucent flesh figure does not show its own inner walls.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from limbloc_ros.core.camera import Camera
from limbloc_ros.core.pose import Array
from limbloc_ros.report._renderer_kernels import rasterise
from limbloc_ros.report.mesh import Mesh

Picture = NDArray[np.uint8]
FloatPicture = NDArray[Any]

GAMMA = 2.2
#: Towards the lights, in the camera's frame (x right, y down, z forward), with their strengths.
LIGHTS = (((-0.45, -0.75, -0.55), 0.72), ((0.75, -0.15, -0.55), 0.26), ((0.2, -0.6, 0.9), 0.18))
AMBIENT = 0.24
#: Spacing of the lines on the floor, m.
GRID_M = 0.5


@dataclass(frozen=True)
class Layer:
    """One thing in the picture.

    Attributes:
        mesh: its triangles.
        opacity: 0 to 1 where the surface faces the camera.
        edge_opacity: 0 to 1 where it is seen edge-on; None for the same as `opacity`. Glass has little and much.
        colour_map: scalars [N] -> sRGB [N, 3]; None takes the mesh's own colours.
        gloss: strength of the highlight.
        outlined: draw a thin dark line where depth jumps.
    """

    mesh: Mesh
    opacity: float = 1.0
    edge_opacity: float | None = None
    colour_map: Callable[[NDArray[Any]], NDArray[Any]] | None = None
    gloss: float = 0.12
    outlined: bool = True


def look_at(
    target: ArrayLike,
    azimuth_rad: float,
    elevation_rad: float,
    distance_m: float,
    size_px: tuple[int, int],
    field_of_view_rad: float = 0.5,
) -> Camera:
    """A camera without distortion that looks at `target`.

    Args:
        target: [3] m; it appears in the middle of the picture.
        azimuth_rad: where the camera stands seen from the target, about world z from world x.
        elevation_rad: how high it stands, 0 level, below pi/2.
        distance_m: from the target.
        size_px: (width, height).
        field_of_view_rad: of the picture's height.
    """
    width, height = size_px
    outward = np.array(
        [
            np.cos(elevation_rad) * np.cos(azimuth_rad),
            np.cos(elevation_rad) * np.sin(azimuth_rad),
            np.sin(elevation_rad),
        ]
    )
    forward = -outward
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    T[:3, 3] = np.asarray(target, dtype=np.float64) + distance_m * outward
    f = height / 2 / np.tan(field_of_view_rad / 2)
    K = np.array([[f, 0, (width - 1) / 2], [0, f, (height - 1) / 2], [0, 0, 1]])
    return Camera("view", width, height, K, T)


def background(
    size_px: tuple[int, int], top: ArrayLike = (0.93, 0.94, 0.96), bottom: ArrayLike = (0.98, 0.98, 0.98)
) -> Picture:
    """A plain vertical gradient, uint8 rgb [height, width, 3]."""
    width, height = size_px
    t = np.linspace(0, 1, height)[:, None, None]
    column = (1 - t) * np.asarray(top) + t * np.asarray(bottom)
    return np.asarray(np.broadcast_to(column * 255 + 0.5, (height, width, 3)).astype(np.uint8))


def render(
    layers: Sequence[Layer], camera: Camera, backdrop: Picture | None = None, *, floor: bool = False, smooth: int = 3
) -> Picture:
    """Draw the layers.

    Args:
        layers: what to draw; their order does not matter, depth decides.
        camera: the view; distortion is applied to the vertices, so a real camera's image may be the backdrop.
        backdrop: uint8 rgb [height, width, 3] of the camera's size; a light gradient when None.
        floor: draw the floor z = 0 with a grid of 0.5 m and the figures' soft shadow (views without distortion).
        smooth: samples per pixel along each axis, against jagged edges.

    Returns:
        uint8 rgb [height, width, 3].
    """
    size = (camera.width, camera.height)
    picture = background(size) if backdrop is None else backdrop
    if picture.shape != (camera.height, camera.width, 3):
        raise ValueError(f"backdrop: expected shape {(camera.height, camera.width, 3)}, got {picture.shape}")
    canvas = (picture.astype(np.float32) / 255) ** GAMMA
    if floor:
        canvas = _floor(canvas, layers, camera)
    part = _region(layers, camera)
    if part is not None:
        x0, y0, x1, y1 = part
        K = camera.K - np.array([[0, 0, x0], [0, 0, y0], [0, 0, 0]])
        window = dataclasses.replace(camera, width=x1 - x0, height=y1 - y0, K=K)
        canvas[y0:y1, x0:x1] = _blend(layers, window, canvas[y0:y1, x0:x1], smooth)
    return np.asarray((np.clip(canvas, 0, 1) ** (1 / GAMMA) * 255 + 0.5).astype(np.uint8))


def _region(layers: Sequence[Layer], camera: Camera) -> tuple[int, int, int, int] | None:
    """x0, y0, x1, y1 of the pixels that the layers can touch, with a margin for the soft shading; None for none."""
    uv = np.concatenate([np.zeros((0, 2)), *(camera.world_to_image(layer.mesh.vertices)[0] for layer in layers)])
    uv = uv[np.isfinite(uv).all(axis=1)]
    if not len(uv):
        return None
    size = np.array([camera.width, camera.height])
    low = np.clip(np.floor(uv.min(axis=0)) - 4, 0, size).astype(int)
    high = np.clip(np.ceil(uv.max(axis=0)) + 5, 0, size).astype(int)
    return (int(low[0]), int(low[1]), int(high[0]), int(high[1])) if (high > low).all() else None


def _blend(layers: Sequence[Layer], camera: Camera, canvas: FloatPicture, smooth: int) -> FloatPicture:
    """The canvas (linear rgb) with the layers over it, furthest first at every sample."""
    drawn = [_draw(layer, camera, smooth) for layer in layers]
    order = np.argsort(np.stack([d[0] for d in drawn]), axis=0)[::-1]
    colours, alphas = np.stack([d[1] for d in drawn]), np.stack([d[2] for d in drawn])
    fine = np.repeat(np.repeat(canvas, smooth, axis=0), smooth, axis=1)
    for rank in order:
        alpha = np.take_along_axis(alphas, rank[None], axis=0)[0][..., None]
        fine += alpha * (np.take_along_axis(colours, rank[None, ..., None], axis=0)[0] - fine)
    return np.asarray(cv2.resize(fine, (camera.width, camera.height), interpolation=cv2.INTER_AREA))


def _draw(layer: Layer, camera: Camera, smooth: int) -> tuple[FloatPicture, FloatPicture, FloatPicture]:
    """Depth [H, W] m (inf where empty), linear rgb [H, W, 3] and opacity [H, W] of one layer."""
    mesh = layer.mesh
    shape = (camera.height * smooth, camera.width * smooth)
    z_buffer = np.full(shape, np.inf, dtype=np.float32)
    values = np.zeros((*shape, 7), dtype=np.float32)
    rgb, alpha = np.zeros((*shape, 3), dtype=np.float32), np.zeros(shape, dtype=np.float32)
    uv, depth = camera.world_to_image(mesh.vertices)
    uv = (uv + 0.5) * smooth - 0.5
    attributes = np.concatenate([mesh.normals, mesh.colours, mesh.scalars[:, None]], axis=1).astype(np.float32)
    rasterise(uv, depth, mesh.faces, attributes, z_buffer, values)
    seen = np.isfinite(z_buffer)
    if not seen.any():
        return z_buffer, rgb, alpha
    here = values[seen]
    colour = here[:, 3:6] if layer.colour_map is None else layer.colour_map(here[:, 6])
    v, u = np.nonzero(seen)
    at = np.stack([(u + 0.5) / smooth - 0.5, (v + 0.5) / smooth - 0.5], axis=1)
    rays = np.ones((len(at), 3), dtype=np.float32)
    rays[:, :2] = (at - camera.K[:2, 2]) / camera.K[[0, 1], [0, 1]]
    normals = here[:, :3] @ camera.T_world_camera[:3, :3].astype(np.float32)
    light, highlight, facing = _light(normals, rays, layer.gloss)
    shade = light * _occlusion(z_buffer, seen, camera.K[0, 0] * smooth, layer.outlined)[seen]
    rgb[seen] = np.clip(colour, 0, 1) ** GAMMA * shade[:, None] + highlight[:, None]
    edge = layer.opacity if layer.edge_opacity is None else layer.edge_opacity
    alpha[seen] = layer.opacity + (edge - layer.opacity) * (1 - facing) ** 2
    return z_buffer, rgb, alpha


def _light(normals: FloatPicture, rays: FloatPicture, gloss: float) -> tuple[FloatPicture, FloatPicture, FloatPicture]:
    """Diffuse light, highlight, and how squarely the surface faces the camera (1 head-on); all [N], camera frame."""
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    facing = np.abs(np.einsum("ij,ij->i", normals, rays))
    light = np.full(len(normals), AMBIENT, dtype=np.float32)
    highlight = np.zeros(len(normals), dtype=np.float32)
    for direction, strength in LIGHTS:
        to_light = (np.asarray(direction) / np.linalg.norm(direction)).astype(np.float32)
        light += strength * np.clip(normals @ to_light, 0, None)
        half = to_light - rays
        half /= np.linalg.norm(half, axis=1, keepdims=True)
        highlight += gloss * strength * np.clip(np.einsum("ij,ij->i", normals, half), 0, None) ** 40
    return light, highlight, facing


def _occlusion(z_buffer: FloatPicture, seen: NDArray[np.bool_], focal_px: float, outlined: bool) -> FloatPicture:
    """Light that reaches each pixel [H, W], 0 to 1: less in hollows, and a thin dark line where depth jumps.

    Depth is compared with its blurred self (Luft et al. 2006, "Image enhancement by unsharp masking the depth
    buffer"), and with its neighbours for the line.
    """
    near = float(z_buffer[seen].min())
    filled = np.where(seen, z_buffer, np.float32(0))
    # A wide blur costs its width: it is done on a coarser picture, where it is a few pixels wide.
    coarse = max(1, round(0.05 * focal_px / near / 4))
    height, width = z_buffer.shape
    small = (-(-width // coarse), -(-height // coarse))
    blurred = cv2.resize(np.dstack([seen.astype(np.float32), filled]), small, interpolation=cv2.INTER_AREA)
    blurred = cv2.GaussianBlur(blurred, (0, 0), 0.05 * focal_px / near / coarse)
    blurred = cv2.resize(blurred, (width, height), interpolation=cv2.INTER_LINEAR)
    around = blurred[..., 1] / np.maximum(blurred[..., 0], 1e-6)
    hollow = np.clip((filled - around) / 0.12, 0, 1)
    if not outlined:
        return np.asarray(1 - 0.55 * hollow, dtype=np.float32)
    behind = cv2.dilate(np.where(seen, z_buffer, np.float32(near - 1)), np.ones((3, 3), np.uint8)) - filled
    line = np.where(seen & (behind > 0.04), np.float32(0.45), np.float32(0))
    return np.asarray((1 - 0.55 * hollow) * (1 - line), dtype=np.float32)


def _floor(canvas: FloatPicture, layers: Sequence[Layer], camera: Camera) -> FloatPicture:
    """The canvas (linear rgb) with the floor z = 0: grid lines that fade with distance, and a soft shadow."""
    vertices = np.concatenate([np.zeros((0, 3)), *(layer.mesh.vertices for layer in layers)])
    if not len(vertices):
        return canvas
    height, width = canvas.shape[:2]
    u, v = (np.arange(n) - c for n, c in ((width, camera.K[0, 2]), (height, camera.K[1, 2])))
    u, v = u / camera.K[0, 0], v / camera.K[1, 1]
    rays = np.stack([*np.meshgrid(u, v), np.ones((height, width))], axis=-1) @ camera.T_world_camera[:3, :3].T
    eye = camera.T_world_camera[:3, 3]
    down = rays[..., 2] < -1e-6
    reach = np.where(down, -eye[2] / np.where(down, rays[..., 2], -1.0), 0.0)
    x, y = (eye[i] + reach * rays[..., i] for i in (0, 1))
    middle = (vertices[:, :2].min(axis=0) + vertices[:, :2].max(axis=0)) / 2
    fade = np.where(down, np.clip(1.6 - np.hypot(x - middle[0], y - middle[1]), 0, 1), 0.0)
    lines = np.zeros_like(x)
    for value in (x, y):
        # How far a pixel reaches along this axis of the floor, m: the line is drawn one and a half pixels wide.
        spread = np.hypot(*np.gradient(value)).clip(1e-4)
        to_line = np.abs((value / GRID_M + 0.5) % 1.0 - 0.5) * GRID_M
        lines = np.maximum(lines, np.clip(1.25 - to_line / spread, 0, 1) * np.clip(0.1 / spread, 0, 1))
    dim = 1 - 0.25 * lines * fade - 0.5 * _shadow(vertices, middle, x, y) * (fade > 0)
    return np.asarray(canvas * dim[..., None], dtype=np.float32)


def _shadow(vertices: Array, middle: Array, x: Array, y: Array) -> FloatPicture:
    """How dark the floor is at (x, y) m, 0 to 1: a blurred plan of all that is lower than a metre, low things most."""
    cell, span = 0.01, 2.5
    cells = int(2 * span / cell)
    column_row = ((vertices[:, :2] - middle + span) / cell).astype(np.int64)
    kept = ((column_row >= 0) & (column_row < cells)).all(axis=1) & (vertices[:, 2] < 1.0)
    plan = np.zeros((cells, cells), dtype=np.float32)
    nearness = (1.0 - vertices[kept, 2]).clip(0, 1).astype(np.float32) ** 2
    np.maximum.at(plan, (column_row[kept, 1], column_row[kept, 0]), nearness)
    plan = cv2.GaussianBlur(cv2.dilate(plan, np.ones((5, 5), np.uint8)), (0, 0), 6.0)
    at = [((value - m + span) / cell).astype(np.float32) for value, m in zip((x, y), middle, strict=True)]
    return np.asarray(cv2.remap(plan, at[0], at[1], cv2.INTER_LINEAR, borderValue=0))
