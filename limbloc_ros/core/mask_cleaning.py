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

from limbloc_ros.core._background_kernels import CHANGE_SCALE, COLOUR_SCALE, add_body_parts, grow_from_seeds
from limbloc_ros.core.config import BackgroundConfig

Bytes = NDArray[np.uint8]

REFERENCE_PIXELS = 640 * 480
"""Sizes in the configuration are meant for images of this many pixels."""

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
    threshold = round(config.threshold_sigmas * CHANGE_SCALE)
    changed = cv2.medianBlur(change, 3)
    scale = np.sqrt(change.size / REFERENCE_PIXELS)
    blob, hole = config.min_blob_px * scale**2, config.max_hole_px * scale**2
    colour = cv2.medianBlur(colour, 3)
    weak_colour = round(config.shadow_sigmas * COLOUR_SCALE)
    weak = cv2.bitwise_and(_at_least(changed, threshold), _at_least(colour, weak_colour))
    strong = cv2.bitwise_and(weak, _at_least(colour, min(2 * weak_colour, 255)))
    weak[[0, -1], :] = 0
    weak[:, [0, -1]] = 0
    full: Bytes = grow_from_seeds(weak, strong)
    x, y, w, h = cv2.boundingRect(full)
    if w == 0:
        return full
    pad = 8 + int(2 * config.close_px * scale)
    rows = slice(max(y - pad, 0), y + h + pad)
    columns = slice(max(x - pad, 0), x + w + pad)
    mask: Bytes = np.ascontiguousarray(full[rows, columns])
    change, changed = np.ascontiguousarray(change[rows, columns]), changed[rows, columns]
    colour = colour[rows, columns]
    mask = _morph(mask, cv2.MORPH_OPEN, config.open_px * scale)
    mask = _morph(mask, cv2.MORPH_CLOSE, config.close_px * scale)
    # Skin or cloth in nearly the background's colour leaves bites in the outline and holes. A cast shadow touches the
    # body only at the feet; the shadow seen between two legs is enclosed by them but has the floor's very colour.
    add_body_parts(mask, changed, colour, threshold, CLOTH_COLOUR * weak_colour, BODY_BORDER)
    _tidy(mask, changed, colour, threshold, weak_colour, blob, hole)
    if config.edge_fraction > 0:
        mask = _trim_outline(mask, change, config.edge_fraction)
        mask = _morph(mask, cv2.MORPH_CLOSE, 1.0)
        _tidy(mask, changed, colour, threshold, weak_colour, blob, hole)
    full[rows, columns] = mask
    # The outermost pixels cannot be judged by their neighbours: they follow the next ones.
    full[0], full[-1] = full[1], full[-2]
    full[:, 0], full[:, -1] = full[:, 1], full[:, -2]
    return full


def _at_least(levels: Bytes, threshold: int) -> Bytes:
    """255 where `levels` >= threshold."""
    return np.asarray(cv2.threshold(levels, max(threshold - 1, 0), 255, cv2.THRESH_BINARY)[1], dtype=np.uint8)


def _morph(mask: Bytes, operation: int, radius: float) -> Bytes:
    size = 2 * round(radius) + 1
    if size == 1:
        return mask
    window = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    return np.asarray(cv2.morphologyEx(mask, operation, window), dtype=np.uint8)


def _tidy(
    mask: Bytes, changed: Bytes, colour: Bytes, threshold: int, weak_colour: int, blob: float, hole: float
) -> None:
    """In place: erase blobs of less than `blob` px, fill holes of less than `hole` px or that are no real holes.

    A true hole, seen between arm and trunk, shows the background itself. A hole that is mostly changed and merely has
    nearly the background's colour under less light is cloth.
    """
    contours, hierarchy = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    if hierarchy is None:
        return
    erase, fill = [], []
    for contour, links in zip(contours, hierarchy[0], strict=True):
        # Pick's theorem: the polygon through the pixel centres misses half of its own pixels, less one. A hole's
        # outline runs on the foreground around it.
        area, rim = cv2.contourArea(contour), len(contour) / 2
        if links[3] < 0:
            if area + rim + 1 < blob:
                erase.append(contour)
        elif area - rim + 1 < hole or _looks_like_cloth(contour, mask, changed, colour, threshold, weak_colour):
            fill.append(contour)
    if fill:
        cv2.drawContours(mask, fill, -1, 255, cv2.FILLED)
    if erase:
        cv2.drawContours(mask, erase, -1, 0, cv2.FILLED)


def _looks_like_cloth(
    contour: NDArray[np.int32], mask: Bytes, changed: Bytes, colour: Bytes, threshold: int, weak_colour: int
) -> bool:
    """Whether more than half of a hole's pixels are changed, and not by a shadow alone."""
    x, y, w, h = cv2.boundingRect(contour)
    inside = np.zeros((h, w), dtype=np.uint8)
    cv2.drawContours(inside, [contour - (x, y)], -1, 255, cv2.FILLED)
    hole = (inside > 0) & (mask[y : y + h, x : x + w] == 0)
    if 2 * np.count_nonzero(hole & (changed[y : y + h, x : x + w] >= threshold)) <= np.count_nonzero(hole):
        return False
    return bool(colour[y : y + h, x : x + w][hole].mean() > CLOTH_COLOUR * weak_colour)


def _trim_outline(mask: Bytes, change: Bytes, fraction: float) -> Bytes:
    """Drop outline pixels whose change is below `fraction` of the largest one within two pixels.

    Blur spreads a person by a pixel or two; the true outline is where the change has half its inner value. A wider
    window would also drop the halo that video codecs draw, but with it faint limbs beside something of high contrast.
    """
    inner = cv2.dilate(cv2.bitwise_and(change, mask), _OUTLINE)
    core = cv2.erode(mask, _OUTLINE)
    enough = cv2.compare(change, cv2.convertScaleAbs(inner, alpha=fraction), cv2.CMP_GE)
    return np.asarray(cv2.bitwise_and(mask, cv2.bitwise_or(core, enough)), dtype=np.uint8)
