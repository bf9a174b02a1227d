# SPDX-License-Identifier: Apache-2.0
"""The calibration files of other tools, one module a format, and the table of them all."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from limbloc_ros.core.errors import RigError
from limbloc_ros.rig.formats import benchmark, easymocap, kalibr, multical, qualisys, ros, toml_cameras
from limbloc_ros.rig.formats.common import Format

#: Every format by name. The order is that of asking; the pickier ones first.
FORMATS: dict[str, Format] = {
    f.name: f
    for f in (
        qualisys.FORMAT,
        easymocap.FORMAT,
        kalibr.FORMAT,
        ros.FORMAT,
        multical.FORMAT,
        benchmark.FORMAT,
        toml_cameras.ANIPOSE,
        toml_cameras.CALISCOPE,
    )
}


def recognise(paths: Sequence[Path]) -> Format:
    """The format of calibration files.

    Raises:
        RigError: a file is missing, or of no or of several formats.
    """
    for path in paths:
        if not path.exists():
            raise RigError(f"{path} does not exist; expected a calibration file")
    fits = [f for f in FORMATS.values() if all(f.recognises(path, _beginning(path)) for path in paths)]
    if len(fits) == 1:
        return fits[0]
    known = "; ".join(f"{f.name}: {f.title}" for f in FORMATS.values())
    names = ", ".join(map(str, paths))
    what = f"may be {' or '.join(f.name for f in fits)}" if fits else "is of no format that limbloc reads"
    raise RigError(f"{names} {what}; say --format ({known})")


def _beginning(path: Path) -> str:
    if path.is_dir():
        return ""
    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            return file.read(4000)
    except OSError as error:
        raise RigError(f"{path} cannot be read: {error.strerror}") from None
