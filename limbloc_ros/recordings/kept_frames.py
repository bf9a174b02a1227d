# SPDX-License-Identifier: Apache-2.0
"""A few frames of a run with their masks and images, kept so that the report can be made without the recording."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core.errors import InputError
from limbloc_ros.core.images import decode_picture
from limbloc_ros.recordings.cases import pack_mask, unpack_mask
from limbloc_ros.recordings.npz_file import read_npz
from limbloc_ros.recordings.results import result_file

Pixels = NDArray[np.uint8]

FILE = "kept_frames.npz"

#: At most so many frames are held; when more have come, every second one goes.
CAPACITY = 24


class KeptFrames:
    """Frames spread evenly over a recording whose length nobody knows beforehand.

    Give it every frame in order; between CAPACITY / 2 and CAPACITY of them are held at any time.
    """

    def __init__(self) -> None:
        self._stride = 1
        self._masks: dict[int, dict[str, tuple[Pixels, int]]] = {}
        self._images: dict[int, dict[str, Pixels]] = {}

    @property
    def numbers(self) -> tuple[int, ...]:
        """Which frames are held, in order."""
        return tuple(self._masks)

    def add(self, number: int, masks: dict[str, Pixels], images: dict[str, Pixels]) -> None:
        """Offer frame number `number` with its masks and, where there are, images (grey or bgr) by camera name."""
        if number % self._stride or not masks:
            return
        self._masks[number] = {name: (pack_mask(mask), mask.shape[1]) for name, mask in masks.items()}
        self._images[number] = {name: _jpeg(image) for name, image in images.items()}
        if len(self._masks) > CAPACITY:
            self._stride *= 2
            for old in [n for n in self._masks if n % self._stride]:
                del self._masks[old], self._images[old]

    def masks(self, number: int) -> dict[str, Pixels]:
        """Masks of a held frame by camera name, 0 and 255."""
        return {name: unpack_mask(packed, width) for name, (packed, width) in self._masks[number].items()}

    def images(self, number: int) -> dict[str, Pixels]:
        """Images of a held frame by camera name, bgr; its masks where the recording had no images."""
        if not self._images[number]:
            return self.masks(number)
        return {
            name: np.asarray(cv2.imdecode(jpeg, cv2.IMREAD_COLOR), dtype=np.uint8)
            for name, jpeg in self._images[number].items()
        }

    def save(self, folder: Path) -> None:
        """Write the frames to `folder`; raises OutputError when that fails."""
        arrays: dict[str, Any] = {"numbers": np.array(self.numbers, dtype=np.int64)}
        for number, masks in self._masks.items():
            for name, (packed, width) in masks.items():
                arrays[f"mask {number} {width} {name}"] = packed
            for name, jpeg in self._images[number].items():
                arrays[f"image {number} 0 {name}"] = jpeg
        with result_file(folder / FILE) as file:
            np.savez_compressed(file, **arrays)

    @staticmethod
    def load(folder: Path) -> KeptFrames:
        """Read what `save` wrote; empty when the run kept none.

        Raises:
            InputError: the file is damaged.
        """
        kept = KeptFrames()
        if not (folder / FILE).is_file():
            return kept
        arrays = read_npz(folder / FILE)
        if "numbers" not in arrays:
            raise InputError(f"{folder / FILE} is not a file of kept frames; run `process` again")
        numbers = arrays.pop("numbers")
        if numbers.dtype.kind != "i" or numbers.ndim != 1:
            raise InputError(f"{folder / FILE} is damaged (numbers of {numbers.dtype}); run `process` again")
        for number in numbers:
            kept._masks[int(number)], kept._images[int(number)] = {}, {}
        try:
            for key, array in arrays.items():
                kind, number, width, name = key.split(" ", 3)
                if kind == "mask" and array.dtype == np.uint8 and array.shape[1] == -(-int(width) // 8):
                    kept._masks[int(number)][name] = (array, int(width))
                elif kind == "image" and array.dtype == np.uint8:
                    decode_picture(array.tobytes(), "jpeg")  # says so when it is damaged
                    kept._images[int(number)][name] = array
                else:
                    raise ValueError(key)
        except (KeyError, IndexError, ValueError, InputError) as error:
            raise InputError(f"{folder / FILE} is damaged ({error}); run `process` again") from None
        return kept


def _jpeg(image: Pixels) -> Pixels:
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 90])
    return np.asarray(data, dtype=np.uint8)
