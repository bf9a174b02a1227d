# SPDX-License-Identifier: Apache-2.0
"""How far apart the cameras' stamps are within a set, and by how many millimetres that smears whoever moves.

A hull is cut from silhouettes of different instants when cameras run free. A limb that moves at v meanwhile lies
v * skew elsewhere, and the hull keeps of it only what all silhouettes share.
"""

from __future__ import annotations

import statistics
from collections import deque
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Figures are those of so many seconds, by the stamps.
WINDOW_NS = 5_000_000_000
#: Places this far apart in time or more tell a speed: over less, the fit's own tremble would.
BASE_NS = 80_000_000
#: Smearing that is worth a word, mm.
SMEARED_MM = 5.0


class StampSkew:
    """Keeps stamps and joints of the last seconds.

    A stamp that falls back (a looped recording) begins anew.
    """

    def __init__(self) -> None:
        self._recent: dict[str, deque[int]] = {}
        self._skews: deque[tuple[int, int]] = deque()
        self._offsets: dict[str, deque[tuple[int, int]]] = {}
        self._places: deque[tuple[int, Array]] = deque()
        self._speeds: deque[tuple[int, float]] = deque()

    def mask(self, camera: str, stamp_ns: int) -> None:
        """A camera's mask came."""
        self._recent.setdefault(camera, deque(maxlen=64)).append(stamp_ns)

    def carved(self, stamp_ns: int, skew_ns: int) -> None:
        """A set was carved: its earliest stamp, and how far behind that its latest is."""
        if self._skews and stamp_ns < self._skews[-1][0]:
            self._skews.clear()
            self._offsets.clear()
        self._skews.append((stamp_ns, skew_ns))
        _forget(self._skews, stamp_ns)
        for camera, stamps in self._recent.items():
            mine = [s for s in stamps if stamp_ns <= s <= stamp_ns + skew_ns]
            if mine:
                offsets = self._offsets.setdefault(camera, deque())
                offsets.append((stamp_ns, mine[-1] - stamp_ns))
                _forget(offsets, stamp_ns)

    def joints(self, stamp_ns: int, places: Array) -> None:
        """Somebody's joints [J, 3] m came."""
        if self._places and stamp_ns <= self._places[-1][0]:
            self._places.clear()
            self._speeds.clear()
        self._places.append((stamp_ns, places))
        while len(self._places) > 2 and stamp_ns - self._places[1][0] >= BASE_NS:
            self._places.popleft()
        before_ns, before = self._places[0]
        if BASE_NS <= stamp_ns - before_ns <= WINDOW_NS:
            way_m = float(np.linalg.norm(places - before, axis=1).max())
            self._speeds.append((stamp_ns, way_m / (1e-9 * (stamp_ns - before_ns))))
        _forget(self._speeds, stamp_ns)

    def nobody(self) -> None:
        """Nobody is there: who moved before is no longer of interest."""
        self._places.clear()
        self._speeds.clear()

    @property
    def skew_ms(self) -> float:
        """Median over the last seconds' sets of latest minus earliest stamp; NaN without any."""
        return 1e-6 * statistics.median(skew for _, skew in self._skews) if self._skews else float("nan")

    @property
    def speed_m_s(self) -> float:
        """How fast the fastest joint usually is, which is mostly a hand or a foot: median of the last seconds."""
        return statistics.median(speed for _, speed in self._speeds) if self._speeds else float("nan")

    @property
    def costs_mm(self) -> float:
        """By how much that joint is smeared: speed times skew; NaN when nobody is followed."""
        return self.speed_m_s * self.skew_ms

    def in_words(self) -> str:
        """What the skew costs, when it is worth a word; else empty."""
        if not self.costs_mm >= SMEARED_MM:
            return ""
        return (
            f"the cameras' stamps are {self.skew_ms:.0f} ms apart, which at {self.speed_m_s:.1f} m/s smears hands and "
            f"feet by {self.costs_mm:.0f} mm: trigger the cameras together"
        )

    def behind_ms(self) -> Mapping[str, float]:
        """Camera -> how far its stamps usually lie behind the earliest of their set."""
        return {camera: 1e-6 * statistics.median(ns for _, ns in each) for camera, each in self._offsets.items()}


def _forget(kept: deque[tuple[int, int]] | deque[tuple[int, float]], now_ns: int) -> None:
    while kept and now_ns - kept[0][0] > WINDOW_NS:
        kept.popleft()
