# SPDX-License-Identifier: Apache-2.0
"""A clip -> C3D, the file of motion laboratories, by the library ezc3d (the extra `export`)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from limbloc_ros import __version__
from limbloc_ros.core.errors import InputError
from limbloc_ros.export.clip import Clip
from limbloc_ros.export.markers import marker_places

UNITS = {"m": 1.0, "mm": 1000.0}
#: C3D counts frames in 16 bits in its header; longer files hold them in a parameter that not all readers know.
MOST_FRAMES = 65535


def write_c3d(clip: Clip, path: Path, unit: str = "mm", names: str = "limbloc") -> None:
    """Write the markers of a clip, world axes (z up); a frame without a pose has residual -1, C3D's word for unknown.

    Args:
        clip: frames at an even rate.
        path: the file itself; the caller renames it when it is complete.
        unit: a key of UNITS.
        names: a key of `markers.MARKER_SETS`.

    Raises:
        InputError: ezc3d is not installed, or the clip is too long for the format.
    """
    try:
        import ezc3d
    except ModuleNotFoundError:
        raise InputError("C3D needs the library ezc3d; install it with `pip install 'limbloc_ros[export]'`") from None
    if len(clip) > MOST_FRAMES:
        raise InputError(f"C3D holds at most {MOST_FRAMES} frames, the clip has {len(clip)}; use --first and --last")
    labels, places = marker_places(clip.joints, names)
    points = np.ones((4, len(labels), len(places)))
    points[:3] = UNITS[unit] * places.transpose(2, 1, 0)
    file = ezc3d.c3d()
    file["parameters"]["POINT"]["UNITS"]["value"] = [unit]
    file["parameters"]["POINT"]["RATE"]["value"] = [clip.rate_hz]
    file["parameters"]["POINT"]["LABELS"]["value"] = list(labels)
    file["data"]["points"] = points
    for group, name, value in (
        ("POINT", "X_SCREEN", "+Y"),
        ("POINT", "Y_SCREEN", "+Z"),
        ("MANUFACTURER", "SOFTWARE", "limbloc_ros"),
        ("MANUFACTURER", "VERSION_LABEL", __version__),
    ):
        file.add_parameter(group, name, value)
    file.write(str(path))
