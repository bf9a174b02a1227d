# SPDX-License-Identifier: Apache-2.0
"""A real ROS graph for tests: nodes composed in this process, talking over DDS on a domain of their own."""

from __future__ import annotations

import gc
import os
from collections.abc import Callable
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter

from limbloc_ros.ros import health, node_main, topics

os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"

#: Fast DDS needs ports 7400 + 250 * domain; ids up to 100 keep clear of the ephemeral ports.
DOMAIN = 1 + os.getpid() % 100

TIMEOUT_S = 20.0

health.PERIOD_S = 0.1  # diagnostics ten times a second, or the tests would mostly wait for them


class Graph:
    """Nodes under test and one tester node, spun together in this thread."""

    def __init__(self) -> None:
        gc.collect()  # nodes whose constructor failed in an earlier test are still on the network until then
        self.context = Context()
        rclpy.init(context=self.context, domain_id=DOMAIN)
        self.executor = node_main.make_executor(self.context)
        self.nodes: list[Node] = []
        self.tester = self.add(lambda **options: Node("tester", **options))

    def close(self) -> None:
        """Destroy all nodes and shut the context down."""
        for node in list(self.nodes):
            self.remove(node)
        self.executor.shutdown()
        rclpy.shutdown(context=self.context)

    def add(self, make: Callable[..., Node], _name: str = "", **parameters: Any) -> Any:
        """Build a node with parameters; `__` in a name stands for the dot of a section."""
        overrides = [Parameter(name.replace("__", "."), value=value) for name, value in parameters.items()]
        names = {"node_name": _name} if _name else {}
        node = make(context=self.context, parameter_overrides=overrides, **names)
        self.nodes.append(node)
        self.executor.add_node(node)
        return node

    def remove(self, node: Node) -> None:
        """Take a node out of the graph, as if its process had died."""
        self.nodes.remove(node)
        self.executor.remove_node(node)
        node.destroy_node()

    def collect(self, kind: Any, topic: str, qos: Any = topics.STREAM_QOS) -> list[Any]:
        """A list to which every message of a topic is appended."""
        messages: list[Any] = []
        self.tester.create_subscription(kind, topic, messages.append, qos)
        return messages

    def diagnostics(self) -> Diagnostics:
        """Follow `/diagnostics`."""
        return Diagnostics(self.collect(DiagnosticArray, topics.DIAGNOSTICS, topics.DIAGNOSTICS_QOS))

    def publisher(self, kind: Any, topic: str, qos: Any = topics.STREAM_QOS) -> Any:
        """A publisher that has found its subscriber."""
        publisher = self.tester.create_publisher(kind, topic, qos)
        self.until(lambda: publisher.get_subscription_count() > 0)
        return publisher

    def call(self, kind: Any, name: str, request: Any) -> Any:
        """Call a service and return its response."""
        client = self.tester.create_client(kind, name)
        self.until(client.service_is_ready)
        future = client.call_async(request)
        self.until(future.done)
        return future.result()

    def until(self, condition: Callable[[], bool], timeout_s: float = TIMEOUT_S) -> None:
        """Spin all nodes until the condition holds; fails after a while."""
        assert node_main.run(self.executor, self.context, condition, timeout_s), (
            "the condition did not come true in time"
        )

    def spin(self, seconds: float) -> None:
        """Spin all nodes for some time."""
        node_main.run(self.executor, self.context, None, seconds)


class Diagnostics:
    """The newest entry of each name."""

    def __init__(self, messages: list[DiagnosticArray]) -> None:
        self._messages = messages

    def __getitem__(self, name: str) -> DiagnosticStatus | None:
        for msg in reversed(self._messages):
            for status in msg.status:
                if status.name == name:
                    return status
        return None

    def says(self, name: str, *words: str) -> Callable[[], bool]:
        """Whether the newest entry of `name` holds all the words in its message."""

        def check() -> bool:
            status = self[name]
            return status is not None and all(word in status.message for word in words)

        return check

    def value(self, name: str, key: str) -> str:
        """One value of the newest entry; empty while there is none."""
        status = self[name]
        return "" if status is None else next(pair.value for pair in status.values if pair.key == key)
