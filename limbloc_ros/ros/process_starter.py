# SPDX-License-Identifier: Apache-2.0
"""Has the processes of a smart space forked by `limbloc_ros.nodes.process_server`, which has imported all they need.

A process of its own has to import the numeric libraries and ROS and to load compiled kernels, one to two seconds and
100 MB each; forked ones share what the server did once. The server must be a process without threads, so it cannot be
this one, which may take part in ROS.

What it forks becomes our child all the same: it forks twice, and we are the one who adopts orphans (the "subreaper",
`man 2 prctl`). So we see how each process ends, and the server may die without taking anybody with it.
"""

from __future__ import annotations

import ctypes
import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Mapping

#: What the server is called before its output.
SERVER = "start"

_PR_SET_CHILD_SUBREAPER = 36

#: Longest request and answer, bytes; the description of a hundred cameras is far shorter.
LONGEST = 1 << 20


class StartedProcess:
    """A process that the server has forked for us.

    Attributes:
        pid: its id, and that of the process group that it leads.
        returncode: as in `subprocess.Popen`; None while it runs.
    """

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self.returncode: int | None = None

    def poll(self) -> int | None:
        """The exit code, or minus the signal, if it has ended."""
        return self._reap(os.WNOHANG)

    def wait(self) -> int:
        """The same, when it has ended."""
        code = self._reap(0)
        assert code is not None
        return code

    def signal_group(self, number: signal.Signals) -> None:
        """Send a signal to the process and all that it has started, if any of them is left."""
        try:
            os.killpg(self.pid, number)
        except ProcessLookupError:
            return  # it was faster

    def group_alive(self) -> bool:
        """Whether the process or anything that it has started still runs."""
        if self.poll() is None:
            return True
        try:
            while os.waitpid(-self.pid, os.WNOHANG)[0]:
                pass  # the children of an ended process are ours, and stay in the table until we look
        except ChildProcessError:
            return False
        return True

    def _reap(self, options: int) -> int | None:
        if self.returncode is None:
            pid, status = os.waitpid(self.pid, options)
            if pid:
                self.returncode = os.waitstatus_to_exitcode(status)
        return self.returncode


class ProcessStarter:
    """The server, which is started with the first request and again when it has died.

    Args:
        environment: all variables of the server and of what it forks.

    Attributes:
        server: the running server, if any; its output is to be read from `server.stdout`.
    """

    def __init__(self, environment: Mapping[str, str]) -> None:
        self.server: subprocess.Popen[str] | None = None
        self._environment = dict(environment)
        self._socket: socket.socket | None = None

    def request(self, key: int, name: str, description: str, variables: Mapping[str, str], output: int) -> None:
        """Ask for a process; `started` tells when it runs.

        Args:
            key: given back by `started`.
            name: for people who look at the machine's processes.
            description: of its nodes, for `limbloc_ros.nodes.composed`.
            variables: environment variables of this process alone.
            output: file descriptor of its output and errors.

        Raises:
            OSError: the server cannot be started, or has died.
        """
        if self._socket is None:
            self._start_server()
        assert self._socket is not None
        text = json.dumps({"key": key, "name": name, "description": description, "variables": dict(variables)}).encode()
        socket.send_fds(self._socket, [text], [output])

    def started(self) -> list[tuple[int, StartedProcess]]:
        """Keys and processes of the requests that have been fulfilled since the last call.

        Raises:
            OSError: the server has died; what it has not fulfilled is to be requested anew.
        """
        found: list[tuple[int, StartedProcess]] = []
        while self._socket is not None:
            try:
                answer = self._receive(socket.MSG_DONTWAIT)
            except BlockingIOError:
                break
            if answer is None:
                if found:
                    break  # these first
                self.close()
                raise ConnectionResetError("the process that starts the others has ended")
            found.append(answer)
        return found

    def close(self) -> list[tuple[int, StartedProcess]]:
        """End the server; nothing is forked any more. Returns what it had forked in the last moment."""
        if self.server is None or self._socket is None:
            return []
        self._socket.shutdown(socket.SHUT_WR)  # ends it when it waits for a request,
        self.server.terminate()  # this when it is loading; it is deaf to it while it forks
        last = []
        while (answer := self._receive()) is not None:
            last.append(answer)
        self._socket.close()
        self.server.wait()
        self.server = self._socket = None
        return last

    def _receive(self, flags: int = 0) -> tuple[int, StartedProcess] | None:
        """The next answer; None when the server has ended."""
        assert self._socket is not None
        while True:
            try:
                text = self._socket.recv(LONGEST, flags)
            except ConnectionResetError:
                continue  # it ended with unread requests: this is told once, and before what it had answered
            if not text:
                return None
            answer = json.loads(text)
            return answer["key"], StartedProcess(answer["pid"])

    def _start_server(self) -> None:
        if ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0) != 0:
            raise OSError(ctypes.get_errno(), "prctl(PR_SET_CHILD_SUBREAPER) failed")
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            self.server = subprocess.Popen(
                [sys.executable, "-m", "limbloc_ros.nodes.process_server", str(theirs.fileno())],
                env=self._environment,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                errors="replace",
                start_new_session=True,
                pass_fds=[theirs.fileno()],
            )
        self._socket = ours
