# SPDX-License-Identifier: Apache-2.0
"""Raw images of all common encodings, JPEG and PNG -> pixels.

The arguments are read by attribute, as messages of rclpy and of `rosbags` have them, so that the live nodes and the
offline run decode with the same code. Claimed sizes are checked against the bytes before anything is allocated.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core.camera import MAX_PIXELS
from limbloc_ros.core.errors import InputError
from limbloc_ros.core.mask_png import decode_mask

Pixels = NDArray[np.uint8]


class RawImage(Protocol):
    """The fields of a sensor_msgs/Image that hold the picture; `step` is the length of a row in bytes."""

    width: int
    height: int
    encoding: str
    is_bigendian: int
    step: int
    data: Any


class CompressedPicture(Protocol):
    """The fields of a sensor_msgs/CompressedImage that hold the picture."""

    format: str
    data: Any


@dataclass(frozen=True)
class _Encoding:
    """How an encoding lies in memory: bytes per pixel of a row, and OpenCV's conversion to BGR (None: as it is)."""

    channels: int
    to_bgr: int | None = None
    depth: type[np.uint8] | type[np.uint16] = np.uint8


_BAYER = {
    "rggb": cv2.COLOR_BayerRGGB2BGR,
    "bggr": cv2.COLOR_BayerBGGR2BGR,
    "gbrg": cv2.COLOR_BayerGBRG2BGR,
    "grbg": cv2.COLOR_BayerGRBG2BGR,
}

#: The names of sensor_msgs/image_encodings.hpp.
_ENCODINGS = {
    "mono8": _Encoding(1),
    "8UC1": _Encoding(1),
    "bgr8": _Encoding(3),
    "8UC3": _Encoding(3),
    "rgb8": _Encoding(3, cv2.COLOR_RGB2BGR),
    "bgra8": _Encoding(4, cv2.COLOR_BGRA2BGR),
    "8UC4": _Encoding(4, cv2.COLOR_BGRA2BGR),
    "rgba8": _Encoding(4, cv2.COLOR_RGBA2BGR),
    "mono16": _Encoding(1, None, np.uint16),
    "16UC1": _Encoding(1, None, np.uint16),
    "bgr16": _Encoding(3, None, np.uint16),
    "rgb16": _Encoding(3, cv2.COLOR_RGB2BGR, np.uint16),
    "uyvy": _Encoding(2, cv2.COLOR_YUV2BGR_UYVY),
    "yuv422": _Encoding(2, cv2.COLOR_YUV2BGR_UYVY),
    "yuyv": _Encoding(2, cv2.COLOR_YUV2BGR_YUY2),
    "yuv422_yuy2": _Encoding(2, cv2.COLOR_YUV2BGR_YUY2),
    **{f"bayer_{name}8": _Encoding(1, code) for name, code in _BAYER.items()},
    **{f"bayer_{name}16": _Encoding(1, code, np.uint16) for name, code in _BAYER.items()},
}

#: A plane of brightness with a plane of half-resolution colour pairs below it.
_SEMI_PLANAR = {"nv12": cv2.COLOR_YUV2BGR_NV12, "nv21": cv2.COLOR_YUV2BGR_NV21}


def image_to_pixels(msg: RawImage) -> Pixels:
    """A raw image -> uint8 [height, width] (grey) or [height, width, 3] (BGR).

    Read-only where it is a view of the message's memory. 16-bit images keep their upper 8 bits; YUV is taken as
    BT.601, as cameras send it.

    Raises:
        InputError: unknown encoding, impossible size, or too few bytes.
    """
    width, height, encoding = msg.width, msg.height, msg.encoding
    known = encoding.strip()
    _check_size(width, height, f"a {encoding} image")
    if known in _SEMI_PLANAR:
        return _semi_planar(msg, _SEMI_PLANAR[known])
    if known not in _ENCODINGS:
        raise InputError(
            f"image encoding {encoding!r} is not supported; expected one of "
            f"{', '.join(sorted([*_ENCODINGS, *_SEMI_PLANAR]))} (depth and float images cannot be segmented)"
        )
    layout = _ENCODINGS[known]
    if layout.channels == 2 and width % 2:  # two pixels share their colour; not every OpenCV minds
        raise InputError(f"a {width}x{height} {encoding} image cannot be converted; expected an even width")
    rows = _rows(msg, height, width * layout.channels * layout.depth().itemsize)
    if layout.depth is np.uint16:
        wide = np.ascontiguousarray(rows).view(">u2" if msg.is_bigendian else "<u2")
        pixels = (wide >> 8).astype(np.uint8)
    else:
        pixels = rows
    if layout.channels > 1:
        pixels = pixels.reshape(height, width, layout.channels)
    return pixels if layout.to_bgr is None else _convert(pixels, layout.to_bgr, msg)


def _rows(msg: RawImage, height: int, row_bytes: int) -> Pixels:
    """[height, row_bytes] view of the image's bytes without the padding at the end of each row."""
    if msg.step < row_bytes:
        raise InputError(
            f"a {msg.width}x{msg.height} {msg.encoding} image needs a step of at least {row_bytes} bytes, "
            f"got {msg.step}"
        )
    expected = msg.step * (height - 1) + row_bytes  # some drivers leave out the last row's padding
    if len(msg.data) < expected:
        raise InputError(
            f"a {msg.width}x{msg.height} {msg.encoding} image with step {msg.step} needs {expected} bytes, "
            f"got {len(msg.data)}: the message is truncated or its header wrong"
        )
    flat = np.frombuffer(msg.data, np.uint8)
    return np.lib.stride_tricks.as_strided(flat, (height, row_bytes), (msg.step, 1), writeable=False)


