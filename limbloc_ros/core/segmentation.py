# SPDX-License-Identifier: Apache-2.0
"""What comes out of the segmentation of one image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]


@dataclass(frozen=True)
class Segmentation:
    """The mask of one image and what the model thinks of it.

    Attributes:
        mask: uint8 [H, W] of the image's size, 0 = background, 255 = foreground; all 0 while learning.
        learning: the background is not known (yet, or again); the mask says nothing.
        frames_learned: images that made the background so far.
        foreground_fraction: part of the image that is foreground, 0 to 1.
        light_jump: most of the image differs from the background: the light was switched or the camera moved.
        moved: it shows another view than the background: the camera was moved, covered or exchanged. No mask until the
            view is back, or the background is captured anew.
        blind: the image shows nothing but one brightness; no mask.
        gain: [3] brightness of the light relative to the learned background, per channel.
    """

    mask: Bytes
    learning: bool
    frames_learned: int
    foreground_fraction: float
    light_jump: bool
    gain: tuple[float, ...]
    moved: bool = False
    blind: bool = False
