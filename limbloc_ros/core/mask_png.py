# SPDX-License-Identifier: Apache-2.0
"""Masks as PNG files of one bit per pixel, in a fifth of the time that libpng takes to write and a third to read them.

Every camera's mask crosses this twice a frame, and libpng packs bits one by one. The files are ordinary PNGs (ISO/IEC
15948) that every program reads; what is read here is only this one kind, whoever wrote it.
"""

from __future__ import annotations

import struct
import zlib

import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]

SIGNATURE = b"\x89PNG\r\n\x1a\n"

#: Depth 1, grey; compression, filter and interlace methods 0.
_KIND = bytes((1, 0, 0, 0, 0))

#: zlib's; 4 and more take twice the time for a fifth less.
_LEVEL = 2


def encode_mask(mask: Bytes) -> bytes:
    """uint8 [height, width], non-zero = foreground -> a PNG of about 1 KB for a person."""
    height, width = mask.shape
    rows = np.zeros((height, 1 + (width + 7) // 8), dtype=np.uint8)  # each begins with its filter: 0, none
    rows[:, 1:] = np.packbits(mask, axis=1)
    head = struct.pack(">II", width, height) + _KIND
    return SIGNATURE + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in ((b"IHDR", head), (b"IDAT", zlib.compress(rows.data, _LEVEL)), (b"IEND", b""))
    )


def decode_mask(data: bytes) -> Bytes | None:
    """The inverse: 0 and 255; None for any other kind of PNG, and for a damaged one."""
    if data[:8] != SIGNATURE or data[12:16] != b"IHDR" or data[24:29] != _KIND:
        return None
    width, height = struct.unpack(">II", data[16:24])
    shape = height, 1 + (width + 7) // 8
    packed, at = [], 8
    while at + 12 <= len(data):
        length, kind = struct.unpack(">I4s", data[at : at + 8])
        end = at + 8 + length
        if data[end : end + 4] != struct.pack(">I", zlib.crc32(data[at + 4 : end])):
            return None
        if kind == b"IDAT":
            packed.append(data[at + 8 : end])
        elif kind not in (b"IHDR", b"IEND"):
            return None  # a transparent colour, say
        at = end + 4
    try:
        unpacked = zlib.decompressobj().decompress(b"".join(packed), shape[0] * shape[1] + 1)
    except zlib.error:
        return None
    if len(unpacked) != shape[0] * shape[1]:
        return None
    rows = np.frombuffer(unpacked, dtype=np.uint8).reshape(shape)
    if rows[:, 0].any():  # rows that are told as differences
        return None
    mask = np.unpackbits(rows[:, 1:], axis=1, count=width)
    return np.negative(mask, out=mask)  # of 1 that is 255
