# SPDX-License-Identifier: Apache-2.0
"""TRC marker files, as OpenSim and Pose2Sim read and write them: y up, tab separated, empty cells where unknown."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core.errors import InputError
from limbloc_ros.export.clip import Clip
from limbloc_ros.export.markers import marker_places
from limbloc_ros.export.skeleton import Y_UP

Array = NDArray[np.float64]

UNITS = {"m": 1.0, "mm": 1000.0}
_HEAD = "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames"


@dataclass(frozen=True)
class Markers:
    """What a TRC file holds.

    Attributes:
        names: M names.
        places: [F, M, 3] m in world axes (z up), NaN where unknown.
        seconds: [F] s.
    """

    names: tuple[str, ...]
    places: Array
    seconds: Array


def trc_text(clip: Clip, file_name: str, unit: str = "m", names: str = "pose2sim") -> str:
    """The file's text.

    Args:
        clip: frames at an even rate.
        file_name: for the file's first line.
        unit: a key of UNITS; the file says which.
        names: a key of `markers.MARKER_SETS`.
    """
    labels, places = marker_places(clip.joints, names)
    places = UNITS[unit] * places @ Y_UP.T
    rate, count = f"{clip.rate_hz:.10g}", len(places)
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{file_name}",
        _HEAD,
        "\t".join(map(str, [rate, rate, count, len(labels), unit, rate, 1, count])),
        "\t".join(["Frame#", "Time", *(cell for label in labels for cell in (label, "", ""))]),
        "\t".join(["", "", *(f"{axis}{m + 1}" for m in range(len(labels)) for axis in "XYZ")]),
    ]
    digits = 6 if unit == "m" else 3
    for number, (time, row) in enumerate(zip(clip.seconds, places.reshape(count, -1), strict=True), 1):
        cells = ("" if np.isnan(value) else f"{value:.{digits}f}" for value in row)
        lines.append("\t".join([str(number), f"{time:.6f}", *cells]))
    return "\n".join([*lines, ""])


def read_trc(path: Path) -> Markers:
    """Read a TRC file, of m or mm.

    Raises:
        InputError: not a TRC file, unknown units, or a damaged line.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path} cannot be read as a TRC file: {error}") from None
    if len(lines) < 5 or not lines[0].startswith("PathFileType"):
        got = repr(lines[0][:40]) if lines else "an empty file"
        raise InputError(f"{path}: expected a TRC file, which begins with PathFileType, got {got}")
    about = dict(zip(lines[1].split(), lines[2].split(), strict=False))
    unit = about.get("Units", "")
    if unit not in UNITS:
        raise InputError(f"{path}: Units: expected m or mm, got {unit or 'none'!r}")
    names = tuple(name for name in lines[3].split("\t")[2:] if name.strip())
    rows = []
    for number, line in enumerate(lines[5:], 6):
        cells = line.rstrip("\n").split("\t")
        if not line.strip():
            continue
        wanted = 2 + 3 * len(names)
        cells = (cells + [""] * wanted)[:wanted]
        try:
            rows.append([float(cell) if cell.strip() else np.nan for cell in cells[1:]])
        except ValueError as error:
            raise InputError(f"{path}, line {number}: expected numbers, got {error}") from None
    if not rows:
        raise InputError(f"{path} holds no frames")
    table = np.array(rows, dtype=np.float64)
    places = table[:, 1:].reshape(len(table), -1, 3) / UNITS[unit]
    return Markers(names, places @ Y_UP, table[:, 0])
