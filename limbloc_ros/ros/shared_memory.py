# SPDX-License-Identifier: Apache-2.0
"""Removes the shared memory of DDS processes that were killed: nobody else does, and each leaves up to 16 MB.

Fast DDS gives every participant a segment, `/dev/shm/fastrtps_<16 hex digits>`, and an empty file beside it with the
same name and `_el`, which the process keeps locked as long as it lives. `fastdds shm clean` goes by the same lock.
"""

from __future__ import annotations

import fcntl
import os
import re
import time
from pathlib import Path

FOLDER = Path("/dev/shm")
#: A lock file so young, s, may be one that its process has made but not locked yet.
YOUNG_S = 1.0

_LOCK = re.compile(r"fastrtps_[0-9a-f]{16}_el")


def remove_abandoned(folder: Path = FOLDER) -> int:
    """Remove all segments in `folder` whose process is gone, save for those of other users.

    Returns:
        bytes of memory that this gave back.
    """
    freed = 0
    for lock in folder.iterdir() if folder.is_dir() else ():
        if not _LOCK.fullmatch(lock.name):
            continue
        segment = lock.with_name(lock.name.removesuffix("_el"))
        try:
            if time.time() - lock.stat().st_mtime < YOUNG_S or _is_locked(lock):
                continue
            size = segment.stat().st_blocks * 512 if segment.exists() else 0
            segment.unlink(missing_ok=True)
            lock.unlink()
        except (FileNotFoundError, PermissionError):
            continue  # somebody else was faster, or it is somebody else's
        freed += size
    return freed


def _is_locked(path: Path) -> bool:
    file = os.open(path, os.O_RDONLY)
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(file)
    return False
