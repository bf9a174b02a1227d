# SPDX-License-Identifier: Apache-2.0
"""Running one node from the command line for people, with options in place of ROS parameters."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Mapping
from typing import Any

from limbloc_ros.ros.environment import NetworkConfig, graph_environment


def run_node(main: Callable[[], int], parameters: Mapping[str, Any]) -> int:
    """Call a node's main function with parameters; None and empty ones stay at their defaults.

    The environment that large messages need is set first, and found by everybody that this process starts.
    """
    os.environ.update(graph_environment(NetworkConfig(discovery="environment")))
    given = {name: value for name, value in parameters.items() if value not in (None, (), [])}
    arguments = [word for name, value in given.items() for word in ("-p", f"{name}:={json.dumps(value)}")]
    sys.argv = [sys.argv[0], "--ros-args", *arguments]
    return main()
