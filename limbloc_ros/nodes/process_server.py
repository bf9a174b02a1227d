# SPDX-License-Identifier: Apache-2.0
"""Forks the processes of a smart space; `limbloc_ros.ros.process_starter` starts it and tells why and how.

For every request it imports what the nodes of the new process need, unless an earlier one did, and loads their kernels.
The processes that need little come first and work while the rest is imported. It must never have a second thread,
because a fork takes only one along: the number libraries' thread pools are off, and ROS, whose import starts threads,
is left to the new process, for which it is a matter of a tenth of a second.
"""

from __future__ import annotations

import ctypes
import gc
import inspect
import json
import os
import signal
import socket
import sys
import time
import traceback
from pkgutil import resolve_name
from types import FrameType
from typing import Any, NoReturn

import cv2

from limbloc_ros.ros.process_starter import LONGEST

#: Kernels that take longer than this, s, are being compiled, not loaded.
PATIENCE_S = 4.0

#: What each kind of node works with, of ours and with all that comes along, but ROS; a function loads kernels. (The
#: first kernel of all brings much of numba along, so some are loaded before the first process is forked. What nobody
#: else needs, the kernels of the fit, the pose node loads itself: meanwhile the others start, and find it by DDS.)
NEEDED = {
    "simulated_cameras": ("simulation.room", "simulation.company", "rig.rig_file", "core.background:warm_up"),
    "segmentation": ("recordings.background_file", "recordings.videos", "core.background:warm_up"),
    "carving": ("rig.rig_file", "rig.watch", "core.synchroniser", "core.pipeline:Carver.warm_up"),
    "pose": ("core.people", "core.ros4hri", "core.pipeline:Carver.warm_up"),
    "replay": ("recordings.bags",),
    "record": ("recordings.bags",),
}

_PR_SET_PDEATHSIG, _PR_SET_NAME = 1, 15
_ASKED_TO_END = {signal.SIGINT, signal.SIGTERM}


def main() -> int:
    """Fulfil requests until the other end of the socket, a file descriptor and the only argument, is closed."""
    # Forked processes begin deaf to these as well, until they know how to end cleanly (`node_main.main`).
    signal.pthread_sigmask(signal.SIG_BLOCK, _ASKED_TO_END)
    supervisor = os.getppid()
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    signal.signal(signal.SIGALRM, explain)
    cv2.setNumThreads(1)
    gc.disable()  # nothing of what is imported becomes garbage, and a collection would write to all shared pages
    with socket.socket(fileno=int(sys.argv[1])) as channel:
        while True:
            text, outputs, _, _ = socket.recv_fds(channel, LONGEST, 1)
            if not text:
                return 0
            request = json.loads(text)
            signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
            prepare(request["description"])
            signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})
            gc.freeze()
            pid = fork_orphan()
            if pid == 0:
                channel.close()
                become(request, outputs[0], supervisor)
            os.close(outputs[0])
            channel.send(json.dumps({"key": request["key"], "pid": pid}).encode())


def prepare(description: str) -> None:
    """Import what the described nodes work with, and load their kernels."""
    signal.setitimer(signal.ITIMER_REAL, PATIENCE_S)
    try:
        for kind in {entry["kind"]: None for entry in json.loads(description)["nodes"]}:
            for name in NEEDED.get(kind, ()):
                found = resolve_name(f"limbloc_ros.{name}")
                if callable(found):
                    found()
        # ROS messages import this when the first one is made; and its logging asks in which module a line stands, for
        # which `inspect` looks at the files of all modules, but at each only once.
        resolve_name("rosidl_generator_py")
        inspect.getmodule(sys._getframe())
    except Exception as error:  # the process itself will meet it again, and say what it is about
        print(f"not prepared: {error}")
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)


def fork_orphan() -> int:
    """Fork a process whose parent is not us, with a session of its own: 0 in the new one, its id in ours."""
    ours, theirs = os.pipe()
    between = os.fork()
    if between == 0:
        between = os.getpid()
        try:
            orphan = os.fork()
        except OSError:
            os._exit(1)
        if orphan:
            os._exit(0)
        os.setsid()  # before anybody is told, who might signal the group
        os.write(theirs, str(os.getpid()).encode())
        while os.getppid() == between:  # until we are adopted
            time.sleep(0.001)
        os.close(ours)
        os.close(theirs)
        return 0
    os.close(theirs)
    os.waitpid(between, 0)
    with os.fdopen(ours) as told:
        return int(told.read())


def become(request: dict[str, Any], output: int, supervisor: int) -> NoReturn:
    """Turn into a process of nodes."""
    try:
        for descriptor in (1, 2):
            os.dup2(output, descriptor)
        os.close(output)
        os.environ.update(request["variables"])
        ctypes.CDLL(None).prctl(_PR_SET_NAME, request["name"].encode())
        gc.enable()
        from limbloc_ros.nodes import composed

        composed.main([composed.__name__, request["description"], "--parent", str(supervisor)])
    except BaseException:
        traceback.print_exc()
        sys.stderr.flush()
    finally:
        os._exit(1)


def explain(_number: int, _frame: FrameType | None) -> None:
    """Tell people what takes so long (a signal handler: a second thread would not do)."""
    print("loading the numeric kernels; the first start compiles them, which takes a minute or more")


if __name__ == "__main__":
    raise SystemExit(main())
