# SPDX-License-Identifier: Apache-2.0
"""Per-pixel evidence -> clean silhouette: hysteresis, morphology, and the outline's exact place.

* hysteresis: a weakly changed pixel counts when it hangs together with a strongly changed one;
* parts of a body in nearly the background's colour pass for shadow; they are told from it by where they lie;
* the outline is put where the change falls to half of its value just inside, which undoes the blur of lens and codec.
"""

from __future__ import annotations

import functools

import cv2
import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core import _mask_kernels as kernels
from limbloc_ros.core._bit_kernels import Bits
from limbloc_ros.core.background_evidence import change_level, colour_level
from limbloc_ros.core.config import BackgroundConfig

Bytes = NDArray[np.uint8]

BODY_BORDER = 0.7
"""A part that looks like shadow is body when its border runs along foreground this much of the way along background."""

CLOTH_COLOUR = 0.6
"""... and when its colour differs from the background's by more than this part of `shadow_sigmas` on average."""

BODY_REACH = 8
"""... and when it reaches out of the box around the foreground by less than this, px, and what may be closed there."""


def clean_mask(change: Bytes, colour: Bytes, config: BackgroundConfig, scale: float) -> Bits:
    """Make the silhouette from every pixel's distance to the background.

    Args:
        change: [H, W] distance to the background in sigmas * CHANGE_SCALE.
        colour: [H, W] the part of it that no shadow explains, in sigmas * COLOUR_SCALE.
        config: thresholds, and sizes in px at 640x480.
        scale: px of this image per px at 640x480.

    Returns:
        the mask, one bit per pixel (`_bit_kernels`).
    """
    weak_colour = colour_level(config)
    return kernels.clean(  # type: ignore[no-any-return]
        change,
        colour,
        change_level(config),
        weak_colour,
        min(2 * weak_colour, 255),
        BODY_REACH + int(2 * config.close_px * scale),
        disc(config.open_px * scale),
        disc(config.close_px * scale),
        CLOTH_COLOUR * weak_colour,
        BODY_BORDER,
        config.max_hole_px * scale**2,
        round(config.edge_fraction * kernels.FRACTION),
        config.min_blob_px * scale**2,
    )


@functools.cache
def disc(radius: float) -> NDArray[np.int32]:
    """A disc, as `_bit_kernels.dilate` takes it: how far it reaches to both sides in each of its rows."""
    size = 2 * round(radius) + 1
    window = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    return np.asarray((window.sum(axis=1, dtype=np.int32) - 1) // 2)
