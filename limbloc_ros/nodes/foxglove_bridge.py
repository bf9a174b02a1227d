# SPDX-License-Identifier: Apache-2.0
"""The running graph in Foxglove: topics -> a websocket, as the CDR bytes they are, with their ros2msg definitions.

A topic is subscribed only while somebody looks at it, so that nobody pays for hull and images that are not shown.
Needs the extra `foxglove` (foxglove-sdk); open ws://<host>:<port> in Foxglove, with config/limbloc.foxglove.json.
"""

from __future__ import annotations

import re
import threading
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from limbloc_ros.core.config import setting
from limbloc_ros.core.errors import ConfigError, InputError
from limbloc_ros.recordings.bags import TYPESTORE
from limbloc_ros.ros import node_main
from limbloc_ros.ros.parameters import NodeParameters
from limbloc_ros.ros.raw_messages import message_class
from limbloc_ros.ros.topics import patterns

DISCOVERY_PERIOD_S = 0.5
#: Interest of viewers comes from the server's own thread and is acted on this often.
INTEREST_PERIOD_S = 0.05
#: Latched messages that are kept for viewers who come later (tf_static has a publisher in many nodes).
LATCHED_KEPT = 100
#: Topics of ROS itself that no viewer wants.
HIDDEN = r".*/(parameter_events|rosout)"


@dataclass(frozen=True)
class FoxgloveSettings:
    """Who may look, and at what."""

    port: int = setting(8765, "TCP port of the websocket; 0: any that is free", low=0, high=65535)
    host: str = setting(
        "127.0.0.1", "address that is listened on: this machine only, or 0.0.0.0 for everybody in the network"
    )
    topics: tuple[str, ...] = setting((), "names or regular expressions of topics; empty: all")
    exclude: tuple[str, ...] = setting((), "names or regular expressions of topics that are left out all the same")


class FoxgloveBridge(Node):
    """Serves the graph's topics to Foxglove until it is destroyed.

    Attributes:
        port: on which it listens.

    Raises:
        ConfigError: the library is missing, a topic pattern is no regular expression, or the port is taken.
    """

    def __init__(self, node_name: str = "foxglove_bridge", **node_options: Any) -> None:
        super().__init__(node_name, **node_options)
        try:
            import foxglove
        except ModuleNotFoundError:
            raise ConfigError(
                "the Foxglove bridge needs foxglove-sdk; install it with `pip install 'limbloc_ros[foxglove]'`"
            ) from None
        self._foxglove = foxglove
        self.settings = NodeParameters(self).declare(FoxgloveSettings)
        s = self.settings
        self._include, self._exclude = patterns("topics", s.topics or (".*",)), patterns("exclude", s.exclude)
        self._hidden = re.compile(HIDDEN)
        self._topics: dict[str, _Topic] = {}
        self._refused: set[str] = set()
        self._interest = _Interest()
        self._served = foxglove.Context()
        try:
            self._server = foxglove.start_server(
                name="limbloc", host=s.host, port=s.port, server_listener=self._interest, context=self._served
            )
        except Exception as error:  # the SDK has no narrower kind for a port that is taken
            raise ConfigError(f"nobody can be served on {s.host}:{s.port} ({error}); choose another port") from None
        self.port = int(self._server.port)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(DISCOVERY_PERIOD_S, self.discover, clock=steady)
        self.create_timer(INTEREST_PERIOD_S, self._follow_interest, clock=steady)
        self.get_logger().info(f"open ws://{s.host}:{self.port} in Foxglove")
        self.discover()

    def destroy_node(self) -> None:
        """Send the viewers away and destroy the node."""
        self._server.stop()
        super().destroy_node()

    def discover(self) -> None:
        """Announce topics that are new, and take back those that nobody publishes any more."""
        published = {
            name: kinds[0]
            for name, kinds in self.get_topic_names_and_types()
            if self._wanted(name) and self.count_publishers(name)
        }
        for name in [name for name in self._topics if name not in published]:
            self._topics.pop(name).close()
        for name, kind in published.items():
            if name in self._topics or name in self._refused:
                continue
            try:
                self._topics[name] = self._announce(name, kind)
            except InputError as error:
                self._refused.add(name)
                self.get_logger().warning(f"{name} is not shown: {error}")

    def _announce(self, name: str, kind: str) -> _Topic:
        message_type = message_class(kind)
        if kind not in TYPESTORE.fielddefs:
            raise InputError(f"the definition of {kind} is not known")
        definition, _ = TYPESTORE.generate_msgdef(kind, ros_version=2)
        schema = self._foxglove.Schema(name=kind, encoding="ros2msg", data=definition.encode())
        channel = self._foxglove.Channel(name, schema=schema, message_encoding="cdr", context=self._served)
        return _Topic(self, name, message_type, channel)

    def _follow_interest(self) -> None:
        counts, news = self._interest.take()
        for topic in self._topics.values():
            topic.follow(counts[topic.channel_id], topic.channel_id in news)

    def _wanted(self, name: str) -> bool:
        if self._hidden.fullmatch(name) or any(p.fullmatch(name) for p in self._exclude):
            return False
        return any(p.fullmatch(name) for p in self._include)


