# SPDX-License-Identifier: Apache-2.0
"""Topics -> rosbag2 recording (MCAP or sqlite3), as raw CDR; topics are found while they appear."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from limbloc_ros.core.config import setting
from limbloc_ros.core.errors import InputError, OutputError
from limbloc_ros.recordings.bags import BagWriter
from limbloc_ros.ros import node_main
from limbloc_ros.ros.parameters import NodeParameters
from limbloc_ros.ros.raw_messages import message_class
from limbloc_ros.ros.topics import patterns

DISCOVERY_PERIOD_S = 0.5

#: Recorded when no topics are given, besides the cameras' images.
DEFAULT_TOPICS = (
    r".*/camera_info",
    r".*/mask/compressed",
    r".*/(true_)?joints(_\d+)?",
    r".*/joint_angles",
    r".*/humans/bodies/[^/]+/(joint_states|urdf)",
    r"/diagnostics",
    r"/tf(_static)?",
)
IMAGE_TOPICS = {"raw": r".*/image_raw", "compressed": r".*/image_raw/compressed"}


@dataclass(frozen=True)
class RecordSettings:
    """What is recorded, and where."""

    bag: str = setting("", "folder to make; empty: limbloc_<date>_<time> in the working folder")
    storage: str = setting("mcap", "file format; mcap survives accidents best", choices=("mcap", "sqlite3"))
    topics: tuple[str, ...] = setting(
        (), "names or regular expressions of topics; empty: cameras, masks, joints, joint states, diagnostics"
    )
    exclude: tuple[str, ...] = setting((), "names or regular expressions of topics that are left out all the same")
    images: str = setting(
        "auto",
        "which of the cameras' images the default selection takes; auto: compressed where a camera has them, else raw "
        "(eight raw 640x480 cameras at 30 Hz are 220 MB/s)",
        choices=("auto", "raw", "compressed", "none"),
    )
    duration_s: float = setting(0.0, "end by itself after this (0: until stopped)", unit="s", low=0.0, high=1e6)
    if_exists: str = setting(
        "refuse",
        "what to do when the folder is there: refuse, or make the next one, NAME_2, NAME_3, ... (a recorder that died "
        "and is started again)",
        choices=("refuse", "next"),
    )


class RecordNode(Node):
    """Records until it is destroyed, the time is over or the disk is full.

    Attributes:
        done: set when it has ended by itself.
        error: why recording failed; None otherwise.
        writer: the bag, with counts by topic.

    Raises:
        OutputError: the folder exists or cannot be made.
        ConfigError: a topic pattern is no regular expression.
    """

    def __init__(self, node_name: str = "record", **node_options: Any) -> None:
        super().__init__(node_name, **node_options)
        self.settings = NodeParameters(self).declare(RecordSettings)
        s = self.settings
        default = (*DEFAULT_TOPICS, *self._image_patterns())
        self._include = patterns("topics", s.topics or default)
        self._exclude = patterns("exclude", s.exclude)
        self.done = threading.Event()
        self.error: str | None = None
        self._subscriptions_by_topic: dict[str, Any] = {}
        self._seen: dict[str, int] = {}
        self._refused: set[str] = set()
        self.path = Path(s.bag or datetime.now().strftime("limbloc_%Y%m%d_%H%M%S"))
        if s.if_exists == "next":
            self.path = next_free(self.path)
        self.writer = BagWriter(self.path, s.storage)
        self._started = time.monotonic()
        self._times: dict[str, tuple[float, float]] = {}
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._discovery = self.create_timer(DISCOVERY_PERIOD_S, self.discover, clock=steady)
        self.get_logger().info(f"recording to {self.path}")
        self.discover()

    def destroy_node(self) -> None:
        """Finish the bag and destroy the node."""
        self.finish()
        super().destroy_node()

    def finish(self) -> None:
        """Close the bag; what is missing then is told in `error`."""
        self._discovery.cancel()
        try:
            self.writer.close()
        except OutputError as error:
            self._fail(error)

    def summary(self) -> str:
        """What was recorded, as a table for people."""
        total = sum(self.writer.counts.values())
        lines = [f"recorded {total} messages, {self.writer.bytes_written / 2**20:.1f} MB, in {self.path}:"]
        if not total:
            lines.append("  nothing: no such topic was published. `ros2 topic list` shows what there is")
        for name, count in sorted(self.writer.counts.items()):
            first, last = self._times.get(name, (0.0, 0.0))
            rate = f"{(count - 1) / (last - first):7.1f} Hz" if last > first else " " * 10
            lines.append(f"  {count:8d}  {rate}  {name}")
        return "\n".join(lines)

    def discover(self) -> None:
        """Subscribe to wanted topics that are new; called again and again."""
        if self.settings.duration_s and time.monotonic() - self._started >= self.settings.duration_s:
            self.finish()
            self.done.set()
            return
        for name, kinds in self.get_topic_names_and_types():
            if name in self._subscriptions_by_topic or name in self._refused or not self._wanted(name):
                continue
            # A publisher's second topic (raw and compressed) appears a moment later: decide at the next look.
            self._seen[name] = self._seen.get(name, 0) + 1
            publishers = self.get_publishers_info_by_topic(name)
            if publishers and (self.settings.topics or self._seen[name] > 1) and not self._has_compressed_twin(name):
                self._subscribe(name, kinds[0], publishers)

    def _wanted(self, name: str) -> bool:
        return any(p.fullmatch(name) for p in self._include) and not any(p.fullmatch(name) for p in self._exclude)

    def _image_patterns(self) -> tuple[str, ...]:
        images = self.settings.images
        if images == "auto":
            return tuple(IMAGE_TOPICS.values())
        return (IMAGE_TOPICS[images],) if images != "none" else ()

    def _has_compressed_twin(self, name: str) -> bool:
        """Whether this is a raw image that is also published compressed, and the default selection may choose."""
        automatic = not self.settings.topics and self.settings.images == "auto" and name.endswith("/image_raw")
        return automatic and self.count_publishers(f"{name}/compressed") > 0

    def _subscribe(self, name: str, kind: str, publishers: list[Any]) -> None:
        reliable = all(p.qos_profile.reliability == ReliabilityPolicy.RELIABLE for p in publishers)
        latched = all(p.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for p in publishers)
        try:
            message_type = message_class(kind)
            self.writer.add_topic(name, kind, reliable=reliable, latched=latched)
        except InputError as error:
            self._refused.add(name)
            self.get_logger().error(str(error))
            return
        qos = QoSProfile(
            history=HistoryPolicy.KEEP_LAST,
            depth=100 if latched else 30,
            reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        )
        self._subscriptions_by_topic[name] = self.create_subscription(
            message_type, name, self._make_callback(name), qos, raw=True
        )
        self.get_logger().info(f"recording {name}")

    def _make_callback(self, name: str) -> Callable[[bytes], None]:
        def write(cdr: bytes) -> None:
            if self.writer.closed:
                return
            try:
                self.writer.write(name, self.get_clock().now().nanoseconds, cdr)
            except OutputError as error:
                self._fail(error)
                return
            now = time.monotonic()
            self._times[name] = (self._times.get(name, (now,))[0], now)

        return write

    def _fail(self, error: OutputError) -> None:
        self.error = str(error)
        self.get_logger().fatal(self.error)
        self.done.set()


def next_free(path: Path) -> Path:
    """The path itself, or with _2, _3, ... behind it the first that is not there."""
    number, free = 1, path
    while free.exists():
        number += 1
        free = path.with_name(f"{path.name}_{number}")
    return free


def main() -> int:
    """Record until Ctrl-C, SIGTERM, the end of `duration_s` or of the disk; then say what was recorded."""
    made: list[RecordNode] = []

    def make() -> RecordNode:
        made.append(RecordNode())
        return made[0]

    code = node_main.main(make, until=lambda: made[0].done.is_set())
    if made:
        print(made[0].summary(), flush=True)
    return 1 if made and made[0].error else code


if __name__ == "__main__":
    raise SystemExit(main())
