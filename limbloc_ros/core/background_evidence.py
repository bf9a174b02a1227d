# SPDX-License-Identifier: Apache-2.0
"""Image and background -> evidence: how far every pixel is from its background, measured where it matters.

Most of an image is background. Every fourth row is measured in full; of the others only what lies around foreground in
these, unless much has changed. What is missed is too small to be kept in a mask.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core._background_kernels import CHANGE_SCALE, COLOUR_SCALE, foreground_spans, measure
from limbloc_ros.core.config import BackgroundConfig

Bytes = NDArray[np.uint8]
Words = NDArray[np.uint16]
Floats = NDArray[np.float32]

LOOKED_ROWS = 4
"""Every so many rows are measured in full."""

RIM_PX = 24
"""So much around foreground in these is measured as well, px at 640x480."""

REFERENCE_PIXELS = 640 * 480
"""Sizes in the configuration are meant for images of this many pixels."""


def change_level(config: BackgroundConfig) -> int:
    """The level of `change` from which on a pixel is no background."""
    return min(round(config.threshold_sigmas * CHANGE_SCALE), 255)


def colour_level(config: BackgroundConfig) -> int:
    """The level of `colour` from which on a changed pixel is more than a shadow."""
    return min(round(config.shadow_sigmas * COLOUR_SCALE), 255)


def measure_evidence(
    planes: Bytes,
    level: Words,
    sharpness: Words,
    gain: Floats,
    config: BackgroundConfig,
    grey: bool,
    turn: int,
    most: float,
    change: Bytes,
    colour: Bytes,
) -> None:
    """Measure an image's distance to its background.

    Args:
        planes: [3, H, W] the image.
        level, sharpness: [3, H, W] the background in fixed point, as `_background_kernels.measure` takes it.
        gain: [3] brightness of the light now over that of the background.
        config: thresholds.
        grey: three equal channels: no colour tells a shadow.
        turn: rows turn % LOOKED_ROWS, + LOOKED_ROWS, ... are those measured in full.
        most: when more than this share of them changed, everything is measured.
        change: [H, W] out, distance to the background in sigmas * CHANGE_SCALE; 0 where nothing was measured.
        colour: [H, W] out, likewise the part of it that no shadow explains, in sigmas * COLOUR_SCALE.
    """
    height, width = change.shape
    shadows = (1.0, 1.0) if grey else (config.shadow_darkest, config.highlight_brightest)
    background = level, sharpness, gain, np.float32(shadows[0]), np.float32(shadows[1])
    change.fill(0)
    colour.fill(0)
    first = turn % LOOKED_ROWS
    spans = np.zeros((height, 2), dtype=np.int32)
    spans[first::LOOKED_ROWS, 1] = width
    measure(planes, *background, spans, change, colour)
    levels = change_level(config), colour_level(config)
    if np.count_nonzero(change[first::LOOKED_ROWS] >= levels[0]) > most * change.size / LOOKED_ROWS:
        spans[:] = 0, width
    else:
        rim = max(LOOKED_ROWS, round(RIM_PX * np.sqrt(change.size / REFERENCE_PIXELS)))
        foreground_spans(change, levels[0], colour, levels[1], first, LOOKED_ROWS, rim, spans)
    spans[first::LOOKED_ROWS] = 0  # these are measured already
    measure(planes, *background, spans, change, colour)
