# SPDX-License-Identifier: Apache-2.0
"""Frames of several cameras -> sets of one instant, by acquisition stamp.

Pure logic without a clock of its own: the live carving node, the stepped replay and the offline run of a bag use it
alike, and get the same sets from the same frames. It relies on what DDS and bags guarantee: frames of one camera come
in the order of their stamps. The order between cameras is free.

When is a set finished? As soon as every camera is in it, or every missing one has already sent something newer (then
it dropped that frame and waiting is useless), or has been silent for `silent_sets` sets (a dead camera must not delay
the others), or the timeout ran out (`tick`), or more than `queue` sets wait. Sets leave in the order of their stamps;
what comes after its set has left is counted as late, never mixed into another one.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from limbloc_ros.core.config import SyncConfig
from limbloc_ros.core.errors import ConfigError, InputError

T = TypeVar("T")

NANOSECONDS = 1_000_000_000

#: A camera's stamp that falls back by more than this is a jump in time (a looped bag, a reset clock), not disorder.
JUMP_S = 0.5


@dataclass(frozen=True)
class FrameSet(Generic[T]):
    """Frames of one instant.

    Attributes:
        stamp_ns: the earliest acquisition stamp in the set, ns.
        items: what was added, by camera name in the order of the synchroniser's names.
        missing: the cameras that are not in the set.
        skew_ns: latest minus earliest stamp, ns.
    """

    stamp_ns: int
    items: dict[str, T]
    missing: tuple[str, ...]
    skew_ns: int


@dataclass
class SyncCounters:
    """What happened so far, for `/diagnostics`. Each frame received ends in a set or in one of the losses below.

    Attributes:
        complete: sets with all cameras. incomplete: sets handed on without some. dropped: sets with fewer than
            `min_cameras`, thrown away.
        received, missing, late, duplicate: by camera: frames added; sets handed on or dropped without it; frames
            that came after their set had left (or from before a jump in time, or the first one of a camera that comes
            back from silence); frames with a stamp the camera had sent already.
        resets: jumps back in time. skipped: sets thrown away by `skip_until`.
    """

    complete: int = 0
    incomplete: int = 0
    dropped: int = 0
    resets: int = 0
    skipped: int = 0
    received: dict[str, int] = field(default_factory=dict)
    missing: dict[str, int] = field(default_factory=dict)
    late: dict[str, int] = field(default_factory=dict)
    duplicate: dict[str, int] = field(default_factory=dict)


@dataclass
class _OpenSet(Generic[T]):
    """A set that still waits; `opened_ns` is on the caller's steady clock, None until the first tick sees it."""

    low_ns: int
    high_ns: int
    opened_ns: int | None
    items: dict[str, T]


@dataclass
class _Stream:
    """What is known of one camera."""

    last_ns: int | None = None
    missed: int = 0
    stale_allowed: int = 0


