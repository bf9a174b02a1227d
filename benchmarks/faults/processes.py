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
        rss_mb: resident memory without mapped files and shared memory, MB; `each_mb` of each process, by name.
        threads, files: threads and open file descriptors.
        segments: names of the files in /dev/shm that they have mapped.
    """

    rss_mb: float
    threads: int
    files: int
    segments: frozenset[str]
    each_mb: dict[str, float]


def footprint(pids: Mapping[str, int]) -> Footprint:
    """What these processes hold now; those that have ended meanwhile count nothing."""
    threads = files = 0
    each: dict[str, float] = {}
    segments: set[str] = set()
    for name, pid in pids.items():
        try:
            status = Path(f"/proc/{pid}/status").read_text().splitlines()
            files += len(list(Path(f"/proc/{pid}/fd").iterdir()))
            maps = Path(f"/proc/{pid}/maps").read_text()
        except (FileNotFoundError, ProcessLookupError):
            continue
        values = {line.split(":")[0]: line.split()[1] for line in status if line.startswith(("RssAnon", "Threads"))}
        segments |= {word.split("/dev/shm/")[1] for word in maps.split() if word.startswith("/dev/shm/")}
        each[name] = round(int(values["RssAnon"]) / 1024, 1)
        threads += int(values["Threads"])
    return Footprint(round(sum(each.values()), 1), threads, files, frozenset(segments), each)


def left_behind(segments: frozenset[str]) -> list[str]:
    """Those of the shared memory segments of DDS that still exist though no process uses them any more.

    Its port files have numbers for names and are used again by whoever comes next: they do not count.
    """
    there = {n for n in segments if n.startswith("fast") and "_port" not in n and (SHARED / n).exists()}
    for process in Path("/proc").iterdir():
        if process.name.isdecimal() and there:
            try:
                maps = (process / "maps").read_text()
            except OSError:
                continue  # it has ended
            there -= {name for name in there if f"{SHARED}/{name}\n" in maps}
    return sorted(there)
