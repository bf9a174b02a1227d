# SPDX-License-Identifier: Apache-2.0
"""Calibrated cameras, the room they look at, and the projection of world points into their images."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from limbloc_ros.core.errors import RigError

Array = NDArray[np.float64]

#: Larger pictures are taken for a damaged file or message.
MAX_PIXELS = 64_000_000

#: No room needs more; squares and products of larger numbers overflow further on.
_LARGEST = {"K": 1e7, "T_world_camera": 1e4, "distortion": 1e7}

#: OpenCV fills polygons row by row, also far outside the image.
_FARTHEST_PX = 1e5

DISTORTION_COEFFICIENTS = {"none": (0,), "radtan": (4, 5), "rational": (8, 12, 14), "fisheye": (4,)}


@dataclass(frozen=True)
class Camera:
    """One calibrated camera.

    Attributes:
        name: the camera's name, also the prefix of its topics.
        width, height: image size in px.
        K: [3, 3] intrinsics in px; integer pixel coordinates are pixel centres.
        distortion: coefficients in OpenCV's order (k1 k2 p1 p2 [k3 ...]; fisheye k1..k4).
        distortion_model: `none`, `radtan` (plumb_bob), `rational` or `fisheye` (equidistant).
        T_world_camera: [4, 4] pose of the optical frame (x right, y down, z forward) in the world, m.
        ignore: polygons [N, 2] in px where the camera's foreground means nothing (a screen, a window, a curtain): it
            neither carves there nor is it held against others.
    """

    name: str
    width: int
    height: int
    K: Array
    T_world_camera: Array
    distortion: Array = field(default_factory=lambda: np.zeros(0))
    distortion_model: str = "none"
    ignore: tuple[Array, ...] = ()

    def __post_init__(self) -> None:
        for name, shape in (("K", (3, 3)), ("T_world_camera", (4, 4)), ("distortion", None)):
            value = np.array(getattr(self, name), dtype=np.float64)
            if shape is not None and value.shape != shape:
                raise RigError(f"camera {self.name}: {name} must have shape {shape}, got {value.shape}")
            if not np.isfinite(value).all():
                raise RigError(f"camera {self.name}: {name} holds a number that is not finite")
            if value.size and np.abs(value).max() > _LARGEST[name]:
                raise RigError(
                    f"camera {self.name}: {name} holds {np.abs(value).max():g}; expected numbers up to "
                    f"{_LARGEST[name]:g} (are the units metres and pixels?)"
                )
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        # It becomes part of topics and file names.
        if not (self.name.isprintable() and len(self.name) <= 100) or any(
            part in ("", ".", "..") for part in self.name.split("/")
        ):
            raise RigError(f"expected a camera's name such as cam0, got {self.name!r:.80}")
        if self.width < 1 or self.height < 1:
            raise RigError(f"camera {self.name}: image size must be positive, got {self.width}x{self.height}")
        if self.width * self.height > MAX_PIXELS:
            raise RigError(
                f"camera {self.name}: expected images of at most {MAX_PIXELS} pixels, got {self.width}x{self.height}"
            )
        if self.K[0, 0] <= 0 or self.K[1, 1] <= 0:
            raise RigError(
                f"camera {self.name}: K has focal lengths {self.K[0, 0]:g}, {self.K[1, 1]:g} px; expected positive "
                "ones (an all-zero K means that the driver has no calibration: run camera_calibration or set "
                "camera_info_url)"
            )
        if self.distortion_model not in DISTORTION_COEFFICIENTS:
            raise RigError(
                f"camera {self.name}: distortion_model must be one of {', '.join(DISTORTION_COEFFICIENTS)}, "
                f"got {self.distortion_model!r}"
            )
        counts = DISTORTION_COEFFICIENTS[self.distortion_model]
        if self.distortion.size not in counts:
            raise RigError(
                f"camera {self.name}: {self.distortion_model} distortion takes {' or '.join(map(str, counts))} "
                f"coefficients, got {self.distortion.size}"
            )
        polygons = tuple(np.array(polygon, dtype=np.float64) for polygon in self.ignore)
        for polygon in polygons:
            shaped = polygon.ndim == 2 and polygon.shape[1] == 2 and len(polygon) >= 3
            if not shaped or not (np.abs(polygon) <= _FARTHEST_PX).all():
                raise RigError(
                    f"camera {self.name}: ignore takes polygons of three or more (x, y) in px, none farther than "
                    f"{_FARTHEST_PX:g}, got {polygon.tolist()!s:.200}"
                )
            polygon.setflags(write=False)
        object.__setattr__(self, "ignore", polygons)
        R = self.T_world_camera[:3, :3]
        if np.abs(R @ R.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R) < 0:
            raise RigError(
                f"camera {self.name}: the rotation of T_world_camera is not a right-handed rotation matrix: its "
                f"determinant is {np.linalg.det(R):.3f} (expected 1; -1: mirrored, of left-handed axes), "
                f"its rows are {', '.join(f'{n:.3f}' for n in np.linalg.norm(R, axis=1))} long (expected 1); write its "
                "columns as the image's right, down and forward in the room, or take the rig from the tool that "
                "measured it with `limbloc rig import`"
            )

    @property
    def T_camera_world(self) -> Array:
        """[4, 4] world to optical frame, m."""
        T = np.eye(4)
        R = self.T_world_camera[:3, :3]
        T[:3, :3] = R.T
        T[:3, 3] = -R.T @ self.T_world_camera[:3, 3]
        return T

    def ignored_pixels(self) -> NDArray[np.uint8] | None:
        """[height, width] 1 where the camera is to be ignored, 0 elsewhere; None without such regions."""
        if not self.ignore:
            return None
        pixels = np.zeros((self.height, self.width), np.uint8)
        outlines = [np.rint(polygon).astype(np.int32) for polygon in self.ignore]
        return np.asarray(cv2.fillPoly(pixels, outlines, 1), dtype=np.uint8)

    def world_to_image(self, p_world: ArrayLike) -> tuple[Array, Array]:
        """Project world points.

        Args:
            p_world: [..., 3] points, m.

        Returns:
            uv [..., 2] in px (distorted, as in the image; NaN behind the camera) and depth [...] in m along the axis.
        """
        p_world = np.asarray(p_world, dtype=np.float64)
        T = self.T_camera_world
        p_camera = p_world @ T[:3, :3].T + T[:3, 3]
        depth = p_camera[..., 2].copy()
        flat = p_camera.reshape(-1, 3)
        front = flat[:, 2] > 1e-6
        uv = np.full((len(flat), 2), np.nan)
        if front.any():
            pts = np.ascontiguousarray(flat[front])
            if self.distortion_model == "fisheye":
                out, _ = cv2.fisheye.projectPoints(pts[:, None], np.zeros(3), np.zeros(3), self.K, self.distortion)
            else:
                out, _ = cv2.projectPoints(pts, np.zeros(3), np.zeros(3), self.K, self.distortion)
            uv[front] = out.reshape(-1, 2)
        return uv.reshape(*p_world.shape[:-1], 2), depth


@dataclass(frozen=True)
class Rig:
    """The cameras of a room and the box of space that is carved.

    Attributes:
        cameras: at least one camera, names unique.
        volume_min, volume_max: [3] corners of the carve volume in world axes, m (z up, the floor at z = 0).
    """

    cameras: tuple[Camera, ...]
    volume_min: Array
    volume_max: Array

    def __post_init__(self) -> None:
        if not self.cameras:
            raise RigError("a rig needs at least one camera, got none")
        names = [c.name for c in self.cameras]
        if len(set(names)) != len(names):
            raise RigError(f"camera names must be unique, got {', '.join(names)}")
        for name in ("volume_min", "volume_max"):
            value = np.array(getattr(self, name), dtype=np.float64)
            if value.shape != (3,) or not np.isfinite(value).all():
                raise RigError(f"{name} must be three finite numbers in metres, got {value.tolist()}")
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        size = self.volume_max - self.volume_min
        if (size <= 0.1).any() or (size > 100).any():
            raise RigError(
                f"the carve volume must be 0.1 to 100 m long on each axis, got {size.tolist()} m "
                "(are the units metres?)"
            )

    @property
    def names(self) -> tuple[str, ...]:
        """Camera names in the rig's order."""
        return tuple(c.name for c in self.cameras)

    def camera(self, name: str) -> Camera:
        """The camera called `name`; raises RigError that lists the known names."""
        for camera in self.cameras:
            if camera.name == name:
                return camera
        raise RigError(f"the rig has no camera {name!r}; it has {', '.join(self.names)}")
