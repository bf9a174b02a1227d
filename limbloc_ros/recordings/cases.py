# SPDX-License-Identifier: Apache-2.0
"""Benchmark case folders: calibration, packed masks and, where it is known, the truth.

`calib.json` holds the cameras, `masks.npz` per camera uint8 `[F, H, ceil(W / 8)]` packed bits, `gt.npz` the true joints
and `meta.json` what was drawn. Only the first two are needed. Where `meta.json` says `background_frames`, the masks
begin with so many frames of the empty room, which the truth does not have: they are left out.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core.camera import Rig
from limbloc_ros.core.errors import InputError
from limbloc_ros.recordings.npz_file import read_npz
from limbloc_ros.rig.plain_values import read_values
from limbloc_ros.rig.rig_file import load_rig

Array = NDArray[np.float64]

#: Frames per second of a case whose meta.json does not say.
DEFAULT_FPS = 25.0


@dataclass(frozen=True)
class Case:
    """One benchmark case.

    Attributes:
        folder: where it was read from.
        rig: its cameras, with a carve volume derived from what they see.
        packed: camera name -> uint8 [F, H, ceil(W / 8)], eight pixels a byte, the first in the highest bit.
        stamps: [F] s from the first frame on.
        meta: meta.json as it is, {} without one.
        truth: joint name -> [F, 3] m in world axes; {} without gt.npz.
    """

    folder: Path
    rig: Rig
    packed: dict[str, NDArray[np.uint8]]
    stamps: Array
    meta: dict[str, Any]
    truth: dict[str, Array]

    def __len__(self) -> int:
        return len(self.stamps)

    def masks(self, frame: int) -> dict[str, NDArray[np.uint8]]:
        """Masks of one frame: camera name -> uint8 [height, width], 0 or 255."""
        widths = {camera.name: camera.width for camera in self.rig.cameras}
        return {name: unpack_mask(packed[frame], widths[name]) for name, packed in self.packed.items()}


def pack_mask(mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """[H, W] mask (non-zero = foreground) -> [H, ceil(W / 8)] packed bits."""
    return np.packbits(mask != 0, axis=1)


def unpack_mask(packed: NDArray[np.uint8], width: int) -> NDArray[np.uint8]:
    """[H, ceil(W / 8)] packed bits -> [H, width] mask of 0 and 255."""
    return np.unpackbits(packed, axis=1, count=width) * np.uint8(255)


def is_case(folder: Path) -> bool:
    """Whether `folder` is a benchmark case."""
    try:
        return (folder / "calib.json").is_file() and (folder / "masks.npz").is_file()
    except OSError:  # no path at all, as a damaged file of results may hold
        return False


def load_case(folder: str | Path, rig: Rig | None = None) -> Case:
    """Read a benchmark case.

    Args:
        folder: with `calib.json` and `masks.npz`.
        rig: used in place of `calib.json`.

    Raises:
        InputError: a file is missing or damaged, or the masks do not fit the cameras.
        RigError: calib.json is malformed.
    """
    folder = Path(folder)
    if not is_case(folder):
        raise InputError(f"{folder} is no benchmark case: expected calib.json and masks.npz in it")
    rig = rig or load_rig(folder / "calib.json")
    packed = read_npz(folder / "masks.npz")
    unknown = sorted(set(packed) - set(rig.names))
    if unknown or not packed:
        raise InputError(
            f"{folder / 'masks.npz'}: expected masks of the rig's cameras {', '.join(rig.names)}, "
            f"got {', '.join(unknown) or 'none'}"
        )
    for name, bits in packed.items():
        camera = rig.camera(name)
        expected = (camera.height, -(-camera.width // 8))
        if bits.ndim != 3 or bits.dtype != np.uint8 or bits.shape[1:] != expected:
            raise InputError(
                f"{folder / 'masks.npz'}: camera {name} is {camera.width}x{camera.height} px, so its masks must be "
                f"uint8 [F, {expected[0]}, {expected[1]}], got {bits.dtype} {list(bits.shape)}"
            )
    counts = {name: len(bits) for name, bits in packed.items()}
    if len(set(counts.values())) != 1:
        raise InputError(f"{folder / 'masks.npz'}: expected equally many frames of every camera, got {counts}")
    meta = _read_meta(folder / "meta.json")
    empty = int(meta.get("background_frames", 0))
    frames = next(iter(counts.values())) - empty
    if frames < 1:
        raise InputError(f"{folder}: all {frames + empty} frames are of the empty room (background_frames {empty})")
    return Case(
        folder=folder,
        rig=rig,
        packed={name: packed[name][empty:] for name in rig.names if name in packed},
        stamps=np.arange(frames) / float(meta.get("fps", DEFAULT_FPS)),
        meta=meta,
        truth=_read_truth(folder / "gt.npz", frames),
    )


def _read_meta(path: Path) -> dict[str, Any]:
    if not path.is_file():
        return {}
    meta = read_values(path, "case", "the meta.json in it", InputError)
    if not isinstance(meta, dict):
        raise InputError(f"{path}: expected an object with keys such as kind and fps, got {type(meta).__name__}")
    if not isinstance(meta.get("fps", DEFAULT_FPS), (int, float)) or meta.get("fps", DEFAULT_FPS) <= 0:
        raise InputError(f"{path}: key fps: expected a positive number, got {meta['fps']!r}")
    if not isinstance(meta.get("background_frames", 0), int) or meta.get("background_frames", 0) < 0:
        raise InputError(f"{path}: key background_frames: expected 0 or more, got {meta['background_frames']!r}")
    return meta


def _read_truth(path: Path, frames: int) -> dict[str, Array]:
    if not path.is_file():
        return {}
    archive = read_npz(path)
    joints, names = joints_of(archive, path)
    if len(joints) != frames:
        raise InputError(f"{path}: expected joints [{frames}, {len(names)}, 3], got {list(joints.shape)}")
    return {name: joints[:, i] for i, name in enumerate(names)}


def joints_of(archive: Mapping[str, NDArray[Any]], path: Path) -> tuple[Array, tuple[str, ...]]:
    """Joints [F, J, 3] m and their names out of an archive; raises InputError when they are not there or do not fit."""
    if not {"joints", "joint_names"} <= set(archive):
        raise InputError(
            f"{path}: expected joints [N, J, 3] m and joint_names [J], got {', '.join(archive) or 'nothing'}; save the "
            "arrays under these names"
        )
    joints, names = archive["joints"], archive["joint_names"]
    if names.dtype.kind != "U" or names.ndim != 1 or joints.dtype.kind not in "fiu":
        raise InputError(
            f"{path}: expected joints as numbers and joint_names as a list of texts, got {joints.dtype} "
            f"{list(joints.shape)} and {names.dtype} {list(names.shape)}"
        )
    if joints.ndim != 3 or joints.shape[1:] != (len(names), 3):
        raise InputError(f"{path}: expected joints [F, {len(names)}, 3], got {list(joints.shape)}")
    return joints.astype(np.float64), tuple(str(name) for name in names)
