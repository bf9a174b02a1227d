# SPDX-License-Identifier: Apache-2.0
"""Rooms as a camera sees them, small, for tests of the segmentation."""

import numpy as np

from limbloc_ros.core.background import BackgroundModel

HEIGHT, WIDTH = 96, 128
COLOUR = np.array([90, 120, 150], dtype=np.float64)
PERSON = (slice(30, 70), slice(50, 70))


def room(rng, noise=1.0, light=1.0, shape=(HEIGHT, WIDTH)):
    """A wall with a smooth pattern under a light, with sensor noise."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    pattern = 1 + 0.2 * np.sin(x / 17) * np.cos(y / 23)
    image = COLOUR * pattern[..., None] * light + rng.normal(0, noise, (*shape, 3))
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def textured(rng):
    """A room with furniture: rectangles of many colours."""
    image = np.full((HEIGHT, WIDTH, 3), COLOUR)
    for _ in range(40):
        y, x = rng.integers(0, (HEIGHT - 10, WIDTH - 10))
        image[y : y + rng.integers(5, 30), x : x + rng.integers(5, 30)] = rng.integers(40, 200, 3)
    return image.astype(np.uint8)


def noisy(rng, picture):
    """What a camera makes of a scene."""
    return np.clip(picture + rng.normal(0, 1.0, picture.shape), 0, 255).astype(np.uint8)


def learned(rng, config=None, **kwargs):
    model = BackgroundModel(config)
    for _ in range(model.config.learning_frames):
        assert model.segment(room(rng, **kwargs)).learning
    return model


def iou(a, b):
    return np.count_nonzero(a & b) / np.count_nonzero(a | b)
