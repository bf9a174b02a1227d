# SPDX-License-Identifier: Apache-2.0
"""How far from its axis a lens model can be believed, and how much it enlarges there.

A distortion polynomial is fitted inside the image. Far outside it may turn around and fold points that the camera
cannot see back into the image; and a bound of the polynomial's slope is what makes skipping whole blocks of voxels
safe. Both depend on the calibration alone and are measured once per camera.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core.camera import Camera
from limbloc_ros.core.errors import RigError

#: Angles off the axis (89 degrees at most) and directions around it at which the lens is sampled.
_ANGLES = np.linspace(0.0, math.radians(89.0), 257)[1:]
_DIRECTIONS = np.arange(32) * (2 * np.pi / 32)
#: Beyond the image, the range goes on by this factor, so that blocks of voxels beside the image can be judged too.
_BESIDE_IMAGE = 1.25


def lens_range(camera: Camera) -> tuple[float, float]:
    """The range of a lens model and its largest enlargement within.

    Args:
        camera: its distortion and image size are read.

    Returns:
        The largest distance from the axis, in normalised coordinates (x/z, y/z), up to which the model is one-to-one
        and which holds the whole image where the model allows; points further out are not seen. And the Lipschitz
        constant of the distortion within it: two points d apart (normalised) are at most that times d apart after it.
        (inf, 1) without distortion.

    Raises:
        RigError: the model is not one-to-one even at the image's centre, or has a tilted sensor.
    """
    if not camera.distortion.any():
        return math.inf, 1.0
    if camera.distortion.size == 14 and camera.distortion[12:].any():
        raise RigError(
            f"camera {camera.name}: the tilted-sensor coefficients (13th and 14th) are not supported: expected zeros, "
            f"got {camera.distortion[12:].tolist()}; calibrate without CALIB_TILTED_MODEL"
        )
    radii = np.tan(_ANGLES)
    directions = np.stack([np.cos(_DIRECTIONS), np.sin(_DIRECTIONS)], axis=-1)
    points = radii[:, None, None] * directions
    # Central differences across and along the radius: the two columns of the Jacobian in a turned frame.
    step = 1e-5 * radii[:, None, None]
    across = np.stack([-directions[:, 1], directions[:, 0]], axis=-1)
    along_r = (distort(camera, points + step * directions) - distort(camera, points - step * directions)) / (2 * step)
    along_t = (distort(camera, points + step * across) - distort(camera, points - step * across)) / (2 * step)
    turned = along_r * directions[None], along_r * across[None], along_t * directions[None], along_t * across[None]
    rr, rt, tr, tt = (part.sum(axis=-1) for part in turned)
    folds = ~((rr * tt - rt * tr > 0) & (rr > 0)).all(axis=1)
    fold = int(folds.argmax()) if folds.any() else len(radii)
    if fold < 2:
        raise RigError(
            f"camera {camera.name}: its distortion {camera.distortion.tolist()} is impossible: it maps neighbours of "
            "the image's centre onto each other; are the coefficients in OpenCV's order, and of this distortion_model?"
        )
    u = distort(camera, points[:fold]) * (camera.K[0, 0], camera.K[1, 1]) + (camera.K[0, 2], camera.K[1, 2])
    seen = ((u > -1) & (u < (camera.width, camera.height))).all(axis=-1).any(axis=1)
    last = int(np.flatnonzero(seen)[-1]) + 1 if seen.any() else 0
    limit = min(fold - 1, int(np.searchsorted(radii, radii[min(last, len(radii) - 1)] * _BESIDE_IMAGE)))
    # Largest singular value of the Jacobian [[rr, tr], [rt, tt]]; between samples it may exceed both by their step.
    total, area = rr**2 + rt**2 + tr**2 + tt**2, rr * tt - rt * tr
    largest = np.sqrt(0.5 * (total + np.sqrt(np.maximum(total**2 - 4 * area**2, 0))))[: limit + 1].max(axis=1)
    between = float(np.abs(np.diff(largest, prepend=1.0)).max())
    return float(radii[limit]), float(largest.max()) + between


def distort(camera: Camera, normalised: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distorted normalised coordinates [..., 2] of normalised coordinates [..., 2].

    OpenCV's models except for a tilted sensor, in a tenth of its time: nothing is carved before the lenses of all
    cameras are measured. As in OpenCV, a fisheye leaves the points of its axis where they are.
    """
    a, b = normalised[..., 0], normalised[..., 1]
    k = np.zeros(14)
    k[: camera.distortion.size] = camera.distortion
    r2 = a * a + b * b
    with np.errstate(all="ignore"):  # impossible lenses divide by 0 and overflow: that folds, too
        if camera.distortion_model == "fisheye":
            r = np.sqrt(r2)
            t2 = np.arctan(r) ** 2
            scale = np.arctan(r) * (1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3])))) / r
            scale = np.where(r > 1e-8, scale, 1.0)
            return np.stack([a * scale, b * scale], axis=-1)
        radial = 1 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))
        if k[5:8].any():
            radial /= 1 + r2 * (k[5] + r2 * (k[6] + r2 * k[7]))
        u = a * radial + 2 * k[2] * a * b + k[3] * (r2 + 2 * a * a) + r2 * (k[8] + r2 * k[9])
        v = b * radial + k[2] * (r2 + 2 * b * b) + 2 * k[3] * a * b + r2 * (k[10] + r2 * k[11])
    return np.stack([u, v], axis=-1)
