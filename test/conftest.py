# SPDX-License-Identifier: Apache-2.0
"""What holds for all tests."""

import signal
from pathlib import Path

# A shell that runs the tests in the background has them ignore Ctrl-C, and all processes that they start would, too.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

#: A test file that speaks of any of these starts nodes or processes, and waits for them.
_LIVE = ("rclpy", "ros_graph", "subprocess", "LocalCluster", "import faults", "from faults")


def pytest_collection_modifyitems(items):
    """Mark what runs nodes or processes as `live`: one at a time, the others may run side by side (see Makefile)."""
    live = {}
    for item in items:
        if item.path not in live:
            text = Path(item.path).read_text()
            live[item.path] = any(word in text for word in _LIVE)
        if live[item.path]:
            item.add_marker("live")
