# SPDX-License-Identifier: Apache-2.0
"""What processes hold: resident memory, threads, open files, shared memory."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

SHARED = Path("/dev/shm")


@dataclass(frozen=True)
class Footprint:
    """Sums over processes.

    Attributes:
        rss_mb: resident memory without mapped files and shared memory, MB.
        threads, files: threads and open file descriptors.
        segments: names of the files in /dev/shm that they have mapped.
    """

    rss_mb: float
    threads: int
    files: int
    segments: frozenset[str]


def footprint(pids: Mapping[str, int]) -> Footprint:
    """What these processes hold now; those that have ended meanwhile count nothing."""
    rss = threads = files = 0
    segments: set[str] = set()
    for pid in pids.values():
        try:
            status = Path(f"/proc/{pid}/status").read_text().splitlines()
            files += len(list(Path(f"/proc/{pid}/fd").iterdir()))
            maps = Path(f"/proc/{pid}/maps").read_text()
        except (FileNotFoundError, ProcessLookupError):
            continue
        values = {line.split(":")[0]: line.split()[1] for line in status if line.startswith(("RssAnon", "Threads"))}
        segments |= {word.split("/dev/shm/")[1] for word in maps.split() if word.startswith("/dev/shm/")}
        rss += int(values["RssAnon"])
        threads += int(values["Threads"])
    return Footprint(round(rss / 1024, 1), threads, files, frozenset(segments))


def left_behind(segments: frozenset[str]) -> list[str]:
    """Those of the shared memory files that still exist."""
    return sorted(name for name in segments if (SHARED / name).exists())
