# SPDX-License-Identifier: Apache-2.0
"""The stick figure drawn over a camera's own image, lens distortion included."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core.camera import Camera
from limbloc_ros.core.errors import InputError
from limbloc_ros.core.pose import JOINT, JOINT_NAMES, STICK_BONES, Array

Image = NDArray[np.uint8]

#: Drawing uses this many fractional bits of a pixel (OpenCV's `shift`).
SHIFT = 4
#: Lens distortion bends a bone: it is drawn as so many straight pieces.
PIECES = 8
BRIGHT = {"L": (0.34, 0.71, 0.91), "R": (0.95, 0.50, 0.10), "": (0.98, 0.98, 0.98)}


def side_of(name: str) -> str:
    """`L` or `R` for the person's own side of a joint, bone or part, empty for the middle."""
    return name[-1] if name.endswith(("_L", "_R")) else ""


def draw_stick(image: Image, camera: Camera, joints: Array) -> Image:
    """The image with the stick figure over it: the person's left blue, right orange, middle white.

    Args:
        image: uint8 bgr [height, width, 3] of the camera's size, as the camera gave it (distorted).
        camera: its calibration.
        joints: [25, 3] m in the order of JOINT_NAMES; those that are not finite or behind the camera are left out.

    Raises:
        InputError: the image has not the camera's size.
    """
    check_size(image, camera)
    picture = image.copy()
    on_image = projected(camera, joints)
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


def projected(camera: Camera, joints: Array) -> Array:
    """[N, 2] px of the joints that fall near the image."""
    uv, _ = camera.world_to_image(joints)
    size = np.array([camera.width, camera.height])
    near = np.isfinite(uv).all(axis=1) & (np.abs(np.nan_to_num(uv) - size / 2) < 1.5 * size).all(axis=1)
    return np.asarray(uv[near])


def as_bgr(image: Image) -> Image:
    """A colour image as it is, a grey one in three channels; a mask as a grey figure on a dark ground."""
    if image.ndim == 3:
        return image
    if np.isin(image, (0, 255)).all():
        image = np.where(image > 0, np.uint8(128), np.uint8(38))
    return image[..., None].repeat(3, axis=2)


def label(image: Image, text: str) -> Image:
    """The image with a small caption in its upper left corner."""
    font, scale = cv2.FONT_HERSHEY_SIMPLEX, 0.5
    (width, height), _ = cv2.getTextSize(text, font, scale, 1)
    picture = image.copy()
    picture[: height + 12, : width + 14] = picture[: height + 12, : width + 14] // 4
    cv2.putText(picture, text, (7, height + 6), font, scale, (255, 255, 255), 1, cv2.LINE_AA)
    return picture


def check_size(image: Image, camera: Camera) -> None:
    """Raise InputError when an image is not bgr of its camera's size."""
    if image.shape != (camera.height, camera.width, 3):
        raise InputError(
            f"camera {camera.name}: expected an image of shape {(camera.height, camera.width, 3)}, got {image.shape}"
        )


def _bgr(side: str) -> tuple[int, int, int]:
    red, green, blue = (round(255 * c) for c in BRIGHT[side])
    return blue, green, red
