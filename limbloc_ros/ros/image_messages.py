# SPDX-License-Identifier: Apache-2.0
"""sensor_msgs Image, CompressedImage and CameraInfo <-> arrays and cameras.

Incoming pictures are decoded by `core.images`, which the offline run of a bag uses too.
"""

from __future__ import annotations

from array import array

import cv2
import numpy as np
from numpy.typing import ArrayLike
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Header

from limbloc_ros.core.camera import Camera
from limbloc_ros.core.errors import RigError
from limbloc_ros.core.images import (
    Pixels,
    binary,
    compressed_to_pixels,
    image_to_pixels,
    message_to_mask,
    message_to_pixels,
)
from limbloc_ros.core.mask_png import encode_mask

__all__ = [
    "MASK_FORMAT",
    "camera_to_info",
    "compressed_to_pixels",
    "image_to_pixels",
    "info_to_camera",
    "mask_to_compressed",
    "mask_to_image",
    "message_to_mask",
    "message_to_pixels",
    "pixels_to_compressed",
    "pixels_to_image",
]

#: As image_transport names it.
MASK_FORMAT = "mono8; png compressed mono8"


def pixels_to_image(pixels: Pixels, header: Header) -> Image:
    """uint8 [height, width] -> mono8, [height, width, 3] -> bgr8."""
    msg = Image(header=header, height=pixels.shape[0], width=pixels.shape[1])
    msg.encoding = "mono8" if pixels.ndim == 2 else "bgr8"
    msg.step = int(np.prod(pixels.shape[1:]))
    msg.data = _bytes(pixels)
    return msg


def _bytes(values: Pixels) -> array[int]:
    """The only fast way into a uint8[] field: an ndarray takes 4000 times, a memoryview 1500 times as long."""
    result = array("B")
    result.frombytes(np.ascontiguousarray(values).data.cast("B"))
    return result


def pixels_to_compressed(pixels: Pixels, header: Header, quality: int = 90) -> CompressedImage:
    """Grey or BGR pixels -> JPEG, named as image_transport does."""
    encoding = "mono8" if pixels.ndim == 2 else "bgr8"
    _, data = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return CompressedImage(header=header, format=f"{encoding}; jpeg compressed {encoding}", data=_bytes(data))


def mask_to_image(mask: Pixels, header: Header) -> Image:
    """uint8 [height, width], non-zero = foreground -> mono8 with 0 and 255."""
    return pixels_to_image(binary(mask), header)


def mask_to_compressed(mask: Pixels, header: Header) -> CompressedImage:
    """uint8 [height, width], non-zero = foreground -> PNG of one bit per pixel, about 1 KB for a person."""
    return CompressedImage(header=header, format=MASK_FORMAT, data=array("B", encode_mask(mask)))


_MODELS = {"none": "plumb_bob", "radtan": "plumb_bob", "rational": "rational_polynomial", "fisheye": "equidistant"}


def camera_to_info(camera: Camera, header: Header) -> CameraInfo:
    """The camera's intrinsics; its pose travels as TF or in the rig file."""
    msg = CameraInfo(header=header, width=camera.width, height=camera.height)
    msg.distortion_model = _MODELS[camera.distortion_model]
    distortion = camera.distortion.tolist()
    msg.d = distortion + [0.0] * (5 - len(distortion)) if msg.distortion_model == "plumb_bob" else distortion
    msg.k = camera.K.ravel()
    msg.r = np.eye(3).ravel()
    msg.p = np.hstack([camera.K, np.zeros((3, 1))]).ravel()
    return msg


def info_to_camera(msg: CameraInfo, name: str, T_world_camera: ArrayLike) -> Camera:
    """A CameraInfo and the pose of its optical frame -> camera of the image that is sent (with ROI and binning).

    Raises:
        RigError: an all-zero K, an unknown distortion model or none for the coefficients that are there, a wrong number
            of coefficients, no size.
    """
    models = {"plumb_bob": "radtan", "rational_polynomial": "rational", "equidistant": "fisheye", "": "none"}
    if msg.distortion_model not in models:
        raise RigError(
            f"camera {name}: distortion_model of its CameraInfo must be one of "
            f"{', '.join(filter(None, models))}, got {msg.distortion_model!r}"
        )
    if any(msg.d) and not msg.distortion_model:
        raise RigError(
            f"camera {name}: its CameraInfo has {len(msg.d)} coefficients but no distortion_model; expected one of "
            f"{', '.join(filter(None, models))}"
        )
    model = models[msg.distortion_model] if any(msg.d) else "none"
    K = np.array(msg.k, dtype=np.float64).reshape(3, 3)
    width, height = msg.width, msg.height
    if msg.roi.width and msg.roi.height:
        K[:2, 2] -= msg.roi.x_offset, msg.roi.y_offset
        width, height = msg.roi.width, msg.roi.height
    binning = np.array([max(msg.binning_x, 1), max(msg.binning_y, 1)])
    K[:2] /= binning[:, None]
    K[:2, 2] += 0.5 / binning - 0.5  # integers are pixel centres, so pixel 0 of the binned image lies at (b - 1) / 2
    distortion = np.array(msg.d) if model != "none" else np.zeros(0)
    size = int(width // binning[0]), int(height // binning[1])
    return Camera(name, *size, K, np.asarray(T_world_camera), distortion, model)
