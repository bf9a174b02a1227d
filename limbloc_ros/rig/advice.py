# SPDX-License-Identifier: Apache-2.0
"""How good a calibration is, camera by camera, and what to record again."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.rig.bundle import View
from limbloc_ros.rig.calibration import Calibration

Array = NDArray[np.float64]

#: The image in cells (across, down) that the board should have been in.
CELLS = (8, 6)
#: Good practice: root mean square error, share of cells, views, frames in common with some other camera, slant.
GOOD_RMS_PX, GOOD_COVERAGE, GOOD_VIEWS, GOOD_COMMON, GOOD_SLANT_DEG = 1.0, 0.6, 15, 10, 25.0
#: Uncertainties that a room can live with: position (m), gaze (rad).
GOOD_SIGMA_M, GOOD_SIGMA_RAD = 0.003, np.radians(0.1)

_COLUMNS = ("left", "middle", "right")
_ROWS = ("upper", "centre", "lower")


@dataclass(frozen=True)
class CameraQuality:
    """One camera's figures.

    Attributes:
        name: the camera.
        views, corners: how many were used.
        rms_px, p95_px, worst_px: distances of found and projected corners.
        coverage: share of the image's cells in which a corner was found.
        cells: [6, 8] corners in each.
        slant_deg: how far the board was tilted out of the image plane, 90th percentile.
        common: frames that it shares with the camera it shares most with.
        sigma_m, sigma_rad: uncertainty of its place and gaze.
    """

    name: str
    views: int
    corners: int
    rms_px: float
    p95_px: float
    worst_px: float
    coverage: float
    cells: NDArray[np.int64]
    slant_deg: float
    common: int
    sigma_m: float
    sigma_rad: float


def assess(calibration: Calibration) -> list[CameraQuality]:
    """The figures of every camera."""
    common = _common_frames(calibration.views)
    out = []
    for c, camera in enumerate(calibration.cameras):
        mine = [(v, r) for v, r in zip(calibration.views, calibration.residuals, strict=True) if v.camera == c]
        errors = np.concatenate([np.linalg.norm(r, axis=1) for _, r in mine])
        places = np.concatenate([v.places for v, _ in mine])
        cells = count_cells(places, (camera.width, camera.height))
        slants = []
        for view, _ in mine:
            T = calibration.boards.get(view.frame)
            if T is not None:
                away = camera.T_world_camera[:3, 3] - T[:3, 3]
                cosine = abs(float(T[:3, 2] @ away)) / float(np.linalg.norm(away))
                slants.append(math.degrees(math.acos(min(1.0, cosine))))
        partners = [n for pair, n in common.items() if c in pair]
        out.append(
            CameraQuality(
                camera.name,
                len(mine),
                len(errors),
                float(np.sqrt((errors**2).mean())),
                float(np.percentile(errors, 95)),
                float(errors.max()),
                float((cells > 0).mean()),
                cells,
                float(np.percentile(slants, 90)) if slants else float("nan"),
                max(partners, default=0),
                float(calibration.sigma_m[c]),
                float(calibration.sigma_rad[c]),
            )
        )
    return out


def count_cells(places: Array, size: tuple[int, int]) -> NDArray[np.int64]:
    """[6, 8] how many of the places [N, 2] px lie in each cell of an image of `size`."""
    across = np.clip((places[:, 0] + 0.5) / size[0] * CELLS[0], 0, CELLS[0] - 1).astype(int)
    down = np.clip((places[:, 1] + 0.5) / size[1] * CELLS[1], 0, CELLS[1] - 1).astype(int)
    cells = np.zeros((CELLS[1], CELLS[0]), np.int64)
    np.add.at(cells, (down, across), 1)
    return cells


def _common_frames(views: Sequence[View]) -> dict[tuple[int, int], int]:
    """Pairs of cameras -> frames in which both saw the board."""
    seen: dict[int, set[int]] = defaultdict(set)
    for view in views:
        seen[view.frame].add(view.camera)
    counts: dict[tuple[int, int], int] = defaultdict(int)
    for cameras in seen.values():
        for pair in combinations(sorted(cameras), 2):
            counts[pair] += 1
    return counts


def what_to_record(qualities: Sequence[CameraQuality], floor_frames: int, alone: bool = False) -> list[str]:
    """What to do better, one sentence each; empty when all is well.

    Args:
        qualities: of every camera.
        floor_frames: frames in which the board lay on the floor.
        alone: lenses only: no other camera and no floor is expected.
    """
    advice = []
    for q in qualities:
        if q.rms_px > GOOD_RMS_PX:
            advice.append(
                f"{q.name}: corners are {q.rms_px:.2f} px off (expected below {GOOD_RMS_PX:g}): hold the board still, "
                "give more light (blur), make sure that it is flat; with all cameras off, check its size and --lens"
            )
        if q.views < GOOD_VIEWS:
            advice.append(f"{q.name}: only {q.views} views (expected {GOOD_VIEWS}): show it the board longer")
        if q.coverage < GOOD_COVERAGE:
            advice.append(
                f"{q.name}: the board was in {100 * q.coverage:.0f} % of its image (expected {100 * GOOD_COVERAGE:.0f} "
                f"%): bring it to the {_empty_region(q.cells)}, near the camera"
            )
        if q.slant_deg < GOOD_SLANT_DEG:
            advice.append(
                f"{q.name}: the board was never tilted by more than {q.slant_deg:.0f} degrees (expected "
                f"{GOOD_SLANT_DEG:.0f}): tilt it towards and away from the camera, or the focal length is a guess"
            )
        if alone:
            continue
        if q.common < GOOD_COMMON:
            advice.append(
                f"{q.name}: no other camera shares more than {q.common} frames with it (expected {GOOD_COMMON}): move "
                "the board where it and a neighbour both see it"
            )
        if q.sigma_m > GOOD_SIGMA_M or q.sigma_rad > GOOD_SIGMA_RAD:
            advice.append(
                f"{q.name}: its place is known to {1000 * q.sigma_m:.1f} mm and its gaze to "
                f"{np.degrees(q.sigma_rad):.2f} degrees: more frames of the board in the middle of the room"
            )
    if not alone and 0 < floor_frames < 3:
        advice.append(f"the floor rests on {floor_frames} frame(s): let the board lie there for some seconds")
    return advice


def _empty_region(cells: NDArray[np.int64]) -> str:
    """The ninth of the image with the most empty cells, in words."""
    empty = (cells == 0).astype(float)
    rows, columns = np.array_split(np.arange(CELLS[1]), 3), np.array_split(np.arange(CELLS[0]), 3)
    share = np.array([[empty[np.ix_(r, c)].mean() for c in columns] for r in rows])
    row, column = divmod(int(share.argmax()), 3)
    return "middle" if (row, column) == (1, 1) else f"{_ROWS[row]} {_COLUMNS[column]}"