def _semi_planar(msg: RawImage, code: int) -> Pixels:
    """Drivers disagree whether `height` counts the colour plane; the number of bytes tells."""
    height = msg.height * 3 // 2 if len(msg.data) >= msg.step * (msg.height * 3 // 2) else msg.height
    if height % 3 or msg.width % 2:
        raise InputError(
            f"a {msg.encoding} image needs an even size and 3/2 rows of {msg.step} bytes for each row of the picture, "
            f"got {msg.width}x{msg.height} with {len(msg.data)} bytes"
        )
    return _convert(_rows(msg, height, msg.width), code, msg)


def _convert(pixels: NDArray[np.uint8], code: int, msg: RawImage) -> Pixels:
    try:
        return np.asarray(cv2.cvtColor(np.ascontiguousarray(pixels), code), dtype=np.uint8)
    except cv2.error as error:
        raise InputError(
            f"a {msg.width}x{msg.height} {msg.encoding} image cannot be converted: {error.err}; expected an even size"
        ) from None


def _check_size(width: int, height: int, what: str) -> None:
    if width < 1 or height < 1 or width * height > MAX_PIXELS:
        raise InputError(f"{what} of {width}x{height} px: expected 1 to {MAX_PIXELS} pixels")


def compressed_to_pixels(msg: CompressedPicture) -> Pixels:
    """A compressed image -> pixels, as `decode_picture`."""
    return decode_picture(_bytes_of(msg), msg.format)


def _bytes_of(msg: CompressedPicture) -> bytes:
    return msg.data if isinstance(msg.data, bytes) else msg.data.tobytes()


def decode_picture(data: bytes, claimed: str = "") -> Pixels:
    """JPEG or PNG -> uint8 [height, width] (grey) or [height, width, 3] (BGR).

    Args:
        data: the file's bytes, which tell what it is.
        claimed: the format by its name, for messages.

    Raises:
        InputError: neither JPEG nor PNG, truncated, damaged, or of an impossible size.
    """
    kind = _check_compressed(data, claimed)
    mask = decode_mask(data)
    if mask is not None:
        return mask
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise InputError(f"a {kind} image of {len(data)} bytes is damaged: {error.err}") from None
    if pixels is None:
        raise InputError(f"a {kind} image of {len(data)} bytes is damaged and cannot be decoded")
    if pixels.dtype == np.uint16:
        pixels = (pixels >> 8).astype(np.uint8)
    return np.asarray(pixels[..., :3] if pixels.ndim == 3 else pixels)


def _check_compressed(data: bytes, claimed: str) -> str:
    """OpenCV fills the lost rows of a truncated picture with grey and says nothing, so look at the bytes ourselves."""
    if data.startswith(b"\xff\xd8"):
        # Inside the compressed data 0xff is always followed by 0, so an end marker behind the last scan is the end.
        if data.rfind(b"\xff\xd9") < data.rfind(b"\xff\xda") or b"\xff\xda" not in data:
            raise InputError(f"a JPEG image of {len(data)} bytes has no end marker: it is truncated")
        _check_size(*_jpeg_size(data), "a JPEG image")
        return "JPEG"
    if data.startswith(b"\x89PNG\r\n\x1a\n"):
        if len(data) < 45 or data.rfind(b"IEND") < len(data) - 64:
            raise InputError(f"a PNG image of {len(data)} bytes has no end: it is truncated")
        width, height = struct.unpack(">II", data[16:24])
        _check_size(width, height, "a PNG image")
        return "PNG"
    raise InputError(
        f"expected a JPEG or PNG image, got {len(data)} bytes of format {claimed!r} that begin with {data[:4].hex(' ')}"
    )


def _jpeg_size(data: bytes) -> tuple[int, int]:
    """(width, height) from the frame header (marker SOF0 to SOF15)."""
    at = 2
    while at + 9 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF or 0xD0 <= marker <= 0xD8:  # fill bytes and markers without a length
            at += 1 if marker == 0xFF else 2
            continue
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack(">HH", data[at + 5 : at + 9])
            return width, height
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    raise InputError(f"a JPEG image of {len(data)} bytes has no frame header: it is damaged")


def message_to_pixels(msg: Any) -> Pixels:
    """A sensor_msgs/Image or CompressedImage -> pixels, whichever it is."""
    return image_to_pixels(msg) if hasattr(msg, "encoding") else compressed_to_pixels(msg)


def message_to_mask(msg: RawImage | CompressedPicture) -> Pixels:
    """A raw or compressed mask -> uint8 [height, width], 0 and 255; any non-zero value counts as foreground.

    Raises:
        InputError: not a single channel of 8 bits, or what `image_to_pixels` and `compressed_to_pixels` refuse.
    """
    if not hasattr(msg, "encoding"):
        data = _bytes_of(msg)
        _check_compressed(data, msg.format)
        mask = decode_mask(data)
        if mask is not None:  # as nearly all are: 0 and 255 already
            return mask
    pixels = message_to_pixels(msg)
    if pixels.ndim != 2:
        raise InputError(f"expected a mask of one channel (mono8), got {pixels.shape[2]} channels")
    return binary(pixels)


def binary(mask: Pixels) -> Pixels:
    """Any mask -> 0 and 255."""
    return np.asarray(cv2.threshold(mask, 0, 255, cv2.THRESH_BINARY)[1], dtype=np.uint8)  # 20 times as fast as numpy
