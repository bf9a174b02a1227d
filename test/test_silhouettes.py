# SPDX-License-Identifier: Apache-2.0
"""Signed distances of masks are exact to the last bit."""

import cv2
import numpy as np

from limbloc_ros.core.silhouettes import signed_distance_px


def exact_distance(mask):
    """The definition: float32 of the root of the smallest squared pixel distance, minus half a pixel."""
    inside = mask != 0
    points = np.argwhere(np.ones_like(inside))
    result = np.zeros(mask.shape, np.float32)
    for there in (True, False):
        others = np.argwhere(inside != there)
        for y, x in points[(inside == there).ravel()]:
            squared = ((others - (y, x)) ** 2).sum(axis=1).min()
            distance = np.sqrt(np.float32(squared)) - np.float32(0.5)
            result[y, x] = -distance if there else distance
    return result


def shape():
    mask = np.zeros((37, 53), np.uint8)
    cv2.circle(mask, (22, 17), 11, 255, -1)
    cv2.rectangle(mask, (30, 20), (47, 24), 255, -1)
    return mask


def test_distances_are_exact():
    """OpenCV's own are not: their last bit depends on where the picture lies in memory."""
    assert (signed_distance_px(shape()) == exact_distance(shape())).all()