class _Topic:
    """One topic as a channel; it has a ROS subscription only while somebody looks."""

    def __init__(self, node: Node, name: str, message_type: Any, channel: Any) -> None:
        self._node, self._name, self._type, self._channel = node, name, message_type, channel
        self._subscription: Any = None
        self._latched = False
        self._kept: deque[bytes] = deque(maxlen=LATCHED_KEPT)
        self.channel_id = int(channel.id())

    def follow(self, viewers: int, somebody_came: bool) -> None:
        """Subscribe for the first viewer, unsubscribe after the last; latched messages are told to who comes later."""
        if viewers and self._subscription is None:
            self._subscribe()
        elif not viewers and self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
            self._subscription = None
            self._kept.clear()
        elif somebody_came:
            for cdr in self._kept:
                self._log(cdr)

    def close(self) -> None:
        """Take the channel back."""
        self.follow(0, False)
        self._channel.close()

    def _subscribe(self) -> None:
        offers = [p.qos_profile for p in self._node.get_publishers_info_by_topic(self._name)]
        reliable = all(offer.reliability == ReliabilityPolicy.RELIABLE for offer in offers)
        self._latched = bool(offers) and all(o.durability == DurabilityPolicy.TRANSIENT_LOCAL for o in offers)
        qos = QoSProfile(
            history=HistoryPolicy.KEEP_LAST,
            depth=LATCHED_KEPT if self._latched else 5,
            reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if self._latched else DurabilityPolicy.VOLATILE,
        )
        self._subscription = self._node.create_subscription(self._type, self._name, self._on_message, qos, raw=True)

    def _on_message(self, cdr: bytes) -> None:
        if self._latched:
            self._kept.append(cdr)
        self._log(cdr)

    def _log(self, cdr: bytes) -> None:
        self._channel.log(cdr, log_time=self._node.get_clock().now().nanoseconds)


class _Interest:
    """How many viewers look at each channel; the server calls it from its own thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: Counter[int] = Counter()
        self._news: set[int] = set()

    def on_subscribe(self, client: Any, channel: Any) -> None:
        """Somebody looks at a channel."""
        with self._lock:
            self._counts[int(channel.id)] += 1
            self._news.add(int(channel.id))

    def on_unsubscribe(self, client: Any, channel: Any) -> None:
        """Somebody looks away, or has left."""
        with self._lock:
            self._counts[int(channel.id)] -= 1

    def take(self) -> tuple[Counter[int], set[int]]:
        """Viewers of each channel now, and the channels that somebody came to since the last call."""
        with self._lock:
            news, self._news = self._news, set()
            return self._counts.copy(), news

    def __getattr__(self, name: str) -> Callable[..., None]:
        """The server's other events are of no interest."""
        if name.startswith("on_"):
            return lambda *_: None
        raise AttributeError(name)


def main() -> int:
    """Serve until Ctrl-C or SIGTERM."""
    return node_main.main(FoxgloveBridge)


if __name__ == "__main__":
    raise SystemExit(main())
