# SPDX-License-Identifier: Apache-2.0
"""What processes hold: resident memory, threads, open files, shared memory."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Footprint:
    """Sums over processes.

    Attributes:
        rss_mb: resident memory without what is shared through files and shared memory segments, MB.
        threads, files: threads and open file descriptors.
        segments: files in /dev/shm on this machine.
    """

    rss_mb: float
    threads: int
    files: int
    segments: int


def footprint(pids: Mapping[str, int]) -> Footprint:
    """What these processes hold now; those that have ended meanwhile count nothing."""
    rss = threads = files = 0
    for pid in pids.values():
        try:
            status = Path(f"/proc/{pid}/status").read_text().splitlines()
            files += len(list(Path(f"/proc/{pid}/fd").iterdir()))
        except (FileNotFoundError, ProcessLookupError):
            continue
        values = {line.split(":")[0]: line.split()[1] for line in status if line.startswith(("RssAnon", "Threads"))}
        rss += int(values["RssAnon"])
        threads += int(values["Threads"])
    return Footprint(round(rss / 1024, 1), threads, files, len(list(Path("/dev/shm").iterdir())))
