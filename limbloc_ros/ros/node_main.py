# SPDX-License-Identifier: Apache-2.0
"""Starting, spinning and stopping nodes, alone or several in one process."""

from __future__ import annotations

import gc
import os
import signal
import time
from collections.abc import Callable, Sequence
from types import FrameType

import cv2
import rclpy
from rclpy.context import Context
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from limbloc_ros.core.errors import LimblocError
from limbloc_ros.core.interrupts import interrupt
from limbloc_ros.ros.exit_codes import REFUSED

#: A node that is still being compiled so long after a signal, s, is not waited for: `ros2 launch` kills after ten.
LATE_S = 3.0


def make_executor(context: Context | None = None) -> Executor:
    """The events executor, five times cheaper per callback, where rclpy has it; else the single-threaded one."""
    try:
        from rclpy.experimental import EventsExecutor
    except ImportError:
        return SingleThreadedExecutor(context=context)
    return EventsExecutor(context=context)


def spin(
    nodes: Sequence[Node],
    context: Context | None = None,
    until: Callable[[], bool] | None = None,
    timeout_s: float | None = None,
) -> bool:
    """Run the nodes' callbacks in this thread until the context is shut down.

    Once per node: a message whose event waits in an executor that ends is not announced to the next one.

    Args:
        nodes: all of the same context.
        context: the default one if None.
        until: checked after every callback; True ends the loop.
        timeout_s: ends the loop after this long.

    Returns:
        whether `until` became True.
    """
    executor = make_executor(context)
    for node in nodes:
        executor.add_node(node)
    try:
        return run(executor, context, until, timeout_s)
    except (KeyboardInterrupt, ExternalShutdownException):
        return False
    finally:
        for node in nodes:
            executor.remove_node(node)
        executor.shutdown()


def run(
    executor: Executor,
    context: Context | None = None,
    until: Callable[[], bool] | None = None,
    timeout_s: float | None = None,
) -> bool:
    """The loop of `spin` on an executor that already has its nodes."""
    # The EventsExecutor's own spin() ignores signals and can hang at shutdown, so the loop is ours.
    deadline = None if timeout_s is None else time.monotonic() + timeout_s
    while rclpy.ok(context=context):
        if until is not None and until():
            return True
        if deadline is not None and time.monotonic() > deadline:
            return False
        executor.spin_once(timeout_sec=0.02)
    return False


def main(
    make_nodes: Callable[[], Node | Sequence[Node]],
    args: Sequence[str] | None = None,
    until: Callable[[], bool] | None = None,
) -> int:
    """The main function of a process of nodes: init, build, spin, clean shutdown.

    Args:
        make_nodes: builds the node, or several to be composed in this process.
        args: command line with ROS arguments; the process's own if None.
        until: True ends the process (a recording that has been replayed).

    Returns:
        exit code: 0 after a clean stop, REFUSED when a node could not start (the reason is logged).
    """
    cv2.setNumThreads(1)  # one process per stage already uses the cores; OpenCV's pool only adds waiting
    nodes: Sequence[Node] = ()
    code = 0
    making = stopped = False
    stopped_s = 0.0

    def on_signal(number: int, frame: FrameType | None) -> None:
        nonlocal stopped, stopped_s
        if not stopped:
            stopped, stopped_s = True, time.monotonic()
        if making:  # a start that compiles kernels takes a while; nobody wants to wait for its end
            if time.monotonic() - stopped_s > LATE_S:  # the signal comes again and again until the compiler is left
                os._exit(0)
            interrupt(number, frame)

    def make() -> Sequence[Node]:
        nonlocal making
        making = not stopped
        try:
            made = make_nodes() if making else ()
        finally:
            making = False  # what comes now, also the word about what went wrong, comes to its end
        return [made] if isinstance(made, Node) else made

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, on_signal)
    try:
        # rclpy's own handlers invalidate the context at once, and a callback that is just publishing then fails.
        rclpy.init(args=None if args is None else list(args), signal_handler_options=SignalHandlerOptions.NO)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT, signal.SIGTERM})  # see nodes/process_server.py
        nodes = make()
        spin(nodes, until=lambda: stopped or (until is not None and until()))
    except LimblocError as error:
        get_logger("limbloc").fatal(str(error))
        code = REFUSED
    except KeyboardInterrupt:
        pass
    except ImportError:
        if not stopped:  # numpy's C modules make one of an interrupt
            raise
    finally:
        for node in nodes:
            node.destroy_node()
        rclpy.try_shutdown()
    gc.collect()  # the rest of a node that was not finished, whose shared memory would stay
    return code
