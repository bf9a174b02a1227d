# SPDX-License-Identifier: Apache-2.0
"""Serialised messages as they are on the wire: message classes by type name, and a check before they are published.

rclpy publishes any bytes as a message without looking at them; a subscriber then fails or reads nonsense.
"""

from __future__ import annotations

import importlib
from functools import cache
from typing import Any

from limbloc_ros.core.errors import InputError
from limbloc_ros.recordings.bags import deserialise


@cache
def message_class(kind: str) -> Any:
    """The rclpy class of a message type such as `sensor_msgs/msg/Image`.

    Raises:
        InputError: the name is no message type, or its package is not installed.
    """
    parts = kind.split("/")
    if len(parts) != 3 or parts[1] != "msg" or not all(part.isidentifier() for part in parts):
        raise InputError(f"expected a message type such as sensor_msgs/msg/Image, got {kind!r}")
    try:
        return getattr(importlib.import_module(f"{parts[0]}.msg"), parts[2])
    except (ImportError, AttributeError) as error:
        raise InputError(f"the message type {kind} is not installed ({error}): install its package") from None


def check_cdr(kind: str, cdr: bytes, where: str) -> None:
    """Raise InputError, naming `where`, unless `cdr` is a whole message of type `kind`. Costs some 10 us an image."""
    if len(cdr) < 4 or cdr[0] != 0 or cdr[1] not in (0, 1):
        raise InputError(f"{where}: expected a CDR message, got {len(cdr)} bytes that begin with {cdr[:4].hex(' ')}")
    deserialise(kind, cdr, where)
