# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C that never lands inside the compiler of the kernels."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Iterable, Iterator
from types import FrameType

#: Exit code of a process that was interrupted.
EXIT_CODE = 130
#: Modules that compiled code calls back, which knows nothing of exceptions.
COMPILERS = ("llvmlite.", "numba.")
#: Time after which a signal that came at a bad moment is sent again, s.
AGAIN_S = 0.02


def install(numbers: Iterable[signal.Signals]) -> None:
    """Let these signals raise KeyboardInterrupt in the main thread, but not while it is inside a compiler."""
    for number in numbers:
        signal.signal(number, interrupt)


def interrupt(number: int, frame: FrameType | None) -> None:
    """Handler of a signal: raise KeyboardInterrupt, now or as soon as llvmlite and numba have been left.

    LLVM calls Python back for the kernels that numba has cached. An exception there has nobody to go to: it is printed,
    the signal is lost, and LLVM goes on without the kernel and crashes. Numba's dispatcher calls Python back for the
    types of arguments and results, and makes a SystemError of an exception there.

    Args:
        number: of the signal.
        frame: what the main thread is executing.

    Raises:
        KeyboardInterrupt: unless the signal is sent again later.
    """
    while frame is not None:
        if frame.f_globals.get("__name__", "").startswith(COMPILERS):
            later = threading.Timer(AGAIN_S, os.kill, (os.getpid(), number))
            later.daemon = True
            later.start()
            return
        frame = frame.f_back
    raise KeyboardInterrupt


@contextlib.contextmanager
def ending_at_once(text: str) -> Iterator[None]:
    """Within, Ctrl-C ends the process then and there, with `text` on standard error and EXIT_CODE.

    For the loading of kernels, while there is nothing to keep: what is called back in the middle of it can lose an
    exception. Only where `install` has been called for SIGINT.
    """
    if signal.getsignal(signal.SIGINT) is not interrupt:
        yield
        return

    def end(_number: int, _frame: FrameType | None) -> None:
        os.write(2, f"\n{text}\n".encode())
        os._exit(EXIT_CODE)

    signal.signal(signal.SIGINT, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, interrupt)
