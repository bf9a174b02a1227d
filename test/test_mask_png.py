# SPDX-License-Identifier: Apache-2.0
"""Masks as PNGs of one bit, against OpenCV and so libpng, both ways."""

from __future__ import annotations

import zlib

import cv2
import numpy as np
import pytest

from limbloc_ros.core.mask_png import decode_mask, encode_mask

RNG = np.random.default_rng(3)


@pytest.mark.parametrize("shape", [(1, 1), (3, 7), (5, 8), (48, 65), (480, 640)])
def test_opencv_reads_what_we_write_and_we_what_opencv_writes(shape: tuple[int, int]) -> None:
    mask = (RNG.random(shape) < 0.3).astype(np.uint8) * np.uint8(255)
    ours = encode_mask(mask)
    np.testing.assert_array_equal(cv2.imdecode(np.frombuffer(ours, np.uint8), cv2.IMREAD_UNCHANGED), mask)
    np.testing.assert_array_equal(decode_mask(ours), mask)
    theirs = cv2.imencode(".png", mask, [cv2.IMWRITE_PNG_BILEVEL, 1])[1].tobytes()
    read = decode_mask(theirs)
    assert read is None or np.array_equal(read, mask)  # None: libpng told rows as differences
    plain = [cv2.IMWRITE_PNG_BILEVEL, 1, cv2.IMWRITE_PNG_COMPRESSION, 3]
    np.testing.assert_array_equal(decode_mask(cv2.imencode(".png", mask, plain)[1].tobytes()), mask)


def test_any_value_but_zero_is_foreground() -> None:
    np.testing.assert_array_equal(decode_mask(encode_mask(np.array([[0, 1, 7, 255]], np.uint8))), [[0, 255, 255, 255]])


def test_other_pngs_and_damaged_ones_are_left_to_libpng() -> None:
    mask = np.zeros((16, 16), np.uint8)
    mask[4:9, 3:12] = 255
    good = encode_mask(mask)
    assert decode_mask(cv2.imencode(".png", mask)[1].tobytes()) is None  # 8 bits per pixel
    assert decode_mask(b"\xff\xd8\xff") is None
    for n in range(len(good) - 12):
        assert decode_mask(good[:n]) is None, n
    for n in range(12, len(good) - 12):
        assert decode_mask(good[:n] + bytes([good[n] ^ 1]) + good[n + 1 :]) is None, n
    bomb = zlib.compress(bytes(10_000_000))
    head, tail = good[:33], good[-12:]
    data = b"IDAT" + bomb
    assert decode_mask(head + len(bomb).to_bytes(4, "big") + data + zlib.crc32(data).to_bytes(4, "big") + tail) is None
