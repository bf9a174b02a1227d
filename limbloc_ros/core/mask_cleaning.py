# SPDX-License-Identifier: Apache-2.0
"""Per-pixel evidence -> clean silhouette: hysteresis, morphology, and the outline's exact place.

* hysteresis: a weakly changed pixel counts when it hangs together with a strongly changed one;
* parts of a body in nearly the background's colour pass for shadow; they are told from it by where they lie;
* the outline is put where the change falls to half of its value just inside, which undoes the blur of lens and codec.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core import _mask_kernels as kernels
from limbloc_ros.core.background_evidence import REFERENCE_PIXELS, change_level, colour_level
from limbloc_ros.core.config import BackgroundConfig

Bytes = NDArray[np.uint8]

BODY_BORDER = 0.7
"""A part that looks like shadow is body when its border runs along foreground this much of the way along background."""

CLOTH_COLOUR = 0.6
"""... and when its colour differs from the background's by more than this part of `shadow_sigmas` on average."""

_OUTLINE = np.ones((5, 5), dtype=np.uint8)


def clean_mask(change: Bytes, colour: Bytes, config: BackgroundConfig) -> Bytes:
    """Make the silhouette from every pixel's distance to the background.

    Args:
        change: [H, W] distance to the background in sigmas * CHANGE_SCALE.
        colour: [H, W] the part of it that no shadow explains, in sigmas * COLOUR_SCALE.
        config: thresholds, and sizes in px at 640x480, which are scaled with the image.

    Returns:
        uint8 [H, W], 0 or 255.
    """
    height, width = change.shape
    threshold, weak_colour = change_level(config), colour_level(config)
    full = np.empty_like(change)
    kernels.mostly_at_least(change, threshold, colour, weak_colour, full)
    runs = kernels.strong_parts(full, colour, min(2 * weak_colour, 255))
    full.fill(0)
    if len(runs) == 0:
        return full
    # What follows looks at the foreground and a rim around it only.
    scale = np.sqrt(change.size / REFERENCE_PIXELS)
    pad = 8 + int(2 * config.close_px * scale)
    top, left = np.maximum(runs[:, : kernels.END].min(axis=0) - pad, 0)
    bottom, right = int(runs[-1, kernels.ROW]) + 1 + pad, int(runs[:, kernels.END].max()) + pad
    part = slice(top, min(bottom, height)), slice(left, min(right, width))
    change, colour = np.ascontiguousarray(change[part]), colour[part]
    changed, colour = cv2.medianBlur(change, 3), cv2.medianBlur(colour, 3)
    mask = np.zeros_like(change)
    kernels.paint(mask, runs - np.array([top, left, left], dtype=np.int32))
    mask = _morph(mask, cv2.MORPH_OPEN, config.open_px * scale)
    mask = _morph(mask, cv2.MORPH_CLOSE, config.close_px * scale)
    # Skin or cloth in nearly the background's colour leaves bites in the outline and holes. A cast shadow touches the
    # body only at the feet; the shadow seen between two legs is enclosed by them but has the floor's very colour.
    cloth = CLOTH_COLOUR * weak_colour
    hole = config.max_hole_px * scale**2
    kernels.add_body_parts(mask, changed, colour, threshold, cloth, BODY_BORDER)
    kernels.fill_holes(mask, changed, colour, threshold, cloth, hole)
    if config.edge_fraction > 0:
        mask = _trim_outline(mask, change, config.edge_fraction)
        mask = _morph(mask, cv2.MORPH_CLOSE, 1.0)
        kernels.fill_holes(mask, changed, colour, threshold, cloth, hole)
    kernels.erase_blobs(mask, config.min_blob_px * scale**2)
    full[part] = mask
    # The outermost pixels cannot be judged by their neighbours: they follow the next ones.
    full[0], full[-1] = full[1], full[-2]
    full[:, 0], full[:, -1] = full[:, 1], full[:, -2]
    return full


def _morph(mask: Bytes, operation: int, radius: float) -> Bytes:
    size = 2 * round(radius) + 1
    if size == 1:
        return mask
    window = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    return np.asarray(cv2.morphologyEx(mask, operation, window), dtype=np.uint8)


def _trim_outline(mask: Bytes, change: Bytes, fraction: float) -> Bytes:
    """Drop outline pixels whose change is below `fraction` of the largest one within two pixels.

    Blur spreads a person by a pixel or two; the true outline is where the change has half its inner value. A wider
    window would also drop the halo that video codecs draw, but with it faint limbs beside something of high contrast.
    """
    inner = cv2.dilate(cv2.bitwise_and(change, mask), _OUTLINE)
    core = cv2.erode(mask, _OUTLINE)
    enough = cv2.compare(change, cv2.convertScaleAbs(inner, alpha=fraction), cv2.CMP_GE)
    return np.asarray(cv2.bitwise_and(mask, cv2.bitwise_or(core, enough)), dtype=np.uint8)
