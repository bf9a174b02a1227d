# SPDX-License-Identifier: Apache-2.0
"""Writing files so that they appear complete or not at all."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from limbloc_ros.core.errors import OutputError


@contextlib.contextmanager
def replaced(path: Path) -> Iterator[Path]:
    """A temporary name of the same suffix beside `path`, for the block to write; then it takes `path`'s place.

    Raises:
        OutputError: the folder cannot be made or written to, or the disk is full; what was at `path` is still there.
    """
    temporary = path.with_name(f".writing-{path.name}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        temporary.replace(path)
    except OSError as error:
        raise OutputError(
            f"{path} cannot be written: {error.strerror or error}; make room or choose another --out"
        ) from None
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
