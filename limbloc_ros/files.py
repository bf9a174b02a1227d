# SPDX-License-Identifier: Apache-2.0
"""Writing files so that they appear complete or not at all."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from limbloc_ros.core.errors import OutputError

#: What a person can do about a file that cannot be written.
ADVICE = "make room or choose another --out"


@contextlib.contextmanager
def replaced(path: Path, *, advice: str = ADVICE, durable: bool = False) -> Iterator[Path]:
    """A temporary name of the same suffix beside `path`, for the block to write; then it takes `path`'s place.

    Args:
        path: the file; its folder is made if need be.
        advice: ends the message of the error.
        durable: wait until the disk has the data, so that not even a power cut leaves half a file.

    Raises:
        OutputError: the folder cannot be made or written to, or the disk is full; what was at `path` is still there.
    """
    temporary = path.with_name(f".writing-{path.name}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        if durable:
            with temporary.open("rb") as file:
                os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {error.strerror or error}; {advice}") from None
    finally:
        with contextlib.suppress(OSError):  # the disk may be gone; the first error is the one to tell
            temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file in UTF-8; raises OutputError as `replaced`."""
    with replaced(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file; raises OutputError as `replaced`."""
    with replaced(path) as temporary:
        temporary.write_bytes(data)
