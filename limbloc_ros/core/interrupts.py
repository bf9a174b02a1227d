# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C that never lands inside the compiler of the kernels."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterable
from types import FrameType

#: Time after which a signal that came at a bad moment is sent again, s.
AGAIN_S = 0.02


def install(numbers: Iterable[signal.Signals]) -> None:
    """Let these signals raise KeyboardInterrupt in the main thread, but not while it is inside llvmlite."""
    for number in numbers:
        signal.signal(number, interrupt)


def interrupt(number: int, frame: FrameType | None) -> None:
    """Handler of a signal: raise KeyboardInterrupt, now or as soon as llvmlite has been left.

    LLVM calls Python back for the kernels that numba has cached. An exception there has nobody to go to: it is printed,
    the signal is lost, and LLVM goes on without the kernel and crashes.

    Args:
        number: of the signal.
        frame: what the main thread is executing.

    Raises:
        KeyboardInterrupt: unless the signal is sent again later.
    """
    while frame is not None:
        if frame.f_globals.get("__name__", "").startswith("llvmlite."):
            later = threading.Timer(AGAIN_S, os.kill, (os.getpid(), number))
            later.daemon = True
            later.start()
            return
        frame = frame.f_back
    raise KeyboardInterrupt
