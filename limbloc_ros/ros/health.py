# SPDX-License-Identifier: Apache-2.0
"""How a node tells on `/diagnostics` how it is doing, and how it survives bad input.

diagnostic_updater does the first half on an apt ROS 2, but has no wheel.
"""

from __future__ import annotations

import ctypes
import statistics
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from limbloc_ros.core.errors import LimblocError
from limbloc_ros.ros import topics
from limbloc_ros.ros.messages import ERROR, OK, worst

PERIOD_S = 1.0
#: Rates are counted over this long, and a fault is shown and not logged again for this long.
WINDOW_S = 5.0
#: Longer without a message of a stream that should flow is worth a warning.
SILENT_S = 2.0
#: What a harder frame needed is given back to the system this often.
GIVE_BACK_S = 10.0


class Meter:
    """Rate and latency of a stream over the last seconds.

    Attributes:
        count: messages since the start.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._started = clock()
        self._ticks: deque[tuple[float, float]] = deque(maxlen=1000)
        self.count = 0

    def tick(self, latency_s: float = 0.0) -> None:
        """One message came or went, `latency_s` after its acquisition."""
        self.count += 1
        self._ticks.append((self._clock(), latency_s))

    def _recent(self) -> list[tuple[float, float]]:
        since = self._clock() - WINDOW_S
        return [tick for tick in self._ticks if tick[0] >= since]

    @property
    def rate_hz(self) -> float:
        """Messages per second."""
        recent = self._recent()
        span = recent[-1][0] - recent[0][0] if len(recent) > 1 else 0.0
        return (len(recent) - 1) / span if span > 0 else 0.0

    @property
    def latency_ms(self) -> float:
        """Median, ms; NaN when nothing came."""
        recent = self._recent()
        return 1e3 * statistics.median(latency for _, latency in recent) if recent else float("nan")

    @property
    def silence_s(self) -> float:
        """Seconds since the last message, or since the start."""
        return self._clock() - (self._ticks[-1][0] if self._ticks else self._started)


@dataclass
class _Fault:
    message: str
    count: int
    seen: float
    logged: float


def give_back_memory() -> None:
    """Return freed memory to the system, also from between blocks in use: without it a process only ever grows.

    The C library keeps what was freed (`environment` asks it to, for speed). Returning it takes below a millisecond.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:  # glibc has it, other C libraries do not
        trim(0)


class Health:
    """Publishes what `describe` says once a second, with the faults of the last seconds added to its first entry."""

    _gave_back_s = time.monotonic()  # of the process, not of the node

    def __init__(self, node: Node, describe: Callable[[], Sequence[DiagnosticStatus]]) -> None:
        self._node = node
        self._describe = describe
        self._faults: dict[str, _Fault] = {}
        self._levels: dict[str, bytes] = {}
        self._publisher = node.create_publisher(DiagnosticArray, topics.DIAGNOSTICS, topics.DIAGNOSTICS_QOS)
        self._timer = node.create_timer(PERIOD_S, self.publish, clock=Clock(clock_type=ClockType.STEADY_TIME))

    @contextmanager
    def guard(self, key: str) -> Iterator[None]:
        """Around a callback's work: errors that limbloc raises on purpose become faults, and the node goes on."""
        try:
            yield
        except LimblocError as error:
            self.fault(key, str(error))

    def fault(self, key: str, message: str) -> None:
        """Remember a fault for the diagnostics and log it, the same one at most every few seconds."""
        now = time.monotonic()
        fault = self._faults.setdefault(key, _Fault(message, 0, now, -WINDOW_S))
        fault.count += 1
        fault.seen = now
        if message != fault.message or now - fault.logged >= WINDOW_S:
            fault.message, fault.logged = message, now
            self._node.get_logger().error(f"{key}: {message}")

    def publish(self) -> None:
        """Publish now (also called by the timer)."""
        statuses = list(self._describe())
        for status in statuses:
            self._log_change(status)
        now = time.monotonic()
        recent = {key: fault for key, fault in self._faults.items() if now - fault.seen < WINDOW_S}
        if recent:
            first = statuses[0]
            first.level = worst([first.level, ERROR])
            first.message = "; ".join(f"{key}: {fault.message}" for key, fault in recent.items())
        if statuses:
            statuses[0].values += [
                KeyValue(key=f"errors of {key}", value=str(fault.count)) for key, fault in self._faults.items()
            ]
        msg = DiagnosticArray(status=statuses)
        msg.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(msg)
        if now - Health._gave_back_s >= GIVE_BACK_S:
            Health._gave_back_s = now
            give_back_memory()

    def _log_change(self, status: DiagnosticStatus) -> None:
        """Say it once when something becomes bad or good again; who watches only the console must see it too."""
        before = self._levels.get(status.name, OK)
        self._levels[status.name] = status.level
        if status.level == before:
            return
        log = self._node.get_logger()
        if status.level == OK:
            log.info(f"{status.name} is fine again: {status.message}")
        else:
            log.warning(f"{status.name}: {status.message}")

    def latency_s(self, stamp_ns: int) -> float:
        """Seconds from an acquisition stamp to now on the node's clock."""
        return float(self._node.get_clock().now().nanoseconds - stamp_ns) / 1e9
