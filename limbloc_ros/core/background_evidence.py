# SPDX-License-Identifier: Apache-2.0
"""Image and background -> evidence: how far every pixel is from its background, measured where it matters.

Most of an image is background. Every fourth row is looked at; what lies around foreground in these is measured, or
everything when much has changed. What is missed is too small to be kept in a mask.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core._background_kernels import (
    CHANGE_SCALE,
    COLOUR_SCALE,
    light_gain,
    look,
    measure_around,
)
from limbloc_ros.core._bit_kernels import Bits, no_pixels
from limbloc_ros.core.config import BackgroundConfig

Bytes = NDArray[np.uint8]
Words = NDArray[np.uint16]
Floats = NDArray[np.float32]

LOOKED_ROWS = 4
"""Every so many rows are looked at."""

RIM_PX = 12
"""So much around foreground in these is measured as well, px at 640x480."""

REFERENCE_PIXELS = 640 * 480
"""Sizes in the configuration are meant for images of this many pixels."""


def change_level(config: BackgroundConfig) -> int:
    """The level of `change` from which on a pixel is no background."""
    return min(round(config.threshold_sigmas * CHANGE_SCALE), 255)


def colour_level(config: BackgroundConfig) -> int:
    """The level of `colour` from which on a changed pixel is more than a shadow."""
    return min(round(config.shadow_sigmas * COLOUR_SCALE), 255)


class Background(NamedTuple):
    """What an image is held against, as the kernels take it.

    Attributes:
        level, sharpness: [3, H, W] mean and one over sigma in fixed point, as `_background_kernels.measure` takes
            them.
        gain: [3] brightness of the light now over that of the background.
        darkest, brightest: shadows and highlights scale the background by a factor in this range.
    """

    level: Words
    sharpness: Words
    gain: Floats
    darkest: np.float32
    brightest: np.float32


class Look(NamedTuple):
    """The rows of an image that tell where something is.

    Attributes:
        first: rows first, first + LOOKED_ROWS, ... are these.
        changed: [R, N] bits (`_bit_kernels`), set where a pixel is not the background's.
        share: part of their pixels that are not, 0 to 1.
    """

    first: int
    changed: Bits
    share: float


class Evidence(NamedTuple):
    """How far the pixels are from their background where somebody may be; elsewhere everything is background.

    Attributes:
        top, left: where in the image the arrays begin; `left` is a multiple of 64.
        change: [h, w] distance to the background in sigmas * CHANGE_SCALE; 0 where nothing was measured.
        colour: [h, w] likewise the part of it that no shadow explains, in sigmas * COLOUR_SCALE.
    """

    top: int
    left: int
    change: Bytes
    colour: Bytes

    @property
    def box(self) -> tuple[slice, slice]:
        """Where in the image the arrays lie."""
        height, width = self.change.shape
        return slice(self.top, self.top + height), slice(self.left, self.left + width)

    def changed(self, shape: tuple[int, int], level: int) -> Bytes:
        """uint8 [H, W] of the whole image, 255 where the change has this level."""
        out = np.zeros(shape, dtype=np.uint8)
        out[self.box] = cv2.compare(self.change, level, cv2.CMP_GE) if self.change.size else 0
        return out


def at_working_size(image: Bytes, most_pixels: int) -> Bytes:
    """An image [H, W, 3], halved until it has no more pixels than this, as the kernels take it."""
    height, width = image.shape[:2]
    factor = 1
    while (height // factor) * (width // factor) > most_pixels:
        factor *= 2
    if factor > 1:
        image = cv2.resize(image, (width // factor, height // factor), interpolation=cv2.INTER_AREA)
    image = np.ascontiguousarray(image).view()
    image.flags.writeable = False  # as a message's pixels are: the kernels are compiled for one of both only
    return image


def planes_of(image: Bytes) -> Bytes:
    """An image [H, W, 3] as [3, H, W]."""
    return np.stack(cv2.split(image))


def scale_of(pixels: int) -> float:
    """Px of an image of so many pixels per px at 640x480."""
    return math.sqrt(pixels / REFERENCE_PIXELS)


def light_stride(pixels: int) -> int:
    """Every so many rows and columns are enough to tell the light of an image: some 1500 pixels."""
    return max(1, int(math.sqrt(pixels / 1500)))


def light_of(image: Bytes, samples: Words, busy: Bits, last: Floats) -> Floats:
    """The gain of the light of an image [H, W, 3]; arguments as `light_gain` takes them."""
    return np.asarray(light_gain(image, samples, busy, last, light_stride(image.shape[0] * image.shape[1])))


def light_change(gain: Floats, last: Floats) -> float:
    """By how much the logarithm of the light's gain has changed, in the channel in which it has most."""
    # Plain numbers: NumPy takes 20 times as long for three of them.
    return max(abs(math.log(new / old)) for new, old in zip(gain.tolist(), last.tolist(), strict=True))


def look_at(image: Bytes, background: Background, config: BackgroundConfig, turn: int) -> Look:
    """Look at some rows of an image [H, W, 3]: turn % LOOKED_ROWS, + LOOKED_ROWS, ..."""
    first = turn % LOOKED_ROWS
    height, width = image.shape[:2]
    changed = no_pixels((height - first + LOOKED_ROWS - 1) // LOOKED_ROWS, width)
    far = np.float32(change_level(config) / CHANGE_SCALE)
    number = look(image, background.level, background.sharpness, background.gain, first, LOOKED_ROWS, far, changed)
    return Look(first, changed, number / (len(changed) * width))


def measure_evidence(
    image: Bytes, looked: Look, background: Background, config: BackgroundConfig, everywhere: bool
) -> Evidence:
    """Measure an image's distance to its background.

    Args:
        image: [H, W, 3].
        looked: what `look_at` found.
        background: the background.
        config: thresholds.
        everywhere: measure all of it, not only around what was found.
    """
    height, width = image.shape[:2]
    scale = scale_of(height * width)
    rim = max(LOOKED_ROWS, round(RIM_PX * scale))
    pad = 3 + round(config.close_px * scale)  # a closed crack needs some room around it
    around = looked.changed, colour_level(config), looked.first, LOOKED_ROWS, rim, pad, everywhere
    return Evidence(*measure_around(image, *background, *around))
