# SPDX-License-Identifier: Apache-2.0
"""Calibration boards: checkerboards and ChArUco boards, found in images by OpenCV."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core.errors import ConfigError, RigError

Array = NDArray[np.float64]
Pixels = NDArray[np.uint8]

#: Fewer corners than this of one board say too little.
MIN_CORNERS = 6
DEFAULT_DICTIONARY = "DICT_5X5_100"
#: Larger images are halved for the search until they are no wider than this, and searched anew for the exact place.
SEARCH_PX = 1400


@dataclass(frozen=True)
class Board:
    """A board with corners in a plane.

    Attributes:
        kind: `checkerboard` or `charuco`.
        columns, rows: inner corners of a checkerboard, squares of a ChArUco board.
        square_m: edge of a square, m.
        marker_m: edge of a marker, m (ChArUco).
        dictionary: name of the marker dictionary in cv2.aruco (ChArUco).
        legacy: the pattern of OpenCV before 4.6, which begins with a white square when rows are even (ChArUco).
    """

    kind: str
    columns: int
    rows: int
    square_m: float
    marker_m: float = 0.0
    dictionary: str = DEFAULT_DICTIONARY
    legacy: bool = False

    @property
    def grid(self) -> tuple[int, int]:
        """Corners along x and along y."""
        return (self.columns, self.rows) if self.kind == "checkerboard" else (self.columns - 1, self.rows - 1)

    @property
    def points(self) -> Array:
        """[N, 3] corners on the board in m: x along the columns, y along the rows, z = 0; by id."""
        nx, ny = self.grid
        x, y = np.meshgrid(np.arange(nx), np.arange(ny))
        first = 0.0 if self.kind == "checkerboard" else 1.0
        flat = np.stack([x.ravel() + first, y.ravel() + first, np.zeros(nx * ny)], axis=1)
        return flat * self.square_m

    @property
    def ambiguous(self) -> bool:
        """Whether the board looks the same when turned by 180 degrees, so that two cameras may number it otherwise."""
        return self.kind == "checkerboard" and (self.columns + self.rows) % 2 == 0

    def find(self, image: Pixels) -> tuple[NDArray[np.int64], Array] | None:
        """The corners in an image.

        Args:
            image: uint8 [height, width] or [height, width, 3] bgr.

        Returns:
            ids [M] into `points` and their places [M, 2] px (pixel centres are integers); None when the board is not
            there, or too little of it.
        """
        grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        found = self._find_checkerboard(grey) if self.kind == "checkerboard" else self._find_charuco(grey)
        return found if found is not None and len(found[0]) >= MIN_CORNERS else None

    def draw(self, square_px: int = 100, margin_px: int | None = None) -> Pixels:
        """The board as a picture to print, uint8 [height, width], with a white margin (default: half a square)."""
        margin = square_px // 2 if margin_px is None else margin_px
        nx, ny = (self.columns + 1, self.rows + 1) if self.kind == "checkerboard" else (self.columns, self.rows)
        size = (nx * square_px, ny * square_px)
        if self.kind == "checkerboard":
            y, x = np.indices(size[::-1]) // square_px
            picture = np.where((x + y) % 2 == 0, np.uint8(0), np.uint8(255))
        else:
            picture = self._charuco.generateImage(size)
        return np.pad(picture, margin, constant_values=255)

    @cached_property
    def _charuco(self) -> Any:
        if not hasattr(cv2.aruco, "CharucoDetector"):
            raise RigError(f"ChArUco boards need OpenCV 4.7 or later, this is {cv2.__version__}; use a checkerboard")
        markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        board = cv2.aruco.CharucoBoard((self.columns, self.rows), self.square_m, self.marker_m, markers)
        board.setLegacyPattern(self.legacy)
        return board

    @cached_property
    def _detector(self) -> Any:
        return cv2.aruco.CharucoDetector(self._charuco)

    def _find_charuco(self, grey: Pixels) -> tuple[NDArray[np.int64], Array] | None:
        corners, ids, _, _ = self._detector.detectBoard(grey)
        if ids is None or len(ids) == 0:
            return None
        # Already refined, in windows that hold no corner of a marker.
        return ids.ravel().astype(np.int64), corners.reshape(-1, 2).astype(np.float64)

    def _find_checkerboard(self, grey: Pixels) -> tuple[NDArray[np.int64], Array] | None:
        small, scale = grey, 1.0
        while max(small.shape) > SEARCH_PX:
            small = cv2.pyrDown(small)
            scale *= 2
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH + cv2.CALIB_CB_NORMALIZE_IMAGE + cv2.CALIB_CB_FAST_CHECK
        good, corners = cv2.findChessboardCorners(small, self.grid, flags=flags)
        if not good:
            return None
        places = _refined(grey, corners.reshape(-1, 2) * scale)
        ids = np.arange(len(places))
        return ids, places[::-1] if self._upside_down(grey, places) else places

    def _upside_down(self, grey: Pixels, places: Array) -> bool:
        """Whether the corners were numbered from the other end: then a white square lies before the first corner."""
        if self.ambiguous:
            return False
        nx, ny = self.grid
        grid = places.reshape(ny, nx, 2)
        # The square before the first corner has the colour of the one after it, diagonally.
        middles = 0.25 * (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:])
        shades = cv2.remap(grey, middles.astype(np.float32), None, cv2.INTER_LINEAR).astype(np.float64)
        even = (np.indices(shades.shape).sum(axis=0) % 2) == 0
        return bool(shades[even].mean() > shades[~even].mean())


def _refined(grey: Pixels, corners: NDArray[Any]) -> Array:
    """Corners to a fraction of a pixel; the window is small enough to hold no other corner."""
    places = np.ascontiguousarray(corners, dtype=np.float32)
    apart = np.linalg.norm(places[:, None] - places[None], axis=-1) + 1e9 * np.eye(len(places))
    window = int(np.clip(0.35 * apart.min(), 2, 11))
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 0.005)
    refined = cv2.cornerSubPix(grey, places.reshape(-1, 1, 2), (window, window), (-1, -1), criteria)
    return np.asarray(refined.reshape(-1, 2), dtype=np.float64)


def parse_board(text: str) -> Board:
    """`checkerboard:9x6:0.03` (inner corners, square in m) or `charuco:7x5:0.08:0.06[:DICTIONARY][:legacy]` (squares).

    Raises:
        ConfigError: another form, or an impossible board.
    """
    words = text.split(":")
    legacy = words[-1] == "legacy"
    if legacy:
        words.pop()
    usage = (
        "expected checkerboard:COLUMNSxROWS:SQUARE_M or charuco:COLUMNSxROWS:SQUARE_M:MARKER_M[:DICTIONARY][:legacy]"
    )
    try:
        kind = words[0]
        columns, rows = (int(word) for word in words[1].lower().split("x"))
        lengths = [float(word) for word in words[2 : 3 if kind == "checkerboard" else 4]]
    except (IndexError, ValueError):
        raise ConfigError(f"--board {text}: {usage}") from None
    names = words[2 + len(lengths) :]
    if kind not in ("checkerboard", "charuco") or len(lengths) != (1 if kind == "checkerboard" else 2):
        raise ConfigError(f"--board {text}: {usage}")
    if len(names) > (kind == "charuco") or (legacy and kind != "charuco"):
        raise ConfigError(f"--board {text}: {usage}")
    if not all(0.001 <= length <= 2 for length in lengths):
        raise ConfigError(f"--board {text}: expected edges of 0.001 to 2 m, got {lengths}; they are metres")
    if kind == "checkerboard" and min(columns, rows) < 3:
        raise ConfigError(f"--board {text}: expected 3x3 inner corners or more, got {columns}x{rows}")
    if kind == "charuco" and (min(columns, rows) < 3 or lengths[1] >= lengths[0]):
        raise ConfigError(f"--board {text}: expected 3x3 squares or more, and markers smaller than the squares")
    marker_m = lengths[1] if kind == "charuco" else 0.0
    board = Board(kind, columns, rows, lengths[0], marker_m, names[0] if names else DEFAULT_DICTIONARY, legacy)
    if kind == "charuco":
        known = [name for name in dir(cv2.aruco) if name.startswith("DICT_")]
        if board.dictionary not in known:
            raise ConfigError(f"--board {text}: no dictionary {board.dictionary}; OpenCV has {', '.join(known)}")
    return board
