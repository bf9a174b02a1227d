# SPDX-License-Identifier: Apache-2.0
"""The stick figure and the flesh figure drawn over the cameras' own images."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import cv2
import numpy as np

from limbloc_ros.core.camera import Camera, Rig
from limbloc_ros.core.errors import InputError
from limbloc_ros.core.pose import Array, Flesh
from limbloc_ros.export.stick_drawing import Image, as_bgr, check_size, draw_stick, label, projected
from limbloc_ros.report.mesh import flesh_figure_mesh
from limbloc_ros.report.renderer import Layer, render


def draw_flesh(image: Image, camera: Camera, flesh: Flesh, opacity: float = 0.45) -> Image:
    """The image with the translucent flesh figure over it; arguments as in `draw_stick`."""
    check_size(image, camera)
    layer = Layer(flesh_figure_mesh(flesh), opacity, min(1.0, opacity + 0.3))
    return np.ascontiguousarray(render([layer], camera, image[..., ::-1], smooth=2)[..., ::-1])


def overlay_montage(
    images: Mapping[str, Image],
    rig: Rig,
    joints: Array,
    flesh: Flesh | None = None,
    *,
    columns: int = 0,
    panel_width_px: int = 480,
    close_up: bool = False,
) -> Image:
    """All cameras' images of one frame, with the figure over each, side by side.

    Args:
        images: camera name -> uint8 bgr [H, W, 3] image, or [H, W] mask (drawn in grey).
        rig: the cameras; those without an image are left out.
        joints: [25, 3] m.
        flesh: drawn beneath the sticks when given.
        columns: panels in a row; 0 chooses.
        panel_width_px: width of a panel.
        close_up: show only the part of each image around the person, upright 3:4, instead of the whole image.

    Returns:
        uint8 bgr.

    Raises:
        InputError: no camera of the rig has an image, or one has the wrong size.
    """
    cameras = [camera for camera in rig.cameras if camera.name in images]
    if not cameras:
        raise InputError(f"expected images of {', '.join(rig.names)}, got {', '.join(images) or 'none'}")
    panels = []
    for camera in cameras:
        picture = as_bgr(images[camera.name])
        check_size(picture, camera)
        centre, size = _around_person(camera, joints) if close_up else _whole(camera)
        picture, window = _cut(picture, camera, centre, size, panel_width_px)
        if flesh is not None:
            picture = draw_flesh(picture, window, flesh)
        panels.append(label(draw_stick(picture, window, joints), camera.name))
    columns = columns or min(len(panels), 4 if len(panels) > 4 else 2)
    tallest, gap = max(p.shape[0] for p in panels), 6
    rows = -(-len(panels) // columns)
    sheet = np.full((rows * (tallest + gap) - gap, columns * (panel_width_px + gap) - gap, 3), 255, dtype=np.uint8)
    for k, panel in enumerate(panels):
        y, x = (k // columns) * (tallest + gap), (k % columns) * (panel_width_px + gap)
        sheet[y : y + panel.shape[0], x : x + panel_width_px] = panel
    return sheet


def _around_person(camera: Camera, joints: Array) -> tuple[Array, Array]:
    """Centre and size, px, of the part of the image that shows the joints, 3 wide and 4 high."""
    uv = projected(camera, joints)
    if not len(uv):
        return _whole(camera)
    low, high = uv.min(axis=0), uv.max(axis=0)
    height = max(1.25 * (high[1] - low[1]), 1.35 * (high[0] - low[0]) * 4 / 3, 48.0)
    return (low + high) / 2, np.array([height * 3 / 4, height])


def _whole(camera: Camera) -> tuple[Array, Array]:
    """Centre and size, px, of the whole image."""
    size = np.array([camera.width, camera.height], dtype=np.float64)
    return (size - 1) / 2, size


def _cut(image: Image, camera: Camera, centre: Array, size: Array, width_px: int) -> tuple[Image, Camera]:
    """A part of the image, `width_px` wide and dark beyond the image's edge, and the camera that would have taken it.

    Cutting and scaling change the intrinsics alone: pixel u becomes scale * (u - centre) + the new middle.
    """
    scale = width_px / size[0]
    new = (width_px, round(float(size[1] * scale)))
    shift = (np.array(new) - 1) / 2 - scale * centre
    M = np.array([[scale, 0, shift[0]], [0, scale, shift[1]], [0, 0, 1]])
    if scale < 0.7:  # against flicker of fine texture
        image = cv2.GaussianBlur(image, (0, 0), 0.4 / scale)
    cut = cv2.warpAffine(image, M[:2], new, flags=cv2.INTER_LINEAR, borderValue=(38, 38, 38))
    return cut, dataclasses.replace(camera, width=new[0], height=new[1], K=M @ camera.K)