class StampSynchroniser(Generic[T]):
    """Groups frames by stamp; see the module's text for the rules.

    Args:
        names: the cameras, unique.
        slop_s: largest stamp difference within a set, s.
        queue: sets that may wait.
        min_cameras: smaller sets are dropped.
        timeout_s: an incomplete set leaves after this, s, counted on the clock that the caller passes to `tick`.
        silent_sets: a camera missing in this many sets running is no longer waited for. Its first frame after that
            only wakes it up and is not used, so that the outcome does not depend on who came first. 0: always wait.

    Raises:
        ConfigError: names empty or not unique, or a bound violated.
    """

    def __init__(
        self,
        names: Sequence[str],
        slop_s: float = 0.02,
        queue: int = 10,
        min_cameras: int = 2,
        timeout_s: float = 0.15,
        silent_sets: int = 5,
    ) -> None:
        if not names or len(set(names)) != len(names):
            raise ConfigError(f"a synchroniser needs unique camera names, got {list(names)}")
        for label, value, low in (("slop_s", slop_s, 0.0), ("queue", queue, 1), ("min_cameras", min_cameras, 1),
                                  ("timeout_s", timeout_s, 0.0), ("silent_sets", silent_sets, 0)):  # fmt: skip
            if not value >= low:
                raise ConfigError(f"{label}: expected at least {low}, got {value}")
        self.names = tuple(names)
        self.queue = queue
        self.min_cameras = min_cameras
        self.silent_sets = silent_sets
        self.slop_s = slop_s
        self.timeout_s = timeout_s
        self.counters = SyncCounters()
        for by_camera in (c for c in vars(self.counters).values() if isinstance(c, dict)):
            by_camera.update(dict.fromkeys(self.names, 0))
        self._open: list[_OpenSet[T]] = []
        self._streams = {name: _Stream() for name in self.names}
        self._left_ns: int | None = None  # the latest stamp in the newest set that has left
        self._left_low_ns = 0
        self._left_names: frozenset[str] = frozenset()

    @classmethod
    def from_config(cls, names: Sequence[str], config: SyncConfig, min_cameras: int) -> StampSynchroniser[T]:
        """Build it from the shared parameters."""
        return cls(names, min_cameras=min_cameras, **dataclasses.asdict(config))

    @property
    def waiting(self) -> int:
        """Sets that still wait for cameras."""
        return len(self._open)

    @property
    def silent(self) -> tuple[str, ...]:
        """Cameras that sets no longer wait for."""
        return tuple(name for name in self.names if self._is_silent(self._streams[name]))

    def add(self, name: str, stamp_ns: int, item: T, now_ns: int | None = None) -> list[FrameSet[T]]:
        """Take one frame; returns the sets that are now finished, in the order of their stamps.

        Args:
            name: the camera.
            stamp_ns: acquisition stamp, ns.
            item: kept as it is.
            now_ns: the caller's steady clock, ns; without it a set's timeout starts at the next tick.

        Raises:
            InputError: an unknown camera.
        """
        if name not in self._streams:
            raise InputError(f"no camera is called {name!r}; expected one of {', '.join(self.names)}")
        stream, slop_ns = self._streams[name], round(self.slop_s * NANOSECONDS)
        self.counters.received[name] += 1
        finished: list[FrameSet[T]] = []

        jump_ns = round(JUMP_S * NANOSECONDS)
        if stream.last_ns is not None and stamp_ns < stream.last_ns - jump_ns:
            if stream.stale_allowed:  # another camera told us of this jump already
                stream.stale_allowed, stream.last_ns = 0, None
            else:
                finished += self._jump(name, stamp_ns, jump_ns)
        elif stream.stale_allowed and stream.last_ns is not None and stamp_ns >= stream.last_ns:
            # Frames from before the jump that were still on their way. If they go on, only that one clock jumped.
            stream.stale_allowed -= 1
            self.counters.late[name] += 1
            return finished
        if stamp_ns == stream.last_ns:
            self.counters.duplicate[name] += 1
            return finished

        was_silent = self._would_be_silent(stream, stamp_ns, name)
        stream.last_ns = stamp_ns if stream.last_ns is None else max(stream.last_ns, stamp_ns)
        stream.missed = 0
        if was_silent or self._is_late(name, stamp_ns, slop_ns):
            self.counters.late[name] += 1
        else:
            self._place(name, stamp_ns, item, now_ns, slop_ns)
        return finished + self._finish(None)

    def tick(self, now_ns: int) -> list[FrameSet[T]]:
        """Let incomplete sets go that have waited for `timeout_s` on the caller's steady clock (call it regularly)."""
        for open_set in self._open:
            if open_set.opened_ns is None:
                open_set.opened_ns = now_ns
        return self._finish(now_ns)

    def flush(self) -> list[FrameSet[T]]:
        """Let all waiting sets go, in order (the end of a recording)."""
        finished = []
        while self._open:
            finished += self._leave()
        return finished

    def skip_until(self, stamp_ns: int) -> None:
        """Some cameras left out their frames up to this stamp (ns): drop waiting sets up to it, and later arrivals."""
        if self._left_ns is not None and stamp_ns <= self._left_ns:
            return
        kept = [s for s in self._open if s.low_ns > stamp_ns]
        self.counters.skipped += len(self._open) - len(kept)
        self._open = kept
        self._left_ns, self._left_low_ns, self._left_names = stamp_ns, stamp_ns, frozenset(self.names)

    def reset(self) -> None:
        """Forget all waiting sets and the cameras' last stamps; the counters stay."""
        self._open.clear()
        self._left_ns, self._left_names = None, frozenset()
        self._streams = {name: _Stream() for name in self.names}

    def _is_silent(self, stream: _Stream) -> bool:
        return 0 < self.silent_sets <= stream.missed

    def _would_be_silent(self, stream: _Stream, stamp_ns: int, name: str) -> bool:
        """Whether the camera was silent before this frame, counting also older sets that still wait.

        Counted by stamps, not by what has left, so that it comes out alike live and offline.
        """
        older = sum(1 for s in self._open if s.high_ns < stamp_ns and name not in s.items)
        return 0 < self.silent_sets <= stream.missed + older

    def _is_late(self, name: str, stamp_ns: int, slop_ns: int) -> bool:
        if self._left_ns is None:
            return False
        return stamp_ns <= self._left_ns or (name not in self._left_names and stamp_ns - self._left_low_ns <= slop_ns)

    def _jump(self, name: str, stamp_ns: int, jump_ns: int) -> list[FrameSet[T]]:
        """Finish what waits from before the jump and start anew at `stamp_ns`."""
        finished = self.flush()
        self.counters.resets += 1
        self._left_ns, self._left_names = None, frozenset()
        for other, stream in self._streams.items():
            stream.missed = 0
            if other == name or stream.last_ns is None or stream.last_ns <= stamp_ns + jump_ns:
                stream.last_ns, stream.stale_allowed = None, 0
            else:
                stream.stale_allowed = self.queue
        return finished

    def _place(self, name: str, stamp_ns: int, item: T, now_ns: int | None, slop_ns: int) -> None:
        """Put the frame into the nearest open set that has room for it, or open one."""
        best: _OpenSet[T] | None = None
        best_distance = 0
        for candidate in self._open:
            span = max(candidate.high_ns, stamp_ns) - min(candidate.low_ns, stamp_ns)
            distance = abs(stamp_ns - candidate.low_ns)
            if name not in candidate.items and span <= slop_ns and (best is None or distance < best_distance):
                best, best_distance = candidate, distance
        if best is None:
            self._open.append(_OpenSet(stamp_ns, stamp_ns, now_ns, {name: item}))
        else:
            best.items[name] = item
            best.low_ns, best.high_ns = min(best.low_ns, stamp_ns), max(best.high_ns, stamp_ns)
        self._open.sort(key=lambda s: s.low_ns)

    def _is_finished(self, open_set: _OpenSet[T]) -> bool:
        for name in self.names:
            stream = self._streams[name]
            passed = stream.last_ns is not None and not stream.stale_allowed and stream.last_ns >= open_set.low_ns
            if name not in open_set.items and not passed and not self._is_silent(stream):
                return False
        return True

    def _finish(self, now_ns: int | None) -> list[FrameSet[T]]:
        """Let go every set that is finished, has timed out or does not fit the queue, and all older ones before it."""
        finished: list[FrameSet[T]] = []
        timeout_ns = round(self.timeout_s * NANOSECONDS)
        while self._open:
            last = -1
            for index, open_set in enumerate(self._open):
                timed_out = (
                    now_ns is not None and open_set.opened_ns is not None and now_ns - open_set.opened_ns >= timeout_ns
                )
                if timed_out or self._is_finished(open_set):
                    last = index
            if last < 0 and len(self._open) <= self.queue:
                break
            for _ in range(max(last + 1, 1)):
                finished += self._leave()
        return finished

    def _leave(self) -> list[FrameSet[T]]:
        """Take the oldest set out, count it, and hand it on if it has enough cameras."""
        oldest = self._open.pop(0)
        missing = tuple(name for name in self.names if name not in oldest.items)
        for name in missing:
            self.counters.missing[name] += 1
            stream = self._streams[name]
            if stream.last_ns is None or stream.last_ns < oldest.low_ns:
                stream.missed += 1
        self._left_ns, self._left_low_ns = oldest.high_ns, oldest.low_ns
        self._left_names = frozenset(oldest.items)
        if len(oldest.items) < self.min_cameras:
            self.counters.dropped += 1
            return []
        if missing:
            self.counters.incomplete += 1
        else:
            self.counters.complete += 1
        items = {name: oldest.items[name] for name in self.names if name in oldest.items}
        return [FrameSet(oldest.low_ns, items, missing, oldest.high_ns - oldest.low_ns)]
