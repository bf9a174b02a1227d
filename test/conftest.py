# SPDX-License-Identifier: Apache-2.0
"""What holds for all tests."""

import os
import signal
from pathlib import Path

import pytest

# One thread each, as the nodes of the graph have it (ros/environment.py): test processes run side by side, and BLAS's
# threads would wait for each other. Before numpy is imported; processes that tests start inherit it.
for library in ("OMP", "OPENBLAS"):
    os.environ.setdefault(f"{library}_NUM_THREADS", "1")

# A shell that runs the tests in the background has them ignore Ctrl-C, and all processes that they start would, too.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

#: A test file that speaks of any of these starts nodes or processes, and waits for them ...
_LIVE = ("rclpy", "ros_graph", "subprocess", "LocalCluster")
#: ... and of these a whole room, from a process that must be the first in which DDS starts: it reads its profile once.
_ROOM = ("from faults",)


def pytest_collection_modifyitems(items):
    """Mark what runs nodes or processes as `live`, whole rooms as `room`; others may run side by side (Makefile)."""
    marks = {}
    for item in items:
        if item.path not in marks:
            text = Path(item.path).read_text()
            room = any(word in text for word in _ROOM)
            marks[item.path] = "room" if room else "live" if any(word in text for word in _LIVE) else None
        if marks[item.path]:
            item.add_marker(marks[item.path])


@pytest.fixture
def graph():
    """A ROS context with a tester node of its own; closed after the test."""
    from ros_graph import Graph  # only where nodes are started: what calculates needs no ROS

    graph = Graph()
    yield graph
    graph.close()
