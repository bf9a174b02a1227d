# SPDX-License-Identifier: Apache-2.0
"""Messages that wait for a node's work, where the node can see how many there are.

A callback that works at once leaves the newer messages in the middleware's queue, which drops the oldest without a
word. Here callbacks only put messages by, and the work is done when the executor has nothing newer: a slow moment is
ridden over and caught up with, and when the node stays behind it skips what waits, counts it, and can say so.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from limbloc_ros.core.synchroniser import JUMP_S
from limbloc_ros.ros.health import WINDOW_S
from limbloc_ros.ros.messages import NANOSECONDS

T = TypeVar("T")

#: Who has skipped something is held to be too slow for good for so long, by stamps, s.
SLOW_FOR_S = 10.0
#: The work's timer fires as soon as the executor is free. (The events executor knows no guard conditions.)
_AT_ONCE_S = 1e-6


class Backlog(Generic[T]):
    """Items in the order of their stamps, worked off one by one by the node's executor.

    Args:
        node: whose executor does the work.
        work: gets each item.
        longest_s: how far, in acquisition stamps, the oldest waiting item may lie behind the newest. Beyond this all
            but the newest are skipped: what is late anyway shall not make the next frames late as well.
        on_skip: told the newest stamp (ns) that was skipped.
        again_s: for SLOW_FOR_S after that, how far it may lie behind before every second item that waits is skipped: a
            machine that is too slow for good shall give fewer results, not later ones, and evenly. None: as ever.

    Attributes:
        skipped: items that were thrown away.
    """

    def __init__(
        self,
        node: Node,
        work: Callable[[T], None],
        longest_s: float,
        on_skip: Callable[[int], None] | None = None,
        again_s: float | None = None,
    ) -> None:
        self.longest_s, self.again_s = longest_s, again_s
        self.skipped = 0
        self._skipped_s = -WINDOW_S
        self._work = work
        self._on_skip = on_skip
        self._items: deque[tuple[int, T]] = deque()
        self._skip_until_ns: int | None = None
        self._last_ns: int | None = None
        self._slow_ns: int | None = None
        self._wake = node.create_timer(_AT_ONCE_S, self._on_wake, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._wake.cancel()

    def __len__(self) -> int:
        return len(self._items)

    @property
    def behind(self) -> str:
        """For the diagnostics: that items were skipped in the last seconds; empty when not."""
        if time.monotonic() - self._skipped_s > WINDOW_S:
            return ""
        return f"the machine is too slow: {self.skipped} frames skipped since the start"

    def add(self, stamp_ns: int, item: T) -> None:
        """Put an item by until the executor is free."""
        if self._last_ns is not None and stamp_ns < self._last_ns - JUMP_S * NANOSECONDS:
            self._skip_until_ns = None  # a jump back in time: what was skipped there says nothing of the new time
        self._last_ns = stamp_ns
        if self._skip_until_ns is not None and stamp_ns <= self._skip_until_ns:
            self._count(1)
            return
        self._items.append((stamp_ns, item))
        late_s = (stamp_ns - self._items[0][0]) / NANOSECONDS
        if late_s > self.longest_s and len(self._items) > 1:
            self._slow_ns = stamp_ns
            until = self._items[-2][0]
            self.skip_until(until)
            if self._on_skip is not None:
                self._on_skip(until)
        elif self.again_s is not None and late_s > self.again_s and self._is_slow(stamp_ns):
            self._slow_ns = stamp_ns
            kept = list(self._items)[::-2][::-1]  # with the newest
            self._count(len(self._items) - len(kept))
            self._items = deque(kept)
        if len(self._items) == 1:
            self._wake.reset()

    def _is_slow(self, stamp_ns: int) -> bool:
        return self._slow_ns is not None and 0 <= stamp_ns - self._slow_ns < SLOW_FOR_S * NANOSECONDS

    def skip_until(self, stamp_ns: int) -> None:
        """Throw away what waits with this stamp (ns) or an older one, and what comes with one later."""
        self._skip_until_ns = stamp_ns
        kept = [(stamp, item) for stamp, item in self._items if stamp > stamp_ns]
        self._count(len(self._items) - len(kept))
        self._items = deque(kept)

    def left_out(self) -> None:
        """An item was not even put by."""
        self._count(1)

    def clear(self) -> None:
        """Forget what waits."""
        self._items.clear()

    def _count(self, skipped: int) -> None:
        if skipped:
            self.skipped += skipped
            self._skipped_s = time.monotonic()

    def _on_wake(self) -> None:
        self._wake.cancel()
        if self._items:
            _, item = self._items.popleft()
            self._work(item)
        if self._items:
            self._wake.reset()


class Thinning:
    """Which instants all cameras leave out while some camera's process cannot keep up.

    Skipping what waits tears the sets when many cameras do it at different moments: each keeps other instants, and a
    set wants all. So all agree on a rate: they hear the same announcements of skipped frames, and each one raises the
    step, once a second at most; of every interval of the step only the first image is taken, and none when that one was
    lost on its way. All is counted by stamps, which are the same for all cameras. After a while without announcements
    the step falls again.
    """

    #: Shortest interval, s; each step doubles it.
    SHORTEST_S = 1 / 32
    STEPS = 6
    #: By stamps: between two steps up, and without announcements before a step down, s.
    UP_S, DOWN_S = 1.0, 20.0
    #: The camera's period is the shortest between so many last images; the first of an interval comes within it.
    REMEMBERED = 30

    def __init__(self) -> None:
        self._step = 0
        self._stepped_ns = self._heard_ns = 0
        self._interval = -1
        self._last_ns = 0
        self._periods_ns: deque[int] = deque(maxlen=self.REMEMBERED)

    @property
    def rate_hz(self) -> float:
        """Images a second that are taken at most; infinite when none is left out."""
        return float("inf") if self._step == 0 else 1 / (self.SHORTEST_S * 2.0 ** (self._step - 1))

    def announced(self, stamp_ns: int) -> None:
        """Some camera skipped its frames up to this stamp."""
        if self._step == 0 or abs(stamp_ns - self._stepped_ns) >= self.UP_S * NANOSECONDS:
            self._step, self._stepped_ns = min(self._step + 1, self.STEPS), stamp_ns
        self._heard_ns = stamp_ns

    def takes(self, stamp_ns: int) -> bool:
        """Whether an image is to be worked on."""
        if stamp_ns > self._last_ns:
            self._periods_ns.append(stamp_ns - self._last_ns)
        self._last_ns = stamp_ns
        if self._step and abs(stamp_ns - self._heard_ns) > self.DOWN_S * NANOSECONDS:
            self._step, self._heard_ns = self._step - 1, stamp_ns
        if self._step == 0:
            return True
        rate_hz = self.rate_hz  # a power of two: products with it are exact
        before, self._interval = self._interval, int(stamp_ns * rate_hz) // NANOSECONDS
        since_ns = stamp_ns - int(self._interval * NANOSECONDS / rate_hz)
        return self._interval != before and since_ns < min(self._periods_ns, default=NANOSECONDS)
