# SPDX-License-Identifier: Apache-2.0
"""The background of a recording that shows a person all the time, guessed from many of its frames."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core._background_estimate_kernels import densest_mean
from limbloc_ros.core._background_kernels import LEVEL_SCALE, light_gain, sampled
from limbloc_ros.core._bit_kernels import no_pixels
from limbloc_ros.core.background_evidence import light_stride
from limbloc_ros.core.errors import InputError

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float32]

_GRADIENT_BINS = (0.0, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, float("inf"))


@dataclass(frozen=True)
class BackgroundEstimate:
    """A background guessed from a recording that shows a person all the time.

    Attributes:
        mean: float32 [H, W, 3], grey levels.
        sigma: float32 [H, W, 3] noise, grey levels; 0 where the video repeats itself exactly.
    """

    mean: Floats
    sigma: Floats


def noise_variance(planes: Bytes, mean: Floats, gain: Floats) -> Floats:
    """Each pixel's noise from how much pixels of equal background contrast differ from the background in one image.

    At edges of the background a tremble of the camera or the codec makes more noise than on plain walls. The median is
    not disturbed by a person, who covers less than half of each class.

    Args:
        planes: uint8 [3, H, W] the image.
        mean: float32 [3, H, W] the background, grey levels.
        gain: [3] brightness of the image's light relative to the background's.

    Returns:
        float32 [3, H, W] variance, grey levels squared.
    """
    variance = np.zeros_like(mean)
    grey = mean.mean(axis=0)
    slope = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0, scale=0.125), cv2.Sobel(grey, cv2.CV_32F, 0, 1, scale=0.125))
    slope = cv2.dilate(slope, np.ones((3, 3), dtype=np.uint8))
    off = np.abs(planes.astype(np.float32) - mean * gain[:, None, None])
    for low, high in itertools.pairwise(_GRADIENT_BINS):
        here = (slope >= low) & (slope < high)
        where = here
        if np.count_nonzero(where) < 100:
            where = slope >= low if low > 0 else np.ones_like(here)
        for c in range(3):
            sigma = 1.4826 * float(np.median(off[c][where])) if where.any() else 0.0
            variance[c][here] = np.float32(sigma * sigma)
    return variance


def estimate_background(frames: Iterable[Bytes], share: float = 0.4) -> BackgroundEstimate:
    """Guess the empty room from frames in which a person is always somewhere.

    Each pixel takes the mean of the tightest brightness interval that holds `share` of its samples (a mode), after
    the frames were brought to one light.

    Limitation: a person (or a part: feet, a torso that hardly moves) who covers a pixel for more than about half of
    the recording becomes background there, and is missing from every mask: use frames spread over the whole
    recording, 15 to 60 of them, and prefer a picture of the empty room when there is one.

    Args:
        frames: uint8 [H, W, 3] or [H, W] of one camera.
        share: part of the samples that the interval must hold, 0 to 1.

    Raises:
        InputError: fewer than three frames, or unequal sizes.
    """
    stack = [cv2.cvtColor(f, cv2.COLOR_GRAY2BGR) if f.ndim == 2 else f for f in frames]
    if len(stack) < 3:
        raise InputError(f"expected at least 3 frames to guess a background from, got {len(stack)}; use more frames")
    shapes = {f.shape for f in stack}
    if len(shapes) > 1:
        raise InputError(f"expected frames of one size, got {sorted(shapes)}; each camera needs its own background")
    samples = np.stack(stack)
    spread = samples[np.linspace(0, len(samples) - 1, min(len(samples), 9)).round().astype(int)]
    middle = np.ascontiguousarray(fixed_levels(np.median(spread, axis=0)).transpose(2, 0, 1))
    nobody = no_pixels(*middle.shape[1:])
    ones = np.ones(3, dtype=np.float32)
    levels = sampled(middle, 4)
    gains = np.stack([light_gain(f, levels, nobody, ones, 4) for f in samples])
    mean, sigma = densest_mean(samples, gains, share)
    return BackgroundEstimate(mean, sigma)


def fixed_levels(grey_levels: NDArray[np.floating[Any]]) -> NDArray[np.uint16]:
    """Means in the kernels' fixed point."""
    return np.asarray(np.rint(grey_levels * LEVEL_SCALE), dtype=np.uint16)


def light_over(image: Bytes, mean: Floats) -> Floats:
    """The gain [3] of the light of an image [H, W, 3] of the empty room over that of a mean [3, H, W], grey levels."""
    stride = light_stride(mean[0].size)
    some = slice(stride // 2, None, stride)  # only these need be brought to fixed point
    pixels = np.ascontiguousarray(image[some, some])
    ones = np.ones(3, dtype=np.float32)
    return np.asarray(light_gain(pixels, fixed_levels(mean[:, some, some]), no_pixels(*pixels.shape[:2]), ones, 1))
