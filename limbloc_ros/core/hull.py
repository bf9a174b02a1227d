# SPDX-License-Identifier: Apache-2.0
"""Masks + cameras -> the visual hull as a signed distance field (paper section 1)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core.camera import Rig
from limbloc_ros.core.config import HullConfig
from limbloc_ros.core.errors import NoPerson


@dataclass(frozen=True)
class Hull:
    """A visual hull on the world's voxel lattice (see docs/conventions.md).

    Attributes:
        voxel_m: edge length of a voxel, m.
        index_min: (i, j, k) lattice indices of element [0, 0, 0]; voxel centres are (index + 0.5) * voxel_m.
        sdf: float32 [nx, ny, nz] signed distance, m; negative inside, clamped to band_m outside.
        band_m: where the clamp lies, m.
        cameras: names of the cameras that were used.
        rejected: camera name -> why its mask was not used.
    """

    voxel_m: float
    index_min: tuple[int, int, int]
    sdf: NDArray[np.float32]
    band_m: float
    cameras: tuple[str, ...]
    rejected: dict[str, str]

    def shell(self) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        """The voxels that matter: the inside and the thin shell around it.

        Returns:
            lattice indices int32 [V, 3] and signed distances float32 [V] m, all below band_m, in array order.
        """
        local = np.argwhere(self.sdf < np.float32(self.band_m))
        values = self.sdf[local[:, 0], local[:, 1], local[:, 2]]
        return (local + np.asarray(self.index_min)).astype(np.int32), values

    @staticmethod
    def from_shell(
        voxel_m: float,
        band_m: float,
        indices: NDArray[np.int32],
        values: NDArray[np.float32],
        cameras: tuple[str, ...] = (),
        rejected: dict[str, str] | None = None,
    ) -> Hull:
        """Rebuild from `shell()` the hull that the pose stage sees; the inverse of `shell`, bit for bit."""
        raise NotImplementedError


def carve(masks: Mapping[str, NDArray[np.uint8]], rig: Rig, config: HullConfig) -> Hull | NoPerson:
    """Carve the hull of one frame.

    Args:
        masks: camera name -> uint8 [height, width], non-zero = foreground. Cameras without a mask are left out.
        rig: the cameras and the carve volume.
        config: voxel size, voting, limits.

    Returns:
        the hull, cropped to its largest component plus the shell, or why there is none.
    """
    raise NotImplementedError
