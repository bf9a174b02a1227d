# SPDX-License-Identifier: Apache-2.0
"""The light is switched while somebody is in the room: what does the background look like now?

Learning it anew would take the person for background, and the place where he stood for a person ever after. But the
last mask says where he was; everywhere else the new image is the new background. Behind him the old background is
brought to the new light by a gain that varies smoothly over the image.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float32]

#: The light is compared in cells of so many pixels.
CELL_PX = 8
#: A cell whose gain (its logarithm) differs by more from the smooth course around it tells nothing of the light.
ODD_CELL = 0.25
#: Edges of the background are compared where they have this contrast, grey levels, if there are so many such pixels.
EDGE_LEVELS, FEWEST_EDGES = 4.0, 150
#: With edges that correlate this well it is the same view; with less than the second figure it is another one.
SAME_VIEW, OTHER_VIEW = 0.5, 0.25
#: Who was there has moved since, by up to this part of the image's height.
REACH = 16
#: Without edges, so many of the cells must follow the smooth gain.
SMOOTH_SHARE = 0.6

#: An image says nothing when its standard deviation (grey levels) is below this, and below this share of the
#: background's; without a background, when nothing in it is brighter, or darker, than this.
FLAT_LEVELS, FLAT_SHARE = 6.0, 0.25
BLACK, WHITE = 12, 250
_SAMPLING = 4


@dataclass(frozen=True)
class Relit:
    """A background under new light.

    Attributes:
        mean: float32 [3, H, W] grey levels: the image itself where nobody is, the old background under the new light
            elsewhere.
        agreement: correlation of the background's edges with the image's, -1 to 1; NaN when it has too few.
        follows: bool [H, W] where the brightness changed as smoothly over the image as light does.
        smooth: share of the image whose brightness changed as smoothly over the image as light does.
    """

    mean: Floats
    agreement: float
    follows: NDArray[np.bool_]
    smooth: float

    @property
    def same_view(self) -> bool:
        """Only the light has changed."""
        return self.smooth > SMOOTH_SHARE if np.isnan(self.agreement) else self.agreement > SAME_VIEW

    @property
    def other_view(self) -> bool:
        """The camera was moved, covered, or is another one."""
        return self.agreement < OTHER_VIEW


def relight(planes: Bytes, mean: Floats, changed: Bytes, cautious: bool = False) -> Relit:
    """The background under the light of an image.

    Args:
        planes: uint8 [3, H, W] the image under the new light.
        mean: float32 [3, H, W] the background under the old one, grey levels.
        changed: uint8 [H, W] non-zero where something else than background was a moment ago: a person, a shadow.
        cautious: take the image only where its brightness changed as smoothly as light does; somebody may have come.
    """
    reach = 2 * (len(changed) // REACH) + 1
    there = cv2.morphologyEx(changed, cv2.MORPH_OPEN, np.ones((3, 3), dtype=np.uint8))  # not single noisy pixels
    free = cv2.dilate(there, np.ones((reach, reach), dtype=np.uint8)) == 0
    field, good, smooth = _gain_field(planes, mean, free)
    relit = np.minimum(mean * field, np.float32(255))
    agreement = _agreement(planes, relit, free)
    if cautious:
        free &= good
    return Relit(np.where(free, planes.astype(np.float32), relit).astype(np.float32), agreement, good, smooth)


def shows_nothing(image: Bytes, mean: Floats | None) -> bool:
    """Whether an image [H, W, 3] is black, white or of one grey: a covered lens, a dead sensor.

    Args:
        image: uint8 [H, W, 3].
        mean: float32 [3, H, W] the background, which may be as plain; None while there is none.
    """
    image = image[::_SAMPLING, ::_SAMPLING]
    spread = float(image.std(axis=(0, 1)).max())
    if spread >= FLAT_LEVELS:
        return False
    if mean is None:
        return bool(image.max() <= BLACK or image.min() >= WHITE)
    return spread < FLAT_SHARE * float(mean[:, ::_SAMPLING, ::_SAMPLING].std(axis=(1, 2)).max())


def _gain_field(planes: Bytes, mean: Floats, free: NDArray[np.bool_]) -> tuple[Floats, NDArray[np.bool_], float]:
    """A smooth gain [3, H, W], where the image follows it [H, W], and the share of cells that do."""
    height, width = free.shape
    rows, columns = max(height // CELL_PX, 4), max(width // CELL_PX, 4)
    usable = _shrink(free.astype(np.float32), rows, columns) > 0.99
    logs = np.empty((3, rows, columns))
    for c in range(3):
        new, old = (_shrink(a.astype(np.float32), rows, columns) for a in (planes[c], mean[c]))
        usable &= (new > 3) & (new < 245) & (old > 3) & (old < 245)
        logs[c] = np.log((new + 1) / (old + 1))
    y, x = (a.ravel() for a in np.mgrid[-1 : 1 : rows * 1j, -1 : 1 : columns * 1j])
    terms = np.stack([x**i * y**j for i in range(4) for j in range(4 - i)], axis=1)
    weight = usable.astype(np.float64).ravel()
    if np.count_nonzero(weight) < 4 * terms.shape[1]:
        return np.ones_like(mean), np.zeros_like(free), 0.0
    course = np.empty_like(logs)
    for _ in range(8):  # least squares, ever again without what lies far off
        root = np.sqrt(weight)[:, None]
        for c in range(3):
            found = np.linalg.lstsq(terms * root, logs[c].reshape(-1, 1) * root, rcond=None)[0]
            course[c] = (terms @ found).reshape(rows, columns)
        off = np.abs(logs - course).max(axis=0)
        weight = np.where(usable, 1.0 / (1.0 + (off / (0.5 * ODD_CELL)) ** 4), 0.0).ravel()
    good = usable & (off < ODD_CELL)
    amount = cv2.GaussianBlur(good.astype(np.float64), (0, 0), 1.5)
    field = np.empty_like(mean)
    for c in range(3):
        rest = cv2.GaussianBlur(np.where(good, logs[c] - course[c], 0.0), (0, 0), 1.5) / (amount + 0.1)
        field[c] = cv2.resize(np.exp(course[c] + rest).astype(np.float32), (width, height))
    follows = cv2.resize(cv2.erode(good.astype(np.uint8), np.ones((3, 3), np.uint8)), (width, height)) > 0
    return field, follows, float(np.count_nonzero(good)) / max(int(np.count_nonzero(usable)), 1)


def _agreement(planes: Bytes, relit: Floats, free: NDArray[np.bool_]) -> float:
    """How well the background's edges are still there."""
    new, old = (cv2.GaussianBlur(a.mean(axis=0, dtype=np.float32), (0, 0), 1.0) for a in (planes, relit))
    fine = [a - cv2.GaussianBlur(a, (0, 0), 4.0) for a in (new, old)]
    edges = free & (np.abs(fine[1]) > EDGE_LEVELS)
    if np.count_nonzero(edges) < FEWEST_EDGES:
        return float("nan")
    a, b = (f[edges].astype(np.float64) for f in fine)
    return float(a @ b / max(float(np.sqrt((a @ a) * (b @ b))), 1e-9))


def _shrink(plane: Floats, rows: int, columns: int) -> Floats:
    return np.asarray(cv2.resize(plane, (columns, rows), interpolation=cv2.INTER_AREA))
