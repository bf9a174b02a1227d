# SPDX-License-Identifier: Apache-2.0
"""The stick figure and the flesh figure drawn over the cameras' own images."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import cv2
import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core.camera import Camera, Rig
from limbloc_ros.core.errors import InputError
from limbloc_ros.core.pose import JOINT, JOINT_NAMES, STICK_BONES, Array, Flesh
from limbloc_ros.report.mesh import flesh_figure_mesh, side_of
from limbloc_ros.report.renderer import Layer, render

Image = NDArray[np.uint8]

#: Drawing uses this many fractional bits of a pixel (OpenCV's `shift`).
SHIFT = 4
#: Lens distortion bends a bone: it is drawn as so many straight pieces.
PIECES = 8
BRIGHT = {"L": (0.34, 0.71, 0.91), "R": (0.95, 0.50, 0.10), "": (0.98, 0.98, 0.98)}


def draw_stick(image: Image, camera: Camera, joints: Array) -> Image:
    """The image with the stick figure over it: the person's left blue, right orange, middle white.

    Args:
        image: uint8 bgr [height, width, 3] of the camera's size, as the camera gave it (distorted).
        camera: its calibration.
        joints: [25, 3] m in the order of JOINT_NAMES; those that are not finite or behind the camera are left out.

    Raises:
        InputError: the image has not the camera's size.
    """
    _check_size(image, camera)
    picture = image.copy()
    on_image = _projected(camera, joints)
    person_px = float(np.ptp(on_image, axis=0).max()) if len(on_image) else 0.0
    width = max(1, round(person_px / 95))
    strokes = []
    for a, b in STICK_BONES:
        t = np.linspace(0, 1, PIECES + 1)[:, None]
        uv, _ = camera.world_to_image((1 - t) * joints[JOINT[a]] + t * joints[JOINT[b]])
        if np.isfinite(uv).all() and np.abs(uv).max() < 1e5:
            strokes.append((np.round(uv * (1 << SHIFT)).astype(np.int32), _bgr(side_of(b))))
    for extra, dark in ((2, True), (0, False)):
        for line, colour in strokes:
            cv2.polylines(picture, [line], False, (20, 20, 20) if dark else colour, width + extra, cv2.LINE_AA, SHIFT)
    uv, _ = camera.world_to_image(joints)
    for name, at in zip(JOINT_NAMES, uv, strict=True):
        if np.isfinite(at).all() and np.abs(at).max() < 1e5:
            centre = tuple(int(v) for v in np.round(at * (1 << SHIFT)))
            radius = round((width * 1.1) * (1 << SHIFT))
            cv2.circle(picture, centre, radius + (1 << SHIFT), (20, 20, 20), -1, cv2.LINE_AA, SHIFT)
            cv2.circle(picture, centre, radius, _bgr(side_of(name)), -1, cv2.LINE_AA, SHIFT)
    return picture


def draw_flesh(image: Image, camera: Camera, flesh: Flesh, opacity: float = 0.45) -> Image:
    """The image with the translucent flesh figure over it; arguments as in `draw_stick`."""
    _check_size(image, camera)
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
        _check_size(picture, camera)
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
    uv = _projected(camera, joints)
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


def _projected(camera: Camera, joints: Array) -> Array:
    """[N, 2] px of the joints that fall near the image."""
    uv, _ = camera.world_to_image(joints)
    size = np.array([camera.width, camera.height])
    near = np.isfinite(uv).all(axis=1) & (np.abs(np.nan_to_num(uv) - size / 2) < 1.5 * size).all(axis=1)
    return np.asarray(uv[near])


def as_bgr(image: Image) -> Image:
    """A colour image as it is; a mask as a grey figure on a dark ground."""
    if image.ndim == 3:
        return image
    return np.where((image > 0)[..., None], np.uint8(128), np.uint8(38)).repeat(3, axis=2).astype(np.uint8)


def label(image: Image, text: str) -> Image:
    """The image with a small caption in its upper left corner."""
    font, scale = cv2.FONT_HERSHEY_SIMPLEX, 0.5
    (width, height), _ = cv2.getTextSize(text, font, scale, 1)
    picture = image.copy()
    picture[: height + 12, : width + 14] = picture[: height + 12, : width + 14] // 4
    cv2.putText(picture, text, (7, height + 6), font, scale, (255, 255, 255), 1, cv2.LINE_AA)
    return picture


def _bgr(side: str) -> tuple[int, int, int]:
    red, green, blue = (round(255 * c) for c in BRIGHT[side])
    return blue, green, red


def _check_size(image: Image, camera: Camera) -> None:
    if image.shape != (camera.height, camera.width, 3):
        raise InputError(
            f"camera {camera.name}: expected an image of shape {(camera.height, camera.width, 3)}, got {image.shape}"
        )
