# SPDX-License-Identifier: Apache-2.0
"""A camera's learned background as a file, so that a process that starts again need not learn it anew.

It would learn whoever stands in the room by then as part of the room.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from limbloc_ros.core.background import BackgroundModel
from limbloc_ros.core.errors import InputError
from limbloc_ros.files import replaced
from limbloc_ros.recordings.npz_file import read_npz


def save_background(model: BackgroundModel, path: Path) -> None:
    """Write what the model has learned; the file appears complete or not at all. Nothing if it still learns.

    Raises:
        OutputError: the disk is full or the folder not writable.
    """
    state = model.state()
    if state is not None:
        with replaced(path) as temporary:
            np.savez(temporary, **state)  # type: ignore[arg-type]


def load_background(model: BackgroundModel, path: Path) -> None:
    """Have the model go on from what `save_background` wrote.

    Raises:
        InputError: the file is damaged, or of another image size or version.
    """
    try:
        model.restore(read_npz(path))
    except InputError as error:
        raise InputError(f"{path}: {error}; the background is learned anew") from None
