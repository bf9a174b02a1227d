# SPDX-License-Identifier: Apache-2.0
"""The installed commands of the nodes: each runs `main` of the module of the same name.

Importing ROS and the numeric libraries takes a second or two. A Ctrl-C meanwhile, or `ros2 launch` that ends because
another node refused its parameters, finds nothing to clean up, and would come out of the middle of somebody's import as
a long traceback, or as an ImportError that nobody can explain. So the process just ends.
"""

from __future__ import annotations

import os
import signal
from functools import partial
from importlib import import_module
from types import FrameType


def command(node: str) -> int:
    """Run a node's `main`; a signal before it has its own handlers ends the process with exit code 0."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _end)
    return int(import_module(f"limbloc_ros.nodes.{node}").main())


def _end(_number: int, _frame: FrameType | None) -> None:
    os._exit(0)


segmentation = partial(command, "segmentation")
carving = partial(command, "carving")
pose = partial(command, "pose")
simulated_cameras = partial(command, "simulated_cameras")
replay = partial(command, "replay")
record = partial(command, "record")
composed = partial(command, "composed")
foxglove_bridge = partial(command, "foxglove_bridge")
